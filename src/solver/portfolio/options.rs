//! The thresholds of the portfolio, with their reasons.

/// How a block is searched, and what decides between consensuses.
#[derive(Debug, Clone, PartialEq)]
pub struct PortfolioOptions {
    /// Network iterations between two verifications of its ranking.
    pub iterations_per_round: u32,
    /// Rounds without a network, and those of a quick search.
    pub rounds_without_network: u32,
    pub quick_rounds: u32,
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
        iterations_per_round: 25,
        // As many samples as the longest search with one.
        rounds_without_network: 16,
        // The noise as assumed, which is rather too high.
        quick_rounds: 1,
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
