//! A little of `keysplat stress`: some cases of each family, none of which may fail. Those on the GPU say so loudly and pass where there is
//! no adapter.

use crate::common::requirements::skip;
use keysplat::verification::stress::{self, CaseId, Machine, Part, StressConfig, StressReport};

fn run(machine: Option<&Machine>, only: Part, cases: usize) -> StressReport {
    let config = StressConfig { cases, seed: 7, only: Some(only), long_steps: 800 };
    let report = stress::run(machine, &config, |_| ()).unwrap();
    assert!(report.families.len() >= if only == Part::Long { 1 } else { 5 });
    let wrong: Vec<String> = report.families.iter().filter(|f| f.failed > 0).map(ToString::to_string).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    report
}

fn machine() -> Option<Machine> {
    Machine::open(None).inspect_err(|error| skip("adapter", &error.to_string())).ok()
}

#[test]
fn scenes_of_every_family_are_rendered_and_trained_rightly() {
    let Some(machine) = machine() else { return };
    let report = run(Some(&machine), Part::Rasterizer, 6);
    // Most pixels are judged, or the suite says little.
    for family in report.families.iter().filter(|f| f.name.starts_with("render")) {
        let (pixels, left_out) = (family.counts["pixels"], family.counts["left out"]);
        assert!(2 * left_out < pixels || family.name.contains("needles"), "{}: {left_out} of {pixels} left out", family.name);
    }
}

#[test]
fn the_solvers_are_right_or_refuse() {
    let report = run(None, Part::Tracker, 20);
    let refused = |name: &str| {
        let family = report.families.iter().find(|f| f.name == name).unwrap();
        (family.counts.get("refused").copied().unwrap_or(0), family.cases as u64)
    };
    for nothing in ["two views: mere turn", "two views: mere turn, 40% outliers", "two views: nothing moved", "two views: chance"]
    {
        let (refused, cases) = refused(nothing);
        assert_eq!(refused, cases, "{nothing}");
    }
    for something in ["two views: volume", "pose: 10 km away", "bundle: size 1e3", "triangulation: 2°, size 1e-3"] {
        assert_eq!(refused(something).0, 0, "{something}");
    }
}

#[test]
fn many_steps_do_not_wander_off() {
    let Some(machine) = machine() else { return };
    run(Some(&machine), Part::Long, 1);
}

#[test]
fn a_moved_world_gives_the_moved_map() {
    let Some(machine) = machine() else { return };
    run(Some(&machine), Part::Equivariance, 20);
}

#[test]
fn a_case_can_be_run_again() {
    let config = StressConfig { cases: 1, seed: 0, only: None, long_steps: 0 };
    let case = |family: &str| CaseId { part: Part::Tracker, family: family.into(), seed: 5, index: 3 };
    let outcome = stress::replay(None, &config, &case("pose: plane")).unwrap().unwrap();
    assert_eq!(stress::replay(None, &config, &case("pose: plane")).unwrap().unwrap(), outcome);
    assert!(!outcome.measured.is_empty() && outcome.failures().is_empty());
    assert!(stress::replay(None, &config, &case("no such family")).unwrap().is_none());
}
