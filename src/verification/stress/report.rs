//! What the suite found: rows of a table, failures, and the cases to look at again.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::{CaseId, Measured, Outcome, Part};

/// Failures of a family that are kept in words.
const KEPT_FAILURES: usize = 10;

/// One number over all cases of a family.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Name of the quantity, with unit.
    pub quantity: &'static str,
    /// Cases that gave this number, and those that were above its limit.
    pub cases: usize,
    /// Cases above the limit.
    pub failures: usize,
    /// Median over the cases.
    pub median: f64,
    /// 95th percentile over the cases.
    pub percentile_95: f64,
    /// Maximum over the cases.
    pub worst: f64,
    /// `None` where the number is only reported.
    pub limit: Option<f64>,
    /// Index of the worst case.
    pub worst_index: usize,
}

/// A case that failed, and why.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Failure {
    /// The failed case.
    pub case: CaseId,
    /// Reasons of the failure.
    pub what: Vec<String>,
}

/// Results of one family.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FamilyReport {
    /// The part.
    pub part: Part,
    /// Name of the family.
    pub name: String,
    /// Seed of the family.
    pub seed: u64,
    /// Cases run.
    pub cases: usize,
    /// Cases with anything wrong.
    pub failed: usize,
    /// Quantities measured.
    pub rows: Vec<Row>,
    /// Sums of what the cases counted.
    pub counts: BTreeMap<&'static str, u64>,
    /// First failures, in words.
    pub failures: Vec<Failure>,
}

/// Results of all families.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StressReport {
    /// All families that ran.
    pub families: Vec<FamilyReport>,
}

impl FamilyReport {
    /// Summarises outcomes in the order of their indices.
    pub(super) fn new(part: Part, name: &str, seed: u64, outcomes: &[Outcome]) -> Self {
        let mut quantities: Vec<&'static str> = Vec::new();
        let mut counts = BTreeMap::new();
        for outcome in outcomes {
            let unknown = |m: &&Measured| !quantities.contains(&m.quantity);
            let new: Vec<_> = outcome.measured.iter().filter(unknown).map(|m| m.quantity).collect();
            quantities.extend(new);
            outcome.counts.iter().for_each(|(what, number)| *counts.entry(*what).or_default() += number);
        }
        let case = |index| CaseId { part, family: name.into(), seed, index };
        let failures: Vec<Failure> = (outcomes.iter().enumerate())
            .map(|(index, outcome)| Failure { case: case(index), what: outcome.failures() })
            .filter(|failure| !failure.what.is_empty())
            .collect();
        Self {
            part,
            name: name.into(),
            seed,
            cases: outcomes.len(),
            failed: failures.len(),
            rows: quantities.iter().map(|quantity| Row::new(quantity, outcomes)).collect(),
            counts,
            failures: failures.into_iter().take(KEPT_FAILURES).collect(),
        }
    }

    /// The case nearest to a limit, or beyond it.
    pub fn worst(&self) -> Option<CaseId> {
        let share = |row: &&Row| row.worst / row.limit.unwrap_or(f64::INFINITY);
        let row = self.rows.iter().filter(|row| row.limit.is_some()).max_by(|a, b| share(a).total_cmp(&share(b)))?;
        Some(CaseId { part: self.part, family: self.name.clone(), seed: self.seed, index: row.worst_index })
    }
}

impl Row {
    fn new(quantity: &'static str, outcomes: &[Outcome]) -> Self {
        let of_case = |(index, outcome): (usize, &Outcome)| {
            outcome.measured.iter().filter(|m| m.quantity == quantity).map(|m| (*m, index)).collect::<Vec<_>>()
        };
        let mut all: Vec<(Measured, usize)> = outcomes.iter().enumerate().flat_map(of_case).collect();
        // NaN sorts last: it is the worst.
        all.sort_by(|a, b| a.0.value.abs().total_cmp(&b.0.value.abs()));
        let at = |share: f64| all[((all.len() - 1) as f64 * share).round() as usize];
        let (worst, worst_index) = at(1.0);
        Self {
            quantity,
            cases: all.len(),
            failures: all.iter().filter(|(m, _)| !m.is_within()).count(),
            median: at(0.5).0.value,
            percentile_95: at(0.95).0.value,
            worst: worst.value,
            limit: Some(worst.limit).filter(|limit| limit.is_finite()),
            worst_index,
        }
    }
}

impl StressReport {
    /// Cases of all families.
    pub fn cases(&self) -> usize {
        self.families.iter().map(|family| family.cases).sum()
    }

    /// Failed cases of all families.
    pub fn failed(&self) -> usize {
        self.families.iter().map(|family| family.failed).sum()
    }
}

impl fmt::Display for FamilyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts: Vec<String> = self.counts.iter().map(|(what, number)| format!("{what} {number}")).collect();
        writeln!(f, "{}: {} cases, {} failed   {}", self.name, self.cases, self.failed, counts.join(", "))?;
        for row in &self.rows {
            let limit = row.limit.map_or_else(String::new, |limit| format!("{limit:>10.1e}"));
            let Row { quantity, median, percentile_95, worst, .. } = row;
            writeln!(f, "  {quantity:<34}{median:>10.1e}{percentile_95:>10.1e}{worst:>10.1e}{limit}")?;
        }
        for failure in &self.failures {
            writeln!(f, "  FAILED case {}: {}", failure.case.index, failure.what.join("; "))?;
        }
        Ok(())
    }
}
