//! How to solve: the method and its parameters, with the reason for every default.

use serde::{Deserialize, Serialize};

use super::error::{InvalidInput, Violation, Violations};

named! {
    /// Which tracks are right is decided by...
    #[derive(Default)]
    pub enum Method {
        /// ...the network's prior and geometry together: the network proposes, geometry disposes.
        #[default]
        Auto = "AUTO",
        /// ...the paper's network under the paper's objective as printed: its weights, thresholded at 1/2.
        Paper = "PAPER",
        /// ...geometry alone, no network.
        Geometry = "GEOMETRY",
        /// ...plain projective factorisation (Sturm & Triggs 1996) with a residual threshold.
        Psfm = "PSFM",
        /// ...the paper's network by itself under a continued objective: the weights of the best of several optimisations,
        /// thresholded at 1/2.
        Scpsfm = "SCPSFM",
    }
}

impl Method {
    /// Whether the method optimises the network.
    pub fn uses_network(self) -> bool {
        matches!(self, Method::Auto | Method::Paper | Method::Scpsfm)
    }
}

/// What proposed the tracks that the accepted hypothesis was sampled from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Proposal {
    /// The weights of the network that is optimised on the request.
    Network,
    /// Iteratively reweighted least squares on the subspace.
    Irls,
    /// Agreement of a track's motion over the views.
    Consistency,
    /// Distances between tracks that stay the same in all views; where depths are given.
    Rigidity,
    /// The network that was trained beforehand, see `scpsfm train-prior`.
    Learned,
    /// None: uniform sampling.
    Uniform,
}

impl Proposal {
    /// Every proposal.
    pub const ALL: [Proposal; 6] = [
        Proposal::Learned,
        Proposal::Network,
        Proposal::Irls,
        Proposal::Consistency,
        Proposal::Rigidity,
        Proposal::Uniform,
    ];

    /// The proposal's name in files, metrics and logs.
    pub fn name(self) -> &'static str {
        match self {
            Proposal::Network => "network",
            Proposal::Irls => "irls",
            Proposal::Consistency => "consistency",
            Proposal::Rigidity => "rigidity",
            Proposal::Learned => "learned",
            Proposal::Uniform => "uniform",
        }
    }
}

/// Tensor backend that the network runs on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// `burn-flex`, the faster of the two.
    #[default]
    Flex,
    /// `burn-ndarray`, which burn deprecates in favour of flex.
    Ndarray,
}

/// How one job is solved. Every field has a default with its reason; see the associated constants.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SolveSettings {
    pub method: Method,
    /// Whether the DAQ residual takes part: as a loss of the network and as a score of hypotheses.
    pub use_daq: bool,
    /// Weight of L_proj at the first iteration of a head; by PAPER, at every iteration.
    pub alpha: f64,
    /// Weight of L_DAQ.
    pub beta: f64,
    /// Least number of inliers that L_num asks for, the paper's `t`, at the first iteration of a head; by PAPER, at
    /// every iteration.
    pub min_inliers: f64,
    /// Slope of the sigmoid in L_num of PAPER; the other methods have no such sigmoid.
    pub kappa: f64,
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Iterations of each head of the network.
    pub iterations: u32,
    /// Width of the PointNet as a share of the original (64-64-64-128-1024).
    pub network_width: f64,
    /// Whether PAPER, SCPSFM and PSFM estimate projective depths from fundamental matrices and epipoles where the input
    /// brings none, as the paper does on real tracks; otherwise such depths are 1. The other methods need none, and an
    /// input's own depths are never replaced: there it changes nothing.
    pub epipolar_depths: bool,
    /// Seed of every random choice: one seed, one answer.
    pub seed: u64,
    /// What the caller believes the observation noise to be, one standard deviation in pixels. A start, not a
    /// verdict: the noise is estimated from the data.
    pub noise_px: Option<f64>,
    /// Whether every view has a focal length of its own (a zoom), instead of one constant calibration for all. The DAQ
    /// residual, which asks for constancy, takes no part then, nor do focal priors.
    pub focal_per_view: bool,
    /// Interim weights every so many network iterations; 0: never.
    pub weights_every: u32,
    /// Backend of the network; `None` takes the server's.
    pub backend: Option<Backend>,
    /// Proposals that AUTO and GEOMETRY leave out: for ablations, not for callers, who are not shown it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub excluded_proposals: Vec<Proposal>,
}

impl SolveSettings {
    /// Where the continuation starts; see [`crate::network`] for what follows.
    pub const DEFAULT_ALPHA: f64 = 10.0;
    /// The paper's value.
    pub const PAPER_ALPHA: f64 = 1.0;
    /// The paper's value.
    pub const DEFAULT_BETA: f64 = 1.0;
    /// The paper's value.
    pub const DEFAULT_MIN_INLIERS: f64 = 15.0;
    /// The paper's sigmoid has no slope. All weights may collapse to 0; with 20 to 50 they do not.
    pub const DEFAULT_KAPPA: f64 = 1.0;
    /// The paper's value.
    pub const DEFAULT_LEARNING_RATE: f64 = 1e-3;
    /// The weights converge within 300 to 500 iterations.
    pub const DEFAULT_ITERATIONS: u32 = 500;
    /// A quarter of the PointNet (about 1e5 parameters) ranks tracks as well as the whole (1.5e6) at a fraction of
    /// the time.
    pub const DEFAULT_NETWORK_WIDTH: f64 = 0.25;
    /// Iterations that one job may ask for: 25 times the default; more is a slip of the finger.
    pub const MAX_ITERATIONS: u32 = 10_000;
    /// Twice the original PointNet, beyond which memory grows and nothing was ever gained.
    pub const MAX_NETWORK_WIDTH: f64 = 2.0;

    /// Adam moves every weight by about the rate at each step: above this nothing converges.
    pub const MAX_LEARNING_RATE: f64 = 1.0;

    /// Noise in pixels above which another unit was meant: solvers assume a tenth of the image at most, and no image is
    /// ten times as long.
    pub const MAX_NOISE_PX: f64 = 10_000.0;

    /// The defaults of a method.
    pub fn of_method(method: Method) -> Self {
        Self { method, alpha: Self::default_alpha(method), ..Self::default() }
    }

    /// Weight of L_proj where none is asked for.
    pub fn default_alpha(method: Method) -> f64 {
        match method {
            Method::Paper => Self::PAPER_ALPHA,
            Method::Auto | Method::Scpsfm | Method::Geometry | Method::Psfm => Self::DEFAULT_ALPHA,
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// Each violation names its field as `settings.<field>`.
    pub fn validate(&self) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        let mut positive = |name: &str, value: f64| {
            if !(value.is_finite() && value > 0.0) {
                found.push(Violation::of(
                    format!("job.settings.{name}"),
                    format!("{value} is not a positive finite number"),
                ));
            }
        };
        positive("alpha", self.alpha);
        positive("min_inliers", self.min_inliers);
        positive("kappa", self.kappa);
        positive("learning_rate", self.learning_rate);
        positive("network_width", self.network_width);
        if let Some(noise_px) = self.noise_px {
            positive("noise_px", noise_px);
        }
        if !(self.beta.is_finite() && self.beta >= 0.0) {
            found.push(Violation::of("job.settings.beta", format!("{} is not a finite number >= 0", self.beta)));
        }
        if self.network_width > Self::MAX_NETWORK_WIDTH {
            found.push(Violation::of(
                "job.settings.network_width",
                format!("{} is above the largest width {}", self.network_width, Self::MAX_NETWORK_WIDTH),
            ));
        }
        if self.learning_rate > Self::MAX_LEARNING_RATE {
            found.push(Violation::of(
                "job.settings.learning_rate",
                format!("{} is above the largest rate {}", self.learning_rate, Self::MAX_LEARNING_RATE),
            ));
        }
        if let Some(noise_px) = self.noise_px.filter(|noise_px| *noise_px > Self::MAX_NOISE_PX) {
            found.push(Violation::of(
                "job.settings.noise_px",
                format!("{noise_px} is above the largest noise {}, in pixels", Self::MAX_NOISE_PX),
            ));
        }
        if self.iterations == 0 || self.iterations > Self::MAX_ITERATIONS {
            found.push(Violation::of(
                "job.settings.iterations",
                format!("{} is not in 1..={}", self.iterations, Self::MAX_ITERATIONS),
            ));
        }
        found.into_result()
    }
}

impl Default for SolveSettings {
    fn default() -> Self {
        Self {
            method: Method::default(),
            use_daq: true,
            alpha: Self::DEFAULT_ALPHA,
            beta: Self::DEFAULT_BETA,
            min_inliers: Self::DEFAULT_MIN_INLIERS,
            kappa: Self::DEFAULT_KAPPA,
            learning_rate: Self::DEFAULT_LEARNING_RATE,
            iterations: Self::DEFAULT_ITERATIONS,
            network_width: Self::DEFAULT_NETWORK_WIDTH,
            // Half of the tracks must be right: mean F1 of PAPER over four scenes (10 views, 200 tracks) is .42 for .00
            // with depths of 1 at 30 % outliers, .55 for .05 at 50 %, .30 for .24 at 70 %, but .31 for .99 at 90 %.
            epipolar_depths: false,
            seed: 0,
            noise_px: None,
            focal_per_view: false,
            weights_every: 0,
            backend: None,
            excluded_proposals: Vec::new(),
        }
    }
}
