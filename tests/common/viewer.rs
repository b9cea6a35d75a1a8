//! A program that serves a view, and viewers of it.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::Child;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use super::recording::keysplat;

pub const HANGS_AFTER: Duration = Duration::from_secs(90);
/// Words of a Gaussian but for the harmonics, whose scale is that of their part.
pub const BASE_WORDS: usize = 8;

/// A program that serves a view.
pub struct Serving {
    pub child: Child,
    pub said: String,
    pub address: SocketAddr,
    pub url: String,
}

impl Serving {
    pub fn start(mut command: std::process::Command) -> Self {
        let mut child = command.spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("The view is at ").unwrap_or_else(|| panic!("no address: {line}")).to_owned();
        let address = url.strip_prefix("http://").unwrap().split('/').next().unwrap().parse().unwrap();
        // The table that follows is not read here, and is shorter than the pipe.
        std::mem::forget(stdout);
        Self { child, said: line, address, url }
    }

    /// `keysplat view` of a finished run.
    pub fn view(path: &Path) -> Self {
        let mut command = keysplat(["view", "--at", "127.0.0.1:0"]);
        command.arg(path);
        Self::start(command)
    }

    pub fn token(&self) -> &str {
        self.url.split("token=").nth(1).unwrap()
    }

    /// The status line and the rest of an answer to a request that is written as it is.
    pub fn ask(&self, request: &str) -> String {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(HANGS_AFTER)).unwrap();
        stream.write_all(request.replace("HOST", &self.address.to_string()).as_bytes()).unwrap();
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A viewer that takes what it gets.
pub struct Viewer {
    pub socket: WebSocket<MaybeTlsStream<TcpStream>>,
    pub parts: BTreeMap<(Vec<i64>, u64), Vec<u32>>,
    pub updates: usize,
    pub keyframes: BTreeMap<u64, Value>,
    pub statistics: Vec<Value>,
    pub images: Vec<Value>,
    pub complete: bool,
}

impl std::fmt::Debug for Viewer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let last = self.statistics.last();
        write!(f, "{} updates, {} Gaussians, complete {}, {last:?}", self.updates, self.gaussians(), self.complete)
    }
}

pub fn open(serving: &Serving) -> WebSocket<MaybeTlsStream<TcpStream>> {
    let address = serving.url.replace("http:", "ws:").replace("/?", "/live?");
    let (socket, _) = tungstenite::connect(&address).unwrap();
    if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
        stream.set_read_timeout(Some(HANGS_AFTER)).unwrap();
    }
    socket
}

impl Viewer {
    pub fn new(serving: &Serving) -> Self {
        let mut viewer = Self {
            socket: open(serving),
            parts: BTreeMap::new(),
            updates: 0,
            keyframes: BTreeMap::new(),
            statistics: Vec::new(),
            images: Vec::new(),
            complete: false,
        };
        let hello = viewer.take();
        assert_eq!((hello["type"].as_str(), hello["protocol"].as_u64()), (Some("hello"), Some(1)), "{hello}");
        viewer
    }

    pub fn send(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    /// Takes in one message and returns its object.
    pub fn take(&mut self) -> Value {
        let started = Instant::now();
        let (value, payload) = loop {
            assert!(started.elapsed() < HANGS_AFTER, "nothing but pings: {self:?}");
            match self.socket.read().unwrap() {
                Message::Text(text) => break (serde_json::from_str::<Value>(&text).unwrap(), Vec::new()),
                Message::Binary(bytes) => {
                    let header = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
                    assert!(bytes.len() <= 4 << 20 && header.is_multiple_of(4));
                    break (serde_json::from_slice(&bytes[4..4 + header]).unwrap(), bytes[4 + header..].to_vec());
                }
                _ => {}
            }
        };
        match value["type"].as_str().unwrap() {
            "map" => self.take_map(&value, &payload),
            "statistics" => self.statistics.extend(value["entries"].as_array().unwrap().iter().cloned()),
            "image" => {
                image::load_from_memory(&payload).unwrap();
                self.images.push(value.clone());
            }
            "poses" => {
                if value["all"] == true {
                    self.keyframes.clear();
                }
                let keyframes = value["keyframes"].as_array().unwrap();
                self.keyframes.extend(keyframes.iter().map(|k| (k["id"].as_u64().unwrap(), k.clone())));
            }
            _ => {}
        }
        value
    }

    fn take_map(&mut self, header: &Value, payload: &[u8]) {
        self.updates += 1;
        if header["reset"] == true {
            self.parts.clear();
        }
        let words_each = BASE_WORDS + 4 * header["sh_degree"].as_u64().unwrap() as usize;
        let mut words = payload.chunks_exact(4).map(|word| u32::from_le_bytes(word.try_into().unwrap()));
        for chunk in header["chunks"].as_array().unwrap() {
            let at = chunk["at"].as_array().unwrap().iter().map(|c| c.as_i64().unwrap()).collect();
            let key = (at, chunk["part"].as_u64().unwrap());
            let count = chunk["count"].as_u64().unwrap() as usize;
            let taken: Vec<u32> = words.by_ref().take(count * words_each).collect();
            assert_eq!(taken.len(), count * words_each);
            let base = taken.chunks(words_each).flat_map(|gaussian| gaussian[..BASE_WORDS].to_vec()).collect();
            if count == 0 { drop(self.parts.remove(&key)) } else { drop(self.parts.insert(key, base)) }
        }
        assert!(words.next().is_none());
        self.complete = header["complete"] == true;
        if self.complete {
            assert_eq!(self.gaussians() as u64, header["gaussians"].as_u64().unwrap());
        }
        self.send(&json!({ "type": "taken", "revision": header["revision"] }));
    }

    pub fn gaussians(&self) -> usize {
        self.parts.values().map(|words| words.len() / BASE_WORDS).sum()
    }

    /// Takes messages until a condition holds.
    pub fn until(&mut self, what: &str, holds: impl Fn(&Self) -> bool) {
        let started = Instant::now();
        while !holds(self) {
            self.take();
            assert!(started.elapsed() < HANGS_AFTER, "{what} never came; {self:?}");
        }
    }

    pub fn is_done(&self) -> bool {
        self.statistics.last().is_some_and(|entry| entry["phase"] == "done")
    }
}
