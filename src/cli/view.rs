//! `keysplat view`, and the view of a run (`--view`).

use std::io::IsTerminal;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use keysplat::pipeline::KeptMapper;
use keysplat::viewing::{DEFAULT_ADDRESS, Finished, Live, Server, ServerOptions};
use keysplat::{Progress, Session};
use miette::IntoDiagnostic;

use super::{Verbosity, print, signals};

/// A run that is over is served for so long after its last viewer: a page that was reloaded is back by then.
const GONE_AFTER: Duration = Duration::from_secs(3);
const LOOK_EVERY: Duration = Duration::from_millis(100);

#[derive(Args)]
pub struct ViewArgs {
    /// Folder of a run, or a map such as map.ply.
    path: PathBuf,
    /// Address to serve at, e.g. 0.0.0.0:7007 for viewers on other machines.
    #[arg(long, value_name = "ADDR:PORT", value_parser = parse_address)]
    at: Option<SocketAddr>,
    /// Only print the address.
    #[arg(long)]
    no_browser: bool,
}

/// An address with a port, a port of this machine, or an address with the default port.
pub fn parse_address(text: &str) -> Result<SocketAddr, String> {
    let port = || text.parse::<u16>().ok().map(|port| SocketAddr::new(DEFAULT_ADDRESS.ip(), port));
    let host = || text.parse::<IpAddr>().ok().map(|ip| SocketAddr::new(ip, DEFAULT_ADDRESS.port()));
    text.parse()
        .ok()
        .or_else(port)
        .or_else(host)
        .ok_or_else(|| format!("`{text}` is no address; write 127.0.0.1:7007, or 0.0.0.0:7007 for viewers on other machines"))
}

pub fn view(args: &ViewArgs, verbosity: Verbosity) -> miette::Result<()> {
    let finished = Finished::open(&args.path).into_diagnostic()?;
    let options = ServerOptions { address: args.at, ..ServerOptions::default() };
    let server = Server::start(options, finished.board(), finished.desk()).into_diagnostic()?;
    let (send, ended) = std::sync::mpsc::channel();
    let end = move || {
        let _ = send.send(());
    };
    signals::on_end(end).into_diagnostic()?;
    announce(&server, !args.no_browser, verbosity)?;
    // An error means that no Ctrl-C can come any more.
    let _ = ended.recv();
    Ok(())
}

/// Whether and where a run is shown.
#[derive(Args, Clone, Default)]
pub struct ViewOptions {
    /// Show the run in a browser, at http://127.0.0.1:7007 or the given address; 0.0.0.0:7007 is for viewers on other machines.
    #[arg(long, value_name = "ADDR:PORT", num_args = 0..=1, require_equals = true, value_parser = parse_address)]
    view: Option<Option<SocketAddr>>,
    /// With --view: viewers on other machines may pause and finish the run, too.
    #[arg(long, requires = "view")]
    view_control: bool,
}

/// A run that is shown.
pub struct Viewed {
    // Dropped before what it serves.
    _server: Server,
    live: Live,
}

impl ViewOptions {
    /// Shows a session's run, if that is wanted.
    pub fn start(&self, session: &Session, progress: &Progress, verbosity: Verbosity) -> miette::Result<Option<Viewed>> {
        let Some(address) = self.view else { return Ok(None) };
        progress.control().keep_mapper();
        let live = Live::start(session.shared_recording(), progress.clone()).into_diagnostic()?;
        let options = ServerOptions { address, remote_control: self.view_control };
        let server = Server::start(options, live.board(), live.desk()).into_diagnostic()?;
        announce(&server, true, verbosity)?;
        Ok(Some(Viewed { _server: server, live }))
    }
}

impl Viewed {
    /// The map is finished and is being measured.
    pub fn measuring(&self) {
        self.live.measuring();
    }

    /// The refinement goes on after the run's end.
    pub fn refining(&self) {
        self.live.refining();
    }

    /// Serves a run that is over for as long as somebody looks, or until Ctrl-C; whether a viewer wants the refinement to go on.
    pub fn wants_more(&self, progress: &Progress, mut kept: Option<&mut KeptMapper>) -> bool {
        self.live.done();
        let control = progress.control();
        if !self.live.was_watched() {
            return false;
        }
        tracing::info!("all results are written; the view stays open while somebody looks, or until Ctrl-C");
        let mut last_seen = Instant::now();
        while last_seen.elapsed() < GONE_AFTER && !control.is_interrupted() {
            if control.refines_on() {
                control.restart();
                return true;
            }
            if let Some(kept) = &mut kept {
                kept.attend(progress);
            }
            if self.live.viewers() > 0 {
                last_seen = Instant::now();
            }
            std::thread::sleep(LOOK_EVERY);
        }
        false
    }
}

/// Prints the address of a view, and opens it where there is a browser.
pub fn announce(server: &Server, opens_browser: bool, verbosity: Verbosity) -> miette::Result<()> {
    let url = server.url();
    if verbosity.json {
        tracing::info!(url, "the view");
    } else {
        print(&format!("The view is at {url}\n"))?;
    }
    if opens_browser && has_browser() && verbosity.shows_progress() && open::that_detached(&url).is_err() {
        tracing::info!("open the address in a browser");
    }
    Ok(())
}

/// Whether there is a desktop that somebody sits at.
fn has_browser() -> bool {
    let is_set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let has_desktop = cfg!(any(target_os = "macos", windows)) || is_set("DISPLAY") || is_set("WAYLAND_DISPLAY");
    has_desktop && !is_set("SSH_CONNECTION") && std::io::stdout().is_terminal()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_may_be_short() {
        let parsed = |text: &str| parse_address(text).map(|address| address.to_string());
        assert_eq!(parsed("0.0.0.0:80").as_deref(), Ok("0.0.0.0:80"));
        assert_eq!(parsed("8080").as_deref(), Ok("127.0.0.1:8080"));
        assert_eq!(parsed("0.0.0.0").as_deref(), Ok("0.0.0.0:7007"));
        assert_eq!(parsed("[::1]:90").as_deref(), Ok("[::1]:90"));
        assert!(["", "localhost", "1.2.3.4:99999", ":80"].iter().all(|text| parse_address(text).is_err()));
    }
}
