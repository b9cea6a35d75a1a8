//! Files of the layout, see `Layout::parse_files`.
#![no_main]

use keysplat::sequence::Layout;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| drop(Layout::Euroc.parse_files(bytes)));
