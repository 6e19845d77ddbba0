//! Near-duplicates: tracks that stand within a few pixels of another in every view.
//!
//! A detector that fires many times on one blob, or a moving object of a few pixels, gives many tracks that say what one
//! of them says. Where that one is wrong they outvote everything else: any four tracks of which one is of the group
//! explain all of it, and so does a camera that one of them moved. One of each group therefore stands for the others
//! until a reconstruction stands, which judges them all.

use std::cmp::Reverse;
use std::ops::Range;

use nalgebra::Vector2;

use super::block::Block;
use super::consensus::LEAST_INLIERS;
use crate::domain::{StopToken, VERIFIED};

options! {
    /// What counts as near-duplicates.
    pub struct NearDuplicateOptions {
        /// Root mean square distance over the views that both are in, up to which they are, in units of the noise that
        /// the solve starts from. Two observations of one point are 1.4 apart.
        near: f64 = 2.0,
        /// Share of the views of the shorter one that both must be in. A detector that fires many times loses some of
        /// them at times; of two tracks that only cross fewer are near.
        least_common: f64 = 0.5,
        /// Tracks of the least group: as many as geometry takes to verify anything.
        least_group: usize = LEAST_INLIERS,
        /// Tracks that must remain: twice those that verify anything.
        least_remaining: usize = 2 * LEAST_INLIERS,
        /// Tracks that each is compared with, at most: of more in one place some are of one group.
        most_compared: usize = 200,
    }
}

const OPTIONS: NearDuplicateOptions = NearDuplicateOptions::DEFAULT;

/// Tracks between two questions to the stop token.
const TRACKS_A_QUESTION: usize = 1 << 10;

/// All tracks, to be compared.
struct Tracks<'a, V: Fn(usize) -> usize> {
    /// Observations of each.
    ranges: &'a [usize],
    /// View of each observation.
    views: V,
    /// Normalised image points.
    xy: &'a [Vector2<f64>],
    /// Largest root mean square distance.
    near: f64,
    /// Observation after observation, the place in its view and its track, sorted.
    places: Vec<(Place, u32)>,
}

/// A view and a square of its image.
type Place = (u32, i32, i32);

/// The representative of each track: itself, but for near-duplicates. Of tracks whose first, middle or last observations
/// are near each other the longest is that of the others. Once `stop` fires, every track represents itself.
///
/// * `ranges`: observations of each track
/// * `views`: view of each observation
/// * `xy`: normalised image points
/// * `noise`: normalised, that the solve starts from
pub fn representatives(
    ranges: &[usize],
    views: impl Fn(usize) -> usize,
    xy: &[Vector2<f64>],
    noise: f64,
    stop: &StopToken,
) -> Vec<usize> {
    let tracks = Tracks::new(ranges, views, xy, OPTIONS.near * noise);
    let count = ranges.len().saturating_sub(1);
    let themselves = || (0..count).collect();
    let mut representative: Vec<usize> = themselves();
    let mut order: Vec<usize> = (0..count).filter(|&track| tracks.of(track).len() >= VERIFIED).collect();
    order.sort_by_key(|&track| Reverse(tracks.of(track).len()));
    let mut is_first = vec![false; count];
    for (k, &track) in order.iter().enumerate() {
        if k.is_multiple_of(TRACKS_A_QUESTION) && stop.is_stopped() {
            return themselves();
        }
        match tracks.candidates(track).filter(|&first| is_first[first]).find(|&first| tracks.are_near(first, track)) {
            Some(first) => representative[track] = first,
            None => is_first[track] = true,
        }
    }
    let mut size = vec![0; count];
    representative.iter().for_each(|&first| size[first] += 1);
    for (track, representative) in representative.iter_mut().enumerate() {
        if size[*representative] < OPTIONS.least_group {
            *representative = track;
        }
    }
    let remaining = representative.iter().enumerate().filter(|(track, representative)| track == *representative);
    if remaining.count() >= OPTIONS.least_remaining { representative } else { themselves() }
}

impl<'a, V: Fn(usize) -> usize> Tracks<'a, V> {
    fn new(ranges: &'a [usize], views: V, xy: &'a [Vector2<f64>], near: f64) -> Self {
        let mut tracks = Self { ranges, views, xy, near, places: Vec::new() };
        let of_track = |track: usize| tracks.of(track).map(move |k| (k, track as u32));
        let observations = (0..ranges.len().saturating_sub(1)).flat_map(of_track);
        let mut places: Vec<(Place, u32)> = observations.map(|(k, track)| (tracks.place(k), track)).collect();
        places.sort_unstable();
        tracks.places = places;
        tracks
    }

    fn of(&self, track: usize) -> Range<usize> {
        self.ranges[track]..self.ranges[track + 1]
    }

    /// Squares are so wide that what is near by twice the mean is in the next one at most.
    fn place(&self, k: usize) -> Place {
        let [x, y] = [self.xy[k].x, self.xy[k].y].map(|x| (x / (2.0 * self.near)).floor() as i32);
        ((self.views)(k) as u32, x, y)
    }

    /// Tracks that may be near this one.
    fn candidates(&self, track: usize) -> impl Iterator<Item = usize> {
        let seen = self.of(track);
        let ends = [seen.start, seen.start + seen.len() / 2, seen.end - 1];
        let around = ends.into_iter().flat_map(|k| {
            let (view, x, y) = self.place(k);
            (-1..=1).flat_map(move |dx: i32| {
                (-1..=1).map(move |dy: i32| (view, x.saturating_add(dx), y.saturating_add(dy)))
            })
        });
        let in_place = |place: Place| {
            let first = self.places.partition_point(|(other, _)| *other < place);
            self.places[first..].iter().take_while(move |(other, _)| *other == place).map(|(_, track)| *track as usize)
        };
        around.flat_map(in_place).take(OPTIONS.most_compared)
    }

    /// Whether two tracks are near each other where both are seen, and are so often enough to say so.
    fn are_near(&self, long: usize, short: usize) -> bool {
        let (long, short) = (self.of(long), self.of(short));
        let least = VERIFIED.max((OPTIONS.least_common * short.len() as f64).ceil() as usize);
        let (mut j, mut common, mut sum) = (long.start, 0, 0.0);
        for k in short {
            let view = (self.views)(k);
            while j < long.end && (self.views)(j) < view {
                j += 1;
            }
            if j < long.end && (self.views)(j) == view {
                sum += (self.xy[j] - self.xy[k]).norm_squared();
                common += 1;
            }
        }
        common >= least && sum <= common as f64 * self.near * self.near
    }
}

/// The block without what others represent.
///
/// * `representative`: that of each track of the input
pub fn without(representative: &[usize], block: Block) -> Block {
    let kept: Vec<usize> = block
        .tracks
        .iter()
        .enumerate()
        .filter(|(_, track)| representative[**track] == **track)
        .map(|(k, _)| k)
        .collect();
    if kept.len() == block.tracks.len() { block } else { block.select(&kept) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOISE: f64 = 0.005;

    /// Tracks of these views, at a place that a track may leave in its last view; the representative of each that has
    /// another.
    fn found(tracks: &[(Range<usize>, [f64; 3])]) -> Vec<(usize, usize)> {
        let (mut ranges, mut views, mut xy) = (vec![0], Vec::new(), Vec::new());
        for (of_track, [x, y, later]) in tracks {
            for view in of_track.clone() {
                views.push(view);
                xy.push(Vector2::new(*x, if view + 1 == of_track.end { *later } else { *y }));
            }
            ranges.push(views.len());
        }
        let found = representatives(&ranges, |k| views[k], &xy, NOISE, &StopToken::default());
        found.into_iter().enumerate().filter(|(track, representative)| track != representative).collect()
    }

    fn apart(count: usize) -> Vec<(Range<usize>, [f64; 3])> {
        (0..count).map(|k| (0..3, [0.05 * k as f64, 0.0, 0.0])).collect()
    }

    #[test]
    fn the_longest_of_a_group_represents_it_and_fewer_represent_themselves() {
        let mut tracks = apart(20);
        tracks.extend((0..OPTIONS.least_group - 1).map(|k| (2..6, [0.5 + 1e-3 * k as f64, 0.3, 0.3])));
        tracks.push((0..8, [0.501, 0.3, 0.3]));
        tracks.extend((0..2).map(|k| (0..3, [0.1 + 1e-3 * f64::from(k), 0.3, 0.3])));
        // Near the group where it begins, and not where it ends; in too few of its views.
        tracks.push((2..6, [0.5, 0.3, 0.4]));
        tracks.push((6..20, [0.5, 0.3, 0.3]));
        let longest = 20 + OPTIONS.least_group - 1;
        assert_eq!(found(&tracks), (20..longest).map(|track| (track, longest)).collect::<Vec<_>>());
    }

    #[test]
    fn nothing_is_left_aside_without_a_group_or_beside_too_little() {
        assert!(found(&apart(20)).is_empty());
        let mut group = vec![(0..3, [0.5, 0.3, 0.3]); 40];
        group.extend(apart(OPTIONS.least_remaining - 2));
        assert!(found(&group).is_empty());
        group.push((0..3, [0.9, -0.3, -0.3]));
        assert_eq!(found(&group), (1..40).map(|track| (track, 0)).collect::<Vec<_>>());
        assert!(found(&[]).is_empty());
        assert!(found(&vec![(0..3, [f64::MAX, -f64::MAX, f64::MIN]); 3]).is_empty());
    }
}
