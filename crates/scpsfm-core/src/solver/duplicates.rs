//! An input in which tracks stand several times, solved with one of each.
//!
//! Duplicates of one wrong track agree with each other on any geometry: eight of them verify what nothing else does.
//! They count once, and all get the answer of the first.

use super::Error;
use crate::domain::duplicates::Duplicates;
use crate::domain::result::ObservationResults;
use crate::domain::{Input, Limits, Observer, Progress, RawInput, Solution, Stage};

/// Solves the input without its duplicates, by `solve`, and answers for all of it.
///
/// # Errors
/// Those of `solve`; [`Error::Internal`] where the rest is no valid input, which it is.
pub fn solve_once(
    input: &Input,
    duplicates: &Duplicates,
    observer: &mut dyn Observer,
    solve: impl FnOnce(&Input, &mut dyn Observer) -> Result<Solution, Error>,
) -> Result<Solution, Error> {
    let (rest, places) = without(input, duplicates)?;
    let mut solution = solve(&rest, &mut Unfolding { observer, duplicates })?;
    unfold(&mut solution, input.observation_count(), &places);
    duplicates.answer(input, &mut solution);
    solution.warnings.push(duplicates.warning(|track| track.to_string()));
    Ok(solution)
}

/// The input without the observations of its duplicates, whose tracks are empty then; and where each observation that
/// is left stood in the caller's order.
fn without(input: &Input, duplicates: &Duplicates) -> Result<(Input, Vec<usize>), Error> {
    let kept: Vec<usize> =
        (0..input.observation_count()).filter(|&k| !duplicates.is_duplicate(input.track_of(k))).collect();
    let raw = RawInput {
        views: input.views().to_vec(),
        track_count: input.track_count(),
        view: kept.iter().map(|&k| input.view_of(k) as u32).collect(),
        track: kept.iter().map(|&k| input.track_of(k) as u32).collect(),
        x: kept.iter().map(|&k| input.point_px(k)[0]).collect(),
        y: kept.iter().map(|&k| input.point_px(k)[1]).collect(),
        depth: kept.iter().filter_map(|&k| input.depth(k)).collect(),
        sigma: kept.iter().filter_map(|&k| input.sigma_px(k)).collect(),
    };
    let limits = Limits { max_views: usize::MAX, max_tracks: usize::MAX, max_observations: usize::MAX };
    let rest = Input::new(raw, &limits, "input").map_err(|error| Error::Internal(error.to_string()))?;
    Ok((rest, kept.into_iter().map(|k| input.caller_index(k)).collect()))
}

/// Puts what is said of the observations that were solved where the caller has them; nothing is said of the others yet.
fn unfold(solution: &mut Solution, count: usize, places: &[usize]) {
    let solved = std::mem::replace(&mut solution.observations, ObservationResults::unjudged(count));
    let all = &mut solution.observations;
    for (k, &place) in places.iter().enumerate() {
        all.inlier[place] = solved.inlier[k];
        all.residual_px[place] = solved.residual_px[k];
        all.weight[place] = solved.weight[k];
        all.split[place] = solved.split[k];
    }
}

/// Tells the caller of all tracks.
struct Unfolding<'a> {
    observer: &'a mut dyn Observer,
    duplicates: &'a Duplicates,
}

impl Observer for Unfolding<'_> {
    fn stage(&mut self, stage: Stage) {
        self.observer.stage(stage);
    }

    fn progress(&mut self, progress: &Progress) {
        self.observer.progress(progress);
    }

    fn weights(&mut self, iteration: u32, weights: &[f32]) {
        let mut weights = weights.to_vec();
        self.duplicates.list().for_each(|(duplicate, first)| weights[duplicate] = weights[first]);
        self.observer.weights(iteration, &weights);
    }
}
