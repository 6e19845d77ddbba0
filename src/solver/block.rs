//! Which views and tracks are solved together: normalisation and the choice of complete blocks.

use std::collections::BTreeSet;

use nalgebra::Vector2;
use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use crate::domain::{ImageSize, Input, StopToken, View, Warning, WarningCode};
use crate::geometry::measurement::{CompleteBlock, Normalization};
use crate::geometry::statistics::median;

/// Tracks that a block should have: twice the eight that verification needs, for half of them may be wrong.
const WANTED_TRACKS: usize = 16;
/// Tracks below which no block is tried: verification needs eight inliers.
pub const LEAST_TRACKS: usize = 8;
/// Views below which a projective reconstruction carries no calibration worth searching for.
pub const LEAST_VIEWS: usize = 3;
/// Views that a block grows to. Real tracks are short: longer blocks hold few of them.
const MOST_VIEWS: usize = 10;
/// Views that are solved as one block where tracks are complete over all views; of more, these many evenly spread:
/// bundle adjustment of a block is cubic in its views.
const MOST_VIEWS_WHOLE: usize = 40;
/// Tracks beyond which more of them do not make a block better.
const ENOUGH_TRACKS: usize = 300;
/// Views that blocks are begun from; of long sequences not every view needs its turn to find a few dense blocks.
const MOST_FIRST_VIEWS: usize = 64;
/// Blocks that are tried, best first, before the best result stands.
const MOST_BLOCKS: usize = 4;

/// A set of views with the tracks that are seen in all of them.
#[derive(Debug, Clone)]
pub struct Block {
    /// Views of the input, increasing.
    pub views: Vec<usize>,
    /// Tracks of the input, increasing.
    pub tracks: Vec<usize>,
    /// Their points; view `i` and track `j` are `views[i]` and `tracks[j]` of the input.
    pub complete: CompleteBlock,
}

/// The transform from pixels that the whole solve uses: principal points assumed in the image centres, lengths in
/// units of the largest image side.
pub fn normalization(input: &Input) -> (Normalization, Vec<Warning>) {
    let mut warnings = Vec::new();
    // One camera took the views of unknown size: one centre, or its principal point would move from view to view.
    let [low, high] = extent_of_unsized(input);
    let assumed = ((low + high) / 2.0, (high - low).amax());
    let frames: Vec<(Vector2<f64>, f64)> = input
        .views()
        .iter()
        .map(|view| {
            view.size.map_or(assumed, |size| (image_centre(size), f64::from(size.width_px.max(size.height_px))))
        })
        .collect();
    let scale_px = frames.iter().map(|(_, side)| *side).fold(0.0, f64::max);
    let centres_px = frames.into_iter().map(|(centre, _)| centre).collect();
    let unknown = input.views().iter().filter(|view| view.size.is_none()).count();
    if unknown > 0 {
        warnings.push(Warning::new(
            WarningCode::AssumedImageSize,
            format!(
                "{unknown} of {} views came without an image size; the extent of their points stood in, so the principal \
                 point and with it the calibration may be off; give the size",
                input.view_count()
            ),
        ));
    }
    warnings.extend(outside(input));
    // All points in one place: any scale will do.
    let scale_px = if scale_px > 0.0 { scale_px } else { 1.0 };
    (Normalization { centres_px, scale_px }, warnings)
}

/// Distance from the middle of the image within which half of the points must lie, in the longer image side: within an
/// image it is half a side at most, the paper's scenes, whose cameras see beyond their image, have .8 of it, and a size
/// that is three times too small shows.
const MEDIAN_WITHIN: f64 = 1.0;

/// Share of the points beyond the right or lower edge of their image, and none beyond the others, from which its size
/// is doubted: that of a reduced copy leaves half of the points out, exchanged sides a fiftieth and more. Points of
/// scenes that were made up lie beyond all edges.
const BEYOND_TWO_EDGES: f64 = 0.01;
/// How far beyond an edge a point may lie, in pixels: there are conventions that differ by half of one.
const EDGE_PX: f64 = 1.0;

/// Says so where the points do not lie in images of the size that was given: the calibration rests on its middle.
fn outside(input: &Input) -> Option<Warning> {
    beyond_two_edges(input).or_else(|| far_outside(input))
}

/// Points that fill an image from its upper left corner, and a larger one than the size that was given.
fn beyond_two_edges(input: &Input) -> Option<Warning> {
    let (mut sized, mut beyond) = (0usize, 0usize);
    for k in 0..input.observation_count() {
        let Some(size) = input.views()[input.view_of(k)].size else { continue };
        let [x, y] = input.point_px(k);
        if x.min(y) < -EDGE_PX {
            return None;
        }
        sized += 1;
        beyond += usize::from(x > f64::from(size.width_px) + EDGE_PX || y > f64::from(size.height_px) + EDGE_PX);
    }
    let share = beyond as f64 / sized.max(1) as f64;
    (share > BEYOND_TWO_EDGES).then(|| {
        let detail = format!(
            "{:.0} % of the points lie beyond the right or lower edge of their image and none beyond the others: is the \
             size that was given that of these images, and are width and height in their places?",
            100.0 * share
        );
        Warning::new(WarningCode::PointsOutsideImage, detail)
    })
}

/// Points that no image of such a size could show.
fn far_outside(input: &Input) -> Option<Warning> {
    let of = |k: usize| {
        let size = input.views()[input.view_of(k)].size?;
        let offset = Vector2::from(input.point_px(k)) - image_centre(size);
        Some(offset.amax() / f64::from(size.width_px.max(size.height_px)))
    };
    let mut offsets: Vec<f64> = (0..input.observation_count()).filter_map(of).collect();
    (median(&mut offsets) > MEDIAN_WITHIN).then(|| {
        let detail = "half of the points lie farther from the middle of their image than it is long: is the size that was \
                      given that of these images, or of a reduced copy?";
        Warning::new(WarningCode::PointsOutsideImage, detail)
    })
}

/// Says so where views of several cameras or sizes are given one focal length.
///
/// * `cameras`: each group has a calibration of its own, so that sizes alone matter, within a group
/// * `zooms`: each view has a focal length of its own, so that nothing is merged
pub fn merged_cameras(input: &Input, cameras: bool, zooms: bool) -> Option<Warning> {
    if zooms {
        return None;
    }
    let (group_of, groups) = camera_groups(input);
    let size = |view: &View| view.size.map(|size| (size.width_px, size.height_px));
    let kinds: BTreeSet<_> =
        input.views().iter().zip(&group_of).map(|(view, group)| (cameras.then_some(*group), size(view))).collect();
    let distinct = if cameras { groups } else { 1 };
    if kinds.len() <= distinct && (cameras || groups == 1) {
        return None;
    }
    let detail = if cameras {
        "views of one camera group have several image sizes; they were solved with one focal length in pixels"
            .to_owned()
    } else {
        format!(
            "{groups} camera groups and {} image sizes were solved as one camera with one focal length",
            kinds.len()
        )
    };
    Some(Warning::new(WarningCode::CameraGroupsMerged, detail))
}

/// Camera group of each view, counted from 0 in rising order of the input's numbers, and how many there are.
pub fn camera_groups(input: &Input) -> (Vec<usize>, usize) {
    let numbers: BTreeSet<u32> = input.views().iter().map(|view| view.camera_group).collect();
    let numbers: Vec<u32> = numbers.into_iter().collect();
    let of = |view: &View| numbers.partition_point(|number| *number < view.camera_group);
    (input.views().iter().map(of).collect(), numbers.len())
}

/// Weight of each observation: the squared ratio of the median standard deviation of all to its own; 1 where none are
/// given.
pub fn weights(input: &Input) -> Vec<f64> {
    let count = input.observation_count();
    let mut sigmas: Vec<f64> = (0..count).filter_map(|k| input.sigma_px(k)).collect();
    let typical = median(&mut sigmas);
    (0..count).map(|k| input.sigma_px(k).map_or(1.0, |sigma| (typical / sigma).powi(2))).collect()
}

/// Centre of an image whose top-left pixel's centre is (0, 0).
fn image_centre(size: ImageSize) -> Vector2<f64> {
    Vector2::new((f64::from(size.width_px) - 1.0) / 2.0, (f64::from(size.height_px) - 1.0) / 2.0)
}

/// Share of the points on either side that the extent leaves out: a few wild ones do not make an image.
const EXTENT_TAIL: f64 = 0.02;

/// Box around the points of all views without a size, but for a tail on every side; the unit square without points.
fn extent_of_unsized(input: &Input) -> [Vector2<f64>; 2] {
    let points: Vec<[f64; 2]> = (0..input.observation_count())
        .filter(|&k| input.views()[input.view_of(k)].size.is_none())
        .map(|k| input.point_px(k))
        .collect();
    if points.is_empty() {
        return [Vector2::zeros(), Vector2::repeat(1.0)];
    }
    let tail = (EXTENT_TAIL * points.len() as f64) as usize;
    let bounds = [0, 1].map(|axis| {
        let mut values: Vec<f64> = points.iter().map(|point| point[axis]).collect();
        values.sort_by(f64::total_cmp);
        [values[tail], values[values.len() - 1 - tail]]
    });
    [Vector2::new(bounds[0][0], bounds[1][0]), Vector2::new(bounds[0][1], bounds[1][1])]
}

/// Sets of views worth solving, best first; empty when no three views share enough tracks.
///
/// Once `stop` fires the answer is whatever was found by then.
pub fn candidate_views(input: &Input, ranges: &[usize], stop: &StopToken) -> Vec<Vec<usize>> {
    if let Some(views) = whole(input, ranges) {
        return vec![views];
    }
    candidate_views_among(input, ranges, &vec![true; input.view_count()], stop)
}

/// The views of the one block of an input whose tracks are complete; see [`complete_views`].
pub fn whole(input: &Input, ranges: &[usize]) -> Option<Vec<usize>> {
    complete_views(input, ranges).map(|views| super::extend::evenly(&views, MOST_VIEWS_WHOLE))
}

/// The same of incomplete tracks, each set of one camera group: those of the group with most observations first.
pub fn candidate_views_of_one_camera(input: &Input, ranges: &[usize], stop: &StopToken) -> Vec<Vec<usize>> {
    let (group_of, groups) = camera_groups(input);
    let mut observed = vec![0usize; groups];
    (0..input.observation_count()).for_each(|k| observed[group_of[input.view_of(k)]] += 1);
    let mut order: Vec<usize> = (0..groups).collect();
    order.sort_by_key(|&group| (std::cmp::Reverse(observed[group]), group));
    let mut found: Vec<Vec<usize>> = Vec::new();
    for group in order {
        let open: Vec<bool> = group_of.iter().map(|of| *of == group).collect();
        let enough = open.iter().filter(|&&open| open).count() >= LEAST_VIEWS;
        if enough && found.len() < MOST_BLOCKS && !stop.is_stopped() {
            found.extend(candidate_views_among(input, ranges, &open, stop));
        }
    }
    found.truncate(MOST_BLOCKS);
    found
}

/// The same of incomplete tracks, only of views that are `open` (one entry a view).
pub fn candidate_views_among(input: &Input, ranges: &[usize], open: &[bool], stop: &StopToken) -> Vec<Vec<usize>> {
    for least in [WANTED_TRACKS, LEAST_TRACKS] {
        let found = greedy_views(input, ranges, open, least, stop);
        if !found.is_empty() {
            return found;
        }
    }
    Vec::new()
}

/// Views of a subset: of a track with three wrong observations of ten, four views are clean one time in six.
const SUBSET_VIEWS: usize = 4;
/// Subsets of one set, and of all sets together.
const SUBSETS_OF_SET: usize = 6;
const MOST_SUBSETS: usize = 8;

/// Small subsets of these sets of views: runs and combs in turn, spread over the set; the first of each set first. A
/// track with some wrong observations is clean in some of them.
pub fn subsets(sets: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let subset = |views: &[usize], k: usize| -> Vec<usize> {
        let longest = (views.len() - 1) / (SUBSET_VIEWS - 1);
        let step = if k.is_multiple_of(2) { 1 } else { longest };
        let starts = views.len() - (SUBSET_VIEWS - 1) * step;
        let first = (k * starts / SUBSETS_OF_SET).min(starts - 1);
        (0..SUBSET_VIEWS).map(|i| views[first + i * step]).collect()
    };
    let mut found: Vec<Vec<usize>> = Vec::new();
    for k in 0..SUBSETS_OF_SET {
        for views in sets.iter().filter(|views| views.len() > SUBSET_VIEWS) {
            let subset = subset(views, k);
            if !found.contains(&subset) {
                found.push(subset);
            }
        }
    }
    found.truncate(MOST_SUBSETS);
    found
}

/// The views in which anything is observed, if at least half of the tracks that are observed at all, and enough of
/// them, are seen in all of these. Padding, views and tracks without observations, changes nothing.
pub fn complete_views(input: &Input, ranges: &[usize]) -> Option<Vec<usize>> {
    let views = observed_views(input);
    let observed = ranges.windows(2).filter(|range| range[1] > range[0]).count();
    let complete = ranges.windows(2).filter(|range| range[1] - range[0] == views.len()).count();
    (views.len() >= LEAST_VIEWS && complete >= LEAST_TRACKS && 2 * complete >= observed).then_some(views)
}

/// The views in which anything is observed, increasing.
pub fn observed_views(input: &Input) -> Vec<usize> {
    let mut seen = vec![false; input.view_count()];
    (0..input.observation_count()).for_each(|k| seen[input.view_of(k)] = true);
    (0..seen.len()).filter(|&view| seen[view]).collect()
}

/// From every view, adds the view that keeps most tracks complete, as long as `least` remain; of the sizes passed on
/// the way, keeps the one with most constraints.
fn greedy_views(input: &Input, ranges: &[usize], open: &[bool], least: usize, stop: &StopToken) -> Vec<Vec<usize>> {
    let mut tracks_of_view: Vec<Vec<usize>> = vec![Vec::new(); input.view_count()];
    for k in (0..input.observation_count()).filter(|&k| open[input.view_of(k)]) {
        tracks_of_view[input.view_of(k)].push(input.track_of(k));
    }
    let mut found: Vec<(usize, Vec<usize>)> = Vec::new();
    for first in first_views(&tracks_of_view) {
        if stop.is_stopped() {
            break;
        }
        let seen = tracks_of_view[first].clone();
        let mut views = vec![first];
        let mut tracks = seen;
        let mut best: Option<(usize, Vec<usize>)> = None;
        while views.len() < MOST_VIEWS {
            let mut counts = vec![0usize; input.view_count()];
            for &track in &tracks {
                for k in (ranges[track]..ranges[track + 1]).filter(|&k| open[input.view_of(k)]) {
                    counts[input.view_of(k)] += 1;
                }
            }
            for &view in &views {
                counts[view] = 0;
            }
            // The first of equals, so that one input has one answer.
            let Some((next, &count)) = counts.iter().enumerate().rev().max_by_key(|&(_, count)| count) else { break };
            if count < least {
                break;
            }
            views.push(next);
            tracks.retain(|&track| (ranges[track]..ranges[track + 1]).any(|k| input.view_of(k) == next));
            if views.len() >= LEAST_VIEWS {
                let value = count.min(ENOUGH_TRACKS) * (views.len() - 2);
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
    diverse(found.into_iter().map(|(_, views)| views).collect())
}

/// The views that blocks are begun from: all that see something, or as many as are affordable, evenly along the
/// sequence.
fn first_views(tracks_of_view: &[Vec<usize>]) -> Vec<usize> {
    let seeing: Vec<usize> = (0..tracks_of_view.len()).filter(|&view| !tracks_of_view[view].is_empty()).collect();
    super::extend::evenly(&seeing, MOST_FIRST_VIEWS)
}

/// At most [`MOST_BLOCKS`] of the ranked sets: those that share at most half of their views with every better one
/// first, for a block that failed is not saved by changing one view.
fn diverse(ranked: Vec<Vec<usize>>) -> Vec<Vec<usize>> {
    let overlaps = |a: &[usize], b: &[usize]| 2 * a.iter().filter(|view| b.contains(view)).count() > a.len();
    let (mut chosen, mut similar): (Vec<Vec<usize>>, Vec<Vec<usize>>) = (Vec::new(), Vec::new());
    for views in ranked {
        let list = if chosen.iter().any(|better| overlaps(&views, better)) { &mut similar } else { &mut chosen };
        list.push(views);
    }
    chosen.append(&mut similar);
    chosen.truncate(MOST_BLOCKS);
    chosen
}

impl Block {
    /// The block of at most `most` of its tracks, chosen at random; `seed` decides which.
    pub fn sample(self, most: usize, seed: u64) -> Self {
        self.sample_with(most, seed, &[])
    }

    /// The same; tracks of the input that are among `kept` (increasing) stay in any case.
    pub fn sample_with(self, most: usize, seed: u64, kept: &[usize]) -> Self {
        if self.tracks.len() <= most {
            return self;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut chosen = index::sample(&mut rng, self.tracks.len(), most).into_vec();
        chosen.extend((0..self.tracks.len()).filter(|&j| kept.binary_search(&self.tracks[j]).is_ok()));
        chosen.sort_unstable();
        chosen.dedup();
        self.select(&chosen)
    }

    /// The block of these of its tracks, increasing.
    pub fn select(&self, chosen: &[usize]) -> Self {
        let tracks = chosen.iter().map(|&j| self.tracks[j]).collect();
        Self { views: self.views.clone(), tracks, complete: self.complete.select(chosen) }
    }
}

/// The block of these views: all tracks that are complete over them.
pub fn extract(input: &Input, ranges: &[usize], normalization: &Normalization, views: &[usize]) -> Block {
    let mut place = vec![None; input.view_count()];
    for (i, &view) in views.iter().enumerate() {
        place[view] = Some(i);
    }
    let mut tracks = Vec::new();
    let mut points = Vec::new();
    let mut depths = Vec::new();
    for track in 0..input.track_count() {
        // Observations of a track are sorted by view, and so are the views of a block.
        let inside: Vec<usize> =
            (ranges[track]..ranges[track + 1]).filter(|&k| place[input.view_of(k)].is_some()).collect();
        if inside.len() == views.len() {
            tracks.push(track);
            for k in inside {
                points.push(normalization.normalize(input.view_of(k), input.point_px(k)));
                depths.extend(input.depth(k));
            }
        }
    }
    let depths = input.has_depths().then_some(depths);
    let complete = CompleteBlock::new(views.len(), tracks.len(), &points, depths);
    Block { views: views.to_vec(), tracks, complete }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{ImageSize, Limits, RawInput};

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

    #[test]
    fn complete_tracks_are_one_block_of_all_views() {
        let input = input(12, &vec![(0..12).collect(); 20]);
        let ranges = input.track_ranges();
        assert_eq!(candidate_views(&input, &ranges, &StopToken::default()), [(0..12).collect::<Vec<_>>()]);
        let long = self::input(100, &vec![(0..100).collect(); 20]);
        let views = &candidate_views(&long, &long.track_ranges(), &StopToken::default())[0];
        assert_eq!((views.len(), views[0], views[39]), (MOST_VIEWS_WHOLE, 0, 97));
    }

    #[test]
    fn of_banded_tracks_the_densest_band_comes_first() {
        let mut tracks = vec![(0..5).collect::<Vec<_>>(); 30];
        tracks.extend(vec![(3..8).collect::<Vec<_>>(); 60]);
        let input = input(8, &tracks);
        let ranges = input.track_ranges();
        let candidates = candidate_views(&input, &ranges, &StopToken::default());
        assert_eq!(candidates[0], [3, 4, 5, 6, 7]);
        let (normalization, warnings) = normalization(&input);
        let block = extract(&input, &ranges, &normalization, &candidates[0]);
        assert_eq!((block.complete.views(), block.tracks.len()), (5, 60));
        assert_eq!(warnings[0].code, WarningCode::AssumedImageSize);
        let sampled = block.clone().sample(7, 1);
        assert_eq!((sampled.tracks.len(), sampled.complete.tracks()), (7, 7));
        let place = block.tracks.iter().position(|&track| track == sampled.tracks[3]).expect("a track of the block");
        assert_eq!(sampled.complete.point(2, 3), block.complete.point(2, place));
    }

    #[test]
    fn subsets_are_runs_and_combs_of_each_set_in_turn() {
        let found = subsets(&[(0..10).collect(), (20..30).collect(), (0..4).collect()]);
        assert_eq!(found.len(), MOST_SUBSETS);
        assert_eq!(found[..4], [[0, 1, 2, 3], [20, 21, 22, 23], [0, 3, 6, 9], [20, 23, 26, 29]]);
        assert!(found.iter().all(|views| views.is_sorted()));
        assert!(subsets(&[(0..4).collect()]).is_empty());
    }

    #[test]
    fn an_image_size_that_does_not_hold_the_points_is_doubted() {
        let codes = |width_px: u32, height_px: u32| {
            let raw = RawInput {
                views: vec![View { size: Some(ImageSize { width_px, height_px }), ..View::default() }; 3],
                track_count: 10,
                view: (0..30).map(|k| k % 3).collect(),
                track: (0..30).map(|k| k / 3).collect(),
                x: (0..30).map(|k| 30.0 * f64::from(k)).collect(),
                y: (0..30).map(|k| 20.0 * f64::from(k)).collect(),
                ..RawInput::default()
            };
            let input = Input::new(raw, &Limits::default(), "points").expect("valid");
            normalization(&input).1.iter().map(|warning| warning.code).collect::<Vec<_>>()
        };
        assert_eq!(codes(880, 600), []);
        // A reduced copy, and exchanged sides.
        for (width, height) in [(440, 300), (220, 150), (600, 880)] {
            assert_eq!(codes(width, height), [WarningCode::PointsOutsideImage], "{width} x {height}");
        }
    }

    #[test]
    fn views_of_unknown_size_share_one_centre() {
        let input = input(3, &[vec![0, 1], vec![1, 2], vec![0, 2], vec![0, 1, 2]]);
        let (normalization, _) = normalization(&input);
        assert!(normalization.centres_px.iter().all(|centre| *centre == normalization.centres_px[0]));
    }

    #[test]
    fn views_that_share_nothing_make_no_block() {
        let input = input(4, &[vec![0, 1], vec![2, 3], vec![1, 2]]);
        assert!(candidate_views(&input, &input.track_ranges(), &StopToken::default()).is_empty());
    }
}
