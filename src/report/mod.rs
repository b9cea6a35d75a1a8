//! `keysplat report`: a run's folder as one HTML file that needs nothing else, no network either.

pub mod curves;
mod page;
mod plots;
pub mod replays;
pub mod sweep;

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::evaluation::{Comparison, Metrics};
use crate::files::{WriteError, write_atomically};
use crate::run_folder::{History, outputs};

/// The report's name in the run's folder.
pub const REPORT: &str = "report.html";

/// Distinct names, in the order of their first row.
fn names<T>(rows: &[T], of: impl Fn(&T) -> &str) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for row in rows {
        if !names.contains(&of(row)) {
            names.push(of(row));
        }
    }
    names
}

/// A cell of text in a CSV file.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

/// A report that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file of the run cannot be read.
    #[error("cannot read {path}: {source}; give the folder of a run, with metrics.json in it")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file of the run is not what the program writes.
    #[error("{path} is not this version's ({source}); `keysplat eval` writes metrics.json and comparison.json anew")]
    Parse {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: serde_json::Error,
    },
    /// The drawing library failed.
    #[error("cannot draw: {0}; please report this")]
    Drawing(String),
    /// The page cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Files of a run that the report shows.
struct Run {
    folder: PathBuf,
    metrics: Metrics,
    /// Only runs of ours have one.
    history: Option<History>,
    comparison: Option<Comparison>,
    config: Option<String>,
}

/// Writes the report of the run in `folder` and returns its path.
///
/// # Errors
/// Where `metrics.json` is missing, or a file is not what it should be, or the report cannot be written.
pub fn write(folder: &Path) -> Result<PathBuf, ReportError> {
    let metrics_path = folder.join(outputs::METRICS);
    let metrics = read(&metrics_path)?.ok_or_else(|| ReportError::Read {
        path: metrics_path,
        source: std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such file"),
    })?;
    let run = Run {
        folder: folder.into(),
        metrics,
        history: read(&folder.join(outputs::HISTORY))?,
        comparison: read(&folder.join(outputs::COMPARISON))?,
        config: std::fs::read_to_string(folder.join(outputs::CONFIG)).ok(),
    };
    let path = folder.join(REPORT);
    write_atomically(&path, page::html(&run)?.as_bytes())?;
    Ok(path)
}

/// `None` where there is no such file.
fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, ReportError> {
    match std::fs::read(path) {
        Ok(text) => serde_json::from_slice(&text).map(Some).map_err(|source| ReportError::Parse { path: path.into(), source }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(ReportError::Read { path: path.into(), source }),
    }
}
