//! Reading a COLMAP database (SQLite): keypoints, and matches joined into tracks.
//!
//! The only SQL outside `store` beside that of `write_database`, and of another kind: it reads a file of someone
//! else's, and never writes.

pub(super) mod rows;

use std::path::{Path, PathBuf};

use rusqlite::config::DbConfig;
use rusqlite::{Connection, OpenFlags};

use self::rows::Keypoints;
pub(super) use self::rows::MAX_MATCHES;
use super::images::{Images, Observation};
use crate::domain::matches::{keypoint_starts, view_of};
use crate::domain::{Limits, PairMatches, counted};
use crate::formats::error::{Error, Problem};
use crate::formats::input::{LabelledInput, display_path};
use crate::formats::source::Matches;

/// Reads the tracks of a database. Views are image names; tracks are numbered from 0, COLMAP has none yet.
///
/// * `matches`: which to join; `None`: the verified where there are any, else the raw
///
/// A note tells how many matches made the tracks, and how many were cut because they would have put two keypoints of
/// one image into one track.
///
/// # Errors
/// A file that is no such database, is being written to, is damaged (by table and row) or above `limits`.
pub fn read(path: &Path, limits: &Limits, matches: Option<Matches>) -> Result<LabelledInput, Error> {
    let file = display_path(path);
    let one = |problem: Problem| Error::one(&file, problem);
    refuse_unfinished(path).map_err(|what| Error::whole(&file, what))?;
    let contents = open(path).and_then(|connection| read_tables(&connection, limits, matches)).map_err(one)?;
    let labelled = contents.into_labelled(path, limits).map_err(one)?;
    labelled.check(limits)?;
    Ok(labelled)
}

/// What is said of a database whose rigs have several cameras.
const SHARED_FRAMES: &str = "frames of several images (rigs of several cameras) are solved as images on their own; a \
    model that is exported is not one that COLMAP goes on from with this database";

/// What a database holds of use here.
struct Contents {
    images: Images,
    /// Keypoints of each image, in the order of the images.
    keypoints: Keypoints,
    /// Views are the positions of the images.
    matches: PairMatches,
    kind: Matches,
    notes: Vec<String>,
}

impl Contents {
    fn into_labelled(mut self, path: &Path, limits: &Limits) -> Result<LabelledInput, Problem> {
        let keypoints = self.keypoints;
        // Views are in another order than the images, and tracks are numbered by the views' keypoints.
        let (view_of_image, image_of_view) = self.images.views();
        let mut matches = self.matches;
        for view in matches.first_view.iter_mut().chain(&mut matches.second_view) {
            *view = view_of_image[*view as usize];
        }
        let starts = keypoint_starts(image_of_view.iter().map(|&image| keypoints.count(image)));
        let joined = matches.join(&starts);
        if joined.observations.len() > limits.max_observations {
            let what = format!(
                "{} are above the limit of {}",
                counted(joined.observations.len(), "observation"),
                limits.max_observations
            );
            return Err(Problem::of_file(what));
        }
        let note = format!(
            "joined {} of {} into {}; cut {}, which would have put two keypoints of one image into one track",
            counted(matches.len(), &format!("{} match", kind_name(self.kind))),
            counted(matches.pair_count(), "image pair"),
            counted(joined.tracks, "track"),
            counted(joined.cut, "match")
        );
        let observation = |&(keypoint, track): &(u32, u32)| {
            let view = view_of(&starts, keypoint);
            let (image, keypoint) = (image_of_view[view as usize], keypoint - starts[view as usize]);
            let [x, y] = keypoints.point(image, keypoint);
            Observation { image, keypoint, track: u64::from(track), x, y, line: 0 }
        };
        let observations = joined.observations.iter().map(observation).collect();
        for (image, keypoints) in keypoints.into_images() {
            self.images.set_keypoints(image, keypoints);
        }
        let notes = [vec![note], self.notes].concat();
        let labelled = self.images.into_labelled(observations, path, notes);
        Ok(LabelledInput { matches: Some(matches), ..labelled })
    }
}

fn kind_name(kind: Matches) -> &'static str {
    match kind {
        Matches::Verified => "verified",
        Matches::Raw => "raw",
    }
}

/// Refuses a database with a journal: what stands in there alone would be missed, or half a change be read.
pub(super) fn refuse_unfinished(path: &Path) -> Result<(), String> {
    for suffix in ["-wal", "-journal"] {
        let mut journal = path.as_os_str().to_owned();
        journal.push(suffix);
        let journal = PathBuf::from(journal);
        if std::fs::metadata(&journal).is_ok_and(|metadata| metadata.len() > 0) {
            return Err(format!(
                "{} beside it says that a change is under way or was broken off: let COLMAP end, or run \
                 `sqlite3 {} 'pragma wal_checkpoint(truncate)'`",
                display_path(&journal),
                display_path(path)
            ));
        }
    }
    Ok(())
}

/// Opens a database to read. Nobody else writes meanwhile, so that no lock and no shared memory file beside it is
/// needed.
fn open(path: &Path) -> Result<Connection, Problem> {
    let failed = |cause: &dyn std::fmt::Display| Problem::of_file(format!("cannot be opened: {cause}"));
    // SQLite's own words for a file that is not there name the address.
    std::fs::File::open(path).map_err(|error| failed(&error))?;
    let absolute = std::path::absolute(path).map_err(|error| failed(&error))?;
    let mut address =
        url::Url::from_file_path(absolute).map_err(|()| failed(&"its path cannot be written as a URL"))?;
    address.set_query(Some("immutable=1"));
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(address.as_str(), flags).map_err(|error| failed(&error))?;
    distrust(&connection).map_err(|error| failed(&error))?;
    Ok(connection)
}

/// A schema is a program too; these are strangers'.
pub(super) fn distrust(connection: &Connection) -> rusqlite::Result<()> {
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false).map(drop)
}

fn read_tables(connection: &Connection, limits: &Limits, matches: Option<Matches>) -> Result<Contents, Problem> {
    let tables = rows::tables(connection)?;
    let require = |table: &str| match tables.contains(table) {
        true => Ok(()),
        false => Err(Problem::of_file(format!("is no COLMAP database: it has no table `{table}`"))),
    };
    ["cameras", "images", "keypoints"].into_iter().try_for_each(require)?;
    let (mut images, mut notes) = (Images::default(), Vec::new());
    rows::cameras(connection, &mut images)?;
    rows::images(connection, limits.max_views, &mut images)?;
    let keypoints = rows::keypoints(connection, &images)?;
    if ["frames", "frame_data"].iter().all(|table| tables.contains(*table)) {
        match rows::frames(connection, &images)? {
            Some(frames) => images.set_frames(frames),
            None => notes.push(SHARED_FRAMES.into()),
        }
    }
    let kinds: &[Matches] = match matches {
        Some(Matches::Verified) => &[Matches::Verified],
        Some(Matches::Raw) => &[Matches::Raw],
        None => &[Matches::Verified, Matches::Raw],
    };
    for &kind in kinds {
        require(rows::table(kind))?;
        let matches = rows::matches(connection, kind, &images, &keypoints)?;
        if !matches.is_empty() {
            return Ok(Contents { images, keypoints, matches, kind, notes });
        }
    }
    Err(Problem::of_file(match matches {
        Some(Matches::Verified) => {
            "holds no verified matches; let COLMAP verify them, or take the others with --matches raw"
        }
        _ => "holds no matches; let COLMAP match its images first",
    }))
}

#[cfg(test)]
#[path = "database_tests.rs"]
mod tests;
