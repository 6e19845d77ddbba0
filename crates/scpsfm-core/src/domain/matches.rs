//! Keypoints and the matches between them: an input whose tracks are joined here, see [`joining`](super::joining).

use std::collections::HashMap;

use super::error::{InvalidInput, Violation, Violations};
use super::input::{Input, RawInput, View, check_position, too_few_views};
use super::joined_tracks::Joining;
use super::joining::{self, Joined, Match};
use super::limits::Limits;
use super::words::counted;

/// Matches of pairs of views. Structure of arrays: one entry a pair, and one entry a match, pair after pair.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PairMatches {
    /// The two views of each pair.
    pub first_view: Vec<u32>,
    pub second_view: Vec<u32>,
    /// Number of matches of each pair.
    pub count: Vec<u32>,
    /// Keypoint of each match in the first view of its pair, counted within the view.
    pub first_keypoint: Vec<u32>,
    /// The same in the second view.
    pub second_keypoint: Vec<u32>,
}

impl PairMatches {
    /// Adds a pair of views with its matches.
    pub fn push(&mut self, views: [u32; 2], matches: impl IntoIterator<Item = [u32; 2]>) {
        let before = self.len();
        for [first, second] in matches {
            self.first_keypoint.push(first);
            self.second_keypoint.push(second);
        }
        let [first, second] = views;
        self.first_view.push(first);
        self.second_view.push(second);
        self.count.push((self.len() - before) as u32);
    }

    /// Number of matches.
    pub fn len(&self) -> usize {
        self.first_keypoint.len()
    }

    pub fn is_empty(&self) -> bool {
        self.first_keypoint.is_empty()
    }

    /// Number of pairs.
    pub fn pair_count(&self) -> usize {
        self.count.len()
    }

    /// The views of each pair and where its matches are.
    fn pairs(&self) -> impl Iterator<Item = ([u32; 2], std::ops::Range<usize>)> {
        let views = self.first_view.iter().zip(&self.second_view);
        views.zip(&self.count).scan(0, |end, ((&first, &second), &count)| {
            let start = *end;
            *end += count as usize;
            Some(([first, second], start..*end))
        })
    }

    /// Joins the matches into tracks. Keypoints are numbered over all views.
    ///
    /// * `starts`: number of the first keypoint of each view, and the number of all keypoints
    pub fn join(&self, starts: &[u32]) -> Joined {
        let mut matches = Vec::with_capacity(self.len());
        for ([first, second], range) in self.pairs() {
            let pair_size = range.len() as u32;
            let of_pair = self.first_keypoint[range.clone()].iter().zip(&self.second_keypoint[range]);
            matches.extend(of_pair.map(|(a, b)| Match {
                a: starts[first as usize] + a,
                b: starts[second as usize] + b,
                pair_size,
            }));
        }
        joining::join(matches, |keypoint| view_of(starts, keypoint))
    }
}

/// Number of the first keypoint of each view, and the number of all keypoints.
pub fn keypoint_starts(counts: impl IntoIterator<Item = u32>) -> Vec<u32> {
    let mut starts = vec![0];
    starts.extend(counts.into_iter().scan(0, |end, count| {
        *end += count;
        Some(*end)
    }));
    starts
}

/// The view that a keypoint is of.
pub fn view_of(starts: &[u32], keypoint: u32) -> u32 {
    (starts.partition_point(|&start| start <= keypoint) - 1) as u32
}

/// An input of keypoints and matches as a caller states it, before any check.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RawMatches {
    pub views: Vec<View>,
    /// Number of keypoints of each view.
    pub keypoint_counts: Vec<u32>,
    /// Position of each keypoint in pixels, view after view.
    pub x: Vec<f64>,
    pub y: Vec<f64>,
    pub pairs: PairMatches,
}

impl RawMatches {
    /// Checks everything and joins the matches. Observations are in the order of tracks and, within a track, of views;
    /// tracks in the order of their first keypoints.
    ///
    /// # Errors
    /// Every violation found, its field prefixed by `prefix` (`match_set`).
    pub fn into_input(self, limits: &Limits, prefix: &str) -> Result<Input, InvalidInput> {
        let field = |name: &str| format!("{prefix}.{name}");
        self.check_counts(limits, &field)?;
        self.check_numbers(&field)?;
        let starts = keypoint_starts(self.keypoint_counts.iter().copied());
        let match_count = self.pairs.len() as u32;
        let Joined { observations, tracks, cut } = self.pairs.join(&starts);
        if tracks > limits.max_tracks {
            let what = format!("joined into {}, above the limit of {}", counted(tracks, "track"), limits.max_tracks);
            return Err(Violation::of(field("first_keypoint_indices"), what).into());
        }
        let mut raw = RawInput { views: self.views, track_count: tracks, ..RawInput::default() };
        let mut keypoints = Vec::with_capacity(observations.len());
        for (keypoint, track) in observations {
            let view = view_of(&starts, keypoint);
            raw.view.push(view);
            raw.track.push(track);
            raw.x.push(self.x[keypoint as usize]);
            raw.y.push(self.y[keypoint as usize]);
            keypoints.push(keypoint - starts[view as usize]);
        }
        let joining = Joining { keypoint: keypoints, match_count, cut_match_count: cut as u32 };
        Ok(Input::new(raw, limits, prefix)?.joined_by(joining))
    }

    /// Checks lengths, by themselves and against each other.
    fn check_counts(&self, limits: &Limits, field: &impl Fn(&str) -> String) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        let PairMatches { first_view, second_view, count, first_keypoint, second_keypoint } = &self.pairs;
        if self.views.len() < 2 {
            found.push(Violation::of(field("views"), too_few_views(self.views.len())));
        }
        let bounds = [
            ("views", self.views.len(), limits.max_views, "views"),
            ("xs", self.x.len(), limits.max_observations, "keypoints"),
            ("match_counts", count.len(), limits.max_observations, "pairs of views"),
            ("first_keypoint_indices", first_keypoint.len(), limits.max_observations, "matches"),
        ];
        for (name, count, most, what) in bounds {
            if count > most {
                found.push(Violation::of(field(name), format!("{count} {what} are above the limit of {most}")));
            }
        }
        if first_keypoint.is_empty() {
            found.push(Violation::of(field("first_keypoint_indices"), "no matches given"));
        }
        // In u64, which no sum of so few u32 leaves.
        let sum = |counts: &[u32]| counts.iter().map(|&count| u64::from(count)).sum::<u64>();
        let (views, pairs) = (self.views.len() as u64, count.len() as u64);
        let (keypoints, matches) = (sum(&self.keypoint_counts), sum(count));
        let lengths = [
            ("keypoint_counts", self.keypoint_counts.len(), views, "views"),
            ("xs", self.x.len(), keypoints, "keypoints, the sum of keypoint_counts"),
            ("ys", self.y.len(), keypoints, "keypoints, the sum of keypoint_counts"),
            ("first_view_indices", first_view.len(), pairs, "pairs in match_counts"),
            ("second_view_indices", second_view.len(), pairs, "pairs in match_counts"),
            ("first_keypoint_indices", first_keypoint.len(), matches, "matches, the sum of match_counts"),
            ("second_keypoint_indices", second_keypoint.len(), matches, "matches, the sum of match_counts"),
        ];
        for (name, length, due, what) in lengths {
            if length as u64 != due {
                found.push(Violation::of(field(name), format!("has {} for {due} {what}", counted(length, "entry"))));
            }
        }
        found.into_result()
    }

    /// Checks positions and indices; the lengths are right.
    fn check_numbers(&self, field: &impl Fn(&str) -> String) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        for (name, values) in [("xs", &self.x), ("ys", &self.y)] {
            for (k, &value) in values.iter().enumerate() {
                if let Err(what) = check_position(value) {
                    found.push(Violation::at(field(name), k, what));
                }
            }
        }
        let mut pairs = HashMap::new();
        for (pair, ([first, second], range)) in self.pairs.pairs().enumerate() {
            let mut are_views = true;
            for (name, view) in [("first_view_indices", first), ("second_view_indices", second)] {
                if view as usize >= self.views.len() {
                    are_views = false;
                    let what = format!("view {view} is outside the {} views given", self.views.len());
                    found.push(Violation::at(field(name), pair, what));
                }
            }
            if first == second {
                let what = format!("view {first} is matched with itself");
                found.push(Violation::at(field("second_view_indices"), pair, what));
            } else if let Some(before) = pairs.insert((first.min(second), first.max(second)), pair) {
                let what = format!("views {first} and {second} are pair {before} already; give a pair once");
                found.push(Violation::at(field("first_view_indices"), pair, what));
            } else if are_views {
                self.check_pair([first, second], range, field, &mut found);
            }
        }
        found.into_result()
    }

    /// Checks the matches of one pair.
    fn check_pair(
        &self,
        views: [u32; 2],
        range: std::ops::Range<usize>,
        field: &impl Fn(&str) -> String,
        found: &mut Violations,
    ) {
        let PairMatches { first_keypoint, second_keypoint, .. } = &self.pairs;
        let sides = [("first_keypoint_indices", first_keypoint), ("second_keypoint_indices", second_keypoint)];
        for ((name, keypoints), view) in sides.into_iter().zip(views) {
            let count = self.keypoint_counts[view as usize];
            for k in range.clone().filter(|&k| keypoints[k] >= count) {
                let what =
                    format!("keypoint {} is outside the {} of view {view}", keypoints[k], counted(count, "keypoint"));
                found.push(Violation::at(field(name), k, what));
            }
        }
        let mut order: Vec<usize> = range.collect();
        let key = |k: usize| (first_keypoint[k], second_keypoint[k]);
        order.sort_unstable_by_key(|&k| (key(k), k));
        for pair in order.windows(2).filter(|pair| key(pair[0]) == key(pair[1])) {
            let (first, second) = key(pair[1]);
            let what = format!("the match of {first} and {second} is there already, at index {}", pair[0]);
            found.push(Violation::at(field("first_keypoint_indices"), pair[1], what));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three views of three keypoints each, `x = 10 view + keypoint`; the first two keypoints are a track each.
    fn matches() -> RawMatches {
        let mut pairs = PairMatches::default();
        pairs.push([0, 1], [[0, 0], [1, 1]]);
        pairs.push([2, 1], [[0, 0], [1, 1]]);
        RawMatches {
            views: vec![View::default(); 3],
            keypoint_counts: vec![3; 3],
            x: (0..9).map(|k| f64::from(10 * (k / 3) + k % 3)).collect(),
            y: vec![5.0; 9],
            pairs,
        }
    }

    fn wrong(change: impl Fn(&mut RawMatches)) -> Vec<String> {
        let mut matches = matches();
        change(&mut matches);
        let error = matches.into_input(&Limits::default(), "match_set").expect_err("invalid input was accepted");
        error.violations().iter().map(Violation::path).collect()
    }

    #[test]
    fn matches_become_observations_that_tell_their_keypoints() {
        let input = matches().into_input(&Limits::default(), "match_set").expect("valid");
        let raw = input.to_raw();
        assert_eq!((&raw.track[..], &raw.view[..]), (&[0, 0, 0, 1, 1, 1][..], &[0, 1, 2, 0, 1, 2][..]));
        assert_eq!(raw.x, [0.0, 10.0, 20.0, 1.0, 11.0, 21.0]);
        let joined = input.joined_tracks().expect("joined");
        assert_eq!((joined.view, joined.track), (raw.view, raw.track));
        let expected = Joining { keypoint: vec![0, 0, 0, 1, 1, 1], match_count: 4, cut_match_count: 0 };
        assert_eq!(joined.joining, expected);
    }

    #[test]
    fn what_is_stored_is_read_again_and_track_sets_are_not_joined() {
        let input = matches().into_input(&Limits::default(), "match_set").expect("valid");
        let bytes = rmp_serde::to_vec_named(&input).expect("encoded");
        assert_eq!(rmp_serde::from_slice::<Input>(&bytes).expect("decoded"), input);
        let again = Input::new(input.to_raw(), &Limits::default(), "track_set").expect("valid");
        assert_eq!(again.joined_tracks(), None);
    }

    #[test]
    fn names_field_and_index_of_what_is_wrong() {
        assert_eq!(wrong(|set| set.x[4] = f64::NAN), ["match_set.xs[4]"]);
        assert_eq!(wrong(|set| set.y[8] = 1e9), ["match_set.ys[8]"]);
        assert_eq!(wrong(|set| set.y.truncate(8)), ["match_set.ys"]);
        assert_eq!(wrong(|set| set.keypoint_counts[2] = 2), ["match_set.xs", "match_set.ys"]);
        assert_eq!(wrong(|set| set.keypoint_counts.truncate(2)).first().expect("wrong"), "match_set.keypoint_counts");
        assert_eq!(wrong(|set| set.pairs.first_view[1] = 3), ["match_set.first_view_indices[1]"]);
        assert_eq!(wrong(|set| set.pairs.second_view[0] = 9), ["match_set.second_view_indices[0]"]);
        assert_eq!(wrong(|set| set.pairs.second_view[0] = 0), ["match_set.second_view_indices[0]"]);
        assert_eq!(wrong(|set| set.pairs.first_view[1] = 0), ["match_set.first_view_indices[1]"]);
        assert_eq!(wrong(|set| set.pairs.count[1] = 1).len(), 2);
        assert_eq!(wrong(|set| set.pairs.first_keypoint[3] = 3), ["match_set.first_keypoint_indices[3]"]);
        assert_eq!(wrong(|set| set.pairs.second_keypoint[0] = u32::MAX), ["match_set.second_keypoint_indices[0]"]);
        let twice = |set: &mut RawMatches| (set.pairs.first_keypoint[3], set.pairs.second_keypoint[3]) = (0, 0);
        assert_eq!(wrong(twice), ["match_set.first_keypoint_indices[3]"]);
        assert_eq!(wrong(|set| set.pairs = PairMatches::default()), ["match_set.first_keypoint_indices"]);
        assert_eq!(wrong(|set| set.views[1].name = Some("".into())), ["match_set.views[1].name"]);
        assert!(wrong(|set| set.views.truncate(1)).contains(&"match_set.views".to_owned()));
    }

    #[test]
    fn refuses_what_is_above_the_limits() {
        let refused = |limits: Limits| {
            let error = matches().into_input(&limits, "match_set").expect_err("above the limits");
            error.violations()[0].to_string()
        };
        let few = Limits { max_observations: 8, ..Limits::default() };
        assert_eq!(refused(few), "match_set.xs: 9 keypoints are above the limit of 8");
        let few = Limits { max_tracks: 1, ..Limits::default() };
        assert_eq!(refused(few), "match_set.first_keypoint_indices: joined into 2 tracks, above the limit of 1");
        let few = Limits { max_views: 2, ..Limits::default() };
        assert_eq!(refused(few), "match_set.views: 3 views are above the limit of 2");
    }

    #[test]
    fn counts_whose_sum_is_beyond_32_bits_are_refused() {
        assert_eq!(wrong(|set| set.keypoint_counts = vec![u32::MAX; 3]), ["match_set.xs", "match_set.ys"]);
    }
}
