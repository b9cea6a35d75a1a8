//! One viewer's connection: sends what is new when there is room, and answers requests.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use axum::extract::ws::{Message, WebSocket};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};

use super::board::Board;
use super::delivery::Delivery;
use super::protocol::{FromViewer, Hello, Outgoing, ToViewer};
use super::server::Service;

/// A viewer that takes or sends nothing for this long is gone.
const PATIENCE: Duration = Duration::from_secs(30);
const PING_EVERY: Duration = Duration::from_secs(10);
/// Messages of a viewer in a second.
const MOST_PER_SECOND: usize = 100;
/// Messages that are in no table.
const MOST_BAD: usize = 10;
/// Answers under way for one viewer.
const MOST_ANSWERS: usize = 2;

/// Attends to a viewer until it leaves, or misbehaves.
pub(super) async fn attend(mut socket: WebSocket, service: &Arc<Service>, control: bool) {
    let board = &service.board;
    let mut changed = board.subscribe();
    let mut pings = interval(PING_EVERY);
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (answers, mut answered) = mpsc::channel(MOST_ANSWERS);
    let mut viewer = Viewer {
        delivery: Delivery::default(),
        presence: Presence::new(board),
        service,
        control,
        answers,
        waiting: None,
        conduct: Conduct::default(),
    };
    let hello = Hello { control, ..board.hello.clone() };
    if !send(&mut socket, Outgoing::text(&ToViewer::Hello(&hello))).await {
        return;
    }
    loop {
        while let Some(message) = viewer.delivery.next(board) {
            let (bytes, began) = (message.len(), Instant::now());
            if !send(&mut socket, message).await {
                return;
            }
            viewer.delivery.sent(bytes, began.elapsed());
            viewer.conduct.last = Instant::now();
        }
        viewer.presence.update(&viewer.delivery);
        let going_on = tokio::select! {
            message = socket.recv() => match message {
                Some(Ok(message)) => viewer.receive(message),
                _ => false,
            },
            Some(answer) = answered.recv() => {
                viewer.retry();
                send(&mut socket, answer).await
            }
            change = changed.changed() => change.is_ok(),
            _ = pings.tick() => {
                let is_there = viewer.conduct.last.elapsed() < PATIENCE;
                is_there && matches!(timeout(PATIENCE, socket.send(Message::Ping(Vec::new().into()))).await, Ok(Ok(())))
            }
        };
        if !going_on {
            return;
        }
    }
}

async fn send(socket: &mut WebSocket, message: Outgoing) -> bool {
    let message = match message {
        Outgoing::Text(text) => Message::Text(text.into()),
        Outgoing::Binary(bytes) => Message::Binary(bytes.into()),
    };
    matches!(timeout(PATIENCE, socket.send(message)).await, Ok(Ok(())))
}

/// Makes an answer, or says why there is none.
type Work = Box<dyn FnOnce() -> Result<Outgoing, String> + Send>;

struct Viewer<'a> {
    delivery: Delivery,
    presence: Presence<'a>,
    service: &'a Arc<Service>,
    control: bool,
    answers: mpsc::Sender<Outgoing>,
    /// The newest request that has no place yet.
    waiting: Option<(&'static str, Work)>,
    conduct: Conduct,
}

impl Viewer<'_> {
    /// Takes in a message; `false` ends the connection.
    fn receive(&mut self, message: Message) -> bool {
        if !self.conduct.is_calm() {
            return false;
        }
        let text = match &message {
            Message::Text(text) => text.as_str(),
            Message::Binary(_) => "",
            Message::Ping(_) | Message::Pong(_) => return true,
            // The end of the stream follows.
            Message::Close(_) => return true,
        };
        match FromViewer::parse(text) {
            Some(message) => self.answer(message),
            None => self.conduct.bad += 1,
        }
        self.conduct.bad <= MOST_BAD
    }

    fn answer(&mut self, message: FromViewer) {
        let desk = self.service.desk.clone();
        match message {
            FromViewer::Taken { revision } => self.delivery.taken(revision),
            FromViewer::Images { current } => self.delivery.wants_images = current,
            FromViewer::Control { r#do } if self.control => desk.control(r#do),
            FromViewer::Control { .. } => self.reply("control", || Err("this view is read only".into())),
            FromViewer::Keyframe { id } => self.reply("keyframe", move || desk.keyframe(id)),
            FromViewer::Render(request) => self.reply("render", move || desk.render(&request)),
        }
    }

    /// Answers from a thread that may block. Beyond the answers under way the newest request waits, and replaces the one that waited.
    fn reply(&mut self, what: &'static str, work: impl FnOnce() -> Result<Outgoing, String> + Send + 'static) {
        self.waiting = Some((what, Box::new(work)));
        self.retry();
    }

    /// Begins the answer that waits, if there is a place.
    fn retry(&mut self) {
        if self.waiting.is_none() {
            return;
        }
        let Ok(place) = self.answers.clone().try_reserve_owned() else { return };
        let Some((what, work)) = self.waiting.take() else { return };
        let Ok(permit) = self.service.answers.clone().try_acquire_owned() else {
            let why = "too many viewers ask at once; ask again";
            place.send(Outgoing::text(&ToViewer::Refused { what, why }));
            return;
        };
        tokio::task::spawn_blocking(move || {
            let answer = work().unwrap_or_else(|why| Outgoing::text(&ToViewer::Refused { what, why: &why }));
            place.send(answer);
            drop(permit);
        });
    }
}

/// How a viewer behaves.
struct Conduct {
    last: Instant,
    second: Instant,
    in_second: usize,
    bad: usize,
}

impl Default for Conduct {
    fn default() -> Self {
        Self { last: Instant::now(), second: Instant::now(), in_second: 0, bad: 0 }
    }
}

impl Conduct {
    /// Counts a message; whether there are not too many.
    fn is_calm(&mut self) -> bool {
        self.last = Instant::now();
        if self.second.elapsed() >= Duration::from_secs(1) {
            (self.second, self.in_second) = (Instant::now(), 0);
        }
        self.in_second += 1;
        self.in_second <= MOST_PER_SECOND
    }
}

/// A viewer as the board counts it.
struct Presence<'a> {
    board: &'a Board,
    is_ready: bool,
    is_watching: bool,
}

impl<'a> Presence<'a> {
    fn new(board: &'a Board) -> Self {
        board.viewers.fetch_add(1, Ordering::Relaxed);
        board.was_watched.store(true, Ordering::Relaxed);
        Self { board, is_ready: false, is_watching: false }
    }

    fn update(&mut self, delivery: &Delivery) {
        let is_ready = self.board.map.load().as_ref().is_none_or(|map| delivery.has_all_of(map.revision));
        count(&self.board.ready, &mut self.is_ready, is_ready);
        count(&self.board.watching, &mut self.is_watching, delivery.wants_images);
    }
}

fn count(all: &AtomicUsize, was: &mut bool, is: bool) {
    match (*was, is) {
        (false, true) => drop(all.fetch_add(1, Ordering::Relaxed)),
        (true, false) => drop(all.fetch_sub(1, Ordering::Relaxed)),
        _ => {}
    }
    *was = is;
}

impl Drop for Presence<'_> {
    fn drop(&mut self) {
        count(&self.board.ready, &mut self.is_ready, false);
        count(&self.board.watching, &mut self.is_watching, false);
        self.board.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}
