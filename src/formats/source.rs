//! What kind of input a path holds, and reading it.

use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use super::error::Error;
use super::input::{LabelledInput, display_path};
use super::{colmap, focal_priors, observations, opensfm, result_files, text, view_table};
use crate::domain::{FocalPrior, ImageSize, Limits};

/// The path that stands for standard input, as with most programs.
pub const STANDARD_INPUT: &str = "-";
/// How SQLite files, and so COLMAP databases, begin.
pub(super) const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";
/// How OpenSfM's tracks.csv begins, from its version 1 on.
pub(super) const OPENSFM_TRACKS: &[u8] = b"OPENSFM_TRACKS_VERSION";
const UTF8_BOM: &[u8] = b"\xEF\xBB\xBF";
/// Bytes that a kind is told from: the first line of a table, its image's name at its longest.
const BEGINNING_BYTES: u64 = 8192;
/// Tabs of the shortest line of OpenSfM's tracks.csv.
const OPENSFM_TABS: usize = 7;

/// A kind of input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A CSV with a header `view,track,x,y[,depth][,sigma]`.
    Observations,
    /// OpenSfM's tracks.csv.
    OpenSfm,
    /// COLMAP's database.db: keypoints and matches.
    ColmapDatabase,
    /// A directory with a COLMAP sparse model, text or binary.
    ColmapModel,
}

/// Which matches of a COLMAP database are joined into tracks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matches {
    /// Those that COLMAP's geometric verification kept.
    Verified,
    /// Those of the descriptors.
    Raw,
}

/// How to read an input. The default asks the file itself.
#[derive(Debug, Clone, Default)]
pub struct Reading {
    /// `None`: told from the file.
    pub format: Option<Format>,
    /// Size of every image, for files that carry none.
    pub size: Option<ImageSize>,
    /// `None`: verified where there are any, else raw.
    pub matches: Option<Matches>,
    /// What is known of the focal length of every view beforehand, in place of what the file says of it.
    pub focal_prior: Option<FocalPrior>,
    /// A table of cameras, sizes and focal lengths of single views, for files that carry none; see [`view_table`].
    pub view_table: Option<PathBuf>,
}

/// Standard input or a pipe: it can be read once.
struct Stream {
    /// What was read of it to tell its kind.
    beginning: Vec<u8>,
    rest: Box<dyn Read>,
}

impl Stream {
    /// `None` for a file or a directory.
    fn open(path: &Path) -> std::io::Result<Option<Self>> {
        let mut rest: Box<dyn Read> = if path == Path::new(STANDARD_INPUT) {
            Box::new(std::io::stdin())
        } else {
            let metadata = std::fs::metadata(path)?;
            if metadata.is_file() || metadata.is_dir() {
                return Ok(None);
            }
            Box::new(File::open(path)?)
        };
        let mut beginning = Vec::new();
        rest.by_ref().take(BEGINNING_BYTES).read_to_end(&mut beginning)?;
        Ok(Some(Self { beginning, rest }))
    }
}

/// Reads an input of any kind, `-` from standard input; an `Ok` is an input the solver takes.
///
/// # Errors
/// What is wrong with the file, by line, byte or row; a flag that the file needs or contradicts.
pub fn read(path: &Path, limits: &Limits, reading: &Reading) -> Result<LabelledInput, Error> {
    let whole = |description: String| Error::whole(&display_path(path), description);
    let stream = Stream::open(path).map_err(|error| whole(cannot_read(error)))?;
    let format = match (reading.format, &stream) {
        (Some(format), _) => format,
        (None, Some(stream)) => told_from(&stream.beginning),
        (None, None) => detect(path).map_err(whole)?,
    };
    let is_colmap = matches!(format, Format::ColmapDatabase | Format::ColmapModel);
    if is_colmap && stream.is_some() {
        return Err(whole("is a stream; COLMAP's files are read by their paths".into()));
    }
    refuse_other(format, path).map_err(whole)?;
    if is_colmap && reading.size.is_some() {
        return Err(whole("carries the sizes of its images; leave out --width and --height".into()));
    }
    if reading.matches.is_some() && format != Format::ColmapDatabase {
        return Err(whole("is no COLMAP database; leave out --matches".into()));
    }
    if reading.view_table.is_some() && format != Format::Observations {
        return Err(whole(
            "is no table view,track,x,y; its cameras come from its own files; leave out --view-table".into(),
        ));
    }
    let table = || -> Result<Box<dyn BufRead>, Error> {
        Ok(match stream {
            Some(Stream { beginning, rest }) => Box::new(BufReader::new(Cursor::new(beginning).chain(rest))),
            None => Box::new(text::open_table(path, limits)?),
        })
    };
    let mut labelled = match format {
        Format::Observations => observations::read(table()?, path, limits, reading.size),
        Format::OpenSfm => opensfm::tracks::read(table()?, path, limits, reading.size),
        Format::ColmapDatabase => colmap::database::read(path, limits, reading.matches),
        Format::ColmapModel => colmap::model::read(path, limits),
    }?;
    labelled.format = Some(format);
    labelled.name_views();
    if reading.focal_prior.is_some() {
        labelled.raw.views.iter_mut().for_each(|view| view.focal_prior = reading.focal_prior);
        labelled.check(limits)?;
    }
    if let Some(table) = &reading.view_table {
        if table == Path::new(STANDARD_INPUT) {
            return Err(Error::whole("--view-table", "is read from a file, not from standard input"));
        }
        view_table::apply(table, limits, &mut labelled)?;
    }
    labelled.notes.extend(focal_priors::doubts(&labelled.raw));
    Ok(labelled)
}

fn cannot_read(error: std::io::Error) -> String {
    format!("cannot be read: {error}")
}

/// Tells the kind of a file or a directory from names and first bytes.
fn detect(path: &Path) -> Result<Format, String> {
    let metadata = std::fs::metadata(path).map_err(cannot_read)?;
    if metadata.is_dir() {
        return if colmap::model::is_model(path) { Ok(Format::ColmapModel) } else { Err(what_a_directory_lacks(path)) };
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    if colmap::model::is_part(&name) {
        return Err("is one file of a COLMAP model; give the directory that holds it".into());
    }
    let mut beginning = Vec::new();
    File::open(path).and_then(|file| file.take(BEGINNING_BYTES).read_to_end(&mut beginning)).map_err(cannot_read)?;
    Ok(if name.ends_with(".db") { Format::ColmapDatabase } else { told_from(&beginning) })
}

/// Tells a kind from first bytes; what is nothing else is taken for a table of observations, whose reader says best
/// what is wrong with it.
fn told_from(beginning: &[u8]) -> Format {
    let text = beginning.strip_prefix(UTF8_BOM).unwrap_or(beginning);
    let first_line = text.split(|&byte| byte == b'\n').next().unwrap_or_default();
    let tabs = first_line.iter().filter(|&&byte| byte == b'\t').count();
    if beginning.starts_with(SQLITE_MAGIC) {
        Format::ColmapDatabase
    } else if text.starts_with(OPENSFM_TRACKS) || tabs >= OPENSFM_TABS {
        Format::OpenSfm
    } else {
        Format::Observations
    }
}

/// Says so where `--format` or a name calls something one of COLMAP's files that is none, before any flag is found not
/// to fit.
fn refuse_other(format: Format, path: &Path) -> Result<(), String> {
    match format {
        Format::ColmapDatabase => {
            let mut beginning = Vec::new();
            let magic = SQLITE_MAGIC.len() as u64;
            File::open(path).and_then(|file| file.take(magic).read_to_end(&mut beginning)).map_err(cannot_read)?;
            // An empty file is a database without tables.
            let is_database = beginning.is_empty() || beginning == SQLITE_MAGIC;
            if is_database { Ok(()) } else { Err("is no COLMAP database".into()) }
        }
        Format::ColmapModel if !path.is_dir() => Err("is no COLMAP model, which is a directory".into()),
        Format::ColmapModel | Format::Observations | Format::OpenSfm => Ok(()),
    }
}

/// What to give instead of this directory.
fn what_a_directory_lacks(path: &Path) -> String {
    if path.join(result_files::RESULT).exists() {
        return "is the directory of an answer; give the file that was solved".into();
    }
    let below = ["database.db", "tracks.csv", "observations.csv", "sparse/0", "sparse"];
    match below.into_iter().find(|name| path.join(name).exists()) {
        Some(name) => format!("is a directory without a COLMAP model; give its {name}"),
        None => "is a directory without a COLMAP model (cameras and images, .bin or .txt)".into(),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn detected(name: &str, content: &[u8]) -> Result<Format, String> {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join(name);
        fs::write(&path, content).expect("written");
        detect(&path)
    }

    #[test]
    fn a_kind_is_told_from_name_and_content() {
        assert_eq!(detected("o.csv", b"view,track,x,y\n"), Ok(Format::Observations));
        assert_eq!(detected("o.csv", b""), Ok(Format::Observations));
        assert_eq!(detected("tracks.csv", b"OPENSFM_TRACKS_VERSION_v2\n"), Ok(Format::OpenSfm));
        assert_eq!(detected("tracks.csv", b"\xEF\xBB\xBFOPENSFM_TRACKS_VERSION_v1\n"), Ok(Format::OpenSfm));
        assert_eq!(detected("tracks.csv", b"a,b.jpg\t0\t1\t0.1\t0.2\t1\t2\t3\n"), Ok(Format::OpenSfm));
        assert_eq!(detected("any", b"SQLite format 3\0..."), Ok(Format::ColmapDatabase));
        assert_eq!(detected("empty.db", b""), Ok(Format::ColmapDatabase));
        let part = detected("images.bin", b"\x01").expect_err("a part of a model");
        assert!(part.contains("give the directory"), "{part}");
    }

    #[test]
    fn a_directory_is_a_model_or_says_what_to_give() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let refused = || detect(directory.path()).expect_err("no model");
        assert!(refused().contains("without a COLMAP model (cameras"), "{}", refused());
        fs::write(directory.path().join("result.json"), "").expect("written");
        assert!(refused().contains("is the directory of an answer"), "{}", refused());
        fs::remove_file(directory.path().join("result.json")).expect("removed");
        fs::write(directory.path().join("database.db"), "").expect("written");
        assert!(refused().ends_with("give its database.db"), "{}", refused());
        for name in ["cameras.txt", "images.txt"] {
            fs::write(directory.path().join(name), "").expect("written");
        }
        assert_eq!(detect(directory.path()), Ok(Format::ColmapModel));
    }

    #[test]
    fn a_focal_length_that_is_given_is_that_of_every_view() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("o.csv");
        fs::write(&path, "view,track,x,y\n0,0,1,2\n1,0,3,4\n").expect("written");
        let prior = |focal_px| FocalPrior { focal_px, sigma_log: 0.1 };
        let with = |focal_px| {
            let reading = Reading { focal_prior: Some(prior(focal_px)), ..Reading::default() };
            read(&path, &Limits::default(), &reading)
        };
        let input = with(800.0).expect("valid");
        assert!(input.raw.views.iter().all(|view| view.focal_prior == Some(prior(800.0))));
        let refused = with(-1.0).expect_err("no focal length").to_string();
        assert!(refused.contains("focal prior -1e0 px with sigma 1e-1: -1e0 is not within 1e-6..=1e9"), "{refused}");
    }

    #[test]
    fn flags_that_do_not_fit_the_file_are_named() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("tracks.csv");
        let refused = |reading: Reading| {
            read(&path, &Limits::default(), &reading).expect_err("flags that do not fit").to_string()
        };
        fs::write(&path, "OPENSFM_TRACKS_VERSION_v0\na.jpg\t1\t0\t0\t0\t1\t2\t3\n").expect("written");
        let words = refused(Reading::default());
        assert!(words.contains("/tracks.csv, line 2: image: ") && words.contains("--width and --height"), "{words}");
        let matches = Some(Matches::Raw);
        assert!(refused(Reading { matches, ..Reading::default() }).contains("leave out --matches"));
        let size = Some(ImageSize { width_px: 4, height_px: 3 });
        let database = Reading { size, format: Some(Format::ColmapDatabase), ..Reading::default() };
        assert!(refused(database.clone()).ends_with("is no COLMAP database"));
        let model = Reading { format: Some(Format::ColmapModel), ..database.clone() };
        assert!(refused(model).contains("is no COLMAP model"));
        let table = Reading { format: Some(Format::Observations), ..Reading::default() };
        assert!(refused(table).contains("is an OpenSfM tracks.csv"));
        fs::write(&path, SQLITE_MAGIC).expect("written");
        assert!(refused(database.clone()).contains("leave out --width and --height"));
        let cameras = Reading { size: None, view_table: Some("views.csv".into()), ..database };
        assert!(refused(cameras).contains("leave out --view-table"));
    }
}
