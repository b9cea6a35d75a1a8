//! The file's fields, the table's rows, and the statistics in both.

use super::*;

/// The example of the protocol, field for field, and what it leaves out: counts of real-time and resumed replays, the map's own colours.
const EXAMPLE: &str = r#"{ "sequence": "redkitchen", "sensor": "rgbd", "paced": false, "frames": 600, "frames_read_failed": 0,
  "frames_tracked": 600, "frames_late": 0, "keyframes_deferred": 0, "keyframes": 61,
  "ate_rmse_m": {"all_frames": 0.01, "keyframes": 0.01}, "rpe": {"trans_m_per_frame": 0.002, "rot_deg_per_frame": 0.1},
  "images": {"held_out":   {"count": 75, "psnr_db": 24.0, "ssim": 0.85, "depth_l1_m": 0.02},
             "held_out_map_colors": null,
             "all_frames": {"count": 600, "psnr_db": 24.5, "ssim": 0.86, "depth_l1_m": 0.02},
             "monogs":     {"count": 110, "psnr_db": 24.1, "ssim": 0.85, "depth_l1_m": 0.02}},
  "gaussians": 60000, "map_bytes": 3000000, "map_hash": "00ff",
  "wall_s": 90.0, "resumed": 0, "tracking_ms": {"median": 20.0, "p95": 30.0, "max": 50.0},
  "depth_bias": {"offset_per_m": 0.001, "tilt_x_per_m": 0.009, "tilt_y_per_m": -0.002}, "pixel_sigma": 0.8,
  "mapping": {"iterations": 1800, "iterations_per_frame": 3.0, "ms_per_iteration": {"median": 40.0, "p95": 60.0},
              "map_width": 320, "map_height": 240},
  "peak_host_bytes": 900000000, "peak_gpu_bytes": 200000000,
  "adapter": {"name": "llvmpipe", "backend": "vulkan", "kind": "cpu", "driver": "Mesa 22.3.6"},
  "cpu": "name", "threads": 2, "version": "0.1.0", "config_hash": "00ff" }"#;

#[test]
fn the_file_has_exactly_the_fields_of_the_protocol() {
    let metrics: Metrics = serde_json::from_str(EXAMPLE).unwrap();
    let expected: serde_json::Value = serde_json::from_str(EXAMPLE).unwrap();
    assert_eq!(serde_json::to_value(&metrics).unwrap(), expected);
}

#[test]
fn what_does_not_apply_is_null_and_not_left_out() {
    let mut metrics: Metrics = serde_json::from_str(EXAMPLE).unwrap();
    metrics.images.monogs = None;
    metrics.ate_rmse_m.keyframes = None;
    metrics.adapter = None;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.json");
    write_json(&metrics, &path).unwrap();
    let value: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for pointer in ["/images/monogs", "/ate_rmse_m/keyframes", "/adapter"] {
        assert_eq!(value.pointer(pointer), Some(&serde_json::Value::Null), "{pointer}");
    }
    assert_eq!(serde_json::from_value::<Metrics>(value).unwrap(), metrics);
}

#[test]
fn the_table_shows_lost_frames_and_interruptions_beside_the_figures() {
    let mut metrics: Metrics = serde_json::from_str(EXAMPLE).unwrap();
    assert!(metrics.to_string().contains("whole run             90.0 s\n"), "{metrics}");
    (metrics.frames_tracked, metrics.resumed) = (570, 2);
    metrics.images.held_out = None;
    let table = metrics.to_string();
    assert!(table.contains("ATE RMSE              1.00 cm   lost frames 5.0 %\n"), "{table}");
    assert!(table.contains("whole run             90.0 s   resumed 2×\n"), "{table}");
    assert!(table.contains("held-out images       –\n"), "{table}");
    let names = table.lines().filter_map(|line| line.split("PSNR").next().filter(|name| *name != line));
    assert!(names.clone().count() > 0 && names.clone().all(|name| name.ends_with(' ')), "{table}");
    assert!(table.contains("PSNR 24.50 dB   SSIM 0.8600   depth L1 2.00 cm   (600 images)\n"), "{table}");
}

#[test]
fn times_are_ranked() {
    let times: Vec<f64> = (1..=20).rev().map(f64::from).collect();
    assert_eq!(Times::of(&times), Some(Times { median: 10.5, p95: 19.0, max: 20.0 }));
    assert_eq!(Times::of(&[3.0]), Some(Times { median: 3.0, p95: 3.0, max: 3.0 }));
    assert_eq!(Times::of(&[]), None);
}

#[test]
fn means_leave_out_what_was_not_measured() {
    let mut means = ImageMeans::default();
    assert_eq!(means.figures(), None);
    means.add(20.0, 0.5, Some(0.1));
    means.add(30.0, 0.7, None);
    let figures = means.figures().unwrap();
    assert_eq!((figures.count, figures.psnr_db, figures.depth_l1_m), (2, Some(25.0), Some(0.1)));
    assert!((figures.ssim.unwrap() - 0.6).abs() < 1e-12, "{figures:?}");
    means.add(f64::INFINITY, 1.0, None);
    assert_eq!(means.figures().unwrap().psnr_db, None);
}

#[test]
fn the_hash_is_sha256() {
    // FIPS 180-2, appendix B.1.
    assert_eq!(sha256_hex(b"abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
}

#[test]
fn depth_is_averaged_over_the_images_that_have_it() {
    let mut means = ImageMeans::default();
    [Some(0.1), None, Some(0.4)].into_iter().for_each(|depth| means.add(20.0, 0.5, depth));
    assert_eq!(means.figures().unwrap().depth_l1_m, Some(0.25));
}

#[test]
fn the_table_shows_times_memory_and_adapter() {
    let metrics: Metrics = serde_json::from_str(EXAMPLE).unwrap();
    let table = metrics.to_string();
    for row in [
        "mapping               1800 iterations at 320x240, 3.00 per frame   median 40.0 ms   p95 60.0 ms\n",
        "peak memory           host 858.3 MiB   GPU 190.7 MiB\n",
        "adapter               llvmpipe (cpu, vulkan, Mesa 22.3.6)\n",
    ] {
        assert!(table.contains(row), "{table}");
    }
    assert_eq!(UsualTimes::of(&[1.0, 2.0, 4.0]), Some(UsualTimes { median: 2.0, p95: 4.0 }));
    assert_eq!(UsualTimes::of(&[]), None);
}
