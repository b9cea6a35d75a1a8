//! `keysplat eval-mesh`: errors of a mesh against a true surface.

use std::path::PathBuf;

use clap::Args;
use keysplat::mesh::Mesh;
use keysplat::session::{MeshReport, MeshTruthOptions, evaluate_mesh};
use miette::IntoDiagnostic;

use super::{Verbosity, print};

#[derive(Args)]
pub struct EvalMeshArgs {
    /// Mesh, binary PLY.
    mesh: PathBuf,
    /// True surface, binary PLY; `keysplat generate --surface` writes that of a synthetic scene.
    #[arg(long)]
    truth: PathBuf,
    /// Folder of the run that the mesh is of: its trajectory leads the mesh to the truth's world, with scale for mono.
    #[arg(long)]
    run: Option<PathBuf>,
    /// The recording, where the folder does not name it or it has moved.
    #[arg(long, requires = "run")]
    sequence: Option<PathBuf>,
    /// Do not refine the alignment by ICP.
    #[arg(long)]
    no_icp: bool,
}

pub fn eval_mesh(args: &EvalMeshArgs, verbosity: Verbosity) -> miette::Result<()> {
    let (mesh, truth) = (Mesh::read(&args.mesh).into_diagnostic()?, Mesh::read(&args.truth).into_diagnostic()?);
    let options = MeshTruthOptions { run: args.run.clone(), sequence: args.sequence.clone(), refine: !args.no_icp };
    let report = evaluate_mesh(mesh, &truth, &options).into_diagnostic()?;
    if verbosity.json {
        print(&format!("{}\n", serde_json::to_string(&report).into_diagnostic()?))
    } else if verbosity.quiet {
        Ok(())
    } else {
        print(&text(&report))
    }
}

fn text(report: &MeshReport) -> String {
    let errors = &report.errors;
    let centimetres = |metres: f64| format!("{:.2} cm", 100.0 * metres);
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let mut lines = vec![
        ("accuracy".to_owned(), centimetres(errors.accuracy_m)),
        ("completion".to_owned(), centimetres(errors.completion_m)),
        ("completion < 5 cm".to_owned(), percent(errors.completion_ratio)),
    ];
    for share in &errors.shares {
        let of = format!("(precision {}, recall {})", percent(share.precision), percent(share.recall));
        let name = format!("F1 at {:.0} cm", 100.0 * share.within_m);
        lines.push((name, format!("{}   {of}", percent(share.f1))));
    }
    if let Some(depth) = &report.depth {
        lines.push((
            "depth L1".to_owned(),
            format!("{}   ({} views, {} seen)", centimetres(depth.depth_l1_m), depth.views, percent(depth.seen_share)),
        ));
    }
    if let Some(by) = report.refined_by_m {
        lines.push(("moved by ICP".to_owned(), centimetres(by)));
    }
    lines.into_iter().map(|(name, value)| format!("{name:<20}  {value}\n")).collect()
}
