//! The noise of a consensus, estimated by its residuals, and the consensus refitted at it.

use super::Fits;
use super::options::GrowingOptions;
use crate::domain::StopToken;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::{chi_square_median, median};
use crate::solver::a_contrario;
use crate::solver::consensus::{Consensus, ConsensusOptions, LEAST_INLIERS, NoiseOptions, constraint_count};

const OPTIONS: NoiseOptions = NoiseOptions::DEFAULT;

/// Estimates the noise from the inliers and refits until both agree.
///
/// The estimate is `median(r^2) / median of chi-square`, with the degrees of freedom that cameras and points leave to
/// a track, so a few wrong tracks among the inliers do not move it. Starting high is safe, starting low is not: a gate
/// that is too narrow loses the scene.
fn settle_noise(block: &CompleteBlock, consensus: Consensus, stop: &StopToken) -> Consensus {
    let mut current = consensus;
    for _ in 0..OPTIONS.rounds {
        let inliers = current.inliers();
        if inliers.len() < LEAST_INLIERS || stop.is_stopped() {
            break;
        }
        let noise = estimate_noise(&current, &inliers);
        let settled = (noise / current.noise - 1.0).abs() < OPTIONS.settled;
        let mut fits = Fits::new(block, noise, stop);
        let fitted = fits.refit(
            &current,
            &inliers,
            ConsensusOptions::DEFAULT.loss(noise),
            GrowingOptions::DEFAULT.first_iterations,
        );
        let refitted = fits.polish(fitted);
        // A noise level at which the consensus falls apart was estimated from a fit too flexible to trust.
        if refitted.inlier_count() < LEAST_INLIERS {
            break;
        }
        current = refitted;
        if settled {
            break;
        }
    }
    current
}

/// The consensus once its noise and its inliers agree, with the logarithm of its false alarms.
///
/// * `consensus`: polished at its own noise, as [`grow`](super::grow) returns it
/// * `spread`: see [`Consensus::ln_false_alarms_by_residuals`]
pub fn refine(block: &CompleteBlock, consensus: &Consensus, spread: f64, stop: &StopToken) -> (Consensus, f64) {
    let settled = settle_noise(block, consensus.clone(), stop);
    let ln_false_alarms = a_contrario::ln_false_alarms(block, &settled, spread, stop);
    (settled, ln_false_alarms)
}

/// Noise of a consensus by the median of these tracks' residuals.
pub fn estimate_noise(consensus: &Consensus, inliers: &[usize]) -> f64 {
    let views = consensus.cameras.len();
    let per_track = (constraint_count(views, inliers.len()) / inliers.len() as f64).max(0.5);
    let mut squared: Vec<f64> = inliers.iter().map(|&track| consensus.squared[track]).collect();
    OPTIONS.clamp((median(&mut squared) / chi_square_median(per_track)).sqrt())
}
