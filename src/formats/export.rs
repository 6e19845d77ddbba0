//! A metric result for other programs, in directories of their own below that of the result files.

use std::io;
use std::path::{Path, PathBuf};

use super::metric::{self, Model};
use super::publish::{Draft, pretty};
use super::{LabelledInput, colmap, opensfm};
use crate::domain::Solution;

/// What another program reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// A COLMAP sparse model, binary: `colmap/{cameras,images,points3D}.bin`. Of several parts this is the largest, and
    /// the others are below it in folders of their numbers: `colmap/1/` and on.
    Colmap,
    /// The same as text: `colmap-text/{cameras,images,points3D}.txt`.
    ColmapText,
    /// `opensfm/reconstruction.json`, a list with one reconstruction a part.
    OpenSfm,
}

impl Export {
    #[cfg(test)]
    pub const ALL: [Export; 3] = [Export::Colmap, Export::ColmapText, Export::OpenSfm];

    /// Directory below that of the result files.
    pub fn folder(self) -> &'static str {
        self.files().0
    }

    /// Directory and files.
    pub(super) fn files(self) -> (&'static str, &'static [&'static str]) {
        match self {
            Export::Colmap => ("colmap", &["cameras.bin", "images.bin", "points3D.bin"]),
            Export::ColmapText => ("colmap-text", &["cameras.txt", "images.txt", "points3D.txt"]),
            Export::OpenSfm => ("opensfm", &["reconstruction.json"]),
        }
    }

    /// What is to be written: folder below that of [`Export::files`], and the files' contents in their order.
    fn contents(self, models: &[Model]) -> io::Result<Vec<(PathBuf, Vec<Vec<u8>>)>> {
        let each =
            |write: fn(&Model) -> Vec<Vec<u8>>| models.iter().map(move |model| (folder(model.part), write(model)));
        Ok(match self {
            Export::Colmap => each(|model| colmap::write::binary(model).into()).collect(),
            Export::ColmapText => each(|model| colmap::write::text(model).map(String::into_bytes).into()).collect(),
            Export::OpenSfm => {
                vec![(PathBuf::new(), vec![pretty(&opensfm::reconstruction::json(models))?.into_bytes()])]
            }
        })
    }
}

/// Folder of a part's model below that of the largest.
fn folder(part: u32) -> PathBuf {
    if part == 0 { PathBuf::new() } else { PathBuf::from(part.to_string()) }
}

/// Adds what is asked for to the files of a result; why nothing was, where the result is not metric.
///
/// # Errors
/// The first file that cannot be written, named.
pub fn add(
    draft: &mut Draft,
    exports: &[Export],
    solution: &Solution,
    input: &LabelledInput,
) -> io::Result<Option<metric::Error>> {
    if exports.is_empty() {
        return Ok(None);
    }
    let models = match Model::of_parts(solution, input) {
        Ok(models) => models,
        Err(refused) => return Ok(Some(refused)),
    };
    for export in exports {
        let (name, files) = export.files();
        for (folder, contents) in export.contents(&models)? {
            for (file, bytes) in files.iter().zip(&contents) {
                draft.add(Path::new(name).join(&folder).join(file), bytes)?;
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
#[path = "export_tests.rs"]
mod tests;
