//! `keysplat check`: a sound recording passes, and each defect is named with what to do about it.

use std::path::Path;

use crate::common::recording::{
    Finished, change_line, color_file, copy_of_recording, finish, keysplat, recording, scratch, truncate,
};
use crate::common::requirements::recorded;

fn check(folder: &Path, more: &[&str]) -> Finished {
    let mut command = keysplat(["check".as_ref(), folder.as_os_str()]);
    command.args(more);
    finish(command)
}

/// Spoils a copy of the recording, and checks that a warning says `parts`.
fn warned(name: &str, spoil: impl FnOnce(&Path), parts: &[&str]) {
    let spoilt = copy_of_recording(name);
    spoil(&spoilt);
    let said = check(&spoilt, &[]).succeeded().stdout;
    let warned = said.lines().any(|line| line.starts_with("warning: ") && parts.iter().all(|part| line.contains(part)));
    assert!(warned, "no warning says {parts:?}:\n{said}");
}

#[test]
fn a_sound_recording_passes() {
    let said = check(recording(), &[]).succeeded().stdout;
    for part in [
        "(tum, rgbd)",
        "24 over 0.77 s, 30.0 Hz",
        "160x120",
        "5000 units a metre",
        "24 of the first 24 frames",
        "nothing looks wrong",
    ] {
        assert!(said.contains(part), "{part}:\n{said}");
    }
    let json =
        finish(keysplat(["--log".as_ref(), "json".as_ref(), "check".as_ref(), recording().as_os_str()])).succeeded().stdout;
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["findings"], serde_json::json!([]));
    assert!(json["facts"].as_array().unwrap().iter().any(|fact| fact["name"] == "depth"));
    let mono = check(recording(), &["--sensor", "mono"]).succeeded().stdout;
    assert!(mono.contains("(tum, mono)") && !mono.contains("units a metre"), "{mono}");
}

#[test]
fn defects_are_named() {
    let units = |factor: f64| {
        move |folder: &Path| {
            change_line(&folder.join("camera.txt"), 2, |line| {
                let mut fields: Vec<String> = line.split_whitespace().map(String::from).collect();
                fields[6] = (5000.0 * factor).to_string();
                fields.join(" ")
            });
        }
    };
    warned("small-units", units(0.02), &["median depth", "with 1000 units a metre"]);
    warned("large-units", units(100.0), &["median depth", "check the depth units"]);
    let focal = |folder: &Path| {
        change_line(&folder.join("camera.txt"), 2, |line| format!("1000 1000 {}", line.splitn(3, ' ').nth(2).unwrap()));
    };
    warned("long-lens", focal, &["field of view of 9°", "another image size"]);
    let gap = |folder: &Path| {
        for (list, number) in ["rgb.txt", "depth.txt"].iter().flat_map(|list| (14..=25).map(move |number| (list, number))) {
            change_line(&folder.join(list), number, |line| {
                let (time, file) = line.split_once(' ').unwrap();
                format!("{:.6} {file}", time.parse::<f64>().unwrap() + 2.0)
            });
        }
    };
    warned("gap", gap, &["1 gaps", "2.0 s before frame 12"]);
    warned("cut-images", |folder| truncate(&color_file(folder, 3), 40), &["1 of 24 frames cannot be read", "0.100000"]);
    let black = |folder: &Path| (5..9).for_each(|i| image::RgbImage::new(160, 120).save(color_file(folder, i)).unwrap());
    warned("black", black, &["4 of 24 frames are nearly black"]);
}

#[test]
fn what_makes_a_run_useless_fails_the_check() {
    let folder = copy_of_recording("no-depth");
    for entry in std::fs::read_dir(folder.join("depth")).unwrap() {
        let blank = image::ImageBuffer::<image::Luma<u16>, _>::new(160, 120);
        blank.save(entry.unwrap().path()).unwrap();
    }
    let found = check(&folder, &[]);
    found.refused(&["a run useless"]);
    assert!(
        found.stdout.contains("problem: no depth image has a measurement") && found.stdout.contains("--sensor mono"),
        "{}",
        found.stdout
    );
    check(&folder, &["--sensor", "mono"]).succeeded();
}

#[test]
fn a_folder_with_depth_and_a_found_camera_is_a_recording() {
    let Some(kitchen) = recorded("redkitchen") else { return };
    let folder = scratch().join("uncalibrated");
    for kind in ["rgb", "depth"] {
        let mut files: Vec<_> = std::fs::read_dir(kitchen.join(kind)).unwrap().map(|file| file.unwrap().path()).collect();
        files.sort();
        std::fs::create_dir_all(folder.join(kind)).unwrap();
        for file in &files[..150] {
            std::fs::copy(file, folder.join(kind).join(file.file_name().unwrap())).unwrap();
        }
    }
    let camera = folder.join("camera.toml");
    let mut command = keysplat(["calibrate"]);
    command.arg(&folder).args(["--layout", "images", "--out"]).arg(&camera);
    let said = finish(command).succeeded();
    assert!(said.stderr.contains("millimetres"), "{}", said.stderr);
    let checked = check(&folder, &[]).succeeded().stdout;
    assert!(checked.contains("(images, rgbd)") && checked.contains("1000 units a metre"), "{checked}");
}
