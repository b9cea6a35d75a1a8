//! What the mapping thread does for others between two batches of its steps: snapshots, ordered views, pauses.

use std::cell::RefCell;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Progress;
use super::progress::{MappingProgress, RenderOrder};
use crate::gpu::GpuError;
use crate::mapping::{Interlude, Mapper, MappingError, PagedOut};
use crate::render::{Rasterizer, Rendered};
use crate::splat::{GaussianCloud, MapSnapshot, ViewCamera};

/// Snapshots for viewers take at most one part in so many of the mapper's time, at most one in this time:
const SNAPSHOT_SHARE: u32 = 100;
const SNAPSHOT_EVERY: Duration = Duration::from_millis(250);
/// Those that are kept in case the device fails are as old as this at most, and one part in so many of the time.
const KEPT_SHARE: u32 = 20;
const KEPT_EVERY: Duration = Duration::from_secs(1);
/// Ordered views take at most one part in so many of its time.
const RENDER_SHARE: u32 = 25;
/// Intersections of an ordered view, at most: a picture from close by is refused before it fills the GPU's memory.
const MOST_INTERSECTIONS: usize = 1 << 22;

/// Work that may take a share of the time.
#[derive(Debug, Default)]
struct Share {
    /// When it was done last, and how long that took.
    last: Option<(Instant, Duration)>,
}

impl Share {
    fn is_due(&self, one_in: u32, every: Duration) -> bool {
        self.last.is_none_or(|(at, cost)| at.elapsed() >= every.max(one_in * cost))
    }

    fn take<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let began = Instant::now();
        let done = work();
        self.last = Some((Instant::now(), began.elapsed()));
        done
    }
}

/// The mapping thread's duties to others.
#[derive(Debug)]
pub(super) struct Attending<'a> {
    progress: &'a Progress,
    state: RefCell<State>,
}

#[derive(Debug, Default)]
struct State {
    /// The newest map that was downloaded: what was on the GPU.
    cloud: Arc<GaussianCloud>,
    /// What was on the disk then.
    paged_out: PagedOut,
    /// Whether the map has changed since.
    is_stale: bool,
    snapshots: Share,
    renders: Share,
    renderer: OrderRenderer,
    figures: MappingProgress,
}

impl<'a> Attending<'a> {
    /// `cloud` is the map so far, but for what is `paged_out`.
    pub fn new(progress: &'a Progress, cloud: Arc<GaussianCloud>, paged_out: PagedOut) -> Self {
        if !cloud.is_empty() {
            progress.snapshots().put(MapSnapshot { cloud: cloud.clone(), keyframes: 0, psnr_db: 0.0 });
        }
        Self { progress, state: RefCell::new(State { cloud, paged_out, ..State::default() }) }
    }

    /// The newest map that was downloaded, with what was on the disk then.
    pub fn cloud(&self, mapper: &Mapper) -> Arc<GaussianCloud> {
        let State { cloud, paged_out, .. } = &*self.state.borrow();
        if paged_out.is_nothing() {
            return cloud.clone();
        }
        let mut whole = (**cloud).clone();
        if let Err(error) = mapper.add_paged_out(&mut whole, paged_out) {
            tracing::warn!("the map lacks some Gaussians: {error}");
        }
        Arc::new(whole)
    }

    /// Shows viewers the whole map, when the run has ended.
    pub fn show(&self, cloud: &Arc<GaussianCloud>) {
        let MappingProgress { keyframes, psnr_db, .. } = self.state.borrow().figures;
        self.progress.snapshots().put(MapSnapshot { cloud: cloud.clone(), keyframes, psnr_db });
    }

    /// Marks the newest download as out of date.
    pub fn changed(&self) {
        self.state.borrow_mut().is_stale = true;
    }

    /// Publishes the figures of the map.
    pub fn publish(&self, figures: MappingProgress) {
        self.state.borrow_mut().figures = figures;
        self.progress.mapping().put(figures);
    }

    /// Renders what is ordered and downloads what is wanted, within their shares of the time.
    pub fn attend(&self, mapper: &Mapper) -> Result<(), MappingError> {
        let mut state = self.state.borrow_mut();
        let wanted = self.progress.snapshots().is_wanted() && state.snapshots.is_due(SNAPSHOT_SHARE, SNAPSHOT_EVERY);
        if state.is_stale && (wanted || state.snapshots.is_due(KEPT_SHARE, KEPT_EVERY)) {
            state.download(mapper, self.progress)?;
        }
        if self.progress.has_order() && state.renders.is_due(RENDER_SHARE, Duration::ZERO) {
            let Some(order) = self.progress.next_order() else { return Ok(()) };
            let State { renders, renderer, .. } = &mut *state;
            renders.take(|| renderer.answer(mapper, order));
        }
        Ok(())
    }

    /// Downloads the map unless it has not changed.
    pub fn download(&self, mapper: &Mapper) -> Result<(), MappingError> {
        let mut state = self.state.borrow_mut();
        if state.is_stale { state.download(mapper, self.progress) } else { Ok(()) }
    }

    /// Between two batches of steps, which end where `stop` says so.
    pub fn until<'b>(&'b self, stop: &'b dyn Fn() -> bool) -> impl Interlude + 'b
    where
        'a: 'b,
    {
        Until { attending: self, stop }
    }

    /// Attends while the run is held.
    pub fn while_paused(&self, mapper: &Mapper) -> Result<(), MappingError> {
        self.progress.control().wait_while_paused(|| self.attend(mapper)).map(drop)
    }
}

/// Renders ordered views with buffers of its own: those of the mapper decide which steps are repeated, and its memory may be bounded.
#[derive(Debug, Default)]
pub(super) struct OrderRenderer {
    rasterizer: Option<Rasterizer>,
}

impl OrderRenderer {
    /// Renders an ordered view of the map as it is now.
    pub fn answer(&mut self, mapper: &Mapper, RenderOrder { camera, reply }: RenderOrder) {
        reply(self.render(mapper, &camera).map_err(|error| error.to_string()));
    }

    fn render(&mut self, mapper: &Mapper, camera: &ViewCamera) -> Result<Rendered, GpuError> {
        if self.rasterizer.is_none() {
            let rasterizer = Rasterizer::new(mapper.gpu().beside())?;
            self.rasterizer = Some(rasterizer.with_most_intersections(MOST_INTERSECTIONS));
        }
        let rasterizer = self.rasterizer.as_mut().expect("it was just made");
        rasterizer.render(mapper.map(), camera, [0.0; 3])
    }
}

impl State {
    fn download(&mut self, mapper: &Mapper, progress: &Progress) -> Result<(), MappingError> {
        let (cloud, paged_out) = self.snapshots.take(|| mapper.download_resident())?;
        (self.cloud, self.paged_out) = (Arc::new(cloud), paged_out);
        self.is_stale = false;
        let MappingProgress { keyframes, psnr_db, .. } = self.figures;
        progress.snapshots().put(MapSnapshot { cloud: self.cloud.clone(), keyframes, psnr_db });
        Ok(())
    }
}

struct Until<'a, 'b> {
    attending: &'b Attending<'a>,
    stop: &'b dyn Fn() -> bool,
}

impl Interlude for Until<'_, '_> {
    fn between(&self, mapper: &Mapper) -> Result<ControlFlow<()>, MappingError> {
        // Steps were taken since the last time.
        self.attending.changed();
        self.attending.attend(mapper)?;
        self.attending.while_paused(mapper)?;
        Ok(if (self.stop)() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}
