//! Finished runs refined further, whole and in cells: interrupted, with holes, merged.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::OnceLock;
use std::time::Duration;

use keysplat::export::MapFormat;
use keysplat::splat::GaussianCloud;

use crate::common::recording::{Finished, finish, keysplat, metrics, recording, run_command, scratch, skipped_without_adapter};

/// A finished run of the recording; tests only read it.
fn finished_run() -> &'static Path {
    static RUN: OnceLock<PathBuf> = OnceLock::new();
    RUN.get_or_init(|| {
        let out = scratch().join("run");
        finish(run_command(recording(), &out, &["--set", "mapping.refine.final_epochs=2"])).succeeded();
        out
    })
}

fn split(run: &Path, plan: &Path) -> Finished {
    let mut command = keysplat(["split", run.to_str().unwrap(), "--max-gaussians", "3000", "--halo", "0.5", "--out"]);
    command.arg(plan).args(["--", "--set", "mapping.refine.final_epochs=6", "--set", "mapping.refine.density_every=50"]);
    command.args(["--checkpoint-every", "1"]);
    finish(command)
}

fn jobs(what: &str, plan: &Path, more: &[&str]) -> Finished {
    let mut command = keysplat(["jobs", what]);
    command.arg(plan).args(more);
    finish(command)
}

fn map(folder: &Path) -> GaussianCloud {
    MapFormat::of_path(&folder.join("map.ply")).unwrap().read(&folder.join("map.ply")).unwrap()
}

fn digest(plan: &Path) -> serde_json::Value {
    let merge = std::fs::read_to_string(plan.join("merge.json")).unwrap();
    serde_json::from_str::<serde_json::Value>(&merge).unwrap()["digest"].clone()
}

#[test]
fn cells_make_the_same_map_whatever_happens_and_a_hole_keeps_the_run() {
    if skipped_without_adapter() {
        return;
    }
    let (plan, killed) = (scratch().join("plan"), scratch().join("killed-plan"));
    let planned = split(finished_run(), &plan).succeeded().stdout;
    let tasks: usize = planned.split(' ').next().unwrap().parse().unwrap();
    assert!((2..20).contains(&tasks), "{planned}");
    let merged = jobs("submit", &plan, &["--local", "2"]).succeeded().stdout;
    assert!(merged.contains("Gaussians before"), "{merged}");

    split(finished_run(), &killed).succeeded();
    let checkpoint = killed.join("tasks/0000/working/checkpoint.bin");
    let mut command = keysplat(["jobs", "run", killed.to_str().unwrap(), "--task", "0"]);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    while !checkpoint.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    assert_eq!(child.wait().unwrap().code(), None, "it ended before it was killed");
    jobs("submit", &killed, &["--local", "1"]).succeeded();
    let maps = [&plan, &killed].map(|plan| std::fs::read(plan.join("merged/map.ply")).unwrap());
    assert!(maps[0] == maps[1] && digest(&plan) == digest(&killed));

    // The merged folder is that of a run.
    let merged = plan.join("merged");
    finish(keysplat(["eval", merged.to_str().unwrap()])).succeeded();
    let psnr = |folder: &Path| metrics(folder).images.held_out.unwrap().psnr_db.unwrap();
    assert!(psnr(&merged) > psnr(finished_run()), "{} {}", psnr(&merged), psnr(finished_run()));

    let (whole, all) = (map(finished_run()), map(&merged));
    let core = map(&killed.join("tasks/0001/result"));
    std::fs::remove_dir_all(killed.join("tasks/0001")).unwrap();
    jobs("merge", &killed, &[]).refused(&["task 1 (x", "has no result"]);
    let with_hole = jobs("merge", &killed, &["--allow-holes"]);
    assert_eq!(with_hole.code, Some(3));
    let left = map(&killed.join("merged"));
    let kept = left.len() - (all.len() - core.len());
    let of_run = left.means.iter().filter(|mean| whole.means.contains(mean)).count();
    assert!(kept > 0 && of_run >= kept && left.means != all.means, "{kept} {of_run}");
}

#[test]
fn cells_are_not_merged_into_another_map() {
    if skipped_without_adapter() {
        return;
    }
    let (run, plan) = (scratch().join("mapped-again"), scratch().join("mapped-again-plan"));
    crate::common::recording::copy_folder(finished_run(), &run);
    split(&run, &plan).succeeded();
    jobs("run", &plan, &["--task", "0"]).succeeded();
    std::fs::copy(run.join("trajectory.txt"), run.join("keyframes.txt")).unwrap();
    jobs("merge", &plan, &["--allow-holes"]).refused(&["keyframes.txt", "is not what it was"]);
}

#[test]
fn what_cannot_be_refined_is_named() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("refused");
    let refine = |run: &Path, more: &[&str]| {
        let mut command = keysplat(["run", "--refine", run.to_str().unwrap(), "--out"]);
        command.arg(&out).args(more);
        finish(command)
    };
    let far = "refined.region={low=[90.0,90.0,90.0],high=[91.0,91.0,91.0],halo=0.5}";
    refine(finished_run(), &["--set", far]).refused(&["no keyframe of the run sees the region"]);
    let inverted = "refined.region={low=[1.0,1.0,1.0],high=[0.0,2.0,2.0],halo=0.5}";
    refine(finished_run(), &["--set", inverted]).refused(&["region.low must lie below region.high"]);
    refine(recording(), &[]).refused(&["cannot read the configuration", "config.toml"]);
    let damaged = scratch().join("damaged-run");
    crate::common::recording::copy_folder(finished_run(), &damaged);
    std::fs::write(damaged.join("keyframes.txt"), "no pose\n").unwrap();
    refine(&damaged, &[]).refused(&["cannot refine the run", "keyframes.txt"]);
    let mut command = keysplat(["run", "--refine", finished_run().to_str().unwrap(), "--out"]);
    command.arg(finished_run());
    finish(command).refused(&["would be replaced"]);
}
