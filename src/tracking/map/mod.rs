//! The sparse map: keyframes, landmarks and covisibility; their creation, fusion and culling.

pub mod attachment;
pub mod insertion;
pub mod keyframe;
pub mod keyframe_culling;
pub mod keyframe_database;
pub mod landmark;
pub mod prediction;
pub mod sparse_map;
pub mod tally;
pub mod triangulation;

pub use sparse_map::Map;

/// Gives back what a list has not used since it was more than twice as long.
fn trim<T>(list: &mut Vec<T>) {
    if list.capacity() > 2 * list.len() {
        list.shrink_to_fit();
    }
}
