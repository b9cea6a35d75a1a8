//! A run as a board for viewers: a thread reads its progress, and requests what viewers would take.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::board::{Board, Frames, NumberedImage, put};
use super::packing::PackedMap;
use super::path::camera_path;
use super::pictures::{self, RecordedImages};
use super::protocol::{CameraView, Command, CurrentView, Hello, KeyframeView, PROTOCOL, Phase, PoseView, Statistics};
use super::server::Desk;
use crate::evaluation::{Alignment, Comparison, evaluate_trajectory, machine};
use crate::geometry::Trajectory;
use crate::pipeline::{FrameImage, KeyframePoses, Outlook, Progress, RenderOrder};
use crate::recording::Recording;
use crate::render::Rendered;
use crate::sequence::{RectifiedImage, SensorKind};
use crate::splat::{MapSnapshot, ViewCamera};

/// How often the thread looks.
const LOOK_EVERY: Duration = Duration::from_millis(100);
const STATISTICS_EVERY: Duration = Duration::from_secs(1);
/// Poses of the path, which is sent anew each time.
const MOST_POSES: usize = 2000;
const PATH_EVERY: Duration = Duration::from_secs(2);
const IMAGE_EVERY: Duration = Duration::from_millis(200);
/// A viewer's picture has to be there after this time.
const RENDER_TIME: Duration = Duration::from_secs(20);

/// A run that viewers see.
pub struct Live {
    board: Arc<Board>,
    desk: Arc<LiveDesk>,
    thread: Option<JoinHandle<()>>,
}

/// Answers viewers of a run.
struct LiveDesk {
    recording: Arc<Recording>,
    images: RecordedImages,
    progress: Progress,
    board: Arc<Board>,
    phase: AtomicUsize,
    /// Whether the run is over, and its thread may end.
    is_over: AtomicBool,
}

const PHASES: [Phase; 4] = [Phase::Tracking, Phase::Refining, Phase::Measuring, Phase::Done];
/// Places among these.
const REFINING: usize = 1;
const MEASURING: usize = 2;
const DONE: usize = 3;

impl Live {
    /// Begins to show a run of this recording.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(recording: Arc<Recording>, progress: Progress) -> std::io::Result<Self> {
        let board = Arc::new(Board::new(hello(&recording)));
        let images = RecordedImages::new(&recording);
        let (phase, is_over) = (AtomicUsize::new(0), AtomicBool::new(false));
        let desk = Arc::new(LiveDesk { recording, images, progress, board: board.clone(), phase, is_over });
        let observer = Observer::new(desk.clone());
        let thread = std::thread::Builder::new().name("observing".into()).spawn(move || observer.observe())?;
        Ok(Self { board, desk, thread: Some(thread) })
    }

    /// What a server shows.
    pub fn board(&self) -> Arc<Board> {
        self.board.clone()
    }

    /// What answers viewers.
    pub fn desk(&self) -> Arc<dyn Desk> {
        self.desk.clone()
    }

    /// Shows that the refinement goes on after the run's end.
    pub fn refining(&self) {
        self.desk.phase.store(REFINING, Ordering::Relaxed);
    }

    /// Shows that the map is finished and is being measured.
    pub fn measuring(&self) {
        self.desk.phase.store(MEASURING, Ordering::Relaxed);
    }

    /// Shows that all results are written.
    pub fn done(&self) {
        self.desk.phase.store(DONE, Ordering::Relaxed);
    }

    /// Whether anybody has ever looked.
    pub fn was_watched(&self) -> bool {
        self.board.was_watched.load(Ordering::Relaxed)
    }

    /// Viewers connected.
    pub fn viewers(&self) -> usize {
        self.board.viewers.load(Ordering::Relaxed)
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.desk.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn hello(recording: &Recording) -> Hello {
    let sequence = recording.sequence();
    let sensor = sequence.sensor.kind();
    let metric = sensor != SensorKind::Mono;
    Hello {
        protocol: PROTOCOL,
        name: sequence.name.clone(),
        sensor: Some(sensor.to_string()),
        live: true,
        control: true,
        exact: true,
        images: RecordedImages::are_there(recording),
        units: if metric { "metres" } else { "arbitrary" },
        camera: Some(CameraView::from(recording.map_pinhole())),
        frames: Some(sequence.entries.len()),
    }
}

/// Looks at a run and writes what it sees to the board.
struct Observer {
    desk: Arc<LiveDesk>,
    outlook: Outlook,
    snapshot: Option<Arc<MapSnapshot>>,
    poses: Option<Arc<KeyframePoses>>,
    image: Option<Arc<FrameImage>>,
    frame: usize,
    revision: u64,
    path_of: Option<Arc<KeyframePoses>>,
    compared: Instant,
    counted: Instant,
    pictured: Instant,
}

impl Observer {
    fn new(desk: Arc<LiveDesk>) -> Self {
        let outlook = Outlook::new(desk.recording.sequence().entries.len(), &desk.recording.config().mapping.refine);
        let now = Instant::now();
        Self {
            desk,
            outlook,
            snapshot: None,
            poses: None,
            image: None,
            frame: 0,
            revision: 0,
            path_of: None,
            compared: now,
            counted: now.checked_sub(STATISTICS_EVERY).unwrap_or(now),
            pictured: now,
        }
    }

    fn observe(mut self) {
        while !self.desk.is_over.load(Ordering::Relaxed) {
            let is_watched = self.desk.board.viewers.load(Ordering::Relaxed) > 0;
            let mut changed = self.count();
            if is_watched {
                changed |= self.see_frames() | self.see_path() | self.see_image() | self.see_map();
            }
            if changed {
                self.desk.board.announce();
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }

    /// Statistics are kept without viewers too: whoever comes later sees how it went.
    fn count(&mut self) -> bool {
        let state = self.outlook.look(&self.desk.progress);
        if self.counted.elapsed() < STATISTICS_EVERY {
            return false;
        }
        self.counted = Instant::now();
        let later = self.desk.phase.load(Ordering::Relaxed);
        let phase = PHASES[later.max(usize::from(state.mapping.refinement.is_some()))];
        let has_steps = state.mapping.steps > 0;
        let entry = Statistics {
            s: state.s,
            phase,
            paused: state.paused,
            frames: state.frames,
            keyframes: state.tracking.keyframes,
            gaussians: state.mapping.gaussians,
            steps: state.mapping.steps,
            lost: state.tracking.lost,
            psnr_db: has_steps.then_some(state.mapping.psnr_db),
            frame_ms: (state.frames > 0).then_some(state.tracking.frame_ms),
            step_ms: has_steps.then_some(state.mapping.step_ms),
            host_bytes: machine::host_bytes(),
            left_s: state.left_s.filter(|_| later == 0),
        };
        let board = &self.desk.board;
        let newest = board.statistics.load_full();
        if phase == Phase::Done && newest.newest().is_some_and(|last| last.phase == Phase::Done) {
            return false;
        }
        let mut history = (*newest).clone();
        history.push(entry);
        board.statistics.store(Arc::new(history));
        true
    }

    fn see_frames(&mut self) -> bool {
        let progress = &self.desk.progress;
        let tracking = progress.tracking().get();
        let poses = progress.poses().get();
        progress.poses().want();
        let frame = tracking.as_ref().map_or(0, |tracking| tracking.frames_done);
        let same = |a: &Option<Arc<_>>, b: &Option<Arc<_>>| a.as_ref().map(Arc::as_ptr) == b.as_ref().map(Arc::as_ptr);
        let moved = !same(&poses, &self.poses);
        if !moved && frame == self.frame {
            return false;
        }
        let current = tracking.and_then(|tracking| {
            let pose = PoseView::from(&tracking.world_from_camera?);
            Some(CurrentView { frame: tracking.frames_done - 1, pose, lost: tracking.lost })
        });
        let last = self.desk.board.frames.load_full().filter(|_| !moved);
        let frames = last.map_or_else(|| frames(poses.as_deref()), |last| (*last).clone());
        put(&self.desk.board.frames, Frames { current, ..frames });
        (self.frame, self.poses) = (frame, poses);
        true
    }

    /// The path through the keyframes, beside the truth where the recording has one.
    fn see_path(&mut self) -> bool {
        let Some(poses) = self.poses.clone().filter(|_| self.compared.elapsed() >= PATH_EVERY) else { return false };
        if self.path_of.as_ref().is_some_and(|last| Arc::ptr_eq(last, &poses)) {
            return false;
        }
        self.compared = Instant::now();
        let sequence = self.desk.recording.sequence();
        let estimate = Trajectory { poses: poses.keyframes.iter().map(|keyframe| keyframe.stamped()).collect() };
        let errors = sequence.groundtruth.as_ref().and_then(|truth| {
            let errors = evaluate_trajectory(truth, &estimate, Alignment::of(sequence.sensor.kind())).ok()?;
            Some(Comparison::of(&estimate, Some((truth, &errors))))
        });
        put(&self.desk.board.path, camera_path(&estimate, errors.as_ref(), MOST_POSES));
        self.path_of = Some(poses);
        true
    }

    fn see_image(&mut self) -> bool {
        if self.desk.board.watching.load(Ordering::Relaxed) == 0 || self.pictured.elapsed() < IMAGE_EVERY {
            return false;
        }
        let images = self.desk.progress.images();
        images.want();
        let Some(image) = images.get() else { return false };
        if self.image.as_ref().is_some_and(|last| Arc::ptr_eq(last, &image)) {
            return false;
        }
        self.pictured = Instant::now();
        let shown = pictures::current(&image.color, image.frame).map(|message| {
            put(&self.desk.board.image, NumberedImage { number: image.frame as u64, message });
        });
        self.image = Some(image);
        shown.is_ok()
    }

    /// Requests a newer map once a viewer has all of the last one.
    fn see_map(&mut self) -> bool {
        let (board, snapshots) = (&self.desk.board, self.desk.progress.snapshots());
        if !board.wants_map() {
            return false;
        }
        let Some(snapshot) = snapshots.get() else {
            snapshots.want();
            return false;
        };
        let is_new = self.snapshot.as_ref().is_none_or(|last| !Arc::ptr_eq(last, &snapshot));
        snapshots.want();
        if is_new {
            self.revision += 1;
            let last = board.map.load_full();
            put(&board.map, PackedMap::new(&snapshot.cloud, self.revision, last.as_deref()));
            self.snapshot = Some(snapshot);
        }
        is_new
    }
}

fn frames(poses: Option<&KeyframePoses>) -> Frames {
    let Some(poses) = poses else { return Frames::default() };
    let views = poses.keyframes.iter().map(|k| KeyframeView {
        id: k.frame_index,
        frame: k.frame_index,
        t: k.timestamp_s,
        pose: (&k.world_from_camera).into(),
    });
    Frames { keyframes: views.collect(), loops: poses.loops.clone(), current: None }
}

impl Desk for LiveDesk {
    fn recorded(&self, id: usize) -> Result<(usize, RectifiedImage), String> {
        let frames = self.board.frames.load_full().unwrap_or_default();
        let place = frames.keyframes.binary_search_by_key(&id, |view| view.id).map_err(|_| "there is no such keyframe")?;
        let frame = frames.keyframes[place].frame;
        Ok((frame, self.images.load(&self.recording, frame)?))
    }

    fn draw(&self, camera: &ViewCamera) -> Result<Rendered, String> {
        if self.phase.load(Ordering::Relaxed) == MEASURING {
            return Err("the map is being measured; ask again when that is done".into());
        }
        let (send, receive) = mpsc::channel();
        let reply = Box::new(move |view| {
            let _ = send.send(view);
        });
        if !self.progress.order(RenderOrder { camera: *camera, reply }) {
            return Err("the mapper has too many pictures to render; ask again".into());
        }
        receive.recv_timeout(RENDER_TIME).map_err(|_| "the mapper did not render it in time")?
    }

    fn control(&self, command: Command) {
        let control = self.progress.control();
        match command {
            Command::Pause => control.pause(),
            Command::Go => control.resume(),
            Command::Step => control.step(),
            Command::Finish => control.stop(),
            Command::Refine => control.refine_on(true),
        }
    }
}
