//! Files of all dataset layouts, see `Layout::parse_files`.
#![no_main]

use keysplat::sequence::Layout;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| Layout::all().iter().for_each(|layout| drop(layout.parse_files(bytes))));
