//! Damaged, cut and lying files: every parser says what is wrong, in bounded memory, and never panics. The seeds are those of the fuzz
//! targets (`fuzz/corpus`); here they are damaged by seeded chance, there by what covers more code.

use std::alloc::{GlobalAlloc, Layout as Memory, System};
use std::cell::Cell;
use std::path::{Path, PathBuf};

use fastrand::Rng;
use keysplat::config::Config;
use keysplat::export::MapFormat;
use keysplat::geometry::Trajectory;
use keysplat::mesh::Mesh;
use keysplat::sequence::Layout;
use keysplat::synthetic::SceneConfig;
use keysplat::viewing::FromViewer;

/// Counts the bytes in use by each thread, and the most that ever were: a test is one thread, and others run beside it.
struct Counting;

thread_local! {
    static USED: Cell<usize> = const { Cell::new(0) };
    static PEAK: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: everything is passed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, memory: Memory) -> *mut u8 {
        USED.set(USED.get() + memory.size());
        PEAK.set(PEAK.get().max(USED.get()));
        unsafe { System.alloc(memory) }
    }

    unsafe fn dealloc(&self, at: *mut u8, memory: Memory) {
        // What another thread has allocated was not counted here.
        USED.set(USED.get().saturating_sub(memory.size()));
        unsafe { System.dealloc(at, memory) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// More than any of these files may need.
const MOST_BYTES: usize = 8 << 20;
const DAMAGED_EACH: usize = 400;

/// The parsers of a target: how many of them took the bytes.
fn parse(target: &str, bytes: &[u8]) -> usize {
    let path = Path::new("file");
    let text = || std::str::from_utf8(bytes).ok();
    if let Some(format) = MapFormat::by_name(target) {
        return usize::from(format.decode(bytes).is_ok());
    }
    match (Layout::by_name(target), target) {
        (Some(layout), _) => layout.parse_files(bytes).iter().filter(|result| result.is_ok()).count(),
        (_, "trajectory") => usize::from(text().is_some_and(|text| Trajectory::parse_tum(text, path).is_ok())),
        (_, "config") => usize::from(text().is_some_and(|text| Config::parse(text, path, false).is_ok())),
        (_, "viewer") => usize::from(text().is_some_and(|text| match FromViewer::parse(text) {
            Some(FromViewer::Render(request)) => request.camera().is_some(),
            message => message.is_some(),
        })),
        (_, "meshes") => usize::from(Mesh::decode(bytes, path).is_ok()),
        (_, "scene") => usize::from(text().is_some_and(|text| SceneConfig::parse(text, path).is_ok())),
        _ => panic!("the corpus {target} has no parser here"),
    }
}

/// `(target, file, bytes)` of the whole corpus.
fn corpus() -> Vec<(String, PathBuf, Vec<u8>)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let entries = |folder: &Path| -> Vec<PathBuf> {
        let mut paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        paths.sort();
        paths
    };
    let of_target = |folder: PathBuf| {
        let target = folder.file_name().unwrap().to_str().unwrap().to_owned();
        entries(&folder).into_iter().map(move |file| (target.clone(), file.clone(), std::fs::read(file).unwrap()))
    };
    // One target has all layouts and one all formats, a folder each.
    let (tables, targets): (Vec<_>, Vec<_>) =
        entries(&root).into_iter().partition(|folder| folder.ends_with("layouts") || folder.ends_with("formats"));
    let rows = tables.iter().flat_map(|folder| entries(folder));
    targets.into_iter().chain(rows).flat_map(of_target).collect()
}

/// A copy with some bytes changed, lost, doubled, or replaced by numbers that lie.
fn damaged(rng: &mut Rng, bytes: &[u8]) -> Vec<u8> {
    const LIES: [&[u8]; 8] = [b"nan", b"-1", b"1e999", b"18446744073709551615", b"[[[[", b"\xff", b"\n", &[0xff; 8]];
    let mut bytes = bytes.to_vec();
    for _ in 0..rng.usize(1..6) {
        let at = rng.usize(..=bytes.len());
        let end = (at + rng.usize(..12)).min(bytes.len());
        match rng.usize(..5) {
            0 => bytes.truncate(at),
            1 => bytes[at..end].iter_mut().for_each(|byte| *byte ^= 1 << rng.u8(..8)),
            2 => drop(bytes.drain(at..end)),
            3 => drop(bytes.splice(at..end, LIES[rng.usize(..LIES.len())].iter().copied())),
            _ => {
                let twice = bytes[at..end].repeat(2);
                drop(bytes.splice(at..end, twice));
            }
        }
    }
    bytes
}

fn assert_bounded(what: &str) {
    let peak = PEAK.get();
    assert!(peak < MOST_BYTES, "{what} took {peak} bytes");
}

#[test]
fn the_corpus_is_read_and_its_damaged_copies_do_no_harm() {
    let corpus = corpus();
    assert!(
        Layout::all().iter().all(|layout| corpus.iter().any(|(target, ..)| target == layout.name())),
        "fuzz/corpus/layouts lacks a folder for a layout"
    );
    assert!(
        MapFormat::all().iter().all(|format| corpus.iter().any(|(target, ..)| target == format.name())),
        "fuzz/corpus/formats lacks a folder for a format"
    );
    for (target, file, bytes) in corpus {
        assert!(parse(&target, &bytes) > 0, "{} is read by no parser", file.display());
        let mut rng = Rng::with_seed(bytes.len() as u64);
        for _ in 0..DAMAGED_EACH {
            parse(&target, &damaged(&mut rng, &bytes));
        }
        assert_bounded(&file.display().to_string());
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut encoder, bytes).unwrap();
    encoder.finish().unwrap()
}

/// A zip whose description promises `count` Gaussians, and names files outside of it.
fn sog(count: u64) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
    let one = |file: &str| serde_json::json!({ "codebook": [0.0], "files": [file] });
    let meta = serde_json::json!({
        "version": 2, "count": count, "scales": one("/etc/passwd"), "sh0": one("../x"), "quats": one("x"),
        "means": { "mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["../../x", "x"] },
    });
    zip.start_file("meta.json", options).unwrap();
    std::io::Write::write_all(&mut zip, meta.to_string().as_bytes()).unwrap();
    // As long as an honest file, and compressed to nothing.
    zip.start_file("x", options).unwrap();
    std::io::Write::write_all(&mut zip, &vec![0; 32 << 20]).unwrap();
    zip.finish().unwrap().into_inner()
}

#[test]
fn lying_headers_cost_no_memory() {
    let names = [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
        "rot_3",
    ];
    let properties: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    for count in [1u64 << 40, 1 << 58, u64::MAX] {
        let header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n");
        assert_eq!(parse("ply", &[header.as_bytes(), &[0; 4096]].concat()), 0);
        let promised = (count as u32).max(1 << 31).to_le_bytes();
        let spz = [&0x5053_474eu32.to_le_bytes()[..], &3u32.to_le_bytes(), &promised, &[3, 12, 0, 0], &[0; 4096]].concat();
        assert_eq!(parse("spz", &gzip(&spz)), 0);
        let spz4 =
            [&0x5053_474eu32.to_le_bytes()[..], &4u32.to_le_bytes(), &promised, &[3, 12, 0, 6], &32u32.to_le_bytes()].concat();
        assert_eq!(parse("spz4", &[&spz4[..], &[0; 4096]].concat()), 0);
        // Made by another thread, whose memory is not counted.
        let bytes = std::thread::spawn(move || sog(count)).join().unwrap();
        assert_eq!(parse("sog", &bytes), 0);
        for stride in [12, u64::MAX] {
            let names = ["POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"];
            let kinds = ["VEC3", "VEC4", "VEC3", "SCALAR", "VEC3"];
            let name = |name: &str| format!("{}{name}", if name == "POSITION" { "" } else { "KHR_gaussian_splatting:" });
            let attributes: serde_json::Map<_, _> = (0..5).map(|k| (name(names[k]), serde_json::json!(k))).collect();
            let accessor =
                |k: usize| serde_json::json!({ "bufferView": 0, "componentType": 5126, "count": count, "type": kinds[k] });
            let document = serde_json::json!({
                "meshes": [{ "primitives": [{ "attributes": attributes, "extensions": { "KHR_gaussian_splatting": {} } }] }],
                "bufferViews": [{ "buffer": 0, "byteLength": 64, "byteStride": stride }],
                "accessors": (0..5).map(accessor).collect::<Vec<_>>(),
            });
            let mut text = document.to_string().into_bytes();
            text.resize(text.len().next_multiple_of(4), b' ');
            let length = (28 + text.len() + 64) as u32;
            let start = [b"glTF".as_slice(), &2u32.to_le_bytes(), &length.to_le_bytes()].concat();
            let json = [&(text.len() as u32).to_le_bytes(), b"JSON".as_slice(), &text].concat();
            let glb = [start, json, [&64u32.to_le_bytes(), b"BIN\0".as_slice(), &[0; 64]].concat()].concat();
            assert_eq!(parse("glb", &glb), 0);
        }
        let model = [&count.to_le_bytes()[..], &[1; 4096]].concat();
        assert_eq!(parse("colmap", &model), 0);
        let mut atom = [0u8, 0, 0, 1, b'f', b't', b'y', b'p'].to_vec();
        atom.extend(count.to_be_bytes());
        assert_eq!(parse("video", &atom), 1, "it is a video, and known to be cut");
    }
    assert_bounded("a lying header");
}

#[test]
fn deep_nesting_and_endless_aliases_are_refused() {
    let deep = |open: &str| open.repeat(10_000);
    for target in ["transforms", "replica"] {
        assert_eq!(parse(target, deep("[").as_bytes()), 0);
        assert_eq!(parse(target, deep("{\"a\":").as_bytes()), 0);
    }
    for target in ["config", "images", "scene"] {
        assert_eq!(parse(target, format!("a = {}", deep("[")).as_bytes()), 0);
        assert_eq!(parse(target, format!("a = {}", deep("{b=")).as_bytes()), 0);
        assert_eq!(parse(target, format!("{} = 1", deep("a.")).as_bytes()), 0);
    }
    assert_eq!(parse("euroc", deep("[").as_bytes()), 0);
    assert_eq!(parse("euroc", deep("- ").as_bytes()), 0);
    let mut aliases = String::from("a0: &a0 [1]\n");
    for i in 1..30 {
        aliases += &format!("a{i}: &a{i} [{}]\n", vec![format!("*a{}", i - 1); 10].join(", "));
    }
    assert_eq!(parse("euroc", aliases.as_bytes()), 0);
    assert_eq!(parse("euroc", format!("a: [{}1]", "1, ".repeat(100_000)).as_bytes()), 0);
    assert_bounded("nesting");
}
