//! Leaves out depth that other views contradict: each pixel's point is looked at from the nearest views.
//!
//! A view confirms a point whose depth it shares, contradicts one that it sees through, and knows nothing of one that it sees something in front of.

use nalgebra::{Point3, Vector2};
use rayon::prelude::*;

use super::{DepthView, MeshConfig};

/// Metres between two cameras count as much as this angle between their axes, radians a metre.
const RADIANS_A_METRE: f64 = 0.5;
/// Views whose axes differ by more share no surface worth comparing, radians.
const MOST_ANGLE: f64 = 1.0;

/// Sets the depth of contradicted pixels to unknown.
pub(super) fn check(views: &mut [DepthView], config: &MeshConfig) {
    if config.neighbours == 0 {
        return;
    }
    let seen: &[DepthView] = views;
    let kept: Vec<Vec<bool>> = (0..seen.len()).into_par_iter().map(|i| confirmed(seen, i, config)).collect();
    for (view, kept) in views.iter_mut().zip(kept) {
        view.inverse_depth.iter_mut().zip(kept).filter(|(_, kept)| !kept).for_each(|(inverse, _)| *inverse = 0.0);
    }
}

/// The views that look most alike, nearest first.
fn neighbours(views: &[DepthView], of: usize, count: usize) -> Vec<usize> {
    let axis = |k: usize| views[k].world_from_camera.rotation * nalgebra::Vector3::z();
    let centre = |k: usize| views[k].world_from_camera.translation.vector;
    let mut others: Vec<(f64, usize)> = (0..views.len())
        .filter(|k| *k != of)
        .map(|k| (axis(of).angle(&axis(k)), RADIANS_A_METRE * (centre(of) - centre(k)).norm(), k))
        .filter(|(angle, ..)| *angle < MOST_ANGLE)
        .map(|(angle, away, k)| (angle + away, k))
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.into_iter().take(count).map(|(_, k)| k).collect()
}

/// Of each pixel, whether the neighbours confirm it at least as often as they contradict it. What no other view saw is kept.
fn confirmed(views: &[DepthView], of: usize, config: &MeshConfig) -> Vec<bool> {
    let view = &views[of];
    let others: Vec<_> = neighbours(views, of, config.neighbours)
        .into_iter()
        .map(|k| (&views[k], views[k].world_from_camera.inverse() * view.world_from_camera))
        .collect();
    let width = view.pinhole.width as usize;
    let tolerance = config.tolerance as f32;
    let vote = |(i, inverse): (usize, &f32)| {
        if *inverse == 0.0 {
            return false;
        }
        let pixel = Vector2::new((i % width) as f64, (i / width) as f64);
        let point = Point3::from(view.pinhole.unproject(&pixel, f64::from(inverse.recip())));
        let (mut agree, mut against) = (0, 0);
        for (other, other_from_view) in &others {
            let p = other_from_view * point;
            let Some(at) = other.pinhole.project(&p.coords).filter(|at| other.pinhole.contains(at, 0.0)) else { continue };
            let there = other.sample(at.x as f32, at.y as f32);
            if there == 0.0 {
                continue;
            }
            // Share of its depth by which the other view sees through the point.
            let through = 1.0 - p.z as f32 * there;
            agree += usize::from(through.abs() <= tolerance);
            against += usize::from(through > tolerance);
        }
        agree >= against
    };
    view.inverse_depth.iter().enumerate().map(vote).collect()
}
