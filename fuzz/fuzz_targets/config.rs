//! Configurations. What is accepted reads back as the same.
#![no_main]

use std::path::Path;

use keysplat::config::Config;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    for known_poses in [false, true] {
        if let Ok(config) = Config::parse(text, Path::new("file"), known_poses) {
            let again = Config::parse(&config.to_toml(), Path::new("again"), known_poses);
            assert_eq!(again.expect("what was written is valid").to_toml(), config.to_toml());
        }
    }
});
