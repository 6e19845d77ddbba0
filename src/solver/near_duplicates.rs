//! Groups of near-duplicates: tracks that stand within a few pixels of each other in every view.
//!
//! A detector that fires many times on one blob, or a moving object of a few pixels, gives many tracks that say what
//! one of them says. Where that one is wrong they outvote everything else: any four tracks of which one is of the group
//! explain all of it. A search therefore looks at one of each group; what it finds is then extended to the others.

use super::block::Block;
use super::grow::LEAST_INLIERS;
use crate::geometry::measurement::CompleteBlock;

/// Tracks of the least group that is thinned: as many as geometry takes to verify anything.
const LEAST_NEAR_DUPLICATES: usize = LEAST_INLIERS;
/// Tracks that must remain for a search: twice those that verify anything.
const LEAST_REMAINING: usize = 2 * LEAST_INLIERS;
/// Tracks that are compared with each other, for every one that is searched: the time is quadratic in them.
const COMPARED: usize = 4;

/// At most `most` tracks of the block, chosen at random among those that are left when of every group one is kept;
/// `None` where there are no groups, or too little beside them.
///
/// * `noise`: normalised units; tracks are near each other that differ by no more than two of this noise would on
///   average
pub fn thinned(block: &Block, most: usize, noise: f64, seed: u64) -> Option<Block> {
    let sample = block.clone().sample(COMPARED * most, seed);
    let kept = one_of_each(&sample.complete, noise);
    (kept.len() < sample.tracks.len() && kept.len() >= LEAST_REMAINING).then(|| sample.select(&kept).sample(most, seed))
}

/// The tracks without those of groups, but for the first of each.
fn one_of_each(block: &CompleteBlock, noise: f64) -> Vec<usize> {
    let near = 4.0 * block.views() as f64 * noise * noise;
    // Each track with the first one that stands for it and is near; the firsts are not near each other.
    let mut first_of = Vec::with_capacity(block.tracks());
    let mut firsts: Vec<usize> = Vec::new();
    for track in 0..block.tracks() {
        let first = firsts.iter().copied().find(|&first| are_near(block, track, first, near));
        if first.is_none() {
            firsts.push(track);
        }
        first_of.push(first.unwrap_or(track));
    }
    let mut size = vec![0; block.tracks()];
    first_of.iter().for_each(|&first| size[first] += 1);
    (0..block.tracks())
        .filter(|&track| first_of[track] == track || size[first_of[track]] < LEAST_NEAR_DUPLICATES)
        .collect()
}

/// Whether the squared distances of two tracks sum up to no more than this.
fn are_near(block: &CompleteBlock, a: usize, b: usize, most: f64) -> bool {
    let mut sum = 0.0;
    block.track(a).iter().zip(block.track(b)).all(|(a, b)| {
        sum += (a.xy - b.xy).norm_squared();
        sum <= most
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;

    const NOISE: f64 = 0.005;

    /// A block of tracks in two views, each at the same place in both but for the last coordinate.
    fn block(tracks: &[[f64; 3]]) -> Block {
        let points: Vec<Vector2<f64>> =
            tracks.iter().flat_map(|&[x, y, later]| [Vector2::new(x, y), Vector2::new(x, later)]).collect();
        let complete = CompleteBlock::new(2, tracks.len(), &points, None);
        Block { views: vec![0, 1], tracks: (10..10 + tracks.len()).collect(), complete }
    }

    #[test]
    fn of_a_group_one_is_kept_and_of_fewer_all() {
        let apart = (0..20).map(|k| [0.05 * f64::from(k), 0.0, 0.0]);
        let group = (0..LEAST_NEAR_DUPLICATES).map(|k| [0.5 + 1e-4 * k as f64, 0.3, 0.3]);
        let pair = (0..2).map(|k| [0.1 + 1e-4 * f64::from(k), 0.3, 0.3]);
        // Near the group in one view, and not in the other.
        let stranger = [0.5, 0.3, 0.4];
        let tracks: Vec<[f64; 3]> = apart.chain(group).chain(pair).chain([stranger]).collect();
        let thinned = thinned(&block(&tracks), 100, NOISE, 0).expect("a group");
        let expected: Vec<usize> = (10..=30).chain(38..=40).collect();
        assert_eq!(thinned.tracks, expected);
        assert_eq!(thinned.complete.point(1, 23).y, stranger[2]);
    }

    #[test]
    fn nothing_is_thinned_without_a_group_or_beside_too_little() {
        let apart: Vec<[f64; 3]> = (0..20).map(|k| [0.05 * f64::from(k), 0.0, 0.0]).collect();
        assert!(thinned(&block(&apart), 100, NOISE, 0).is_none());
        let mut group: Vec<[f64; 3]> = vec![[0.5, 0.3, 0.3]; 40];
        group.extend(&apart[..LEAST_REMAINING - 2]);
        assert!(thinned(&block(&group), 100, NOISE, 0).is_none());
        group.push(apart[19]);
        assert_eq!(thinned(&block(&group), 100, NOISE, 0).expect("a group").tracks.len(), LEAST_REMAINING);
    }
}
