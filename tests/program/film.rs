//! `keysplat render`: moving pictures of a run's map.

use std::fs::File;

use crate::common::recording::{finish, keysplat, recording, run_command, scratch, skipped_without_adapter};

#[test]
fn every_path_becomes_a_moving_picture() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("run");
    finish(run_command(recording(), &out, &[])).succeeded();
    let render = |path: &str, name: &str, more: &[&str]| {
        let file = scratch().join(name);
        let mut command = keysplat(["render".as_ref(), out.as_os_str(), "--out".as_ref(), file.as_os_str()]);
        command.args(["--path", path]).args(more);
        (finish(command), file)
    };
    let (said, file) = render("orbit", "orbit.gif", &["--seconds", "1", "--fps", "6", "--size", "121x80"]);
    assert_eq!(said.succeeded().stdout.trim(), file.to_str().unwrap());
    let mut decoder = gif::DecodeOptions::new().read_info(File::open(&file).unwrap()).unwrap();
    assert_eq!((decoder.width(), decoder.height()), (120, 80), "sides are even");
    let mut frames = 0;
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        frames += 1;
        assert_eq!(frame.delay, 17);
    }
    assert_eq!(frames, 6);
    render("keyframes", "k.png", &["--seconds", "0.1"]).0.succeeded();
    let picture = image::open(scratch().join("k-0003.png")).unwrap().to_rgb8();
    assert!(picture.pixels().filter(|p| p.0.iter().any(|v| *v > 30)).count() > 1000, "it shows the room");
    assert!(!scratch().join("k-0004.png").exists());
    let (said, file) = render("trajectory", "t.mp4", &["--seconds", "0.5"]);
    said.succeeded();
    assert_eq!(&std::fs::read(&file).unwrap()[4..8], b"ftyp");
    assert!(!scratch().join(".partial-t.mp4").exists());
    render("orbit", "x.avi", &[]).0.refused(&["x.avi", ".mp4, .gif or .png"]);
    render("orbit", "x.gif", &["--seconds", "0"]).0.refused(&["0 seconds"]);
    render("orbit", "nowhere/x.mp4", &["--seconds", "0.1"]).0.refused(&["nowhere/x.mp4"]);
    std::fs::remove_file(out.join("map.ply")).unwrap();
    render("orbit", "x.gif", &[]).0.refused(&["has no map"]);
}
