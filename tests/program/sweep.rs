//! Sweeps as the program makes them: tables and curves, going on where one was interrupted, and one sweep against another.

use crate::common::recording::{Finished, copy_of_recording, finish, keysplat, recording, scratch, skipped_without_adapter};
use keysplat::config::Config;
use keysplat::mapping::MappingConfig;
use std::path::Path;

fn sweep(out: &Path, points: &[&str]) -> Finished {
    let mut command = keysplat(["bench", "sweep", recording().to_str().unwrap(), "--out"]);
    command.arg(out).args(points).args(["--", "--set", "mapping.window.recent=3"]);
    finish(command)
}

fn compare(before: &Path, after: &Path) -> Finished {
    finish(keysplat(["bench".as_ref(), "compare".as_ref(), before.as_os_str(), after.as_os_str(), "--fail".as_ref()]))
}

#[test]
fn a_sweep_is_made_once_and_compared() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("sweep");
    let points = ["--epochs", "1,3", "--seeds", "0,1"];
    let table = sweep(&out, &points).succeeded().stdout;
    assert_eq!(table.lines().filter(|line| line.starts_with("| recording |")).count(), 2, "{table}");
    let csv = std::fs::read_to_string(out.join("sweep.csv")).unwrap();
    assert_eq!(csv.lines().count(), 5, "{csv}");
    assert!(csv.contains("\"recording\",\"3 epochs\",1,24,24,"), "{csv}");
    let svg = std::fs::read_to_string(out.join("curves.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("held-out PSNR, dB"));

    // One run is gone: it alone is made again.
    let runs = out.join("runs/recording");
    let made = |name: &str| std::fs::metadata(runs.join(name).join("map.ply")).unwrap().modified().unwrap();
    let (kept, lost) = (made("1-epochs-0"), made("3-epochs-1"));
    std::fs::remove_file(runs.join("3-epochs-1/metrics.json")).unwrap();
    sweep(&out, &points).succeeded();
    assert_eq!(made("1-epochs-0"), kept);
    assert!(made("3-epochs-1") > lost);

    let same = compare(&out, &out).succeeded().stdout;
    assert!(!same.contains("worse") && !same.contains("better"), "{same}");
    let worse = scratch().join("worse");
    std::fs::create_dir_all(&worse).unwrap();
    let json = std::fs::read_to_string(out.join("sweep.json")).unwrap();
    let mut sweep: serde_json::Value = serde_json::from_str(&json).unwrap();
    for row in sweep["rows"].as_array_mut().unwrap() {
        row["psnr_db"] = (row["psnr_db"].as_f64().unwrap() - 8.0).into();
    }
    std::fs::write(worse.join("sweep.json"), sweep.to_string()).unwrap();
    compare(&out, &worse).refused(&["2 figures got worse beyond the spread"]);
    compare(&worse, &out).succeeded();
}

#[test]
fn presets_are_swept_with_their_own_epochs_or_with_all() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("presets");
    let csv_of = |points: &[&str]| {
        sweep(&out, points).succeeded();
        std::fs::read_to_string(out.join("sweep.csv")).unwrap()
    };
    let own = csv_of(&["--presets", "balanced,quality"]);
    assert!(own.contains("\"recording\",\"balanced\",0,24,24,") && own.contains("\"quality\",0,"), "{own}");
    let settings = |run: &str| Config::read(&out.join("runs/recording").join(run).join("config.toml")).unwrap().mapping;
    let (usual, quality) = (MappingConfig::default(), settings("quality-0"));
    assert_eq!(settings("balanced-0").refine.final_epochs, usual.refine.final_epochs);
    assert!(quality.refine.final_epochs > usual.refine.final_epochs);
    let all = csv_of(&["--presets", "quality", "--epochs", "1,2"]);
    assert!(all.lines().count() == 3 && all.contains("\"quality, 1 epochs\""), "{all}");
    let few = settings("quality--2-epochs-0");
    assert_eq!((few.refine.final_epochs, few.insertion.detail), (2, quality.insertion.detail));
}

#[test]
fn a_recording_is_replayed_from_several_starts_in_both_directions() {
    let out = scratch().join("track");
    let replayed = || {
        let mut command = keysplat(["bench", "track", recording().to_str().unwrap(), "--starts", "2", "--every", "1"]);
        command.args(["--missing", "0,20", "--variant", "usual:", "--variant", "few: tracking.features=500", "--out"]).arg(&out);
        finish(command).succeeded().stdout
    };
    let table = replayed();
    assert!(table.contains("| recording | usual | 8 |") && table.contains("| recording | few | 8 |"), "{table}");
    // Without the two times, which are the only figures that may differ.
    let figures = || {
        let csv = std::fs::read_to_string(out.join("track.csv")).unwrap();
        csv.lines().map(|line| line.rsplitn(3, ',').last().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let first = figures();
    assert_eq!(first.len(), 17);
    let all_frames = first.iter().filter(|line| line.contains(",0,false,1,0,24,")).count();
    let backwards = first.iter().filter(|line| line.contains(",true,1,20,")).count();
    assert_eq!((all_frames, backwards), (2, 4), "{first:?}");
    replayed();
    assert_eq!(figures(), first);
    assert!(std::fs::read_to_string(out.join("track.svg")).unwrap().contains("share of replays"));
}

#[test]
fn what_cannot_be_swept_or_compared_is_said() {
    let out = scratch().join("nothing");
    let wrong = keysplat(["bench".as_ref(), "sweep".as_ref(), "no-such-room".as_ref(), "--out".as_ref(), out.as_os_str()]);
    finish(wrong).refused(&["no-such-room", "room-clean"]);
    let without_truth = copy_of_recording("without-truth");
    std::fs::remove_file(without_truth.join("groundtruth.txt")).unwrap();
    let mut wrong = keysplat(["bench", "track", without_truth.to_str().unwrap(), "--out"]);
    wrong.arg(&out);
    finish(wrong).refused(&["without-truth", "no ground truth"]);
    let mut wrong = keysplat(["bench", "track", "--out"]);
    wrong.arg(&out);
    finish(wrong).refused(&["give recordings, or --rooms"]);
    compare(&out, &out).refused(&["sweep.json", "give a sweep's folder"]);
}
