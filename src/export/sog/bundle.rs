//! A zip of lossless WebP images and a description, in memory. Nothing in it becomes a path.

use std::io::{Cursor, Read, Write};

use image_webp::{ColorType, EncoderParams, WebPDecoder, WebPEncoder};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter};

/// Most pixels per byte of the file, beyond [`FEW_PIXELS`]: an honest Gaussian takes ten bytes, and its image a pixel or two.
const PIXELS_PER_BYTE: u64 = 8;
const FEW_PIXELS: u64 = 1 << 18;
/// Most bytes of an entry per byte of the file, beyond [`FEW_BYTES`].
const INFLATION: u64 = 16;
const FEW_BYTES: u64 = 1 << 16;

/// An image of bytes, red, green, blue and alpha, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<[u8; 4]>,
}

impl Plane {
    /// Pixels side by side in the image of so many.
    pub fn width(count: usize) -> usize {
        count.isqrt().max(1).next_multiple_of(4)
    }

    /// As nearly square as fits `count` pixels, in multiples of four; those beyond are empty.
    pub fn of(count: usize, pixel: impl Fn(usize) -> [u8; 4]) -> Self {
        let width = Self::width(count);
        let height = count.div_ceil(width).max(1).next_multiple_of(4);
        // The last pixel again: a run costs nothing.
        let pixels = (0..width * height).map(|i| if count == 0 { [0, 0, 0, 255] } else { pixel(i.min(count - 1)) });
        Self { width, height, pixels: pixels.collect() }
    }

    /// The smaller of the crate's two ways to code it.
    pub fn encode(&self) -> Result<Vec<u8>, String> {
        let opaque = self.pixels.iter().all(|pixel| pixel[3] == 255);
        let (color, channels) = if opaque { (ColorType::Rgb8, 3) } else { (ColorType::Rgba8, 4) };
        let bytes: Vec<u8> = self.pixels.iter().flat_map(|pixel| &pixel[..channels]).copied().collect();
        let coded = [false, true].map(|predicts| {
            let mut coded = Vec::new();
            let mut encoder = WebPEncoder::new(&mut coded);
            let mut parameters = EncoderParams::default();
            parameters.use_predictor_transform = predicts;
            encoder.set_params(parameters);
            let done = encoder.encode(&bytes, self.width as u32, self.height as u32, color);
            done.map(|()| coded).map_err(|error| error.to_string())
        });
        let [plain, predicted] = coded;
        let (plain, predicted) = (plain?, predicted?);
        Ok(if plain.len() <= predicted.len() { plain } else { predicted })
    }
}

/// A zip that is written.
pub(super) struct Writer(ZipWriter<Cursor<Vec<u8>>>);

impl Writer {
    pub fn new() -> Self {
        Self(ZipWriter::new(Cursor::default()))
    }

    /// Stored as it is.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), String> {
        self.add_by(CompressionMethod::Stored, name, bytes)
    }

    /// Compressed.
    pub fn add_deflated(&mut self, name: &str, bytes: &[u8]) -> Result<(), String> {
        self.add_by(CompressionMethod::Deflated, name, bytes)
    }

    /// Without a date, so that the same map gives the same bytes.
    fn add_by(&mut self, method: CompressionMethod, name: &str, bytes: &[u8]) -> Result<(), String> {
        let options = SimpleFileOptions::default().compression_method(method).last_modified_time(DateTime::DEFAULT);
        self.0.start_file(name, options).map_err(|error| error.to_string())?;
        self.0.write_all(bytes).map_err(|error| error.to_string())
    }

    #[cfg(test)]
    pub fn add_plane(&mut self, name: &str, plane: &Plane) -> Result<(), String> {
        self.add(name, &plane.encode()?)
    }

    pub fn finish(self) -> Result<Vec<u8>, String> {
        self.0.finish().map(Cursor::into_inner).map_err(|error| error.to_string())
    }
}

/// A zip that is read.
pub(super) struct Reader<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    bytes: u64,
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Result<Self, String> {
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| format!("this is no whole zip: {error}"))?;
        Ok(Self { archive, bytes: bytes.len() as u64 })
    }

    /// An entry of that name, within bounds.
    pub fn entry(&mut self, name: &str) -> Result<Vec<u8>, String> {
        let most = self.bytes * INFLATION + FEW_BYTES;
        let entry = self.archive.by_name(name).map_err(|error| format!("{name}: {error}"))?;
        let mut bytes = Vec::new();
        entry.take(most + 1).read_to_end(&mut bytes).map_err(|error| format!("{name}: {error}"))?;
        if bytes.len() as u64 > most { Err(format!("{name} is larger than the file can hold")) } else { Ok(bytes) }
    }

    /// An image of at least `least` pixels, and no more than the file can hold.
    pub fn plane(&mut self, name: &str, least: usize) -> Result<Plane, String> {
        let bytes = self.entry(name)?;
        let wrong = |error: image_webp::DecodingError| format!("{name}: {error}");
        let mut decoder = WebPDecoder::new(Cursor::new(&bytes)).map_err(wrong)?;
        let (width, height) = decoder.dimensions();
        let count = u64::from(width) * u64::from(height);
        if count < least as u64 {
            return Err(format!("{name} has {width}×{height} pixels, too few for {least}"));
        }
        if decoder.is_animated() || count > self.bytes * PIXELS_PER_BYTE + FEW_PIXELS {
            return Err(format!("{name} has {width}×{height} pixels, more than the file can hold"));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut pixels = vec![0; count as usize * channels];
        decoder.read_image(&mut pixels).map_err(wrong)?;
        let pixel = |p: &[u8]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)];
        let pixels = pixels.chunks_exact(channels).map(pixel).collect();
        Ok(Plane { width: width as usize, height: height as usize, pixels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_come_back_and_bombs_do_not() {
        let mut rng = fastrand::Rng::with_seed(3);
        for (count, alpha) in [(0, 255), (1, 3), (16, 255), (17, 9), (1000, 255), (1021, 254)] {
            let noise: Vec<[u8; 4]> = (0..count).map(|_| [rng.u8(..), rng.u8(..), rng.u8(..8), alpha]).collect();
            let plane = Plane::of(count, |i| noise[i]);
            assert!(plane.pixels.len() >= count && plane.pixels.len() == plane.width * plane.height);
            let mut writer = Writer::new();
            writer.add_plane("a.webp", &plane).unwrap();
            let bytes = writer.finish().unwrap();
            let mut reader = Reader::new(&bytes).unwrap();
            assert_eq!(reader.plane("a.webp", count).unwrap(), plane);
            assert!(reader.plane("a.webp", plane.pixels.len() + 1).unwrap_err().contains("too few"));
            assert!(reader.plane("../a.webp", 0).is_err());
        }
        let empty = Plane { width: 4096, height: 4096, pixels: vec![[0; 4]; 4096 * 4096] };
        let mut writer = Writer::new();
        writer.add_plane("a.webp", &empty).unwrap();
        let bytes = writer.finish().unwrap();
        assert!(bytes.len() < 20_000);
        assert!(Reader::new(&bytes).unwrap().plane("a.webp", 1).unwrap_err().contains("more than the file can hold"));
        let mut bomb = ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        bomb.start_file("meta.json", options).unwrap();
        bomb.write_all(&vec![b' '; 8 << 20]).unwrap();
        let bomb = bomb.finish().unwrap().into_inner();
        assert!(Reader::new(&bomb).unwrap().entry("meta.json").unwrap_err().contains("larger than the file can hold"));
    }
}
