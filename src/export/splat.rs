//! `.splat` (Kevin Kwok's antimatter15/splat, MIT): 32 bytes a Gaussian without a header, and no view dependence. Only read.

use std::io::BufRead;
use std::path::Path;

use glam::{Quat, Vec3};

use super::{ExportError, FileSize, FormatRow};
use crate::splat::{Gaussian, GaussianCloud, ShDegree, raw_opacity_of_byte, sh::dc_from_color};

/// The format's row in the table of formats.
pub(super) const FORMAT: FormatRow = FormatRow {
    name: "splat",
    extension: "splat",
    help: "32 bytes a Gaussian, without harmonics; only read.",
    keeps_antialiasing: false,
    is_lossless: false,
    tolerance: 0.06,
    encode: None,
    decode,
};

/// Position and extents as floats, four bytes of colour, four of the rotation.
const STRIDE: usize = 32;
/// A flat Gaussian's least extent, metres: its logarithm would not be finite.
const LEAST_EXTENT: f32 = 1e-9;

fn decode(reader: &mut dyn BufRead, FileSize(size): FileSize, path: &Path) -> Result<GaussianCloud, ExportError> {
    let damaged = |what: String| ExportError::Damaged { path: path.into(), what };
    if size == 0 || !size.is_multiple_of(STRIDE as u64) {
        return Err(damaged(format!("{size} bytes are no whole number of Gaussians of {STRIDE} bytes")));
    }
    let mut cloud = GaussianCloud::new(ShDegree::default());
    let mut bytes = [0u8; STRIDE];
    for index in 0..(size / STRIDE as u64) as usize {
        reader.read_exact(&mut bytes).map_err(|source| ExportError::Read { path: path.into(), source })?;
        let gaussian = gaussian(&bytes);
        let extents = [12, 16, 20].map(|at| float(&bytes, at));
        let (finite, positive) = (gaussian.mean.is_finite(), extents.iter().all(|v| v.is_finite() && *v >= 0.0));
        let wrong =
            |property: &str, value: f32| ExportError::Value { path: path.into(), index, property: property.into(), value };
        if !finite {
            return Err(wrong("position", gaussian.mean.element_sum()));
        }
        if !positive {
            return Err(wrong("extent", extents.into_iter().find(|v| !v.is_finite() || *v < 0.0).unwrap_or_default()));
        }
        cloud.push(gaussian);
    }
    Ok(cloud)
}

fn float(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// Bytes of a rotation are w, x, y and z from −1 to 1; all in the middle are none.
fn gaussian(bytes: &[u8; STRIDE]) -> Gaussian {
    let vector = |at: usize| Vec3::new(float(bytes, at), float(bytes, at + 4), float(bytes, at + 8));
    let share = |at: usize| f32::from(bytes[at]) / 255.0;
    let component = |at: usize| (f32::from(bytes[at]) - 128.0) / 128.0;
    let rotation = Quat::from_xyzw(component(29), component(30), component(31), component(28));
    Gaussian {
        mean: vector(0),
        log_scale: vector(12).max(Vec3::splat(LEAST_EXTENT)).map(f32::ln),
        rotation: if rotation.length_squared() > 0.0 { rotation.normalize() } else { Quat::IDENTITY },
        raw_opacity: raw_opacity_of_byte(bytes[27]),
        sh: vec![dc_from_color(Vec3::new(share(24), share(25), share(26)))],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> Vec<u8> {
        let floats = [1.0f32, -2.0, 3.0, 0.5, 0.25, 0.0];
        let mut bytes: Vec<u8> = floats.iter().flat_map(|v| v.to_le_bytes()).collect();
        bytes.extend([255, 0, 51, 204, 192, 128, 64, 128]);
        bytes
    }

    fn read(bytes: &[u8]) -> Result<GaussianCloud, ExportError> {
        decode(&mut &*bytes, FileSize(bytes.len() as u64), Path::new("x.splat"))
    }

    #[test]
    fn a_file_coded_by_hand_is_read() {
        let cloud = read(&file().repeat(2)).unwrap();
        let one = cloud.get(1);
        assert_eq!((cloud.len(), one.mean), (2, Vec3::new(1.0, -2.0, 3.0)));
        assert_eq!(one.log_scale, Vec3::new(0.5f32.ln(), 0.25f32.ln(), LEAST_EXTENT.ln()));
        assert!(one.sh[0].distance(dc_from_color(Vec3::new(1.0, 0.0, 0.2))) < 1e-6);
        assert!((one.raw_opacity - 4f32.ln()).abs() < 1e-5);
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert!(one.rotation.dot(Quat::from_xyzw(0.0, -half, 0.0, half)) > 1.0 - 1e-5, "{}", one.rotation);
    }

    #[test]
    fn what_is_no_splat_is_refused() {
        let refusal = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
        assert!(refusal(&[]).contains("0 bytes") && refusal(&file()[..31]).contains("31 bytes"));
        let mut damaged = file();
        damaged[12..16].copy_from_slice(&(-1f32).to_le_bytes());
        assert!(refusal(&damaged).contains("`extent` of Gaussian 0 is -1"));
        damaged[0..4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refusal(&damaged).contains("`position` of Gaussian 0"));
        let mut unturned = file();
        unturned[28..].fill(128);
        assert_eq!(read(&unturned).unwrap().get(0).rotation, Quat::IDENTITY);
    }
}
