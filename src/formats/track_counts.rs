//! How many tracks have which verdict.

use super::LabelledInput;
use crate::domain::{Method, Solution, Status, VERIFIED};

/// How many tracks have which verdict: each is an inlier, consistent in two views, unclassified or rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrackCounts {
    pub inlier: usize,
    /// Consistent with the two registered views of a part that see them.
    pub two_view: usize,
    /// Of AUTO and GEOMETRY: seen by too few registered views for a verdict; `None` where the input is not at hand. 0 for
    /// other methods, which give every track a verdict. `None` where there is no reconstruction.
    pub unclassified: Option<usize>,
    /// All others. `None` where `unclassified` is.
    pub rejected: Option<usize>,
    /// The unclassified and the rejected ones together, which are known without the input, too.
    pub others: usize,
}

impl TrackCounts {
    pub fn new(solution: &Solution, input: Option<&LabelledInput>) -> Self {
        let inlier = solution.inlier_track_count();
        let two_view = solution.two_view_tracks.len();
        let unclassified = unclassified(solution, input);
        let others = (solution.tracks.inlier.len() - inlier).saturating_sub(two_view);
        let rejected = unclassified.map(|unclassified| others.saturating_sub(unclassified));
        Self { inlier, two_view, unclassified, rejected, others }
    }
}

/// Tracks without a verdict. AUTO and GEOMETRY judge by views, the other methods give every track a weight.
fn unclassified(solution: &Solution, input: Option<&LabelledInput>) -> Option<usize> {
    if solution.status != Status::Solved {
        return None;
    }
    if !matches!(solution.method, Method::Auto | Method::Geometry) {
        return Some(0);
    }
    let raw = &input?.raw;
    let mut has_verdict = solution.tracks.inlier.clone();
    for track in &solution.two_view_tracks {
        has_verdict[track.track as usize] = true;
    }
    let mut seen = vec![0usize; has_verdict.len()];
    for (&view, &track) in raw.view.iter().zip(&raw.track) {
        seen[track as usize] += usize::from(solution.views[view as usize].projection.is_some());
    }
    Some(has_verdict.iter().zip(seen).filter(|&(&judged, seen)| !judged && seen < VERIFIED).count())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::result::TwoViewTrack;
    use crate::formats::fixture;

    #[test]
    fn every_track_has_one_verdict() {
        let (input, mut solution) = fixture::solved();
        let counts = |solution: &Solution| TrackCounts::new(solution, Some(&input));
        let all = TrackCounts { inlier: 20, two_view: 0, unclassified: Some(0), rejected: Some(20), others: 20 };
        assert_eq!(counts(&solution), all);
        assert_eq!(TrackCounts::new(&solution, None), TrackCounts { unclassified: None, rejected: None, ..all });
        let outlier = solution.tracks.inlier.iter().position(|inlier| !inlier).expect("an outlier") as u32;
        solution.two_view_tracks = vec![TwoViewTrack { track: outlier, weight: 0.75, part: 0, point: None }];
        assert_eq!(counts(&solution), TrackCounts { two_view: 1, rejected: Some(19), others: 19, ..all });
        solution.views[..3].iter_mut().for_each(|view| view.projection = None);
        let few_views = TrackCounts { two_view: 1, unclassified: Some(19), rejected: Some(0), others: 19, ..all };
        assert_eq!(counts(&solution), few_views);
        // The networks weigh every track, whoever sees it.
        solution.method = Method::Paper;
        let weighed = TrackCounts { two_view: 1, rejected: Some(19), others: 19, ..all };
        assert_eq!(counts(&solution), weighed);
        assert_eq!(TrackCounts::new(&solution, None), weighed);
        solution.status = Status::NoReconstruction;
        assert_eq!(counts(&solution).rejected, None);
    }
}
