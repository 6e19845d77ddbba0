//! The thresholds of the portfolio, with their reasons.

/// How a block is searched, and what decides between consensuses.
#[derive(Debug, Clone, PartialEq)]
pub struct PortfolioOptions {
    /// Rounds of a search, and of a quick one.
    pub rounds: u32,
    pub quick_rounds: u32,
    /// Round, counted from 0, from which heads of the network are optimised, and rounds after which there is another.
    pub first_head_round: u32,
    pub rounds_per_head: u32,
    /// Samples a round, of a proposal and of uniform sampling, without depths and with.
    pub affine_samples: (usize, usize),
    pub subspace_samples: (usize, usize),
    /// Hypotheses a round and proposal that are grown.
    pub shortlist: usize,
    /// Noise that each round grows at, in units of what is assumed; they repeat.
    pub noise_ladder: [f64; 8],
    /// Consensuses of near-duplicates after which a search is over.
    pub most_near_duplicates: usize,
    /// Gain in the logarithm of the false alarms below which two consensuses are the same.
    pub ln_margin: f64,
    /// Share of the accepted consensus's inliers and certainty that counts as having found it.
    pub sufficient_share: f64,
}

impl PortfolioOptions {
    pub const DEFAULT: Self = Self {
        // Every noise of the ladder twice.
        rounds: 16,
        // The noise as assumed, which is rather too high.
        quick_rounds: 1,
        // Once all that is cheaper has decided nothing at any noise of the ladder. Two heads, each verified at four of
        // the noises: four found no more (5 to 11 % noise, two scenes each).
        first_head_round: 8,
        rounds_per_head: 4,
        // A sample costs microseconds.
        affine_samples: (2_000, 6_000),
        subspace_samples: (250, 1_000),
        shortlist: 2,
        // Every other round at more noise than assumed, doubling up to sixteen times: a level that is twice too low
        // loses the scene, and the caller may have given none.
        noise_ladder: [1.0, 2.0, 1.0, 4.0, 1.0, 8.0, 1.0, 16.0],
        // Whatever includes one of so many explains all of it, and outbids what is right.
        most_near_duplicates: 4,
        // A single track more changes it by tens.
        ln_margin: 5.0,
        sufficient_share: 0.95,
    };
}
