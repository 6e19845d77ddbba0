//! What each view, and each part, contributes to a result.

use std::collections::BTreeMap;

use crate::domain::Solution;
use crate::formats::LabelledInput;

/// Worst observations kept a view: enough to see whether they have something in common.
const WORST: usize = 5;

/// One view's share of the observations. Residuals are over its inlier observations.
#[derive(Debug, Default, Clone)]
pub struct ViewCount {
    pub observations: usize,
    pub inliers: usize,
    /// Observations that show another point of their track than its own.
    pub others: usize,
    judged: usize,
    sum_px: f64,
    sum_px2: f64,
    /// The inlier observations of the largest residuals (px), largest first, each with its track.
    pub worst: Vec<(f64, usize)>,
}

impl ViewCount {
    pub fn mean_px(&self) -> Option<f64> {
        (self.judged > 0).then(|| self.sum_px / self.judged as f64)
    }

    pub fn rms_px(&self) -> Option<f64> {
        (self.judged > 0).then(|| (self.sum_px2 / self.judged as f64).sqrt())
    }

    fn add_residual(&mut self, px: f64, track: usize) {
        self.judged += 1;
        self.sum_px += px;
        self.sum_px2 += px * px;
        let place = self.worst.partition_point(|&(worse, _)| worse >= px);
        if place < WORST {
            self.worst.insert(place, (px, track));
            self.worst.truncate(WORST);
        }
    }
}

/// One entry a view of the solution; nothing but zeros without the input.
pub fn of_views(solution: &Solution, input: Option<&LabelledInput>) -> Vec<ViewCount> {
    let mut counts = vec![ViewCount::default(); solution.views.len()];
    let Some(raw) = input.map(|input| &input.raw) else { return counts };
    for (k, (&view, &track)) in raw.view.iter().zip(&raw.track).enumerate() {
        let Some(count) = counts.get_mut(view as usize) else { continue };
        count.observations += 1;
        if solution.observations.inlier.get(k) == Some(&true) {
            count.inliers += 1;
            let residual = solution.observations.residual_px.get(k).copied().flatten();
            if let Some(px) = residual.filter(|px| px.is_finite()) {
                count.add_residual(px, track as usize);
            }
        } else if solution.observations.split.get(k).is_some_and(|&number| number > 0) {
            count.others += 1;
        }
    }
    counts
}

/// The registered views of each part, in the input's order.
pub fn parts(solution: &Solution) -> BTreeMap<u32, Vec<usize>> {
    let mut parts: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for view in solution.registered_views() {
        parts.entry(solution.views[view].part).or_default().push(view);
    }
    parts
}

/// A point in a part.
pub struct PlacedPoint {
    pub part: u32,
    pub weight: f32,
    pub at: [f64; 3],
    /// A further one of a track that joins several.
    pub is_further: bool,
}

/// The points of all parts: those of the tracks, then the further ones of tracks that join several.
pub fn points(solution: &Solution) -> impl Iterator<Item = PlacedPoint> {
    let tracks = &solution.tracks;
    let own = tracks
        .point
        .iter()
        .enumerate()
        .map(|(track, point)| (track, tracks.weight.get(track).copied().unwrap_or(0.0), *point, false));
    let further = solution.splits.iter().map(|split| (split.track as usize, split.weight, split.point, true));
    own.chain(further)
        .filter_map(|(track, weight, point, is_further)| {
            Some(PlacedPoint { part: tracks.part_of(track)?, weight, at: point?, is_further })
        })
        .filter(|point| point.at.iter().all(|value| value.is_finite()))
}

/// The views of each track's inlier observations, ascending, each once.
pub fn inlier_views(solution: &Solution, input: &LabelledInput) -> Vec<Vec<u32>> {
    let mut views: Vec<Vec<u32>> = vec![Vec::new(); solution.tracks.inlier.len()];
    for (k, (&view, &track)) in input.raw.view.iter().zip(&input.raw.track).enumerate() {
        if solution.observations.inlier.get(k) == Some(&true)
            && (view as usize) < solution.views.len()
            && let Some(views) = views.get_mut(track as usize)
        {
            views.push(view);
        }
    }
    for views in &mut views {
        views.sort_unstable();
        views.dedup();
    }
    views
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn a_view_counts_what_it_sees() {
        let (input, mut solution) = fixture::solved();
        let of_view: Vec<usize> = (0..input.raw.view.len()).filter(|&k| input.raw.view[k] == 2).collect();
        let inliers: Vec<usize> = of_view.iter().copied().filter(|&k| solution.observations.inlier[k]).collect();
        for (rank, &k) in inliers.iter().enumerate() {
            solution.observations.residual_px[k] = Some(rank as f64);
        }
        let count = &of_views(&solution, Some(&input))[2];
        let n = inliers.len() as f64;
        assert_eq!((count.observations, count.inliers), (of_view.len(), inliers.len()));
        assert_eq!(count.mean_px(), Some((n - 1.0) / 2.0));
        assert!((count.rms_px().expect("judged") - ((n - 1.0) * (2.0 * n - 1.0) / 6.0).sqrt()).abs() < 1e-9);
        let worst: Vec<f64> = count.worst.iter().map(|worst| worst.0).collect();
        assert_eq!(worst, (1..=WORST).map(|k| n - k as f64).collect::<Vec<_>>());
        assert_eq!(count.worst[0].1, input.raw.track[inliers[inliers.len() - 1]] as usize);
    }

    #[test]
    fn a_track_that_joins_two_points_has_both() {
        let (input, mut solution) = fixture::solved_with_a_split();
        assert_eq!(points(&solution).count(), solution.inlier_track_count() + 1);
        assert_eq!(points(&solution).filter(|point| point.is_further).count(), 1);
        let page = crate::report::page(&solution, Some(&input));
        assert!(
            page.contains("20 of 20 points are drawn. 1 of the 20 are further points of tracks that join several.")
        );
        solution.splits[0].point = Some([f64::NAN; 3]);
        let page = crate::report::page(&solution, Some(&input));
        assert!(page.contains("19 of 19 points are drawn.</p>"), "what is not among all is no further one");
    }

    #[test]
    fn the_tracks_of_a_part_are_seen_by_its_views() {
        assert_eq!(parts(&fixture::solved().1).len(), 1);
        let (input, solution) = fixture::solved_in_two_parts();
        let of_part = |part| (0..40).find(|&track| solution.tracks.part_of(track) == Some(part)).expect("a track");
        assert_eq!(parts(&solution)[&1], [3, 4]);
        let views = inlier_views(&solution, &input);
        assert_eq!((&views[of_part(0)][..], &views[of_part(1)][..]), (&[0, 1, 2][..], &[3, 4][..]));
    }
}
