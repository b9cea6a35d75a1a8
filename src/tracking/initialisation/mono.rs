//! How a camera without depth begins: a first frame is kept and followed until it and the newest one show two views of one scene.

use std::sync::Arc;

use nalgebra::Vector2;

use crate::geometry::{Pinhole, Se3};
use crate::tracking::TrackingConfig;
use crate::tracking::adjustment::local_bundle;
use crate::tracking::features::frame_features::FrameFeatures;
use crate::tracking::features::matching::{Match, Query, Rules, match_by_projection};
use crate::tracking::initialisation::two_view::two_views;
use crate::tracking::map::sparse_map::{Keyframe, Map, Observation};
use crate::tracking::rig::Rig;

/// How far a feature may move from one frame to the next, as a share of the image's width.
const SEARCH_SHARE: f64 = 0.16;
const RULES: Rules = Rules { max_distance: 50, ratio: 0.9, check_rotation: true };
/// With fewer matches another first frame is chosen.
const MIN_MATCHES: usize = 100;
/// The scene's median depth in the first keyframe becomes this: the unit of a map without scale.
const MEDIAN_DEPTH: f64 = 2.0;

/// The first frame, and where its features were last seen.
#[derive(Clone, Debug)]
pub struct FirstView {
    frame_index: usize,
    timestamp_s: f64,
    features: Arc<FrameFeatures>,
    last_seen: Vec<Vector2<f64>>,
}

impl FirstView {
    pub fn new(frame_index: usize, timestamp_s: f64, features: Arc<FrameFeatures>) -> Self {
        let last_seen = features.features.iter().map(|f| f.pixel).collect();
        Self { frame_index, timestamp_s, features, last_seen }
    }

    /// Follows the features into the next frame; `None` if too few are left.
    pub fn follow(&mut self, frame: &FrameFeatures, pinhole: &Pinhole) -> Option<Vec<Match>> {
        let queries: Vec<Query> = self
            .features
            .features
            .iter()
            .zip(&self.last_seen)
            .map(|(feature, pixel)| Query {
                pixel: *pixel,
                radius: SEARCH_SHARE * f64::from(pinhole.width),
                octaves: feature.octave.saturating_sub(1)..=feature.octave + 1,
                descriptor: feature.descriptor,
                angle_rad: feature.angle_rad,
                inverse_depth: 0.0,
            })
            .collect();
        let matches = match_by_projection(frame, &[], &queries, &RULES);
        for m in &matches {
            self.last_seen[m.query] = frame.features[m.feature].pixel;
        }
        (matches.len() >= MIN_MATCHES).then_some(matches)
    }
}

/// The frame that completes a two-view start.
pub struct SecondView<'a> {
    pub frame_index: usize,
    pub timestamp_s: f64,
    pub features: &'a Arc<FrameFeatures>,
}

/// The map of two keyframes, if the first view and this frame show one scene from two places.
pub fn first_map(first: &FirstView, second: &SecondView<'_>, matches: &[Match], rig: &Rig) -> Option<Map> {
    let Rig { pinhole, config, .. } = rig;
    let SecondView { frame_index, timestamp_s, features } = *second;
    let pixels: Vec<(Vector2<f64>, Vector2<f64>)> =
        matches.iter().map(|m| (first.features.features[m.query].pixel, features.features[m.feature].pixel)).collect();
    let found = two_views(&pixels, pinhole)?;
    let mut map = Map::default();
    map.push(Keyframe::new(first.frame_index, first.timestamp_s, Se3::identity(), first.features.clone()));
    map.push(Keyframe::new(frame_index, timestamp_s, found.second_from_first, features.clone()));
    for (m, point) in matches.iter().zip(&found.points) {
        let Some(point) = point else { continue };
        let landmark = map.add_landmark(Observation { keyframe: 0, feature: m.query }, *point, config);
        map.add_observation(landmark, Observation { keyframe: 1, feature: m.feature });
    }
    local_bundle::adjust_window(&mut map, 1, rig);
    rescale(&mut map, config)?;
    (map.keyframes[1].landmark_count(&map, 2) >= config.min_initial_landmarks).then_some(map)
}

/// Scales the map so that the first keyframe's median depth is `MEDIAN_DEPTH`; `None` where there is no such depth.
fn rescale(map: &mut Map, config: &TrackingConfig) -> Option<()> {
    let scale = MEDIAN_DEPTH / map.median_depth(0).filter(|depth| *depth > 1e-6)?;
    for keyframe in &mut map.keyframes {
        keyframe.camera_from_world.translation.vector *= scale;
    }
    for landmark in 0..map.landmarks.len() {
        map.landmarks[landmark].in_anchor.coords *= scale;
        map.refresh_descriptor(landmark);
        map.refresh_geometry(landmark, config);
    }
    Some(())
}
