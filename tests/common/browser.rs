//! Headless Chromium with WebGL2 in software, driven by its DevTools protocol.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use super::requirements::skip;

/// However busy the machine is, no step of a page takes longer.
const HANGS_AFTER: Duration = Duration::from_secs(120);

/// A page in a browser of its own, which ends with it.
pub struct Page {
    process: Child,
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    calls: u64,
    /// Errors and warnings of the page's console, and uncaught exceptions.
    pub complaints: Vec<String>,
}

/// The program, or the test is skipped.
pub fn chromium() -> Option<&'static str> {
    let found = ["chromium", "chromium-browser", "google-chrome"].into_iter().find(|name| {
        Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
    });
    if found.is_none() {
        skip("browser", "there is no chromium");
    }
    found
}

fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(started.elapsed() < HANGS_AFTER, "{what} did not come");
        std::thread::sleep(Duration::from_millis(50));
    }
}

impl Page {
    /// Starts a browser with its profile in `folder`. Its network ends at this machine.
    pub fn open(program: &str, folder: &Path) -> Self {
        let _ = std::fs::remove_dir_all(folder);
        let process = Command::new(program)
            .args(["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"])
            .args(["--remote-debugging-port=0", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"])
            .arg(format!("--user-data-dir={}", folder.display()))
            .arg("about:blank")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let port: u16 = wait_for("the browser", || {
            let text = std::fs::read_to_string(folder.join("DevToolsActivePort")).ok()?;
            text.lines().next()?.parse().ok()
        });
        let address = wait_for("the browser's page", || page_address(port));
        let (socket, _) = tungstenite::connect(&address).unwrap();
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(HANGS_AFTER)).unwrap();
        }
        let mut page = Self { process, socket, calls: 0, complaints: Vec::new() };
        ["Runtime.enable", "Log.enable", "Page.enable"].iter().for_each(|domain| drop(page.call(domain, json!({}))));
        page
    }

    /// Calls a method of the protocol; events that come meanwhile are kept if they complain.
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.calls += 1;
        let id = self.calls;
        let call = json!({ "id": id, "method": method, "params": parameters });
        self.socket.send(Message::text(call.to_string())).unwrap();
        loop {
            let message: Value = match self.socket.read().unwrap() {
                Message::Text(text) => serde_json::from_str(&text).unwrap(),
                _ => continue,
            };
            if message["id"] == id {
                assert!(message.get("error").is_none(), "{method}: {message}");
                return message["result"].clone();
            }
            self.note(&message);
        }
    }

    fn note(&mut self, event: &Value) {
        let parameters = &event["params"];
        let complains = match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => true,
            Some("Runtime.consoleAPICalled") => ["error", "warning", "assert"].iter().any(|kind| parameters["type"] == *kind),
            Some("Log.entryAdded") => ["error", "warning"].iter().any(|level| parameters["entry"]["level"] == *level),
            _ => false,
        };
        if complains {
            self.complaints.push(parameters.to_string());
        }
    }

    /// Sets the window's size and the colour scheme.
    pub fn window(&mut self, width: u32, height: u32, dark: bool) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600 });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
        let scheme = json!([{ "name": "prefers-color-scheme", "value": if dark { "dark" } else { "light" } }]);
        self.call("Emulation.setEmulatedMedia", json!({ "features": scheme }));
    }

    /// Goes to an address and waits for its document.
    pub fn go(&mut self, address: &str) {
        self.call("Page.navigate", json!({ "url": address }));
        let started = Instant::now();
        while self.evaluate("document.readyState") != "complete" {
            assert!(started.elapsed() < HANGS_AFTER, "{address} does not load");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// The value of an expression, awaited if it is a promise.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let call = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let result = self.call("Runtime.evaluate", call);
        assert!(result.get("exceptionDetails").is_none(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn wait_until(&mut self, expression: &str) {
        let started = Instant::now();
        while self.evaluate(expression) != true {
            assert!(started.elapsed() < HANGS_AFTER, "never true: {expression}; {:?}", self.complaints);
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Presses and releases a key.
    pub fn press(&mut self, key: &str, code: &str, key_code: u32) {
        let text = if key.len() == 1 { json!(key) } else { json!("") };
        for kind in ["keyDown", "keyUp"] {
            let event = json!({ "type": kind, "key": key, "code": code, "windowsVirtualKeyCode": key_code,
                "text": if kind == "keyDown" { text.clone() } else { json!("") } });
            self.call("Input.dispatchKeyEvent", event);
        }
    }

    /// Lays fingers on the window and moves them in a straight line each: `(from, to)`, pixels.
    pub fn swipe(&mut self, fingers: &[([f64; 2], [f64; 2])]) {
        const MOVES: u32 = 10;
        for step in 0..=MOVES {
            let share = f64::from(step) / f64::from(MOVES);
            let at = |(id, (from, to)): (usize, &([f64; 2], [f64; 2]))| {
                let [x, y] = [0, 1].map(|k| from[k] + share * (to[k] - from[k]));
                json!({ "x": x, "y": y, "id": id })
            };
            let points: Vec<Value> = fingers.iter().enumerate().map(at).collect();
            let kind = if step == 0 { "touchStart" } else { "touchMove" };
            self.call("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
        }
        self.call("Input.dispatchTouchEvent", json!({ "type": "touchEnd", "touchPoints": [] }));
    }

    /// Writes a picture of the window.
    pub fn screenshot(&mut self, path: &Path) {
        use base64::Engine;
        let picture = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let bytes = base64::engine::general_purpose::STANDARD.decode(picture["data"].as_str().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The address of the first page's socket.
fn page_address(port: u16) -> Option<String> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(5))).ok()?;
    write!(stream, "GET /json/list HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = String::new();
    // The server may keep the connection open.
    let mut buffer = [0u8; 4096];
    while let Ok(count @ 1..) = stream.read(&mut buffer) {
        answer.push_str(&String::from_utf8_lossy(&buffer[..count]));
        if answer.trim_end().ends_with(']') {
            break;
        }
    }
    let pages: Vec<Value> = serde_json::from_str(answer.split_once("\r\n\r\n")?.1).ok()?;
    let page = pages.into_iter().find(|page| page["type"] == "page")?;
    page["webSocketDebuggerUrl"].as_str().map(String::from)
}
