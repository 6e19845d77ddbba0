//! The thresholds of the portfolio, with their reasons.

options! {
    /// How a block is searched, and what decides between consensuses.
    pub struct PortfolioOptions {
        /// Rounds of a search: every noise of the ladder twice.
        rounds: u32 = 16,
        /// Of a quick one: the noise as assumed, which is rather too high.
        quick_rounds: u32 = 1,
        /// Round, counted from 0, from which heads of the network are optimised, and rounds after which there is
        /// another. Once all that is cheaper has decided nothing at any noise of the ladder. Two heads, each verified
        /// at four of the noises: four found no more (5 to 11 % noise, two scenes each).
        first_head_round: u32 = 8,
        rounds_per_head: u32 = 4,
        /// Samples a round, of a proposal and of uniform sampling, without depths and with. A sample costs
        /// microseconds.
        affine_samples: (usize, usize) = (2_000, 6_000),
        subspace_samples: (usize, usize) = (250, 1_000),
        /// Hypotheses a round and proposal that are grown.
        shortlist: usize = 2,
        /// Noise that each round grows at, in units of what is assumed; they repeat. Every other round at more noise
        /// than assumed, doubling up to sixteen times: a level that is twice too low loses the scene, and the caller
        /// may have given none.
        noise_ladder: [f64; 8] = [1.0, 2.0, 1.0, 4.0, 1.0, 8.0, 1.0, 16.0],
        /// Consensuses of near-duplicates after which a search is over. Whatever includes one of so many explains all
        /// of it, and outbids what is right.
        most_near_duplicates: usize = 4,
        /// Gain in the logarithm of the false alarms below which two consensuses are the same. A single track more
        /// changes it by tens.
        ln_margin: f64 = 5.0,
        /// Share of the accepted consensus's inliers and certainty that counts as having found it.
        sufficient_share: f64 = 0.95,
    }
}
