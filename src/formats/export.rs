//! A result for other programs, in directories of their own below that of the result files.

use std::fmt;
use std::path::{Path, PathBuf};
use std::{io, iter};

use super::metric::{self, Model};
use super::publish::{Draft, pretty};
use super::{Format, LabelledInput, bundler, colmap, nerfstudio, opensfm, ply};
use crate::domain::Solution;

/// What another program reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// A COLMAP sparse model, binary: `colmap/{cameras,images,points3D}.bin`, and `rigs.bin` and `frames.bin` where the
    /// database that was solved has frames. Of several parts this is the largest, and the others are below it in
    /// folders of their numbers: `colmap/1/` and on.
    Colmap,
    /// The same as text: `colmap-text/{cameras,images,points3D}.txt`.
    ColmapText,
    /// `colmap-db/database.db`, a copy of the COLMAP database that was solved with two-view geometries of the matches
    /// that are right and the cameras that were estimated.
    ColmapDatabase,
    /// `opensfm/reconstruction.json`, a list with one reconstruction a part, `opensfm/tracks.csv` with the observations
    /// of its points, and `opensfm/camera_models.json`.
    OpenSfm,
    /// `nerfstudio/transforms.json` and `nerfstudio/points.ply` of the largest part.
    Nerfstudio,
    /// `bundler/bundle.out` and `bundler/list.txt`; the parts in folders as with [`Export::Colmap`].
    Bundler,
    /// `bal/problem.txt`; the parts in folders as with [`Export::Colmap`].
    Bal,
}

/// Why an export was not written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    #[error(transparent)]
    Model(#[from] metric::Error),
    #[error(transparent)]
    Nerfstudio(#[from] nerfstudio::Error),
    #[error(transparent)]
    Bundler(#[from] bundler::Error),
    #[error("the input is no COLMAP database: there is none to copy")]
    NoDatabase,
    #[error("no view of the result has a camera")]
    NoCamera,
    #[error("{0}")]
    Database(String),
}

/// The exports that were asked for and not written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotExported {
    refused: Vec<(Export, Refusal)>,
    /// Whether others were written.
    is_part: bool,
}

impl NotExported {
    /// Whether this one was not written.
    pub fn has(&self, export: Export) -> bool {
        self.refused.iter().any(|(refused, _)| *refused == export)
    }
}

/// `nothing was exported: WHY`, or where some were `not exported: FOLDER: WHY; ...`.
impl fmt::Display for NotExported {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some((_, why)) = self.refused.first().filter(|_| !self.is_part)
            && self.refused.iter().all(|(_, other)| other == why)
        {
            return write!(f, "nothing was exported: {why}");
        }
        f.write_str("not exported: ")?;
        for (place, (export, why)) in self.refused.iter().enumerate() {
            write!(f, "{}{}: {why}", if place > 0 { "; " } else { "" }, export.folder())?;
        }
        Ok(())
    }
}

impl Export {
    #[cfg(test)]
    pub const ALL: [Export; 7] = [
        Export::Colmap,
        Export::ColmapText,
        Export::ColmapDatabase,
        Export::OpenSfm,
        Export::Nerfstudio,
        Export::Bundler,
        Export::Bal,
    ];

    /// Directory below that of the result files.
    pub fn folder(self) -> &'static str {
        match self {
            Export::Colmap => "colmap",
            Export::ColmapText => "colmap-text",
            Export::ColmapDatabase => "colmap-db",
            Export::OpenSfm => "opensfm",
            Export::Nerfstudio => "nerfstudio",
            Export::Bundler => "bundler",
            Export::Bal => "bal",
        }
    }

    /// Files in it that a run may be given to solve.
    pub(super) fn inputs(self) -> &'static [&'static str] {
        match self {
            Export::ColmapDatabase => &[DATABASE],
            Export::OpenSfm => &[TRACKS],
            Export::Colmap | Export::ColmapText | Export::Nerfstudio | Export::Bundler | Export::Bal => &[],
        }
    }

    /// Writes the export.
    fn write(
        self,
        draft: &mut Draft,
        solution: &Solution,
        input: &LabelledInput,
        models: &Result<Vec<Model>, metric::Error>,
    ) -> io::Result<Result<(), Refusal>> {
        if self == Export::ColmapDatabase {
            return database(draft, solution, input);
        }
        let models = match models {
            Ok(models) => models,
            Err(refused) => return Ok(Err((*refused).into())),
        };
        let files = match self.files(models, solution)? {
            Ok(files) => files,
            Err(refused) => return Ok(Err(refused)),
        };
        for (path, bytes) in files {
            draft.add(Path::new(self.folder()).join(path), &bytes)?;
        }
        Ok(Ok(()))
    }

    /// The files of an export that is made of models, the largest first.
    fn files(self, models: &[Model], solution: &Solution) -> io::Result<Result<Vec<File>, Refusal>> {
        let of_parts = |write: fn(&Model) -> Result<Vec<File>, Refusal>| -> Result<Vec<File>, Refusal> {
            let files = models.iter().map(|model| Ok(in_folder(model, write(model)?)));
            files.collect::<Result<Vec<_>, _>>().map(|parts| parts.into_iter().flatten().collect())
        };
        Ok(match self {
            Export::Colmap => of_parts(|model| Ok(colmap_model(model, false))),
            Export::ColmapText => of_parts(|model| Ok(colmap_model(model, true))),
            // Its own file, see `database`.
            Export::ColmapDatabase => Ok(Vec::new()),
            Export::OpenSfm => Ok(vec![
                ("reconstruction.json".into(), pretty(&opensfm::reconstruction::json(models))?.into()),
                (TRACKS.into(), opensfm::write_tracks::csv(models, solution.noise_px).into()),
                ("camera_models.json".into(), pretty(&opensfm::reconstruction::camera_models(models))?.into()),
            ]),
            Export::Nerfstudio => match models.first().map(nerfstudio::transforms) {
                Some(Ok(transforms)) => {
                    let points = (nerfstudio::POINTS.into(), ply::of_model(&models[0]).into());
                    let has_points = !models[0].points.is_empty();
                    let transforms = ("transforms.json".into(), pretty(&transforms)?.into());
                    Ok(iter::once(transforms).chain(has_points.then_some(points)).collect())
                }
                Some(Err(refused)) => Err(refused.into()),
                None => Err(metric::Error::NoPose.into()),
            },
            Export::Bundler => of_parts(|model| {
                let out = bundler::bundle::out(model)?;
                Ok(vec![("bundle.out".into(), out.into()), ("list.txt".into(), bundler::bundle::list(model).into())])
            }),
            Export::Bal => of_parts(|model| Ok(vec![("problem.txt".into(), bundler::bal::problem(model)?.into())])),
        })
    }
}

/// Path below the folder of an export, and content.
type File = (PathBuf, Vec<u8>);

const DATABASE: &str = "database.db";
const TRACKS: &str = "tracks.csv";

/// The files of a part; those of all but the largest are in a folder of its number.
fn in_folder(model: &Model, files: Vec<File>) -> Vec<File> {
    let folder = if model.part == 0 { PathBuf::new() } else { PathBuf::from(model.part.to_string()) };
    files.into_iter().map(|(name, bytes)| (folder.join(name), bytes)).collect()
}

/// The files of a sparse model.
fn colmap_model(model: &Model, as_text: bool) -> Vec<File> {
    let (extension, tables, frames) = if as_text {
        let tables = colmap::write::text(model).map(String::into_bytes);
        ("txt", tables, colmap::write_frames::text(model).map(|tables| tables.map(String::into_bytes)))
    } else {
        ("bin", colmap::write::binary(model), colmap::write_frames::binary(model))
    };
    let named = |(name, bytes): (&str, Vec<u8>)| (PathBuf::from(format!("{name}.{extension}")), bytes);
    let tables = ["cameras", "images", "points3D"].into_iter().zip(tables);
    tables.chain(["rigs", "frames"].into_iter().zip(frames.into_iter().flatten())).map(named).collect()
}

/// The copy of the database that was solved: also of a result that is not metric, whose matches are right all the same.
fn database(draft: &mut Draft, solution: &Solution, input: &LabelledInput) -> io::Result<Result<(), Refusal>> {
    if input.format != Some(Format::ColmapDatabase) {
        return Ok(Err(Refusal::NoDatabase));
    }
    if solution.registered_views().is_empty() {
        return Ok(Err(Refusal::NoCamera));
    }
    let path = Path::new(Export::ColmapDatabase.folder()).join(DATABASE);
    let written = draft.add_with(path, |target| colmap::write_database::write(target, solution, input))?;
    Ok(written.map_err(Refusal::Database))
}

/// Adds what is asked for to the files of a result; what was not written, and why.
///
/// # Errors
/// The first file that cannot be written, named.
pub fn add(
    draft: &mut Draft,
    exports: &[Export],
    solution: &Solution,
    input: &LabelledInput,
) -> io::Result<Option<NotExported>> {
    if exports.is_empty() {
        return Ok(None);
    }
    let models = Model::of_parts(solution, input);
    let mut refused = Vec::new();
    for (place, &export) in exports.iter().enumerate() {
        // Asked for a second time, it is there.
        if exports[..place].contains(&export) {
            continue;
        }
        if let Err(why) = export.write(draft, solution, input, &models)? {
            refused.push((export, why));
        }
    }
    let mut refused = NotExported { refused, is_part: false };
    refused.is_part = exports.iter().any(|&export| !refused.has(export));
    Ok((!refused.refused.is_empty()).then_some(refused))
}

#[cfg(test)]
#[path = "export_tests.rs"]
mod tests;
