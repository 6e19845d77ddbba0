//! An input in which tracks stand several times, solved with one of each.
//!
//! Duplicates of one wrong track agree with each other on any geometry: eight of them verify what nothing else does.
//! They count once, and all get the answer of the first.

use super::error::Error;
use crate::domain::duplicates::Duplicates;
use crate::domain::result::ObservationResults;
use crate::domain::{Input, Observer, Progress, Solution, Stage};

/// Solves the input without its duplicates, by `solve`, and answers for all of it.
pub fn solve_once(
    input: &Input,
    duplicates: &Duplicates,
    observer: &mut dyn Observer,
    solve: impl FnOnce(&Input, &mut dyn Observer) -> Result<Solution, Error>,
) -> Result<Solution, Error> {
    let is_kept = |k: &usize| !duplicates.is_duplicate(input.track_of(*k));
    let rest = input.restricted_to(|k| is_kept(&k));
    let places: Vec<usize> = (0..input.observation_count()).filter(is_kept).map(|k| input.caller_index(k)).collect();
    let mut solution = solve(&rest, &mut Unfolding { observer, duplicates })?;
    unfold(&mut solution, input.observation_count(), &places);
    duplicates.answer(input, &mut solution);
    solution.warnings.push(duplicates.warning(|track| track.to_string()));
    Ok(solution)
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
