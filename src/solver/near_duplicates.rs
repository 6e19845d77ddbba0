//! Near-duplicates: tracks that stand within a few pixels of another in every view.
//!
//! A detector that fires many times on one blob, or a moving object of a few pixels, gives many tracks that say what one
//! of them says. Where that one is wrong they outvote everything else: any four tracks of which one is of the group
//! explain all of it, and so does a camera that one of them moved. One of each group therefore stands for the others
//! until a reconstruction stands, which judges them all.

use std::borrow::Cow;
use std::collections::HashMap;

use nalgebra::Vector2;

use super::block::Block;
use super::grow::LEAST_INLIERS;
use super::problem::{Problem, VERIFIED};

/// What counts as near-duplicates.
#[derive(Debug, Clone, PartialEq)]
pub struct NearDuplicateOptions {
    /// Distance in every view that both are in, normalised units.
    pub near: f64,
    /// Tracks of the least group: as many as geometry takes to verify anything.
    pub least_group: usize,
    /// Tracks that must remain: twice those that verify anything.
    pub least_remaining: usize,
}

impl NearDuplicateOptions {
    pub const DEFAULT: Self = Self { near: 0.004, least_group: LEAST_INLIERS, least_remaining: 2 * LEAST_INLIERS };
}

const OPTIONS: NearDuplicateOptions = NearDuplicateOptions::DEFAULT;

/// A view and a square of its image, as wide as near-duplicates may be apart.
type Cell = (u32, i64, i64);

/// The track that stands for each: itself, but for near-duplicates.
///
/// * `ranges`: observations of each track
/// * `views`: view of each observation
/// * `xy`: normalised image points
pub fn find(ranges: &[usize], views: impl Fn(usize) -> usize, xy: &[Vector2<f64>]) -> Vec<usize> {
    let tracks = ranges.len().saturating_sub(1);
    let place = |k: usize| xy[k].map(|x| (x / OPTIONS.near).floor() as i64);
    // The first track of each group that is in a cell.
    let mut firsts: HashMap<Cell, Vec<u32>> = HashMap::new();
    let mut first_of: Vec<usize> = (0..tracks).collect();
    for track in 0..tracks {
        let seen = ranges[track]..ranges[track + 1];
        let Some(k) = seen.clone().next().filter(|_| seen.len() >= VERIFIED) else { continue };
        let (view, at) = (views(k) as u32, place(k));
        let around = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (view, at.x + dx, at.y + dy)));
        let candidates = around.filter_map(|cell| firsts.get(&cell)).flatten();
        let near = candidates
            .map(|&first| first as usize)
            .find(|&first| are_near(&(ranges[first]..ranges[first + 1]), &seen, &views, xy));
        match near {
            Some(first) => first_of[track] = first,
            None => seen.for_each(|k| {
                let at = place(k);
                firsts.entry((views(k) as u32, at.x, at.y)).or_default().push(track as u32);
            }),
        }
    }
    let mut size = vec![0; tracks];
    first_of.iter().for_each(|&first| size[first] += 1);
    let stands_for: Vec<usize> = (0..tracks)
        .map(|track| if size[first_of[track]] >= OPTIONS.least_group { first_of[track] } else { track })
        .collect();
    let remaining = (0..tracks).filter(|&track| stands_for[track] == track).count();
    if remaining >= OPTIONS.least_remaining { stands_for } else { (0..tracks).collect() }
}

/// Whether two tracks are near each other in every view that both are in, and in enough of them to say so.
fn are_near(
    a: &std::ops::Range<usize>,
    b: &std::ops::Range<usize>,
    views: &impl Fn(usize) -> usize,
    xy: &[Vector2<f64>],
) -> bool {
    let (mut j, mut common) = (a.start, 0);
    for k in b.clone() {
        while j < a.end && views(j) < views(k) {
            j += 1;
        }
        if j < a.end && views(j) == views(k) {
            if (xy[j] - xy[k]).amax() > OPTIONS.near {
                return false;
            }
            common += 1;
        }
    }
    common >= VERIFIED
}

/// The block without what others stand for.
pub fn without<'a>(problem: &Problem, block: &'a Block) -> Cow<'a, Block> {
    let kept: Vec<usize> = (0..block.tracks.len()).filter(|&k| !problem.is_duplicate(block.tracks[k])).collect();
    if kept.len() == block.tracks.len() { Cow::Borrowed(block) } else { Cow::Owned(block.select(&kept)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tracks of three views, at the same place in all but the last.
    fn duplicates(tracks: &[[f64; 3]]) -> Vec<usize> {
        let xy: Vec<Vector2<f64>> = tracks
            .iter()
            .flat_map(|&[x, y, later]| [Vector2::new(x, y), Vector2::new(x, y), Vector2::new(x, later)])
            .collect();
        let ranges: Vec<usize> = (0..=tracks.len()).map(|track| 3 * track).collect();
        let found = find(&ranges, |k| k % 3, &xy);
        (0..tracks.len()).filter(|&track| found[track] != track).collect()
    }

    #[test]
    fn of_a_group_one_is_kept_and_of_fewer_all() {
        let apart = (0..20).map(|k| [0.05 * f64::from(k), 0.0, 0.0]);
        let group = (0..OPTIONS.least_group).map(|k| [0.5 + 1e-4 * k as f64, 0.3, 0.3]);
        let pair = (0..2).map(|k| [0.1 + 1e-4 * f64::from(k), 0.3, 0.3]);
        // Near the group in two views, and not in the third.
        let stranger = [0.5, 0.3, 0.4];
        let tracks: Vec<[f64; 3]> = apart.chain(group).chain(pair).chain([stranger]).collect();
        assert_eq!(duplicates(&tracks), (21..20 + OPTIONS.least_group).collect::<Vec<_>>());
    }

    #[test]
    fn nothing_is_left_aside_without_a_group_or_beside_too_little() {
        let apart: Vec<[f64; 3]> = (0..20).map(|k| [0.05 * f64::from(k), 0.0, 0.0]).collect();
        assert!(duplicates(&apart).is_empty());
        let mut group: Vec<[f64; 3]> = vec![[0.5, 0.3, 0.3]; 40];
        group.extend(&apart[..OPTIONS.least_remaining - 2]);
        assert!(duplicates(&group).is_empty());
        group.push(apart[19]);
        assert_eq!(duplicates(&group).len(), 39);
        assert!(find(&[], |_| 0, &[]).is_empty());
        let far = [Vector2::new(f64::MAX, -f64::MAX); 3];
        assert_eq!(find(&[0, 3], |k| k, &far), [0]);
    }
}
