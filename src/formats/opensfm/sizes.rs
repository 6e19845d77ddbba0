//! Sizes and cameras of the images of an OpenSfM data set: `exif/IMAGE.exif`, beside the tracks (mapillary/OpenSfM,
//! `opensfm/dataset.py` and `exif.py`).

use std::fs::File;
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

use serde::Deserialize;

use crate::domain::ImageSize;
use crate::formats::json;

/// Bytes of such a file at most; OpenSfM's have some hundreds.
const MOST_BYTES: u64 = 1 << 20;

/// What is used of the file of an image.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
pub struct Exif {
    width: u32,
    height: u32,
    /// OpenSfM's name of the camera; images of one name share a calibration.
    #[serde(default)]
    pub camera: Option<String>,
}

impl Exif {
    pub fn size(&self) -> ImageSize {
        ImageSize { width_px: self.width, height_px: self.height }
    }
}

/// The folder `exif/` of a data set.
#[derive(Debug)]
pub struct Sizes {
    folder: PathBuf,
}

impl Sizes {
    /// Beside a file of tracks.
    pub fn beside(tracks: &Path) -> Self {
        Self { folder: tracks.parent().unwrap_or(Path::new("")).join("exif") }
    }

    /// What is known of an image; `None` where there is no file of it.
    ///
    /// # Errors
    /// A file that cannot be read or holds no size, in words.
    pub fn of(&self, image: &str) -> Result<Option<Exif>, String> {
        // A name from a foreign file leads nowhere outside the folder.
        if !Path::new(image).components().all(|component| matches!(component, Component::Normal(_))) {
            return Ok(None);
        }
        let mut text = String::new();
        let path = self.folder.join(format!("{image}.exif"));
        match File::open(path).and_then(|file| file.take(MOST_BYTES).read_to_string(&mut text)) {
            Ok(_) => {}
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
                return Ok(None);
            }
            Err(error) => return Err(format!("exif/{image}.exif cannot be read: {error}")),
        }
        let exif: Exif = json::read(text.as_bytes())
            .map_err(|error| format!("exif/{image}.exif has no width and height: {error}"))?;
        let sides = 1..=ImageSize::MAX_SIDE_PX;
        if !sides.contains(&exif.width) || !sides.contains(&exif.height) {
            let what = format!("{} x {} px is no size of an image", exif.width, exif.height);
            return Err(format!("exif/{image}.exif: {what}"));
        }
        Ok(Some(exif))
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_size_is_read_and_what_is_none_is_named() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let sizes = Sizes::beside(&directory.path().join("tracks.csv"));
        assert_eq!(sizes.of("a.jpg"), Ok(None), "no folder");
        fs::create_dir_all(directory.path().join("exif/sub")).expect("created");
        let write = |name: &str, text: &str| fs::write(directory.path().join(name), text).expect("written");
        write("exif/sub/a.jpg.exif", r#"{"width": 640, "height": 480, "camera": "v2 x", "focal_ratio": 0.9}"#);
        write("secret.exif", r#"{"width": 1, "height": 1}"#);
        let exif = sizes.of("sub/a.jpg").expect("readable").expect("there");
        assert_eq!((exif.size().width_px, exif.size().height_px, exif.camera.as_deref()), (640, 480, Some("v2 x")));
        assert_eq!(sizes.of("../secret"), Ok(None));
        let cases = [
            ("{", "EOF"),
            (r#"{"width": 3}"#, "height"),
            (r#"{"width": 0, "height": 4}"#, "0 x 4"),
            (r#"{"width": 3, "height": -4}"#, "`height`: invalid value: integer `-4`"),
        ];
        for (text, word) in cases {
            write("exif/b.jpg.exif", text);
            let words = sizes.of("b.jpg").expect_err("no size");
            assert!(words.starts_with("exif/b.jpg.exif") && words.contains(word), "{words}");
        }
    }
}
