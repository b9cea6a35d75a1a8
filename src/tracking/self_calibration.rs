//! The camera of a recording without a calibration, from its own frames: the monocular tracker makes a map with an assumed focal length, bundle
//! adjustment of that map estimates focal length, distortion and the rolling shutter's readout time, and the next map is made with this lens; the
//! answer is the mean of several.
//!
//! The principal point is taken to be the centre of the image, and pixels to be square.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Vector2, Vector6};

use crate::geometry::{Camera, Distortion, Pinhole, Se3, se3};
use crate::sequence::Sensor;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::solvers::intrinsics::{Lens, LensDeviation, LensProblem, PixelObservation};
use crate::tracking::{ExtractedFrame, Tracker, TrackingConfig, TrackingError};

/// Focal lengths assumed in turn, as shares of the image's larger side, until one leads to an answer.
const ASSUMED: [f64; 3] = [0.9, 0.6, 1.4];
/// Maps that an answer is the mean of: each chooses other keyframes and landmarks, so that they differ by more than any of them states.
const ROUNDS: usize = 6;
/// Maps made from one assumed lens, at most, before the answer is taken as it comes.
const MOST_MAPS: usize = 6;
/// Changes of the focal length (as a share) and of the distortion up to which a map was made with about the right lens.
const NEAR_FOCAL: f64 = 0.05;
const NEAR_K1: f64 = 0.05;
/// Keyframes that an answer needs, and of which one is made, at most: the first ones.
const LEAST_KEYFRAMES: usize = 6;
const MOST_KEYFRAMES: usize = 150;
/// Landmarks that fewer keyframes see say little.
const LEAST_VIEWS: usize = 3;
/// A frame's motion is that between the frames up to so many before and after it.
const MOTION_FRAMES: usize = 2;
const STEPS: usize = 40;
/// Standard deviation of the focal length, as a share of it, up to which it is an answer.
const MOST_DEVIATION: f64 = 0.03;
/// Focal lengths of usual lenses, as shares of the image's larger side.
const PLAUSIBLE: std::ops::Range<f64> = 0.35..4.0;

/// A camera that calibrated itself.
#[derive(Clone, Copy, Debug)]
pub struct SelfCalibration {
    /// The camera.
    pub camera: Camera,
    /// Time from the first row to the last one, intervals between two frames: about 0 for a global shutter.
    pub readout: f64,
    /// Standard deviation of the focal length, pixels.
    pub focal_sigma: f64,
    /// Standard deviation of the first distortion term.
    pub k1_sigma: f64,
    /// Keyframes that it follows from.
    pub keyframes: usize,
    /// Observations that it follows from.
    pub observations: usize,
    /// Root mean square of their residuals, pixels at the finest pyramid level.
    pub rms_pixels: f64,
}

/// A lens that follows from one map.
struct Estimate {
    lens: Lens,
    deviation: LensDeviation,
    keyframes: usize,
    observations: usize,
    /// Whitened.
    rms: f64,
}

/// Frames from which no camera can be told.
#[derive(Debug, thiserror::Error)]
pub enum SelfCalibrationError {
    /// Too few frames were tracked.
    #[error(
        "the camera cannot calibrate itself: the frames could not be tracked with any usual focal length; choose a stretch where the camera moves \
         sideways past things at different distances (--frames), or calibrate it and write a camera.toml"
    )]
    NotTracked,
    /// The motion says too little.
    #[error(
        "the camera cannot calibrate itself: the focal length would be uncertain by {percent:.0}%; the camera has to turn and to move, so choose a longer \
         stretch (--frames), or calibrate it and write a camera.toml"
    )]
    Uncertain {
        /// Standard deviation of the focal length, percent of it.
        percent: f64,
    },
    /// The tracker failed.
    #[error(transparent)]
    Tracking(#[from] TrackingError),
}

fn camera(lens: Lens, width: u32, height: u32) -> Camera {
    let assumed = Camera::assumed(width, height);
    let pinhole = Pinhole { fx: lens.focal, fy: lens.focal, ..assumed.pinhole };
    Camera { pinhole, distortion: lens.distortion, ..assumed }
}

/// The camera of consecutive frames that were extracted with [`Camera::assumed`].
///
/// # Errors
/// [`SelfCalibrationError`] if the frames do not tell.
pub fn self_calibrate(
    frames: &[ExtractedFrame],
    (width, height): (u32, u32),
    config: &TrackingConfig,
) -> Result<SelfCalibration, SelfCalibrationError> {
    let side = f64::from(width.max(height));
    let mut least_deviation = f64::INFINITY;
    for assumed in ASSUMED {
        let mut lens = Lens { focal: assumed * side, distortion: Distortion::default(), readout: 0.0 };
        let (mut estimates, mut maps): (Vec<Estimate>, usize) = (Vec::new(), 0);
        while let Some(estimate) = adjust(frames, &lens, (width, height), config)? {
            let Lens { focal, distortion, readout } = estimate.lens;
            tracing::debug!(focal, ?distortion, readout, deviation = estimate.deviation.focal, "self-calibration");
            if !estimate.lens.is_plausible((width, height)) {
                break;
            }
            maps += 1;
            if !lens.is_near(&estimate.lens) && maps < MOST_MAPS {
                // The lens has bent this map.
                lens = estimate.lens;
                estimates.clear();
                continue;
            }
            estimates.push(estimate);
            lens = mean_lens(&estimates);
            if estimates.len() == ROUNDS {
                let found = combine(&estimates, lens, (width, height), config);
                let deviation = found.focal_sigma / lens.focal;
                if deviation < MOST_DEVIATION {
                    return Ok(found);
                }
                least_deviation = least_deviation.min(deviation);
                break;
            }
        }
    }
    Err(match least_deviation.is_finite() {
        true => SelfCalibrationError::Uncertain { percent: 100.0 * least_deviation },
        false => SelfCalibrationError::NotTracked,
    })
}

fn mean_lens(estimates: &[Estimate]) -> Lens {
    let mean = |of: &dyn Fn(&Lens) -> f64| estimates.iter().map(|e| of(&e.lens)).sum::<f64>() / estimates.len() as f64;
    let distortion = Distortion {
        k1: mean(&|lens| lens.distortion.k1),
        k2: mean(&|lens| lens.distortion.k2),
        p1: mean(&|lens| lens.distortion.p1),
        p2: mean(&|lens| lens.distortion.p2),
        k3: 0.0,
    };
    Lens { focal: mean(&|lens| lens.focal.ln()).exp(), distortion, readout: mean(&|lens| lens.readout) }
}

/// The mean of the estimates, with their own deviation and the one between them.
fn combine(estimates: &[Estimate], lens: Lens, (width, height): (u32, u32), config: &TrackingConfig) -> SelfCalibration {
    let count = estimates.len() as f64;
    let sigma = |off: &dyn Fn(&Estimate) -> f64, stated: &dyn Fn(&Estimate) -> f64| {
        let shown = estimates.iter().map(|e| off(e).powi(2)).sum::<f64>() / (count - 1.0);
        let stated = estimates.iter().map(|e| stated(e).powi(2)).sum::<f64>() / count;
        (shown / count + stated).sqrt()
    };
    let last = &estimates[estimates.len() - 1];
    SelfCalibration {
        camera: camera(lens, width, height),
        readout: lens.readout,
        focal_sigma: lens.focal * sigma(&|e| (e.lens.focal / lens.focal).ln(), &|e| e.deviation.focal),
        k1_sigma: sigma(&|e| e.lens.distortion.k1 - lens.distortion.k1, &|e| e.deviation.k1),
        keyframes: last.keyframes,
        observations: last.observations,
        rms_pixels: last.rms * config.pixel_sigma,
    }
}

impl Lens {
    /// Whether it is a usual lens, whose distorted pixels stay in their order out to the corners.
    fn is_plausible(&self, (width, height): (u32, u32)) -> bool {
        let Distortion { k1, k2, .. } = self.distortion;
        let corner = 0.5 * f64::from(width).hypot(height.into()) / self.focal;
        let grows = |part: u32| {
            let r2 = (corner * f64::from(part) / 8.0).powi(2);
            1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2) > 0.0
        };
        PLAUSIBLE.contains(&(self.focal / f64::from(width.max(height)))) && (1..=8).all(grows)
    }

    fn is_near(&self, other: &Self) -> bool {
        (self.focal / other.focal).ln().abs() < NEAR_FOCAL && (self.distortion.k1 - other.distortion.k1).abs() < NEAR_K1
    }
}

/// Tracks the frames with a lens and adjusts it with the map; `None` if there is no map to speak of.
fn adjust(
    frames: &[ExtractedFrame],
    lens: &Lens,
    (width, height): (u32, u32),
    config: &TrackingConfig,
) -> Result<Option<Estimate>, SelfCalibrationError> {
    let camera = camera(*lens, width, height);
    let mut tracker = Tracker::new(camera, Sensor::Mono, config)?;
    for frame in frames {
        tracker.track_extracted(&undistorted(frame, &camera), true)?;
    }
    tracker.finish()?;
    let map = tracker.map();
    let keyframes: Vec<usize> = map.living_in(tracker.largest_submap()).take(MOST_KEYFRAMES).collect();
    if keyframes.len() < LEAST_KEYFRAMES {
        return Ok(None);
    }
    let place: BTreeMap<usize, usize> = keyframes.iter().enumerate().map(|(i, k)| (*k, i)).collect();
    let recorded: BTreeMap<usize, &ExtractedFrame> = frames.iter().map(|f| (f.index, f)).collect();
    let trajectory: BTreeMap<usize, Se3> =
        tracker.trajectory().into_iter().map(|(i, p)| (i, p.world_from_camera.inverse())).collect();
    let centre = Vector2::new(camera.pinhole.cx, camera.pinhole.cy);
    let mut problem = LensProblem {
        lens: *lens,
        poses: keyframes.iter().map(|k| map.keyframes[*k].camera_from_world).collect(),
        motions: keyframes.iter().map(|k| motion(&trajectory, map.keyframes[*k].frame_index)).collect(),
        height: height.into(),
        points: Vec::new(),
        observations: Vec::new(),
    };
    for landmark in map.landmarks_of(&keyframes) {
        let seen = map.landmarks[landmark].observations.iter().filter_map(|s| Some((*place.get(&s.keyframe)?, *s)));
        let seen: Vec<_> = seen.collect();
        if seen.len() < LEAST_VIEWS {
            continue;
        }
        for (pose, observation) in seen {
            let frame = recorded[&map.keyframes[observation.keyframe].frame_index];
            let feature = &frame.features.features[observation.feature];
            let weight = 1.0 / (config.pixel_sigma * config.pyramid_scale.powi(feature.octave.into()));
            problem.observations.push(PixelObservation {
                pose,
                point: problem.points.len(),
                pixel: feature.pixel - centre,
                weight,
            });
        }
        problem.points.push(map.position(landmark));
    }
    problem.drop_hidden();
    problem.solve(STEPS);
    problem.drop_outliers();
    problem.solve(STEPS);
    let Some(deviation) = problem.deviation(STEPS) else { return Ok(None) };
    let (rms, observations) = problem.agreement();
    Ok(Some(Estimate { lens: problem.lens, deviation, keyframes: keyframes.len(), observations, rms }))
}

/// How camera_from_world changes at a frame from one frame to the next, by the frames around it; 0 without them.
fn motion(trajectory: &BTreeMap<usize, Se3>, frame: usize) -> Vector6<f64> {
    let around = frame.saturating_sub(MOTION_FRAMES)..=frame + MOTION_FRAMES;
    let mut poses = trajectory.range(around);
    let Some(((first, from), (last, to))) = poses.next().zip(poses.next_back()) else { return Vector6::zeros() };
    se3::log(&(to * from.inverse())) / (last - first) as f64
}

/// The frame as a camera with this lens sees it.
fn undistorted(frame: &ExtractedFrame, camera: &Camera) -> ExtractedFrame {
    let undistort = |f: &Feature| Feature { pixel: camera.undistort_pixel(&f.pixel), ..*f };
    let features = frame.features.features.iter().map(undistort).collect();
    ExtractedFrame { features: Arc::new(FrameFeatures::new(features, &camera.pinhole)), dense: None, ..frame.clone() }
}
