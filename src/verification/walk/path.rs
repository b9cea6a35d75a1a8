//! The way through a grid of halls: straight on or round a corner at each crossing, never back.

use nalgebra::{Point2, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

use super::{Scale, World};
use crate::geometry::Se3;

/// Corners are cut from this share of an edge on.
const CORNER: f64 = 0.25;
/// Sway of the camera: radians, and metres as a share of half the hall's width.
const SWAY_RAD: f64 = 0.05;
const SWAY_SHARE: f64 = 0.05;

/// A crossing's place in the grid.
pub type Crossing = (i64, i64);

/// The crossings of a walk, which grow as it goes on.
#[derive(Debug)]
pub struct Path {
    world: World,
    scale: Scale,
    crossings: Vec<Crossing>,
    random: fastrand::Rng,
}

impl Path {
    pub fn new(world: World, seed: u64) -> Self {
        let crossings = vec![(0, 0), (1, 0)];
        Self { world, scale: world.scale(), crossings, random: fastrand::Rng::with_seed(seed ^ 0x0070_6174) }
    }

    /// world_from_camera of a frame; y points down.
    pub fn pose(&mut self, frame: usize) -> Se3 {
        let along = frame as f64 * self.scale.step / self.scale.edge + 0.5;
        while self.crossings.len() < along as usize + 3 {
            self.go_on();
        }
        let (at, ahead) = self.at(along);
        let phase = |period: f64| std::f64::consts::TAU * frame as f64 / self.scale.frames_per_s / period;
        let sway = SWAY_SHARE * self.scale.half_width;
        let (x, z) = (self.scale.edge * at.x, self.scale.edge * at.y);
        let centre = Vector3::new(x + sway * phase(2.3).sin(), sway * phase(1.1).sin() - 0.6 * self.scale.height, z);
        let yaw = ahead.x.atan2(ahead.y) + SWAY_RAD * phase(3.1).sin();
        let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), SWAY_RAD * phase(1.7).sin());
        Se3::from_parts(Translation3::from(centre), UnitQuaternion::from_rotation_matrix(&rotation))
    }

    /// Place in units of an edge and direction, `along` that many edges; corners are cut by a parabola.
    fn at(&self, along: f64) -> (Point2<f64>, Vector2<f64>) {
        let place = |k: usize| Point2::new(self.crossings[k].0 as f64, self.crossings[k].1 as f64);
        let nearest = along.round() as usize;
        let off = along - nearest as f64;
        if nearest == 0 || off.abs() >= CORNER {
            let (from, to) = (place(along as usize), place(along as usize + 1));
            return (from + (to - from) * along.fract(), to - from);
        }
        let (before, corner, after) = (place(nearest - 1), place(nearest), place(nearest + 1));
        let (from, to) = (corner + (before - corner) * CORNER, corner + (after - corner) * CORNER);
        let t = (off + CORNER) / (2.0 * CORNER);
        let at = from.coords * (1.0 - t) * (1.0 - t) + corner.coords * (2.0 * t * (1.0 - t)) + to.coords * t * t;
        let ahead = (corner - from) * (1.0 - t) + (to - corner) * t;
        (at.into(), ahead)
    }

    fn go_on(&mut self) {
        let [before, here] = *self.crossings.last_chunk().expect("it begins with two");
        let next = match self.world {
            World::Corridor => ring(here),
            World::Rooms | World::Streets => {
                let neighbours = [(1, 0), (-1, 0), (0, 1), (0, -1)].map(|(x, z)| (here.0 + x, here.1 + z));
                let inside = |c: &Crossing| [c.0, c.1].iter().all(|v| (0..self.scale.crossings).contains(v));
                let open: Vec<Crossing> = neighbours.into_iter().filter(|c| inside(c) && *c != before).collect();
                open[self.random.usize(0..open.len())]
            }
        };
        self.crossings.push(next);
    }
}

/// Side of the corridor's ring, crossings.
pub const RING: i64 = 6;

/// The crossing after `here` on the ring.
fn ring((x, z): Crossing) -> Crossing {
    match (x, z) {
        (x, 0) if x < RING => (x + 1, 0),
        (RING, z) if z < RING => (RING, z + 1),
        (x, RING) if x > 0 => (x - 1, RING),
        _ => (0, z - 1),
    }
}
