//! What an answer is worth on a sequence.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Serialize;

use super::Sequence;
use crate::synthetic::metrics::agreement;
use scpsfm_core::evaluation::measures::rms_after_alignment;

/// Centres that a similarity must be held by: with three, its seven unknowns stand against nine equations.
const LEAST_CENTRES: usize = 3;

/// What either side says, in its own words.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Answer {
    /// Views, in all parts together.
    pub registered: usize,
    /// Reconstructions, each with a frame of its own.
    pub parts: usize,
    pub grade: Option<String>,
    pub focal_px: Option<f64>,
    /// Standard deviation of log f.
    pub sigma_log_focal: Option<f64>,
    pub radial_k1: Option<f64>,
    /// Verdict on each observation, in the order of `observations.csv`.
    pub inlier: Vec<bool>,
    /// Whether the verdicts are of observations, or of tracks spread over theirs.
    pub verdicts: Verdicts,
    /// Reprojection errors over what the side itself kept.
    pub mean_px: Option<f64>,
    pub rms_px: Option<f64>,
    /// Camera centres of the largest part, by the view's id, in a frame of its own.
    pub centres: BTreeMap<u64, Vector3<f64>>,
    pub warnings: Vec<String>,
}

scpsfm_core::named! {
    /// What a side judges.
    #[derive(Default)]
    pub enum Verdicts {
        #[default]
        Observations = "observations",
        Tracks = "tracks",
    }
}

/// An answer against what is known.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scores {
    /// Views, in all parts together.
    pub registered: usize,
    /// Reconstructions, each with a frame of its own.
    pub parts: usize,
    pub grade: Option<String>,
    pub focal_px: Option<f64>,
    /// `100 (f / f_known - 1)`.
    pub focal_error_percent: Option<f64>,
    pub sigma_log_focal: Option<f64>,
    /// `ln(f / f_known) / sigma`.
    pub focal_error_sigmas: Option<f64>,
    pub radial_k1: Option<f64>,
    /// Over all observations; one in a view that is not registered counts as judged wrong.
    pub precision: f64,
    pub recall: f64,
    pub f1: f64,
    pub verdicts: Verdicts,
    /// Reprojection errors over what the side itself kept, hence not comparable where F1 differ much.
    pub mean_px: Option<f64>,
    pub rms_px: Option<f64>,
    /// Root mean square distance of the camera centres of the largest part from the known ones, after the similarity
    /// that fits them best, in percent of the largest distance between two known centres of the whole sequence.
    pub centre_error_percent: Option<f64>,
    /// Centres that were compared.
    pub centres: usize,
    pub warnings: Vec<String>,
}

impl Scores {
    /// Scores an answer that has a verdict for each observation.
    pub fn of(sequence: &Sequence, answer: &Answer) -> Self {
        let observations = agreement(&answer.inlier, &sequence.inlier);
        let ratio = answer.focal_px.zip(sequence.focal_px).map(|(found, known)| found / known);
        let sigmas = ratio.zip(answer.sigma_log_focal).map(|(ratio, sigma)| ratio.ln() / sigma);
        let (centre_error, centres) = centre_error(&answer.centres, &sequence.centres);
        let finite = |value: Option<f64>| value.filter(|value| value.is_finite());
        Self {
            registered: answer.registered,
            parts: answer.parts,
            grade: answer.grade.clone(),
            focal_px: answer.focal_px,
            focal_error_percent: finite(ratio.map(|ratio| 100.0 * (ratio - 1.0))),
            sigma_log_focal: answer.sigma_log_focal,
            focal_error_sigmas: finite(sigmas),
            radial_k1: answer.radial_k1,
            precision: observations.precision,
            recall: observations.recall,
            f1: observations.f1,
            verdicts: answer.verdicts,
            mean_px: answer.mean_px,
            rms_px: answer.rms_px,
            centre_error_percent: finite(centre_error.map(|share| 100.0 * share)),
            centres,
            warnings: answer.warnings.clone(),
        }
    }
}

/// The error as a share of the known trajectory's extent, and how many centres it is of.
fn centre_error(found: &BTreeMap<u64, Vector3<f64>>, known: &[Option<Vector3<f64>>]) -> (Option<f64>, usize) {
    let known_of = |view: u64| usize::try_from(view).ok().and_then(|view| known.get(view).copied().flatten());
    let (from, to): (Vec<_>, Vec<_>) =
        found.iter().filter_map(|(&view, &centre)| Some((centre, known_of(view)?))).unzip();
    let extent = extent(&known.iter().flatten().copied().collect::<Vec<_>>());
    if from.len() < LEAST_CENTRES || extent == 0.0 {
        return (None, from.len());
    }
    (rms_after_alignment(&from, &to).map(|rms| rms / extent), from.len())
}

/// Largest distance between two of the points.
fn extent(points: &[Vector3<f64>]) -> f64 {
    let from = |k: usize| points[k + 1..].iter().map(move |point| (point - points[k]).norm());
    (0..points.len()).flat_map(from).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_centres_error_is_free_of_frame_and_scale_and_relative_to_the_whole_way() {
        let known: Vec<Option<Vector3<f64>>> = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [2.0, 0.3, 0.0], [4.0, 0.0, 0.0]]
            .map(|point| Some(Vector3::from(point)))
            .into_iter()
            .chain([None])
            .collect();
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, -0.2, 1.0);
        let mut found: BTreeMap<u64, Vector3<f64>> = (0..3)
            .map(|view| (view, 7.0 * (turn * known[view as usize].expect("known")) + Vector3::new(1.0, 2.0, 3.0)))
            .collect();
        let (error, count) = centre_error(&found, &known);
        assert!(error.expect("three centres") < 1e-12 && count == 3);
        // Views without a known centre are left out, one out of place is a share of the four units of the whole way.
        found.insert(4, Vector3::zeros());
        found.insert(2, found[&2] + 7.0 * (turn * Vector3::new(0.0, 0.0, 0.4)));
        let (error, count) = centre_error(&found, &known);
        let error = error.expect("three centres");
        assert!(count == 3 && error > 0.01 && error < 0.1, "{error}");
        found.remove(&2);
        assert_eq!(centre_error(&found, &known), (None, 2));
    }
}
