//! What the reader refuses, and that the same map gives the same bytes.

use super::bundle::{Plane, Reader, Writer};
use super::*;
use crate::export::tests::cloud;
use crate::export::{ExportError, FileSize};
use crate::geometry::Se3;
use crate::splat::{GaussianCloud, ShDegree};

fn read(bytes: &[u8]) -> Result<GaussianCloud, ExportError> {
    read::decode(&mut &*bytes, FileSize(bytes.len() as u64), std::path::Path::new("x.sog"))
}

const IMAGES: [&str; 7] =
    ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp"];

/// The file with its description changed, and with another image in place of one.
fn with(bytes: &[u8], change: impl Fn(&mut serde_json::Value), image: Option<(&str, Plane)>) -> Vec<u8> {
    let mut from = Reader::new(bytes).unwrap();
    let mut to = Writer::new();
    for name in IMAGES {
        match &image {
            Some((other, plane)) if *other == name => to.add_plane(name, plane).unwrap(),
            _ => to.add(name, &from.entry(name).unwrap()).unwrap(),
        }
    }
    let mut meta: serde_json::Value = serde_json::from_slice(&from.entry(META).unwrap()).unwrap();
    change(&mut meta);
    to.add(META, meta.to_string().as_bytes()).unwrap();
    to.finish().unwrap()
}

#[test]
fn the_same_map_gives_the_same_bytes_and_another_order_does_not_matter() {
    let map = cloud(ShDegree::ALL[2], 500);
    let cameras: Vec<Se3> = (0..5).map(|k| Se3::translation(0.2 * f64::from(k), 0.0, -12.0)).collect();
    let bytes = write::encode(&map, &cameras, &COMPACT).unwrap();
    assert!(write::encode(&map, &cameras, &COMPACT).unwrap() == bytes);
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(one_thread.install(|| write::encode(&map, &cameras, &COMPACT)).unwrap() == bytes, "on any number of threads");
    let mut turned = GaussianCloud::new(map.sh_degree);
    (0..map.len()).rev().for_each(|i| turned.push(map.get(i)));
    assert!(write::encode(&turned, &cameras, &COMPACT).unwrap() == bytes);
}

#[test]
fn lies_are_refused() {
    let bytes = write::encode(&cloud(ShDegree::ALL[1], 100), &[], &COMPACT).unwrap();
    assert_eq!(read(&with(&bytes, |_| (), None)).unwrap(), read(&bytes).unwrap());
    let refusal = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
    let lie = |at: &str, value: serde_json::Value| {
        refusal(&with(&bytes, |meta| *meta.pointer_mut(at).expect("it is there") = value.clone(), None))
    };
    assert!(lie("/version", 3.into()).contains("SOG version 3 is not read"));
    assert!(lie("/version", serde_json::Value::Null).contains("SOG version 1 is not read"));
    assert!(lie("/count", u64::MAX.into()).contains("more than the file can hold"));
    assert!(lie("/count", (-1).into()).contains("meta.json"));
    assert!(lie("/count", 1000.into()).contains("too few for 1000"));
    assert!(lie("/scales/codebook/3", serde_json::Value::Null).contains("meta.json"), "NaN is null in JSON");
    assert!(lie("/sh0/codebook", vec![0.5].into()).contains("1 places, too few"));
    assert!(lie("/means/maxs/0", 1e300.into()).contains("is not finite"));
    assert!(lie("/means/files/0", "../../means_l.webp".into()).contains("../../means_l.webp"));
    assert!(lie("/shN/count", 3.into()).contains("beyond the palette's 3 entries"));
    assert!(lie("/shN/count", (1u64 << 40).into()).contains("larger than its labels reach"));
    assert!(lie("/shN/bands", 2.into()).contains("shN_centroids.webp"));
    assert!(lie("/shN/bands", 4.into()).contains("degree 4"));
    assert!(lie("/shN/files", vec!["a", "b", "c"].into()).contains("meta.json"));
    let swap = |name: &str, plane: Plane| refusal(&with(&bytes, |_| (), Some((name, plane))));
    assert!(swap("quats.webp", Plane::of(4, |_| [0; 4])).contains("too few for 100"));
    assert!(swap("quats.webp", Plane::of(100, |_| [0, 0, 0, 9])).contains("the rotation of Gaussian 0 is none"));
    assert!(swap("shN_centroids.webp", Plane { width: 64, height: 12, pixels: vec![[0, 0, 0, 255]; 768] }).contains("not 192"));
    assert!(refusal(b"PK\x03\x04").contains("no whole zip") && refusal(&[]).contains("no whole zip"));
    let mut tail = bytes.clone();
    tail.truncate(bytes.len() - 1);
    assert!(refusal(&tail).contains("x.sog"));
}

#[test]
fn an_empty_map_and_one_gaussian_are_files_too() {
    for degree in ShDegree::ALL {
        let empty = GaussianCloud::new(degree);
        assert!(read(&write::encode(&empty, &[], &COMPACT).unwrap()).unwrap().is_empty());
        assert_eq!(read(&write::encode(&cloud(degree, 1), &[], &COMPACT).unwrap()).unwrap().len(), 1);
    }
    let mut map = cloud(ShDegree::default(), 3);
    map.means[1].y = f32::NAN;
    assert!(matches!(write::encode(&map, &[], &COMPACT), Err(ExportError::NonFinite { index: 1 })));
}
