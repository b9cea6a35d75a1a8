//! Pieces of furniture, built from solids in a frame of their own: x along the wall, y away from it, z up, origin on the floor at
//! the middle of the back.

use fastrand::Rng;
use glam::{DMat3, DVec3, Vec3, dvec3};

use super::shapes::{Primitive, Shape};
use super::texture::{Material, muted};

const OAK: Vec3 = Vec3::new(0.74, 0.57, 0.38);
const WALNUT: Vec3 = Vec3::new(0.50, 0.35, 0.25);
const BIRCH: Vec3 = Vec3::new(0.86, 0.75, 0.58);
const STEEL: Vec3 = Vec3::new(0.58, 0.60, 0.63);

/// A piece under construction.
pub struct Piece {
    pub solids: Vec<Primitive>,
    rng: Rng,
}

impl Piece {
    pub fn new(seed: u64) -> Self {
        Self { solids: Vec::new(), rng: Rng::with_seed(seed) }
    }

    fn add(&mut self, shape: Shape, centre: DVec3, turn: DMat3, material: Material) {
        let seed = self.rng.u32(..);
        self.solids.push(Primitive { shape, centre, world_from_local: turn, material, seed });
    }

    /// A box of `size` that stands on `foot` (the middle of its underside).
    pub fn block(&mut self, foot: DVec3, size: DVec3, material: Material) {
        self.turned_block(foot, size, 0.0, material);
    }

    /// A copy turned about the vertical.
    fn turned_block(&mut self, foot: DVec3, size: DVec3, yaw_rad: f64, material: Material) {
        let centre = foot + DVec3::Z * size.z * 0.5;
        self.add(Shape::Block { half: size * 0.5 }, centre, DMat3::from_rotation_z(yaw_rad), material);
    }

    fn cylinder(&mut self, foot: DVec3, radius: f64, height: f64, material: Material) {
        let shape = Shape::Cylinder { radius, half_height: height * 0.5 };
        let turn = DMat3::from_rotation_z(self.between(0.0, 6.0));
        self.add(shape, foot + DVec3::Z * height * 0.5, turn, material);
    }

    fn ellipsoid(&mut self, centre: DVec3, radii: DVec3, turn: DMat3, material: Material) {
        self.add(Shape::Ellipsoid { radii }, centre, turn, material);
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.rng.f64()
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.rng.usize(..from.len())]
    }

    fn tint(&mut self) -> Vec3 {
        muted(self.rng.u32(..))
    }

    fn wood(&mut self) -> Material {
        Material::Wood { tint: self.pick(&[OAK, WALNUT, BIRCH]) }
    }

    fn legs(&mut self, middle: DVec3, width: f64, depth: f64, height: f64, material: Material) {
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            self.block(middle + dvec3(x * width * 0.5, y * depth * 0.5, 0.0), dvec3(0.05, 0.05, height), material);
        }
    }

    /// Books in a row from `left` on, spines towards +y, on a board at `z`; some lean, some lie, some gaps hold a vase.
    fn books(&mut self, left: f64, right: f64, front: f64, z: f64, max_height: f64) {
        let mut x = left + 0.005;
        while x < right - 0.07 {
            let thick = self.between(0.02, 0.055);
            let (tall, deep) = (self.between(0.6, 0.92) * max_height, self.between(0.15, 0.21));
            let kind = self.rng.f64();
            if kind < 0.07 && right - x > 0.2 {
                let radius = self.between(0.045, 0.075);
                let tint = self.tint();
                self.cylinder(dvec3(x + radius + 0.01, front - 0.1, z), radius, tall * 0.75, Material::Glazed { tint });
                x += 2.0 * radius + 0.03;
            } else if kind < 0.15 && right - x > 0.3 {
                let mut height = z;
                for _ in 0..3 {
                    let book = Material::Book { tint: self.tint() };
                    let (thick, long, yaw) = (self.between(0.025, 0.05), self.between(0.2, 0.25), self.between(-0.12, 0.12));
                    // A lying book is a standing one on its side, so that its spine still faces the reader.
                    let turn = DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(std::f64::consts::FRAC_PI_2);
                    let half = dvec3(thick, 0.17, long) * 0.5;
                    self.add(Shape::Block { half }, dvec3(x + 0.14, front - 0.1, height + thick * 0.5), turn, book);
                    height += thick;
                }
                x += 0.28;
            } else {
                let book = Material::Book { tint: self.tint() };
                let inset = self.between(0.01, 0.035);
                self.block(dvec3(x + thick * 0.5, front - inset - deep * 0.5, z), dvec3(thick - 0.002, deep, tall), book);
                x += thick + if self.rng.f64() < 0.08 { 0.05 } else { 0.001 };
            }
        }
    }

    pub fn shelf(&mut self) {
        let (width, depth, height) = (self.pick(&[0.9, 1.1, 1.3]), 0.3, self.pick(&[1.75, 1.95]));
        let wood = self.wood();
        for side in [-1.0, 1.0] {
            self.block(dvec3(side * (width - 0.025) * 0.5, depth * 0.5, 0.0), dvec3(0.025, depth, height), wood);
        }
        self.block(dvec3(0.0, 0.01, 0.0), dvec3(width - 0.05, 0.015, height), wood);
        let boards = 5;
        let gap = (height - 0.08) / f64::from(boards);
        for board in 0..=boards {
            let z = 0.05 + gap * f64::from(board);
            self.block(dvec3(0.0, depth * 0.5, z), dvec3(width - 0.05, depth - 0.01, 0.025), wood);
            if board < boards {
                self.books(-width * 0.5 + 0.03, width * 0.5 - 0.03, depth, z + 0.025, gap - 0.045);
            }
        }
    }

    pub fn cabinet(&mut self) {
        let (width, depth, height) = (self.pick(&[0.9, 1.2]), 0.45, self.pick(&[0.75, 0.9]));
        let wood = self.wood();
        self.block(dvec3(0.0, depth * 0.5, 0.06), dvec3(width, depth, height - 0.06), wood);
        self.block(dvec3(0.0, depth * 0.5, 0.0), dvec3(width - 0.06, depth - 0.06, 0.06), Material::Wood { tint: WALNUT });
        self.block(dvec3(0.0, depth * 0.5 + 0.005, height), dvec3(width + 0.03, depth + 0.02, 0.025), wood);
        let rows = 3;
        let tall = (height - 0.1) / f64::from(rows);
        for (row, side) in (0..rows).flat_map(|row| [(row, -1.0), (row, 1.0)]) {
            let middle = dvec3(side * width * 0.25, depth + 0.008, 0.08 + tall * f64::from(row));
            self.block(middle, dvec3(width * 0.5 - 0.03, 0.018, tall - 0.02), wood);
            self.block(middle + dvec3(0.0, 0.022, tall * 0.45), dvec3(0.12, 0.02, 0.015), Material::Metal { tint: STEEL });
        }
        let top = height + 0.025;
        let tint = self.tint();
        self.cylinder(dvec3(-width * 0.3, 0.2, top), 0.07, 0.24, Material::Glazed { tint });
        self.foliage(dvec3(-width * 0.3, 0.2, top + 0.24), 0.16, 16);
        let half = dvec3(0.09, 0.008, 0.12);
        let lean = DMat3::from_rotation_z(0.15) * DMat3::from_rotation_x(0.22);
        self.add(Shape::Block { half }, dvec3(width * 0.1, 0.15, top + 0.12), lean, Material::Painting);
        for k in 0..3 {
            let book = Material::Book { tint: self.tint() };
            let yaw = self.between(-0.3, 0.3);
            self.turned_block(dvec3(width * 0.34, 0.22, top + 0.035 * f64::from(k)), dvec3(0.17, 0.23, 0.034), yaw, book);
        }
        let stone = Material::Terrazzo { tint: Vec3::splat(0.66) };
        self.ellipsoid(dvec3(width * 0.34, 0.22, top + 0.165), DVec3::splat(0.06), DMat3::IDENTITY, stone);
    }

    pub fn desk(&mut self) {
        let (width, depth, height) = (1.4, 0.7, 0.74);
        let wood = self.wood();
        self.block(dvec3(0.0, depth * 0.5 + 0.02, height - 0.035), dvec3(width, depth, 0.035), wood);
        self.legs(dvec3(0.0, depth * 0.5 + 0.02, 0.0), width - 0.1, depth - 0.1, height - 0.035, Material::Metal { tint: STEEL });
        self.block(dvec3(0.45, 0.36, 0.18), dvec3(0.38, 0.55, 0.52), wood);
        for row in 0..3 {
            let z = 0.2 + 0.165 * f64::from(row);
            self.block(dvec3(0.45, 0.64, z), dvec3(0.35, 0.018, 0.15), wood);
            self.block(dvec3(0.45, 0.66, z + 0.07), dvec3(0.1, 0.02, 0.012), Material::Metal { tint: STEEL });
        }
        let dark = Material::Metal { tint: Vec3::splat(0.2) };
        self.block(dvec3(0.0, 0.22, height), dvec3(0.24, 0.18, 0.012), dark);
        self.block(dvec3(0.0, 0.18, height), dvec3(0.05, 0.03, 0.2), dark);
        self.turned_block(dvec3(0.0, 0.22, height + 0.1), dvec3(0.58, 0.035, 0.36), 0.08, Material::Screen);
        self.turned_block(dvec3(-0.02, 0.5, height), dvec3(0.42, 0.14, 0.018), 0.04, Material::Keys);
        for _ in 0..3 {
            let (x, y, yaw) = (self.between(-0.6, -0.36), self.between(0.36, 0.56), self.between(-0.6, 0.6));
            self.turned_block(
                dvec3(x, y, height),
                dvec3(0.21, 0.297, 0.002 + 0.002 * self.solids.len() as f64 % 0.01),
                yaw,
                Material::Paper,
            );
        }
        let tint = self.tint();
        self.cylinder(dvec3(0.36, 0.52, height), 0.04, 0.095, Material::Glazed { tint });
        self.books(0.4, 0.66, 0.28, height, 0.28);
        self.table_lamp(dvec3(-0.55, 0.2, height));
        self.chair(dvec3(-0.1, 0.95, 0.0), 0.35);
    }

    fn table_lamp(&mut self, foot: DVec3) {
        self.cylinder(foot, 0.075, 0.02, Material::Terrazzo { tint: Vec3::splat(0.4) });
        self.cylinder(foot, 0.012, 0.3, Material::Metal { tint: STEEL });
        self.cylinder(foot + DVec3::Z * 0.27, 0.1, 0.16, Material::Lampshade);
    }

    /// A table away from the wall, its cloth hanging over the edge, with chairs on three sides.
    pub fn dining_table(&mut self) {
        let (width, depth, height) = (1.3, 0.85, 0.74);
        let middle = dvec3(0.0, 0.85, 0.0);
        let wood = self.wood();
        self.legs(middle, width - 0.14, depth - 0.14, height - 0.03, wood);
        self.block(middle + DVec3::Z * (height - 0.03), dvec3(width, depth, 0.03), wood);
        let (a, b) = (self.tint(), Vec3::new(0.88, 0.84, 0.74));
        let cloth = Material::Checks { a, b };
        self.block(middle + DVec3::Z * height, dvec3(width + 0.012, depth + 0.012, 0.004), cloth);
        for side in [-1.0, 1.0] {
            self.block(
                middle + dvec3(side * (width * 0.5 + 0.005), 0.0, height - 0.17),
                dvec3(0.004, depth + 0.012, 0.172),
                cloth,
            );
            self.block(
                middle + dvec3(0.0, side * (depth * 0.5 + 0.005), height - 0.17),
                dvec3(width + 0.012, 0.004, 0.172),
                cloth,
            );
        }
        let top = middle + DVec3::Z * (height + 0.004);
        self.fruit_bowl(top + dvec3(0.05, 0.0, 0.0));
        for (x, y) in [(-0.42, 0.12), (0.4, -0.2)] {
            let tint = self.tint();
            self.cylinder(top + dvec3(x, y, 0.0), 0.11, 0.012, Material::Glazed { tint });
            let tint = self.tint();
            self.cylinder(top + dvec3(x + 0.17, y + 0.08, 0.0), 0.038, 0.09, Material::Glazed { tint });
        }
        let sheet = self.between(-0.4, 0.4);
        self.turned_block(top + dvec3(-0.35, -0.2, 0.0), dvec3(0.3, 0.4, 0.006), sheet, Material::Paper);
        self.chair(middle + dvec3(-0.95, 0.05, 0.0), -1.5);
        self.chair(middle + dvec3(0.95, -0.1, 0.0), 1.65);
        self.chair(middle + dvec3(0.12, 0.68, 0.0), 0.1);
    }

    fn fruit_bowl(&mut self, foot: DVec3) {
        self.cylinder(foot, 0.13, 0.05, Material::Terrazzo { tint: Vec3::new(0.55, 0.6, 0.62) });
        for k in 0..6 {
            let angle = f64::from(k) * 1.05;
            let reach = if k == 5 { 0.0 } else { 0.075 };
            let lift = if k == 5 { 0.12 } else { 0.075 };
            let tint = self.pick(&[Vec3::new(0.82, 0.25, 0.16), Vec3::new(0.93, 0.62, 0.16), Vec3::new(0.55, 0.68, 0.22)]);
            let at = foot + dvec3(angle.cos() * reach, angle.sin() * reach, lift);
            self.ellipsoid(at, dvec3(0.042, 0.042, 0.039), DMat3::IDENTITY, Material::Glazed { tint });
        }
    }

    /// A chair about `foot` whose back is on the side of +y before it is turned by `yaw_rad`.
    fn chair(&mut self, foot: DVec3, yaw_rad: f64) {
        let turn = DMat3::from_rotation_z(yaw_rad);
        let wood = self.wood();
        let seat = Material::Tweed { tint: self.tint() };
        let mut part = |at: DVec3, size: DVec3, material| self.turned_block(foot + turn * at, size, yaw_rad, material);
        for (x, y) in [(-0.19, -0.19), (0.19, -0.19), (-0.19, 0.19), (0.19, 0.19)] {
            let height = if y > 0.0 { 0.88 } else { 0.44 };
            part(dvec3(x, y, 0.0), dvec3(0.04, 0.04, height), wood);
        }
        part(dvec3(0.0, 0.0, 0.42), dvec3(0.42, 0.42, 0.025), wood);
        part(dvec3(0.0, -0.01, 0.445), dvec3(0.38, 0.36, 0.03), seat);
        for z in [0.55, 0.66, 0.77] {
            part(dvec3(0.0, 0.19, z), dvec3(0.36, 0.02, 0.06), wood);
        }
    }

    pub fn sofa(&mut self) {
        let width = 1.9;
        let cloth = Material::Tweed { tint: self.tint() };
        self.block(dvec3(0.0, 0.46, 0.08), dvec3(width, 0.84, 0.2), cloth);
        self.block(dvec3(0.0, 0.13, 0.28), dvec3(width, 0.22, 0.55), cloth);
        for side in [-1.0, 1.0] {
            self.block(dvec3(side * (width * 0.5 - 0.1), 0.46, 0.28), dvec3(0.2, 0.84, 0.32), cloth);
            self.block(dvec3(side * 0.375, 0.56, 0.28), dvec3(0.73, 0.62, 0.16), cloth);
            let (a, b) = (self.tint(), self.tint());
            let lean = DMat3::from_rotation_z(side * -0.3) * DMat3::from_rotation_x(-0.35);
            self.ellipsoid(dvec3(side * 0.55, 0.38, 0.62), dvec3(0.23, 0.09, 0.21), lean, Material::Checks { a, b });
        }
        self.legs(dvec3(0.0, 0.46, 0.0), width - 0.15, 0.7, 0.08, Material::Wood { tint: WALNUT });
        let (a, b) = (self.tint(), self.tint());
        self.block(dvec3(0.72, 0.5, 0.44), dvec3(0.36, 0.6, 0.012), Material::Rug { a, b });
    }

    pub fn lamp(&mut self) {
        let foot = dvec3(0.0, 0.3, 0.0);
        self.cylinder(foot, 0.15, 0.03, Material::Terrazzo { tint: Vec3::splat(0.35) });
        self.cylinder(foot, 0.015, 1.35, Material::Metal { tint: STEEL });
        self.cylinder(foot + DVec3::Z * 1.25, 0.19, 0.28, Material::Lampshade);
    }

    pub fn plant(&mut self) {
        let foot = dvec3(0.0, 0.35, 0.0);
        let tint = self.tint();
        self.cylinder(foot, 0.17, 0.32, Material::Terrazzo { tint });
        self.cylinder(foot + DVec3::Z * 0.3, 0.155, 0.025, Material::Soil);
        self.cylinder(foot + DVec3::Z * 0.3, 0.016, 0.5, Material::Wood { tint: WALNUT });
        self.foliage(foot + DVec3::Z * 0.55, 0.36, 40);
    }

    /// Leaves that spring from about `root`, up to `reach` long.
    fn foliage(&mut self, root: DVec3, reach: f64, leaves: u32) {
        for k in 0..leaves {
            let yaw = f64::from(k) * 2.4 + self.between(-0.3, 0.3);
            let rise = self.between(-0.1, 1.25);
            let length = reach * self.between(0.55, 1.0) * 0.5;
            let start = DVec3::Z * reach * self.between(-0.3, 0.6);
            let turn = DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(-rise);
            let centre = root + start + turn * DVec3::X * length;
            self.ellipsoid(centre, dvec3(length, length * 0.32, 0.008), turn, Material::Leaf);
        }
    }

    pub fn boxes(&mut self) {
        let (mut z, mut side) = (0.0, 0.5);
        for _ in 0..3 {
            let (height, yaw) = (self.between(0.24, 0.36), self.between(-0.25, 0.25));
            self.turned_block(dvec3(0.0, 0.36, z), dvec3(side, side * 0.8, height), yaw, Material::Cardboard);
            z += height;
            side -= 0.08;
        }
    }

    pub fn rug(&mut self) {
        let (a, b) = (self.pick(&[Vec3::new(0.58, 0.20, 0.18), Vec3::new(0.20, 0.30, 0.46)]), self.tint());
        self.block(dvec3(0.0, 0.75, 0.0), dvec3(2.2, 1.5, 0.012), Material::Rug { a, b });
    }

    /// A picture whose middle is at `height` on the wall.
    pub fn picture(&mut self, height: f64) {
        let painting = self.rng.bool();
        let (width, tall) = self.pick(&[(0.5, 0.7), (0.6, 0.8), (0.42, 0.6), (0.7, 0.5)]);
        let (width, tall) = if painting { (tall, width) } else { (width, tall) };
        let material = if painting { Material::Painting } else { Material::Poster };
        self.block(dvec3(0.0, 0.012, height - tall * 0.5), dvec3(width, 0.024, tall), material);
    }

    pub fn window(&mut self) {
        self.block(dvec3(0.0, 0.015, 1.0), dvec3(1.5, 0.03, 1.2), Material::Window);
        self.block(dvec3(0.0, 0.08, 0.96), dvec3(1.6, 0.16, 0.035), Material::Wood { tint: BIRCH });
        for side in [-1.0, 1.0] {
            let (a, b) = (Vec3::new(0.62, 0.50, 0.42), Vec3::new(0.85, 0.79, 0.68));
            self.block(dvec3(side * 0.86, 0.06, 0.9), dvec3(0.2, 0.05, 1.4), Material::Checks { a, b });
        }
    }

    pub fn light_panel(&mut self, height: f64) {
        self.block(dvec3(0.0, 0.0, height - 0.03), dvec3(1.2, 0.6, 0.03), Material::LightPanel);
    }

    /// The thing that moves: a round stool-high robot with a packing box on its head.
    pub fn robot(&mut self) {
        self.cylinder(DVec3::ZERO, 0.2, 0.14, Material::Terrazzo { tint: Vec3::new(0.3, 0.45, 0.6) });
        self.cylinder(DVec3::Z * 0.14, 0.16, 0.6, Material::Poster);
        self.turned_block(DVec3::Z * 0.74, dvec3(0.34, 0.28, 0.26), 0.3, Material::Cardboard);
        self.ellipsoid(DVec3::Z * 1.08, DVec3::splat(0.1), DMat3::IDENTITY, Material::Glazed { tint: Vec3::new(0.8, 0.4, 0.2) });
    }
}
