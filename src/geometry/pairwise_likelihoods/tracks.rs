//! Tracks with holes, as pairs of views look at them.

use std::ops::Range;

use crate::geometry::measurement::CompleteBlock;
use crate::geometry::observation::Observation;

/// Tracks of several views, each seen in some of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracks {
    views: usize,
    /// Observations of track `j`: `ranges[j]..ranges[j + 1]`.
    ranges: Vec<usize>,
    observations: Vec<Observation>,
}

impl Tracks {
    /// * `tracks`: the observations of each, views increasing and below `views`, normalised units
    ///
    /// # Panics
    /// Where the views do not increase or are too many: a defect of the caller.
    pub fn new<T: IntoIterator<Item = Observation>>(views: usize, tracks: impl IntoIterator<Item = T>) -> Self {
        let (mut ranges, mut observations) = (vec![0], Vec::new());
        for track in tracks {
            let first = observations.len();
            observations.extend(track);
            let seen: &[Observation] = &observations[first..];
            assert!(seen.is_sorted_by(|a, b| a.view < b.view), "the views of a track increase");
            assert!(seen.last().is_none_or(|last| last.view < views), "views are below their number");
            ranges.push(observations.len());
        }
        Self { views, ranges, observations }
    }

    /// The tracks of a block, which are complete.
    pub fn of_block(block: &CompleteBlock) -> Self {
        Self::new(block.views(), (0..block.tracks()).map(|track| block.track(track).iter().copied()))
    }

    pub fn views(&self) -> usize {
        self.views
    }

    /// How many tracks there are.
    pub fn len(&self) -> usize {
        self.ranges.len() - 1
    }

    /// The observations of a track.
    pub fn range(&self, track: usize) -> Range<usize> {
        self.ranges[track]..self.ranges[track + 1]
    }

    /// All observations, track by track.
    pub fn observations(&self) -> &[Observation] {
        &self.observations
    }
}
