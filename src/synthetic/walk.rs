//! A walk through the rooms of a building: in at each doorway, once round an ellipse in the room's middle, out at the next.
//!
//! The camera crosses the room to the far side of the ellipse before it turns, so that it never turns faster than on its way round.
//! A cubic spline through waypoints carries position, yaw and pitch together; its tangents are those of the parabola through three.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::DVec3;
use nalgebra::{SVector, Vector3};

use super::building::{Doorway, FloorPlan};
use super::path::Station;

/// Waypoints before and behind a doorway lie this far from its middle, metres: the camera passes straight through.
const APPROACH: f64 = 0.8;
/// Between waypoints of the ellipse, at most.
const STEP_RAD: f64 = PI / 6.0;
/// The ellipse is joined and left this much after and before its ends.
const JOIN_RAD: f64 = PI / 9.0;
/// The camera looks outwards and this much ahead.
const AHEAD_RAD: f64 = 25.0 * PI / 180.0;
const DOOR_PITCH_RAD: f64 = -10.0 * PI / 180.0;
/// What a radian counts as in metres when knots are spaced.
const METRES_PER_RADIAN: f64 = 0.8;

/// Position, yaw and pitch.
type Waypoint = SVector<f64, 5>;

pub struct Walk {
    points: Vec<Waypoint>,
    tangents: Vec<Waypoint>,
    /// Parameter of each waypoint, increasing.
    knots: Vec<f64>,
}

impl Walk {
    /// The walk at a mean height above the floor, metres.
    pub fn new(plan: &FloorPlan, height: f64) -> Self {
        let mut points = Vec::new();
        let doors: Vec<&Doorway> = plan.way.windows(2).filter_map(|pair| plan.door(pair[0], pair[1])).collect();
        let mut yaw = doors.first().map_or(0.0, |first| heading(first.out_of(plan.way[0])));
        for (k, room) in plan.way.iter().enumerate() {
            let (entrance, exit) = (k.checked_sub(1).map(|before| doors[before]), doors.get(k).copied());
            yaw = through(plan, &Visit { room: *room, entrance, exit }, height, yaw, &mut points);
        }
        let mut knots = vec![0.0];
        for pair in points.windows(2) {
            let change: Waypoint = pair[1] - pair[0];
            let (moved, turned) = (change.fixed_rows::<3>(0).norm(), change.fixed_rows::<2>(3).norm());
            knots.push(knots[knots.len() - 1] + moved.hypot(turned * METRES_PER_RADIAN));
        }
        let tangents = (0..points.len()).map(|i| tangent(&points, &knots, i)).collect();
        Self { points, tangents, knots }
    }

    /// The station at a share of the walk; 0 and 1 are its ends, and it does not go beyond.
    pub fn station(&self, share: f64) -> Station {
        let last = self.knots.len() - 1;
        let t = share.clamp(0.0, 1.0) * self.knots[last];
        let i = self.knots.partition_point(|knot| *knot <= t).clamp(1, last) - 1;
        let span = self.knots[i + 1] - self.knots[i];
        let u = (t - self.knots[i]) / span;
        let (square, cube) = (u * u, u * u * u);
        let p = self.points[i] * (2.0 * cube - 3.0 * square + 1.0)
            + self.points[i + 1] * (3.0 * square - 2.0 * cube)
            + (self.tangents[i] * (cube - 2.0 * square + u) + self.tangents[i + 1] * (cube - square)) * span;
        Station { position: Vector3::new(p[0], p[1], p[2]), yaw_rad: p[3], pitch_rad: p[4] }
    }
}

/// A room with the doorways by which it is entered and left.
struct Visit<'a> {
    room: usize,
    entrance: Option<&'a Doorway>,
    exit: Option<&'a Doorway>,
}

/// Yaw of someone who walks in a direction.
fn heading(ahead: DVec3) -> f64 {
    ahead.y.atan2(ahead.x)
}

/// Adds the waypoints of a room that is entered with a yaw; returns the yaw at its end.
fn through(plan: &FloorPlan, visit: &Visit<'_>, height: f64, yaw: f64, points: &mut Vec<Waypoint>) -> f64 {
    let &Visit { room, entrance, exit } = visit;
    let out = exit.map_or(yaw, |door| heading(door.out_of(room)));
    let aside = (out - yaw + PI).rem_euclid(TAU) - PI;
    let straight = aside.abs() < 0.25 * FRAC_PI_2;
    let side = if straight { if room.is_multiple_of(2) { 1.0 } else { -1.0 } } else { aside.signum() };
    let end = yaw + side * TAU + if straight { 0.0 } else { aside };
    let at = |p: DVec3, yaw: f64| Waypoint::from([p.x, p.y, height, yaw, DOOR_PITCH_RAD]);
    if let Some(door) = entrance {
        points.extend([at(door.middle(), yaw), at(door.middle() - door.out_of(room) * APPROACH, yaw)]);
    }
    let from = yaw + if entrance.is_some() { side * JOIN_RAD } else { 0.0 };
    let to = end - if exit.is_some() { side * JOIN_RAD } else { 0.0 };
    let steps = ((to - from).abs() / STEP_RAD).ceil();
    let middle = plan.corner(room) + plan.room * 0.5;
    let radii = [(plan.room.x * 0.5 - 1.95).max(0.3), (plan.room.y * 0.5 - 1.85).max(0.3)];
    for k in 0..=steps as usize {
        let phi = from + (to - from) * k as f64 / steps;
        let z = height + 0.08 * (2.0 * phi).sin();
        let pitch = (-13.0 + 4.0 * (3.0 * phi).sin()).to_radians();
        points.push(Waypoint::from([
            middle.x + radii[0] * phi.cos(),
            middle.y + radii[1] * phi.sin(),
            z,
            phi + side * AHEAD_RAD,
            pitch,
        ]));
    }
    if let Some(door) = exit {
        points.push(at(door.middle() - door.out_of(room) * APPROACH, end));
    }
    end
}

/// Slope at a waypoint of the parabola through it and its neighbours; at the ends, of the chord.
fn tangent(points: &[Waypoint], knots: &[f64], i: usize) -> Waypoint {
    let slope = |k: usize| (points[k + 1] - points[k]) / (knots[k + 1] - knots[k]);
    if i == 0 || i + 1 == points.len() {
        return slope(i.saturating_sub(1));
    }
    let (before, after) = (knots[i] - knots[i - 1], knots[i + 1] - knots[i]);
    (slope(i - 1) * after + slope(i) * before) / (before + after)
}
