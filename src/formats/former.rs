//! Files that a former run of this program left, told from other programs' by what they hold.
//!
//! A directory may hold a caller's own model in `colmap/`, or a table called `observations.csv`: a name alone is no
//! reason to remove a file.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::export::Export;
use super::result_files::{self, part_of_points, remove};
use super::{ply, windows};

/// Bytes of a file that are looked at; what each kind is known by stands within its first few lines.
const LOOKED_AT: u64 = 1 << 16;

/// Removes the result files of former runs from `directory`, but for these names.
///
/// # Errors
/// A file that cannot be removed, named.
pub fn remove_beside(directory: &Path, written: &[String]) -> io::Result<()> {
    for entry in std::fs::read_dir(directory)? {
        let entry = entry?;
        let name = entry.file_name();
        let Some(name) = name.to_str().filter(|name| !written.iter().any(|written| written == name)) else { continue };
        if mark(name).is_some_and(|mark| holds(&entry.path(), mark)) {
            remove(&entry.path())?;
        }
    }
    Ok(())
}

/// What is in a result file of this name and in no other program's.
fn mark(name: &str) -> Option<&'static str> {
    Some(match name {
        result_files::TRACKS => "track,weight,inlier",
        result_files::OBSERVATIONS => "view,track,inlier,residual_px",
        result_files::CAMERAS => "\n      \"registered\": ",
        result_files::POINTS => ply::MARK,
        result_files::REPORT => crate::report::TITLE,
        result_files::RESULT => "\n  \"sigma_log_focal\": ",
        windows::CSV => "window,first_view,last_view,",
        windows::JSON => "\n  \"views_left\": ",
        name if part_of_points(name).is_some() => ply::MARK,
        _ => return None,
    })
}

/// Whether the files of an export in this folder are a former run's.
pub fn is_export(export: Export, folder: &Path) -> bool {
    match export {
        Export::ColmapText => {
            export.files().1.iter().all(|file| holds(&folder.join(file), super::colmap::write::mark(file)))
        }
        Export::OpenSfm => holds(&folder.join(export.files().1[0]), super::opensfm::reconstruction::MARK),
        // The binary format has no room for a name: it is the colours, which stand for weights.
        Export::Colmap => {
            beginning(&folder.join("points3D.bin")).is_some_and(|bytes| super::colmap::write::has_our_colours(&bytes))
        }
    }
}

fn holds(path: &Path, mark: &str) -> bool {
    beginning(path).is_some_and(|bytes| bytes.windows(mark.len()).any(|window| window == mark.as_bytes()))
}

/// The first bytes of a plain file; `None` where it cannot be read, which is none of ours then.
fn beginning(path: &Path) -> Option<Vec<u8>> {
    if !path.symlink_metadata().ok()?.is_file() {
        return None;
    }
    let mut bytes = Vec::new();
    File::open(path).ok()?.take(LOOKED_AT).read_to_end(&mut bytes).ok()?;
    Some(bytes)
}
