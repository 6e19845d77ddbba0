//! What the trained network says of a block, in the forms that the search takes.
//!
//! The network knows thousands of scenes and nothing of this one but its image points: what it believes in, geometry
//! must verify. What it disbelieves counts only where geometry has little to go by ([`TrackScores::counted`]). What its
//! odds are worth in the score of hypotheses comes from `scpsfm evaluate --priors --sweep`.

use super::consensus::LEAST_INLIERS;
use crate::domain::{Method, Proposal, SolveSettings};
use crate::geometry::measurement::CompleteBlock;
use crate::network::subspace::{self, Cloud, MOST_VIEWS};

options! {
    /// What the network's odds are worth.
    pub struct TrackScoreOptions {
        /// Logit that stands for even odds. Training counts the few right tracks of a scene more than the many wrong
        /// ones, by the square root of the odds against them: at 95 % outliers that adds 1.5 to every logit.
        even_logit: f64 = 1.5,
        /// Cost by which one nat of the odds widens the truncation of a track's cost in the affine search, in units of
        /// the truncated cost of a track at even odds.
        cost_per_nat: f64 = 0.15,
        /// Nats that count at most, either way. Beyond, the network's confidence was not earned on scenes like this
        /// one.
        most_nats: f64 = 5.0,
        /// Logit above which a track belongs to the set that growing is started from, and the bounds of that set's
        /// size.
        start_logit: f64 = 1.0,
        /// What determines the cameras, and what a first adjustment can carry.
        start_sizes: (usize, usize) = (8, 60),
        /// Share of likely tracks above which a scene has statistics of its own. From a third on, reweighting and
        /// consistency rank right tracks first (average precision above .99 on real matches).
        many: f64 = 1.0 / 3.0,
        /// Tracks that must be likely right before a ranking without verification is worth telling. Entirely wrong
        /// input has up to three by chance.
        least_likely: usize = 4,
        /// Inliers from which on geometry needs no second opinion. Twice what it needs for any.
        surely_enough: usize = 2 * LEAST_INLIERS,
        /// Odds against a track, in nats, at which it is held to be wrong. Twenty to one.
        rejection_nats: f64 = 3.0,
        /// Tracks below which the network's doubts do not count. Scenes have no fewer, and of ten right tracks alone
        /// the network takes but a few to be right.
        least_judged: usize = 50,
    }
}

const OPTIONS: TrackScoreOptions = TrackScoreOptions::DEFAULT;

/// Whether these settings let the search ask the network.
pub fn may_be_asked(settings: &SolveSettings) -> bool {
    settings.method == Method::Auto && !settings.excluded_proposals.contains(&Proposal::Learned)
}

/// The network's scores of some tracks.
#[derive(Debug, Clone)]
pub struct TrackScores {
    /// Natural logarithms of the odds that a track is right.
    ln_odds: Vec<f64>,
}

impl TrackScores {
    /// Asks the network; `None` where there are more views than it is asked about, or it has no finite answer.
    pub fn of(block: &CompleteBlock) -> Option<Self> {
        let (views, count) = (block.views(), block.tracks());
        if views > MOST_VIEWS {
            return None;
        }
        let mut points = vec![[0.0; 2]; views * count];
        for track in 0..count {
            block.track(track).iter().for_each(|seen| points[seen.view * count + track] = seen.xy.into());
        }
        let scores = subspace::current().network.forward(&Cloud::new(views, count, &points, &vec![true; points.len()]));
        let ln_odds: Vec<f64> = scores.tracks.iter().map(|&logit| f64::from(logit) - OPTIONS.even_logit).collect();
        // A network of finite numbers may still overflow; one that says nothing is not asked.
        ln_odds.iter().all(|odds| odds.is_finite()).then_some(Self { ln_odds })
    }

    /// Logarithms of the odds that each track is right.
    pub fn ln_odds(&self) -> &[f64] {
        &self.ln_odds
    }

    /// Probability of every track to be right.
    pub fn probabilities(&self) -> Vec<f64> {
        self.ln_odds.iter().map(|odds| 1.0 / (1.0 + (-odds).exp())).collect()
    }

    /// What it costs a hypothesis of the affine search to leave a track out, 1 at even odds.
    pub fn truncations(&self) -> Vec<f64> {
        self.truncations_at(OPTIONS.cost_per_nat)
    }

    /// The same at another cost of a nat.
    pub fn truncations_at(&self, per_nat: f64) -> Vec<f64> {
        self.ln_odds.iter().map(|odds| 1.0 + per_nat * odds.clamp(-OPTIONS.most_nats, OPTIONS.most_nats)).collect()
    }

    /// The tracks to grow from without any search, most likely first.
    pub fn start(&self) -> Vec<usize> {
        let mut ranked: Vec<usize> = (0..self.ln_odds.len()).collect();
        ranked.sort_by(|&a, &b| self.ln_odds[b].total_cmp(&self.ln_odds[a]).then(a.cmp(&b)));
        let likely =
            ranked.iter().filter(|&&track| self.ln_odds[track] + OPTIONS.even_logit > OPTIONS.start_logit).count();
        ranked.truncate(likely.clamp(OPTIONS.start_sizes.0, OPTIONS.start_sizes.1));
        ranked
    }

    /// Whether it takes many of the tracks to be right.
    pub fn expects_many(&self) -> bool {
        self.likely() as f64 > OPTIONS.many * self.ln_odds.len() as f64
    }

    /// How many tracks it holds to be right.
    pub fn likely(&self) -> usize {
        self.ln_odds.iter().filter(|odds| **odds > 0.0).count()
    }

    /// How many of these inliers count towards those that geometry needs for a verification.
    ///
    /// With few of them the cameras are flexible enough to take up a wrong one or two; then those that the network
    /// holds to be wrong do not count. With many, or where there are fewer tracks than it has ever been shown, geometry
    /// alone has the word.
    pub fn counted(&self, inliers: &[usize]) -> usize {
        if inliers.len() >= OPTIONS.surely_enough || self.ln_odds.len() < OPTIONS.least_judged {
            return inliers.len();
        }
        inliers.iter().filter(|&&track| self.ln_odds[track] > -OPTIONS.rejection_nats).count()
    }

    /// Whether enough tracks are likely right for their ranking to be reported where geometry verifies none.
    pub fn ranks(&self) -> bool {
        self.likely() >= OPTIONS.least_likely
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_opinion_is_told_in_every_form() {
        let of = |ln_odds: Vec<f64>| TrackScores { ln_odds };
        let track_scores = of(vec![-20.0, 0.0, 20.0, 1.0]);
        let probabilities = track_scores.probabilities();
        assert!(probabilities[0] < 1e-8 && probabilities[1] == 0.5 && probabilities[2] > 1.0 - 1e-8);
        let truncations = track_scores.truncations();
        assert!((truncations[0] - 0.25).abs() < 1e-12 && truncations[1] == 1.0, "{truncations:?}");
        assert!((truncations[2] - 1.75).abs() < 1e-12 && truncations.iter().all(|cost| *cost > 0.0));
        assert_eq!(track_scores.start(), [2, 3, 1, 0], "no more than there are");
        let doubts = of([track_scores.ln_odds.clone(), vec![0.0; OPTIONS.least_judged - 4]].concat());
        assert_eq!(
            (doubts.counted(&[0, 1, 3]), doubts.counted(&[0; OPTIONS.surely_enough])),
            (2, OPTIONS.surely_enough)
        );
        assert_eq!(track_scores.counted(&[0, 1, 3]), 3, "of so few tracks it knows nothing");
        assert!(!track_scores.ranks());
        assert!(of(vec![0.1; OPTIONS.least_likely]).ranks());
    }
}
