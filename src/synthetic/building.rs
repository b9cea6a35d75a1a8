//! A building of rooms: their grid, the order in which a walk enters them, and the walls, floors and doorways between them.
//!
//! Rooms are numbered along a serpentine through the grid, and doorways join consecutive ones. Where the walk returns, a doorway
//! also joins the last room of a row and the first of the row before. World: origin in a corner of room 0, z up, metres.

use std::collections::BTreeSet;
use std::ops::Range;

use fastrand::Rng;
use glam::{DMat3, DVec2, DVec3, dvec3};

use super::config::SceneConfig;
use super::shapes::{Primitive, Shape};
use super::texture::Material;
use super::view::Outline;

/// Thickness of walls, floors and ceilings, metres.
const WALL: f64 = 0.15;
/// Clear width and height of a doorway, metres.
const DOOR: (f64, f64) = (1.0, 2.05);
/// Furniture keeps out of this depth before a doorway, metres.
const AISLE: f64 = 0.8;
/// A doorway's middle lies in this share of its wall, so that doorways rarely line up.
const DOOR_PLACE: (f64, f64) = (0.36, 0.64);
/// The shell lies this far outside of the walls, metres.
const MARGIN: f64 = 0.5;

/// The passage through a wall, a box as thick as the wall.
pub struct Doorway {
    pub low: DVec3,
    pub high: DVec3,
    /// The rooms that it joins.
    rooms: [usize; 2],
    /// Unit vector out of the first of them.
    ahead: DVec3,
}

impl Doorway {
    /// Its middle on the floor.
    pub fn middle(&self) -> DVec3 {
        ((self.low + self.high) * 0.5).with_z(0.0)
    }

    /// Unit vector through it, out of a room.
    pub fn out_of(&self, room: usize) -> DVec3 {
        if room == self.rooms[0] { self.ahead } else { -self.ahead }
    }

    /// The room on the other side; `None` if it is not one of `room`.
    fn beyond(&self, room: usize) -> Option<usize> {
        self.rooms.contains(&room).then(|| self.rooms[0] + self.rooms[1] - room)
    }
}

/// The rooms' grid. A single room has no doorway, and its walls are the shell.
pub struct FloorPlan {
    /// Rooms along x and along y.
    grid: [usize; 2],
    /// Inner size of each room.
    pub room: DVec3,
    pub doors: Vec<Doorway>,
    /// Rooms in the order in which a walk enters them.
    pub way: Vec<usize>,
}

impl FloorPlan {
    pub fn new(config: &SceneConfig) -> Self {
        let r = &config.room;
        let mut plan = Self { grid: r.rooms, room: dvec3(r.width, r.depth, r.height), doors: Vec::new(), way: Vec::new() };
        let mut rng = Rng::with_seed(config.seed ^ 0xD005);
        let along = (1..plan.rooms()).map(|k| [k - 1, k]);
        let mut doorway = |rooms| plan.doorway(rooms, DOOR_PLACE.0 + (DOOR_PLACE.1 - DOOR_PLACE.0) * rng.f64());
        let mut doors: Vec<Doorway> = along.map(&mut doorway).collect();
        let returns = if config.path.returns { plan.returns() } else { Vec::new() };
        doors.extend(returns.iter().copied().map(&mut doorway));
        plan.doors = doors;
        for room in 0..plan.rooms() {
            plan.way.push(room);
            plan.way.extend(returns.iter().filter(|[last, _]| *last == room).flat_map(|[last, first]| [*first, *last]));
        }
        plan
    }

    /// The last room of each row but the first, and the first of the row before, which lies beside it.
    fn returns(&self) -> Vec<[usize; 2]> {
        let [columns, rows] = self.grid;
        (1..rows).map(|row| [(row + 1) * columns - 1, (row - 1) * columns]).collect()
    }

    /// The doorway between two rooms.
    pub fn door(&self, a: usize, b: usize) -> Option<&Doorway> {
        self.doors.iter().find(|door| door.beyond(a) == Some(b))
    }

    pub fn rooms(&self) -> usize {
        self.grid[0] * self.grid[1]
    }

    /// From a room's corner to that of the next along x and y.
    fn pitch(&self) -> DVec2 {
        self.room.truncate() + WALL
    }

    /// The number of the room in a column and row, if there is one.
    fn number(&self, column: Option<usize>, row: Option<usize>) -> Option<usize> {
        let (column, row) = (column.filter(|c| *c < self.grid[0])?, row.filter(|r| *r < self.grid[1])?);
        Some(row * self.grid[0] + if row.is_multiple_of(2) { column } else { self.grid[0] - 1 - column })
    }

    /// A room's lowest corner.
    pub fn corner(&self, room: usize) -> DVec3 {
        let (row, place) = (room / self.grid[0], room % self.grid[0]);
        let column = if row.is_multiple_of(2) { place } else { self.grid[0] - 1 - place };
        (DVec2::new(column as f64, row as f64) * self.pitch()).extend(0.0)
    }

    /// The room a point lies in, or whose wall it lies in.
    pub fn room_at(&self, p: DVec3) -> usize {
        let cell = (p.truncate() + WALL * 0.5) / self.pitch();
        let index = |axis: usize| Some((cell[axis].max(0.0) as usize).min(self.grid[axis] - 1));
        self.number(index(0), index(1)).unwrap_or_default()
    }

    /// Whether light of one room falls into the other.
    pub fn joined(&self, a: usize, b: usize) -> bool {
        a == b || self.door(a, b).is_some()
    }

    /// The doorway between two neighbours, with its middle at a share of the wall.
    fn doorway(&self, rooms: [usize; 2], share: f64) -> Doorway {
        let [here, next] = rooms.map(|room| self.corner(room));
        let ahead = (next - here).normalize();
        let axis = usize::from(ahead.x.abs() < 0.5);
        let (across, from) = (1 - axis, here.max(next));
        let (mut low, mut high) = (from, from);
        low[axis] -= WALL;
        (low[across], high[across]) =
            (from[across] + self.room[across] * share - DOOR.0 * 0.5, from[across] + self.room[across] * share + DOOR.0 * 0.5);
        Doorway { low, high: high.with_z(DOOR.1), rooms, ahead }
    }

    /// Boxes before a room's doorways where no furniture may stand, from the room's corner.
    pub fn aisles(&self, room: usize) -> Vec<(DVec3, DVec3)> {
        let doors = self.doors.iter().filter(|door| door.rooms.contains(&room));
        let aisle = |door: &Doorway| {
            let reach = door.ahead.abs() * AISLE;
            (door.low - reach - self.corner(room), door.high + reach - self.corner(room))
        };
        doors.map(aisle).collect()
    }

    /// Rooms of which a camera may see something: those whose doorways lie behind each other in its picture.
    pub fn seen_from(&self, origin: DVec3, world_from_camera: &DMat3) -> BTreeSet<usize> {
        let outline = |door: &Doorway| {
            let (middle, half) = ((door.low + door.high) * 0.5 - origin, (door.high - door.low) * 0.5);
            Outline::of_box(world_from_camera.transpose() * middle, &world_from_camera.transpose(), half)
        };
        let mut seen = BTreeSet::new();
        self.look(&mut vec![self.room_at(origin)], Outline::everything(), &outline, &mut seen);
        seen
    }

    /// Adds the last of the `rooms` that a line of sight has passed, and those seen beyond it through a gap. No line enters a room twice.
    fn look(&self, rooms: &mut Vec<usize>, gap: Outline, outline: &impl Fn(&Doorway) -> Outline, seen: &mut BTreeSet<usize>) {
        let here = rooms[rooms.len() - 1];
        seen.insert(here);
        for door in &self.doors {
            let Some(next) = door.beyond(here).filter(|next| !rooms.contains(next)) else { continue };
            let mut narrower = gap;
            if narrower.narrow(&outline(door)) {
                rooms.push(next);
                self.look(rooms, narrower, outline, seen);
                rooms.pop();
            }
        }
    }
}

/// The rooms, and the solids that belong to each.
pub struct Rooms {
    pub plan: FloorPlan,
    /// Indices into the scene's solids, for each room; a wall belongs to the rooms on both sides.
    solids: Vec<Vec<u32>>,
}

impl Rooms {
    pub fn new(plan: FloorPlan) -> Self {
        let solids = vec![Vec::new(); plan.rooms()];
        Self { plan, solids }
    }

    /// Gives solids `range` to a room.
    pub fn give(&mut self, room: usize, range: Range<usize>) {
        self.solids[room].extend(range.map(|k| k as u32));
    }

    /// The solids of some rooms, in the scene's order.
    pub fn solids(&self, rooms: &BTreeSet<usize>) -> Vec<u32> {
        let mut all: Vec<u32> = rooms.iter().flat_map(|room| &self.solids[*room]).copied().collect();
        if rooms.len() > 1 {
            all.sort_unstable();
            all.dedup();
        }
        all
    }

    /// The solids of a point's room and of those joined to it.
    pub fn solids_near(&self, p: DVec3) -> impl Iterator<Item = usize> + '_ {
        let here = self.plan.room_at(p);
        let near = self.solids.iter().enumerate().filter(move |(room, _)| self.plan.joined(here, *room));
        near.flat_map(|(_, of_room)| of_room).map(|k| *k as usize)
    }

    /// Walls, floors and ceilings of a building, and the shell around it, which nobody sees and is solid 0.
    pub fn build(&mut self, rng: &mut Rng) -> Vec<Primitive> {
        let plan = &self.plan;
        let size = (plan.pitch() * DVec2::new(plan.grid[0] as f64, plan.grid[1] as f64)).extend(plan.room.z + WALL) - WALL;
        let shell = Shape::Shell { half: size * 0.5 + WALL + MARGIN };
        let mut masonry = Masonry { solids: Vec::new(), rng };
        masonry.add(shell, size * 0.5, Material::Outside);
        self.solids.iter_mut().for_each(|of_room| of_room.push(0));
        for (room, of_room) in self.solids.iter_mut().enumerate() {
            let (low, first) = (plan.corner(room), masonry.solids.len() as u32);
            let (low, high) =
                (low - (DVec2::splat(WALL * 0.5)).extend(0.0), low + plan.room + (DVec2::splat(WALL * 0.5)).extend(0.0));
            masonry.block(low - DVec3::Z * WALL, high.with_z(0.0), Material::Floor);
            masonry.block(low.with_z(high.z), high + DVec3::Z * WALL, Material::Ceiling);
            of_room.extend([first, first + 1]);
        }
        for wall in plan.walls() {
            let first = masonry.solids.len();
            let door = match wall.sides {
                [Some(a), Some(b)] => plan.door(a, b),
                _ => None,
            };
            masonry.wall(&wall, door);
            for room in wall.sides.into_iter().flatten() {
                self.solids[room].extend((first..masonry.solids.len()).map(|k| k as u32));
            }
        }
        masonry.solids
    }
}

struct Wall {
    /// Axis that the wall runs along.
    along: usize,
    /// Rooms on its lower and upper side.
    sides: [Option<usize>; 2],
    low: DVec3,
    high: DVec3,
}

impl FloorPlan {
    /// All walls. Those normal to x run through; those normal to y fit between them.
    fn walls(&self) -> Vec<Wall> {
        let (pitch, mut walls) = (self.pitch(), Vec::new());
        for (column, row) in (0..=self.grid[0]).flat_map(|c| (0..=self.grid[1]).map(move |r| (c, r))) {
            let at = (DVec2::new(column as f64, row as f64) * pitch).extend(0.0);
            let here = self.number(Some(column), Some(row));
            if row < self.grid[1] {
                let sides = [self.number(column.checked_sub(1), Some(row)), here];
                let high = dvec3(at.x, at.y + self.room.y + WALL * 0.5, self.room.z);
                walls.push(Wall { along: 1, sides, low: at - dvec3(WALL, WALL * 0.5, 0.0), high });
            }
            if column < self.grid[0] {
                let sides = [self.number(Some(column), row.checked_sub(1)), here];
                let high = dvec3(at.x + self.room.x, at.y, self.room.z);
                walls.push(Wall { along: 0, sides, low: at - DVec3::Y * WALL, high });
            }
        }
        walls
    }
}

struct Masonry<'a> {
    solids: Vec<Primitive>,
    rng: &'a mut Rng,
}

impl Masonry<'_> {
    fn add(&mut self, shape: Shape, centre: DVec3, material: Material) {
        let seed = self.rng.u32(..);
        self.solids.push(Primitive { shape, centre, world_from_local: DMat3::IDENTITY, material, seed });
    }

    fn block(&mut self, low: DVec3, high: DVec3, material: Material) {
        self.add(Shape::Block { half: (high - low) * 0.5 }, (low + high) * 0.5, material);
    }

    /// A wall in one piece, or with a doorway under a lintel.
    fn wall(&mut self, wall: &Wall, door: Option<&Doorway>) {
        let &Wall { along, low, high, .. } = wall;
        let Some(door) = door else { return self.block(low, high, Material::Room) };
        let cut = |mut p: DVec3, at: f64| {
            p[along] = at;
            p
        };
        self.block(low, cut(high, door.low[along]), Material::Room);
        self.block(cut(low, door.high[along]), high, Material::Room);
        let under = cut(low, door.low[along]).with_z(door.high.z);
        self.block(under, cut(high, door.high[along]), Material::Room);
    }
}
