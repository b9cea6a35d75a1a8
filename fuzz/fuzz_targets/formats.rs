//! Maps in all file formats. A map that was read is finite; written and read again it is the same file, where the
//! format is lossless.
#![no_main]

use keysplat::export::MapFormat;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for format in MapFormat::all() {
        if let Ok(cloud) = format.decode(bytes)
            && format.is_written()
        {
            let once = format.encode(&cloud).expect("a map that was read is finite");
            let again = format.decode(&once).expect("a map that was written is valid");
            if format.is_lossless() {
                assert_eq!(format.encode(&again).expect("it is finite"), once);
            }
        }
    }
});
