//! The features of one frame as the tracker uses them: undistorted, with depth, in a grid for searches around a pixel.

use std::ops::RangeInclusive;

use nalgebra::{Point3, Vector2};

use crate::geometry::Pinhole;
use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::rig::Rig;
use crate::tracking::solvers::residual::Measurement;

/// Side of the search grid's cells, pixels.
const CELL_PIXELS: f64 = 16.0;
/// Features that a search compares at a time.
const LANES: usize = 8;
/// Low bits of a place's entry that hold the feature's index.
const INDEX_BITS: u32 = 24;
/// Relative standard deviation of depth up to which a measurement makes a point, as the weights have it: about three times the real one.
const CERTAIN_DEPTH: f64 = 0.24;
/// So many features of a frame make points, the most certain ones, as in ORB-SLAM2,
const FEWEST_POINTS: usize = 100;
/// up to this deviation.
const MAX_DEPTH_ERROR: f64 = 0.5;

/// One feature of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Feature {
    /// In the distortion-free pinhole.
    pub pixel: Vector2<f64>,
    pub octave: u8,
    pub angle_rad: f32,
    /// Metres along z, where it was measured, away from edges and within range.
    pub depth_metres: Option<f64>,
    /// Standard deviation of the measured inverse depth, 1/metres.
    pub inverse_depth_sigma: f64,
    pub descriptor: Descriptor,
}

/// All features of a frame.
#[derive(Clone, Debug, Default)]
pub struct FrameFeatures {
    pub features: Vec<Feature>,
    columns: usize,
    rows: usize,
    /// `cells[c]..cells[c + 1]` are the places of cell `c`'s features.
    cells: Vec<u32>,
    places: Places,
    /// Relative standard deviation of depth up to which a measurement makes a point.
    max_depth_error: f64,
}

/// Where features are, in columns, so that a search reads [`LANES`] of them in a row.
#[derive(Clone, Debug, Default)]
struct Places {
    x: Vec<f32>,
    y: Vec<f32>,
    /// The octave above [`INDEX_BITS`] bits of the feature's index.
    octave_and_index: Vec<u32>,
}

impl Places {
    /// For so many features. Each column has [`LANES`] places more, which are near nothing.
    fn new(count: usize) -> Self {
        let length = count + LANES;
        Self { x: vec![f32::NAN; length], y: vec![f32::NAN; length], octave_and_index: vec![0; length] }
    }

    fn set(&mut self, place: usize, feature: &Feature, index: u32) {
        self.x[place] = feature.pixel.x as f32;
        self.y[place] = feature.pixel.y as f32;
        self.octave_and_index[place] = u32::from(feature.octave) << INDEX_BITS | index;
    }

    fn index(&self, place: usize) -> usize {
        (self.octave_and_index[place] & ((1 << INDEX_BITS) - 1)) as usize
    }

    /// Which of the [`LANES`] features from a place on are near, the first in the lowest bit.
    #[inline(always)]
    fn near(&self, place: usize, near: &Near) -> u32 {
        let lanes = place..place + LANES;
        let (x, y, octave) = (&self.x[lanes.clone()], &self.y[lanes.clone()], &self.octave_and_index[lanes]);
        let mut hits = 0;
        for lane in 0..LANES {
            let (dx, dy) = (x[lane] - near.x, y[lane] - near.y);
            let of_octaves = (octave[lane] >> INDEX_BITS).wrapping_sub(near.finest) <= near.coarser;
            hits |= u32::from((dx * dx + dy * dy <= near.radius_squared) & of_octaves) << lane;
        }
        hits
    }
}

/// What a search looks for.
#[derive(Clone, Copy, Debug)]
struct Near {
    x: f32,
    y: f32,
    radius_squared: f32,
    finest: u32,
    /// Octaves above the finest.
    coarser: u32,
}

/// The error up to which a feature's depth makes a point: larger where fewer than [`FEWEST_POINTS`] are certain.
fn max_depth_error(features: &[Feature]) -> f64 {
    let mut errors: Vec<f64> = features.iter().filter_map(|f| Some(f.inverse_depth_sigma * f.depth_metres?)).collect();
    if errors.len() > FEWEST_POINTS {
        errors.select_nth_unstable_by(FEWEST_POINTS - 1, f64::total_cmp);
        errors.truncate(FEWEST_POINTS);
    }
    errors.into_iter().fold(CERTAIN_DEPTH, f64::max).min(MAX_DEPTH_ERROR)
}

impl FrameFeatures {
    /// Features of a list, put in a grid.
    pub fn new(mut features: Vec<Feature>, pinhole: &Pinhole) -> Self {
        // A keyframe keeps them.
        features.shrink_to_fit();
        let columns = (f64::from(pinhole.width) / CELL_PIXELS).ceil().max(1.0) as usize;
        let rows = (f64::from(pinhole.height) / CELL_PIXELS).ceil().max(1.0) as usize;
        let cell_of = |pixel: &Vector2<f64>| cell(pixel.y, rows) * columns + cell(pixel.x, columns);
        let mut cells = vec![0u32; columns * rows + 1];
        for feature in &features {
            cells[cell_of(&feature.pixel) + 1] += 1;
        }
        for c in 1..cells.len() {
            cells[c] += cells[c - 1];
        }
        // Features of one cell stay in their order.
        let mut next = cells.clone();
        let mut places = Places::new(features.len());
        for (feature, index) in features.iter().zip(0..) {
            let place = &mut next[cell_of(&feature.pixel)];
            places.set(*place as usize, feature, index);
            *place += 1;
        }
        let max_depth_error = max_depth_error(&features);
        Self { features, columns, rows, cells, places, max_depth_error }
    }

    pub fn len(&self) -> usize {
        self.features.len()
    }

    /// Calls `visit` with the index of every feature of some octaves within `radius` pixels of `centre`, in a fixed order.
    #[inline(always)]
    pub fn within(&self, centre: &Vector2<f64>, radius: f64, octaves: &RangeInclusive<u8>, mut visit: impl FnMut(usize)) {
        let (x0, x1) = (cell(centre.x - radius, self.columns), cell(centre.x + radius, self.columns));
        let (y0, y1) = (cell(centre.y - radius, self.rows), cell(centre.y + radius, self.rows));
        let finest = u32::from(*octaves.start());
        let near = Near {
            x: centre.x as f32,
            y: centre.y as f32,
            radius_squared: (radius * radius) as f32,
            finest,
            coarser: u32::from(*octaves.end()) - finest,
        };
        for y in y0..=y1 {
            let end = self.cells[y * self.columns + x1 + 1] as usize;
            for first in (self.cells[y * self.columns + x0] as usize..end).step_by(LANES) {
                let mut hits = self.places.near(first, &near);
                if end - first < LANES {
                    hits &= (1 << (end - first)) - 1;
                }
                while hits != 0 {
                    visit(self.places.index(first + hits.trailing_zeros() as usize));
                    hits &= hits - 1;
                }
            }
        }
    }

    /// The feature's point in the camera frame; `None` without a depth that is certain enough to make a point of.
    pub fn point_in_camera(&self, index: usize, rig: &Rig) -> Option<Point3<f64>> {
        let feature = &self.features[index];
        let inverse_depth = rig.measurement(feature).inverse_depth?;
        let certain = inverse_depth * self.max_depth_error > feature.inverse_depth_sigma;
        certain.then(|| Point3::from(rig.pinhole.unproject(&feature.pixel, 1.0 / inverse_depth)))
    }

    /// Median of the measured depths, metres.
    pub fn median_depth(&self) -> Option<f64> {
        let mut depths: Vec<f64> = self.features.iter().filter_map(|f| f.depth_metres).collect();
        depths.sort_by(f64::total_cmp);
        depths.get(depths.len() / 2).copied()
    }
}

impl Feature {
    /// Measurement with weights from the noise model; `pixel_sigma` is the standard deviation of each pixel coordinate.
    pub fn measurement(&self, pixel_sigma: f64) -> Measurement {
        Measurement {
            pixel: self.pixel,
            inverse_depth: self.depth_metres.map(|d| 1.0 / d),
            pixel_weight: 1.0 / pixel_sigma,
            depth_weight: if self.depth_metres.is_some() { 1.0 / self.inverse_depth_sigma } else { 0.0 },
        }
    }
}

/// The grid line (row or column) of a coordinate; what lies outside belongs to the border.
fn cell(coordinate: f64, count: usize) -> usize {
    ((coordinate / CELL_PIXELS).max(0.0) as usize).min(count - 1)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::tracking::TrackingConfig;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    pub fn feature(x: f64, y: f64, descriptor: Descriptor) -> Feature {
        Feature { pixel: Vector2::new(x, y), octave: 0, angle_rad: 0.0, depth_metres: None, inverse_depth_sigma: 0.0, descriptor }
    }

    #[test]
    fn the_grid_finds_what_a_full_search_finds() {
        let mut random = fastrand::Rng::with_seed(5);
        // Some lie outside of the image, as undistorted pixels may.
        let mut coordinate = |size: f64| random.f64() * (size + 40.0) - 20.0;
        let anywhere = |octave| Feature { octave, ..feature(coordinate(640.0), coordinate(480.0), Descriptor::default()) };
        let list: Vec<Feature> = (0..4).cycle().take(800).map(anywhere).collect();
        let grid = FrameFeatures::new(list.clone(), &PINHOLE);
        for _ in 0..200 {
            let (centre, radius) = (Vector2::new(coordinate(640.0), coordinate(480.0)), coordinate(60.0).abs());
            let mut found = Vec::new();
            grid.within(&centre, radius, &(1..=2), |i| found.push(i));
            found.sort_unstable();
            let fits = |f: &Feature| (1..=2).contains(&f.octave) && (f.pixel - centre).norm() <= radius;
            let expected: Vec<usize> = (0..800).filter(|i| fits(&list[*i])).collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn certain_depth_makes_points_and_else_the_most_certain() {
        let rig = Rig::new(PINHOLE, TrackingConfig::default());
        let points = |metres: &dyn Fn(usize) -> f64| {
            let at = |i| Feature {
                depth_metres: Some(metres(i)),
                inverse_depth_sigma: 0.025,
                ..feature(9.0, 9.0, Descriptor::default())
            };
            let features = FrameFeatures::new((0..300).map(at).collect(), &PINHOLE);
            (0..300).filter(|i| features.point_in_camera(*i, &rig).is_some()).count()
        };
        assert_eq!(points(&|_| 9.0), 300);
        assert_eq!(points(&|i| if i % 2 == 0 { 9.0 } else { 10.0 }), 150);
        assert_eq!(points(&|i| 10.0 + 0.01 * i as f64), FEWEST_POINTS - 1);
        assert_eq!(points(&|_| 30.0), 0);
    }
}
