//! Who does the work of one adjustment: its points shared out among threads, in batches whose scratch stays small. What
//! several points add to is summed in the order of the points, whoever works on them.

use std::ops::Range;

use super::layout::Layout;
use crate::domain::StopToken;
use crate::parallel::{Threads, even_cuts};

/// Observations from which a second thread is worth its beginning: their linearisation takes a millisecond.
const WORTH_A_THREAD: usize = 4_096;
/// Observations of a batch: bounds the rows of the Jacobian that are held at once, 328 bytes each, to some 5 MB, and
/// the time between two looks at the stop token to some milliseconds, 20 in builds for tests.
pub(super) const BATCH: usize = 16_384;
/// Points between two looks at the stop token where points are worked on one by one: tracks may be thousands of views
/// long.
pub(super) const POINTS_BETWEEN_QUESTIONS: usize = 16;

/// The threads of an adjustment, and the cuts of its points.
pub(super) struct WorkerPool<'a> {
    pub layout: &'a Layout,
    pub threads: Threads,
    pub stop: &'a StopToken,
    /// First points of the batches, and the end.
    batches: Vec<usize>,
}

impl<'a> WorkerPool<'a> {
    pub fn new(layout: &'a Layout, threads: Threads, stop: &'a StopToken) -> Self {
        let observations = layout.seen_range(0..layout.point_count()).len();
        let (mut batches, mut sum) = (vec![0], 0);
        for point in 0..layout.point_count() {
            if sum >= BATCH {
                batches.push(point);
                sum = 0;
            }
            sum += layout.seen(point).len();
        }
        batches.push(layout.point_count());
        Self { layout, threads: threads.if_worth(observations >= WORTH_A_THREAD), stop, batches }
    }

    /// The points in runs that are worked on one after the other.
    pub fn batches(&self) -> impl Iterator<Item = Range<usize>> {
        self.batches.windows(2).map(|ends| ends[0]..ends[1])
    }

    /// Cuts a run of points into pieces of about as many observations each; where each begins, and the end.
    pub fn cut(&self, points: Range<usize>) -> Vec<usize> {
        let first = points.start;
        let cuts = even_cuts(self.threads.pieces(), points.map(|point| self.layout.seen(point).len()));
        cuts.into_iter().map(|cut| first + cut).collect()
    }

    /// What `work` makes of every point, in their order; `None` where it made nothing of one, or it was stopped.
    pub fn of_points<T: Send>(&self, work: impl Fn(usize) -> Option<T> + Sync) -> Option<Vec<T>> {
        let cuts = self.cut(0..self.layout.point_count());
        let of_point = |point: usize| {
            let is_stopped = point.is_multiple_of(POINTS_BETWEEN_QUESTIONS) && self.stop.is_stopped();
            if is_stopped { None } else { work(point) }
        };
        let of_piece = |piece: usize| (cuts[piece]..cuts[piece + 1]).map(of_point).collect::<Option<Vec<T>>>();
        let pieces = self.threads.map(cuts.len() - 1, 1, of_piece, &mut |_| ());
        let pieces: Vec<Vec<T>> = pieces.into_iter().collect::<Option<_>>()?;
        Some(pieces.into_iter().flatten().collect())
    }
}

/// Takes the first `count` elements off a slice.
pub(super) fn split_off<'s, T>(rest: &mut &'s mut [T], count: usize) -> &'s mut [T] {
    let (first, last) = std::mem::take(rest).split_at_mut(count);
    *rest = last;
    first
}
