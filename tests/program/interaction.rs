//! How the program talks and listens: standard output, standard error, Ctrl-C.

use crate::common::recording::{FRAMES, finish, keysplat, metrics, recording, run_command, scratch, skipped_without_adapter};
use keysplat::evaluation::Metrics;
use serde_json::Value;

/// Every line of standard error, each a JSON object.
fn json_lines(stderr: &str) -> Vec<Value> {
    let parse = |line: &str| serde_json::from_str::<Value>(line).unwrap_or_else(|e| panic!("{e}: {line}"));
    stderr.lines().map(parse).inspect(|value| assert!(value.is_object())).collect()
}

#[test]
fn a_json_log_is_json_and_nothing_else() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("json");
    let said = finish(run_command(recording(), &out, &["--log", "json"])).succeeded();
    let lines = json_lines(&said.stderr);
    assert!(lines.iter().any(|line| line["fields"]["frames"] == FRAMES && line["level"] == "INFO"), "{lines:?}");
    assert_eq!(serde_json::from_str::<Metrics>(&said.stdout).unwrap(), metrics(&out));
}

#[test]
fn an_error_is_json_too_where_the_log_is() {
    for quiet in [&["--log=json"][..], &["--log=json", "-q"]] {
        let said = finish(run_command(&scratch().join("nowhere"), &scratch().join("out"), quiet));
        said.refused(&["nowhere"]);
        let lines = json_lines(&said.stderr);
        assert!(lines.len() == 1 && lines[0]["level"] == "ERROR", "{lines:?}");
        assert!(lines[0]["fields"]["message"].as_str().unwrap().starts_with("there is no folder"));
        assert_eq!(said.stdout, "");
    }
}

#[test]
fn a_quiet_run_says_nothing() {
    if skipped_without_adapter() {
        return;
    }
    let said = finish(run_command(recording(), &scratch().join("quiet"), &["--quiet"])).succeeded();
    assert_eq!((said.stdout.as_str(), said.stderr.as_str()), ("", ""));
}

#[test]
fn a_table_is_printed_without_colours_where_no_terminal_is() {
    if skipped_without_adapter() {
        return;
    }
    let out = scratch().join("text");
    let said = finish(run_command(recording(), &out, &[])).succeeded();
    assert_eq!(said.stdout, metrics(&out).to_string());
    assert!(!said.stderr.contains('\x1b') && !said.stdout.contains('\x1b'), "{said:?}");
}

#[cfg(unix)]
#[test]
fn a_reader_that_goes_away_is_no_error() {
    // The pipe's reading end is closed before anything can be written.
    let mut child = keysplat(["adapters"]).spawn().unwrap();
    drop(child.stdout.take());
    let said = crate::common::recording::finish_child(child, String::new()).succeeded();
    assert!(!said.stderr.contains("panicked"), "{}", said.stderr);
}

#[cfg(unix)]
mod interrupted {
    use std::io::{BufRead, BufReader};
    use std::process::{Child, Command};
    use std::time::Duration;

    use crate::common::recording::{finish_child, stamps, write_config};
    use keysplat::export::MapFormat;

    use super::*;

    /// So many steps that the run would take hours on any adapter if it were not interrupted, and nearly each frame a keyframe, so that
    /// the mapper's backlog holds the tracker up.
    const ENDLESS: &str = "[tracking]\nkeyframe_translation = 0.001\nkeyframe_rotation_rad = 0.001\nkeyframe_overlap = 1.0\n";
    const STEPS: u64 = 1_000_000;

    fn interrupt(child: &Child) {
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    }

    #[test]
    fn ctrl_c_ends_with_what_there_is() {
        if skipped_without_adapter() {
            return;
        }
        let config = write_config("endless.toml", ENDLESS);
        let text = std::fs::read_to_string(&config).unwrap();
        let many = |line: &str| match line.split_once(" = ") {
            Some((key @ ("first_iterations" | "iterations_per_keyframe"), _)) => format!("{key} = {STEPS}\n"),
            _ => format!("{line}\n"),
        };
        std::fs::write(&config, text.lines().map(many).collect::<String>()).unwrap();
        let out = scratch().join("interrupted");
        let mut command = keysplat(["run"]);
        command.arg(recording()).arg("--config").arg(&config).arg("--out").arg(&out);
        let mut child = command.spawn().unwrap();
        // Once it says that it replays, it has installed its handler.
        let mut stderr = BufReader::new(child.stderr.take().unwrap());
        let mut said = String::new();
        while !said.contains("replaying into") {
            assert!(stderr.read_line(&mut said).unwrap() > 0, "{said}");
        }
        let rest = std::thread::spawn(move || std::io::read_to_string(stderr).unwrap());
        std::thread::sleep(Duration::from_secs(2));
        interrupt(&child);
        let finished = finish_child(child, said).succeeded();
        assert!(rest.join().unwrap().contains("finishing with what there is"));

        let tracked = stamps(&out.join("trajectory.txt")).len();
        assert!((1..FRAMES).contains(&tracked), "{tracked} frames");
        let m = metrics(&out);
        assert_eq!((m.frames, m.frames_tracked), (FRAMES as u64, tracked as u64));
        assert!(m.mapping.unwrap().iterations < STEPS);
        assert!(m.images.all_frames.unwrap().psnr_db.unwrap() > 15.0);
        assert!(MapFormat::default().read(&out.join("map.ply")).unwrap().len() > 1000);
        assert!(finished.stdout.contains("lost frames"));
    }
}
