//! The view of a run as its viewers have it: polite ones, hostile ones, and a browser.

use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;

use keysplat::export::MapFormat;
use keysplat::geometry::Trajectory;
use keysplat::gpu::Gpu;
use keysplat::render::{GpuCloud, Rasterizer, Rendered};
use keysplat::splat::{GaussianCloud, ViewCamera};
use keysplat::viewing::PackedMap;
use keysplat::{Config, Recording};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde_json::json;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use crate::common::browser::{Page, chromium};
use crate::common::recording::{
    FRAMES, finish, finish_child, keysplat, metrics, recording, run_command, scratch, skipped_without_adapter,
};
use crate::common::viewer::{BASE_WORDS, Serving, Viewer, open};

/// Sum of the base words of a map's Gaussians.
fn sum<'a>(words: impl Iterator<Item = &'a u32>) -> u32 {
    words.fold(0, |sum, word| sum.wrapping_add(*word))
}

fn sum_of_file(path: &Path) -> (usize, u32) {
    let packed = PackedMap::new(&MapFormat::default().read(path).unwrap(), 1, None);
    let stride = BASE_WORDS + 4 * usize::from(packed.sh_degree.get());
    let base = packed.parts.iter().flat_map(|part| part.words.chunks(stride).flat_map(|gaussian| &gaussian[..BASE_WORDS]));
    (packed.gaussians, sum(base))
}

/// Optimisation steps so far.
fn steps(viewer: &Viewer) -> u64 {
    viewer.statistics.last().map_or(0, |entry| entry["steps"].as_u64().unwrap())
}

/// Random bytes, damaged messages and frames that are too large, in turn; a connection that was closed is opened again.
fn torment(serving: &Serving, messages: usize) {
    let mut random = fastrand::Rng::with_seed(5);
    let good = [
        r#"{"type":"taken","revision":1}"#,
        r#"{"type":"keyframe","id":0}"#,
        r#"{"type":"images","current":true}"#,
        r#"{"type":"render","request":1,"kind":"color","p":[0,0,0],"q":[0,0,0,1],"width":64,"height":48,"fx":60,"fy":60,"cx":31,"cy":23}"#,
    ];
    let mut socket = None;
    for number in 0..messages {
        let mut bytes = good[random.usize(..good.len())].as_bytes().to_vec();
        for _ in 0..random.usize(..4) {
            let at = random.usize(..bytes.len());
            bytes[at] = random.u8(32..127);
        }
        bytes.truncate(random.usize(..=bytes.len()));
        let message = match number % 100 {
            0 => Message::binary(vec![0u8; 100_000]),
            1 => Message::text("x".repeat(5_000)),
            2..10 => Message::binary((0..random.usize(..900)).map(|_| random.u8(..)).collect::<Vec<u8>>()),
            _ => Message::text(String::from_utf8(bytes).unwrap()),
        };
        let open = socket.get_or_insert_with(|| try_open(serving));
        if open.as_mut().is_none_or(|open| open.send(message).is_err()) {
            socket = None;
        }
    }
}

fn try_open(serving: &Serving) -> Option<WebSocket<MaybeTlsStream<TcpStream>>> {
    let address = serving.url.replace("http:", "ws:").replace("/?", "/live?");
    tungstenite::connect(&address).ok().map(|(socket, _)| socket)
}

/// Viewers that take all, never read, or attack change neither the map nor the run's end; the map seen last is the file's.
#[test]
fn viewers_see_the_map_grow_and_change_nothing() {
    if skipped_without_adapter() {
        return;
    }
    let (alone, seen) = (scratch().join("alone"), scratch().join("seen"));
    finish(run_command(recording(), &alone, &[])).succeeded();
    let mut serving = Serving::start(run_command(recording(), &seen, &["--view=127.0.0.1:0"]));
    let mut viewer = Viewer::new(&serving);
    viewer.send(&json!({ "type": "control", "do": "pause" }));
    viewer.send(&json!({ "type": "images", "current": true }));
    let mute = open(&serving);
    viewer.until("the pause", |viewer| viewer.statistics.last().is_some_and(|entry| entry["paused"] == true));
    let slow: Vec<TcpStream> = (0..20)
        .map(|_| {
            let mut stream = TcpStream::connect(serving.address).unwrap();
            stream.write_all(b"GET / HTTP/1.1\r\nHost").unwrap();
            stream
        })
        .collect();
    let many: Vec<TcpStream> = (0..200).filter_map(|_| TcpStream::connect(serving.address).ok()).collect();
    drop(many);
    torment(&serving, 10_000);
    let held = viewer.statistics.last().unwrap()["frames"].clone();
    std::thread::sleep(Duration::from_millis(1500));
    let seen_then = viewer.statistics.len();
    viewer.until("more statistics", |viewer| viewer.statistics.len() > seen_then + 1);
    assert_eq!(viewer.statistics.last().unwrap()["frames"], held, "a pause holds the frames");
    let paused = steps(&viewer);
    for _ in 0..2 {
        // A step maps one keyframe, or takes one round, and pauses again.
        let before = steps(&viewer);
        viewer.send(&json!({ "type": "control", "do": "step" }));
        viewer.until("the step", |viewer| steps(viewer) > before && viewer.statistics.last().unwrap()["paused"] == true);
    }
    assert!(paused < steps(&viewer));
    viewer.send(&json!({ "type": "control", "do": "go" }));
    // From close by: more intersections than the mapper has room for.
    let (p, q) = ([0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]);
    viewer.send(&json!({ "type": "render", "request": 9, "kind": "depth", "p": p, "q": q,
        "width": 1920, "height": 1440, "fx": 1500, "fy": 1500, "cx": 959.5, "cy": 719.5 }));
    viewer.until("the end", |viewer| viewer.is_done() && viewer.complete);
    let (_, expected) = sum_of_file(&seen.join("map.ply"));
    viewer.until("the last map", |viewer| viewer.complete && sum(viewer.parts.values().flatten()) == expected);
    assert!(viewer.updates >= 3, "{} updates", viewer.updates);
    assert_eq!(viewer.keyframes.len() as u64, metrics(&seen).keyframes.unwrap());
    assert!(viewer.images.iter().any(|image| image["of"] == "render" && image["kind"] == "depth"), "{:?}", viewer.images);
    viewer.send(&json!({ "type": "keyframe", "id": 0 }));
    viewer.until("a keyframe's image", |viewer| viewer.images.iter().any(|image| image["of"] == "keyframe"));
    let hash = |out: &Path| metrics(out).map_hash.unwrap();
    assert_eq!(hash(&alone), hash(&seen));
    refine_after_the_end(&mut viewer, &seen);
    drop((viewer, mute, slow));
    let child = std::mem::replace(&mut serving.child, keysplat(["--version"]).spawn().unwrap());
    finish_child(child, std::mem::take(&mut serving.said)).succeeded();
    assert_eq!(metrics(&seen).frames, FRAMES as u64);
}

/// Goes on with the refinement of a run that is over, and ends it again: the files are those of the longer refinement.
fn refine_after_the_end(viewer: &mut Viewer, out: &Path) {
    let (before, earlier) = (steps(viewer), metrics(out).map_hash);
    viewer.send(&json!({ "type": "control", "do": "refine" }));
    viewer.until("more steps", |viewer| steps(viewer) > before && !viewer.is_done());
    viewer.send(&json!({ "type": "control", "do": "finish" }));
    viewer.until("the end again", |viewer| viewer.is_done());
    assert_ne!(metrics(out).map_hash, earlier);
    let (_, expected) = sum_of_file(&out.join("map.ply"));
    viewer.until("the refined map", |viewer| viewer.complete && sum(viewer.parts.values().flatten()) == expected);
}

#[test]
fn strangers_are_refused() {
    let map = scratch().join("map.ply");
    MapFormat::default().write(&crate::common::scene(&mut fastrand::Rng::with_seed(2), 50, Default::default()), &map).unwrap();
    let serving = Serving::view(&map);
    let token = serving.token();
    let get = |path: &str, more: &str| serving.ask(&format!("GET {path} HTTP/1.1\r\nHost: HOST\r\n{more}\r\n"));
    let status = |answer: &str| answer.split(' ').nth(1).unwrap_or_default().to_owned();
    let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                   Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
    let page = get(&format!("/?token={token}"), "");
    assert_eq!(status(&page), "200");
    assert!(page.to_lowercase().contains("content-security-policy: default-src 'none'"));
    for path in ["/", "/?token=", "/?token=0123", "/live"] {
        assert_eq!(status(&get(path, upgrade)), "403", "{path}");
    }
    let foreign = get(&format!("/live?token={token}"), &format!("{upgrade}Origin: http://example.org\r\n"));
    assert_eq!(status(&foreign), "403");
    for path in ["/../../etc/passwd", "/..%2f..%2fetc/passwd", "//etc/passwd", "/map.ply", "/?token"] {
        let answer = get(&format!("{path}{}", if path.contains('?') { "" } else { "?token=TOKEN" }).replace("TOKEN", token), "");
        assert!(["404", "403", "400"].contains(&status(&answer).as_str()), "{path}: {answer}");
    }
    let posted = serving.ask(&format!("POST /?token={token} HTTP/1.1\r\nHost: HOST\r\nContent-Length: 0\r\n\r\n"));
    assert_eq!(status(&posted), "405");
    let huge = get("/", &format!("X: {}\r\n", "y".repeat(1 << 20)));
    assert!(["431", "400", ""].contains(&status(&huge).as_str()), "{}", status(&huge));
    let mut viewer = Viewer::new(&serving);
    viewer.until("the map", |viewer| viewer.gaussians() == 50);
    viewer.send(&json!({ "type": "control", "do": "finish" }));
    let answer = std::iter::from_fn(|| Some(viewer.take())).find(|value| value["type"] == "refused").unwrap();
    assert!(answer["why"].as_str().unwrap().contains("read only"), "{answer}");
}

#[test]
fn what_is_no_run_is_refused() {
    let empty = scratch().join("empty");
    std::fs::create_dir_all(&empty).unwrap();
    finish(keysplat(["view".as_ref(), empty.as_os_str()])).refused(&["empty is no folder of a run and no map"]);
    finish(keysplat(["view", "nowhere.ply"])).refused(&["nowhere.ply"]);
    let cut = scratch().join("cut.ply");
    std::fs::write(&cut, "ply\nformat binary_little_endian 1.0\n").unwrap();
    finish(keysplat(["view".as_ref(), cut.as_os_str()])).refused(&["cut.ply"]);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let (map, address) = (scratch().join("one.ply"), taken.local_addr().unwrap().to_string());
    MapFormat::default().write(&crate::common::scene(&mut fastrand::Rng::with_seed(2), 5, Default::default()), &map).unwrap();
    finish(keysplat(["view".as_ref(), map.as_os_str(), "--at".as_ref(), address.as_ref()])).refused(&[&address, "another"]);
}

/// PSNR of bytes, three of each four.
fn psnr(a: &[u8], b: &[u8]) -> f64 {
    let differences = a.chunks(4).zip(b.chunks(4)).flat_map(|(a, b)| (0..3).map(|c| f64::from(a[c]) - f64::from(b[c])));
    let squares: Vec<f64> = differences.map(|d| d * d).collect();
    10.0 * (255.0 * 255.0 * squares.len() as f64 / squares.iter().sum::<f64>().max(1e-9)).log10()
}

/// Lets the page draw a view, and compares it with ours.
fn compare(page: &mut Page, camera: &ViewCamera, ours: &Rendered) {
    let (world_from_camera, pinhole) = (camera.camera_from_world.inverse(), camera.pinhole);
    let (p, q) = (world_from_camera.translation.vector, world_from_camera.rotation.coords);
    let view = json!({ "p": [p.x, p.y, p.z], "q": [q.x, q.y, q.z, q.w], "camera": {
        "width": pinhole.width, "height": pinhole.height,
        "fx": pinhole.fx, "fy": pinhole.fy, "cx": pinhole.cx, "cy": pinhole.cy } });
    let drawn = page.evaluate(&format!("window.keysplat.draw({view}).then(picture => Array.from(picture.rgba))"));
    let drawn: Vec<u8> = drawn.as_array().unwrap().iter().map(|v| v.as_u64().unwrap() as u8).collect();
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let ours: Vec<u8> = ours.color_depth.iter().flat_map(|p| [byte(p[0]), byte(p[1]), byte(p[2]), 255]).collect();
    assert_eq!(ours.len(), drawn.len());
    assert!(psnr(&drawn, &ours) > 30.0, "{} dB", psnr(&drawn, &ours));
}

/// Position, rotation and distance to what the camera turns about.
fn stance(page: &mut Page) -> (Vector3<f64>, UnitQuaternion<f64>, f64) {
    let state = page.evaluate("window.keysplat.state()");
    let numbers = |key: &str| -> Vec<f64> { serde_json::from_value(state["pose"][key].clone()).unwrap() };
    let (p, q) = (numbers("p"), numbers("q"));
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(q[3], q[0], q[1], q[2]));
    (Vector3::from_column_slice(&p), rotation, state["distance"].as_f64().unwrap())
}

/// One finger orbits, two fingers move sideways, a pinch goes nearer.
fn touch(page: &mut Page) {
    page.evaluate("window.keysplat.settled()");
    let middle = page.evaluate(
        "(canvas => { canvas.scrollIntoView({ behavior: 'instant' }); const box = canvas.getBoundingClientRect();
            return [box.left + box.width / 2, box.top + box.height / 2]; })(document.querySelector('#viewer canvas'))",
    );
    let middle: [f64; 2] = serde_json::from_value(middle).unwrap();
    let at = |x: f64, y: f64| [middle[0] + x, middle[1] + y];
    let (p, q, distance) = stance(page);
    let pivot = p + q * Vector3::z() * distance;
    page.swipe(&[(at(-40.0, 0.0), at(30.0, 0.0))]);
    let before = q;
    let (p, q, after) = stance(page);
    assert!(q.angle_to(&before) > 0.1 && (after - distance).abs() < 1e-6 * distance);
    assert!((p + q * Vector3::z() * distance - pivot).norm() < 1e-3 * distance, "an orbit keeps what it turns about");
    page.swipe(&[(at(-30.0, 0.0), at(-70.0, 0.0)), (at(30.0, 0.0), at(70.0, 0.0))]);
    let (nearer, turned, after) = stance(page);
    assert!((after / distance - 60.0 / 140.0).abs() < 0.02, "{after} of {distance} m");
    assert!(q.angle_to(&turned) < 1e-6 && (nearer - p).dot(&(q * Vector3::z())) > 0.5 * distance);
    page.swipe(&[(at(-40.0, 0.0), at(0.0, 40.0)), (at(30.0, 0.0), at(70.0, 40.0))]);
    let (aside, turned, _) = stance(page);
    let moved = q.inverse() * (aside - nearer);
    assert!(q.angle_to(&turned) < 1e-6 && moved.x < 0.0 && moved.y < 0.0 && moved.z.abs() < 0.1 * moved.norm(), "{moved}");
}

/// A comparison, a measurement and the help, by keys. Not all comparisons in a report have both pictures.
fn keys(page: &mut Page, both: bool) {
    page.evaluate("document.querySelector('#viewer canvas').focus()");
    page.press("]", "BracketRight", 221);
    page.wait_until("[...document.querySelectorAll('#viewer .compare')].some(element => !element.hidden)");
    if both {
        next_keyframe(page);
    }
    page.press("Escape", "Escape", 27);
    page.wait_until("[...document.querySelectorAll('#viewer .compare')].every(element => element.hidden)");
    page.press("m", "KeyM", 77);
    page.wait_until(
        "/keyframes see the point|no Gaussian at this point/.test(document.querySelector('#viewer .note').textContent)",
    );
    page.press("?", "Slash", 191);
    page.wait_until("document.querySelector('#viewer dialog[open]') !== null");
    page.press("Escape", "Escape", 27);
}

/// From one keyframe's comparison to the next, whose pictures are not there at once: no other is shown in their place.
fn next_keyframe(page: &mut Page) {
    const BOTH: &str = "document.querySelector('#viewer .pair.both') !== null";
    const NEXT: &str = "document.querySelector('#viewer .compare [aria-label^=\"Next keyframe\"]').click(), \
                        [...document.querySelectorAll('#viewer .pair > canvas')].every(canvas => canvas.hidden)";
    page.wait_until(BOTH);
    assert_eq!(page.evaluate(NEXT), true);
    page.wait_until(BOTH);
}

/// The page draws what our rasterizer draws, from a server and, of an antialiased map, from a report's file; by keyboard and touch, on a phone and on a desk.
#[test]
fn a_browser_draws_the_map_as_we_do() {
    if skipped_without_adapter() {
        return;
    }
    let Some(program) = chromium() else { return };
    let out = scratch().join("shown");
    finish(run_command(recording(), &out, &[])).succeeded();
    let serving = Serving::view(&out);
    let mut page = Page::open(program, &scratch().join("profile"));
    let cloud = MapFormat::default().read(&out.join("map.ply")).unwrap();
    page.go(&serving.url);
    page.wait_until("window.keysplat !== undefined");
    page.wait_until(&format!("window.keysplat.state().gaussians === {}", cloud.len()));
    // Smaller than a pixel, where opacities shrink.
    let mut small = GaussianCloud { antialiased: true, ..cloud.clone() };
    small.log_scales.iter_mut().for_each(|log_scale| *log_scale -= 1.5);
    MapFormat::default().write(&small, &out.join("map.ply")).unwrap();
    finish(keysplat(["report".as_ref(), out.as_os_str()])).succeeded();
    let recording = Recording::open(Config::read(&out.join("config.toml")).unwrap()).unwrap();
    let pinhole = recording.map_pinhole();
    let keyframes = Trajectory::read_tum(&out.join("keyframes.txt")).unwrap().poses;
    let gpu = Gpu::open(None).unwrap();
    let mut rasterizer = Rasterizer::new(gpu.clone()).unwrap();
    let report = format!("file://{}", std::fs::canonicalize(out.join("report.html")).unwrap().display());
    for (address, cloud, width, height, dark) in [(&serving.url, &cloud, 1400, 900, false), (&report, &small, 390, 844, true)] {
        let map = GpuCloud::of(&gpu, cloud).unwrap();
        page.window(width, height, dark);
        page.go(address);
        page.wait_until("window.keysplat !== undefined");
        page.wait_until(&format!("window.keysplat.state().gaussians === {}", cloud.len()));
        page.evaluate("window.keysplat.settled()");
        let digest = PackedMap::new(cloud, 1, None).digest();
        assert_eq!(page.evaluate("window.keysplat.state().digest"), digest);
        assert_eq!(page.evaluate("window.keysplat.state().keyframes"), keyframes.len());
        assert_eq!(page.evaluate("document.documentElement.scrollWidth <= innerWidth"), true, "{width}");
        for pose in keyframes.iter().step_by(keyframes.len().div_ceil(3)) {
            let camera = ViewCamera { pinhole, camera_from_world: pose.world_from_camera.inverse() };
            let ours = rasterizer.render(&map, &camera, [0.0; 3]).unwrap();
            compare(&mut page, &camera, &ours);
        }
        page.screenshot(&scratch().join(format!("page-{width}.png")));
        touch(&mut page);
        keys(&mut page, address == &serving.url);
        assert!(page.complaints.is_empty(), "{:?}", page.complaints);
    }
}
