//! Files for other programs, as arguments.

use std::iter;
use std::path::Path;

use clap::{Args, ValueEnum};

use super::exit::Failure;
use crate::domain::Solution;
use crate::formats::{Export, Format, LabelledInput, result_files};

/// Files for other programs.
#[derive(Debug, Clone, Args)]
pub struct ExportArgs {
    /// Also write the result for these programs, each below the output directory in a folder of its name: colmap/ and
    /// colmap-text/ hold a sparse model (of several parts, folders 1/ and on those of the smaller ones), colmap-db/ a
    /// database.db, opensfm/ reconstruction.json, tracks.csv and camera_models.json, nerfstudio/ transforms.json and
    /// points.ply of the largest part, bundler/ bundle.out and list.txt, bal/ problem.txt. All but colmap-db need a
    /// metric result
    #[arg(long, value_name = "KIND", value_enum, value_delimiter = ',')]
    pub export: Vec<ExportArg>,
}

impl ExportArgs {
    fn exports(&self) -> Vec<Export> {
        self.export.iter().copied().map(Export::from).collect()
    }

    /// Refuses, before any work, a directory in which the result would replace what it is made from, and an export that
    /// no result of an input of this kind has.
    pub fn check(
        &self,
        directory: &Path,
        input: &Path,
        view_table: Option<&Path>,
        format: Option<Format>,
    ) -> Result<(), Failure> {
        if self.export.contains(&ExportArg::ColmapDb) && format != Some(Format::ColmapDatabase) {
            return Err(Failure::usage(format_args!(
                "--export colmap-db: {} is no COLMAP database: there is none to copy",
                input.display()
            )));
        }
        let exports = self.exports();
        let mut read = iter::once(input).chain(view_table);
        match read.find_map(|path| result_files::replaced(directory, &exports, path)) {
            Some(place) => Err(Failure::usage(format_args!(
                "--out {}: the result would replace its own input, {}: give another directory",
                directory.display(),
                place.display()
            ))),
            None => Ok(()),
        }
    }

    /// Writes the result files and, where there is the input, what is asked for other programs, which it returns. What
    /// cannot be written, as of a result that is not metric, is no failure: it is told on stderr.
    ///
    /// # Errors
    /// A file that cannot be written or removed.
    pub fn write(
        &self,
        directory: &Path,
        solution: &Solution,
        input: Option<&LabelledInput>,
    ) -> Result<Vec<Export>, Failure> {
        let mut exports = self.exports();
        if let Some(refused) = result_files::write(directory, solution, input, &exports)? {
            tell!("warning: {refused}");
            exports.retain(|&export| !refused.has(export));
        }
        let models: Vec<&str> =
            exports.iter().filter(|&&export| export != Export::ColmapDatabase).map(|export| export.folder()).collect();
        if solution.is_without_depth() && !models.is_empty() {
            tell!(
                "warning: {}: the camera only turned, so that there is no depth: no points, and all cameras in one place",
                models.join(", ")
            );
        }
        Ok(exports)
    }
}

/// [`Export`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExportArg {
    /// A COLMAP sparse model, binary
    Colmap,
    /// A COLMAP sparse model, text
    ColmapText,
    /// A copy of the COLMAP database that is solved, with the matches that are right as verified two-view geometries
    /// and the estimated cameras: for COLMAP's mapper
    ColmapDb,
    /// OpenSfM's reconstruction.json, with its tracks and its cameras
    Opensfm,
    /// nerfstudio's transforms.json and the points: OpenCV's cameras, poses in OpenGL's axes
    Nerfstudio,
    /// Bundler's bundle.out and list.txt, of perspective cameras with square pixels and at most two radial coefficients
    Bundler,
    /// A problem of BAL (Bundle Adjustment in the Large), of the same cameras
    Bal,
}

impl From<ExportArg> for Export {
    fn from(export: ExportArg) -> Self {
        match export {
            ExportArg::Colmap => Export::Colmap,
            ExportArg::ColmapText => Export::ColmapText,
            ExportArg::ColmapDb => Export::ColmapDatabase,
            ExportArg::Opensfm => Export::OpenSfm,
            ExportArg::Nerfstudio => Export::Nerfstudio,
            ExportArg::Bundler => Export::Bundler,
            ExportArg::Bal => Export::Bal,
        }
    }
}
