//! The constants of the continuation, with their reasons.

/// Wrong consensuses leave about as much as they were selected by; right ones, noise. Photographs have wrong tracks
/// near right ones: of one window of ten views, 40 % of the observations that were kept were wrong where the gate was
/// not held below this, and 6 % are.
const SEPARATION: f64 = 0.4;

options! {
    /// When the terms of the objective change, and into what. Figures: mean F1 of `w > 1/2` in 10 views, 200 tracks, .3
    /// % noise, true depths. With all of it 1.0 to 96 %, .994 at 97 %, .911 at 98 % (30 scenes, prototype); figures of
    /// single ablations are over seeds 0 to 9, where the whole has .864 at 98 %. All of these were measured with a gate
    /// of 2.
    pub struct ContinuationOptions {
        /// Share of the iterations after which L_proj has become the rank-4 tail, and from which on L_DAQ moves the
        /// focal length, and the plane at infinity through layers that the weights share. Nothing that is convex in w
        /// is left by then; without the relaxation F1 is .86 at 96 % and .70 at 97 %.
        relaxation_end: f64 = 0.6,
        /// Share of the iterations in which alpha goes from its value then to what the consensus asks for. Without a
        /// ramp the objective would jump. The length is that of the prototype and was not swept.
        alpha_ramp: f64 = 0.12,
        /// Share of the iterations after which the consensus grows by the energy of the tail. Two stretches of a tenth
        /// each: the second measures the noise of what the first has grown to.
        growth_start: f64 = 0.8,
        /// The paper's `t` at the end of the relaxation, as a share of that at the start. From the paper's 15 to 5,
        /// fewer than any set that means something; 5 throughout is as good.
        final_min_inliers: f64 = 1.0 / 3.0,
        /// Cost of a track in the consensus, `alpha · Σ_{k>=5} σ_k / |S|`, that alpha is set to. A track is worth 1
        /// once t is reached: one that costs a good seventh of it stays, one that costs more than it is worth goes.
        cost_per_track: f64 = 0.15,
        /// Tracks at least that alpha is set by. Fewer columns have too little of a tail to measure.
        least_consensus: usize = 8,
        /// Tracks count as consensus there down to this share of the largest weight. Weights are not near 0 and 1 yet:
        /// half of the largest parts them. Of the prototype, not swept.
        consensus_share: f64 = 0.5,
        /// Alpha at most, at the reference shape. Where the tail vanishes, alpha would have no bound.
        most_alpha: f64 = 40.0,
        /// Residual in units of the measured noise at which a track leaves the consensus: with depths, that which noise
        /// exceeds in one of a thousand tracks (2.2 times its median in 3 views, 1.7 in 5, 1.5 in 10), and at least
        /// this. Columns of unit norm differ in noise. F1 at 5 % noise and 96 % wrong tracks: .926 with 2, .962 with
        /// 1.7, .974 with 1.5, .974 with 1.35; at 3 % noise .985, .996, .996, .988 (10 views, 16 seeds each).
        least_gate: f64 = 1.5,
        /// The same with depths of 1, of a consensus of up to [`Self::gate_tracks`]. Ten right tracks among 190 wrong
        /// ones: with 4, F1 at 95 % wrong tracks is .958 for .991.
        gate_without_depths: f64 = 3.0,
        /// What is added to that for each ten times as many tracks, as far as the residual stays below the separation.
        /// What perspective leaves has a longer tail than noise, and a larger consensus tells its span better. F1 at
        /// 50, 80 and 90 % wrong tracks (20 seeds): .971, .972 and .982 without it, .995, .988 and .983 with it.
        gate_per_decade: f64 = 2.0,
        gate_tracks: f64 = 10.0,
        /// Residual, as a share of what wrong tracks leave, below which a consensus stands apart.
        separation: f64 = SEPARATION,
        /// What the first half of the growth multiplies either by.
        first_gate_factor: f64 = 1.25,
        /// Bounds of that residual. Below, the exact rank of a set of five or six would shut every other track out;
        /// above, wrong ones pass.
        tolerance: (f64, f64) = (0.02, 0.25),
        /// The same as a share of what wrong tracks leave. Tracks that reach half of it on average do not stand apart
        /// any more: beyond, a consensus could not be told from a wrong one. Without it, all of 200 wrong tracks are
        /// kept in one of ten scenes without a right one.
        wrong_share: f64 = 2.0 * SEPARATION,
        /// Shape of the matrix that every alpha is for: columns over rows beyond rank 4. 10 views and 200 tracks.
        /// Singular values of wrong columns grow as the square root of their number.
        reference_shape: f64 = 200.0 / 26.0,
        /// Slope below 0 of the rectifiers in the segmentation head. With ReLU features of the few right tracks die
        /// before the consensus is found.
        leak: f64 = 0.1,
    }
}
