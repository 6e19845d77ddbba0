//! A metric result for other programs, in directories of their own below that of the result files.

use std::io;
use std::path::{Path, PathBuf};

use super::metric::{self, Model};
use super::result_files::{create_directory, pretty, remove, write_atomically};
use super::{LabelledInput, colmap, former, opensfm};
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
    pub const ALL: [Export; 3] = [Export::Colmap, Export::ColmapText, Export::OpenSfm];

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

/// Writes what is asked for below `directory`. Files that a former run wrote for other programs and this one does not
/// replace are removed, asked for or not, so that none is taken for this one's.
///
/// # Errors
/// Something is asked for and the result is not metric; or the first file that cannot be written or removed, named.
pub fn write(directory: &Path, exports: &[Export], solution: &Solution, input: &LabelledInput) -> Result<(), Error> {
    let models = if exports.is_empty() { Ok(Vec::new()) } else { Model::of_parts(solution, input) };
    let mut written = Vec::new();
    for export in exports {
        let (name, files) = export.files();
        let contents = match &models {
            Ok(models) => export.contents(models)?,
            Err(_) => Vec::new(),
        };
        for (folder, contents) in contents {
            let directory = directory.join(name).join(&folder);
            create_directory(&directory)?;
            for (file, bytes) in files.iter().zip(&contents) {
                write_atomically(&directory, file, bytes)?;
            }
            written.push(directory);
        }
    }
    remove_former(directory, &written, Some(&input.path))?;
    models.map(|_| ()).map_err(Error::NotMetric)
}

/// Removes what former runs wrote for other programs below `directory`; what is not ours stays.
///
/// * `written`: folders that this run wrote
/// * `input`: what this run read, which may be a model that a former one wrote
///
/// # Errors
/// The first file that cannot be removed, named.
pub fn remove_former(directory: &Path, written: &[PathBuf], input: Option<&Path>) -> io::Result<()> {
    let is_input = |folder: &Path| {
        let same = |input: &Path| Some(input.canonicalize().ok()? == folder.canonicalize().ok()?);
        input.and_then(same).unwrap_or(false)
    };
    for export in Export::ALL {
        let (name, files) = export.files();
        for folder in former_folders(&directory.join(name))? {
            if written.contains(&folder) || is_input(&folder) || !former::is_export(export, &folder) {
                continue;
            }
            files.iter().try_for_each(|file| remove(&folder.join(file)))?;
            // What is not empty holds files that are not ours.
            let _ = std::fs::remove_dir(&folder);
        }
    }
    Ok(())
}

/// Folders that a former result may have left: those of the smaller parts, which are numbered, then that of the largest.
fn former_folders(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = match std::fs::read_dir(directory) {
        Ok(entries) => entries,
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        Err(error) => return Err(error),
    };
    let mut folders = Vec::new();
    for entry in entries {
        let name = entry?.file_name();
        let part = name.to_str().and_then(|name| name.parse().ok()).filter(|&part| part > 0);
        folders.extend(part.map(folder).filter(|folder| folder.as_os_str() == name).map(|name| directory.join(name)));
    }
    folders.push(directory.to_owned());
    Ok(folders)
}

#[cfg(test)]
#[path = "export_tests.rs"]
mod tests;
