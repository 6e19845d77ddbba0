//! Joining matches of image pairs into tracks, no track with two keypoints of one image.
//!
//! A track is a connected component of the matches, but one wrong match joins two points for good. So matches are taken
//! one by one, the best supported first, and one that would bring two keypoints of an image together is cut: Kruskal's
//! algorithm under a constraint.
//!
//! 1. A match is supported by every third keypoint that is matched with both of its ends (Zach, Klopschitz and
//!    Pollefeys 2010 judge pairs by such loops). Supported matches come first; among equals, that of the image pair
//!    with more matches, then that of the smaller numbers.
//! 2. The others are in no loop, right or wrong. Two pieces of one point often have several such matches between them,
//!    pieces of two points rarely more than one. So pieces are joined by the number of matches between them, those
//!    first that are each other's best.
//! 3. The other matches follow in the order of 1.

use std::cmp::Reverse;

/// Neighbours that are looked at for the support of a match. Support counts to the number of views, mostly a few; the
/// bound keeps keypoints with thousands of matches, which no image gives, from costing their square.
const MOST_NEIGHBOURS: usize = 64;

/// Rounds in which pieces are joined by the number of matches between them, at most. Four find all that thirty do, to
/// .005 of the observations, on synthetic matches of 8 to 30 images with 10 to 50 % wrong ones.
const PIECE_ROUNDS: usize = 4;

/// A match of two keypoints; `a` and `b` number the keypoints of all images, image after image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Match {
    pub a: u32,
    pub b: u32,
    /// Number of matches of the image pair.
    pub pair_size: u32,
}

/// Tracks from matches.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Joined {
    /// Keypoint and track of each observation: by track, then by keypoint; tracks in the order of their first
    /// keypoints.
    pub observations: Vec<(u32, u32)>,
    pub tracks: usize,
    /// Matches that were cut.
    pub cut: usize,
}

/// A match in the order in which matches are taken: by support, size of the pair and keypoints.
type Ranked = (Reverse<u16>, Reverse<u32>, u32, u32);

/// Joins matches, in O(E (log E + V / 64)) for E matches of V images. Which end of a match is `a` does not matter, nor the order of the
/// matches.
///
/// * `image_of`: image of a keypoint, ascending with the keypoint
pub fn join(mut matches: Vec<Match>, image_of: impl Fn(u32) -> u32) -> Joined {
    // Keypoints that are matched at all, renumbered without gaps.
    let mut keypoints: Vec<u32> = matches.iter().flat_map(|found| [found.a, found.b]).collect();
    keypoints.sort_unstable();
    keypoints.dedup();
    let place = |keypoint: u32| keypoints.partition_point(|&other| other < keypoint) as u32;
    for found in &mut matches {
        let (a, b) = (place(found.a), place(found.b));
        (found.a, found.b) = (a.min(b), a.max(b));
    }
    let graph = Graph::new(&matches, keypoints.len());
    let mut order: Vec<Ranked> = matches
        .iter()
        .map(|found| (Reverse(graph.support(found)), Reverse(found.pair_size), found.a, found.b))
        .collect();
    drop((graph, matches));
    order.sort_unstable();
    let mut components = Components::new(keypoints.iter().map(|&keypoint| image_of(keypoint)));
    let supported = order.partition_point(|&(support, ..)| support.0 > 0);
    for &(.., a, b) in &order[..supported] {
        components.join(a, b);
    }
    for _ in 0..PIECE_ROUNDS {
        if !components.join_pieces(&order) {
            break;
        }
    }
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
    /// Images of a root's component.
    images: Vec<ImageSet>,
}

/// Set of images: words of 64 images that are not empty, with their numbers, ascending. A component of thousands of
/// images may be tried against thousands of others, which is a few dozen words each.
type ImageSet = Vec<(u32, u64)>;

fn size(images: &[(u32, u64)]) -> u32 {
    images.iter().map(|(_, bits)| bits.count_ones()).sum()
}

impl Components {
    fn new(images: impl Iterator<Item = u32>) -> Self {
        let images: Vec<ImageSet> = images.map(|image| vec![(image / 64, 1 << (image % 64))]).collect();
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

    /// Whether two components, by their roots, have no image in common.
    fn are_disjoint(&self, a: u32, b: u32) -> bool {
        let (mut few, mut many) = (&self.images[a as usize], &self.images[b as usize]);
        if few.len() > many.len() {
            std::mem::swap(&mut few, &mut many);
        }
        few.iter().all(|&(word, bits)| match many.binary_search_by_key(&word, |&(word, _)| word) {
            Ok(place) => many[place].1 & bits == 0,
            Err(_) => true,
        })
    }

    /// Joins the components that are each other's best, by the number of matches between them and then by the size of
    /// the largest pair; `false` where nothing can be joined.
    fn join_pieces(&mut self, order: &[Ranked]) -> bool {
        let mut between: Vec<(u32, u32, u32)> = Vec::new();
        for &(_, pair_size, a, b) in order {
            let (a, b) = (self.root(a), self.root(b));
            if a != b {
                between.push((a.min(b), a.max(b), pair_size.0));
            }
        }
        between.sort_unstable();
        let mut links: Vec<(Reverse<u32>, Reverse<u32>, u32, u32)> = between
            .chunk_by(|one, next| (one.0, one.1) == (next.0, next.1))
            .filter_map(|chunk| Some((chunk.len() as u32, chunk.last()?)))
            .filter(|&(_, &(a, b, _))| self.are_disjoint(a, b))
            .map(|(count, &(a, b, largest))| (Reverse(count), Reverse(largest), a, b))
            .collect();
        links.sort_unstable();
        let mut has_better = vec![false; self.parents.len()];
        for &(.., a, b) in &links {
            let is_best = !has_better[a as usize] && !has_better[b as usize];
            (has_better[a as usize], has_better[b as usize]) = (true, true);
            if is_best {
                self.join(a, b);
            }
        }
        !links.is_empty()
    }

    /// Joins two components; `false` where they hold keypoints of one image.
    fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        if a == b {
            return true;
        }
        if !self.are_disjoint(a, b) {
            return false;
        }
        let is_larger = size(&self.images[a as usize]) >= size(&self.images[b as usize]);
        let (large, small) = if is_larger { (a, b) } else { (b, a) };
        let moved = std::mem::take(&mut self.images[small as usize]);
        self.parents[small as usize] = large;
        let images = &mut self.images[large as usize];
        images.extend(moved);
        // Two ascending runs: the sort finds and merges them.
        images.sort_unstable();
        images.dedup_by(|next, kept| {
            let is_same = next.0 == kept.0;
            if is_same {
                kept.1 |= next.1;
            }
            is_same
        });
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
            if size(&self.images[root]) < 2 {
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

    /// Matches of synthetic images, and the point of each keypoint.
    struct Scene {
        matches: Vec<Match>,
        keypoints_per_image: u32,
        points: u32,
    }

    impl Scene {
        /// Keypoint `p` of an image shows point `p`, where there is such a point, or nothing. Every image pair that is
        /// `window` apart at most has right matches of `found` of the points, and so many wrong ones that these are the
        /// share `wrong` of all.
        fn new(seed: u64, images: u32, window: u32, found: f64, wrong: f64) -> Self {
            let (points, clutter) = (300, 100);
            let keypoints_per_image = points + clutter;
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut matches = Vec::new();
            for first in 0..images {
                for second in first + 1..images.min(first + 1 + window) {
                    let mut pair: Vec<(u32, u32)> =
                        (0..points).filter(|_| rng.random_bool(found)).map(|point| (point, point)).collect();
                    let count = (pair.len() as f64 * wrong / (1.0 - wrong)).round() as usize;
                    for _ in 0..count {
                        let a = rng.random_range(0..keypoints_per_image);
                        pair.push((a, (a + rng.random_range(1..keypoints_per_image)) % keypoints_per_image));
                    }
                    let pair_size = pair.len() as u32;
                    matches.extend(pair.iter().map(|&(a, b)| Match {
                        a: first * keypoints_per_image + a,
                        b: second * keypoints_per_image + b,
                        pair_size,
                    }));
                }
            }
            Self { matches, keypoints_per_image, points }
        }

        fn image_of(&self, keypoint: u32) -> u32 {
            keypoint / self.keypoints_per_image
        }

        /// Observations that the right matches alone connect: of each point the largest component.
        fn recoverable(&self) -> u32 {
            let is_right = |found: &&Match| found.a % self.keypoints_per_image == found.b % self.keypoints_per_image;
            let right: Vec<Match> = self.matches.iter().filter(is_right).copied().collect();
            self.recovered(&join(right, |keypoint| self.image_of(keypoint)).observations)
        }

        /// Observations of each point that are together in one track of which they are the most; a track with fewer
        /// than two of them recovers nothing.
        fn recovered(&self, observations: &[(u32, u32)]) -> u32 {
            let mut best = vec![0; self.points as usize];
            for track in observations.chunk_by(|one, next| one.1 == next.1) {
                let mut counts = std::collections::BTreeMap::new();
                for &(keypoint, _) in track {
                    *counts.entry(keypoint % self.keypoints_per_image).or_insert(0u32) += 1;
                }
                let most = counts.into_iter().filter(|&(point, count)| point < self.points && count >= 2);
                if let Some((point, count)) = most.max_by_key(|&(point, count)| (count, Reverse(point))) {
                    best[point as usize] = best[point as usize].max(count);
                }
            }
            best.into_iter().sum()
        }

        /// The observations of the connected components that hold no image twice: the rule of textbooks.
        fn whole_components(&self) -> u32 {
            // Every keypoint in an image of its own: nothing is cut.
            let mut observations = join(self.matches.clone(), |keypoint| keypoint).observations;
            let mut twice = std::collections::BTreeSet::new();
            for track in observations.chunk_by(|one, next| one.1 == next.1) {
                if track.windows(2).any(|pair| self.image_of(pair[0].0) == self.image_of(pair[1].0)) {
                    twice.insert(track[0].1);
                }
            }
            observations.retain(|(_, track)| !twice.contains(track));
            self.recovered(&observations)
        }
    }

    /// What the order is for: most observations stay with their own point, whatever wrong matches are thrown among the
    /// right ones, where connected components lose nearly all. The bounds are a few hundredths below what the test
    /// prints.
    #[test]
    fn wrong_matches_leave_most_observations_with_their_points() {
        for (images, window, found, wrong, least) in [
            (8, 8, 0.7, 0.1, 0.98),
            (8, 8, 0.7, 0.3, 0.98),
            (8, 8, 0.7, 0.5, 0.97),
            (10, 4, 0.7, 0.1, 0.98),
            (10, 4, 0.7, 0.3, 0.97),
            (10, 4, 0.7, 0.5, 0.95),
            (8, 8, 0.45, 0.3, 0.91),
        ] {
            let (mut recovered, mut recoverable, mut whole) = (0, 0, 0);
            for seed in 0..3 {
                let scene = Scene::new(seed, images, window, found, wrong);
                let joined = join(scene.matches.clone(), |keypoint| scene.image_of(keypoint));
                recovered += scene.recovered(&joined.observations);
                recoverable += scene.recoverable();
                whole += scene.whole_components();
            }
            let share = |count: u32| f64::from(count) / f64::from(recoverable);
            println!(
                "{images} images, window {window}, {found} of the points matched, {wrong} of the matches wrong: {:.3} \
                 recovered, {:.3} by connected components",
                share(recovered),
                share(whole)
            );
            assert!(share(recovered) > least, "{recovered} of {recoverable}");
            assert!(share(whole) < 0.5 * share(recovered), "connected components are no worse");
        }
    }

    /// Two pieces of one point have two matches between them, and each one, of a larger pair, with a piece of another.
    #[test]
    fn pieces_of_a_point_are_joined_before_a_match_that_stands_alone() {
        let of = |a, b, pair_size| Match { a, b, pair_size };
        let triangle = |a: u32, b: u32, c: u32| [of(a, b, 1), of(b, c, 1), of(a, c, 1)];
        let mut matches = [triangle(0, 10, 20), triangle(30, 40, 50)].concat();
        matches.extend([of(0, 30, 1), of(10, 40, 1), of(20, 31, 9), of(50, 1, 9)]);
        let found = join(matches, image_of);
        assert_eq!(found.observations, [0, 10, 20, 30, 40, 50].map(|keypoint| (keypoint, 0)));
        assert_eq!((found.tracks, found.cut), (1, 2));
    }
}
