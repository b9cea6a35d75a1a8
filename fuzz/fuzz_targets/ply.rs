//! Maps as 3DGS PLY. What is read is finite; written and read again it is the same file.
#![no_main]

use std::path::Path;

use keysplat::export::ply;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(cloud) = ply::read_from(bytes, bytes.len() as u64, Path::new("file")) {
        let once = ply::encode(&cloud).expect("what was read is finite");
        let again = ply::read_from(once.as_slice(), once.len() as u64, Path::new("again")).expect("what was written is valid");
        assert_eq!(ply::encode(&again).expect("it is finite"), once);
    }
});
