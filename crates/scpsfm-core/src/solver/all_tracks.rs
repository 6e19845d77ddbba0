//! From the tracks that were searched to all that are complete over the same views.
//!
//! A search looks at a sample: more tracks make a consensus no easier to find. They do make its cameras and its
//! calibration more exact, by the root of their number, so what was left aside joins once a consensus stands.

use super::block::Block;
use super::consensus::{self, Consensus, ConsensusOptions};
use super::grow::{self, Fits};
use super::problem::Problem;
use super::view_selection::evenly;
use super::{near_duplicates, static_tracks};

options! {
    /// How what the search left aside is judged.
    pub struct AllTracksOptions {
        /// Tracks that are judged, and inliers among them that cameras are adjusted to. Beyond, an adjustment takes
        /// seconds and other errors than noise bound what it gives.
        most_tracks: usize = 5_000,
        most_inliers: usize = 600,
        /// Iterations of an adjustment. It starts at the noise.
        iterations: usize = 10,
        /// Noise that the first rounds judge at, in units of what is estimated. The cameras were fitted to fewer
        /// tracks, and what they err adds to the residuals of the others. At the noise itself up to a third of the
        /// right ones stayed outside, and some for good.
        widenings: [f64; 3] = [2.0, 1.5, 1.2],
        /// Rounds of judging, adjusting and estimating the noise, at most. Those that judge wider, and as many again,
        /// of which two make the inliers stand still most of the time.
        most_rounds: usize = 7,
        /// Share of the searched inliers that must remain, or the extension is given up.
        least_kept: f64 = 0.8,
    }
}

const OPTIONS: AllTracksOptions = AllTracksOptions::DEFAULT;

/// The block and its consensus with the tracks that the search left aside; `None` where there are none, or where what
/// was found does not carry over.
pub fn extend(problem: &Problem, searched: &Block, consensus: &Consensus) -> Option<(Block, Consensus)> {
    let mut block = near_duplicates::without(&problem.representative, problem.block(&searched.views));
    let found: Vec<usize> = consensus.inliers().into_iter().map(|track| searched.tracks[track]).collect();
    let moving = static_tracks::moving(&problem.is_static, &block);
    if moving.len() < block.tracks.len() && !problem.is_of_static(&found) {
        block = block.select(&moving);
    }
    let all = block.sample_with(OPTIONS.most_tracks, problem.settings.seed, &searched.tracks);
    if all.tracks.len() == searched.tracks.len() {
        return None;
    }
    let judged_at = OPTIONS.widenings[0] * consensus.noise;
    let mut found = consensus::judge(&all.complete, consensus.cameras.clone(), judged_at, problem.stop);
    let mut before = Vec::new();
    for round in 1..=OPTIONS.most_rounds {
        let inliers = found.inliers();
        if round > OPTIONS.widenings.len() && inliers == before {
            break;
        }
        if inliers.len() < consensus::LEAST_INLIERS || problem.stop.is_stopped() {
            return None;
        }
        let noise = grow::estimate_noise(&found, &inliers);
        let support = evenly(&inliers, OPTIONS.most_inliers);
        let judged_at = OPTIONS.widenings.get(round).copied().unwrap_or(1.0) * noise;
        let loss = ConsensusOptions::DEFAULT.loss(noise);
        let mut fits = Fits::new(&all.complete, judged_at, problem.stop);
        found = fits.refit(&found, &support, loss, OPTIONS.iterations);
        before = inliers;
    }
    let inliers = consensus.inliers();
    let is_kept =
        |track: &&usize| all.tracks.binary_search(&searched.tracks[**track]).is_ok_and(|place| found.inlier[place]);
    let kept = inliers.iter().filter(is_kept).count();
    (kept as f64 >= OPTIONS.least_kept * inliers.len() as f64).then_some((all, found))
}
