//! A tiny synthetic recording, rendered once per test binary, and the real program run on it.
//!
//! Everything lies in the build folder's `tmp`, in a folder per test binary that is emptied when the binary starts, so that what a
//! failed test wrote can be looked at.

use std::ffi::OsStr;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use super::requirements::skip;
use keysplat::evaluation::Metrics;
use keysplat::gpu::Gpu;
use keysplat::synthetic::{self, CameraConfig, FurnitureConfig, SceneConfig};

pub const FRAMES: usize = 24;
pub const FPS: f64 = 30.0;
pub const WIDTH: u32 = 160;
pub const HEIGHT: u32 = 120;

/// Few steps: the map need not be good, only honest.
pub const FIRST_ITERATIONS: u64 = 20;
pub const ITERATIONS_PER_KEYFRAME: u64 = 5;

/// No run here takes longer, however busy the machine is; one that does hangs.
const HANGS_AFTER: Duration = Duration::from_secs(900);

/// What a graphics driver says on standard error by itself.
const DRIVER_LINES: [&str; 2] = ["error: XDG_RUNTIME_DIR", "WARNING: "];

/// This test binary's folder for files, emptied when the binary starts.
fn binary_scratch() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let binary = std::env::current_exe().unwrap();
        // `program-<hash>`
        let name = binary.file_stem().unwrap().to_str().unwrap().rsplit_once('-').unwrap().0.to_owned();
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        if folder.exists() {
            std::fs::remove_dir_all(&folder).unwrap();
        }
        std::fs::create_dir_all(&folder).unwrap();
        folder
    })
}

/// The folder for files of the calling module.
#[track_caller]
pub fn scratch() -> PathBuf {
    let module = Path::new(std::panic::Location::caller().file()).file_stem().unwrap();
    let folder = binary_scratch().join(module);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// A short sweep across a sparsely furnished room, at the smallest usual size that is tracked well.
pub fn scene() -> SceneConfig {
    let (width, height) = (WIDTH, HEIGHT);
    let camera = CameraConfig { width, height, fx: 131.25, fy: 131.25, cx: 79.5, cy: 59.5, ..CameraConfig::default() };
    let furniture = FurnitureConfig { tables: 1, shelves: 1, sofas: 0, cabinets: 1, lamps: 0, plants: 0, ..Default::default() };
    SceneConfig { seed: 3, frames: FRAMES, fps: FPS, camera, furniture, ..SceneConfig::default() }
}

/// The recording; tests only read it.
pub fn recording() -> &'static Path {
    static RECORDING: OnceLock<PathBuf> = OnceLock::new();
    RECORDING.get_or_init(|| {
        let folder = binary_scratch().join("recording");
        synthetic::generate(&scene(), &folder, &|_, _| {}).unwrap();
        folder
    })
}

/// A copy of the recording under another name, to be spoilt.
#[track_caller]
pub fn copy_of_recording(name: &str) -> PathBuf {
    let to = scratch().join(name);
    copy_folder(recording(), &to);
    to
}

pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

pub fn stamp(frame: usize) -> String {
    format!("{:.6}", frame as f64 / FPS)
}

/// The colour image of a frame.
pub fn color_file(recording: &Path, frame: usize) -> PathBuf {
    recording.join("rgb").join(format!("{}.png", stamp(frame)))
}

/// Leaves only the first `bytes` of a file.
pub fn truncate(file: &Path, bytes: u64) {
    std::fs::OpenOptions::new().write(true).open(file).unwrap().set_len(bytes).unwrap();
}

/// Replaces line `number` (from 1) of a text file by what `change` makes of it.
pub fn change_line(file: &Path, number: usize, change: impl FnOnce(&str) -> String) {
    let text = std::fs::read_to_string(file).unwrap();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    lines[number - 1] = change(&lines[number - 1]);
    std::fs::write(file, lines.join("\n") + "\n").unwrap();
}

/// A configuration with few steps, and more lines behind them.
#[track_caller]
pub fn write_config(name: &str, more: &str) -> PathBuf {
    let path = scratch().join(name);
    let mapping =
        format!("[mapping]\niterations_per_keyframe = {ITERATIONS_PER_KEYFRAME}\nfirst_iterations = {FIRST_ITERATIONS}\n");
    std::fs::write(&path, mapping + more).unwrap();
    path
}

/// Skips the calling test where no adapter can run the mapper; returns whether it did.
pub fn skipped_without_adapter() -> bool {
    static ERROR: OnceLock<Option<String>> = OnceLock::new();
    let error = ERROR.get_or_init(|| Gpu::open(None).err().map(|e| e.to_string()));
    if let Some(error) = error {
        skip("adapter", error);
    }
    error.is_some()
}

/// What the program said and how it ended.
#[derive(Debug)]
pub struct Finished {
    /// `None` if a signal ended it.
    pub code: Option<i32>,
    pub stdout: String,
    /// Without what graphics drivers print.
    pub stderr: String,
}

impl Finished {
    pub fn succeeded(self) -> Self {
        assert_eq!(self.code, Some(0), "{}", self.stderr);
        self
    }

    /// Checks that it ended in an error that says all of `parts`, each unbroken.
    pub fn refused(&self, parts: &[&str]) {
        assert!(self.code.is_some_and(|code| code != 0 && code != 101), "{self:?}");
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        for part in parts {
            assert!(self.stderr.contains(part), "the error does not say `{part}`:\n{}", self.stderr);
        }
    }
}

/// The program, not yet started.
pub fn keysplat<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_keysplat"));
    command.args(arguments).env_remove("RUST_LOG").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// `keysplat run RECORDING --out OUT`, with few steps and more options.
pub fn run_command(recording: &Path, out: &Path, more: &[&str]) -> Command {
    static CONFIG: OnceLock<PathBuf> = OnceLock::new();
    let config = CONFIG.get_or_init(|| write_config("few-steps.toml", ""));
    let mut command = keysplat(["run"]);
    command.arg(recording).arg("--out").arg(out).arg("--config").arg(config).args(more);
    command
}

/// Runs the program to its end.
pub fn finish(mut command: Command) -> Finished {
    finish_child(command.spawn().unwrap(), String::new())
}

/// Waits for a program that was started; `said` is what was read of its standard error already.
pub fn finish_child(mut child: Child, said: String) -> Finished {
    let started = Instant::now();
    let stdout = child.stdout.take().map(|pipe| std::thread::spawn(|| read(pipe)));
    let stderr = child.stderr.take().map(|pipe| std::thread::spawn(|| read(pipe)));
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if started.elapsed() > HANGS_AFTER {
            child.kill().unwrap();
            panic!("the program hangs");
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    let text = |reader: Option<std::thread::JoinHandle<String>>| reader.map_or_else(String::new, |r| r.join().unwrap());
    let stderr = said + &text(stderr);
    let ours = stderr.lines().filter(|line| !DRIVER_LINES.iter().any(|driver| line.starts_with(driver)));
    Finished { code: status.code(), stdout: text(stdout), stderr: ours.map(|line| format!("{line}\n")).collect() }
}

fn read(mut pipe: impl Read) -> String {
    let mut bytes = Vec::new();
    pipe.read_to_end(&mut bytes).unwrap();
    String::from_utf8(bytes).unwrap()
}

pub fn metrics(out: &Path) -> Metrics {
    serde_json::from_str(&std::fs::read_to_string(out.join("metrics.json")).unwrap()).unwrap()
}

/// The first column of a TUM trajectory.
pub fn stamps(trajectory: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(trajectory).unwrap();
    text.lines().map(|line| line.split_once(' ').unwrap().0.to_owned()).collect()
}
