//! Signals that end a command: Ctrl-C, and on Unix SIGTERM, which service managers and containers send first.

/// Calls `act` at each of these signals from now on, in a thread of its own.
#[cfg(unix)]
pub fn on_end(mut act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM])?;
    let heed = move || signals.forever().for_each(|_signal| act());
    std::thread::Builder::new().name("signals".into()).spawn(heed).map(drop)
}

/// Calls `act` at each Ctrl-C from now on, in a thread of its own.
#[cfg(not(unix))]
pub fn on_end(act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    ctrlc::set_handler(act).map_err(std::io::Error::other)
}
