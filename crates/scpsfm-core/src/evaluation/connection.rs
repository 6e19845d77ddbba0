//! The views that anyone could register together: those that the right observations connect.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::solver::consensus::LEAST_VIEWS;
use crate::solver::sequence::{GrowthOptions, MergingOptions};

/// Views that must see a point for it to be known to others.
const TRIANGULATING: usize = 2;

/// Sets of views that right observations connect, by the solver's own numbers of tracks: a view belongs to a set where
/// it sees [`GrowthOptions::LAST`] points that two others of it see, and two sets are one where they share
/// [`MergingOptions`] tracks that two views of the one see. Whether the angles between the rays suffice is not asked.
///
/// * `seen`: view and track of each right observation, each pair once
/// * `views`: how many there are
pub fn connected_views(seen: &[(u32, u32)], views: usize) -> Vec<Vec<usize>> {
    let tracks = seen.iter().map(|(_, track)| *track as usize + 1).max().unwrap_or(0);
    let mut observed = Observed { of_view: vec![Vec::new(); views], of_track: vec![Vec::new(); tracks] };
    for &(view, track) in seen {
        observed.of_view[view as usize].push(track as usize);
        observed.of_track[track as usize].push(view as usize);
    }
    let mut open = vec![true; views];
    let mut sets = Vec::new();
    for pair in observed.pairs() {
        let set = if pair.iter().all(|&view| open[view]) { observed.grown(&pair, &open) } else { continue };
        if set.len() >= LEAST_VIEWS {
            set.iter().for_each(|&view| open[view] = false);
            sets.push(set);
        }
    }
    while let Some((one, other)) = pairs_of(sets.len()).find(|&(one, other)| observed.joins(&sets[one], &sets[other])) {
        let merged = [sets.swap_remove(other), sets.swap_remove(one)].concat();
        let set = observed.grown(&merged, &open);
        set.iter().for_each(|&view| open[view] = false);
        sets.push(set);
    }
    sets
}

struct Observed {
    of_view: Vec<Vec<usize>>,
    of_track: Vec<Vec<usize>>,
}

impl Observed {
    /// Pairs of views that share enough tracks for a third one to join, most first.
    fn pairs(&self) -> Vec<[usize; 2]> {
        let mut shared: HashMap<[usize; 2], usize> = HashMap::new();
        for views in &self.of_track {
            for (i, &view) in views.iter().enumerate() {
                views[..i]
                    .iter()
                    .for_each(|&other| *shared.entry([view.min(other), view.max(other)]).or_default() += 1);
            }
        }
        let mut pairs: Vec<([usize; 2], usize)> = shared.into_iter().collect();
        pairs.retain(|(_, shared)| *shared >= GrowthOptions::LAST.least_agreeing);
        pairs.sort_unstable_by_key(|&(pair, shared)| (Reverse(shared), pair));
        pairs.into_iter().map(|(pair, _)| pair).collect()
    }

    /// A set with all open views that join it, increasing.
    fn grown(&self, set: &[usize], open: &[bool]) -> Vec<usize> {
        let mut joined: BTreeSet<usize> = set.iter().copied().collect();
        let mut waiting: Vec<usize> = joined.iter().copied().collect();
        let (mut seeing, mut points) = (vec![0; self.of_track.len()], vec![0; self.of_view.len()]);
        while let Some(view) = waiting.pop() {
            for &track in &self.of_view[view] {
                seeing[track] += 1;
                if seeing[track] != TRIANGULATING {
                    continue;
                }
                for &other in &self.of_track[track] {
                    points[other] += 1;
                    if points[other] >= GrowthOptions::LAST.least_agreeing && open[other] && joined.insert(other) {
                        waiting.push(other);
                    }
                }
            }
        }
        joined.into_iter().collect()
    }

    /// Whether two sets of views share what a similarity between them takes.
    fn joins(&self, one: &[usize], other: &[usize]) -> bool {
        let options = MergingOptions::DEFAULT;
        let mut tracks = BTreeSet::new();
        // Of each view the tracks that two views of the other set see.
        let mut of_view: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
        for (track, views) in self.of_track.iter().enumerate() {
            let of = |set: &[usize]| -> Vec<usize> {
                views.iter().copied().filter(|view| set.binary_search(view).is_ok()).collect()
            };
            let sides = [of(one), of(other)];
            for (seers, others) in [(&sides[0], &sides[1]), (&sides[1], &sides[0])] {
                if others.len() >= TRIANGULATING && !seers.is_empty() {
                    tracks.insert(track);
                    seers.iter().for_each(|&view| _ = of_view.entry(view).or_default().insert(track));
                }
            }
        }
        let beside = |one: &usize| {
            let others = of_view.iter().filter(|(view, _)| *view != one).flat_map(|(_, tracks)| tracks);
            others.collect::<BTreeSet<_>>().len()
        };
        tracks.len() >= options.least_tracks && of_view.keys().map(beside).min() >= Some(options.least_beside)
    }
}

/// Pairs of so many, the first below the second.
fn pairs_of(count: usize) -> impl Iterator<Item = (usize, usize)> {
    (1..count).flat_map(|other| (0..other).map(move |one| (one, other)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each of so many tracks in the same views, numbered from the first.
    fn tracks(first: u32, count: u32, views: &[u32]) -> impl Iterator<Item = (u32, u32)> {
        (first..first + count).flat_map(move |track| views.iter().map(move |&view| (view, track)))
    }

    #[test]
    fn views_without_common_points_are_apart() {
        let mut seen: Vec<_> = tracks(0, 20, &[0, 1, 2]).chain(tracks(20, 20, &[4, 5, 6])).collect();
        // Five points of a view do not hold it.
        seen.extend(tracks(40, 5, &[1, 2, 3]));
        assert_eq!(connected_views(&seen, 8), [vec![0, 1, 2], vec![4, 5, 6]]);
        seen.extend(tracks(45, 1, &[1, 2, 3]));
        assert_eq!(connected_views(&seen, 8), [vec![0, 1, 2, 3], vec![4, 5, 6]]);
        assert_eq!(connected_views(&[], 3), [[0usize; 0]; 0]);
    }

    #[test]
    fn sets_are_one_where_a_second_camera_gives_the_scale() {
        let sets = || tracks(0, 20, &[0, 1, 2]).chain(tracks(20, 20, &[3, 4, 5]));
        // However many points one camera sees, the scale is open.
        let few: Vec<_> = sets().chain(tracks(40, 5, &[1, 2, 3])).collect();
        assert_eq!(connected_views(&few, 6), [[0, 1, 2], [3, 4, 5]]);
        let of_two: Vec<_> = few.into_iter().chain(tracks(45, 3, &[0, 1, 4])).collect();
        assert_eq!(connected_views(&of_two, 6), [[0, 1, 2, 3, 4, 5]]);
    }
}
