//! Thousands of made-up cases, most of them nasty, each checked against what is known of it: random and degenerate scenes through the
//! rasterizer (against the f64 oracle) and through training, ill-conditioned geometry through the tracker's solvers (against the truth and
//! what the noise explains), a long optimisation, and moved or rescaled worlds.
//!
//! A case is known by its family, its index and the suite's seed, and can be run again alone. Left out: recordings; `tests/` has these.

mod equivariance;
mod geometry;
mod long;
mod machine;
mod maps;
mod rasterizer;
mod report;
mod scenes;
mod training;
mod views;

use std::panic::{AssertUnwindSafe, catch_unwind};

use fastrand::Rng;
use serde::{Deserialize, Serialize};

pub use machine::Machine;
pub use report::{Failure, FamilyReport, Row, StressReport};

use crate::gpu::GpuError;

/// Part of the stress test.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// Forward and backward pass against the oracle, and 200 steps of Adam for a share of the scenes.
    Rasterizer,
    /// Pose, two views, triangulation, bundle adjustment, alignment and pose graph against the truth.
    Tracker,
    /// Many steps on one small scene.
    Long,
    /// The same world elsewhere, turned or of another size.
    Equivariance,
}

impl Part {
    /// All parts, in the order in which they run.
    pub const ALL: [Self; 4] = [Self::Rasterizer, Self::Tracker, Self::Long, Self::Equivariance];
}

/// How much is tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StressConfig {
    /// Cases of each family; families that take long get a share of these, and at least one.
    pub cases: usize,
    /// Seed of the random cases.
    pub seed: u64,
    /// One part alone.
    pub only: Option<Part>,
    /// Steps of the long run.
    pub long_steps: usize,
}

/// Which case of which family, so that it can be run again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaseId {
    /// The part.
    pub part: Part,
    /// Name of the family.
    pub family: String,
    /// Seed of the family.
    pub seed: u64,
    /// Index of the case.
    pub index: usize,
}

/// A number that a case gave, and up to where it is right.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Measured {
    /// Name of the quantity, with unit.
    pub quantity: &'static str,
    /// The measured value.
    pub value: f64,
    /// Infinite where the number is only reported.
    pub limit: f64,
}

/// Result of a case.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Outcome {
    /// Quantities with their limits.
    pub measured: Vec<Measured>,
    /// Things counted, summed up over a family.
    pub counts: Vec<(&'static str, u64)>,
    /// Violated invariants, in words.
    pub faults: Vec<String>,
}

impl Measured {
    /// A NaN is above every limit.
    fn is_within(&self) -> bool {
        self.value <= self.limit
    }
}

impl Outcome {
    /// Notes a number that must be at most `limit`.
    fn measure(&mut self, quantity: &'static str, value: f64, limit: f64) {
        self.measured.push(Measured { quantity, value, limit });
    }

    /// Notes a number that has no limit.
    fn note(&mut self, quantity: &'static str, value: f64) {
        self.measure(quantity, value, f64::INFINITY);
    }

    fn count(&mut self, what: &'static str, number: usize) {
        self.counts.push((what, number as u64));
    }

    fn require(&mut self, holds: bool, otherwise: impl FnOnce() -> String) {
        if !holds {
            self.faults.push(otherwise());
        }
    }

    /// All that is wrong.
    pub fn failures(&self) -> Vec<String> {
        let over = self.measured.iter().filter(|m| !m.is_within());
        let words = over.map(|m| format!("{} is {:.3e}, above {:.1e}", m.quantity, m.value, m.limit));
        self.faults.iter().cloned().chain(words).collect()
    }
}

type CaseFn<'a> = Box<dyn Fn(&mut Rng) -> Result<Outcome, GpuError> + 'a>;

/// Cases of one kind.
struct Family<'a> {
    part: Part,
    name: String,
    /// One case in so many.
    every: usize,
    case: CaseFn<'a>,
}

impl<'a> Family<'a> {
    fn new(part: Part, name: impl Into<String>, every: usize, case: impl Fn(&mut Rng) -> Result<Outcome, GpuError> + 'a) -> Self {
        Self { part, name: name.into(), every, case: Box::new(case) }
    }

    /// Runs a case; a panic is its outcome too.
    fn run(&self, seed: u64, index: usize) -> Result<Outcome, GpuError> {
        let mut rng = Rng::with_seed(case_seed(seed, &self.name, index));
        catch_unwind(AssertUnwindSafe(|| (self.case)(&mut rng))).unwrap_or_else(|panic| {
            let words = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
            Ok(Outcome { faults: vec![format!("it panicked: {}", words.unwrap_or("?"))], ..Outcome::default() })
        })
    }
}

/// FNV-1a over all that names a case.
fn case_seed(seed: u64, family: &str, index: usize) -> u64 {
    let bytes = seed.to_le_bytes().into_iter().chain(family.bytes()).chain((index as u64).to_le_bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn families<'a>(machine: Option<&'a Machine>, config: &StressConfig) -> Vec<Family<'a>> {
    let long_steps = config.long_steps;
    let on_gpu = machine.into_iter().flat_map(|machine| {
        [
            rasterizer::families(machine),
            training::families(machine),
            long::families(machine, long_steps),
            equivariance::families(machine),
        ]
    });
    let mut all: Vec<Family<'a>> = on_gpu.flatten().chain(views::families()).chain(maps::families()).collect();
    all.retain(|family| config.only.is_none_or(|only| family.part == only));
    all
}

/// Runs all families; `done` hears of each when it has ended. Without a machine, what needs one is left out.
///
/// # Errors
/// [`GpuError`] if the adapter gives up.
pub fn run(
    machine: Option<&Machine>,
    config: &StressConfig,
    mut done: impl FnMut(&FamilyReport),
) -> Result<StressReport, GpuError> {
    let mut report = StressReport::default();
    for family in families(machine, config) {
        let mut outcomes = Vec::new();
        for index in 0..config.cases.div_ceil(family.every) {
            outcomes.push(family.run(config.seed, index)?);
        }
        let family = FamilyReport::new(family.part, &family.name, config.seed, &outcomes);
        done(&family);
        report.families.push(family);
    }
    Ok(report)
}

/// Runs one case again; `None` if there is no such family.
///
/// # Errors
/// [`GpuError`] if the adapter gives up.
pub fn replay(machine: Option<&Machine>, config: &StressConfig, case: &CaseId) -> Result<Option<Outcome>, GpuError> {
    let config = StressConfig { only: Some(case.part), ..*config };
    let family = families(machine, &config).into_iter().find(|family| family.name == case.family);
    family.map(|family| family.run(case.seed, case.index)).transpose()
}
