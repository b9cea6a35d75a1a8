//! Our trajectory errors are those of the Python package evo (1.38.1): `evo_ape` and `evo_rpe --delta 1 --delta_unit f`, run once
//! on the made-up trajectories in `fixtures/evo`. `rgbd`: truth at every 4th frame, partial overlap, jittered stamps, lost frames.
//! `mono`: another scale, and truth denser than the estimate at stamps of its own, up to 15 ms off.

use std::path::Path;

use keysplat::evaluation::trajectory::{Alignment, evaluate_trajectory};
use keysplat::geometry::Trajectory;

#[derive(serde::Deserialize)]
struct Reference {
    name: String,
    arguments: String,
    pairs: usize,
    ape_rmse_m: f64,
    ape_max_m: f64,
    rpe_trans_rmse_m: f64,
    rpe_rot_rmse_deg: f64,
}

#[test]
fn figures_are_those_of_evo() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/evo");
    let references: Vec<Reference> = serde_json::from_slice(&std::fs::read(folder.join("evo.json")).unwrap()).unwrap();
    assert_eq!(references.len(), 2);
    for reference in references {
        let read = |what: &str| Trajectory::read_tum(&folder.join(format!("{}_{what}.txt", reference.name))).unwrap();
        let alignment = if reference.arguments.starts_with("-as ") { Alignment::Similarity } else { Alignment::Rigid };
        let errors = evaluate_trajectory(&read("truth"), &read("estimate"), alignment).unwrap();
        assert_eq!(errors.pairs, reference.pairs, "{}", reference.name);
        for (what, ours, theirs) in [
            ("APE RMSE", errors.ate_rmse_m, reference.ape_rmse_m),
            ("APE max", errors.ate_max_m, reference.ape_max_m),
            ("RPE translation", errors.rpe.trans_m_per_step, reference.rpe_trans_rmse_m),
            ("RPE rotation", errors.rpe.rot_deg_per_step, reference.rpe_rot_rmse_deg),
        ] {
            assert!((ours - theirs).abs() < 1e-9, "{} {what}: {ours} here, {theirs} in evo", reference.name);
        }
    }
}
