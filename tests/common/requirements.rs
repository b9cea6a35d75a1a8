//! What tests need beyond the repository: an adapter, recordings, rights, a browser. A test without it is skipped and counted; with
//! `KEYSPLAT_REQUIRE` naming the need, it fails.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use keysplat::gpu::Gpu;

/// Needs by the names that `KEYSPLAT_REQUIRE` lists, separated by commas.
const NEEDS: [&str; 4] = ["adapter", "data", "root", "browser"];
/// The environment variable with the folder of the recordings.
const DATA: &str = "KEYSPLAT_DATA";
/// One line for each skipped test, which `scripts/test.sh` counts.
const SKIPPED: &str = "skipped.txt";

/// Skips the calling test for lack of `need`.
///
/// # Panics
/// If `KEYSPLAT_REQUIRE` lists the need, or a name that is none.
pub fn skip(need: &str, reason: &str) {
    let required = std::env::var("KEYSPLAT_REQUIRE").unwrap_or_default();
    let required: Vec<&str> = required.split(',').map(str::trim).filter(|name| !name.is_empty()).collect();
    let unknown = required.iter().find(|name| !NEEDS.contains(name));
    assert!(unknown.is_none(), "KEYSPLAT_REQUIRE lists {unknown:?}; it may list {NEEDS:?}");
    assert!(NEEDS.contains(&need), "`{need}` is no need");
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    assert!(!required.contains(&need), "{test} needs `{need}`, which KEYSPLAT_REQUIRE lists: {reason}");
    eprintln!("SKIPPED {test}: {reason}");
    // Tests of one binary run side by side; a write of one line is not torn apart.
    static LIST: Mutex<()> = Mutex::new(());
    let _one_at_a_time = LIST.lock();
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(SKIPPED);
    let mut list = File::options().append(true).create(true).open(path).expect("the build folder can be written to");
    writeln!(list, "{need}\t{test}\t{reason}").expect("the build folder can be written to");
}

/// The fastest adapter, or the test is skipped.
pub fn adapter() -> Option<Arc<Gpu>> {
    Gpu::open(None).inspect_err(|error| skip("adapter", &error.to_string())).ok()
}

/// The folder of a real recording, or the test is skipped.
pub fn recorded(name: &str) -> Option<PathBuf> {
    let folder = std::env::var_os(DATA).map(|data| Path::new(&data).join(name)).filter(|folder| folder.exists());
    if folder.is_none() {
        skip("data", &format!("set {DATA} to the folder that holds {name}/"));
    }
    folder
}
