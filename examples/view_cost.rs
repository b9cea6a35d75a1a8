//! Measures what viewers cost the mapper: the same run without a view, with one, and with viewers of several kinds, in turn.
//!
//! Seconds of a clock depend on what else the machine does. Processor time hardly does: of the whole process, which on a software adapter includes all
//! rendering, without the viewers' own threads.
//!
//! usage: cargo run --release --example view_cost -- RECORDING [ROUNDS] [FRAMES] [MAP_SCALE]

use std::error::Error;
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cpu_time::{ProcessTime, ThreadTime};
use keysplat::viewing::{Live, Server, ServerOptions};
use keysplat::{Config, Progress, Session};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// A viewer looks for messages this often.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// An orbiting viewer orders an exact picture this often.
const ORDER_EVERY: Duration = Duration::from_millis(500);

/// What a viewer does.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    /// Takes the first map, and no more.
    Idle,
    /// Takes all maps and images.
    Taking,
    /// The same, and orders exact pictures.
    Orbiting,
    /// Never reads.
    Mute,
}

/// Name, whether there is a server, and its viewers.
const MODES: [(&str, bool, &[Kind]); 7] = [
    ("without --view", false, &[]),
    ("no viewer", true, &[]),
    ("one idle", true, &[Kind::Idle]),
    ("one taking all", true, &[Kind::Taking]),
    ("one orbiting with exact pictures", true, &[Kind::Orbiting]),
    ("three taking all", true, &[Kind::Taking; 3]),
    ("one that never reads", true, &[Kind::Mute]),
];

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let recording = arguments.first().ok_or("usage: view_cost RECORDING [ROUNDS] [FRAMES] [MAP_SCALE]")?;
    let number = |k: usize, default: f64| arguments.get(k).map_or(Ok(default), |text| text.parse::<f64>());
    let (rounds, frames) = (number(1, 5.0)? as usize, number(2, 100.0)? as usize);
    let mut config = Config::for_recording(Path::new(recording));
    config.map_scale = number(3, 0.5)?;
    config.replay.frames = Some((0, frames));
    let mut rounds_of: Vec<Vec<Speed>> = vec![Vec::new(); MODES.len()];
    let mut hashes = Vec::new();
    for round in 0..rounds {
        // Each round begins with another one.
        for k in (0..MODES.len()).map(|k| (k + round) % MODES.len()) {
            let (mode, speeds) = (&MODES[k], &mut rounds_of[k]);
            let (speed, hash) = measure(&config, mode.1, mode.2)?;
            eprintln!(
                "round {round}, {}: {:.2} steps/s, {:.2} steps a processor second",
                mode.0, speed.by_clock, speed.by_processor
            );
            speeds.push(speed);
            hashes.push(hash);
        }
    }
    hashes.dedup();
    println!("Ratios are to the run without a view, round by round: median (least–most).\n");
    println!("| viewers | steps a second, median | ratio | steps a processor second, median | ratio |");
    println!("|---|---|---|---|---|");
    for (mode, speeds) in MODES.iter().zip(&rounds_of) {
        let [by_clock, by_processor] = [|s: &Speed| s.by_clock, |s: &Speed| s.by_processor].map(|of| {
            let median = sorted(speeds.iter().map(of))[speeds.len() / 2];
            let ratios = sorted(speeds.iter().zip(&rounds_of[0]).map(|(speed, without)| of(speed) / of(without)));
            format!("{median:.2} | {:.3} ({:.3}–{:.3})", ratios[ratios.len() / 2], ratios[0], ratios[ratios.len() - 1])
        });
        println!("| {} | {by_clock} | {by_processor} |", mode.0);
    }
    println!("\nmaps of all runs: {}", if hashes.len() == 1 { "the same bytes" } else { "DIFFERENT" });
    Ok(())
}

/// Optimisation steps in a second of the mapper's own time, and in one of all processors.
#[derive(Clone, Copy)]
struct Speed {
    by_clock: f64,
    by_processor: f64,
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

/// A run's speed, and the digest of its map.
fn measure(config: &Config, served: bool, kinds: &[Kind]) -> Outcome<(Speed, Vec<u8>)> {
    let folder = tempfile::tempdir()?;
    let mut session = Session::open(config.clone(), folder.path())?;
    let (progress, over) = (Progress::default(), AtomicBool::new(false));
    let live = served.then(|| Live::start(session.shared_recording(), progress.clone())).transpose()?;
    let address = Some("127.0.0.1:0".parse()?);
    let start = |live: &Live| Server::start(ServerOptions { address, ..ServerOptions::default() }, live.board(), live.desk());
    let server = live.as_ref().map(start).transpose()?;
    let url = server.as_ref().map(|server| server.url().replace("http:", "ws:").replace("/?", "/live?")).unwrap_or_default();
    let clock = ProcessTime::now();
    let watch = |kind: Kind| {
        let clock = ThreadTime::now();
        if let Err(error) = view(&url, kind, &over) {
            eprintln!("a viewer ended: {error}");
        }
        clock.elapsed()
    };
    let (replay, viewers) = std::thread::scope(|scope| {
        let viewers: Vec<_> = kinds.iter().map(|kind| scope.spawn(|| watch(*kind))).collect();
        let replay = session.run(&progress);
        over.store(true, Ordering::Relaxed);
        (replay, viewers.into_iter().filter_map(|viewer| viewer.join().ok()).sum::<Duration>())
    });
    let (replay, processor) = (replay?, clock.elapsed() - viewers);
    let records = &replay.result.history.keyframes;
    let steps: usize = records.iter().map(|record| record.report.iterations).sum();
    let busy: f64 = records.iter().map(|record| record.busy_s).sum();
    let digest = Sha256::digest(config.map_format.encode(&replay.result.cloud)?);
    let speed = Speed { by_clock: steps as f64 / busy, by_processor: steps as f64 / processor.as_secs_f64() };
    Ok((speed, digest.to_vec()))
}

/// One viewer, until the run is over.
fn view(url: &str, kind: Kind, over: &AtomicBool) -> Outcome<()> {
    let (mut socket, _) = tungstenite::connect(url)?;
    if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
        stream.set_read_timeout(Some(LOOK_EVERY))?;
    }
    if kind == Kind::Taking || kind == Kind::Orbiting {
        send(&mut socket, &json!({ "type": "images", "current": true }))?;
    }
    let mut ordered = Instant::now();
    while !over.load(Ordering::Relaxed) {
        if kind == Kind::Mute {
            std::thread::sleep(LOOK_EVERY);
            continue;
        }
        match socket.read() {
            Ok(Message::Binary(bytes)) if kind != Kind::Idle => take(&mut socket, &bytes)?,
            Ok(_) => {}
            Err(tungstenite::Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error.into()),
        }
        if kind == Kind::Orbiting && ordered.elapsed() >= ORDER_EVERY {
            ordered = Instant::now();
            let order = json!({ "type": "render", "request": 1, "kind": "color", "p": [0, 0, 0], "q": [0, 0, 0, 1],
                "width": 640, "height": 480, "fx": 520, "fy": 520, "cx": 319.5, "cy": 239.5 });
            send(&mut socket, &order)?;
        }
    }
    Ok(())
}

fn take(socket: &mut WebSocket<MaybeTlsStream<TcpStream>>, bytes: &[u8]) -> Outcome<()> {
    let length = u32::from_le_bytes(bytes[..4].try_into()?) as usize;
    let header: Value = serde_json::from_slice(&bytes[4..4 + length])?;
    if header["type"] == "map" {
        send(socket, &json!({ "type": "taken", "revision": header["revision"] }))?;
    }
    Ok(())
}

fn send(socket: &mut WebSocket<MaybeTlsStream<TcpStream>>, message: &Value) -> Outcome<()> {
    Ok(socket.send(Message::text(message.to_string()))?)
}
