//! Pictures for viewers: recorded images, and the map as the rasterizer draws it, its depth, and its error against a recorded image.

use std::borrow::Cow;
use std::io::Cursor;
use std::sync::Mutex;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, GrayImage, ImageEncoder, ImageResult, Luma, Rgb, RgbImage, imageops};

use super::protocol::{CameraView, ImageHeader, MOST_TO_VIEWER, Outgoing, RenderKind, RenderRequest, ToViewer};
use crate::evaluation::views::to_rgb8;
use crate::geometry::Camera;
use crate::recording::Recording;
use crate::render::Rendered;
use crate::sequence::{RectifiedImage, Rectifiers};

const JPEG_QUALITY: u8 = 88;
/// Width of the image of the newest frame, pixels.
const CURRENT_WIDTH: u32 = 320;
const CURRENT_QUALITY: u8 = 75;
/// Recorded images are sent at most this wide.
const MOST_RECORDED_WIDTH: u32 = 1280;
/// Shares of the pixels nearer than what black stands for, and farther than what white stands for.
const DEPTH_TAILS: f32 = 0.02;
/// Errors are shown this many times as bright.
const ERROR_GAIN: f32 = 4.0;
/// Room for a header.
const HEADER: usize = 4096;

/// Recorded images of frames, rectified as the mapper has them.
pub struct RecordedImages {
    rectifiers: Mutex<Rectifiers>,
}

impl RecordedImages {
    /// Those of a recording, at its mapping resolution.
    pub fn new(recording: &Recording) -> Self {
        Self { rectifiers: Mutex::new(Rectifiers::new(recording.config().map_scale)) }
    }

    /// Whether frames can be loaded in any order, which those of a video cannot.
    pub fn are_there(recording: &Recording) -> bool {
        recording.sequence().has_random_access()
    }

    /// The image of a frame.
    ///
    /// # Errors
    /// Why it cannot be loaded.
    pub fn load(&self, recording: &Recording, frame: usize) -> Result<RectifiedImage, String> {
        let sequence = recording.sequence();
        if frame >= sequence.entries.len() || !Self::are_there(recording) {
            return Err("this recording has no image of that frame to load".into());
        }
        let loaded = sequence.load(frame).map_err(|error| error.to_string())?;
        let camera: &Camera = sequence.camera_of(frame);
        let rectifier = self.rectifiers.lock().map_err(|_| "the images cannot be rectified")?.of(camera);
        Ok(rectifier.rectify(&loaded))
    }
}

/// The message of a keyframe's recorded image.
///
/// # Errors
/// Why it cannot be encoded.
pub fn recorded(image: &RectifiedImage, id: usize, frame: usize) -> Result<Outgoing, String> {
    let color = fitted(&image.color, MOST_RECORDED_WIDTH);
    let header = ImageHeader {
        of: "keyframe",
        format: "jpeg",
        width: color.width(),
        height: color.height(),
        id: Some(id),
        frame: Some(frame),
        camera: Some(CameraView::from(image.pinhole)),
        ..ImageHeader::default()
    };
    message(header, jpeg(&color, JPEG_QUALITY))
}

/// The message of the newest frame's image.
///
/// # Errors
/// Why it cannot be encoded.
pub fn current(image: &RgbImage, frame: usize) -> Result<Outgoing, String> {
    let small = fitted(image, CURRENT_WIDTH);
    let (width, height) = small.dimensions();
    let header = ImageHeader { of: "current", format: "jpeg", width, height, frame: Some(frame), ..ImageHeader::default() };
    message(header, jpeg(&small, CURRENT_QUALITY))
}

/// The message of a rendered view. An error needs the recorded image that it is against, of the same field of view.
///
/// # Errors
/// Why there is no such picture.
pub fn rendered(view: &Rendered, request: &RenderRequest, recorded: Option<&RgbImage>) -> Result<Outgoing, String> {
    let recorded = recorded.map(|image| match image.dimensions() == (view.width, view.height) {
        true => Cow::Borrowed(image),
        false => Cow::Owned(imageops::resize(image, view.width, view.height, imageops::FilterType::Triangle)),
    });
    let mut header = ImageHeader {
        of: "render",
        format: "png",
        width: view.width,
        height: view.height,
        request: Some(request.request),
        kind: Some(request.kind),
        ..ImageHeader::default()
    };
    let bytes = match request.kind {
        RenderKind::Color => {
            let color = to_rgb8(view);
            let exact = png(color.as_raw(), color.dimensions(), ExtendedColorType::Rgb8);
            // A large picture of much detail fits as a JPEG only.
            if exact.as_ref().is_ok_and(|bytes| bytes.len() + HEADER > MOST_TO_VIEWER) {
                header.format = "jpeg";
                jpeg(&color, JPEG_QUALITY)
            } else {
                exact
            }
        }
        RenderKind::Depth => {
            let (gray, near, far) = depth(view);
            (header.near, header.far) = (Some(near), Some(far));
            png(gray.as_raw(), gray.dimensions(), ExtendedColorType::L8)
        }
        RenderKind::Error => {
            let (color, psnr_db) = error(view, recorded.as_deref().ok_or("an error needs a keyframe with its image")?);
            header.psnr_db = psnr_db;
            header.format = "jpeg";
            jpeg(&color, JPEG_QUALITY)
        }
    };
    message(header, bytes)
}

fn message(header: ImageHeader, bytes: ImageResult<Vec<u8>>) -> Result<Outgoing, String> {
    let bytes = bytes.map_err(|error| format!("the picture cannot be encoded: {error}"))?;
    if bytes.len() + HEADER > MOST_TO_VIEWER {
        return Err("the picture is too large to be sent".into());
    }
    Ok(Outgoing::binary(&ToViewer::Image(header), |all| all.extend_from_slice(&bytes)))
}

fn fitted(image: &RgbImage, width: u32) -> RgbImage {
    if image.width() <= width {
        return image.clone();
    }
    let height = (image.height() * width).div_ceil(image.width()).max(1);
    imageops::resize(image, width, height, imageops::FilterType::Triangle)
}

fn jpeg(image: &RgbImage, quality: u8) -> ImageResult<Vec<u8>> {
    let mut bytes = Cursor::new(Vec::new());
    JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(image)?;
    Ok(bytes.into_inner())
}

fn png(pixels: &[u8], (width, height): (u32, u32), color: ExtendedColorType) -> ImageResult<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(pixels, width, height, color)?;
    Ok(bytes)
}

/// Expected depth as grey values, and the metres that black and white stand for. Pixels that the map does not cover are black.
fn depth(view: &Rendered) -> (GrayImage, f32, f32) {
    let metres: Vec<f32> = (0..view.color_depth.len()).map(|i| view.expected_depth(i)).collect();
    let mut seen: Vec<f32> = metres.iter().copied().filter(|d| d.is_finite() && *d > 0.0).collect();
    seen.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| seen.get((share * seen.len() as f32) as usize).copied();
    let (near, far) = (at(DEPTH_TAILS).unwrap_or(0.0), at(1.0 - DEPTH_TAILS).unwrap_or(1.0));
    let range = (far - near).max(f32::EPSILON);
    let gray = GrayImage::from_fn(view.width, view.height, |x, y| {
        let share = (metres[(y * view.width + x) as usize] - near) / range;
        Luma([(share.clamp(0.0, 1.0) * 255.0).round() as u8])
    });
    (gray, near, far)
}

/// |recorded − rendered|, brightened, after the gains of least squares for red, green and blue; and the PSNR with these gains.
fn error(view: &Rendered, recorded: &RgbImage) -> (RgbImage, Option<f64>) {
    let pixel = |i: usize| [0, 1, 2].map(|c| f64::from(view.color_depth[i][c].clamp(0.0, 1.0)));
    let truth = |i: usize| [0, 1, 2].map(|c| f64::from(recorded.as_raw()[3 * i + c]) / 255.0);
    let count = view.color_depth.len();
    let mut sums = [[0.0f64; 2]; 3];
    for i in 0..count {
        let (p, t) = (pixel(i), truth(i));
        sums.iter_mut().enumerate().for_each(|(c, sum)| *sum = [sum[0] + p[c] * t[c], sum[1] + p[c] * p[c]]);
    }
    let gains = sums.map(|[product, square]| if square > 0.0 { product / square } else { 1.0 });
    let difference = |i: usize| {
        let (p, t) = (pixel(i), truth(i));
        [0, 1, 2].map(|c| (t[c] - (gains[c] * p[c]).min(1.0)).abs())
    };
    let squares: f64 = (0..count).flat_map(difference).map(|d| d * d).sum();
    let psnr_db = (squares > 0.0).then(|| -10.0 * (squares / (3 * count) as f64).log10());
    let byte = |d: f64| (d * f64::from(ERROR_GAIN) * 255.0).min(255.0).round() as u8;
    let image = RgbImage::from_fn(view.width, view.height, |x, y| Rgb(difference((y * view.width + x) as usize).map(byte)));
    (image, psnr_db)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(color: [f32; 3], metres: impl Fn(u32) -> f32) -> Rendered {
        let pixels = 32u32 * 20;
        let pixel = |i: u32| [color[0], color[1], color[2], metres(i)];
        Rendered {
            surface: Vec::new(),
            width: 32,
            height: 20,
            color_depth: (0..pixels).map(pixel).collect(),
            transmittance: vec![0.0; pixels as usize],
        }
    }

    fn request(kind: RenderKind) -> RenderRequest {
        let (p, q) = ([0.0; 3], [0.0, 0.0, 0.0, 1.0]);
        RenderRequest { request: 5, kind, p, q, width: 32, height: 20, fx: 30.0, fy: 30.0, cx: 15.5, cy: 9.5, id: None }
    }

    fn parts(message: &Outgoing) -> (serde_json::Value, image::DynamicImage) {
        let Outgoing::Binary(bytes) = message else { panic!("pictures are binary") };
        let header = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
        let value = serde_json::from_slice(&bytes[4..4 + header]).unwrap();
        (value, image::load_from_memory(&bytes[4 + header..]).unwrap())
    }

    #[test]
    fn colours_are_exact() {
        let message = rendered(&view([0.2, 0.4, 2.0], |_| 1.0), &request(RenderKind::Color), None).unwrap();
        let (header, image) = parts(&message);
        assert_eq!((header["request"].as_u64(), header["kind"].as_str()), (Some(5), Some("color")));
        assert!(image.to_rgb8().pixels().all(|p| p.0 == [51, 102, 255]));
    }

    #[test]
    fn depth_is_between_near_and_far() {
        let message = rendered(&view([0.0; 3], |i| 1.0 + i as f32 / 640.0), &request(RenderKind::Depth), None).unwrap();
        let (header, image) = parts(&message);
        let (near, far) = (header["near"].as_f64().unwrap(), header["far"].as_f64().unwrap());
        assert!((near - 1.02).abs() < 5e-3 && (far - 1.98).abs() < 5e-3, "{near} {far}");
        let gray = image.to_luma8();
        assert_eq!((gray.as_raw()[0], gray.as_raw()[639]), (0, 255));
        assert!((i32::from(gray.as_raw()[320]) - 128).abs() <= 1);
    }

    #[test]
    fn errors_are_what_gains_do_not_explain() {
        let recorded = RgbImage::from_pixel(32, 20, Rgb([100, 50, 20]));
        let same = rendered(&view([0.2, 0.3, 0.1], |_| 1.0), &request(RenderKind::Error), Some(&recorded)).unwrap();
        assert!(parts(&same).1.to_rgb8().pixels().all(|p| p.0.iter().all(|v| *v < 4)));
        assert!(rendered(&view([0.2; 3], |_| 1.0), &request(RenderKind::Error), None).is_err());
        let mut odd = recorded.clone();
        odd.put_pixel(3, 4, Rgb([250, 50, 20]));
        let (image, psnr_db) = error(&view([0.2, 0.3, 0.1], |_| 1.0), &odd);
        assert!(image.get_pixel(3, 4).0[0] > 200 && image.get_pixel(20, 4).0[0] < 10);
        assert!(psnr_db.is_some_and(|db| (30.0..45.0).contains(&db)), "{psnr_db:?}");
    }
}
