//! The server of the page and its messages: one thread, bounded connections, sizes, times and rates. Nobody gets in without the token.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::extract::{Extension, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::middleware::map_response;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, oneshot};
use tokio::time::timeout;

use super::board::Board;
use super::error::ViewError;
use super::protocol::{Command, MOST_FROM_VIEWER, Outgoing, RenderRequest};
use super::{connection, page, pictures};
use crate::render::Rendered;
use crate::sequence::RectifiedImage;
use crate::splat::ViewCamera;

/// Where a view is served unless an address is given.
pub const DEFAULT_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7007);

/// Connections at a time; more are closed at once.
const MOST_CONNECTIONS: usize = 64;
/// Viewers at a time.
const MOST_VIEWERS: usize = 16;
/// A request's header has to be there after this time,
const HEADER_TIME: Duration = Duration::from_secs(5);
/// and its answer taken after this time.
const ANSWER_TIME: Duration = Duration::from_secs(60);
/// Threads that load images and wait for renders.
const BLOCKING_THREADS: usize = 2;
/// Answers under way for all viewers together.
const MOST_ANSWERS: usize = 8;
const TOKEN_BYTES: usize = 16;

/// What answers requests of viewers. The calls may block.
pub trait Desk: Send + Sync {
    /// A keyframe's frame and its recorded image, rectified.
    ///
    /// # Errors
    /// Why there is none, for the viewer.
    fn recorded(&self, id: usize) -> Result<(usize, RectifiedImage), String>;

    /// The map, rendered.
    ///
    /// # Errors
    /// Why it is not, for the viewer.
    fn draw(&self, camera: &ViewCamera) -> Result<Rendered, String>;

    /// Does what a viewer with control wants.
    fn control(&self, command: Command);

    /// The message of a keyframe's recorded image.
    ///
    /// # Errors
    /// Why there is none, for the viewer.
    fn keyframe(&self, id: usize) -> Result<Outgoing, String> {
        let (frame, image) = self.recorded(id)?;
        pictures::recorded(&image, id, frame)
    }

    /// The message of a picture of the map.
    ///
    /// # Errors
    /// Why there is none, for the viewer.
    fn render(&self, request: &RenderRequest) -> Result<Outgoing, String> {
        let (pinhole, world_from_camera) = request.camera().ok_or("a picture has 16 to 1920 pixels along a side, and a pose")?;
        let camera = ViewCamera { pinhole, camera_from_world: world_from_camera.inverse() };
        let recorded = request.id.map(|id| self.recorded(id)).transpose()?.map(|(_, image)| image.color);
        pictures::rendered(&self.draw(&camera)?, request, recorded.as_ref())
    }
}

/// Where and for whom a view is served.
#[derive(Clone, Copy, Debug, Default)]
pub struct ServerOptions {
    /// Address to listen at; without one [`DEFAULT_ADDRESS`], or any free port of this machine where that is taken.
    pub address: Option<SocketAddr>,
    /// Whether viewers on other machines have control too.
    pub remote_control: bool,
}

/// A running server; it ends when this is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    token: String,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

pub(super) struct Service {
    pub board: Arc<Board>,
    pub desk: Arc<dyn Desk>,
    pub remote_control: bool,
    token: String,
    page: String,
    viewers: AtomicUsize,
    /// For answers under way, of all viewers.
    pub answers: Arc<Semaphore>,
}

/// Whether a connection comes from this machine.
#[derive(Clone, Copy)]
struct Peer {
    is_local: bool,
}

impl Server {
    /// Serves a board.
    ///
    /// # Errors
    /// [`ViewError`] if the address is taken, or the system gives no thread.
    pub fn start(options: ServerOptions, board: Arc<Board>, desk: Arc<dyn Desk>) -> Result<Self, ViewError> {
        let listener = listen(options.address)?;
        let address = listener.local_addr().map_err(ViewError::Start)?;
        let token = token().map_err(ViewError::Start)?;
        let service = Service {
            page: page::standalone(&board.hello.name),
            token: token.clone(),
            board,
            desk,
            remote_control: options.remote_control,
            viewers: AtomicUsize::new(0),
            answers: Arc::new(Semaphore::new(MOST_ANSWERS)),
        };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(BLOCKING_THREADS)
            .build()
            .map_err(ViewError::Start)?;
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("viewing".into()).spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    () = accept(listener, Arc::new(service)) => {}
                    _ = stopped => {}
                }
            });
            runtime.shutdown_background();
        });
        Ok(Self { address, token, stop: Some(stop), thread: Some(thread.map_err(ViewError::Start)?) })
    }

    /// The address that it listens at.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its page, with the token. An unspecified address stands for this machine.
    pub fn url(&self) -> String {
        let host = match self.address.ip() {
            ip if ip.is_unspecified() => "localhost".into(),
            IpAddr::V6(ip) => format!("[{ip}]"),
            IpAddr::V4(ip) => ip.to_string(),
        };
        format!("http://{host}:{}/?token={}", self.address.port(), self.token)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.take();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn listen(address: Option<SocketAddr>) -> Result<std::net::TcpListener, ViewError> {
    let bind = |address: SocketAddr| {
        let listener = std::net::TcpListener::bind(address).map_err(|source| ViewError::Listen { address, source })?;
        listener.set_nonblocking(true).map_err(ViewError::Start)?;
        Ok(listener)
    };
    match address {
        Some(address) => bind(address),
        None => bind(DEFAULT_ADDRESS).or_else(|_| bind(SocketAddr::new(DEFAULT_ADDRESS.ip(), 0))),
    }
}

fn token() -> io::Result<String> {
    let mut bytes = [0u8; TOKEN_BYTES];
    getrandom::fill(&mut bytes).map_err(|error| io::Error::other(error.to_string()))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

async fn accept(listener: std::net::TcpListener, service: Arc<Service>) {
    let listener = match TcpListener::from_std(listener) {
        Ok(listener) => listener,
        Err(error) => {
            tracing::warn!("the view cannot be served: {error}");
            return;
        }
    };
    let router =
        Router::new().route("/", get(page_of)).route("/live", get(live)).with_state(service).layer(map_response(last_answer));
    let room = Arc::new(Semaphore::new(MOST_CONNECTIONS));
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // No descriptors are left, say.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let Ok(permit) = room.clone().try_acquire_owned() else { continue };
        let _ = stream.set_nodelay(true);
        let peer = Peer { is_local: peer.ip().to_canonical().is_loopback() };
        let answer = TowerToHyperService::new(router.clone().layer(Extension(peer)));
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(HEADER_TIME);
            let connection = http.serve_connection(TokioIo::new(stream), answer).with_upgrades();
            let _ = timeout(ANSWER_TIME, connection).await;
            drop(permit);
        });
    }
}

async fn page_of(State(service): State<Arc<Service>>, uri: Uri) -> Response {
    if !service.admits(&uri) {
        return refusal("open the address that keysplat printed, with its token");
    }
    let headers = [
        (header::CONTENT_SECURITY_POLICY, page::POLICY),
        (header::CACHE_CONTROL, "no-store"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
    ];
    (headers, Html(service.page.clone())).into_response()
}

async fn live(
    State(service): State<Arc<Service>>,
    Extension(peer): Extension<Peer>,
    uri: Uri,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    if !service.admits(&uri) {
        return refusal("the token is missing or wrong");
    }
    if !is_of_our_page(&headers) {
        return refusal("another site's page may not connect");
    }
    let Some(seat) = Seat::take(&service) else {
        return (StatusCode::SERVICE_UNAVAILABLE, "there are too many viewers").into_response();
    };
    let upgrade = upgrade.max_message_size(MOST_FROM_VIEWER).max_frame_size(MOST_FROM_VIEWER);
    upgrade.on_upgrade(move |socket| async move {
        let control = service.board.hello.control && (peer.is_local || service.remote_control);
        connection::attend(socket, &service, control).await;
        drop(seat);
    })
}

/// A connection has one answer, unless it becomes a socket.
async fn last_answer(mut answer: Response) -> Response {
    if answer.status() != StatusCode::SWITCHING_PROTOCOLS {
        answer.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    answer
}

fn refusal(why: &'static str) -> Response {
    (StatusCode::FORBIDDEN, why).into_response()
}

/// Browsers name the page that opens a socket; it has to be of the host that the socket is opened at.
fn is_of_our_page(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).map(|value| value.to_str().unwrap_or_default());
    let Some(origin) = text(header::ORIGIN) else { return true };
    let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
    authority.is_some() && authority == text(header::HOST)
}

impl Service {
    fn admits(&self, uri: &Uri) -> bool {
        let given = uri.query().and_then(|query| query.split('&').find_map(|pair| pair.strip_prefix("token=")));
        given.is_some_and(|given| is_equal(given.as_bytes(), self.token.as_bytes()))
    }
}

/// Takes as long for every difference.
fn is_equal(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(0, |differences, (a, b)| differences | (a ^ b)) == 0
}

/// One of the places for viewers, given back when dropped.
struct Seat(Arc<Service>);

impl Seat {
    fn take(service: &Arc<Service>) -> Option<Self> {
        let taken = service.viewers.fetch_add(1, Ordering::Relaxed);
        let seat = Self(service.clone());
        (taken < MOST_VIEWERS).then_some(seat)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.0.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}
