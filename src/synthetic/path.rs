//! The camera's way through the room or the building: a smooth curve walked at a bounded pace, with a hand's shake on top.
//!
//! World: z up, origin in the room's corner, so the room is `0..width × 0..depth × 0..height`.

use std::f64::consts::{FRAC_1_SQRT_2, TAU};

use fastrand::Rng;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::SceneError;
use super::building::FloorPlan;
use super::config::{PathConfig, PathKind, SceneConfig};
use super::walk::Walk;
use crate::geometry::Se3;

/// Samples of the curve per turn of its parameter, fine enough that the pace is even.
const SAMPLES_PER_TURN: usize = 2048;
/// A hand shakes in this band, Hz; more slowly it is part of the path, faster it has no amplitude left.
const SHAKE_BAND_HZ: (f64, f64) = (0.25, 1.8);
const SHAKE_WAVES: usize = 6;
/// Beginning and end of a drive, shares of the room's width.
const DRIVE: (f64, f64) = (0.06, 0.7);

/// Position in the room, and where the camera looks: metres and radians.
#[derive(Clone, Copy)]
pub struct Station {
    pub position: Vector3<f64>,
    pub yaw_rad: f64,
    pub pitch_rad: f64,
}

struct Wave {
    hz: f64,
    phase: f64,
    amplitude: f64,
}

pub struct CameraPath {
    kind: PathKind,
    /// Rounds of a loop, rooms of a walk: turns of the curve's parameter.
    rounds: f64,
    /// Through the rooms of a building.
    walk: Option<Walk>,
    room: Vector3<f64>,
    height: f64,
    /// Seconds at which each sample of the curve is reached, going as fast as allowed.
    reached_s: Vec<f64>,
    /// Curve seconds per second of the recording.
    rate: f64,
    /// Six: translation (metres), then rotation (radians).
    shake: Vec<Vec<Wave>>,
}

impl CameraPath {
    pub fn new(config: &SceneConfig) -> Result<Self, SceneError> {
        let path = &config.path;
        let plan = FloorPlan::new(config);
        let (rounds, of) = match path.kind {
            PathKind::Sweep => (1, "sweeps"),
            PathKind::Loop => (path.rounds, "rounds"),
            PathKind::Walk => (plan.way.len() as u32, "rooms"),
            PathKind::Drive => (1, "drives"),
        };
        let room = Vector3::new(config.room.width, config.room.depth, config.room.height);
        let mut rng = Rng::with_seed(config.seed ^ 0x05EE_D0FA_11AD);
        let shake = (0..6).map(|axis| shake_waves(path, axis, &mut rng)).collect();
        let mut this = Self {
            kind: path.kind,
            rounds: f64::from(rounds),
            walk: (path.kind == PathKind::Walk).then(|| Walk::new(&plan, path.height)),
            room,
            height: path.height,
            reached_s: vec![0.0],
            rate: 1.0,
            shake,
        };
        let samples = SAMPLES_PER_TURN * rounds as usize;
        for i in 0..samples {
            let [a, b] = [i, i + 1].map(|k| this.station(k as f64 / SAMPLES_PER_TURN as f64 * TAU));
            let turned = look(&a).rotation_to(&look(&b)).angle();
            let pace = ((b.position - a.position).norm() / path.speed).hypot(turned / path.turn_rate.to_radians());
            this.reached_s.push(this.reached_s[i] + pace);
        }
        if path.kind != PathKind::Sweep {
            let needed_s = this.reached_s[samples];
            let given_s = (config.frames.max(2) - 1) as f64 / config.fps;
            if needed_s > given_s * (1.0 + 1e-9) {
                let needed = (needed_s * config.fps).ceil() as usize + 1;
                return Err(SceneError::TooFewFrames { rounds, of, frames: config.frames, needed });
            }
            this.rate = needed_s / given_s;
        }
        Ok(this)
    }

    /// The camera's pose `t_s` seconds into the recording.
    pub fn world_from_camera(&self, t_s: f64) -> Se3 {
        let station = self.station(self.parameter(t_s * self.rate));
        let offset =
            |axis: usize| -> f64 { self.shake[axis].iter().map(|w| w.amplitude * (TAU * w.hz * t_s + w.phase).sin()).sum() };
        let position = station.position + Vector3::new(offset(0), offset(1), offset(2));
        let tremor = UnitQuaternion::from_scaled_axis(Vector3::new(offset(3), offset(4), offset(5)));
        Isometry3::from_parts(Translation3::from(position), look(&station) * tremor)
    }

    /// The curve's parameter after `s` seconds along it; past its end it starts over.
    fn parameter(&self, s: f64) -> f64 {
        let total = self.reached_s[self.reached_s.len() - 1];
        let (turns, rest) = ((s / total).floor(), s.rem_euclid(total));
        let after = self.reached_s.partition_point(|r| *r <= rest).clamp(1, self.reached_s.len() - 1);
        let (from, to) = (self.reached_s[after - 1], self.reached_s[after]);
        let sample = (after - 1) as f64 + if to > from { (rest - from) / (to - from) } else { 0.0 };
        (sample / SAMPLES_PER_TURN as f64 + turns * self.rounds) * TAU
    }

    fn station(&self, phi: f64) -> Station {
        match (&self.walk, self.kind) {
            (Some(walk), _) => walk.station(phi / (TAU * self.rounds)),
            (None, PathKind::Sweep) => self.sweep(phi),
            (None, PathKind::Drive) => self.drive(phi),
            (None, _) => self.round(phi),
        }
    }

    /// To and fro across the diagonal that leads into the corner at the origin.
    fn sweep(&self, phi: f64) -> Station {
        let reach = 0.16 * self.room.x.min(self.room.y);
        let across = Vector3::new(FRAC_1_SQRT_2, -FRAC_1_SQRT_2, 0.0) * (reach * phi.cos());
        let along = Vector3::new(FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0) * (0.4 * reach * phi.sin());
        let middle = Vector3::new(0.56 * self.room.x, 0.56 * self.room.y, self.height + 0.12 * (2.0 * phi).sin());
        Station {
            position: middle + across + along,
            yaw_rad: (225.0 + 38.0 * (phi + 0.2).cos()).to_radians(),
            pitch_rad: (-17.0 + 5.0 * (2.0 * phi + 1.0).sin()).to_radians(),
        }
    }

    /// Along the middle of the room with gentle bends, as a car keeps to its lane.
    fn drive(&self, phi: f64) -> Station {
        let along = Vector3::x() * (self.room.x * (DRIVE.1 - DRIVE.0) / TAU);
        let bend = 0.04 * self.room.y;
        let across = Vector3::y() * (bend * phi.sin() + 0.5 * bend * (2.3 * phi).sin());
        let slope = bend * phi.cos() + 1.15 * bend * (2.3 * phi).cos();
        Station {
            position: Vector3::new(DRIVE.0 * self.room.x, 0.5 * self.room.y, self.height) + along * phi + across,
            yaw_rad: slope.atan2(along.x),
            pitch_rad: -0.03,
        }
    }

    /// Round an ellipse in the middle of the room, looking outwards and a little ahead; no two rounds are quite the same.
    fn round(&self, phi: f64) -> Station {
        let wobble = 1.0 + 0.1 * (phi * (self.rounds + 1.0) / self.rounds).sin();
        let radii = Vector3::new((self.room.x * 0.5 - 1.95).max(0.3), (self.room.y * 0.5 - 1.85).max(0.3), 0.0) * wobble;
        let offset = Vector3::new(radii.x * phi.cos(), radii.y * phi.sin(), 0.08 * (2.0 * phi).sin());
        Station {
            position: Vector3::new(self.room.x * 0.5, self.room.y * 0.5, self.height) + offset,
            yaw_rad: phi + 25f64.to_radians(),
            pitch_rad: (-13.0 + 4.0 * (3.0 * phi).sin()).to_radians(),
        }
    }
}

/// Camera to world for a viewing direction: x right, y down, z forward.
fn look(station: &Station) -> UnitQuaternion<f64> {
    let (sin_yaw, cos_yaw) = station.yaw_rad.sin_cos();
    let (sin_pitch, cos_pitch) = station.pitch_rad.sin_cos();
    let forward = Vector3::new(cos_pitch * cos_yaw, cos_pitch * sin_yaw, sin_pitch);
    let right = Vector3::new(sin_yaw, -cos_yaw, 0.0);
    let down = forward.cross(&right);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward])))
}

fn shake_waves(path: &PathConfig, axis: usize, rng: &mut Rng) -> Vec<Wave> {
    let largest = if axis < 3 { path.shake_metres } else { path.shake_degrees.to_radians() };
    let (low, high) = SHAKE_BAND_HZ;
    let mut waves: Vec<Wave> = (0..SHAKE_WAVES)
        .map(|k| {
            let hz = low * (high / low).powf((k as f64 + rng.f64()) / SHAKE_WAVES as f64);
            Wave { hz, phase: rng.f64() * TAU, amplitude: 1.0 / hz }
        })
        .collect();
    // Root mean square at half of the largest excursion: two standard deviations are rarely passed.
    let rms = (waves.iter().map(|w| w.amplitude * w.amplitude * 0.5).sum::<f64>()).sqrt();
    waves.iter_mut().for_each(|w| w.amplitude *= 0.5 * largest / rms);
    waves
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(edit: impl Fn(&mut SceneConfig)) -> (CameraPath, SceneConfig) {
        let mut config = SceneConfig::default();
        edit(&mut config);
        (CameraPath::new(&config).unwrap(), config)
    }

    #[test]
    fn the_camera_keeps_to_its_pace_and_stays_upright() {
        let (path, config) = path(|c| (c.path.shake_metres, c.path.shake_degrees) = (0.0, 0.0));
        for i in 0..600 {
            let (a, b) = (path.world_from_camera(f64::from(i) * 0.02), path.world_from_camera(f64::from(i) * 0.02 + 0.01));
            assert!((b.translation.vector - a.translation.vector).norm() <= config.path.speed * 0.01 * 1.001);
            assert!(a.rotation.angle_to(&b.rotation) <= config.path.turn_rate.to_radians() * 0.01 * 1.001);
            assert!((a.rotation * Vector3::x()).z.abs() < 1e-9 && (a.rotation * Vector3::y()).z < -0.8);
        }
    }

    #[test]
    fn shake_has_the_size_that_was_asked_for() {
        let (still, _) = path(|c| (c.path.shake_metres, c.path.shake_degrees) = (0.0, 0.0));
        let (shaken, _) = path(|_| ());
        let (mut moved, mut turned) = (0.0f64, 0.0f64);
        for i in 0..3000 {
            let (a, b) = (still.world_from_camera(f64::from(i) * 0.01), shaken.world_from_camera(f64::from(i) * 0.01));
            moved = moved.max((a.translation.vector - b.translation.vector).amax());
            turned = turned.max(a.rotation.angle_to(&b.rotation).to_degrees());
        }
        assert!((0.007..0.017).contains(&moved) && (0.7..2.4).contains(&turned), "{moved} m, {turned}°");
    }

    #[test]
    fn a_drive_goes_along_the_room_and_looks_where_it_goes() {
        let (path, config) = path(|c| {
            (c.path.kind, c.frames, c.room.width, c.path.speed) = (PathKind::Drive, 100, 30.0, 8.0);
            (c.path.shake_metres, c.path.shake_degrees) = (0.0, 0.0);
        });
        let at = |frame: f64| path.world_from_camera(frame / config.fps);
        let travelled = at(99.0).translation.x - at(0.0).translation.x;
        assert!((travelled - (DRIVE.1 - DRIVE.0) * 30.0).abs() < 1e-6, "{travelled}");
        // Before the first frame and after the last one it goes on, for the exposure's sake.
        for frame in -1..100 {
            let (a, b) = (at(f64::from(frame)), at(f64::from(frame) + 0.5));
            let (moved, ahead) = (b.translation.vector - a.translation.vector, a.rotation * Vector3::z());
            assert!(
                (0.05..0.2).contains(&moved.norm()) && moved.xy().normalize().dot(&ahead.xy().normalize()) > 0.999,
                "{frame}"
            );
        }
    }

    #[test]
    fn a_loop_returns_to_its_start_and_says_how_many_frames_it_takes() {
        let edit = |c: &mut SceneConfig| {
            (c.path.kind, c.path.rounds, c.frames) = (PathKind::Loop, 2, 1200);
            (c.path.shake_metres, c.path.shake_degrees) = (0.0, 0.0);
        };
        let (path, config) = path(edit);
        let (start, end) = (path.world_from_camera(0.0), path.world_from_camera(1199.0 / config.fps));
        assert!(
            (start.translation.vector - end.translation.vector).norm() < 1e-6 && start.rotation.angle_to(&end.rotation) < 1e-6
        );
        let mut short = SceneConfig { frames: 100, ..config };
        let Err(SceneError::TooFewFrames { needed, .. }) = CameraPath::new(&short) else { panic!("100 frames are too few") };
        short.frames = needed;
        assert!(CameraPath::new(&short).is_ok());
    }
}
