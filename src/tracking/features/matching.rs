//! Matching of descriptors: around where a point is predicted, and against all of another frame.
//!
//! A feature is given to the query that it resembles most, whatever their order. False matches are thinned by the ratio to the
//! second best and by rotation: true matches between two frames turn their keypoints by about the same angle.

use std::f32::consts::TAU;
use std::ops::RangeInclusive;

use nalgebra::Vector2;
use pulp::{Arch, Simd};

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::{Feature, FrameFeatures};

/// Bins of the rotation histogram, 12° each; the fullest three stay.
const ROTATION_BINS: usize = 30;
const ROTATION_BINS_KEPT: usize = 3;
/// Share of the fullest bin that another needs to stay.
const ROTATION_BIN_SHARE: f64 = 0.1;
/// How far (1/metres) a measured inverse depth may be from the predicted one; wide, only to tell surfaces apart.
const INVERSE_DEPTH_GATE: f64 = 0.15;

/// Descriptor to be matched around a pixel.
#[derive(Clone, Debug)]
pub struct Query {
    pub pixel: Vector2<f64>,
    pub radius: f64,
    pub octaves: RangeInclusive<u8>,
    pub descriptor: Descriptor,
    /// The keypoint's angle in the frame it comes from, for the rotation check.
    pub angle_rad: f32,
    /// Predicted, 1/metres.
    pub inverse_depth: f64,
}

/// How strict to be.
#[derive(Clone, Copy, Debug)]
pub struct Rules {
    /// Largest Hamming distance of a match.
    pub max_distance: u32,
    /// The best must be below this share of the second best (of the same octave); 1 turns it off.
    pub ratio: f32,
    /// Whether matches must agree in rotation.
    pub check_rotation: bool,
}

/// Query (or feature of the first frame) `query` is feature `feature`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Match {
    pub query: usize,
    pub feature: usize,
    pub distance: u32,
}

/// Matches queries to the features around them that are not `taken`, sorted by query. `taken` may be empty for none.
#[pulp::with_simd(match_by_projection = Arch::new())]
#[inline(always)]
pub fn match_by_projection_with<'a, S: Simd>(
    _: S,
    frame: &'a FrameFeatures,
    taken: &'a [bool],
    queries: &'a [Query],
    rules: &'a Rules,
) -> Vec<Match> {
    let mut claims: Vec<Option<Match>> = vec![None; frame.len()];
    for (index, query) in queries.iter().enumerate() {
        let (mut best, mut second) = (None::<(u32, usize, u8)>, None::<(u32, u8)>);
        frame.within(&query.pixel, query.radius, &query.octaves, |i| {
            let feature = &frame.features[i];
            let off_depth = feature.depth_metres.is_some_and(|d| (1.0 - d * query.inverse_depth).abs() > d * INVERSE_DEPTH_GATE);
            if taken.get(i).copied().unwrap_or(false) || off_depth {
                return;
            }
            let distance = feature.descriptor.distance(&query.descriptor);
            if best.is_none_or(|(d, ..)| distance < d) {
                second = best.map(|(d, _, octave)| (d, octave));
                best = Some((distance, i, feature.octave));
            } else if second.is_none_or(|(d, _)| distance < d) {
                second = Some((distance, feature.octave));
            }
        });
        let Some((distance, feature, octave)) = best else { continue };
        let ambiguous = second.is_some_and(|(d, o)| o == octave && distance as f32 > rules.ratio * d as f32);
        if distance > rules.max_distance || ambiguous || claims[feature].is_some_and(|claim| claim.distance <= distance) {
            continue;
        }
        claims[feature] = Some(Match { query: index, feature, distance });
    }
    let mut matches: Vec<Match> = claims.into_iter().flatten().collect();
    matches.sort_by_key(|m| m.query);
    if rules.check_rotation {
        keep_common_rotation(&mut matches, |m| frame.features[m.feature].angle_rad - queries[m.query].angle_rad);
    }
    matches
}

/// Matches `wanted` features of `a` to all features of `b`: each other's best, by the rules.
pub fn match_all(a: &[Feature], wanted: &[bool], b: &[Feature], rules: &Rules) -> Vec<Match> {
    let mut claims: Vec<Option<Match>> = vec![None; b.len()];
    for (query, from) in a.iter().enumerate().filter(|(i, _)| wanted[*i]) {
        let (mut best, mut second) = ((u32::MAX, 0), u32::MAX);
        for (i, to) in b.iter().enumerate() {
            let distance = from.descriptor.distance(&to.descriptor);
            if distance < best.0 {
                (best, second) = ((distance, i), best.0);
            } else if distance < second {
                second = distance;
            }
        }
        let (distance, feature) = best;
        if distance > rules.max_distance || distance as f32 > rules.ratio * second as f32 {
            continue;
        }
        if claims[feature].is_none_or(|claim| distance < claim.distance) {
            claims[feature] = Some(Match { query, feature, distance });
        }
    }
    let mut matches: Vec<Match> = claims.into_iter().flatten().collect();
    matches.sort_by_key(|m| m.query);
    if rules.check_rotation {
        keep_common_rotation(&mut matches, |m| b[m.feature].angle_rad - a[m.query].angle_rad);
    }
    matches
}

fn keep_common_rotation(matches: &mut Vec<Match>, turn: impl Fn(&Match) -> f32) {
    let bin = |m: &Match| ((turn(m).rem_euclid(TAU) / TAU * ROTATION_BINS as f32).round() as usize) % ROTATION_BINS;
    let mut counts = [0usize; ROTATION_BINS];
    for m in matches.iter() {
        counts[bin(m)] += 1;
    }
    let mut ranked: Vec<usize> = (0..ROTATION_BINS).collect();
    ranked.sort_by_key(|b| (std::cmp::Reverse(counts[*b]), *b));
    let least = ROTATION_BIN_SHARE * counts[ranked[0]] as f64;
    let kept = |b: usize| ranked[..ROTATION_BINS_KEPT].contains(&b) && counts[b] as f64 >= least;
    matches.retain(|m| kept(bin(m)));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::features::frame_features::tests::feature;
    use crate::tracking::solvers::residual::tests::PINHOLE;

    const RULES: Rules = Rules { max_distance: 60, ratio: 0.8, check_rotation: true };

    fn random_descriptor(random: &mut fastrand::Rng) -> Descriptor {
        Descriptor(std::array::from_fn(|_| random.u64(..)))
    }

    /// A second view: shifted by (7, −4), turned by 0.3 rad, 20 bits of each descriptor flipped; every tenth is turned otherwise.
    fn two_views() -> (Vec<Feature>, Vec<Feature>) {
        let mut random = fastrand::Rng::with_seed(9);
        let mut first = Vec::new();
        let mut second = Vec::new();
        for i in 0..400 {
            let descriptor = random_descriptor(&mut random);
            let mut flipped = descriptor;
            (0..20).for_each(|_| flipped.0[random.usize(0..4)] ^= 1 << random.u32(0..64));
            let at = Vector2::new(20.0 + 600.0 * random.f64(), 20.0 + 440.0 * random.f64());
            let turn = if i % 10 == 0 { 1.0 + 0.1 * (i / 10) as f32 } else { 0.3 };
            first.push(Feature { angle_rad: 6.2, ..feature(at.x, at.y, descriptor) });
            second.push(Feature { angle_rad: (6.2f32 + turn).rem_euclid(TAU), ..feature(at.x + 7.0, at.y - 4.0, flipped) });
        }
        (first, second)
    }

    fn check(matches: &[Match]) {
        assert!(matches.len() > 330, "{}", matches.len());
        assert!(matches.iter().all(|m| m.query == m.feature && m.query % 10 != 0));
    }

    #[test]
    fn both_ways_find_the_true_matches_only() {
        let (first, second) = two_views();
        check(&match_all(&first, &[true; 400], &second, &RULES));
        let frame = FrameFeatures::new(second, &PINHOLE);
        let queries: Vec<Query> = first
            .iter()
            .map(|f| Query {
                pixel: f.pixel,
                radius: 15.0,
                octaves: 0..=1,
                descriptor: f.descriptor,
                angle_rad: f.angle_rad,
                inverse_depth: 0.5,
            })
            .collect();
        check(&match_by_projection(&frame, &[], &queries, &RULES));
        let far: Vec<Query> = queries.iter().cloned().map(|q| Query { radius: 5.0, ..q }).collect();
        assert!(match_by_projection(&frame, &[], &far, &RULES).is_empty());
        assert!(match_by_projection(&frame, &[true; 400], &queries, &RULES).is_empty());
    }

    #[test]
    fn a_feature_goes_to_the_query_that_resembles_it_most() {
        let d = |bits: u32| Descriptor([(1u64 << bits) - 1, 0, 0, 0]);
        let frame = FrameFeatures::new(vec![feature(50.0, 50.0, d(0))], &PINHOLE);
        let query = |bits| Query {
            pixel: Vector2::new(52.0, 50.0),
            radius: 5.0,
            octaves: 0..=0,
            descriptor: d(bits),
            angle_rad: 0.0,
            inverse_depth: 1.0,
        };
        let found = match_by_projection(&frame, &[], &[query(9), query(3), query(6)], &RULES);
        assert_eq!(found, [Match { query: 1, feature: 0, distance: 3 }]);
    }
}
