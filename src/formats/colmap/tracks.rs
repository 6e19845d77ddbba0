//! Joining matches of image pairs into tracks, no track with two keypoints of one image.
//!
//! A track is a connected component of the matches, but one wrong match joins two points for good. So matches are taken
//! one by one, the best supported first, and one that would bring two keypoints of an image together is cut: Kruskal's
//! algorithm under a constraint. A match is supported by every third keypoint that is matched with both of its ends
//! (Zach, Klopschitz and Pollefeys 2010 judge pairs by such loops); among equals, that of the image pair with more
//! matches comes first, then that of the smaller ids.

use std::cmp::Reverse;

/// Neighbours that are looked at for the support of a match. Support counts to the number of views, mostly a few; the
/// bound keeps keypoints with thousands of matches, which no image gives, from costing their square.
const MOST_NEIGHBOURS: usize = 64;

/// A match of two keypoints; `a` and `b` number the keypoints of all images, image after image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Match {
    pub a: u32,
    pub b: u32,
    /// Number of matches of the image pair.
    pub pair_size: u32,
}

/// Tracks from matches.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Joined {
    /// Keypoint and track of each observation: by track, then by keypoint; tracks in the order of their first
    /// keypoints.
    pub observations: Vec<(u32, u32)>,
    pub tracks: usize,
    /// Matches that were cut.
    pub cut: usize,
}

/// Joins matches.
///
/// * `image_of`: image of a keypoint, ascending with the keypoint
pub(super) fn join(mut matches: Vec<Match>, image_of: impl Fn(u32) -> u32) -> Joined {
    // Keypoints that are matched at all, renumbered without gaps.
    let mut keypoints: Vec<u32> = matches.iter().flat_map(|found| [found.a, found.b]).collect();
    keypoints.sort_unstable();
    keypoints.dedup();
    let place = |keypoint: u32| keypoints.partition_point(|&other| other < keypoint) as u32;
    for found in &mut matches {
        (found.a, found.b) = (place(found.a), place(found.b));
    }
    let graph = Graph::new(&matches, keypoints.len());
    let mut order: Vec<(Reverse<u16>, Reverse<u32>, u32, u32)> = matches
        .iter()
        .map(|found| (Reverse(graph.support(found)), Reverse(found.pair_size), found.a, found.b))
        .collect();
    drop((graph, matches));
    order.sort_unstable();
    let mut components = Components::new(keypoints.iter().map(|&keypoint| image_of(keypoint)));
    let cut = order.into_iter().filter(|&(.., a, b)| !components.join(a, b)).count();
    let (observations, tracks) = components.tracks(&keypoints);
    Joined { observations, tracks, cut }
}

/// Neighbours of every keypoint, ascending.
struct Graph {
    starts: Vec<usize>,
    neighbours: Vec<u32>,
}

impl Graph {
    fn new(matches: &[Match], keypoints: usize) -> Self {
        let mut starts = vec![0; keypoints + 1];
        for found in matches {
            starts[found.a as usize + 1] += 1;
            starts[found.b as usize + 1] += 1;
        }
        for k in 0..keypoints {
            starts[k + 1] += starts[k];
        }
        let mut ends = starts.clone();
        let mut neighbours = vec![0; 2 * matches.len()];
        for found in matches {
            for (from, to) in [(found.a, found.b), (found.b, found.a)] {
                neighbours[ends[from as usize]] = to;
                ends[from as usize] += 1;
            }
        }
        for k in 0..keypoints {
            neighbours[starts[k]..starts[k + 1]].sort_unstable();
        }
        Self { starts, neighbours }
    }

    fn neighbours(&self, keypoint: u32) -> &[u32] {
        &self.neighbours[self.starts[keypoint as usize]..self.starts[keypoint as usize + 1]]
    }

    /// Keypoints matched with both ends, among the first [`MOST_NEIGHBOURS`] of the end with fewer.
    fn support(&self, found: &Match) -> u16 {
        let (mut few, mut many) = (self.neighbours(found.a), self.neighbours(found.b));
        if few.len() > many.len() {
            std::mem::swap(&mut few, &mut many);
        }
        few.iter().take(MOST_NEIGHBOURS).filter(|keypoint| many.binary_search(keypoint).is_ok()).count() as u16
    }
}

/// Disjoint sets of keypoints, each with at most one keypoint an image.
struct Components {
    parents: Vec<u32>,
    /// Images of a root's component, ascending.
    images: Vec<Vec<u32>>,
}

impl Components {
    fn new(images: impl Iterator<Item = u32>) -> Self {
        let images: Vec<Vec<u32>> = images.map(|image| vec![image]).collect();
        Self { parents: (0..images.len() as u32).collect(), images }
    }

    fn root(&mut self, keypoint: u32) -> u32 {
        let mut at = keypoint;
        while self.parents[at as usize] != at {
            // Halves the path on the way.
            self.parents[at as usize] = self.parents[self.parents[at as usize] as usize];
            at = self.parents[at as usize];
        }
        at
    }

    /// Joins two components; `false` where they hold keypoints of one image.
    fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        if a == b {
            return true;
        }
        let is_larger = self.images[a as usize].len() >= self.images[b as usize].len();
        let (large, small) = if is_larger { (a, b) } else { (b, a) };
        let images = &self.images[large as usize];
        if self.images[small as usize].iter().any(|image| images.binary_search(image).is_ok()) {
            return false;
        }
        let moved = std::mem::take(&mut self.images[small as usize]);
        self.parents[small as usize] = large;
        let images = &mut self.images[large as usize];
        images.extend(moved);
        // Two ascending runs: the sort finds and merges them.
        images.sort();
        true
    }

    /// The components of two keypoints and more; returns their number too.
    fn tracks(mut self, keypoints: &[u32]) -> (Vec<(u32, u32)>, usize) {
        const NONE: u32 = u32::MAX;
        let mut track_of_root = vec![NONE; keypoints.len()];
        let mut tracks = 0;
        let mut observations = Vec::new();
        for (place, &keypoint) in keypoints.iter().enumerate() {
            let root = self.root(place as u32) as usize;
            if self.images[root].len() < 2 {
                continue;
            }
            if track_of_root[root] == NONE {
                track_of_root[root] = tracks;
                tracks += 1;
            }
            observations.push((keypoint, track_of_root[root]));
        }
        observations.sort_unstable_by_key(|&(keypoint, track)| (track, keypoint));
        (observations, tracks as usize)
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Keypoints `10 * image + k`.
    fn image_of(keypoint: u32) -> u32 {
        keypoint / 10
    }

    fn joined(matches: &[(u32, u32)]) -> Joined {
        join(matches.iter().map(|&(a, b)| Match { a, b, pair_size: 1 }).collect(), image_of)
    }

    #[test]
    fn components_are_tracks_in_the_order_of_their_keypoints() {
        let found = joined(&[(21, 32), (10, 25), (0, 10)]);
        assert_eq!(found.observations, [(0, 0), (10, 0), (25, 0), (21, 1), (32, 1)]);
        assert_eq!((found.tracks, found.cut), (2, 0));
        assert_eq!(joined(&[]), Joined::default());
    }

    #[test]
    fn a_match_that_would_join_two_keypoints_of_an_image_is_cut() {
        // Two points seen in three images each, every pair matched, and one wrong match between them.
        let right = [(0, 10), (10, 20), (0, 20), (1, 11), (11, 21), (1, 21)];
        for place in 0..=right.len() {
            let mut matches = right.to_vec();
            matches.insert(place, (0, 21));
            let found = joined(&matches);
            assert_eq!(found.observations, [(0, 0), (10, 0), (20, 0), (1, 1), (11, 1), (21, 1)]);
            assert_eq!((found.tracks, found.cut), (2, 1), "the wrong match at {place}");
        }
    }

    #[test]
    fn without_loops_the_pair_with_more_matches_decides() {
        let strong = Match { a: 0, b: 10, pair_size: 50 };
        let weak = Match { a: 1, b: 10, pair_size: 5 };
        for matches in [vec![strong, weak], vec![weak, strong]] {
            let found = join(matches, image_of);
            assert_eq!((found.observations, found.cut), (vec![(0, 0), (10, 0)], 1));
        }
    }

    #[test]
    fn no_track_has_two_keypoints_of_an_image_and_the_order_of_the_matches_is_all_the_same() {
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut matches: Vec<(u32, u32)> = (0..60)
                .map(|_| (rng.random_range(0..80), rng.random_range(0..80)))
                .filter(|&(a, b)| image_of(a) != image_of(b))
                .collect();
            let found = joined(&matches);
            let mut seen: Vec<(u32, u32)> = found.observations.iter().map(|&(k, track)| (track, image_of(k))).collect();
            seen.dedup();
            assert_eq!(seen.len(), found.observations.len(), "seed {seed}");
            matches.reverse();
            assert_eq!(joined(&matches), found, "seed {seed}");
        }
    }

    /// What the order is for: of wrong matches thrown among right ones, few get into a track.
    #[test]
    fn support_keeps_points_apart() {
        let (images, points) = (8u32, 200u32);
        for seed in 0..5 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut matches = Vec::new();
            for first in 0..images {
                for second in first + 1..images {
                    for point in 0..points {
                        let other = if rng.random_bool(0.2) { rng.random_range(0..points) } else { point };
                        if rng.random_bool(0.7) {
                            matches.push(Match { a: first * points + point, b: second * points + other, pair_size: 1 });
                        }
                    }
                }
            }
            let found = join(matches, |keypoint| keypoint / points);
            let mut counts = vec![vec![0u32; points as usize]; found.tracks];
            for &(keypoint, track) in &found.observations {
                counts[track as usize][(keypoint % points) as usize] += 1;
            }
            let right: u32 = counts.iter().filter_map(|of_track| of_track.iter().max()).sum();
            let share = f64::from(right) / found.observations.len() as f64;
            assert!(share > 0.97, "seed {seed}: {share} of the observations are with their own point");
        }
    }
}
