//! What surfaces look like: procedural textures in surface coordinates (metres), one function per material.
//!
//! Colours are mixed as the eye sees them (about sRGB, `0..1`) and turned into linear reflectance at the end. Detail goes down to
//! about a millimetre; band-limiting is the task of the mip levels in [`super::surface`].

mod building;
mod cloth;
mod print;

use glam::{Vec2, Vec3};

use super::noise::{hsv, unit};

/// A place on a chart.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub uv: Vec2,
    /// Size of the chart.
    pub size: Vec2,
    /// Which chart of its solid.
    pub chart: usize,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Material {
    /// The six faces of the room: walls, floor, ceiling. Of a building, a wall.
    Room,
    /// Upper side of a building's floor slab.
    Floor,
    /// Lower side of a building's ceiling slab.
    Ceiling,
    /// What lies around a building; nobody sees it.
    Outside,
    Wood {
        tint: Vec3,
    },
    Metal {
        tint: Vec3,
    },
    Terrazzo {
        tint: Vec3,
    },
    Glazed {
        tint: Vec3,
    },
    Leaf,
    Soil,
    Cardboard,
    Checks {
        a: Vec3,
        b: Vec3,
    },
    Tweed {
        tint: Vec3,
    },
    Rug {
        a: Vec3,
        b: Vec3,
    },
    /// A closed book: its spine faces the reader on the charts that are not paper.
    Book {
        tint: Vec3,
    },
    /// A printed sheet: headline, lines, shapes.
    Poster,
    /// A painted landscape.
    Painting,
    /// Sheets of writing.
    Paper,
    Screen,
    Keys,
    Window,
    Lampshade,
    LightPanel,
}

impl Material {
    /// Light of its own, as a factor on the texture; `None` for what only reflects.
    pub fn emission(&self) -> Option<f32> {
        match self {
            Self::Window => Some(1.0),
            Self::Lampshade => Some(0.95),
            Self::LightPanel => Some(1.25),
            Self::Screen => Some(0.55),
            _ => None,
        }
    }

    /// Gloss of the material where the scene has gloss, `0..1`.
    pub fn gloss(&self) -> f32 {
        match self {
            Self::Wood { .. } | Self::Poster => 0.5,
            Self::Metal { .. } | Self::Glazed { .. } | Self::Leaf => 1.0,
            Self::Book { .. } | Self::Painting | Self::Terrazzo { .. } => 0.4,
            _ => 0.0,
        }
    }

    /// Whether it is what rooms are made of, not a piece in them.
    pub fn is_structure(&self) -> bool {
        matches!(self, Self::Room | Self::Floor | Self::Ceiling | Self::Outside)
    }

    /// Whether a camera may ever see the chart of a box of it.
    pub fn shows(&self, chart: usize) -> bool {
        match self {
            Self::Floor => chart == building::CEILING,
            Self::Ceiling => chart == building::FLOOR,
            Self::Outside => false,
            _ => true,
        }
    }

    /// Linear reflectance (or own light before [`Self::emission`]) at a place; `seed` tells solids of one material apart.
    pub fn color(&self, place: &Place, seed: u32) -> Vec3 {
        let seen = match *self {
            Self::Room => building::room(place, seed),
            Self::Floor => building::planks(place.uv, seed),
            Self::Ceiling => building::ceiling(place.uv, seed),
            Self::Outside => Vec3::splat(0.5),
            Self::Wood { tint } => building::wood(place, tint, seed),
            Self::Metal { tint } => building::metal(place, tint, seed),
            Self::Terrazzo { tint } => building::terrazzo(place, tint, seed),
            Self::Glazed { tint } => building::glazed(place, tint, seed),
            Self::Leaf => building::leaf(place, seed),
            Self::Soil => building::soil(place, seed),
            Self::Cardboard => print::cardboard(place, seed),
            Self::Checks { a, b } => cloth::checks(place, a, b, seed),
            Self::Tweed { tint } => cloth::tweed(place, tint, seed),
            Self::Rug { a, b } => cloth::rug(place, a, b, seed),
            Self::Book { tint } => print::book(place, tint, seed),
            Self::Poster => print::poster(place, seed),
            Self::Painting => print::painting(place, seed),
            Self::Paper => print::paper(place, seed),
            Self::Screen => print::screen(place, seed),
            Self::Keys => print::keys(place, seed),
            Self::Window => print::window(place, seed),
            Self::Lampshade => cloth::lampshade(place, seed),
            Self::LightPanel => building::light_panel(place),
        };
        let seen = seen.clamp(Vec3::splat(0.02), Vec3::splat(0.97));
        seen * seen
    }
}

/// A muted colour at random, as furniture and book covers have it.
pub fn muted(seed: u32) -> Vec3 {
    let pick = |salt| unit(3, 7, seed ^ salt);
    hsv(pick(0x11), 0.14 + 0.34 * pick(0x22), 0.36 + 0.46 * pick(0x33))
}

/// 1 within `half` of a line at 0, falling to 0 over the last fifth.
fn line(distance: f32, half: f32) -> f32 {
    1.0 - super::noise::ramp(half * 0.8, half * 1.2, distance.abs())
}

/// Distance to the nearest border of a rectangle of `size`; negative outside.
fn border(p: Vec2, size: Vec2) -> f32 {
    let q = p.min(size - p);
    q.x.min(q.y)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TINT: Vec3 = Vec3::new(0.6, 0.4, 0.3);

    /// Every material but those that are plain by intent has corners at the scale of a few millimetres to centimetres.
    #[test]
    fn textures_are_rich_in_gradients_in_both_directions() {
        let rich = [
            Material::Room,
            Material::Wood { tint: TINT },
            Material::Terrazzo { tint: TINT },
            Material::Checks { a: TINT, b: Vec3::splat(0.8) },
            Material::Tweed { tint: TINT },
            Material::Rug { a: TINT, b: Vec3::splat(0.8) },
            Material::Book { tint: TINT },
            Material::Poster,
            Material::Painting,
            Material::Paper,
            Material::Cardboard,
            Material::Window,
        ];
        for material in rich {
            for chart in 0..6 {
                let energy = gradient_energy(material, chart);
                assert!(energy.min_element() > 0.004, "{material:?} chart {chart}: {energy}");
            }
        }
    }

    /// Root mean square difference of neighbouring samples 5 mm apart, along u and v.
    fn gradient_energy(material: Material, chart: usize) -> Vec2 {
        let size = Vec2::new(1.2, 0.8);
        let gray = |x: i32, y: i32| {
            let uv = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) * 0.005;
            material.color(&Place { uv, size, chart }, 5).element_sum() / 3.0
        };
        let mut sum = Vec2::ZERO;
        for (x, y) in (0..159).flat_map(|y| (0..239).map(move |x| (x, y))) {
            sum += Vec2::new((gray(x + 1, y) - gray(x, y)).powi(2), (gray(x, y + 1) - gray(x, y)).powi(2));
        }
        Vec2::new((sum.x / 38_001.0).sqrt(), (sum.y / 38_001.0).sqrt())
    }

    #[test]
    fn colors_stay_reflectances() {
        for chart in 0..6 {
            for i in 0..200 {
                let uv = Vec2::new(i as f32 * 0.013, i as f32 * 0.007);
                let c = Material::Room.color(&Place { uv, size: Vec2::new(2.6, 1.4), chart }, 1);
                assert!(c.min_element() > 0.0 && c.max_element() < 1.0);
            }
        }
    }
}
