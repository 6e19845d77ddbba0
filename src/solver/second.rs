//! Whether the tracks left out agree on a motion of their own.

use super::Error;
use super::grow::{self, Consensus};
use super::portfolio::{Evidence, Portfolio};
use super::recorder::Recorder;
use crate::domain::{Method, Prior, Silent, SolveSettings, StopToken, Warning, WarningCode};
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::chi_square_gate;

/// Gates of the first consensus from which a track counts as left out: nearer ones are its own, with an outlier's share
/// of noise.
const FAR_GATES: f64 = 16.0;
/// Rounds of the search: a second structure worth a warning is found at once among what the first leaves over.
const ROUNDS: u32 = 1;
/// Tracks of a second structure, at least, as a share of the first: a handful that moves together is no second body.
const LEAST_SHARE: f64 = 0.1;

/// Searches the tracks that a consensus leaves out for another.
///
/// # Errors
/// Defects of the search.
pub fn structure(
    block: &CompleteBlock,
    consensus: &Consensus,
    settings: &SolveSettings,
    stop: &StopToken,
) -> Result<Option<Warning>, Error> {
    let gate = FAR_GATES * chi_square_gate((2 * block.views()) as f64 - 3.0) * consensus.noise * consensus.noise;
    let left: Vec<usize> =
        (0..block.tracks()).filter(|&track| !consensus.inlier[track] && consensus.squared[track] > gate).collect();
    if left.len() < grow::LEAST_INLIERS {
        return Ok(None);
    }
    let excluded_priors = Prior::ALL.into_iter().filter(|&prior| prior != Prior::Irls).collect();
    let settings = SolveSettings { method: Method::Geometry, excluded_priors, ..settings.clone() };
    let rest = block.select(&left);
    let mut silent = Silent;
    // A recorder of its own: the caller is told of the first structure.
    let mut recorder = Recorder::new(&mut silent);
    let found = Portfolio::new(&rest, &settings, consensus.noise, stop)
        .with_rounds(ROUNDS)
        .run(&mut recorder, 1.0, &|_| Vec::new())
        .map_err(|error| Error::Internal(error.to_string()))?;
    let second = found.consensus.filter(|_| found.decisive && found.evidence == Evidence::ImagePoints);
    let least = LEAST_SHARE * consensus.inlier_count() as f64;
    Ok(second.map(|second| second.inlier_count()).filter(|&count| count as f64 >= least).map(|count| {
        Warning::new(
            WarningCode::SecondStructure,
            format!(
                "{count} of the {} tracks that were left out agree on another rigid motion: a second moving body, or a \
                 repeated structure; the result is that of the {} tracks that stand, not of both",
                left.len(),
                consensus.inlier_count()
            ),
        )
    }))
}
