//! What a sweep's rows become.

use super::*;

fn row(variant: &str, seed: u64, wall_s: f64, psnr_db: f64) -> SweepRow {
    SweepRow {
        sequence: "room".into(),
        variant: variant.into(),
        seed,
        frames: 10,
        frames_tracked: 10,
        wall_s,
        ate_rmse_m: None,
        psnr_db: Some(psnr_db),
        ssim: None,
        depth_l1_m: None,
        gaussians: Some(1000),
        iterations: None,
        peak_host_bytes: None,
        map_hash: None,
    }
}

#[test]
fn seeds_become_a_median_with_its_spread() {
    let rows = [row("b", 0, 10.0, 30.0), row("a", 0, 20.0, 31.0), row("b", 1, 14.0, 28.0), row("b", 2, 11.0, 31.0)];
    let points = points(&rows);
    assert_eq!(points.iter().map(|p| (p.variant.as_str(), p.runs)).collect::<Vec<_>>(), [("b", 3), ("a", 1)]);
    assert_eq!(points[0].wall_s, Spread { median: 11.0, least: 10.0, most: 14.0 });
    assert_eq!(points[0].psnr_db, Some(Spread { median: 30.0, least: 28.0, most: 31.0 }));
    assert_eq!(points[0].ate_cm, None);
}

#[test]
fn the_front_is_what_nobody_undercuts() {
    let front = pareto(&[(1.0, 9.0), (2.0, 5.0), (3.0, 6.0), (4.0, 1.0), (4.0, 1.0), (5.0, 1.0)]);
    assert_eq!(front, [true, true, false, true, true, false]);
}

#[test]
fn only_what_exceeds_the_spread_counts_as_a_change() {
    let before = [row("a", 0, 10.0, 30.0), row("a", 1, 13.0, 30.5), row("gone", 0, 1.0, 1.0)];
    let after = [row("a", 0, 12.0, 28.0), row("a", 1, 20.0, 28.5), row("new", 0, 1.0, 1.0)];
    let changes = compare(&before, &after);
    let of = |figure| changes.iter().find(|c| c.figure == figure).map(|c| c.verdict);
    assert_eq!(of(Figure::Time), Some(Verdict::Same), "the ranges overlap");
    assert_eq!(of(Figure::Psnr), Some(Verdict::Worse));
    assert_eq!(of(Figure::Gaussians), Some(Verdict::Same));
    assert_eq!(of(Figure::Ate), None);
    assert_eq!(compare(&after, &before).iter().find(|c| c.figure == Figure::Psnr).map(|c| c.verdict), Some(Verdict::Better));
}

#[test]
fn csv_has_a_cell_for_each_name() {
    let csv = to_csv(&[row("a, \"b\"", 0, 1.5, 30.0)]);
    let [header, line] = csv.lines().collect::<Vec<_>>()[..] else { panic!("{csv}") };
    assert!(line.starts_with("\"room\",\"a, \"\"b\"\"\",0,10,10,1.5,,30,,,1000,"));
    assert_eq!(header.split(',').count(), line.replace("a, ", "a").split(',').count());
}
