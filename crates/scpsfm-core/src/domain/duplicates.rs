//! Tracks that are observed in the very same views at the very same points: one track that stands in the input several
//! times.
//!
//! They come of detectors that report a point once an orientation, and of lists that were put together twice. Chance
//! does not make two of them: coordinates are compared bit by bit.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::ops::Range;

use super::input::Input;
use super::result::Solution;
use super::warning::{Warning, WarningCode};

/// Observations from which equal tracks are duplicates: one point says nothing that could be said twice.
const LEAST_OBSERVATIONS: usize = 2;
/// Duplicates named in the warning.
const MOST_NAMED: usize = 5;

/// The duplicates of an input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Duplicates {
    /// For each track the first that is like it: itself, for most.
    first: Vec<u32>,
}

impl Duplicates {
    /// `None` where every track stands once.
    pub fn of(input: &Input) -> Option<Self> {
        let ranges = ranges(input);
        let mut tracks: Vec<usize> =
            (0..ranges.len()).filter(|&track| ranges[track].len() >= LEAST_OBSERVATIONS).collect();
        tracks.sort_by(|&a, &b| compared(input, &ranges[a], &ranges[b]).then(a.cmp(&b)));
        let mut first: Vec<u32> = (0..ranges.len() as u32).collect();
        for pair in tracks.windows(2) {
            if compared(input, &ranges[pair[0]], &ranges[pair[1]]) == Ordering::Equal {
                first[pair[1]] = first[pair[0]];
            }
        }
        let duplicates = Self { first };
        let any = duplicates.list().next().is_some();
        any.then_some(duplicates)
    }

    /// Whether a track stands in the input before.
    pub fn is_duplicate(&self, track: usize) -> bool {
        self.first[track] as usize != track
    }

    /// Each duplicate with the first track that it is like, ascending.
    pub fn list(&self) -> impl Iterator<Item = (usize, usize)> {
        let pairs = self.first.iter().enumerate().map(|(track, &first)| (track, first as usize));
        pairs.filter(|(track, first)| track != first)
    }

    /// How many there are and the first few; `name` names a track by its index.
    pub fn warning(&self, name: impl Fn(usize) -> String) -> Warning {
        let count = self.list().count();
        let mut named: Vec<String> = self
            .list()
            .take(MOST_NAMED)
            .map(|(track, first)| format!("{} (as {})", name(track), name(first)))
            .collect();
        if count > named.len() {
            named.push(format!("and {} more", count - named.len()));
        }
        let detail = format!(
            "{count} of {} tracks have the very same observations as another and were solved as one with it: {}",
            self.first.len(),
            named.join(", ")
        );
        Warning::new(WarningCode::DuplicateTracks, detail)
    }

    /// Gives the duplicates the answer of their first track; but for them, the solution is of all the input.
    pub fn answer(&self, input: &Input, solution: &mut Solution) {
        let ranges = ranges(input);
        let tracks = &mut solution.tracks;
        for (duplicate, first) in self.list() {
            tracks.weight[duplicate] = tracks.weight[first];
            tracks.inlier[duplicate] = tracks.inlier[first];
            tracks.point[duplicate] = tracks.point[first];
            if !tracks.network_weight.is_empty() {
                tracks.network_weight[duplicate] = tracks.network_weight[first];
            }
            if !tracks.part.is_empty() {
                tracks.part[duplicate] = tracks.part[first];
            }
            if !tracks.second_structure.is_empty() {
                tracks.second_structure[duplicate] = tracks.second_structure[first];
            }
            let observations = &mut solution.observations;
            for (k, like) in ranges[duplicate].clone().zip(ranges[first].clone()) {
                let (k, like) = (input.caller_index(k), input.caller_index(like));
                observations.inlier[k] = observations.inlier[like];
                observations.residual_px[k] = observations.residual_px[like];
                observations.weight[k] = observations.weight[like];
                observations.split[k] = observations.split[like];
            }
        }
        let mut of_first: HashMap<u32, Vec<usize>> = HashMap::new();
        for (duplicate, first) in self.list() {
            of_first.entry(first as u32).or_default().push(duplicate);
        }
        repeat(&mut solution.splits, &of_first, |split| &mut split.track);
        repeat(&mut solution.two_view_tracks, &of_first, |found| &mut found.track);
        for structure in &mut solution.second_structures {
            repeat(&mut structure.points, &of_first, |point| &mut point.track);
        }
    }
}

/// Repeats what is said of tracks for their duplicates, and sorts it by track.
fn repeat<T: Copy>(said: &mut Vec<T>, of_first: &HashMap<u32, Vec<usize>>, track: impl Fn(&mut T) -> &mut u32) {
    for k in 0..said.len() {
        let mut entry = said[k];
        for &duplicate in of_first.get(track(&mut entry)).into_iter().flatten() {
            let mut repeated = entry;
            *track(&mut repeated) = duplicate as u32;
            said.push(repeated);
        }
    }
    said.sort_by_key(|entry| *track(&mut entry.clone()));
}

/// The observations of each track, by view.
fn ranges(input: &Input) -> Vec<Range<usize>> {
    input.track_ranges().windows(2).map(|ends| ends[0]..ends[1]).collect()
}

/// Some order of the observations of two tracks: equal where every view, coordinate and depth is.
fn compared(input: &Input, a: &Range<usize>, b: &Range<usize>) -> Ordering {
    let key = |k: usize| {
        let [x, y] = input.point_px(k);
        (input.view_of(k), x.to_bits(), y.to_bits(), input.depth(k).map(f64::to_bits))
    };
    a.clone().map(key).cmp(b.clone().map(key))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Limits, RawInput, View};

    /// An input of these tracks, each a list of view, x and y; every observation has this depth, or none has one.
    fn input(tracks: &[&[(u32, f64, f64)]], depth: impl Fn(usize) -> Option<f64>) -> Input {
        let mut raw = RawInput { views: vec![View::default(); 3], track_count: tracks.len(), ..RawInput::default() };
        for (track, observations) in tracks.iter().enumerate() {
            // In any order.
            for &(view, x, y) in observations.iter().rev() {
                raw.view.push(view);
                raw.track.push(track as u32);
                raw.x.push(x);
                raw.y.push(y);
                raw.depth.extend(depth(track));
            }
        }
        Input::new(raw, &Limits::default(), "input").expect("valid")
    }

    #[test]
    fn tracks_are_duplicates_to_the_last_bit_or_not_at_all() {
        let near = f64::from_bits(2.0f64.to_bits() + 1);
        let tracks: [&[(u32, f64, f64)]; 9] = [
            &[(0, 1.0, 2.0), (1, 3.0, 4.0)],
            &[(0, 1.0, near), (1, 3.0, 4.0)],
            &[(0, 1.0, 2.0), (1, 3.0, 4.0)],
            &[(0, 1.0, 2.0), (2, 3.0, 4.0)],
            &[(0, 1.0, 2.0), (1, 3.0, 4.0), (2, 5.0, 6.0)],
            &[(0, 1.0, 2.0), (1, 3.0, 4.0)],
            &[(0, 7.0, 7.0)],
            &[(0, 7.0, 7.0)],
            &[],
        ];
        let duplicates = Duplicates::of(&input(&tracks, |_| None)).expect("duplicates");
        assert_eq!(duplicates.list().collect::<Vec<_>>(), [(2, 0), (5, 0)]);
        assert!(duplicates.is_duplicate(5) && !duplicates.is_duplicate(0) && !duplicates.is_duplicate(8));
        let warning = duplicates.warning(|track| format!("t{track}"));
        assert!(warning.detail.starts_with("2 of 9 tracks") && warning.detail.ends_with(": t2 (as t0), t5 (as t0)"));
        // Depths tell them apart too.
        assert_eq!(Duplicates::of(&input(&tracks, |track| Some(1.0 + track as f64))), None);
        assert_eq!(Duplicates::of(&input(&tracks[..2], |_| None)), None);
    }

    #[test]
    fn many_duplicates_are_counted_and_few_named() {
        let track: &[(u32, f64, f64)] = &[(0, 1.0, 2.0), (1, 3.0, 4.0)];
        let duplicates = Duplicates::of(&input(&[track; 9], |_| None)).expect("duplicates");
        let detail = duplicates.warning(|track| track.to_string()).detail;
        assert!(detail.starts_with("8 of 9 tracks") && detail.ends_with("5 (as 0), and 3 more"), "{detail}");
    }
}
