//! The report of a run as the program writes it, and as a browser shows it. The latter needs Chromium; says so loudly and passes
//! where there is none.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use crate::common::browser::chromium;
use crate::common::recording::{finish, keysplat, recording, run_command, scratch, skipped_without_adapter};

/// A finished run with its report.
fn report() -> &'static Path {
    static REPORT: OnceLock<PathBuf> = OnceLock::new();
    REPORT.get_or_init(|| {
        let out = scratch().join("run");
        finish(run_command(recording(), &out, &[])).succeeded();
        let said = finish(keysplat(["report".as_ref(), out.as_os_str()])).succeeded().stdout;
        let path = out.join("report.html");
        assert_eq!(said.trim(), path.to_str().unwrap());
        path
    })
}

#[test]
fn a_report_holds_everything_itself() {
    if skipped_without_adapter() {
        return;
    }
    let page = std::fs::read_to_string(report()).unwrap();
    for needed in [
        "<title>recording · keysplat</title>",
        "held-out PSNR",
        "Tracking, stage by stage",
        "Size of the map",
        "iterations_per_keyframe",
    ] {
        assert!(page.contains(needed), "no {needed}");
    }
    assert!(!page.contains("<!--"), "a placeholder was left");
    // One fewer where the system does not tell how much memory a process has.
    assert_eq!(page.matches("<svg").count(), if cfg!(target_os = "linux") { 9 } else { 8 });
    assert_eq!(page.matches("data:image/png;base64,").count(), 3);
    // What would be loaded from elsewhere.
    let outside = ["src=\"", "href=\"", "@import", "url(http"];
    assert!(outside.iter().all(|loads| !page.contains(loads)));
}

#[test]
fn a_run_of_somebody_else_has_a_report_too() {
    if skipped_without_adapter() {
        return;
    }
    let (ours, foreign) = (report().parent().unwrap(), scratch().join("foreign"));
    std::fs::create_dir_all(&foreign).unwrap();
    for name in ["trajectory.txt", "map.ply"] {
        std::fs::copy(ours.join(name), foreign.join(name)).unwrap();
    }
    finish(keysplat(["eval".as_ref(), foreign.as_os_str(), "--sequence".as_ref(), recording().as_os_str()])).succeeded();
    finish(keysplat(["report".as_ref(), foreign.as_os_str()])).succeeded();
    let page = std::fs::read_to_string(foreign.join("report.html")).unwrap();
    assert!(page.contains("held-out PSNR") && !page.contains("Size of the map"));
}

#[test]
fn a_folder_without_figures_is_refused() {
    let empty = scratch().join("empty");
    std::fs::create_dir_all(&empty).unwrap();
    finish(keysplat(["report".as_ref(), empty.as_os_str()])).refused(&["metrics.json", "give the folder of a run"]);
    std::fs::write(empty.join("metrics.json"), "{\"sequence\": 3").unwrap();
    finish(keysplat(["report".as_ref(), empty.as_os_str()])).refused(&["metrics.json is not this version's", "keysplat eval"]);
}

/// What a page says of itself in a window of a given width.
const PROBE: &str = r#"<script>
const root = document.documentElement;
const thin = [...document.querySelectorAll(".plot svg, .pair, .card")].filter(e => e.getBoundingClientRect().width < 120).length;
const luminance = color => color.match(/[0-9.]+/g).slice(0, 3).reduce((sum, c) => sum + Number(c), 0);
const style = getComputedStyle(document.body);
document.querySelector("input[type=range]").value = 20;
document.querySelector("input[type=range]").dispatchEvent(new Event("input"));
parent.postMessage(JSON.stringify({
  width: innerWidth, overflow: root.scrollWidth - root.clientWidth, thin,
  paper: luminance(style.backgroundColor), ink: luminance(style.color),
  label: luminance(getComputedStyle(document.querySelector(".plot text")).fill),
  slider: document.querySelector(".pair").style.getPropertyValue("--at"),
}), "*");
</script></body>"#;

/// Shows the page in a frame, which may be narrower than any window, and keeps what it says.
fn frame(page: &Path, width: u32) -> PathBuf {
    let path = scratch().join(format!("frame-{width}.html"));
    let html = format!(
        "<body><script>onmessage = event => document.body.dataset.probe = event.data;</script>\
         <iframe src=\"file://{}\" style=\"width:{width}px;height:900px;border:0\"></iframe></body>",
        page.display()
    );
    std::fs::write(&path, html).unwrap();
    path
}

#[test]
fn chromium_shows_it_on_a_phone_and_on_a_desk_by_day_and_by_night() {
    if skipped_without_adapter() {
        return;
    }
    let Some(chromium) = chromium() else { return };
    let page = scratch().join("probed.html");
    std::fs::write(&page, std::fs::read_to_string(report()).unwrap().replace("</body>", PROBE)).unwrap();
    for (width, dark) in [(390, false), (390, true), (1400, false), (1400, true)] {
        let scheme = format!("--blink-settings=preferredColorScheme={}", if dark { 0 } else { 1 });
        let profile = format!("--user-data-dir={}", scratch().join("chromium").display());
        let output = Command::new(chromium)
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"])
            .args(["--disable-component-update", "--disable-sync", "--dump-dom", &scheme, &profile])
            .arg("--window-size=1500,1000")
            .arg(format!("file://{}", frame(&page, width).display()))
            .output()
            .unwrap();
        let dom = String::from_utf8_lossy(&output.stdout);
        let probe = dom.split("data-probe=\"").nth(1).and_then(|rest| rest.split('"').next()).unwrap_or_default();
        let probe: serde_json::Value =
            serde_json::from_str(&probe.replace("&quot;", "\"")).unwrap_or_else(|e| panic!("{e}: {dom}"));
        let number = |name: &str| probe[name].as_f64().unwrap_or_else(|| panic!("{name}: {probe}"));
        assert!(number("width") == f64::from(width), "{probe}");
        assert!(number("overflow") <= 0.0, "wider than a window of {width}: {probe}");
        assert!(number("thin") == 0.0, "{width}: {probe}");
        assert_eq!(probe["slider"], "20%", "{probe}");
        assert_eq!(number("paper") < number("ink"), dark, "{probe}");
        assert_eq!(number("paper") < number("label"), dark, "labels of plots: {probe}");
    }
}
