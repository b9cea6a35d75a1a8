//! Measures what viewers cost the mapper: the same run without a view, with one, and with viewers of several kinds, in turn.
//!
//! usage: cargo run --release --example view_cost -- RECORDING [ROUNDS] [FRAMES] [MAP_SCALE]

use std::error::Error;
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

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
    let mut rates: Vec<Vec<f64>> = vec![Vec::new(); MODES.len()];
    let mut hashes = Vec::new();
    for round in 0..rounds {
        for (mode, rates) in MODES.iter().zip(&mut rates) {
            let (rate, hash) = measure(&config, mode.1, mode.2)?;
            eprintln!("round {round}, {}: {rate:.2} steps/s", mode.0);
            rates.push(rate);
            hashes.push(hash);
        }
    }
    hashes.dedup();
    println!("| viewers | steps a second, median | ratio to the run without, round by round: median | least | most |");
    println!("|---|---|---|---|---|");
    for (k, mode) in MODES.iter().enumerate() {
        let mut ratios: Vec<f64> = rates[k].iter().zip(&rates[0]).map(|(rate, without)| rate / without).collect();
        let median = |values: &mut Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let (rate, ratio) = (median(&mut rates[k].clone()), median(&mut ratios));
        println!("| {} | {rate:.2} | {ratio:.3} | {:.3} | {:.3} |", mode.0, ratios[0], ratios[ratios.len() - 1]);
    }
    println!("\nmaps of all runs: {}", if hashes.len() == 1 { "the same bytes" } else { "DIFFERENT" });
    Ok(())
}

/// Optimisation steps in a second of the mapper's own time, and the digest of the map.
fn measure(config: &Config, served: bool, kinds: &[Kind]) -> Outcome<(f64, Vec<u8>)> {
    let folder = tempfile::tempdir()?;
    let mut session = Session::open(config.clone(), folder.path())?;
    let (progress, over) = (Progress::default(), AtomicBool::new(false));
    let live = served.then(|| Live::start(session.shared_recording(), progress.clone())).transpose()?;
    let address = Some("127.0.0.1:0".parse()?);
    let start = |live: &Live| Server::start(ServerOptions { address, ..ServerOptions::default() }, live.board(), live.desk());
    let server = live.as_ref().map(start).transpose()?;
    let url = server.as_ref().map(|server| server.url().replace("http:", "ws:").replace("/?", "/live?")).unwrap_or_default();
    let replay = std::thread::scope(|scope| {
        for kind in kinds {
            scope.spawn(|| {
                if let Err(error) = view(&url, *kind, &over) {
                    eprintln!("a viewer ended: {error}");
                }
            });
        }
        let replay = session.run(&progress);
        over.store(true, Ordering::Relaxed);
        replay
    })?;
    let records = &replay.result.history.keyframes;
    let steps: usize = records.iter().map(|record| record.report.iterations).sum();
    let busy: f64 = records.iter().map(|record| record.busy_s).sum();
    let digest = Sha256::digest(config.map_format.encode(&replay.result.cloud)?);
    Ok((steps as f64 / busy, digest.to_vec()))
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
