//! A simulated front end: walks of any length through worlds of points, without images. The tracker receives features with noise, false ones
//! and repeated ones among them; the truth is exact.
//!
//! A world is a grid of halls; its points lie on their walls, floors and ceilings. What a hall looks like follows from the seed and its place, so
//! that a world of any size costs no more than the halls that have been visited.

mod path;
mod world;

use std::collections::BTreeSet;
use std::sync::Arc;

use clap::ValueEnum;
use nalgebra::{Point3, Vector2};

use crate::geometry::{Camera, Distortion, Pinhole, Se3, Trajectory};
use crate::sequence::Sensor;
use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};
use crate::tracking::{ClosedLoop, ExtractedFrame, Tracker, TrackingConfig};
use path::Path;
use world::{Halls, SeenPoint};

const PINHOLE: Pinhole = Pinhole { fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5, width: 640, height: 480 };
/// Features of a frame, at most.
const MOST_FEATURES: usize = 600;
/// Share of the visible points that become features, and of features that show no point.
const DETECTED: f64 = 0.7;
const FALSE_FEATURES: f64 = 0.15;
/// Bits of a descriptor that noise flips, at most; half as many on average.
const FLIPPED_BITS: usize = 24;
/// Share of the depths that are wrong by far.
const FALSE_DEPTHS: f64 = 0.02;
/// Standard deviation of a corner's position at its pyramid level, pixels, and of a disparity.
const PIXEL_SIGMA: f64 = 0.6;
const DISPARITY_SIGMA: f64 = 0.5;
const BASELINE_METRES: f64 = 0.54;
/// Error of a loop's relative pose from which on the loop is wrong, as a share of a hall's length.
const WRONG_SHARE: f64 = 0.1;

/// A simulated world, and who walks through it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum World {
    /// Halls of 2.4 m by 4 m in a grid, at a walk's speed with an RGB-D camera; places are seen again and again.
    Rooms,
    /// Streets of 10 m by 40 m in a grid, at 8 m/s with a stereo camera; places are seen again and again.
    Streets,
    /// A ring of halls that all look the same, with an RGB-D camera.
    Corridor,
}

/// Lengths of a world, metres.
#[derive(Clone, Copy, Debug)]
struct Scale {
    /// Distance between two crossings.
    edge: f64,
    half_width: f64,
    height: f64,
    /// Crossings in both directions.
    crossings: i64,
    /// Points a metre of hall.
    points: f64,
    /// Metres a frame.
    step: f64,
    frames_per_s: f64,
    /// Points further away are hidden.
    sight: f64,
    /// Depth is measured up to here.
    depth_reach: f64,
}

impl World {
    fn scale(self) -> Scale {
        match self {
            Self::Rooms | Self::Corridor => Scale {
                edge: 4.0,
                half_width: 1.2,
                height: 2.5,
                crossings: 12,
                points: 250.0,
                step: 0.033,
                frames_per_s: 30.0,
                sight: 9.0,
                depth_reach: 6.0,
            },
            Self::Streets => Scale {
                edge: 40.0,
                half_width: 5.0,
                height: 8.0,
                crossings: 8,
                points: 80.0,
                step: 0.8,
                frames_per_s: 10.0,
                sight: 40.0,
                depth_reach: 40.0,
            },
        }
    }

    /// How many loops of a walk are wrong: their relative pose is off by more than a tenth of a hall. `truth` has a pose for each frame.
    pub fn wrong_loops(self, tracker: &Tracker, truth: &Trajectory) -> usize {
        let frames: BTreeSet<usize> = tracker.keyframes().iter().map(|k| k.frame_index).collect();
        let true_pose = |frame: usize| frames.contains(&frame).then(|| truth.poses[frame].world_from_camera);
        let is_wrong = |l: &&ClosedLoop| {
            // Keyframes of submaps that never joined are left out.
            let Some((keyframe, place)) = true_pose(l.keyframe).zip(true_pose(l.place)) else { return false };
            let error = l.keyframe_from_place.inverse() * keyframe.inverse() * place;
            error.translation.vector.norm() > WRONG_SHARE * self.scale().edge
        };
        tracker.loops().iter().filter(is_wrong).count()
    }

    /// What its frames come from.
    pub fn sensor(self) -> Sensor {
        match self {
            Self::Rooms | Self::Corridor => Sensor::Rgbd,
            Self::Streets => Sensor::Stereo { baseline_metres: BASELINE_METRES },
        }
    }
}

/// A walk: its frames one after the other, with their true poses.
#[derive(Debug)]
pub struct Walk {
    world: World,
    scale: Scale,
    halls: Halls,
    path: Path,
    random: fastrand::Rng,
    config: TrackingConfig,
    next: usize,
}

impl Walk {
    /// A walk through a world.
    pub fn new(world: World, seed: u64, config: &TrackingConfig) -> Self {
        let scale = world.scale();
        let random = fastrand::Rng::with_seed(seed);
        let (halls, path) = (Halls::new(world, seed), Path::new(world, seed));
        Self { world, scale, halls, path, random, config: config.clone(), next: 0 }
    }

    /// Its camera, without distortion.
    pub fn camera() -> Camera {
        Camera { pinhole: PINHOLE, distortion: Distortion::default(), depth_units_per_metre: 1000.0 }
    }

    /// The next frame, and its true world_from_camera.
    pub fn frame(&mut self) -> (ExtractedFrame, Se3) {
        let index = self.next;
        self.next += 1;
        let world_from_camera = self.path.pose(index);
        let features = self.features(&world_from_camera);
        let extracted = ExtractedFrame {
            index,
            timestamp_s: index as f64 / self.scale.frames_per_s,
            has_depth_image: true,
            features: Arc::new(FrameFeatures::new(features, &PINHOLE)),
            dense: None,
            features_ms: 0.0,
        };
        (extracted, world_from_camera)
    }

    fn features(&mut self, world_from_camera: &Se3) -> Vec<Feature> {
        let camera_from_world = world_from_camera.inverse();
        let mut found: Vec<(f64, Feature)> = Vec::new();
        for point in self.halls.visible_from(world_from_camera) {
            let p_in_camera = camera_from_world * point.position;
            let Some(feature) = self.feature(&p_in_camera, &point) else { continue };
            if self.random.f64() < DETECTED {
                found.push((point.strength, feature));
            }
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut features: Vec<Feature> = found.into_iter().map(|(_, feature)| feature).take(MOST_FEATURES).collect();
        for feature in &mut features {
            if self.random.f64() < FALSE_FEATURES {
                feature.pixel = Vector2::new(640.0 * self.random.f64(), 480.0 * self.random.f64());
                feature.descriptor = Descriptor(std::array::from_fn(|_| self.random.u64(..)));
            }
        }
        features
    }

    /// How a point looks; `None` outside of the image and of the pyramid's sizes.
    fn feature(&mut self, p_in_camera: &Point3<f64>, point: &SeenPoint) -> Option<Feature> {
        let distance = p_in_camera.coords.norm();
        let octave = ((point.finest_at_metres / distance).ln() / self.config.pyramid_scale.ln()).floor();
        if p_in_camera.z < 0.1 || !(0.0..self.config.pyramid_levels as f64).contains(&octave) {
            return None;
        }
        let size = self.config.pyramid_scale.powf(octave);
        let pixel = PINHOLE.project(&p_in_camera.coords).filter(|pixel| PINHOLE.contains(pixel, 1.0))?;
        let noise = Vector2::new(self.normal(), self.normal()) * (PIXEL_SIGMA * size);
        let (sigma, assumed) = match self.world.sensor() {
            Sensor::Stereo { baseline_metres } => {
                let per_pixel = size / (PINHOLE.fx * baseline_metres);
                (DISPARITY_SIGMA * per_pixel, self.config.disparity_sigma * per_pixel)
            }
            _ => (0.5 * self.config.inverse_depth_sigma, self.config.inverse_depth_sigma),
        };
        let mut inverse_depth = 1.0 / p_in_camera.z + sigma * self.normal();
        if self.random.f64() < FALSE_DEPTHS {
            inverse_depth *= 0.5 + self.random.f64();
        }
        let depth_metres = Some(1.0 / inverse_depth).filter(|z| *z > self.config.min_depth_metres && *z < self.scale.depth_reach);
        let mut descriptor = point.descriptor;
        for _ in 0..self.random.usize(0..=FLIPPED_BITS) {
            descriptor.0[self.random.usize(0..4)] ^= 1 << self.random.u32(0..64);
        }
        Some(Feature {
            pixel: pixel + noise,
            octave: octave as u8,
            angle_rad: (0.1 * self.normal()) as f32,
            depth_metres,
            inverse_depth_sigma: if depth_metres.is_some() { assumed } else { 0.0 },
            descriptor,
        })
    }

    /// A draw from the standard normal distribution (Box & Muller, 1958).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.random.f64()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.random.f64()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::{Alignment, evaluate_trajectory};
    use crate::geometry::StampedPose;

    #[test]
    fn a_walk_is_smooth_and_the_same_each_time() {
        for world in [World::Rooms, World::Streets, World::Corridor] {
            let config = TrackingConfig::default();
            let (mut a, mut b) = (Walk::new(world, 3, &config), Walk::new(world, 3, &config));
            let mut last: Option<Se3> = None;
            for _ in 0..300 {
                let ((frame, pose), (again, _)) = (a.frame(), b.frame());
                assert_eq!(frame.features.features, again.features.features);
                assert!(frame.features.len() > 100, "{world:?}: frame {} has {} features", frame.index, frame.features.len());
                if let Some(last) = last {
                    let step = last.inverse() * pose;
                    assert!(
                        step.translation.vector.norm() < 1.5 * world.scale().step && step.rotation.angle() < 0.2,
                        "{world:?}"
                    );
                }
                last = Some(pose);
            }
        }
    }

    #[test]
    fn the_tracker_follows_a_walk_with_its_settings_as_they_are() {
        let config = TrackingConfig::default();
        let mut walk = Walk::new(World::Rooms, 7, &config);
        let mut tracker = Tracker::new(Walk::camera(), World::Rooms.sensor(), &config).unwrap();
        let mut truth = Trajectory::default();
        for _ in 0..240 {
            let (frame, world_from_camera) = walk.frame();
            truth.poses.push(StampedPose { timestamp_s: frame.timestamp_s, world_from_camera });
            tracker.track_extracted(&frame, true).unwrap();
        }
        tracker.finish().unwrap();
        let poses: Vec<StampedPose> = tracker.trajectory().into_iter().map(|(_, pose)| pose).collect();
        assert_eq!(poses.len(), 240);
        let errors = evaluate_trajectory(&truth, &Trajectory { poses }, Alignment::Rigid).unwrap();
        assert!(errors.ate_rmse_m < 0.05, "{} m", errors.ate_rmse_m);
    }
}
