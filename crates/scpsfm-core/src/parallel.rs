//! Work on several threads that comes to the same on any number of them, to the last bit: who does a piece decides
//! nothing, and what belongs together is summed in one order. Depends on nothing of ours.

use std::num::NonZeroUsize;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, Scope, ScopedJoinHandle};

/// Stack of a thread, that of the threads that solve: the numerics keep small matrices on it.
const STACK_BYTES: usize = 8 << 20;
/// Pieces a thread that work is cut into: one that others delay leaves the rest of its share to them.
const PIECES_A_THREAD: usize = 4;

/// How many threads one solve may keep busy, its own among them.
///
/// They live for one call of [`Self::map`] or [`Self::each`], some tens of microseconds to begin: work that is done
/// sooner is better done alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Threads(NonZeroUsize);

impl Threads {
    /// The caller's own.
    pub const ONE: Self = Self(NonZeroUsize::MIN);

    /// So many; of none, one.
    pub fn new(count: usize) -> Self {
        Self(NonZeroUsize::new(count).unwrap_or(NonZeroUsize::MIN))
    }

    /// As many as the machine has cores for this process.
    pub fn one_a_core() -> Self {
        thread::available_parallelism().map_or(Self::ONE, Self)
    }

    pub fn count(self) -> usize {
        self.0.get()
    }

    /// These where there is so much work that a second one is worth its beginning, else one.
    pub fn if_worth(self, is_worth: bool) -> Self {
        if is_worth { self } else { Self::ONE }
    }

    /// Pieces to cut work into for [`Self::each`]; one where there is one thread.
    pub fn pieces(self) -> usize {
        if self == Self::ONE { 1 } else { PIECES_A_THREAD * self.count() }
    }

    /// What `work` makes of each of `0..count`, in this order.
    ///
    /// * `grain`: how many a thread takes at a time
    /// * `told`: hears on the caller's thread, before each such run of its own, how many are begun
    ///
    /// # Panics
    /// When `work` does.
    pub fn map<T: Send>(
        self,
        count: usize,
        grain: usize,
        work: impl Fn(usize) -> T + Sync,
        told: &mut dyn FnMut(usize),
    ) -> Vec<T> {
        let grain = grain.max(1);
        let runs = count.div_ceil(grain);
        let next = AtomicUsize::new(0);
        let take = |told: &mut dyn FnMut(usize)| {
            let mut done: Vec<(usize, Vec<T>)> = Vec::new();
            loop {
                let run = next.fetch_add(1, Ordering::Relaxed);
                if run >= runs {
                    return done;
                }
                told(run * grain);
                done.push((run, (run * grain..count.min((run + 1) * grain)).map(&work).collect()));
            }
        };
        let mut done = thread::scope(|scope| {
            let helpers = self.helpers(scope, runs, || take(&mut |_| ()));
            let mut done = take(told);
            helpers.into_iter().for_each(|helper| done.extend(joined(helper)));
            done
        });
        done.sort_unstable_by_key(|(run, _)| *run);
        done.into_iter().flat_map(|(_, results)| results).collect()
    }

    /// Does `work` with each of the pieces, the first ones first; whether all of it succeeded. Once a piece has not,
    /// those that are not begun are left.
    ///
    /// # Panics
    /// When `work` does.
    pub fn each<P: Send>(self, pieces: Vec<P>, work: impl Fn(P) -> bool + Sync) -> bool {
        let count = pieces.len();
        let left = Mutex::new(pieces.into_iter());
        let take = || {
            loop {
                let Some(piece) = left.lock().unwrap_or_else(PoisonError::into_inner).next() else { return true };
                if !work(piece) {
                    left.lock().unwrap_or_else(PoisonError::into_inner).by_ref().for_each(drop);
                    return false;
                }
            }
        };
        thread::scope(|scope| {
            let helpers = self.helpers(scope, count, take);
            let own = take();
            helpers.into_iter().fold(own, |all, helper| joined(helper) && all)
        })
    }

    /// Starts what helps the caller with so many pieces; fewer where the system has no more threads to give.
    fn helpers<'scope, T: Send + 'scope>(
        self,
        scope: &'scope Scope<'scope, '_>,
        pieces: usize,
        work: impl Fn() -> T + Send + Copy + 'scope,
    ) -> Vec<ScopedJoinHandle<'scope, T>> {
        let start = |_| thread::Builder::new().stack_size(STACK_BYTES).spawn_scoped(scope, work).ok();
        (1..self.count().min(pieces)).map_while(start).collect()
    }
}

/// What a helper came to; its panic goes on in the caller.
fn joined<T>(helper: ScopedJoinHandle<T>) -> T {
    helper.join().unwrap_or_else(|panic| resume_unwind(panic))
}

/// Cuts `0..weights.len()` into at most so many runs of about the same weight; where each begins, and the end.
pub fn even_cuts(pieces: usize, weights: impl ExactSizeIterator<Item = usize> + Clone) -> Vec<usize> {
    let count = weights.len();
    let total: usize = weights.clone().sum();
    let mut cuts = vec![0];
    let mut sum = 0;
    for (k, weight) in weights.enumerate() {
        // The next cut is due once the share of those before it is full.
        if sum * pieces >= cuts.len() * total && cuts.len() < pieces && k > 0 {
            cuts.push(k);
        }
        sum += weight;
    }
    cuts.push(count);
    cuts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_in_order_whoever_makes_them() {
        for threads in [1, 2, 3, 100] {
            let mut begun = Vec::new();
            let found = Threads::new(threads).map(1000, 7, |k| 3 * k, &mut |k| begun.push(k));
            assert_eq!(found, (0..1000).map(|k| 3 * k).collect::<Vec<_>>(), "{threads} threads");
            assert!(begun.is_sorted(), "{begun:?}");
        }
        assert!(Threads::new(2).map(0, 7, |k| k, &mut |_| ()).is_empty());
    }

    #[test]
    fn every_piece_is_worked_on_once_and_a_failure_leaves_the_rest() {
        for threads in [1, 2, 3, 100] {
            let mut values = vec![0; 50];
            let pieces: Vec<&mut [i32]> = values.chunks_mut(3).collect();
            assert!(Threads::new(threads).each(pieces, |piece| {
                piece.iter_mut().for_each(|value| *value += 1);
                true
            }));
            assert_eq!(values, [1; 50], "{threads} threads");
            assert!(!Threads::new(threads).each((0..50).collect(), |piece| piece != 10));
        }
        let done = AtomicUsize::new(0);
        assert!(!Threads::ONE.each((0..50).collect(), |piece| {
            done.fetch_add(1, Ordering::Relaxed);
            piece != 10
        }));
        assert_eq!(done.into_inner(), 11);
    }

    #[test]
    fn a_panic_of_a_helper_is_the_callers() {
        let caught = std::panic::catch_unwind(|| {
            Threads::new(3).map(100, 1, |k| assert!(k != 50, "piece fifty"), &mut |_| ());
        });
        let panic = caught.expect_err("a panic");
        assert!(panic.downcast_ref::<&str>().is_some_and(|text| text.contains("piece fifty")));
    }

    #[test]
    fn cuts_balance_and_cover() {
        assert_eq!(even_cuts(4, [1; 8].into_iter()), [0, 2, 4, 6, 8]);
        assert_eq!(even_cuts(2, [9, 1, 1, 1].into_iter()), [0, 1, 4]);
        assert_eq!(even_cuts(1, [1, 2, 3].into_iter()), [0, 3]);
        assert_eq!(even_cuts(8, [1, 1].into_iter()), [0, 1, 2]);
        assert_eq!(even_cuts(3, [0usize; 0].into_iter()), [0, 0]);
    }
}
