//! Reading the files of a recording, whatever its layout.

use std::path::{Path, PathBuf};

use super::SequenceError;

/// The folder's own name, also of `.`.
pub fn folder_name(folder: &Path) -> String {
    let name = folder.canonicalize().ok().and_then(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()));
    name.unwrap_or_else(|| "sequence".into())
}

/// A whole file of UTF-8.
pub fn read_text(path: &Path) -> Result<String, SequenceError> {
    std::fs::read_to_string(path).map_err(|source| SequenceError::Read { path: path.into(), source })
}

/// JSON as what it should hold; what does not fit is named with its line in `path`.
pub fn parse_json<T: serde::de::DeserializeOwned>(text: &str, path: &Path) -> Result<T, SequenceError> {
    serde_json::from_str(text).map_err(|error| SequenceError::Syntax {
        path: path.into(),
        line: error.line(),
        what: error.to_string(),
    })
}

/// The pictures in a folder, by name.
pub fn images_in(folder: &Path) -> Result<Vec<PathBuf>, SequenceError> {
    files_in(folder, &["png", "jpg", "jpeg"])
}

/// Files of a folder with one of these extensions (lower case), by name.
pub fn files_in(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, SequenceError> {
    let wanted = |path: &PathBuf| {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        extension.is_some_and(|e| extensions.contains(&e.as_str()))
    };
    let entries = std::fs::read_dir(folder).map_err(|source| SequenceError::Read { path: folder.into(), source })?;
    let mut files: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(wanted).collect();
    files.sort();
    Ok(files)
}

/// What a list names and what exists. Up to half may be missing: they are left out, with one warning.
///
/// `found` holds each listed image, or the listed name where there is none.
///
/// # Errors
/// [`SequenceError::MissingImages`] if more than half are missing.
pub fn existing<T>(list: &Path, found: Vec<Result<T, String>>) -> Result<Vec<T>, SequenceError> {
    let listed = found.len();
    let (mut images, mut missing) = (Vec::with_capacity(listed), Vec::new());
    for image in found {
        match image {
            Ok(image) => images.push(image),
            Err(name) => missing.push(name),
        }
    }
    if missing.len() > listed / 2 {
        let (missing, example) = (missing.len(), missing.swap_remove(0));
        return Err(SequenceError::MissingImages { list: list.into(), missing, listed, example });
    }
    if let Some(first) = missing.first() {
        let count = missing.len();
        tracing::warn!("{}: {count} of {listed} listed images are missing and left out, among them {first}", list.display());
    }
    Ok(images)
}

/// Decodes an image, of the format that its bytes say.
pub fn decode(path: &Path) -> Result<image::DynamicImage, SequenceError> {
    let reader = image::ImageReader::open(path)
        .and_then(image::ImageReader::with_guessed_format)
        .map_err(|source| SequenceError::Read { path: path.into(), source })?;
    reader.decode().map_err(|source| SequenceError::Image { path: path.into(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_to_half_of_a_list_may_be_missing() {
        let found = |missing: usize| (0..5).map(|i| if i < missing { Err(format!("{i}.png")) } else { Ok(i) }).collect();
        let list = Path::new("list.json");
        assert_eq!(existing(list, found(2)).unwrap(), [2, 3, 4]);
        assert!(existing::<usize>(list, Vec::new()).unwrap().is_empty());
        let message = existing(list, found(3)).unwrap_err().to_string();
        assert!(message.starts_with("list.json: 3 of 5 listed images are missing, among them 0.png"), "{message}");
    }
}
