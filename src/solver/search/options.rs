//! The thresholds of the searches, with their reasons.

use crate::solver::calibration::CalibrationOptions;

/// How samples are drawn and scored, without depths and with.
#[derive(Debug, Clone, PartialEq)]
pub struct SamplingOptions {
    /// Share of the sampling weight that is spread over all tracks alike, whatever the prior says.
    pub uniform_share: f64,
    pub affine: AffineOptions,
    pub subspace: SubspaceOptions,
}

impl SamplingOptions {
    pub const DEFAULT: Self =
        Self { uniform_share: 0.1, affine: AffineOptions::DEFAULT, subspace: SubspaceOptions::DEFAULT };
}

/// How affine models of image points are searched for.
#[derive(Debug, Clone, PartialEq)]
pub struct AffineOptions {
    /// Tolerance of the truncated score in units of a view's spread (1.5 median absolute deviations).
    pub tolerance: f64,
    /// Sizes of the supports that a hypothesis is factorised from.
    pub support_sizes: [usize; 2],
    /// Samples between two looks at the stop token.
    pub samples_per_look: usize,
    /// Shortest direction that still spans, in units of a view's spread.
    pub least_direction: f64,
}

impl AffineOptions {
    pub const DEFAULT: Self = Self {
        // Perspective makes right tracks deviate from affine by some tenths of a view's spread.
        tolerance: 0.2,
        // Eight keeps out the wrong tracks, twelve conditions the factorisation: each wins on some scenes.
        support_sizes: [8, 12],
        // They take about a millisecond at 10 views and 200 tracks.
        samples_per_look: 256,
        least_direction: 1e-6,
    };
}

/// How column spaces of the measurement matrix are searched for.
#[derive(Debug, Clone, PartialEq)]
pub struct SubspaceOptions {
    /// Tolerance of the residual (sine of the angle to the subspace) in units of the noise.
    pub tolerance_per_noise: f64,
    /// Bounds of that tolerance.
    pub tolerance_bounds: (f64, f64),
    /// Tolerances of the local optimisation, in units of the final one, and the refits at each of them.
    pub local_tolerances: [f64; 3],
    pub local_rounds: usize,
    /// Weight of the DAQ residual in a hypothesis's cost, in columns.
    pub daq_weight: f64,
    /// Samples between two looks at the stop token.
    pub samples_per_look: usize,
}

impl SubspaceOptions {
    pub const DEFAULT: Self = Self {
        // From the ratio of residual to noise of right columns, with a margin of two.
        tolerance_per_noise: 4.0,
        // Below, numerics; above, everything is close to a 4-dimensional subspace.
        tolerance_bounds: (1e-4, 0.25),
        local_tolerances: [2.0, 1.5, 1.0],
        local_rounds: 4,
        // The residual, not the count, tells a right set of four from a chance one: mean F1 .68 -> .975 at 98 %
        // outliers.
        daq_weight: 20.0,
        samples_per_look: 8,
    };
}

/// How rigid sets of tracks are searched for by their depths.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidOptions {
    pub graph: RigidGraphOptions,
    /// Standard deviation of a distance over the views, in units of the noise times the depth, below which a pair is
    /// rigid.
    pub pair_tolerance: f64,
    /// The same as a share of the depth that the steps of the focal lengths leave to exact pairs.
    pub grid_tolerance: f64,
    /// Spreads of relative depths that are believed.
    pub depth_spreads: (f64, f64),
    /// Best focal lengths, and best-connected cores of each, that a consensus is grown from.
    pub focals_grown: usize,
    pub cores_grown: usize,
    /// Noise that a core is grown at, in units of that its pairs were rigid at.
    pub grown_noise: [f64; 3],
    /// Logarithm of the expected number of false alarms at which the search ends.
    pub ln_never_chance: f64,
    /// Rounds of re-estimating the noise, and the least that is believed.
    pub noise_rounds: usize,
    pub least_noise: f64,
    /// Inflations of the gate while a consensus grows.
    pub gates: [f64; 6],
    /// Steps of the golden section on the log focal length, and its half width.
    pub focal_steps: usize,
    pub focal_half_width: f64,
    /// Tracks that the golden section uses.
    pub focal_tracks: usize,
}

impl RigidOptions {
    pub const DEFAULT: Self = Self {
        graph: RigidGraphOptions::DEFAULT,
        // A distance has the noise of two points in up to three coordinates, and the grid adds to it.
        pair_tolerance: 3.0,
        grid_tolerance: 0.005,
        // Below, the scene is a plane that faces all cameras, which must not make chance look impossible; above, depths
        // mean nothing.
        depth_spreads: (1e-3, 0.5),
        // The right ones were among the first on every scene that was looked at; the others are for strong noise.
        focals_grown: 3,
        cores_grown: 4,
        // Strict pairs keep chance out of a core, a wide gate lets the right tracks in.
        grown_noise: [1.0, 2.0, 4.0],
        // Far beyond what decides, for a better core costs little.
        ln_never_chance: -100.0,
        noise_rounds: 3,
        // The same that a calibration uses at least.
        least_noise: CalibrationOptions::DEFAULT.fit.least_noise,
        gates: [64.0, 16.0, 4.0, 1.0, 1.0, 1.0],
        focal_steps: 10,
        // Two steps of the grid.
        focal_half_width: 0.18,
        // Their distances tell the focal length well enough to gate by.
        focal_tracks: 12,
    };
}

/// Which pairs of tracks are rigid, and which sets of them are a core.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidGraphOptions {
    /// Focal lengths that are tried.
    pub focals: usize,
    /// Distance in tolerances below which a pair says nothing.
    pub least_distance: f64,
    /// Share of a core that a track must be rigid with to join it.
    pub core_share: f64,
    /// Tracks of a core at most.
    pub most_core: usize,
}

impl RigidGraphOptions {
    pub const DEFAULT: Self = Self {
        // A grid whose steps of 9 % change a distance by less than a length tolerance allows.
        focals: 33,
        // Near points are near in every view, right or wrong.
        least_distance: 3.0,
        // At the gate's width a right pair is missed now and then.
        core_share: 0.75,
        // More do not make the poses better to start from.
        most_core: 30,
    };
}
