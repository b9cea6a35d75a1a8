//! An order of points in which neighbours in space are mostly neighbours in an image, beside or above each other (Morton 1966).

use glam::{DVec3, Vec3};

/// Bits of a coordinate.
const BITS: u32 = 21;

/// Indices of the points along the curve; points that share a cell keep their order.
pub(in crate::export) fn order(points: &[Vec3]) -> Vec<usize> {
    let low = points.iter().fold(DVec3::INFINITY, |low, p| low.min(p.as_dvec3()));
    let high = points.iter().fold(DVec3::NEG_INFINITY, |high, p| high.max(p.as_dvec3()));
    let size = (high - low).max_element().max(f64::MIN_POSITIVE);
    let most = f64::from((1u32 << BITS) - 1);
    let key = |p: &Vec3| {
        let [x, y, z] = ((p.as_dvec3() - low) / size * most).to_array().map(|v| spread(v as u64));
        x | y << 1 | z << 2
    };
    let keys: Vec<u64> = points.iter().map(key).collect();
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by_key(|i| keys[*i]);
    order
}

/// Indices of the points, row by row of an image of that width: those in the order of space fill it along the curve of the plane.
pub(super) fn image_order(points: &[Vec3], width: usize) -> Vec<usize> {
    let key = |pixel: &usize| {
        let [x, y] = [pixel % width, pixel / width].map(|v| spread(v as u64));
        x | y << 1
    };
    let mut pixels: Vec<usize> = (0..points.len()).collect();
    pixels.sort_by_key(key);
    let mut image = vec![0; points.len()];
    order(points).into_iter().zip(pixels).for_each(|(i, pixel)| image[pixel] = i);
    image
}

/// Two zeros after each bit.
fn spread(bits: u64) -> u64 {
    [
        (32, 0x1f_0000_0000_ffff),
        (16, 0x1f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ]
    .into_iter()
    .fold(bits & 0x1f_ffff, |bits, (shift, mask): (u32, u64)| (bits | bits << shift) & mask)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_in_the_order_are_near() {
        let mut rng = fastrand::Rng::with_seed(3);
        let points: Vec<Vec3> = (0..4096).map(|_| Vec3::new(rng.f32(), rng.f32(), rng.f32())).collect();
        let order = order(&points);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..points.len()).collect::<Vec<_>>());
        let path = |order: &[usize]| order.windows(2).map(|pair| points[pair[0]].distance(points[pair[1]])).sum::<f32>();
        assert!(path(&order) < 0.25 * path(&sorted));
        let image = image_order(&points, 64);
        let above = (64..points.len()).map(|pixel| points[image[pixel]].distance(points[image[pixel - 64]])).sum::<f32>();
        let by_rows = (64..points.len()).map(|pixel| points[order[pixel]].distance(points[order[pixel - 64]])).sum::<f32>();
        assert!(above < 0.7 * by_rows, "{above} against {by_rows}");
        sorted = image;
        sorted.sort_unstable();
        assert_eq!(sorted, (0..points.len()).collect::<Vec<_>>());
        assert_eq!(spread(0b101), 0b1_000_001);
        assert_eq!(spread(u64::MAX), 0x1249_2492_4924_9249);
    }
}
