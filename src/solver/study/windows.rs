//! Windows of real sequences, and what pairs of views and the trained network say of their observations.

use std::time::Instant;

use super::NOISE;
use crate::domain::{Input, StopToken};
use crate::geometry::fundamental::MOST_SAMPLES;
use crate::geometry::observation::Observation;
use crate::geometry::pairwise_likelihoods::{Tracks, Votes};
use crate::solver::block;
use crate::solver::learned::TrackScores;

/// Views of a window: those of a block that seeds a sequence, for long complete ones hold few tracks.
pub const WINDOW_VIEWS: usize = 5;

/// Consecutive views of a sequence with the tracks that three or more of them show: fewer verify nothing.
pub struct Window {
    tracks: Tracks,
    /// Observations of the input, in the order of the tracks.
    pub observations: Vec<usize>,
}

/// What is said of every observation of a window, larger where it is more likely right; `None` from those who say
/// nothing.
pub struct WindowRankings {
    /// Pairs of views.
    pub epipolar: Option<Vec<f64>>,
    /// The network that was trained beforehand.
    pub learned: Option<Vec<f64>>,
    /// Both. No search is guided by it: on real sequences the scene's own statistics decide every seed, and hearing
    /// these first took three of nine views from one sequence and gave none a better calibration.
    pub together: Option<Vec<f64>>,
    /// Of asking the pairs, and of asking the network.
    pub seconds: [f64; 2],
}

/// Every window of an input, those that show no tracks left out.
pub fn windows(input: &Input) -> Vec<Window> {
    let ranges = input.track_ranges();
    let (normalization, _) = block::normalization(input);
    let seen = |k: usize, first: usize| {
        let view = input.view_of(k);
        Observation::new(view - first, input.track_of(k), normalization.normalize(view, input.point_px(k)))
    };
    let window = |first: usize| {
        let inside = |track: usize| -> Vec<usize> {
            let within = first..first + WINDOW_VIEWS;
            (ranges[track]..ranges[track + 1]).filter(|&k| within.contains(&input.view_of(k))).collect()
        };
        let shown: Vec<Vec<usize>> =
            (0..input.track_count()).map(inside).filter(|seen| seen.len() >= block::LEAST_VIEWS).collect();
        let tracks = Tracks::new(WINDOW_VIEWS, shown.iter().map(|track| track.iter().map(|&k| seen(k, first))));
        Window { tracks, observations: shown.concat() }
    };
    let last = (input.view_count() + 1).saturating_sub(WINDOW_VIEWS);
    (0..last).map(window).filter(|window| !window.observations.is_empty()).collect()
}

impl Window {
    /// Asks pairs of views and the trained network.
    pub fn rank(&self, seed: u64, stop: &StopToken) -> WindowRankings {
        let begun = Instant::now();
        let votes = Votes::ask(&self.tracks, NOISE, MOST_SAMPLES, seed, stop);
        let voted = begun.elapsed().as_secs_f64();
        let track_scores = TrackScores::of_tracks(&self.tracks);
        let seconds = [voted, begun.elapsed().as_secs_f64() - voted];
        let together = match (&votes, &track_scores) {
            (Some(votes), Some(track_scores)) => Some(track_scores.with_votes(votes)),
            (Some(votes), None) => Some(TrackScores::of_votes(votes)),
            (None, track_scores) => track_scores.clone(),
        };
        let said = |track_scores: &TrackScores| track_scores.observations().to_vec();
        WindowRankings {
            epipolar: votes.map(|votes| votes.alone().observations),
            learned: track_scores.as_ref().map(said),
            together: together.as_ref().map(said),
            seconds,
        }
    }
}
