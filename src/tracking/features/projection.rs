//! Search by projection: matches points with a predicted pixel to the features around it (Mur-Artal & Tardós, *ORB-SLAM2*, 2017).

use nalgebra::Vector2;

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::features::matching::{Query, Rules, match_by_projection};
use crate::tracking::rig::Rig;

/// Predicted appearance of a point in a frame.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    /// The caller's index of the point.
    pub point: usize,
    pub pixel: Vector2<f64>,
    /// Pyramid octave at which the point should be detected.
    pub octave: u8,
    /// Cosine between the line of sight and the point's mean viewing direction.
    pub view_cosine: f64,
    /// 1/metres.
    pub inverse_depth: f64,
    pub descriptor: Descriptor,
    /// Angle of the keypoint that the descriptor comes from, for [`Rules::check_rotation`].
    pub angle_rad: f32,
}

/// A point and the feature that matches it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PointMatch {
    pub point: usize,
    pub feature: usize,
}

/// Tolerances of a search by projection.
#[derive(Clone, Copy, Debug)]
pub struct ProjectionSearch<'a> {
    /// Features left out; empty for none.
    pub taken: &'a [bool],
    /// Octaves above the predicted one that are searched too; one below always is.
    pub coarser_octaves: u8,
    pub rules: Rules,
}

impl ProjectionSearch<'_> {
    /// Matches projections to the features of `frame`, in the order of the projections. `radius` is in pixels at the finest octave.
    pub fn run(
        &self,
        frame: &FrameFeatures,
        projections: &[Projection],
        radius: impl Fn(&Projection) -> f64,
        rig: &Rig,
    ) -> Vec<PointMatch> {
        let query = |p: &Projection| Query {
            pixel: p.pixel,
            radius: radius(p) * rig.octave_scale(p.octave),
            octaves: p.octave.saturating_sub(1)..=p.octave + self.coarser_octaves,
            descriptor: p.descriptor,
            angle_rad: p.angle_rad,
            inverse_depth: p.inverse_depth,
        };
        let queries: Vec<Query> = projections.iter().map(query).collect();
        let matches = match_by_projection(frame, self.taken, &queries, &self.rules);
        matches.iter().map(|m| PointMatch { point: projections[m.query].point, feature: m.feature }).collect()
    }
}
