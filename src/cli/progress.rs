//! Progress bars on standard error, and an early end.

use indicatif::{ProgressBar, ProgressStyle};
use keysplat::Progress;
use miette::IntoDiagnostic;

use super::keys::Keys;
use super::{Verbosity, signals};

/// A bar in the given template; hidden where nothing should be shown.
pub fn bar(verbosity: Verbosity, len: u64, template: &str) -> ProgressBar {
    if !verbosity.shows_progress() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(template).expect("our templates are valid");
    ProgressBar::new(len).with_style(style)
}

/// A bar without an end in the given template; hidden where nothing should be shown.
pub fn spinner(verbosity: Verbosity, template: &str) -> ProgressBar {
    if !verbosity.shows_progress() {
        return ProgressBar::hidden();
    }
    ProgressBar::new_spinner().with_style(ProgressStyle::with_template(template).expect("our templates are valid"))
}

/// The first signal ends the replay and writes the results so far, the second ends the program.
pub fn stop_on_signals(progress: &Progress) -> miette::Result<()> {
    let progress = progress.clone();
    signals::on_end(move || {
        if progress.control().interrupt() {
            Keys::restore();
            std::process::exit(130);
        }
        tracing::warn!("finishing with what there is; press Ctrl-C again to quit at once");
    })
    .into_diagnostic()
}
