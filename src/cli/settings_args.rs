//! How to solve, as arguments.

use clap::{Args, ValueEnum};

use super::args::parse_whole;
use super::exit::Failure;
use crate::domain::{Backend, Method, SolveSettings};

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
        does up to 16 of them, `paper` one, `auto` usually none [default: {}]",
        SolveSettings::MAX_ITERATIONS, SolveSettings::DEFAULT_ITERATIONS),
        value_parser = clap::value_parser!(u32).range(1..=i64::from(SolveSettings::MAX_ITERATIONS)))]
    pub iterations: Option<u32>,

    /// Leave the DAQ residual (self-calibration) out of the losses and scores
    #[arg(long)]
    pub no_daq: bool,

    /// With `paper`, `scpsfm` and `psfm`, for an input without depths: estimate projective depths from fundamental
    /// matrices and epipoles, instead of taking them as 1; needs about half of the tracks to be right
    #[arg(long)]
    pub epipolar_depths: bool,

    /// Noise of the observations in pixels, one standard deviation, where known: a start, the noise is estimated; more
    /// than twice as much is HIGH_NOISE [default: .5 % of the longest image side]
    #[arg(long, value_name = "PX")]
    pub noise_px: Option<f64>,

    /// A focal length a view (a zoom) instead of one for all: the grade is WEAK at best then, all views share one lens,
    /// and camera groups and focal lengths known beforehand are not looked at
    #[arg(long, conflicts_with = "focal_px")]
    pub focal_per_view: bool,

    /// Tensor backend of the network [default: flex, or what the server is configured with]
    #[arg(long, value_enum)]
    pub backend: Option<BackendArg>,

    #[arg(long, hide_short_help = true, help = format!("Weight of the loss L_proj at the first iteration; with \
        `paper`, at every iteration [default: {}; paper: {}]",
        SolveSettings::DEFAULT_ALPHA, SolveSettings::PAPER_ALPHA))]
    pub alpha: Option<f64>,

    #[arg(long, hide_short_help = true, help = format!("Weight of the loss L_DAQ [default: {}]",
        SolveSettings::DEFAULT_BETA))]
    pub beta: Option<f64>,

    #[arg(long, hide_short_help = true, value_name = "T", help = format!("Least number of inliers that the loss L_num \
        asks for (the paper's t) at the first iteration; with `paper`, at every iteration [default: {}]",
        SolveSettings::DEFAULT_MIN_INLIERS))]
    pub min_inliers: Option<f64>,

    #[arg(long, hide_short_help = true, help = format!("Slope of the sigmoid in L_num, with `paper` only; 1 is as \
        printed and may let all weights collapse to 0 [default: {}]", SolveSettings::DEFAULT_KAPPA))]
    pub kappa: Option<f64>,

    #[arg(long, hide_short_help = true, value_name = "RATE", help = format!("Learning rate of Adam [default: {}]",
        SolveSettings::DEFAULT_LEARNING_RATE))]
    pub learning_rate: Option<f64>,

    #[arg(long, hide_short_help = true, value_name = "SHARE", help = format!("Width of the network as a share of the \
        original PointNet [default: {}]", SolveSettings::DEFAULT_NETWORK_WIDTH))]
    pub network_width: Option<f64>,
}

/// Methods that optimise the network on the input.
const OF_NETWORK: &[MethodArg] = &[MethodArg::Auto, MethodArg::Paper, MethodArg::Scpsfm];

impl SettingsArgs {
    /// The settings, checked.
    ///
    /// # Errors
    /// A value out of range, and a flag that changes nothing with the method, as wrong usage.
    pub fn settings(&self) -> Result<SolveSettings, Failure> {
        let method = self.method.into();
        let defaults = SolveSettings::of_method(method);
        let settings = SolveSettings {
            method,
            use_daq: !self.no_daq,
            alpha: self.alpha.unwrap_or(defaults.alpha),
            beta: self.beta.unwrap_or(defaults.beta),
            min_inliers: self.min_inliers.unwrap_or(defaults.min_inliers),
            kappa: self.kappa.unwrap_or(defaults.kappa),
            learning_rate: self.learning_rate.unwrap_or(defaults.learning_rate),
            iterations: self.iterations.unwrap_or(defaults.iterations),
            network_width: self.network_width.unwrap_or(defaults.network_width),
            epipolar_depths: self.epipolar_depths,
            seed: self.seed,
            noise_px: self.noise_px,
            focal_per_view: self.focal_per_view,
            backend: self.backend.map(Backend::from),
            ..defaults
        };
        settings.validate().map_err(|invalid| Failure::of_flags(&invalid))?;
        self.check_use()?;
        Ok(settings)
    }

    /// Refuses flags that change nothing with the method.
    fn check_use(&self) -> Result<(), Failure> {
        use MethodArg::{Auto, Geometry, Paper, Psfm, Scpsfm};
        let flags: [(&str, bool, &[MethodArg]); 9] = [
            ("--epipolar-depths", self.epipolar_depths, &[Paper, Scpsfm, Psfm]),
            ("--no-daq", self.no_daq, &[Auto, Paper, Scpsfm, Geometry]),
            ("--kappa", self.kappa.is_some(), &[Paper]),
            ("--alpha", self.alpha.is_some(), OF_NETWORK),
            ("--beta", self.beta.is_some(), OF_NETWORK),
            ("--min-inliers", self.min_inliers.is_some(), OF_NETWORK),
            ("--learning-rate", self.learning_rate.is_some(), OF_NETWORK),
            ("--network-width", self.network_width.is_some(), OF_NETWORK),
            ("--iterations", self.iterations.is_some(), OF_NETWORK),
        ];
        match flags.into_iter().find(|(_, is_given, methods)| *is_given && !methods.contains(&self.method)) {
            Some((flag, _, methods)) => {
                let values = methods.iter().filter_map(MethodArg::to_possible_value);
                let names: Vec<String> = values.map(|value| value.get_name().to_owned()).collect();
                Err(Failure::usage(format_args!("{flag} is of use with --method {} only", names.join(", "))))
            }
            None => Ok(()),
        }
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
