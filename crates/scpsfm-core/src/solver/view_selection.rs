//! Which views are searched together: all of them where their tracks are complete, blocks of views that share many
//! tracks, small subsets of either, and triplets whose views share tracks in pairs.

use std::cmp::Reverse;

use super::consensus::{LEAST_INLIERS, LEAST_VIEWS};
use super::problem::{Problem, complete_views};
use crate::geometry::fundamental;

/// Tracks that every two views of a triplet share: one more than determine their fundamental matrix.
pub const LEAST_SHARED_BY_PAIR: usize = fundamental::LEAST_MATCHES + 1;

/// Views that a reconstruction begins with.
#[derive(Debug, Clone)]
pub enum SeedViews {
    /// By the tracks that are complete over them.
    Block(Vec<usize>),
    /// By the tracks that two or three of them share.
    Triplet([usize; 3]),
}

options! {
    /// Which sets of views are worth solving.
    pub struct ViewSelectionOptions {
        /// Tracks that a block should have; with fewer than [`LEAST_INLIERS`] none is tried. Half of them may be wrong.
        wanted_tracks: usize = 2 * LEAST_INLIERS,
        /// Views that a block grows to. Real tracks are short: longer blocks hold few of them.
        most_views: usize = 10,
        /// Views that are solved as one block where tracks are complete over all views; of more, these many evenly
        /// spread. Bundle adjustment of a block is cubic in its views.
        most_views_whole: usize = 40,
        /// Tracks beyond which more of them do not make a block better.
        enough_tracks: usize = 300,
        /// Views that blocks are begun from. Of long sequences not every view needs its turn to find a few dense
        /// blocks.
        most_first_views: usize = 64,
        /// Blocks that are tried, best first, before the best result stands.
        most_blocks: usize = 4,
        /// Second views of a triplet that are tried with each first: those that share most tracks with it.
        most_second_views: usize = 8,
        /// Triplets that are tried: as many as subsets.
        most_triplets: usize = 8,
        /// Views of a subset. Of a track with three wrong observations of ten, four views are clean one time in six.
        subset_views: usize = 4,
        /// Subsets of one set, and of all sets together.
        subsets_of_set: usize = 6,
        most_subsets: usize = 8,
    }
}

const OPTIONS: ViewSelectionOptions = ViewSelectionOptions::DEFAULT;

/// Sets of views worth solving, best first; empty when no three views share enough tracks.
///
/// Once `stop` fires the answer is whatever was found by then.
pub fn candidate_views(problem: &Problem) -> Vec<Vec<usize>> {
    let among_all = || candidate_views_among(problem, &vec![true; problem.views()]);
    whole(problem).map_or_else(among_all, |views| vec![views])
}

/// The views of the one block of an input whose tracks are complete; see [`complete_views`].
pub fn whole(problem: &Problem) -> Option<Vec<usize>> {
    complete_views(problem.input, &problem.ranges).map(|views| evenly(&views, OPTIONS.most_views_whole))
}

/// Blocks of the views that are `open` (one entry a view), whose tracks are incomplete, best first; at most
/// [`ViewSelectionOptions::most_blocks`].
pub fn candidate_views_among(problem: &Problem, open: &[bool]) -> Vec<Vec<usize>> {
    let found = [OPTIONS.wanted_tracks, LEAST_INLIERS].into_iter().map(|least| greedy_views(problem, open, least));
    found.into_iter().find(|found| !found.is_empty()).unwrap_or_default()
}

/// Small subsets of these sets of views: runs and combs in turn, spread over the set; the first of each set first. A
/// track with some wrong observations is clean in some of them.
pub fn subsets(sets: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let subset = |views: &[usize], k: usize| -> Vec<usize> {
        let longest = (views.len() - 1) / (OPTIONS.subset_views - 1);
        let step = if k.is_multiple_of(2) { 1 } else { longest };
        let starts = views.len() - (OPTIONS.subset_views - 1) * step;
        let first = (k * starts / OPTIONS.subsets_of_set).min(starts - 1);
        (0..OPTIONS.subset_views).map(|i| views[first + i * step]).collect()
    };
    let mut found: Vec<Vec<usize>> = Vec::new();
    for k in 0..OPTIONS.subsets_of_set {
        for views in sets.iter().filter(|views| views.len() > OPTIONS.subset_views) {
            let subset = subset(views, k);
            if !found.contains(&subset) {
                found.push(subset);
            }
        }
    }
    found.truncate(OPTIONS.most_subsets);
    found
}

/// Triplets of views of which every two share tracks, ranked by the number of tracks of the pair that shares fewest.
/// The tracks of one pair need not be those of another.
///
/// * `open`: which views may take part
pub fn triplets(problem: &Problem, open: &[bool]) -> Vec<[usize; 3]> {
    let seeing: Vec<usize> =
        (0..problem.views()).filter(|&view| open[view] && !problem.of_view[view].is_empty()).collect();
    let is_enough = |count: usize| count >= LEAST_SHARED_BY_PAIR;
    let mut found: Vec<(usize, [usize; 3])> = Vec::new();
    for first in evenly(&seeing, OPTIONS.most_first_views) {
        if problem.stop.is_stopped() {
            break;
        }
        let with_first = shared_tracks(problem, open, first);
        let mut others: Vec<usize> = seeing.iter().copied().filter(|&view| is_enough(with_first[view])).collect();
        others.sort_by_key(|&view| (Reverse(with_first[view]), view));
        for &second in others.iter().take(OPTIONS.most_second_views).take_while(|_| !problem.stop.is_stopped()) {
            let with_second = shared_tracks(problem, open, second);
            let weakest = |third: &usize| with_first[second].min(with_first[*third]).min(with_second[*third]);
            // The first of equals, so that one input has one answer.
            let third = others.iter().copied().filter(|third| *third != second).rev().max_by_key(weakest);
            let Some(third) = third.filter(|third| is_enough(weakest(third))) else { continue };
            let mut views = [first, second, third];
            views.sort_unstable();
            found.push((weakest(&third), views));
        }
    }
    found.sort_by_key(|&(weakest, views)| (Reverse(weakest), views));
    found.dedup();
    diverse(found.into_iter().map(|(_, views)| views).collect(), OPTIONS.most_triplets)
}

/// Number of tracks that a view shares with each open one; 0 with itself.
fn shared_tracks(problem: &Problem, open: &[bool], view: usize) -> Vec<usize> {
    let mut shared = vec![0; problem.views()];
    let tracks = problem.of_view[view].iter().map(|&k| problem.track_of(k as usize));
    for track in tracks.filter(|&track| problem.supports_growth(track, false)) {
        let seen = problem.of_track(track).map(|k| problem.view_of(k));
        seen.filter(|&other| open[other]).for_each(|other| shared[other] += 1);
    }
    shared[view] = 0;
    shared
}

/// From every view, adds the view that keeps most tracks complete, as long as `least` remain; of the sizes passed on
/// the way, keeps the one with most constraints.
fn greedy_views(problem: &Problem, open: &[bool], least: usize) -> Vec<Vec<usize>> {
    let seeing: Vec<usize> =
        (0..problem.views()).filter(|&view| open[view] && !problem.of_view[view].is_empty()).collect();
    let mut found: Vec<(usize, Vec<usize>)> = Vec::new();
    for first in evenly(&seeing, OPTIONS.most_first_views) {
        if problem.stop.is_stopped() {
            break;
        }
        let mut views = vec![first];
        let seen = problem.of_view[first].iter().map(|&k| problem.track_of(k as usize));
        let is_searched = |track: &usize| !problem.is_static[*track] && !problem.is_near_duplicate(*track);
        let mut tracks: Vec<usize> = seen.filter(is_searched).collect();
        let mut best: Option<(usize, Vec<usize>)> = None;
        while views.len() < OPTIONS.most_views {
            let mut counts = vec![0usize; problem.views()];
            let seen = tracks.iter().flat_map(|&track| problem.of_track(track)).map(|k| problem.view_of(k));
            seen.filter(|&view| open[view]).for_each(|view| counts[view] += 1);
            for &view in &views {
                counts[view] = 0;
            }
            // The first of equals, so that one input has one answer.
            let Some((next, &count)) = counts.iter().enumerate().rev().max_by_key(|&(_, count)| count) else { break };
            if count < least {
                break;
            }
            views.push(next);
            tracks.retain(|&track| problem.seen_in(track, next).is_some());
            if views.len() >= LEAST_VIEWS {
                let value = count.min(OPTIONS.enough_tracks) * (views.len() - 2);
                if best.as_ref().is_none_or(|(most, _)| value > *most) {
                    let mut sorted = views.clone();
                    sorted.sort_unstable();
                    best = Some((value, sorted));
                }
            }
        }
        found.extend(best);
    }
    found.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
    found.dedup();
    diverse(found.into_iter().map(|(_, views)| views).collect(), OPTIONS.most_blocks)
}

/// At most `most` of the items, evenly spread.
pub fn evenly<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let count = items.len().min(most);
    (0..count).map(|k| items[k * items.len() / count]).collect()
}

/// At most `most` of the ranked sets: those that share at most half of their views with every better one first, for one
/// that failed is not saved by changing one view.
fn diverse<Set: AsRef<[usize]>>(ranked: Vec<Set>, most: usize) -> Vec<Set> {
    let overlaps = |a: &[usize], b: &[usize]| 2 * a.iter().filter(|view| b.contains(view)).count() > a.len();
    let (mut chosen, mut similar): (Vec<Set>, Vec<Set>) = (Vec::new(), Vec::new());
    for views in ranked {
        let is_similar = chosen.iter().any(|better| overlaps(views.as_ref(), better.as_ref()));
        let list = if is_similar { &mut similar } else { &mut chosen };
        list.push(views);
    }
    chosen.append(&mut similar);
    chosen.truncate(most);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Input;
    use crate::domain::{Limits, RawInput, SolveSettings, StopToken, View, WarningCode};
    use crate::parallel::Threads;

    /// Tracks given as lists of the views that see them.
    fn input(views: usize, tracks: &[Vec<usize>]) -> Input {
        let mut raw =
            RawInput { views: vec![View::default(); views], track_count: tracks.len(), ..RawInput::default() };
        for (track, seen) in tracks.iter().enumerate() {
            for &view in seen {
                raw.view.push(view as u32);
                raw.track.push(track as u32);
                raw.x.push((track * 7 % 13) as f64);
                raw.y.push((track * 5 % 11) as f64);
            }
        }
        Input::new(raw, &Limits::default(), "test").expect("valid")
    }

    fn with_problem<T>(input: &Input, ask: impl FnOnce(&Problem) -> T) -> T {
        ask(&Problem::new(input, &SolveSettings::default(), Threads::ONE, &StopToken::default()))
    }

    #[test]
    fn complete_tracks_are_one_block_of_all_views() {
        let input = input(12, &vec![(0..12).collect(); 20]);
        assert_eq!(with_problem(&input, candidate_views), [(0..12).collect::<Vec<_>>()]);
        let long = self::input(100, &vec![(0..100).collect(); 20]);
        let views = &with_problem(&long, candidate_views)[0];
        assert_eq!((views.len(), views[0], views[39]), (OPTIONS.most_views_whole, 0, 97));
    }

    #[test]
    fn of_banded_tracks_the_densest_band_comes_first() {
        let mut tracks = vec![(0..5).collect::<Vec<_>>(); 30];
        tracks.extend(vec![(3..8).collect::<Vec<_>>(); 60]);
        let input = input(8, &tracks);
        let (candidates, block, warning) = with_problem(&input, |problem| {
            let candidates = candidate_views(problem);
            let block = problem.block(&candidates[0]);
            (candidates, block, problem.warnings[0].code)
        });
        assert_eq!(candidates[0], [3, 4, 5, 6, 7]);
        assert_eq!((block.complete.views(), block.tracks.len()), (5, 60));
        assert_eq!(warning, WarningCode::AssumedImageSize);
        let sampled = block.clone().sample(7, 1);
        assert_eq!((sampled.tracks.len(), sampled.complete.tracks()), (7, 7));
        let place = block.tracks.iter().position(|&track| track == sampled.tracks[3]).expect("a track of the block");
        assert_eq!(sampled.complete.point(2, 3), block.complete.point(2, place));
    }

    #[test]
    fn subsets_are_runs_and_combs_of_each_set_in_turn() {
        let found = subsets(&[(0..10).collect(), (20..30).collect(), (0..4).collect()]);
        assert_eq!(found.len(), OPTIONS.most_subsets);
        assert_eq!(found[..4], [[0, 1, 2, 3], [20, 21, 22, 23], [0, 3, 6, 9], [20, 23, 26, 29]]);
        assert!(found.iter().all(|views| views.is_sorted()));
        assert!(subsets(&[(0..4).collect()]).is_empty());
    }

    /// Pairs of three views share 12 tracks, those of three others 20 but for one that shares 9; among empty views.
    #[test]
    fn triplets_are_ranked_by_their_weakest_pair() {
        let pairs = [([1, 2], 12), ([1, 400], 12), ([2, 400], 12), ([3, 5], 20), ([3, 7], 20), ([5, 7], 9)];
        let tracks: Vec<Vec<usize>> = pairs.iter().flat_map(|&(pair, count)| vec![pair.to_vec(); count]).collect();
        let input = input(800, &tracks);
        let among = |open: Vec<bool>| with_problem(&input, |problem| triplets(problem, &open));
        assert_eq!(among(vec![true; 800]), [[1, 2, 400], [3, 5, 7]]);
        assert_eq!(among((0..800).map(|view| view != 400).collect()), [[3, 5, 7]]);
        assert!(among((0..800).map(|view| view < 6).collect()).is_empty());
        assert!(with_problem(&input, candidate_views).is_empty());
    }

    #[test]
    fn views_that_share_nothing_make_no_block() {
        let input = input(4, &[vec![0, 1], vec![2, 3], vec![1, 2]]);
        assert!(with_problem(&input, candidate_views).is_empty());
    }
}
