//! A metric result for other programs, in directories of their own below that of the result files.

use std::io;
use std::path::Path;

use super::metric::{self, Model};
use super::result_files::{create_directory, pretty, write_atomically};
use super::{LabelledInput, colmap, opensfm};
use crate::domain::Solution;

/// What another program reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// A COLMAP sparse model, binary: `colmap/{cameras,images,points3D}.bin`.
    Colmap,
    /// The same as text: `colmap-text/{cameras,images,points3D}.txt`.
    ColmapText,
    /// `opensfm/reconstruction.json`.
    OpenSfm,
}

/// Why nothing was exported.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Not a failure: the solve is done, its result is just of another kind.
    #[error("nothing was exported: {0}")]
    NotMetric(#[from] metric::Error),
    #[error(transparent)]
    Io(#[from] io::Error),
}

impl Export {
    /// Directory and files.
    fn files(self) -> (&'static str, &'static [&'static str]) {
        match self {
            Export::Colmap => ("colmap", &["cameras.bin", "images.bin", "points3D.bin"]),
            Export::ColmapText => ("colmap-text", &["cameras.txt", "images.txt", "points3D.txt"]),
            Export::OpenSfm => ("opensfm", &["reconstruction.json"]),
        }
    }

    /// The files' contents, in their order.
    fn contents(self, model: &Model) -> io::Result<Vec<Vec<u8>>> {
        Ok(match self {
            Export::Colmap => colmap::write::binary(model).into(),
            Export::ColmapText => colmap::write::text(model).map(String::into_bytes).into(),
            Export::OpenSfm => vec![pretty(&opensfm::reconstruction::json(model))?.into_bytes()],
        })
    }
}

/// Writes what is asked for below `directory`. Files of a former result are removed where there is nothing to replace
/// them, so that none is taken for this one's.
///
/// # Errors
/// The result is not metric, or the first file that cannot be written, named.
pub fn write(directory: &Path, exports: &[Export], solution: &Solution, input: &LabelledInput) -> Result<(), Error> {
    let model = Model::new(solution, input);
    for export in exports {
        let (name, files) = export.files();
        let directory = directory.join(name);
        match &model {
            Ok(model) => {
                create_directory(&directory)?;
                for (file, bytes) in files.iter().zip(export.contents(model)?) {
                    write_atomically(&directory, file, &bytes)?;
                }
            }
            Err(_) => files.iter().try_for_each(|file| remove(&directory.join(file)))?,
        }
    }
    model.map(|_| ()).map_err(Error::NotMetric)
}

fn remove(file: &Path) -> io::Result<()> {
    match std::fs::remove_file(file) {
        Err(error) if error.kind() != io::ErrorKind::NotFound && error.kind() != io::ErrorKind::NotADirectory => {
            Err(io::Error::new(error.kind(), format!("cannot remove {}: {error}", file.display())))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
#[path = "export_tests.rs"]
mod tests;
