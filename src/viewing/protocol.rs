//! Messages between keysplat and its viewers (docs/view-protocol.md).

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::{Pinhole, Se3};

/// Number of the protocol; another meaning gets another number.
pub const PROTOCOL: u32 = 1;
/// Most bytes of a message to a viewer.
pub const MOST_TO_VIEWER: usize = 4 << 20;
/// Most bytes of a message from a viewer.
pub const MOST_FROM_VIEWER: usize = 1 << 10;
/// Most pixels along a side of a picture that a viewer may have rendered.
pub const MOST_PIXELS: u32 = 1920;

/// A message to a viewer, as it goes into the socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outgoing {
    /// A JSON object.
    Text(String),
    /// Header's length, JSON header, payload.
    Binary(Vec<u8>),
}

impl Outgoing {
    /// A message without a payload.
    pub fn text(message: &ToViewer<'_>) -> Self {
        Self::Text(json(message))
    }

    /// A message with a payload, which begins at a multiple of 4 bytes.
    pub fn binary(header: &ToViewer<'_>, payload: impl FnOnce(&mut Vec<u8>)) -> Self {
        let mut header = json(header).into_bytes();
        header.resize(header.len().next_multiple_of(4), b' ');
        let mut bytes = (header.len() as u32).to_le_bytes().to_vec();
        bytes.append(&mut header);
        payload(&mut bytes);
        Self::Binary(bytes)
    }

    /// Its size in bytes.
    pub fn len(&self) -> usize {
        match self {
            Self::Text(text) => text.len(),
            Self::Binary(bytes) => bytes.len(),
        }
    }

    /// Whether it has no content.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn json(message: &ToViewer<'_>) -> String {
    serde_json::to_string(message).expect("plain structures become JSON")
}

/// What keysplat sends. Fields as in the document.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum ToViewer<'a> {
    Hello(&'a Hello),
    Poses {
        all: bool,
        keyframes: Vec<KeyframeView>,
        #[serde(skip_serializing_if = "Option::is_none")]
        loops: Option<&'a [[usize; 2]]>,
        #[serde(skip_serializing_if = "Option::is_none")]
        current: Option<CurrentView>,
    },
    Path(&'a CameraPath),
    Statistics {
        entries: &'a [Statistics],
    },
    Map(MapHeader),
    Image(ImageHeader),
    Refused {
        what: &'a str,
        why: &'a str,
    },
}

/// The first message.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "docs/view-protocol.md describes all fields")]
pub struct Hello {
    pub protocol: u32,
    pub name: String,
    pub sensor: Option<String>,
    pub live: bool,
    pub control: bool,
    pub exact: bool,
    pub images: bool,
    pub units: &'static str,
    pub camera: Option<CameraView>,
    pub frames: Option<usize>,
}

/// Intrinsics of a view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CameraView {
    pub width: u32,
    pub height: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

impl From<Pinhole> for CameraView {
    fn from(p: Pinhole) -> Self {
        Self { width: p.width, height: p.height, fx: p.fx, fy: p.fy, cx: p.cx, cy: p.cy }
    }
}

/// A pose, world from camera, rounded to a hundredth of a millimetre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PoseView {
    pub p: [f64; 3],
    pub q: [f64; 4],
}

impl From<&Se3> for PoseView {
    fn from(pose: &Se3) -> Self {
        let round = |v: f64, steps: f64| (v * steps).round() / steps;
        let (p, q) = (pose.translation.vector, pose.rotation.coords);
        Self { p: [p.x, p.y, p.z].map(|v| round(v, 1e5)), q: [q.x, q.y, q.z, q.w].map(|v| round(v, 1e6)) }
    }
}

/// A keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct KeyframeView {
    pub id: usize,
    pub frame: usize,
    pub t: f64,
    #[serde(flatten)]
    pub pose: PoseView,
}

/// The newest frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CurrentView {
    pub frame: usize,
    #[serde(flatten)]
    pub pose: PoseView,
    pub lost: bool,
}

/// The camera's path, in the world of the map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CameraPath {
    pub poses: Vec<(f64, f64, f64, f64, Option<f64>)>,
    pub truth: Vec<[f64; 3]>,
}

/// Figures of one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Statistics {
    pub s: f64,
    pub phase: Phase,
    pub paused: bool,
    pub frames: usize,
    pub keyframes: usize,
    pub gaussians: usize,
    pub steps: usize,
    pub lost: bool,
    pub psnr_db: Option<f32>,
    pub frame_ms: Option<f64>,
    pub step_ms: Option<f64>,
    pub host_bytes: Option<u64>,
    pub left_s: Option<f64>,
}

/// What a run is at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    #[default]
    Tracking,
    Refining,
    Measuring,
    Done,
}

/// Header of a `map` message.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MapHeader {
    pub revision: u64,
    pub reset: bool,
    pub complete: bool,
    pub gaussians: usize,
    pub sh_degree: u8,
    pub antialiased: bool,
    pub cell: f64,
    pub chunks: Vec<ChunkHeader>,
}

/// A part in a `map` message.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ChunkHeader {
    pub at: [i32; 3],
    pub part: u32,
    pub count: usize,
    pub sh_scale: f32,
}

/// Header of an `image` message.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ImageHeader {
    pub of: &'static str,
    pub format: &'static str,
    pub width: u32,
    pub height: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kind: Option<RenderKind>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraView>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub far: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
}

/// What a viewer sends. Fields as in the document.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
#[expect(missing_docs, reason = "docs/view-protocol.md describes all fields")]
pub enum FromViewer {
    Taken { revision: u64 },
    Images { current: bool },
    Keyframe { id: usize },
    Render(RenderRequest),
    Control { r#do: Command },
}

/// A picture that a viewer requests.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[expect(missing_docs, reason = "docs/view-protocol.md describes all fields")]
pub struct RenderRequest {
    pub request: u64,
    pub kind: RenderKind,
    pub p: [f64; 3],
    pub q: [f64; 4],
    pub width: u32,
    pub height: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    /// The keyframe that an error is against.
    pub id: Option<usize>,
}

/// What of the map a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RenderKind {
    Color,
    Depth,
    Error,
}

/// What a viewer wants a run to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Command {
    Pause,
    Go,
    Step,
    Finish,
    Refine,
}

impl FromViewer {
    /// Parses a message; `None` where it is none.
    pub fn parse(text: &str) -> Option<Self> {
        if text.len() > MOST_FROM_VIEWER {
            return None;
        }
        serde_json::from_str(text).ok()
    }
}

impl RenderRequest {
    /// Its camera; `None` where that is none.
    pub fn camera(&self) -> Option<(Pinhole, Se3)> {
        let Self { p, q, width, height, fx, fy, cx, cy, .. } = *self;
        let sides = (16..=MOST_PIXELS).contains(&width) && (16..=MOST_PIXELS).contains(&height);
        let focal = |f: f64| (1.0..1e6).contains(&f);
        let bounded = |values: &[f64]| values.iter().all(|v| v.abs() < 1e9);
        let rotation = Quaternion::new(q[3], q[0], q[1], q[2]);
        let turned = bounded(&q) && (0.5..2.0).contains(&rotation.norm());
        let fits = sides && focal(fx) && focal(fy) && bounded(&[cx, cy]) && bounded(&p) && turned;
        let pose = || Se3::from_parts(Vector3::from(p).into(), UnitQuaternion::new_normalize(rotation));
        fits.then(|| (Pinhole { fx, fy, cx, cy, width, height }, pose()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn payloads_begin_at_multiples_of_four_bytes() {
        for name in ["a", "ab", "abc", "abcd"] {
            let Outgoing::Binary(bytes) =
                Outgoing::binary(&ToViewer::Refused { what: name, why: "so" }, |bytes| bytes.extend([1, 2, 3, 4]))
            else {
                panic!("it has a payload")
            };
            let header = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
            assert!(header.is_multiple_of(4) && bytes[4 + header..] == [1, 2, 3, 4]);
            let value: serde_json::Value = serde_json::from_slice(&bytes[4..4 + header]).unwrap();
            assert_eq!((value["type"].as_str(), value["what"].as_str()), (Some("refused"), Some(name)));
        }
    }

    #[test]
    fn viewers_messages_are_parsed_or_refused() {
        assert_eq!(FromViewer::parse(r#"{"type":"taken","revision":3}"#), Some(FromViewer::Taken { revision: 3 }));
        assert_eq!(
            FromViewer::parse(r#"{"type":"control","do":"pause","more":1}"#),
            Some(FromViewer::Control { r#do: Command::Pause })
        );
        let render = |width: u32, q: &str, fx: &str| {
            format!(
                r#"{{"type":"render","request":1,"kind":"color","p":[0,0,0],"q":{q},"width":{width},"height":20,"fx":{fx},"fy":9,"cx":1,"cy":1}}"#
            )
        };
        let camera = |text: &str| match FromViewer::parse(text) {
            Some(FromViewer::Render(request)) => request.camera(),
            other => panic!("{other:?}"),
        };
        assert!(camera(&render(32, "[0,0,0,1]", "9")).is_some());
        let none = [
            render(4000, "[0,0,0,1]", "9"),
            render(32, "[0,0,0,0]", "9"),
            render(32, "[0,0,0,1]", "0"),
            render(32, "[0,0,0,1]", "1e300"),
        ];
        none.iter().for_each(|text| assert!(camera(text).is_none(), "{text}"));
        let long = format!(r#"{{"type":"taken","revision":3,"x":"{}"}}"#, "x".repeat(MOST_FROM_VIEWER));
        let refused = [
            "",
            "{}",
            "[]",
            "null",
            r#"{"type":"taken"}"#,
            r#"{"type":"taken","revision":-1}"#,
            r#"{"type":"poses"}"#,
            r#"{"type":"control","do":"rm -rf"}"#,
            &long,
            &render(32, "[0,0,1e999,1]", "9"),
        ];
        refused.iter().for_each(|text| assert_eq!(FromViewer::parse(text), None, "{text}"));
    }
}
