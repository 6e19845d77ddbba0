//! The scene's measures and its departures from the paper, as arguments.

use clap::{Args, ValueEnum};

use super::args::{parse_positive, parse_whole};
use super::exit::Failure;
use crate::domain::error::quoted;
use crate::synthetic::scene::FOCAL_RANGE_PX;
use crate::synthetic::{Motion, NoiseKind, OutlierKind, Scene, SceneOptions, Shape};

/// The measures of the paper's scenes; `demo` has them too.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "The scene")]
pub struct SceneArgs {
    /// Views (images)
    #[arg(long, default_value_t = 10, value_parser = parse_whole::<usize>)]
    pub views: usize,

    /// Tracks; each is seen in every view
    #[arg(long, default_value_t = 200, value_parser = parse_whole::<usize>)]
    pub tracks: usize,

    /// Standard deviation of the noise as a share of the image width
    #[arg(long, value_name = "SHARE", default_value_t = 0.003)]
    pub noise: f64,

    /// Share of the tracks that are outliers
    #[arg(long, value_name = "SHARE", default_value_t = 0.9)]
    pub outliers: f64,

    /// Largest rotation about each axis in radians; above 0.5 the cameras orbit the scene
    #[arg(long, value_name = "RAD", default_value_t = 0.4)]
    pub rotation: f64,

    /// Seed of the scene: one seed, one scene
    #[arg(long, default_value_t = 0, value_parser = parse_whole::<u64>)]
    pub seed: u64,
}

impl SceneArgs {
    /// The paper's scene of these measures.
    pub fn options(&self, with_depths: bool) -> SceneOptions {
        SceneOptions {
            views: self.views,
            tracks: self.tracks,
            noise: self.noise,
            outliers: self.outliers,
            max_rotation_rad: self.rotation,
            with_depths,
            seed: self.seed,
            ..SceneOptions::default()
        }
    }

    /// The scene itself.
    ///
    /// # Errors
    /// A measure out of range, as wrong usage.
    pub fn generate(&self, with_depths: bool) -> Result<Scene, Failure> {
        Scene::generate(&self.options(with_depths)).map_err(|invalid| Failure::of_flags(&invalid))
    }
}

/// Points and cameras other than the paper's.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "The scene: shape and motion")]
pub struct GeometryArgs {
    /// How the points lie
    #[arg(long, value_enum, default_value_t = ShapeArg::Box)]
    pub shape: ShapeArg,

    /// How the cameras move
    #[arg(long, value_enum, default_value_t = MotionArg::General)]
    pub motion: MotionArg,

    /// Largest turn of each camera about its optical axis in radians, beside the motion's
    #[arg(long, value_name = "RAD", default_value_t = 0.0)]
    pub roll: f64,
}

impl GeometryArgs {
    /// These options with this geometry.
    pub fn apply(&self, options: SceneOptions) -> SceneOptions {
        SceneOptions { shape: self.shape.into(), motion: self.motion.into(), max_roll_rad: self.roll, ..options }
    }
}

/// Outliers other than the paper's.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "The scene: outliers")]
pub struct OutlierArgs {
    /// What the wrong observations of outliers are
    #[arg(long, value_enum, value_name = "KIND", default_value_t = OutlierKindArg::Permuted)]
    pub outlier_kind: OutlierKindArg,

    /// Views in which an outlier is wrong, random ones for each track; 0: all that can be, or half if repeated
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = parse_whole::<usize>)]
    pub wrong_views: usize,

    /// Views that observe a track, neighbours of each other; 0: all
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = parse_whole::<usize>)]
    pub seen_views: usize,

    /// Observations of every right track that are anywhere in the image instead, in random views for each track
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = parse_whole::<usize>)]
    pub wrong_observations: usize,

    /// Observations of every track that are left out, random ones for each track
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = parse_whole::<usize>)]
    pub deleted_observations: usize,

    /// Share of all tracks that belong to a second moving body; they count among the outliers
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub second_motion: f64,
}

impl OutlierArgs {
    /// These options with these outliers.
    pub fn apply(&self, options: SceneOptions) -> SceneOptions {
        SceneOptions {
            outlier_kind: self.outlier_kind.into(),
            wrong_views: self.wrong_views,
            seen_views: self.seen_views,
            wrong_observations: self.wrong_observations,
            deleted_observations: self.deleted_observations,
            second_motion: self.second_motion,
            ..options
        }
    }
}

/// Noise and calibration other than the paper's.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "The scene: noise and camera")]
pub struct CameraArgs {
    /// How the noise is distributed
    #[arg(long, value_enum, value_name = "KIND", default_value_t = NoiseKindArg::Gaussian)]
    pub noise_kind: NoiseKindArg,

    /// Displacement of the principal point from the centre, right and down, as shares of the image width
    #[arg(long, value_name = "DX,DY", default_value = "0,0", value_parser = pair, allow_hyphen_values = true)]
    pub principal_point: [f64; 2],

    /// Radial distortion: x (1 + K1 r^2), with x and its length r in focal lengths from the principal point
    #[arg(long, value_name = "K1", default_value_t = 0.0, allow_hyphen_values = true)]
    pub radial_k1: f64,

    #[arg(long, value_name = "PX", value_parser = parse_positive,
        help = format!("Focal length in pixels [default: random, {} to {}]", FOCAL_RANGE_PX.0, FOCAL_RANGE_PX.1))]
    pub focal_px: Option<f64>,

    /// The focal length of each view is random in f (1 +- SHARE)
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub zoom: f64,
}

impl CameraArgs {
    /// The range of the focal length.
    pub fn focal_range_px(&self) -> (f64, f64) {
        self.focal_px.map_or(FOCAL_RANGE_PX, |focal_px| (focal_px, focal_px))
    }

    /// These options with this noise and this camera.
    pub fn apply(&self, options: SceneOptions) -> SceneOptions {
        SceneOptions {
            focal_range_px: self.focal_range_px(),
            noise_kind: self.noise_kind.into(),
            principal_point: self.principal_point,
            radial_k1: self.radial_k1,
            zoom: self.zoom,
            ..options
        }
    }
}

/// Reads two numbers with a comma between them.
fn pair(text: &str) -> Result<[f64; 2], String> {
    let number = |text: &str| text.trim().parse::<f64>().map_err(|error| format!("{error} in {}", quoted(text)));
    let (first, second) = text.split_once(',').ok_or("two numbers with a comma between them are expected")?;
    Ok([number(first)?, number(second)?])
}

/// [`Shape`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ShapeArg {
    /// In a box
    Box,
    /// On a tilted plane: no unique reconstruction
    Plane,
}

impl From<ShapeArg> for Shape {
    fn from(shape: ShapeArg) -> Self {
        match shape {
            ShapeArg::Box => Shape::Box,
            ShapeArg::Plane => Shape::Plane,
        }
    }
}

/// [`Motion`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MotionArg {
    /// Rotations and translations at random
    General,
    /// Around the scene, looking at its centre
    Orbit,
    /// Around the scene about one axis
    Turntable,
    /// No rotation between views: no calibration
    PureTranslation,
    /// Along the optical axis, no rotation: no calibration
    Forward,
    /// On a grid across the optical axis, no rotation: no calibration
    Grid,
    /// Rotation about the camera centre: no depth
    PureRotation,
    /// Anywhere on a sphere around the scene, with any roll
    Sphere,
}

impl From<MotionArg> for Motion {
    fn from(motion: MotionArg) -> Self {
        match motion {
            MotionArg::General => Motion::General,
            MotionArg::Orbit => Motion::Orbit,
            MotionArg::Turntable => Motion::Turntable,
            MotionArg::PureTranslation => Motion::PureTranslation,
            MotionArg::Forward => Motion::Forward,
            MotionArg::Grid => Motion::Grid,
            MotionArg::PureRotation => Motion::PureRotation,
            MotionArg::Sphere => Motion::Sphere,
        }
    }
}

/// [`OutlierKind`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum OutlierKindArg {
    /// Points of other outliers in the same view
    Permuted,
    /// Anywhere in the image
    Uniform,
    /// Along the epipolar lines of view 0: right in each pair with it, and in no three views
    Slid,
    /// Off by one constant vector, as where a structure repeats
    Repeated,
}

impl From<OutlierKindArg> for OutlierKind {
    fn from(kind: OutlierKindArg) -> Self {
        match kind {
            OutlierKindArg::Permuted => OutlierKind::Permuted,
            OutlierKindArg::Uniform => OutlierKind::Uniform,
            OutlierKindArg::Slid => OutlierKind::Slid,
            OutlierKindArg::Repeated => OutlierKind::Repeated,
        }
    }
}

/// [`NoiseKind`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum NoiseKindArg {
    /// Gaussian
    Gaussian,
    /// Laplacian, of the same standard deviation
    Laplace,
    /// 90 % Gaussian as above, 10 % of thrice the standard deviation
    Heavy,
    /// Uniform, of the same standard deviation
    Uniform,
}

impl From<NoiseKindArg> for NoiseKind {
    fn from(kind: NoiseKindArg) -> Self {
        match kind {
            NoiseKindArg::Gaussian => NoiseKind::Gaussian,
            NoiseKindArg::Laplace => NoiseKind::Laplace,
            NoiseKindArg::Heavy => NoiseKind::Heavy,
            NoiseKindArg::Uniform => NoiseKind::Uniform,
        }
    }
}
