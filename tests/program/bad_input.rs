//! What users get wrong: every mistake ends in an error that names the place and says what to do, and never in a panic.

use std::path::{Path, PathBuf};

use crate::common::recording::{
    FRAMES, HEIGHT, WIDTH, change_line, color_file, copy_of_recording, finish, finish_child, keysplat, recording, run_command,
    scene, scratch, skipped_without_adapter, stamps, truncate,
};
use crate::common::requirements::skip;

/// Spoils a copy of the recording, runs it, and checks that the error says `parts` and that no output was begun.
fn refused(name: &str, spoil: impl FnOnce(&Path), more: &[&str], parts: &[&str]) {
    let spoilt = copy_of_recording(name);
    spoil(&spoilt);
    let out = scratch().join(format!("{name}-out"));
    finish(run_command(&spoilt, &out, more)).refused(parts);
    assert!(!out.exists(), "{} was made for nothing", out.display());
}

fn remove(folder: &Path, name: &str) {
    std::fs::remove_file(folder.join(name)).unwrap();
}

/// A path with a line number, as errors name it.
fn at_line(name: &str, file: &str, line: usize) -> String {
    format!("{}:{line}: ", scratch().join(name).join(file).display())
}

fn write(name: &str, text: &str) -> PathBuf {
    let path = scratch().join(name);
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn folders_that_are_no_recordings() {
    let missing = scratch().join("missing");
    finish(run_command(&missing, &scratch().join("out"), &[])).refused(&[missing.to_str().unwrap(), "give the folder"]);
    let file = recording().join("rgb.txt");
    finish(run_command(&file, &scratch().join("out"), &[])).refused(&[file.to_str().unwrap(), "give the folder"]);
    let spoil = |folder: &Path| remove(folder, "rgb.txt");
    refused("no-layout", spoil, &[], &["no-layout is no recording", "rgb.txt", "--layout"]);
    finish(keysplat([Path::new("run"), Path::new("--out"), &scratch()]))
        .refused(&["which recording?", "keysplat run <SEQUENCE>"]);
}

#[test]
fn damaged_lists() {
    let empty = |folder: &Path| std::fs::write(folder.join("rgb.txt"), "# nothing\n").unwrap();
    refused("empty-list", empty, &[], &["empty-list/rgb.txt lists no frames", "copied whole"]);

    for list in ["rgb", "depth", "groundtruth"] {
        let (name, file) = (format!("unsorted-{list}"), format!("{list}.txt"));
        let back = |line: &str| format!("0.05 {}", line.split_once(' ').unwrap().1);
        let unsorted = |folder: &Path| change_line(&folder.join(&file), 7, back);
        refused(&name, unsorted, &[], &[&at_line(&name, &file, 7), "not after the one before it; sort the"]);
    }

    let nan = |folder: &Path| {
        change_line(&folder.join("groundtruth.txt"), 5, |line| {
            let mut fields: Vec<&str> = line.split(' ').collect();
            fields[2] = "NaN";
            fields.join(" ")
        });
    };
    refused("nan", nan, &[], &[&at_line("nan", "groundtruth.txt", 5), "`NaN` is not finite", "expected `timestamp tx"]);

    let gone = |folder: &Path| std::fs::remove_file(color_file(folder, 3)).unwrap();
    refused("gone", gone, &[], &[&at_line("gone", "rgb.txt", 5), "0.100000.png", "copied whole"]);

    let camera = |folder: &Path| remove(folder, "camera.txt");
    refused("no-camera", camera, &[], &["no-camera: no camera.txt", "--camera"]);
}

#[test]
fn images_of_another_size() {
    let small = |folder: &Path| {
        for entry in std::fs::read_dir(folder.join("depth")).unwrap() {
            let depth = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_pixel(80, 60, image::Luma([9000]));
            depth.save(entry.unwrap().path()).unwrap();
        }
    };
    let camera = format!("is 80x60, but the camera is {WIDTH}x{HEIGHT}");
    refused("small-depth", small, &[], &["small-depth/depth/0.000000.png", &camera, "must agree"]);
    let tiny = ["--map-scale", "0.05"];
    refused("tiny-map", |_| {}, &tiny, &["mapped at 8x6", "raise the mapping resolution (--map-scale)"]);
}

#[test]
fn a_recording_that_does_not_begin_with_depth() {
    let parts = |name: &str| format!("{name}/rgb/0.000000.png, has no depth image");
    let advice = "begin at a frame that has one with --frames";
    // Without any depth it is a mono recording, and too short a one.
    if !skipped_without_adapter() {
        let folder = copy_of_recording("no-depth");
        remove(&folder, "depth.txt");
        finish(run_command(&folder, &scratch().join("no-depth-out"), &[])).refused(&["was replayed as mono", "depth.txt"]);
    }
    let late = |folder: &Path| change_line(&folder.join("depth.txt"), 2, |_| String::new());
    refused("late-depth", late, &[], &[&parts("late-depth"), advice]);
    if !skipped_without_adapter() {
        // The advice is good.
        let out = scratch().join("late-depth-out");
        finish(run_command(&scratch().join("late-depth"), &out, &["--frames", "1.."])).succeeded();
        assert_eq!(stamps(&out.join("trajectory.txt")).len(), FRAMES - 1);
    }
}

#[test]
fn images_that_cannot_be_read() {
    if skipped_without_adapter() {
        return;
    }
    // The first one alone is skipped like any other.
    let first = copy_of_recording("first-unreadable");
    truncate(&color_file(&first, 0), 40);
    let out = scratch().join("unreadable-out");
    let said = finish(run_command(&first, &out, &[])).succeeded();
    assert!(said.stderr.contains(color_file(&first, 0).to_str().unwrap()), "{}", said.stderr);
    let trajectory = std::fs::read(out.join("trajectory.txt")).unwrap();
    // Without any there is nothing to write, and an earlier run's results stay.
    let all = copy_of_recording("all-unreadable");
    (0..FRAMES).for_each(|frame| truncate(&color_file(&all, frame), 300));
    let said = finish(run_command(&all, &out, &[]));
    said.refused(&["not one of the 24 frames could be read", color_file(&all, 0).to_str().unwrap(), "copied whole"]);
    assert_eq!(std::fs::read(out.join("trajectory.txt")).unwrap(), trajectory);
}

#[test]
fn images_that_show_nothing() {
    if skipped_without_adapter() {
        return;
    }
    let black = copy_of_recording("black");
    (0..FRAMES).for_each(|frame| image::RgbImage::new(WIDTH, HEIGHT).save(color_file(&black, frame)).unwrap());
    let said = finish(run_command(&black, &scratch().join("black-out"), &[]));
    said.refused(&["not one frame could be tracked", "texture"]);
}

#[test]
fn configurations() {
    let run = |config: &Path| {
        let mut command = keysplat(["run"]);
        command.arg(recording()).arg("--out").arg(scratch().join("never")).arg("--config").arg(config);
        finish(command)
    };
    let config = write("unknown-key.toml", "map_scale = 0.5\n[mapping]\niteratons_per_keyframe = 3\n");
    run(&config).refused(&[config.to_str().unwrap(), "line 3", "iteratons_per_keyframe", "iterations_per_keyframe"]);
    let config = write("wrong-type.toml", "map_scale = \"half\"\n");
    run(&config).refused(&[config.to_str().unwrap(), "line 1", "map_scale"]);
    for (text, part) in [
        ("map_scale = nan\n", "map_scale must be above 0 and at most 1, not NaN"),
        ("[replay]\nevery = 0\n", "replay.every must be at least 1"),
        ("[tracking]\nfeatures = 0\n", "tracking.features is 0; it must be from 100"),
        ("[mapping.insertion]\nopacity = 1.5\n", "mapping.insertion.opacity must lie between 0 and 1, not 1.5"),
    ] {
        let config = write("out-of-range.toml", text);
        run(&config).refused(&[&format!("{}: ", config.display()), part]);
    }
    let missing = scratch().join("missing.toml");
    run(&missing).refused(&[&format!("cannot read the configuration {}", missing.display())]);
    assert!(!scratch().join("never").exists());
}

#[test]
fn options() {
    let run = |more: &[&str]| finish(run_command(recording(), &scratch().join("never-either"), more));
    for range in ["9..3", "5", "a..b", "3..3"] {
        run(&["--frames", range]).refused(&[range, "--frames", "write A..B"]);
    }
    run(&["--frames", "30..40"]).refused(&["frames 30..40", "outside the sequence of 24 frames", "--frames A..B within 0..24"]);
    run(&["--every", "0"]).refused(&["replay.every must be at least 1"]);
    run(&["--map-scale", "1.5"]).refused(&["map_scale must be above 0 and at most 1, not 1.5"]);
    run(&["--camera", "nosuch"]).refused(&["no camera is called `nosuch`", "tum-fr1"]);
    assert!(!scratch().join("never-either").exists());
    let calibrated = scratch().join("calibrated");
    std::fs::create_dir_all(calibrated.join("image_0")).unwrap();
    std::fs::write(calibrated.join("calib.txt"), "").unwrap();
    finish(run_command(&calibrated, &scratch().join("never-either"), &["--camera", "tum-fr1"]))
        .refused(&["the layout kitti have their own calibration", "leave --camera out"]);
}

#[test]
fn adapters_that_are_not_there() {
    let out = scratch().join("no-adapter");
    if !skipped_without_adapter() {
        let said = finish(run_command(recording(), &out, &["--adapter", "nosuch"]));
        said.refused(&["no adapter's name contains `nosuch`; there are: "]);
    }
    if cfg!(target_os = "linux") {
        let without_drivers = |mut command: std::process::Command| {
            command.env("VK_DRIVER_FILES", "/nonexistent").env("VK_ICD_FILENAMES", "/nonexistent");
            finish(command)
        };
        let advice = "install a Vulkan driver";
        without_drivers(run_command(recording(), &out, &[])).refused(&["no GPU adapter was found", advice, "keysplat adapters"]);
        assert!(without_drivers(keysplat(["adapters"])).succeeded().stdout.contains(advice));
    }
    assert!(!out.exists());
}

#[test]
fn output_folders_that_cannot_be() {
    if skipped_without_adapter() {
        return;
    }
    // A path below a file; whoever runs the tests may write anywhere else.
    let out = write("a-file", "").join("out");
    finish(run_command(recording(), &out, &[])).refused(&[&format!("output folder {}: ", out.display()), "--out"]);
}

#[test]
fn scenes() {
    let generate = |text: &str| {
        let scene = write("scene.toml", text);
        let out = scratch().join("never-rendered");
        let finished = finish(keysplat([Path::new("generate"), &scene, Path::new("--out"), &out]));
        assert!(!out.exists());
        finished
    };
    let file = scratch().join("scene.toml");
    generate("seed = 1\n[camera]\nwitdh = 640\n").refused(&[file.to_str().unwrap(), "line 3", "witdh", "width"]);
    generate("fps = nan\n").refused(&[&format!("{}: `fps` is NaN", file.display()), "between 1 and 1000"]);
    generate("[furniture]\npictures = 401\n").refused(&["furniture", "between 0 and 400"]);
    let scene = write("good-scene.toml", &scene().to_toml());
    let again = finish(keysplat([Path::new("generate"), &scene, Path::new("--out"), recording()]));
    again.refused(&[recording().to_str().unwrap(), "is there already; remove it or write elsewhere"]);
}

#[test]
fn folders_to_evaluate() {
    let eval = |dir: &Path, more: &[&str]| {
        let mut command = keysplat(["eval"]);
        command.arg(dir).args(more);
        finish(command)
    };
    let with_sequence = ["--sequence", recording().to_str().unwrap()];
    let dir = scratch().join("to-evaluate");
    let trajectory = dir.join("trajectory.txt");
    let nothing = ["there is no file", trajectory.to_str().unwrap(), "give a run's folder"];
    eval(&dir, &with_sequence).refused(&nothing);
    std::fs::create_dir_all(&dir).unwrap();
    eval(&dir, &[]).refused(&nothing);
    std::fs::write(&trajectory, "0.0 0 0 0 0 0 0 1\n0.033333 0 0 0 0 0 0\n").unwrap();
    eval(&dir, &with_sequence).refused(&["there is no file", dir.join("map.ply").to_str().unwrap()]);
    std::fs::write(dir.join("map.ply"), "ply\nformat ascii 1.0\n").unwrap();
    eval(&dir, &[]).refused(&["no config.toml that names its recording", "--sequence"]);
    eval(&dir, &with_sequence).refused(&[&format!("{}:2: fewer than 8 numbers", trajectory.display())]);
    std::fs::write(&trajectory, "100.0 0 0 0 0 0 0 1\n").unwrap();
    eval(&dir, &with_sequence).refused(&[dir.join("map.ply").to_str().unwrap(), "3DGS PLY"]);
    let empty = keysplat::splat::GaussianCloud::new(Default::default());
    keysplat::export::MapFormat::default().write(&empty, &dir.join("map.ply")).unwrap();
    eval(&dir, &with_sequence).refused(&["no pose of", trajectory.to_str().unwrap(), "within 0.02 s", "--sequence"]);
    std::fs::write(dir.join("metrics.json"), "{}").unwrap();
    eval(&dir, &with_sequence).refused(&[dir.join("metrics.json").to_str().unwrap(), "move it away"]);
}

/// A small disk of its own, taken away again when the test ends.
#[cfg(target_os = "linux")]
pub(crate) struct SmallDisk(pub(crate) tempfile::TempDir);

#[cfg(target_os = "linux")]
impl SmallDisk {
    /// `None` where mounting is not allowed.
    pub(crate) fn mount(size: &str) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let options = ["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"];
        let mounted = std::process::Command::new("mount").args(options).arg(folder.path()).output();
        mounted.is_ok_and(|output| output.status.success()).then(|| Self(folder))
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg(self.0.path()).status();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk() {
    if skipped_without_adapter() {
        return;
    }
    let Some(disk) = SmallDisk::mount("256k") else {
        skip("root", "mounting a small disk takes the rights of root");
        return;
    };
    let out = disk.0.path().join("out");
    let map = format!("cannot write {}: ", out.join("map.ply").display());
    finish(run_command(recording(), &out, &[])).refused(&[&map, "free some space or write to another disk"]);
    // What is small and dear was written first, and nothing half.
    assert_eq!(stamps(&out.join("trajectory.txt")).len(), FRAMES);
    let mut left: Vec<_> = std::fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    let expected = [".lock", "config.toml", "exposures.json", "history.json", "keyframes.txt", "trajectory.txt", "views"];
    assert_eq!(left, expected);

    let scene = write("scene-for-the-disk.toml", &scene().to_toml());
    let target = disk.0.path().join("recording");
    let generated = finish(keysplat([Path::new("generate"), &scene, Path::new("--out"), &target]));
    generated.refused(&["cannot write", disk.0.path().to_str().unwrap(), "has space"]);
    assert_eq!(std::fs::read_dir(disk.0.path()).unwrap().count(), 1, "only the run's folder is left");
}

/// The disk fills up while the map grows: the run goes on and warns once, and goes on from the last checkpoint when there is space.
#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_up_between_checkpoints() {
    use std::fs::File;
    use std::io::Write;
    use std::time::Duration;

    if skipped_without_adapter() {
        return;
    }
    let Some(disk) = SmallDisk::mount("64m") else {
        skip("root", "mounting a small disk takes the rights of root");
        return;
    };
    let more = ["--set", "tracking.keyframe_translation=0.02", "--set", "mapping.iterations_per_keyframe=10"];
    let (whole, out) = (scratch().join("never-full"), disk.0.path().join("out"));
    finish(run_command(recording(), &whole, &more)).succeeded();
    let child = run_command(recording(), &out, &[&more[..], &["--checkpoint-every", "1"]].concat()).spawn().unwrap();
    let (checkpoint, filler) = (out.join("checkpoint.bin"), disk.0.path().join("filler"));
    // The first one has no map yet.
    while std::fs::metadata(&checkpoint).map_or(0, |file| file.len()) < 100_000 {
        std::thread::sleep(Duration::from_millis(1));
    }
    // What the run frees meanwhile is filled as well.
    let said = std::thread::scope(|scope| {
        let run = scope.spawn(|| finish_child(child, String::new()));
        let mut filler = File::create(&filler).unwrap();
        while !run.is_finished() {
            while filler.write_all(&[0; 4096]).is_ok() {}
            std::thread::sleep(Duration::from_millis(1));
        }
        run.join().unwrap()
    });
    said.refused(&["cannot write", "free some space or write to another disk"]);
    let warnings = said.stderr.lines().filter(|line| line.contains("the run goes on"));
    assert!(warnings.clone().count() == 1 && warnings.clone().all(|line| line.contains("checkpoint.bin")), "{}", said.stderr);
    std::fs::remove_file(&filler).unwrap();
    finish(keysplat([Path::new("resume"), &out])).succeeded();
    for file in ["trajectory.txt", "map.ply"] {
        assert!(std::fs::read(out.join(file)).unwrap() == std::fs::read(whole.join(file)).unwrap(), "{file} differs");
    }
    assert!(!checkpoint.exists());
}
