//! What the reader refuses, and where each value lies in the file.

use super::super::tests::cloud;
use super::*;

fn read_bytes(bytes: &[u8]) -> Result<GaussianCloud, ExportError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.ply");
    std::fs::write(&path, bytes).unwrap();
    crate::export::MapFormat::default().read(&path)
}

fn refusal(bytes: &[u8]) -> String {
    let message = read_bytes(bytes).unwrap_err().to_string();
    assert!(message.contains("map.ply"), "names no file: {message}");
    message
}

/// A file's header as text and the rest of it.
fn split(bytes: &[u8]) -> (String, Vec<u8>) {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|window| window == end).unwrap() + end.len();
    (String::from_utf8(bytes[..at].to_vec()).unwrap(), bytes[at..].to_vec())
}

fn with_header(bytes: &[u8], change: impl Fn(&str) -> String) -> Vec<u8> {
    let (header, body) = split(bytes);
    let changed = change(&header);
    assert_ne!(header, changed, "the change changes nothing");
    [changed.into_bytes(), body].concat()
}

#[test]
fn each_value_lies_where_the_reference_code_puts_it() {
    let degree = ShDegree::new(1).unwrap();
    let mut cloud = GaussianCloud::new(degree);
    cloud.push(Gaussian {
        mean: Vec3::new(1.0, 2.0, 3.0),
        log_scale: Vec3::new(-1.0, -2.0, -3.0),
        // 2 (w + x + y + z): a half each once it is normalised, but for the sign of y.
        rotation: Quat::from_xyzw(2.0, -2.0, 2.0, 2.0),
        raw_opacity: 0.75,
        sh: vec![
            Vec3::new(10.0, 20.0, 30.0),
            Vec3::new(11.0, 21.0, 31.0),
            Vec3::new(12.0, 22.0, 32.0),
            Vec3::new(13.0, 23.0, 33.0),
        ],
    });
    let bytes = encode(&cloud).unwrap();
    let (header, body) = split(&bytes);
    let names: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let expected_names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 f_rest_7 \
                          f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    assert_eq!(names, expected_names.split_whitespace().collect::<Vec<_>>());
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"));
    let values: Vec<f32> = body.chunks(4).map(|chunk| f32::from_le_bytes(chunk.try_into().unwrap())).collect();
    let expected = [
        [1.0, 2.0, 3.0, 0.0, 0.0, 0.0].as_slice(),
        // The constant band, then all of red, of green, of blue.
        &[10.0, 20.0, 30.0, 11.0, 12.0, 13.0, 21.0, 22.0, 23.0, 31.0, 32.0, 33.0],
        &[0.75, -1.0, -2.0, -3.0, 0.5, 0.5, -0.5, 0.5],
    ];
    assert_eq!(values, expected.concat());
}

#[test]
fn other_orders_other_properties_and_comments_are_read() {
    let cloud = cloud(ShDegree::default(), 2);
    let bytes = encode(&cloud).unwrap();
    let (header, body) = split(&bytes);
    // Opacity first, an 8-bit property in the middle, no normals, an element after the vertices, line ends of Windows.
    let mut names: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let old_names = names.clone();
    names.retain(|name| !name.starts_with('n') && *name != "opacity");
    names.insert(0, "opacity");
    let mut new_header = String::from("ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 2\n");
    let mut new_body = Vec::new();
    for (i, name) in names.iter().enumerate() {
        new_header.push_str(&format!("property float32 {name}\n"));
        if i == 4 {
            new_header.push_str("property uchar red\n");
        }
    }
    new_header.push_str("element extra 1\nproperty list uchar int indices\nend_header\n");
    for vertex in body.chunks(4 * old_names.len()) {
        for (i, name) in names.iter().enumerate() {
            let at = 4 * old_names.iter().position(|old| old == name).unwrap();
            new_body.extend_from_slice(&vertex[at..at + 4]);
            if i == 4 {
                new_body.push(200);
            }
        }
    }
    new_body.push(0);
    let file = [new_header.replace('\n', "\r\n").into_bytes(), new_body].concat();
    assert_eq!(read_bytes(&file).unwrap(), read_bytes(&bytes).unwrap());
}

#[test]
fn doubles_and_harmonics_of_degree_4_are_read() {
    let map = cloud(ShDegree::new(3).unwrap(), 3);
    let bytes = encode(&map).unwrap();
    let (header, body) = split(&bytes);
    let names: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    // 24 harmonics a channel, of which the last nine are of degree 4; all as doubles.
    let values = |vertex: &[u8], name: &str| {
        let at = 4 * names.iter().position(|known| *known == name).unwrap();
        f64::from(f32::from_le_bytes(vertex[at..at + 4].try_into().unwrap()))
    };
    let mut longer: Vec<String> =
        names.iter().filter(|name| !name.starts_with("f_rest")).map(|name| (*name).to_owned()).collect();
    longer.extend((0..72).map(|k| format!("f_rest_{k}")));
    let mut file = String::from("ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\nelement vertex 3\n");
    longer.iter().for_each(|name| file += &format!("property double {name}\n"));
    let mut file = (file + "end_header\n").into_bytes();
    for vertex in body.chunks(4 * names.len()) {
        for name in &longer {
            let value = match name.strip_prefix("f_rest_").map(|number| number.parse::<usize>().unwrap()) {
                Some(k) if k % 24 >= 15 => 99.0,
                Some(k) => values(vertex, &format!("f_rest_{}", k / 24 * 15 + k % 24)),
                None => values(vertex, name),
            };
            file.extend(value.to_le_bytes());
        }
    }
    // The comment says so.
    let expected = GaussianCloud { antialiased: true, ..read_bytes(&bytes).unwrap() };
    assert_eq!(read_bytes(&file).unwrap(), expected);
}

#[test]
fn cut_off_or_overlong_files_are_refused() {
    let bytes = encode(&cloud(ShDegree::new(3).unwrap(), 3)).unwrap();
    let (header, _) = split(&bytes);
    for length in (0..bytes.len()).step_by(7).chain([header.len(), bytes.len() - 1]) {
        refusal(&bytes[..length]);
    }
    let message = refusal(&bytes[..bytes.len() - 1]);
    assert!(message.contains("promises 3 Gaussians of 248 bytes, but 743 bytes follow"), "{message}");
    refusal(&[bytes.clone(), vec![0]].concat());
}

#[test]
fn lying_counts_are_refused_before_anything_is_allocated() {
    let bytes = encode(&cloud(ShDegree::default(), 1)).unwrap();
    for count in ["1099511627776", "18446744073709551615", "2"] {
        let lie = with_header(&bytes, |header| header.replace("vertex 1", &format!("vertex {count}")));
        assert!(refusal(&lie).contains(&format!("promises {count} Gaussians")));
    }
    assert!(refusal(&with_header(&bytes, |h| h.replace("vertex 1", "vertex -1"))).contains("map.ply:3: `-1`"));
}

#[test]
fn headers_that_are_not_ours_say_what_is_wrong() {
    let bytes = encode(&cloud(ShDegree::default(), 1)).unwrap();
    let message = |from: &str, to: &str| refusal(&with_header(&bytes, |header| header.replace(from, to)));
    assert!(message("binary_little_endian", "ascii").contains("map.ply:2: `format ascii 1.0` is not supported"));
    assert!(message("float opacity", "int opacity").contains("`opacity` is not a float"));
    assert!(message("float opacity", "float alpha").contains("`opacity` is missing"));
    assert!(message("float nx", "float f_rest_0").contains("1 properties are called f_rest_*"));
    assert!(message("float nx", "float x").contains("there twice"));
    assert!(message("float nx", "list uchar int nx").contains("`nx` of a vertex is a list"));
    let early = message("element vertex 1\nproperty float x\n", "property float x\nelement vertex 1\n");
    assert!(early.contains("map.ply:3: `property float x` is not understood"), "{early}");
    assert!(message("float nx", "half nx").contains("`half`"));
    assert!(message("element vertex 1", "element chunk 1\nelement vertex 1").contains("before the vertices"));
    assert!(message("format binary_little_endian 1.0\n", "").contains("says the format"));
    assert!(message("end_header", "end").contains("`end` is not understood"));
    assert!(refusal(b"\x89PNG").contains("no PLY"));
    assert!(refusal(&vec![b'x'; 1 << 20]).contains("no PLY"));
    assert!(refusal(&[b"ply\n".to_vec(), vec![b'x'; 1 << 20]].concat()).contains("no end"));
}

#[test]
fn values_that_are_no_numbers_are_refused() {
    let bytes = encode(&cloud(ShDegree::default(), 2)).unwrap();
    let (header, _) = split(&bytes);
    // The 10th property of the second Gaussian is its opacity, the last four its rotation.
    let mut damaged = bytes.clone();
    let at = header.len() + 4 * (17 + 9);
    damaged[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(refusal(&damaged).contains("`opacity` of Gaussian 1 is NaN"));
    let mut turned = bytes.clone();
    let end = bytes.len();
    turned[end - 16..end].fill(0);
    assert!(refusal(&turned).contains("`rot` of Gaussian 1 is 0"));

    let mut map = cloud(ShDegree::default(), 3);
    map.means[1].y = f32::NAN;
    assert!(matches!(encode(&map), Err(ExportError::NonFinite { index: 1 })));
}

#[test]
fn an_empty_map_is_a_file_too() {
    let bytes = encode(&GaussianCloud::new(ShDegree::default())).unwrap();
    assert!(read_bytes(&bytes).unwrap().is_empty());
}

#[test]
fn quaternions_of_unit_length_keep_their_bits() {
    let almost = Quat::from_xyzw(0.5, 0.5, 0.5, 0.5 + f32::EPSILON / 2.0);
    assert_eq!(unit_rotation(almost).to_array(), almost.to_array());
    assert_eq!(unit_rotation(Quat::from_xyzw(0.0, 1.2, 0.0, 1.6)).to_array(), [0.0, 0.6, 0.0, 0.8]);
    assert_eq!(unit_rotation(Quat::from_xyzw(0.0, 0.0, 0.0, 0.0)).to_array(), [0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn headers_are_refused_at_the_line_that_is_wrong() {
    let bytes = encode(&cloud(ShDegree::default(), 1)).unwrap();
    let (header, _) = split(&bytes);
    let lines = header.lines().count();
    let without_format = with_header(&bytes, |h| h.replace("format binary_little_endian 1.0\n", ""));
    assert!(refusal(&without_format).contains(&format!("map.ply:{}: no line says", lines - 1)));
    assert!(
        refusal(&with_header(&bytes, |h| h.replace("element vertex 1\n", "element vertex 1\nelement vertex 1\n")))
            .contains("is missing")
    );
    let early = with_header(&bytes, |h| h.replace("element vertex 1\n", "element face 1\nelement vertex 1\n"));
    assert!(refusal(&early).contains("map.ply:3: `element face 1` comes before"));
    assert!(refusal(b"ply\nend_header").contains("map.ply:2: the header has no end"));
}

#[test]
fn sixteen_bit_properties_are_stepped_over() {
    let bytes = encode(&cloud(ShDegree::default(), 1)).unwrap();
    let mut longer = with_header(&bytes, |h| h.replace("end_header", "property ushort label\nend_header"));
    longer.extend([1, 2]);
    assert_eq!(read_bytes(&longer).unwrap(), read_bytes(&bytes).unwrap());
}
