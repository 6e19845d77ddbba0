//! A metric result for other programs, in directories of their own below that of the result files.

use std::io;
use std::path::{Path, PathBuf};

use super::metric::{self, Model};
use super::result_files::{create_directory, pretty, write_atomically};
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

/// Writes what is asked for below `directory`. Files of a former result are removed where there is nothing to replace
/// them, so that none is taken for this one's.
///
/// # Errors
/// The result is not metric, or the first file that cannot be written, named.
pub fn write(directory: &Path, exports: &[Export], solution: &Solution, input: &LabelledInput) -> Result<(), Error> {
    let models = Model::of_parts(solution, input);
    for export in exports {
        let (name, files) = export.files();
        let directory = directory.join(name);
        let contents = match &models {
            Ok(models) => export.contents(models)?,
            Err(_) => Vec::new(),
        };
        for (folder, contents) in &contents {
            let directory = directory.join(folder);
            create_directory(&directory)?;
            for (file, bytes) in files.iter().zip(contents) {
                write_atomically(&directory, file, bytes)?;
            }
        }
        let written = |folder: &Path| contents.iter().any(|(of, _)| of == folder);
        for folder in former(&directory)?.into_iter().filter(|folder| !written(folder)) {
            let directory = directory.join(&folder);
            files.iter().try_for_each(|file| remove(&directory.join(file)))?;
            if folder != Path::new("") {
                // What is not empty holds files that are not ours.
                let _ = std::fs::remove_dir(&directory);
            }
        }
    }
    models.map(|_| ()).map_err(Error::NotMetric)
}

/// Folders that a former result may have left: that of the largest part, and numbered ones.
fn former(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut folders = vec![PathBuf::new()];
    let entries = match std::fs::read_dir(directory) {
        Ok(entries) => entries,
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(folders);
        }
        Err(error) => return Err(error),
    };
    for entry in entries {
        let name = entry?.file_name();
        let part = name.to_str().and_then(|name| name.parse().ok()).filter(|&part| part > 0);
        folders.extend(part.map(folder).filter(|folder| folder.as_os_str() == name));
    }
    Ok(folders)
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
