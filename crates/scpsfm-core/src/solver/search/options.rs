//! The thresholds of the searches, with their reasons.

use crate::solver::calibration::CalibrationOptions;

options! {
    /// How samples are drawn and scored, without depths and with.
    pub struct SamplingOptions {
        /// Share of the sampling weight that is spread over all tracks alike, whatever the prior says.
        uniform_share: f64 = 0.1,
        affine: AffineOptions = AffineOptions::DEFAULT,
        subspace: SubspaceOptions = SubspaceOptions::DEFAULT,
    }
}

options! {
    /// How affine models of image points are searched for.
    pub struct AffineOptions {
        /// Tolerance of the truncated score in units of a view's spread (1.5 median absolute deviations). Perspective
        /// makes right tracks deviate from affine by some tenths of a view's spread.
        tolerance: f64 = 0.2,
        /// Sizes of the supports that a hypothesis is factorised from. Eight keeps out the wrong tracks, twelve
        /// conditions the factorisation: each wins on some scenes.
        support_sizes: [usize; 2] = [8, 12],
        /// Samples between two looks at the stop token. They take about a millisecond at 10 views and 200 tracks.
        samples_per_look: usize = 256,
        /// Shortest direction that still spans, in units of a view's spread.
        least_direction: f64 = 1e-6,
    }
}

options! {
    /// How column spaces of the measurement matrix are searched for.
    pub struct SubspaceOptions {
        /// Tolerance of the residual (sine of the angle to the subspace) in units of the noise. From the ratio of
        /// residual to noise of right columns, with a margin of two.
        tolerance_per_noise: f64 = 4.0,
        /// Bounds of that tolerance. Below, numerics; above, everything is close to a 4-dimensional subspace.
        tolerance_bounds: (f64, f64) = (1e-4, 0.25),
        /// Tolerances of the local optimisation, in units of the final one, and the refits at each of them.
        local_tolerances: [f64; 3] = [2.0, 1.5, 1.0],
        local_rounds: usize = 4,
        /// Weight of the DAQ residual in a hypothesis's cost, in columns. The residual, not the count, tells a right
        /// set of four from a chance one: mean F1 .68 -> .975 at 98 % outliers.
        daq_weight: f64 = 20.0,
        /// Samples between two looks at the stop token.
        samples_per_look: usize = 8,
    }
}

options! {
    /// How rigid sets of tracks are searched for by their depths.
    pub struct RigidOptions {
        graph: RigidGraphOptions = RigidGraphOptions::DEFAULT,
        /// Standard deviation of a distance over the views, in units of the noise times the depth, below which a pair
        /// is rigid. A distance has the noise of two points in up to three coordinates, and the grid adds to it.
        pair_tolerance: f64 = 3.0,
        /// The same as a share of the depth that the steps of the focal lengths leave to exact pairs.
        grid_tolerance: f64 = 0.005,
        /// Spreads of relative depths that are believed. Below, the scene is a plane that faces all cameras, which must
        /// not make chance look impossible; above, depths mean nothing.
        depth_spreads: (f64, f64) = (1e-3, 0.5),
        /// Best focal lengths, and best-connected cores of each, that a consensus is grown from. The right ones were
        /// among the first on every scene that was looked at; the others are for strong noise.
        focals_grown: usize = 3,
        cores_grown: usize = 4,
        /// Noise that a core is grown at, in units of that its pairs were rigid at. Strict pairs keep chance out of a
        /// core, a wide gate lets the right tracks in.
        grown_noise: [f64; 3] = [1.0, 2.0, 4.0],
        /// Logarithm of the expected number of false alarms at which the search ends. Far beyond what decides, for a
        /// better core costs little.
        ln_never_chance: f64 = -100.0,
        /// Rounds of re-estimating the noise, and the least that is believed.
        noise_rounds: usize = 3,
        /// The same that a calibration uses at least.
        least_noise: f64 = CalibrationOptions::DEFAULT.fit.least_noise,
        /// Inflations of the gate while a consensus grows.
        gates: [f64; 6] = [64.0, 16.0, 4.0, 1.0, 1.0, 1.0],
        /// Steps of the golden section on the log focal length, and its half width.
        focal_steps: usize = 10,
        /// Two steps of the grid.
        focal_half_width: f64 = 0.18,
        /// Tracks that the golden section uses. Their distances tell the focal length well enough to gate by.
        focal_tracks: usize = 12,
    }
}

options! {
    /// Which pairs of tracks are rigid, and which sets of them are a core.
    pub struct RigidGraphOptions {
        /// Focal lengths that are tried. A grid whose steps of 9 % change a distance by less than a length tolerance
        /// allows.
        focals: usize = 33,
        /// Distance in tolerances below which a pair says nothing. Near points are near in every view, right or wrong.
        least_distance: f64 = 3.0,
        /// Share of a core that a track must be rigid with to join it. At the gate's width a right pair is missed now
        /// and then.
        core_share: f64 = 0.75,
        /// Tracks of a core at most. More do not make the poses better to start from.
        most_core: usize = 30,
    }
}
