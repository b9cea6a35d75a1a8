//! COLMAP's text models: one record a line, `#` begins a comment; an image has a second line, its observations, which may be empty.
//! Paths are named in errors.

use std::path::Path;

use super::{KnownImage, ModelCamera};
use crate::sequence::{KnownPoint, SequenceError, checks};

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…`
pub fn cameras(text: &str, path: &Path) -> Result<Vec<ModelCamera>, SequenceError> {
    records(text, path, 1, |line| {
        let mut fields = line.split_whitespace();
        let id = parse(fields.next(), "camera's number")?;
        let model = fields.next().ok_or("there is no camera model")?.to_owned();
        let (width, height) = (parse(fields.next(), "width")?, parse(fields.next(), "height")?);
        let parameters = fields.map(|field| parse(Some(field), "parameter")).collect::<Result<_, _>>()?;
        Ok(ModelCamera { id, model, width, height, parameters })
    })
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of observations.
pub fn images(text: &str, path: &Path) -> Result<Vec<KnownImage>, SequenceError> {
    records(text, path, 2, |line| {
        // The name is the rest of the line: it may have spaces.
        let mut rest = line;
        let mut field = || {
            let (field, after) = rest.trim_start().split_once(char::is_whitespace)?;
            rest = after;
            Some(field)
        };
        let _id: u32 = parse(field(), "image's number")?;
        let mut pose = [0.0; 7];
        for number in &mut pose {
            *number = parse(field(), "pose")?;
        }
        let camera = parse(field(), "camera's number")?;
        let name = rest.trim().to_owned();
        if name.is_empty() {
            return Err("there is no image name".into());
        }
        let [w, x, y, z, tx, ty, tz] = pose;
        Ok(KnownImage { name, camera, camera_from_world: checks::rigid_of_quaternion([tx, ty, tz], [w, x, y, z])? })
    })
}

/// `POINT3D_ID X Y Z R G B ERROR TRACK…`
pub fn points(text: &str, path: &Path) -> Result<Vec<KnownPoint>, SequenceError> {
    records(text, path, 1, |line| {
        let mut fields = line.split_whitespace().skip(1);
        let mut position = [0.0; 3];
        for number in &mut position {
            *number = parse(fields.next(), "position")?;
        }
        let mut color = [0; 3];
        for number in &mut color {
            *number = parse(fields.next(), "colour")?;
        }
        if position.iter().any(|v: &f64| !v.is_finite()) {
            return Err("the position is not finite".into());
        }
        Ok(KnownPoint { position: position.into(), color })
    })
}

/// The records that start at every `lines_each`-th line after a comment or blank line.
fn records<T>(
    text: &str,
    path: &Path,
    lines_each: usize,
    read: impl Fn(&str) -> Result<T, String>,
) -> Result<Vec<T>, SequenceError> {
    let mut lines = text.lines().enumerate();
    let mut records = Vec::new();
    while let Some((index, line)) = lines.next() {
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let syntax = |what| SequenceError::Syntax { path: path.into(), line: index + 1, what };
        records.push(read(line).map_err(syntax)?);
        for _ in 1..lines_each {
            lines.next();
        }
    }
    Ok(records)
}

fn parse<T: std::str::FromStr>(field: Option<&str>, what: &str) -> Result<T, String> {
    let field = field.ok_or_else(|| format!("the line ends before the {what}"))?;
    field.parse().map_err(|_| format!("`{field}` is no {what}"))
}
