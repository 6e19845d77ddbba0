//! Arguments that several commands share.

use std::iter;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::{Args, ValueEnum};

use super::access::AccessArgs;
use super::exit::Failure;
use super::job_view::quoted;
use crate::client::{Client, MAX_WAIT};
use crate::domain::{Backend, FocalPrior, ImageSize, Limits, Method, Solution, SolveSettings};
use crate::formats::{self, Export, Format, LabelledInput, Matches, Reading, result_files};
use crate::parallel::Threads;

/// Where the server listens by default; `serve --listen` has the same port.
pub const DEFAULT_SERVER: &str = "http://127.0.0.1:50051";

/// Which server to talk to.
#[derive(Debug, Clone, Args)]
pub struct ServerArgs {
    /// Address of the server, http:// or https://
    #[arg(long, value_name = "URL", env = "SCPSFM_SERVER", hide_env_values = true, default_value = DEFAULT_SERVER)]
    pub server: String,

    #[command(flatten)]
    pub access: AccessArgs,
}

impl ServerArgs {
    /// Connects to it; where a call has to wait, it is told on stderr.
    ///
    /// # Errors
    /// See [`Client::connect`].
    pub async fn connect(&self) -> Result<Client, Failure> {
        let mut client = Client::connect(&self.server, &self.access.options()?).await?;
        client.on_wait(|trouble| tell!("waiting up to {} s: {trouble}", MAX_WAIT.as_secs()));
        Ok(client)
    }
}

/// A whole number, with an error that says what it is not.
///
/// # Errors
/// For anything else.
pub fn parse_whole<T: FromStr>(text: &str) -> Result<T, String> {
    text.parse().map_err(|_| {
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        if digits { "is too large a number".into() } else { "is not a whole number >= 0".into() }
    })
}

/// A side of an image, in pixels.
fn parse_side(text: &str) -> Result<u32, String> {
    match parse_whole(text)? {
        0 => Err("an image has at least one pixel".into()),
        side => Ok(side),
    }
}

/// Which page of a list.
#[derive(Debug, Clone, Args)]
pub struct PageArgs {
    /// Entries in a page
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub page_size: u16,

    /// The page that follows another
    #[arg(long, value_name = "TOKEN", default_value = "")]
    pub page_token: String,

    /// Every page from there on
    #[arg(long)]
    pub all: bool,
}

impl PageArgs {
    /// Goes on to the page after one, where it is wanted; says on stderr how to ask for it, where it is not.
    pub fn next(&mut self, next_page_token: String) -> bool {
        if next_page_token.is_empty() {
            return false;
        }
        if !self.all {
            tell!("more: --page-token {next_page_token}");
        }
        self.page_token = next_page_token;
        self.all
    }
}

/// Which tracks to solve.
#[derive(Debug, Clone, Args)]
pub struct InputArgs {
    /// Tracks: a CSV with a header `view,track,x,y[,depth][,sigma]`, OpenSfM's tracks.csv, COLMAP's database.db, or the
    /// directory of a COLMAP sparse model (.bin or .txt)
    ///
    /// The kind is told from the name and the first bytes; --format overrides. `-` is a table on standard input.
    ///
    /// In the CSV, a line is an observation, in pixels; the centre of the top-left pixel is (0, 0); sigma is one
    /// standard deviation of a coordinate. Ids are whole numbers from 0, other columns are ignored. OpenSfM's
    /// coordinates are relative to the image size, which is read from exif/IMAGE.exif beside the file; --width and
    /// --height give that of images without one. Of a database, matches are joined into tracks; a match that would put
    /// two keypoints of one image into one track is cut. A model gives its tracks; its poses, points and calibration
    /// are not used.
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
    #[arg(long, help_heading = READING, value_name = "PX", value_parser = parse_positive)]
    pub focal_px: Option<f64>,

    #[arg(long, help_heading = READING, value_name = "SIGMA", requires = "focal_px", value_parser = parse_positive,
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

/// A number above 0.
pub fn parse_positive(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().map_err(|_| "is not a number".to_owned())?;
    if number.is_finite() && number > 0.0 { Ok(number) } else { Err("is not positive and finite".into()) }
}

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

/// Threads that solve at a time where nothing is said: one a core.
pub fn cores() -> usize {
    Threads::one_a_core().count()
}

/// Tells on stderr what reading changed or left out.
pub fn tell_notes(input: &LabelledInput) {
    for note in &input.notes {
        tell!("{}: {note}", input.display_path());
    }
}

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
        Ok(exports)
    }
}

/// How to solve.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "How to solve")]
pub struct SettingsArgs {
    /// What decides which tracks are right
    #[arg(long, value_enum, default_value_t = MethodArg::Auto)]
    pub method: MethodArg,

    /// Seed of every random choice: one seed, one answer
    #[arg(long, default_value_t = 0, value_parser = parse_whole::<u64>)]
    pub seed: u64,

    #[arg(long, value_name = "N", help = format!("Iterations of each optimisation of the network, 1 to {}; `scpsfm` \
        does up to 16 of them, `paper` one, `auto` usually none", SolveSettings::MAX_ITERATIONS),
        default_value_t = SolveSettings::DEFAULT_ITERATIONS,
        value_parser = clap::value_parser!(u32).range(1..=i64::from(SolveSettings::MAX_ITERATIONS)))]
    pub iterations: u32,

    /// Leave the DAQ residual (self-calibration) out of the losses and scores
    #[arg(long)]
    pub no_daq: bool,

    /// With `paper`, `scpsfm` and `psfm`, for an input without depths: estimate projective depths from fundamental
    /// matrices and epipoles, instead of taking them as 1; needs about half of the tracks to be right
    #[arg(long)]
    pub epipolar_depths: bool,

    /// Noise of the observations in pixels, one standard deviation, where known: a start, the noise is estimated
    #[arg(long, value_name = "PX")]
    pub noise_px: Option<f64>,

    /// A focal length a view (a zoom) instead of one for all: the grade is WEAK at best then, all views share one lens,
    /// and camera groups and priors are not looked at
    #[arg(long)]
    pub focal_per_view: bool,

    /// Tensor backend of the network [default: flex, or what the server is configured with]
    #[arg(long, value_enum)]
    pub backend: Option<BackendArg>,

    #[arg(long, hide_short_help = true, help = format!("Weight of the loss L_proj at the first iteration; with \
        `paper`, at every iteration [default: {}; paper: {}]",
        SolveSettings::DEFAULT_ALPHA, SolveSettings::PAPER_ALPHA))]
    pub alpha: Option<f64>,

    /// Weight of the loss L_DAQ
    #[arg(long, hide_short_help = true, default_value_t = SolveSettings::DEFAULT_BETA)]
    pub beta: f64,

    /// Least number of inliers that the loss L_num asks for (the paper's t) at the first iteration; with `paper`, at
    /// every iteration
    #[arg(long, hide_short_help = true, value_name = "T", default_value_t = SolveSettings::DEFAULT_MIN_INLIERS)]
    pub min_inliers: f64,

    /// Slope of the sigmoid in L_num, with `paper` only; 1 is as printed and may let all weights collapse to 0
    #[arg(long, hide_short_help = true, default_value_t = SolveSettings::DEFAULT_KAPPA)]
    pub kappa: f64,

    /// Learning rate of Adam
    #[arg(long, hide_short_help = true, value_name = "RATE", default_value_t = SolveSettings::DEFAULT_LEARNING_RATE)]
    pub learning_rate: f64,

    /// Width of the network as a share of the original PointNet
    #[arg(long, hide_short_help = true, value_name = "SHARE", default_value_t = SolveSettings::DEFAULT_NETWORK_WIDTH)]
    pub network_width: f64,
}

impl SettingsArgs {
    /// The settings, checked.
    ///
    /// # Errors
    /// A value out of range, as wrong usage.
    pub fn settings(&self) -> Result<SolveSettings, Failure> {
        let method = self.method.into();
        let settings = SolveSettings {
            method,
            use_daq: !self.no_daq,
            alpha: self.alpha.unwrap_or(SolveSettings::default_alpha(method)),
            beta: self.beta,
            min_inliers: self.min_inliers,
            kappa: self.kappa,
            learning_rate: self.learning_rate,
            iterations: self.iterations,
            network_width: self.network_width,
            epipolar_depths: self.epipolar_depths,
            seed: self.seed,
            noise_px: self.noise_px,
            focal_per_view: self.focal_per_view,
            backend: self.backend.map(Backend::from),
            ..SolveSettings::default()
        };
        settings.validate().map_err(Failure::usage)?;
        if self.epipolar_depths && !matches!(self.method, MethodArg::Paper | MethodArg::Scpsfm | MethodArg::Psfm) {
            return Err(Failure::usage("--epipolar-depths is of use with --method paper, scpsfm and psfm only"));
        }
        Ok(settings)
    }
}

/// [`Method`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MethodArg {
    /// The network's prior and geometry together
    Auto,
    /// The paper's network under its objective as printed, for comparison: one optimisation, thresholded at 1/2
    Paper,
    /// Geometry alone, no network
    Geometry,
    /// Plain projective factorisation (Sturm and Triggs 1996)
    Psfm,
    /// The paper's network by itself under a continued objective: the best of up to 16 optimisations, thresholded at
    /// 1/2
    Scpsfm,
}

impl From<MethodArg> for Method {
    fn from(method: MethodArg) -> Self {
        match method {
            MethodArg::Auto => Method::Auto,
            MethodArg::Paper => Method::Paper,
            MethodArg::Geometry => Method::Geometry,
            MethodArg::Psfm => Method::Psfm,
            MethodArg::Scpsfm => Method::Scpsfm,
        }
    }
}

/// [`Backend`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BackendArg {
    /// burn-flex, the faster of the two
    Flex,
    /// burn-ndarray
    Ndarray,
}

impl From<BackendArg> for Backend {
    fn from(backend: BackendArg) -> Self {
        match backend {
            BackendArg::Flex => Backend::Flex,
            BackendArg::Ndarray => Backend::Ndarray,
        }
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
