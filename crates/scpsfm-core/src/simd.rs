//! The processor's widest vectors, for loops that carry the time. Depends on nothing of ours.

use faer::traits::ComplexField;

/// Numbers that loops over short rows take at a time: those of the widest vectors that most processors have.
pub const LANES: usize = 4;

/// Runs `work` as compiled for the widest vectors that the processor has.
///
/// Only what is inlined into `work` gains; mark it `#[inline(always)]`. Builds are for the least processor of their
/// architecture, on x86-64 one with two numbers a vector; this finds four or eight at run time.
#[inline(always)]
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    <f64 as ComplexField>::Arch::default().dispatch(work)
}
