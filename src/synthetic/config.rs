//! The scene file: everything that decides what is rendered, with its defaults and its checks.

use serde::{Deserialize, Serialize};

use super::SceneError;

/// Description of a synthetic recording. Equal descriptions give byte-identical recordings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneConfig {
    /// Decides the furnishing, the textures, the hand's shake and the sensor's noise.
    pub seed: u64,
    /// Frames rendered.
    pub frames: usize,
    /// Frames per second.
    pub fps: f64,
    /// Recording camera.
    pub camera: CameraConfig,
    /// A second camera; without one, the recording has depth images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stereo: Option<StereoConfig>,
    /// Size and gloss of the room.
    pub room: RoomConfig,
    /// Pieces of furniture.
    pub furniture: FurnitureConfig,
    /// Path of the camera.
    pub path: PathConfig,
    /// Faults of the sensor.
    pub degradation: DegradationConfig,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            frames: 160,
            fps: 30.0,
            camera: CameraConfig::default(),
            stereo: None,
            room: RoomConfig::default(),
            furniture: FurnitureConfig::default(),
            path: PathConfig::default(),
            degradation: DegradationConfig::default(),
        }
    }
}

/// The recording camera: pixels, and OpenCV's lens coefficients. The recorded images show the lens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// Image width.
    pub width: u32,
    /// Image height.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Radial distortion, second order.
    pub k1: f64,
    /// Radial distortion, fourth order.
    pub k2: f64,
    /// Tangential distortion, along y.
    pub p1: f64,
    /// Tangential distortion, along x.
    pub p2: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        let (width, height) = (640, 480);
        Self { width, height, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5, k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 }
    }
}

/// The right camera of a rectified stereo pair. Such a recording has no depth images, and its lenses no distortion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StereoConfig {
    /// Distance between the cameras, metres.
    pub baseline: f64,
    /// The most that the right camera is turned about each axis, unknown to the calibration, degrees.
    pub misalignment: f64,
}

impl Default for StereoConfig {
    fn default() -> Self {
        Self { baseline: 0.12, misalignment: 0.0 }
    }
}

/// The room, or each room of a building, metres.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RoomConfig {
    /// Along the world's x axis.
    pub width: f64,
    /// Along the world's z axis.
    pub depth: f64,
    /// Floor to ceiling.
    pub height: f64,
    /// Rooms along x and along y, all of the size above; doorways join them in one chain, with more of them where `path.returns`. More than one
    /// room need a path of kind `walk`.
    #[serde(skip_serializing_if = "is_one_room")]
    pub rooms: [usize; 2],
    /// 0 for purely diffuse surfaces, whose look does not depend on where one stands; up to 1 for highlights on wood, glaze, metal.
    pub gloss: f64,
}

impl Default for RoomConfig {
    fn default() -> Self {
        Self { width: 6.0, depth: 5.2, height: 2.7, rooms: [1, 1], gloss: 0.0 }
    }
}

/// Scenes from before there were buildings keep their files and digests.
fn is_one_room(rooms: &[usize; 2]) -> bool {
    *rooms == [1, 1]
}

/// How many of each piece stand in each room.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FurnitureConfig {
    /// Desks and dining tables in turn.
    pub tables: usize,
    /// Bookshelves.
    pub shelves: usize,
    /// Sofas.
    pub sofas: usize,
    /// Cabinets.
    pub cabinets: usize,
    /// Standard lamps.
    pub lamps: usize,
    /// Potted plants.
    pub plants: usize,
    /// Stacks of packing boxes.
    pub boxes: usize,
    /// Rugs.
    pub rugs: usize,
    /// Posters and paintings on the walls.
    pub pictures: usize,
    /// Windows.
    pub windows: usize,
}

impl FurnitureConfig {
    /// An empty room.
    pub const NONE: Self =
        Self { tables: 0, shelves: 0, sofas: 0, cabinets: 0, lamps: 0, plants: 0, boxes: 0, rugs: 0, pictures: 0, windows: 0 };
}

impl Default for FurnitureConfig {
    fn default() -> Self {
        Self { tables: 2, shelves: 2, sofas: 1, cabinets: 2, lamps: 2, plants: 2, boxes: 2, rugs: 1, pictures: 9, windows: 1 }
    }
}

/// Shape of the camera's path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PathKind {
    /// To and fro before one corner of the room, turning across it.
    Sweep,
    /// Round the room, looking outwards, back to the start.
    Loop,
    /// Once through all rooms, and once round in each.
    Walk,
    /// Straight along the room's width, looking ahead.
    Drive,
}

/// The camera's path.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PathConfig {
    /// Shape of the path.
    pub kind: PathKind,
    /// Times round the room, for a loop; the last frame is back at the start.
    pub rounds: u32,
    /// Whether a walk goes back, at the end of each row of rooms, through a further doorway into the room in which the row before began.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub returns: bool,
    /// The most that the path itself, without the hand's shake, moves, m/s. A sweep goes at the pace that this and the turning
    /// rate allow together; other paths take as long as there are frames.
    pub speed: f64,
    /// The most that the path itself turns, degrees/s.
    pub turn_rate: f64,
    /// Mean height of the camera above the floor, metres.
    pub height: f64,
    /// The hand's shake: about its largest excursion, in metres and in degrees.
    pub shake_metres: f64,
    /// Largest rotation of the shake, degrees.
    pub shake_degrees: f64,
}

impl Default for PathConfig {
    fn default() -> Self {
        let kind = PathKind::Sweep;
        Self {
            kind,
            rounds: 1,
            returns: false,
            speed: 0.4,
            turn_rate: 28.0,
            height: 1.35,
            shake_metres: 0.01,
            shake_degrees: 1.0,
        }
    }
}

/// Faults of the sensor; all off by default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DegradationConfig {
    /// Standard deviation of the colour noise, in 8-bit levels.
    pub image_noise: f64,
    /// Depth noise has the standard deviation `depth_noise * z²` (metres, `z` in metres), as structured light has it.
    pub depth_noise: f64,
    /// Share of the frame interval for which the shutter is open, `0..=1`. The stamped pose is that of the exposure's middle.
    pub motion_blur: f64,
    /// Slow drift of gain and white balance: about its largest excursion, in natural-logarithmic units.
    pub exposure_drift: f64,
    /// Share of depth pixels lost in blobs. Where it is not 0, grazing surfaces are lost too.
    pub missing_depth: f64,
    /// Depth beyond this is not measured, metres; 0 for no limit.
    pub max_range: f64,
    /// A textured thing that travels to and fro through the room.
    pub moving_object: bool,
    /// Its speed, m/s; 0 for a pace of 0.4.
    pub moving_speed: f64,
    /// Frames `from..to` are black, while the camera moves on.
    pub covered: Option<[usize; 2]>,
}

/// More pixels than this a frame would take minutes to render, and is surely a slip of the pen.
const MAX_SIDE: u32 = 8192;
/// More rooms than this would take hours to render.
const MAX_ROOMS: usize = 100;
/// Pieces in one room, and in all rooms of a building.
const MAX_PIECES: (usize, usize) = (400, 4000);
/// More frames than this is an hour at 30 Hz.
const MAX_FRAMES: usize = 108_000;

impl SceneConfig {
    /// Checks each field on its own; whether the furniture fits and the path is clear shows when the scene is built.
    ///
    /// # Errors
    /// [`SceneError::Field`] or [`SceneError::TooFewFrames`] with the key that is out of range.
    pub fn validate(&self) -> Result<(), SceneError> {
        self.validate_camera()?;
        let room = &self.room;
        within("room.width", room.width, 3.5, 60.0)?;
        within("room.depth", room.depth, 3.5, 60.0)?;
        within("room.height", room.height, 2.2, 5.0)?;
        within("room.gloss", room.gloss, 0.0, 1.0)?;
        self.validate_building()?;
        let path = &self.path;
        within("path.speed", path.speed, 0.01, 5.0)?;
        within("path.turn_rate", path.turn_rate, 0.5, 360.0)?;
        within("path.height", path.height, 0.8, room.height - 0.6)?;
        within("path.shake_metres", path.shake_metres, 0.0, 0.05)?;
        within("path.shake_degrees", path.shake_degrees, 0.0, 10.0)?;
        within("path.rounds", f64::from(path.rounds), 1.0, 100.0)?;
        self.validate_degradation()?;
        let f = &self.furniture;
        let counts = [f.tables, f.shelves, f.sofas, f.cabinets, f.lamps, f.plants, f.boxes, f.rugs, f.pictures, f.windows];
        let most = MAX_PIECES.0.min(MAX_PIECES.1 / (room.rooms[0] * room.rooms[1]));
        let pieces = counts.iter().fold(0usize, |sum, n| sum.saturating_add(*n));
        within("furniture (pieces in a room)", pieces as f64, 0.0, most as f64)
    }

    /// What a building of several rooms cannot have.
    fn validate_building(&self) -> Result<(), SceneError> {
        let [columns, rows] = self.room.rooms;
        if columns == 0 || rows == 0 || columns.saturating_mul(rows) > MAX_ROOMS {
            let what = format!("is [{columns}, {rows}]; give rooms along x and along y, 1 to {MAX_ROOMS} in all");
            return Err(SceneError::Field { field: "room.rooms", what });
        }
        let refused = |field, what: &str| Err(SceneError::Field { field, what: what.into() });
        if self.path.returns && (columns < 2 || rows < 2) {
            return refused("path.returns", "must be false unless `room.rooms` has two rooms or more along x and along y");
        }
        if is_one_room(&self.room.rooms) {
            Ok(())
        } else if self.path.kind != PathKind::Walk {
            refused("path.kind", "must be \"walk\" where `room.rooms` has more than one room")
        } else if self.furniture.windows > 0 {
            refused("furniture.windows", "must be 0 where `room.rooms` has more than one room: most walls are inner ones")
        } else if self.degradation.moving_object {
            refused("degradation.moving_object", "must be false where `room.rooms` has more than one room")
        } else {
            Ok(())
        }
    }

    fn validate_camera(&self) -> Result<(), SceneError> {
        within("frames", self.frames as f64, 1.0, MAX_FRAMES as f64)?;
        within("fps", self.fps, 1.0, 1000.0)?;
        let c = &self.camera;
        within("camera.width", f64::from(c.width), 8.0, f64::from(MAX_SIDE))?;
        within("camera.height", f64::from(c.height), 8.0, f64::from(MAX_SIDE))?;
        let side = f64::from(c.width.max(c.height));
        within("camera.fx", c.fx, 0.2 * side, 20.0 * side)?;
        within("camera.fy", c.fy, 0.2 * side, 20.0 * side)?;
        within("camera.cx", c.cx, 0.0, f64::from(c.width))?;
        within("camera.cy", c.cy, 0.0, f64::from(c.height))?;
        for (field, value) in [("camera.k1", c.k1), ("camera.k2", c.k2)] {
            within(field, value, -2.0, 2.0)?;
        }
        for (field, value) in [("camera.p1", c.p1), ("camera.p2", c.p2)] {
            within(field, value, -0.1, 0.1)?;
        }
        self.stereo.as_ref().map_or(Ok(()), |stereo| self.validate_stereo(stereo))
    }

    fn validate_stereo(&self, stereo: &StereoConfig) -> Result<(), SceneError> {
        within("stereo.baseline", stereo.baseline, 0.01, 1.0)?;
        within("stereo.misalignment", stereo.misalignment, 0.0, 1.0)?;
        let c = &self.camera;
        if [c.k1, c.k2, c.p1, c.p2] == [0.0; 4] {
            Ok(())
        } else {
            let what = "must be 0 with `stereo`: the images of a rectified pair have no distortion".into();
            Err(SceneError::Field { field: "camera.k1, k2, p1, p2", what })
        }
    }

    fn validate_degradation(&self) -> Result<(), SceneError> {
        let d = &self.degradation;
        within("degradation.image_noise", d.image_noise, 0.0, 64.0)?;
        within("degradation.depth_noise", d.depth_noise, 0.0, 0.1)?;
        within("degradation.motion_blur", d.motion_blur, 0.0, 1.0)?;
        within("degradation.exposure_drift", d.exposure_drift, 0.0, 2.0)?;
        within("degradation.missing_depth", d.missing_depth, 0.0, 0.95)?;
        within("degradation.max_range", d.max_range, 0.0, 100.0)?;
        within("degradation.moving_speed", d.moving_speed, 0.0, 3.0)?;
        match d.covered {
            Some([from, to]) if from >= to || to > self.frames => Err(SceneError::Field {
                field: "degradation.covered",
                what: format!("is [{from}, {to}]; give [from, to] with from < to <= {} frames", self.frames),
            }),
            _ => Ok(()),
        }
    }
}

fn within(field: &'static str, value: f64, low: f64, high: f64) -> Result<(), SceneError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(SceneError::Field { field, what: format!("is {value}; it must be between {low} and {high}") })
    }
}
