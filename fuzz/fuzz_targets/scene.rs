//! Descriptions of synthetic scenes. What is accepted reads back as the same.
#![no_main]

use std::path::Path;

use keysplat::synthetic::SceneConfig;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(scene) = SceneConfig::parse(text, Path::new("file")) {
        let again = SceneConfig::parse(&scene.to_toml(), Path::new("again"));
        assert_eq!(again.expect("what was written is valid").to_toml(), scene.to_toml());
    }
});
