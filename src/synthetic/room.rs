//! Furnishes the rooms: draws places for each piece until it stands free of the others and clear of the camera's path.

use fastrand::Rng;
use glam::{DMat3, DVec2, DVec3, Vec3, dvec3};
use nalgebra::Translation3;
use rayon::prelude::*;

use super::SceneError;
use super::building::{FloorPlan, Rooms};
use super::config::{RoomConfig, SceneConfig};
use super::furniture::Piece;
use super::shapes::{Primitive, Shape};
use super::texture::Material;
use crate::geometry::Se3;

/// Furniture keeps this far from the sampled path, metres; between samples the camera comes no nearer than [`MIN_CLEARANCE`].
const FURNITURE_CLEARANCE: f64 = 0.55;
/// No camera position may be nearer to a surface, metres.
pub const MIN_CLEARANCE: f64 = 0.4;
/// Places tried for a piece before the room counts as full.
const TRIES: usize = 1500;
/// Candidate places of a piece, compared by the share of it that the camera sees.
const CHOICES: usize = 14;
/// Poses so far outside of a room still count for its furnishing, metres.
const NEAR_ROOM: f64 = 1.0;
/// Gap between two pieces, metres.
const GAP: f64 = 0.04;

/// The furnished room or building. Solid 0 is the shell.
pub fn furnish(config: &SceneConfig, path: &[Se3]) -> Result<(Vec<Primitive>, Rooms), SceneError> {
    let mut rooms = Rooms::new(FloorPlan::new(config));
    let mut rng = Rng::with_seed(config.seed);
    if rooms.plan.rooms() == 1 {
        let solids = furnish_room(config, path, rng, &[])?;
        rooms.give(0, 0..solids.len());
        return Ok((solids, rooms));
    }
    let mut solids = rooms.build(&mut rng);
    let seeds: Vec<u64> = (0..rooms.plan.rooms()).map(|_| rng.u64(..)).collect();
    let plan = &rooms.plan;
    let furnished: Result<Vec<Vec<Primitive>>, SceneError> = seeds
        .into_par_iter()
        .enumerate()
        .map(|(room, seed)| {
            let corner = plan.corner(room);
            let poses = poses_near(plan, room, path);
            // Solid 0 is the shell of a lone room.
            Ok(place(&furnish_room(config, &poses, Rng::with_seed(seed), &plan.aisles(room))?[1..], DMat3::IDENTITY, corner))
        })
        .collect();
    for (room, pieces) in furnished?.into_iter().enumerate() {
        rooms.give(room, solids.len()..solids.len() + pieces.len());
        solids.extend(pieces);
    }
    Ok((solids, rooms))
}

/// Poses in a room and just outside of it, moved to the room's own frame.
fn poses_near(plan: &FloorPlan, room: usize, path: &[Se3]) -> Vec<Se3> {
    let corner = plan.corner(room);
    let near = |p: DVec3| p.cmpgt(DVec3::splat(-NEAR_ROOM)).all() && p.cmplt(plan.room + NEAR_ROOM).all();
    let shift = Translation3::new(-corner.x, -corner.y, -corner.z);
    path.iter().filter(|pose| near(position(pose) - corner)).map(|pose| shift * pose).collect()
}

/// A shell with what stands in it, around `aisles` (boxes) that stay free.
fn furnish_room(
    config: &SceneConfig,
    path: &[Se3],
    mut rng: Rng,
    aisles: &[(DVec3, DVec3)],
) -> Result<Vec<Primitive>, SceneError> {
    let room = &config.room;
    let half = dvec3(room.width, room.depth, room.height) * 0.5;
    let seed = rng.u32(..);
    let shell = Primitive {
        shape: Shape::Shell { half },
        centre: half,
        world_from_local: DMat3::IDENTITY,
        material: Material::Room,
        seed,
    };
    let mut layout = Layout { room, path, rng, solids: vec![shell], taken: aisles.to_vec() };
    layout.lights();
    let f = &config.furniture;
    // Large and wall-bound things first, while there is room.
    layout.several("furniture.windows", f.windows, |_, piece, _| piece.window())?;
    layout.several("furniture.shelves", f.shelves, |_, piece, _| piece.shelf())?;
    layout.several("furniture.sofas", f.sofas, |_, piece, _| piece.sofa())?;
    layout.several(
        "furniture.tables",
        f.tables,
        |k, piece, _| if k.is_multiple_of(2) { piece.desk() } else { piece.dining_table() },
    )?;
    layout.several("furniture.cabinets", f.cabinets, |_, piece, _| piece.cabinet())?;
    layout.several("furniture.plants", f.plants, |_, piece, _| piece.plant())?;
    layout.several("furniture.lamps", f.lamps, |_, piece, _| piece.lamp())?;
    layout.several("furniture.boxes", f.boxes, |_, piece, _| piece.boxes())?;
    layout.several("furniture.pictures", f.pictures, |_, piece, rng| piece.picture(1.45 + 0.35 * rng.f64()))?;
    layout.rugs(f.rugs);
    Ok(layout.solids)
}

struct Layout<'a> {
    room: &'a RoomConfig,
    /// Sampled poses, camera to world.
    path: &'a [Se3],
    rng: Rng,
    solids: Vec<Primitive>,
    /// Boxes around the pieces that stand already.
    taken: Vec<(DVec3, DVec3)>,
}

impl Layout<'_> {
    fn several(
        &mut self,
        field: &'static str,
        count: usize,
        build: impl Fn(usize, &mut Piece, &mut Rng),
    ) -> Result<(), SceneError> {
        for k in 0..count {
            let mut piece = Piece::new(self.rng.u64(..));
            build(k, &mut piece, &mut self.rng);
            if !self.place_at_wall(&piece.solids) {
                return Err(SceneError::NoPlace { field, index: k + 1 });
            }
        }
        Ok(())
    }

    /// Draws places with the back to a wall; takes the one the camera sees best among the first that fit.
    fn place_at_wall(&mut self, piece: &[Primitive]) -> bool {
        let (low, high) = around(piece);
        let mut best: Option<(f64, Vec<Primitive>)> = None;
        let mut found = 0;
        for _ in 0..TRIES {
            let wall = self.rng.usize(..4);
            let along = if wall.is_multiple_of(2) { self.room.width } else { self.room.depth };
            let slack = along - (high.x - low.x) - 2.0 * GAP;
            let draw = self.rng.f64();
            if slack <= 0.0 {
                continue;
            }
            let moved = self.at_wall(piece, wall, draw * slack + GAP - low.x);
            if !self.fits(&moved) {
                continue;
            }
            let score = self.seen(&moved) + 0.25 * self.rng.f64();
            if best.as_ref().is_none_or(|(s, _)| score > *s) {
                best = Some((score, moved));
            }
            found += 1;
            if found == CHOICES {
                break;
            }
        }
        let Some((_, chosen)) = best else { return false };
        self.taken.push(around(&chosen));
        self.solids.extend(chosen);
        true
    }

    /// A piece turned with its back to wall `wall` (0: y = 0, then anticlockwise), its origin `along` metres from the wall's left end.
    fn at_wall(&self, piece: &[Primitive], wall: usize, along: f64) -> Vec<Primitive> {
        let (w, d) = (self.room.width, self.room.depth);
        let origin = match wall {
            0 => dvec3(along, 0.0, 0.0),
            1 => dvec3(w, along, 0.0),
            2 => dvec3(w - along, d, 0.0),
            _ => dvec3(0.0, d - along, 0.0),
        };
        place(piece, DMat3::from_rotation_z(wall as f64 * std::f64::consts::FRAC_PI_2), origin)
    }

    fn fits(&self, piece: &[Primitive]) -> bool {
        let (low, high) = around(piece);
        let apart = |(l, h): &(DVec3, DVec3)| (low - GAP).cmpge(*h).any() || (high + GAP).cmple(*l).any();
        let inside = low.cmpge(DVec3::splat(-0.03)).all()
            && high.x <= self.room.width + 0.03
            && high.y <= self.room.depth + 0.03
            && high.z <= self.room.height - 0.1;
        inside && self.taken.iter().all(apart) && self.path.iter().all(|pose| clear(piece, position(pose)))
    }

    /// Share of the path from which the piece's middle is in view.
    fn seen(&self, piece: &[Primitive]) -> f64 {
        let (low, high) = around(piece);
        let middle = (low + high) * 0.5;
        let views = self.path.iter().filter(|pose| in_view(pose, middle)).count();
        views as f64 / self.path.len().max(1) as f64
    }

    fn lights(&mut self) {
        for side in [0.28, 0.72] {
            let mut piece = Piece::new(self.rng.u64(..));
            piece.light_panel(self.room.height);
            let at = dvec3(self.room.width * side, self.room.depth * 0.5, 0.0);
            let moved = place(&piece.solids, DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2), at);
            self.solids.extend(moved);
        }
    }

    /// Rugs lie in the middle of what the camera sees of the floor; furniture may stand on them.
    fn rugs(&mut self, count: usize) {
        for k in 0..count {
            let mut piece = Piece::new(self.rng.u64(..));
            piece.rug();
            let mut best = (f64::NEG_INFINITY, Vec::new());
            for _ in 0..40 {
                let x = self.rng.f64() * (self.room.width - 2.3).max(0.1) + 1.15;
                let y = self.rng.f64() * (self.room.depth - 1.7).max(0.1) + 0.1;
                let lift = 0.0005 * k as f64;
                let moved = place(&piece.solids, DMat3::IDENTITY, dvec3(x, y, lift));
                let (low, high) = around(&moved);
                let covered = self.taken.iter().filter(|(l, h)| low.cmplt(*h).all() && high.cmpgt(*l).all()).count();
                let score = self.seen(&moved) - 0.3 * covered as f64;
                if score > best.0 {
                    best = (score, moved);
                }
            }
            self.solids.extend(best.1);
        }
    }
}

pub fn position(pose: &Se3) -> DVec3 {
    let t = pose.translation.vector;
    dvec3(t.x, t.y, t.z)
}

/// The camera's axes in the world.
pub fn axes(pose: &Se3) -> DMat3 {
    let r = pose.rotation.to_rotation_matrix();
    let column = |k: usize| dvec3(r[(0, k)], r[(1, k)], r[(2, k)]);
    DMat3::from_cols(column(0), column(1), column(2))
}

/// Whether a point lies well inside what a usual lens sees from `pose`.
pub fn in_view(pose: &Se3, p: DVec3) -> bool {
    let q = pose.inverse_transform_point(&nalgebra::Point3::new(p.x, p.y, p.z));
    q.z > 0.5 && q.x.abs() < 0.5 * q.z && q.y.abs() < 0.4 * q.z
}

fn clear(piece: &[Primitive], p: DVec3) -> bool {
    piece.iter().all(|solid| solid.distance(p) >= FURNITURE_CLEARANCE)
}

/// A piece moved from its own frame into the world.
pub fn place(piece: &[Primitive], turn: DMat3, origin: DVec3) -> Vec<Primitive> {
    let moved = piece.iter().map(|solid| Primitive {
        centre: origin + turn * solid.centre,
        world_from_local: turn * solid.world_from_local,
        ..solid.clone()
    });
    moved.collect()
}

fn around(piece: &[Primitive]) -> (DVec3, DVec3) {
    piece
        .iter()
        .map(Primitive::bounds)
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), (low, high)| (l.min(low), h.max(high)))
}

/// Something textured that travels to and fro between two places on the floor.
pub struct Mover {
    /// In its own frame, origin on the floor.
    solids: Vec<Primitive>,
    from: DVec3,
    to: DVec3,
    speed: f64,
}

impl Mover {
    /// Finds the way on which it is seen most, free of furniture and of the camera. `path` gives times and poses.
    pub fn new(config: &SceneConfig, path: &[(f64, Se3)], solids: &[Primitive]) -> Result<Self, SceneError> {
        const HALF_WIDTH: f64 = 0.24;
        let mut piece = Piece::new(config.seed ^ 0x0B07);
        piece.robot();
        let speed = if config.degradation.moving_speed > 0.0 { config.degradation.moving_speed } else { 0.4 };
        let mut rng = Rng::with_seed(config.seed ^ 0x0B08);
        let solids: Vec<&Primitive> = solids.iter().filter(|s| !matches!(s.material, Material::Rug { .. })).collect();
        let mut place = |_| dvec3(rng.f64() * config.room.width, rng.f64() * config.room.depth, 0.0);
        let free = |p: DVec3| {
            let axis = [0.2, 0.6, 1.0].map(|z| p + DVec3::Z * z);
            solids
                .iter()
                .all(|s| axis.iter().all(|q| s.distance(*q).max(q.z * f64::from(q.z < 0.2)) > HALF_WIDTH || is_floor(s, *q)))
        };
        let mut best: Option<(usize, DVec3, DVec3)> = None;
        let spots: Vec<DVec3> = (0..400).map(&mut place).filter(|p| free(*p)).take(60).collect();
        for (i, a) in spots.iter().enumerate() {
            for b in &spots[i + 1..] {
                let length = (*b - *a).length();
                let candidate = Self { solids: Vec::new(), from: *a, to: *b, speed };
                if length < 0.8 || !(1..12).all(|k| free(a.lerp(*b, f64::from(k) / 12.0))) || candidate.meets(path) {
                    continue;
                }
                let seen = path.iter().filter(|(t, pose)| in_view(pose, candidate.offset(*t) + DVec3::Z * 0.7)).count();
                if best.is_none_or(|(most, ..)| seen > most) {
                    best = Some((seen, *a, *b));
                }
            }
        }
        let (_, from, to) = best.ok_or(SceneError::NoPlace { field: "degradation.moving_object", index: 1 })?;
        Ok(Self { solids: piece.solids, from, to, speed })
    }

    /// Whether it ever comes too near to the camera.
    fn meets(&self, path: &[(f64, Se3)]) -> bool {
        path.iter().any(|(t, pose)| {
            let (p, q) = (position(pose), self.offset(*t));
            DVec2::new(p.x - q.x, p.y - q.y).length() < MIN_CLEARANCE + 0.35
        })
    }

    fn offset(&self, t_s: f64) -> DVec3 {
        let length = (self.to - self.from).length();
        self.from.lerp(self.to, 0.5 - 0.5 * (2.0 * self.speed * t_s / length).cos())
    }

    /// Its solids at a time.
    pub fn at(&self, t_s: f64) -> Vec<Primitive> {
        place(&self.solids, DMat3::IDENTITY, self.offset(t_s))
    }
}

/// The shell counts its floor as near, too: only the walls matter to something that stands.
fn is_floor(solid: &Primitive, p: DVec3) -> bool {
    let Shape::Shell { half } = solid.shape else { return false };
    let q = (p - solid.centre).abs();
    (half - q).truncate().min_element() > 0.24
}

/// Radiance of the luminaires, of the sky in the window and of lampshades: relative, since the camera sets its own exposure.
pub fn radiance(material: &Material) -> Option<Vec3> {
    match material {
        Material::LightPanel => Some(Vec3::new(6.0, 5.6, 4.9)),
        Material::Window => Some(Vec3::new(2.6, 3.0, 3.4)),
        Material::Lampshade => Some(Vec3::new(2.4, 1.8, 1.1)),
        _ => None,
    }
}
