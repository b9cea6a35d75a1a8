//! The features of one frame as the tracker uses them: undistorted, with depth, in a grid for searches around a pixel.

use image::RgbImage;
use nalgebra::{Point3, Vector2};

use crate::geometry::{Camera, Pinhole};
use crate::sequence::{DepthImage, Frame, Sensor};
use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::orb::{Extractor, Keypoint};
use crate::tracking::features::stereo::{Eye, disparities};
use crate::tracking::solvers::residual::Measurement;
use crate::tracking::{TrackingConfig, TrackingError};

/// Side of the search grid's cells, pixels.
const CELL_PIXELS: f64 = 16.0;
/// Relative standard deviation of depth up to which a measurement makes a point.
const MAX_DEPTH_ERROR: f64 = 0.08;

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
    /// `cells[c]..cells[c + 1]` are the places in `order` of cell `c`'s features.
    cells: Vec<u32>,
    order: Vec<u32>,
}

impl FrameFeatures {
    /// Features of a list, put in a grid.
    pub fn new(features: Vec<Feature>, pinhole: &Pinhole) -> Self {
        let columns = (f64::from(pinhole.width) / CELL_PIXELS).ceil().max(1.0) as usize;
        let rows = (f64::from(pinhole.height) / CELL_PIXELS).ceil().max(1.0) as usize;
        let cell_of = |f: &Feature| cell(f.pixel.y, rows) * columns + cell(f.pixel.x, columns);
        let mut order: Vec<u32> = (0..features.len() as u32).collect();
        // Stable: features of one cell stay in their order.
        order.sort_by_key(|i| cell_of(&features[*i as usize]));
        let mut cells = vec![0u32; columns * rows + 1];
        for feature in &features {
            cells[cell_of(feature) + 1] += 1;
        }
        for c in 1..cells.len() {
            cells[c] += cells[c - 1];
        }
        Self { features, columns, rows, cells, order }
    }

    pub fn len(&self) -> usize {
        self.features.len()
    }

    /// Calls `visit` with the index of every feature within `radius` pixels of `centre`, in a fixed order.
    pub fn within(&self, centre: &Vector2<f64>, radius: f64, mut visit: impl FnMut(usize)) {
        let (x0, x1) = (cell(centre.x - radius, self.columns), cell(centre.x + radius, self.columns));
        let (y0, y1) = (cell(centre.y - radius, self.rows), cell(centre.y + radius, self.rows));
        for y in y0..=y1 {
            let span = self.cells[y * self.columns + x0] as usize..self.cells[y * self.columns + x1 + 1] as usize;
            for index in &self.order[span] {
                if (self.features[*index as usize].pixel - centre).norm_squared() <= radius * radius {
                    visit(*index as usize);
                }
            }
        }
    }

    /// The feature's point in the camera frame; `None` without a depth that is certain enough to make a point of.
    pub fn point_in_camera(&self, index: usize, pinhole: &Pinhole) -> Option<Point3<f64>> {
        let feature = &self.features[index];
        let depth = feature.depth_metres.filter(|depth| depth * feature.inverse_depth_sigma < MAX_DEPTH_ERROR)?;
        Some(Point3::from(pinhole.unproject(&feature.pixel, depth)))
    }

    /// Median of the measured depths, metres.
    pub fn median_depth(&self) -> Option<f64> {
        let mut depths: Vec<f64> = self.features.iter().filter_map(|f| f.depth_metres).collect();
        depths.sort_by(f64::total_cmp);
        depths.get(depths.len() / 2).copied()
    }
}

/// Camera, sensor and ORB extractor: from a frame to its features.
#[derive(Debug)]
pub struct FrontEnd {
    pub camera: Camera,
    pub sensor: Sensor,
    pub extractor: Extractor,
}

impl FrontEnd {
    /// Extracts the features of a frame, with depth from its depth image or right image. `grey` is its luma, row-major.
    pub fn features(&self, frame: &Frame, grey: &[u8], config: &TrackingConfig) -> Result<FrameFeatures, TrackingError> {
        let (keypoints, depths) = match (self.sensor, &frame.right) {
            (Sensor::Stereo { baseline_metres }, Some(right)) => {
                self.stereo_depths(grey, right.as_raw(), baseline_metres, config)?
            }
            _ => {
                let keypoints = self.extractor.extract(&self.extractor.pyramid(grey)?)?;
                let depth = |k: &Keypoint| depth_at(frame.depth.as_ref()?, &k.pixel, config);
                let depths = keypoints.iter().map(|k| Some((depth(k)?, config.inverse_depth_sigma))).collect();
                (keypoints, depths)
            }
        };
        let features = keypoints
            .into_iter()
            .zip(depths)
            .filter(|(k, _)| frame.keeps(&k.pixel))
            .map(|(k, depth)| Feature {
                pixel: self.camera.undistort_pixel(&k.pixel),
                octave: k.octave,
                angle_rad: k.angle_rad,
                depth_metres: depth.map(|(metres, _)| metres),
                inverse_depth_sigma: depth.map_or(0.0, |(_, sigma)| sigma),
                descriptor: k.descriptor,
            })
            .filter(|f| f.pixel.iter().all(|v| v.is_finite()))
            .collect();
        Ok(FrameFeatures::new(features, &self.camera.pinhole))
    }

    /// Keypoints of the left image with depths from the right one: depth = focal length · baseline / disparity.
    fn stereo_depths(
        &self,
        left: &[u8],
        right: &[u8],
        baseline_metres: f64,
        config: &TrackingConfig,
    ) -> Result<(Vec<Keypoint>, Vec<MeasuredDepth>), TrackingError> {
        let focal = self.camera.pinhole.fx;
        let scale = focal * baseline_metres;
        let eye = |grey| -> Result<_, TrackingError> {
            let pyramid = self.extractor.pyramid(grey)?;
            Ok((self.extractor.extract(&pyramid)?, pyramid))
        };
        let (left, right) = rayon::join(|| eye(left), || eye(right));
        let ((keypoints, left), (others, right)) = (left?, right?);
        let (left, right) = (Eye { keypoints: &keypoints, pyramid: &left }, Eye { keypoints: &others, pyramid: &right });
        let disparities = disparities(left, right, focal, config.pyramid_scale)?;
        let sigma = |k: &Keypoint| config.disparity_sigma * config.pyramid_scale.powi(k.octave.into()) / scale;
        let depths = keypoints.iter().zip(disparities).map(|(k, disparity)| disparity.map(|d| (scale / d, sigma(k)))).collect();
        Ok((keypoints, depths))
    }
}

impl Feature {
    /// Measurement with weights from the noise model.
    pub fn measurement(&self, config: &TrackingConfig) -> Measurement {
        Measurement {
            pixel: self.pixel,
            inverse_depth: self.depth_metres.map(|d| 1.0 / d),
            pixel_weight: 1.0 / (config.pixel_sigma * config.pyramid_scale.powi(self.octave.into())),
            depth_weight: if self.depth_metres.is_some() { 1.0 / self.inverse_depth_sigma } else { 0.0 },
        }
    }
}

/// Metres and the standard deviation of the inverse depth, 1/metres, where a depth was measured.
type MeasuredDepth = Option<(f64, f64)>;

/// The grid line (row or column) of a coordinate; what lies outside belongs to the border.
fn cell(coordinate: f64, count: usize) -> usize {
    ((coordinate / CELL_PIXELS).max(0.0) as usize).min(count - 1)
}

/// Rec. 601 luma in integers, row-major.
pub fn luma(image: &RgbImage) -> Vec<u8> {
    let of = |[r, g, b]: [u8; 3]| ((u32::from(r) * 77 + u32::from(g) * 150 + u32::from(b) * 29 + 128) >> 8) as u8;
    image.pixels().map(|p| of(p.0)).collect()
}

/// The depth at a recorded pixel, unless it is out of range, not finite, or on an edge.
fn depth_at(depth: &DepthImage, pixel: &Vector2<f64>, config: &TrackingConfig) -> Option<f64> {
    let (x, y) = (pixel.x.round(), pixel.y.round());
    if x < 0.0 || y < 0.0 || x >= f64::from(depth.width) || y >= f64::from(depth.height) {
        return None;
    }
    let (x, y) = (x as u32, y as u32);
    let centre = f64::from(depth.at(x, y)?);
    if !(centre >= config.min_depth_metres && centre <= config.max_depth_metres) {
        return None;
    }
    for v in y.saturating_sub(1)..=(y + 1).min(depth.height - 1) {
        for u in x.saturating_sub(1)..=(x + 1).min(depth.width - 1) {
            if depth.at(u, v).is_some_and(|d| (f64::from(d) - centre).abs() > config.depth_edge_ratio * centre) {
                return None;
            }
        }
    }
    Some(centre)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    pub fn feature(x: f64, y: f64, descriptor: Descriptor) -> Feature {
        Feature { pixel: Vector2::new(x, y), octave: 0, angle_rad: 0.0, depth_metres: None, inverse_depth_sigma: 0.0, descriptor }
    }

    #[test]
    fn the_grid_finds_what_a_full_search_finds() {
        let mut random = fastrand::Rng::with_seed(5);
        // Some lie outside of the image, as undistorted pixels may.
        let mut coordinate = |size: f64| random.f64() * (size + 40.0) - 20.0;
        let list: Vec<Feature> = (0..800).map(|_| feature(coordinate(640.0), coordinate(480.0), Descriptor::default())).collect();
        let grid = FrameFeatures::new(list.clone(), &PINHOLE);
        for _ in 0..200 {
            let (centre, radius) = (Vector2::new(coordinate(640.0), coordinate(480.0)), coordinate(60.0).abs());
            let mut found = Vec::new();
            grid.within(&centre, radius, |i| found.push(i));
            found.sort_unstable();
            let expected: Vec<usize> = (0..800).filter(|i| (list[*i].pixel - centre).norm() <= radius).collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn depth_on_an_edge_or_out_of_range_is_left_out() {
        let metres = (0..100).map(|i| if i % 10 < 5 { 1.0 } else { 2.0 }).collect();
        let mut depth = DepthImage { width: 10, height: 10, metres };
        depth.metres[3 * 10 + 1] = f32::NAN;
        let at = |x: f64, y: f64| depth_at(&depth, &Vector2::new(x, y), &TrackingConfig::default());
        assert_eq!(at(2.2, 6.0), Some(1.0));
        assert_eq!((at(4.0, 6.0), at(5.0, 6.0), at(7.0, 6.0)), (None, None, Some(2.0)));
        assert_eq!((at(1.0, 3.0), at(-3.0, 0.0), at(9.6, 2.0)), (None, None, None));
    }
}
