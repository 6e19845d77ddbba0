//! Which input to read, and how, as arguments.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::args::{parse_number_within, parse_whole};
use super::exit::Failure;
use super::shell::quoted;
use crate::domain::{FocalPrior, ImageSize, Limits};
use crate::formats::{self, Format, LabelledInput, Matches, Reading};

/// Which tracks to solve.
#[derive(Debug, Clone, Args)]
pub struct InputArgs {
    /// Tracks: a CSV with a header `view,track,x,y[,depth][,sigma]`, OpenSfM's tracks.csv, COLMAP's database.db, or the
    /// directory of a COLMAP sparse model (.bin or .txt)
    ///
    /// The kind is told from the name and the first bytes; --format overrides. `-` is a table on standard input.
    ///
    /// In the CSV, a line is an observation, in pixels; the centre of the top-left pixel is (0, 0); sigma is one
    /// standard deviation of a coordinate, of which only the ratios between observations count. Ids are whole numbers
    /// from 0; other columns are not read, which a note says. OpenSfM's coordinates are relative to the image size,
    /// which is read from exif/IMAGE.exif beside the file; --width and --height give that of images without one. Of a
    /// database, matches are joined into tracks; a match that would put two keypoints of one image into one track is
    /// cut. A model gives its tracks; its poses, points and calibration are not used.
    #[arg(value_name = "INPUT")]
    pub input: PathBuf,

    #[command(flatten)]
    pub reading: ReadingArgs,
}

impl InputArgs {
    /// Reads the file.
    ///
    /// # Errors
    /// What is wrong with it, by line ([`Exit::BadInput`](super::exit::Exit::BadInput)).
    pub fn read(&self) -> Result<LabelledInput, Failure> {
        self.reading.read(&self.input)
    }
}

/// A side of an image, in pixels.
fn parse_side(text: &str) -> Result<u32, String> {
    match parse_whole(text)? {
        0 => Err("an image has at least one pixel".into()),
        side if side > ImageSize::MAX_SIDE_PX => Err(format!("no image has more than {} px", ImageSize::MAX_SIDE_PX)),
        side => Ok(side),
    }
}

/// Heading of the flags that say how. Given flag by flag: set for the whole, it would go on to flags of the command.
const READING: &str = "How to read INPUT";

/// How to read a file of tracks.
#[derive(Debug, Clone, Args)]
pub struct ReadingArgs {
    /// Width of the images in pixels; without it the extent of the points stands in, with a warning. COLMAP's files
    /// carry their own sizes
    #[arg(long, help_heading = READING, value_name = "PX", requires = "height", value_parser = parse_side)]
    pub width: Option<u32>,

    /// Height of the images in pixels
    #[arg(long, help_heading = READING, value_name = "PX", requires = "width", value_parser = parse_side)]
    pub height: Option<u32>,

    /// What kind of file INPUT is [default: told from its name and content]
    #[arg(long, help_heading = READING, value_enum)]
    pub format: Option<FormatArg>,

    /// Which matches of a COLMAP database to join into tracks [default: verified, or raw where none is]
    #[arg(long, help_heading = READING, value_enum)]
    pub matches: Option<MatchesArg>,

    /// Focal length of every view in pixels, known beforehand (EXIF, the lens): it counts as one more observation, and
    /// replaces what a COLMAP database knows
    #[arg(long, help_heading = READING, value_name = "PX",
        value_parser = parse_number_within(FocalPrior::FOCAL_RANGE_PX))]
    pub focal_px: Option<f64>,

    #[arg(long, help_heading = READING, value_name = "SIGMA", requires = "focal_px",
        value_parser = parse_number_within(FocalPrior::SIGMA_LOG_RANGE),
        help = format!("One standard deviation of log(--focal-px), a relative error: .1 is 10 % \
        [default: {FOCAL_SIGMA_LOG}]"))]
    pub focal_sigma: Option<f64>,

    /// Cameras, sizes and focal lengths of single views of a CSV: a CSV with a header
    /// `view[,camera_group][,width,height][,focal_px[,focal_sigma]]`
    ///
    /// Views of one camera group have one constant calibration; by default all are in group 0. An empty cell, or a view
    /// that is not listed, has what the other flags say.
    #[arg(long, help_heading = READING, value_name = "FILE")]
    pub view_table: Option<PathBuf>,
}

/// Standard deviation of the logarithm of a focal length that is given without one: that of EXIF.
const FOCAL_SIGMA_LOG: f64 = formats::colmap::cameras::PRIOR_SIGMA_LOG;

impl ReadingArgs {
    /// The flags that were given, each with a space before it.
    pub fn flags(&self) -> String {
        let mut flags = String::new();
        if let Some((width, height)) = self.width.zip(self.height) {
            flags.push_str(&format!(" --width {width} --height {height}"));
        }
        if let Some(format) = self.format.and_then(|format| format.to_possible_value()) {
            flags.push_str(&format!(" --format {}", format.get_name()));
        }
        if let Some(matches) = self.matches.and_then(|matches| matches.to_possible_value()) {
            flags.push_str(&format!(" --matches {}", matches.get_name()));
        }
        if let Some(focal_px) = self.focal_px {
            flags.push_str(&format!(" --focal-px {focal_px}"));
        }
        if let Some(sigma) = self.focal_sigma {
            flags.push_str(&format!(" --focal-sigma {sigma}"));
        }
        if let Some(table) = &self.view_table {
            flags.push_str(&format!(" --view-table {}", quoted(&table.display().to_string())));
        }
        flags
    }

    /// Reads a file.
    ///
    /// # Errors
    /// What is wrong with it, by line ([`Exit::BadInput`](super::exit::Exit::BadInput)).
    pub fn read(&self, path: &Path) -> Result<LabelledInput, Failure> {
        let reading = Reading {
            format: self.format.map(Format::from),
            size: self.width.zip(self.height).map(|(width_px, height_px)| ImageSize { width_px, height_px }),
            matches: self.matches.map(Matches::from),
            focal_prior: self
                .focal_px
                .map(|focal_px| FocalPrior { focal_px, sigma_log: self.focal_sigma.unwrap_or(FOCAL_SIGMA_LOG) }),
            view_table: self.view_table.clone(),
        };
        Ok(formats::read(path, &Limits::default(), &reading)?)
    }
}

/// Tells on stderr what reading changed or left out.
pub fn tell_notes(input: &LabelledInput) {
    for note in &input.notes {
        tell!("{}: {note}", input.display_path());
    }
}

/// [`Format`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FormatArg {
    /// A table `view,track,x,y[,depth][,sigma]`
    Csv,
    /// OpenSfM's tracks.csv, any version
    Opensfm,
    /// COLMAP's database.db
    ColmapDatabase,
    /// The directory of a COLMAP sparse model
    ColmapModel,
}

impl From<FormatArg> for Format {
    fn from(format: FormatArg) -> Self {
        match format {
            FormatArg::Csv => Format::Observations,
            FormatArg::Opensfm => Format::OpenSfm,
            FormatArg::ColmapDatabase => Format::ColmapDatabase,
            FormatArg::ColmapModel => Format::ColmapModel,
        }
    }
}

/// [`Matches`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MatchesArg {
    /// Those that COLMAP's geometric verification kept
    Verified,
    /// Those of the descriptors
    Raw,
}

impl From<MatchesArg> for Matches {
    fn from(matches: MatchesArg) -> Self {
        match matches {
            MatchesArg::Verified => Matches::Verified,
            MatchesArg::Raw => Matches::Raw,
        }
    }
}
