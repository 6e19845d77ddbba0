//! Which tracks a search looks at where there are more than it can: some at random, unless hardly any of those are
//! right.
//!
//! Of 3,000 tracks of which one in fifty is right, a random sample of 600 holds twelve right ones, and one sample in
//! fourteen too few to verify anything. The trained network is linear in the tracks: it can be asked about all of them,
//! and the search looks at those that it ranks first.

use super::block::Block;
use super::error::Error;
use super::learned::{self, TrackScoreOptions, TrackScores};
use super::problem::Problem;

/// Tracks times views that the network is asked about at a time: some 100 MB. Of more, each part is asked for itself.
const ASKED_OBSERVATIONS: usize = 50_000;

/// A sample of at most `most` tracks of a block, and what the network says of it, where it was asked.
///
/// * `asks_network`: whether the network may be asked
pub fn sample(
    problem: &Problem,
    block: &Block,
    most: usize,
    asks_network: bool,
) -> Result<(Block, Option<TrackScores>), Error> {
    let sample = block.clone().sample(most, problem.settings.seed);
    // The windows that seed a sequence share their tracks with others, and depths tell right tracks by themselves.
    let is_all = sample.tracks.len() == block.tracks.len();
    if is_all || !asks_network || block.complete.has_depths() || !learned::may_be_asked(problem.settings) {
        return Ok((sample, None));
    }
    let Some(track_scores) = TrackScores::of(&sample.complete) else { return Ok((sample, None)) };
    if track_scores.likely() >= TrackScoreOptions::DEFAULT.surely_enough {
        return Ok((sample, Some(track_scores)));
    }
    let Some(ln_odds) = of_all(problem, block)? else { return Ok((sample, Some(track_scores))) };
    let mut ranked: Vec<usize> = (0..ln_odds.len()).collect();
    ranked.sort_by(|&a, &b| ln_odds[b].total_cmp(&ln_odds[a]).then(a.cmp(&b)));
    ranked.truncate(most);
    ranked.sort_unstable();
    Ok((block.select(&ranked), None))
}

/// The network's log odds of every track of a block; `None` where it has no answer.
fn of_all(problem: &Problem, block: &Block) -> Result<Option<Vec<f64>>, Error> {
    let tracks: Vec<usize> = (0..block.tracks.len()).collect();
    let at_a_time = (ASKED_OBSERVATIONS / block.views.len().max(1)).max(1);
    // Parts of about one size: a few tracks by themselves are no scene.
    let parts = tracks.len().div_ceil(at_a_time).max(1);
    let mut ln_odds = Vec::with_capacity(tracks.len());
    for part in tracks.chunks(tracks.len().div_ceil(parts)) {
        problem.stopped()?;
        let Some(track_scores) = TrackScores::of(&block.complete.select(part)) else { return Ok(None) };
        ln_odds.extend_from_slice(track_scores.ln_odds());
    }
    Ok(Some(ln_odds))
}
