//! The paper's evaluation, and what goes beyond it: every method on the same scenes, against the oracle.
//!
//! [`sweeps`] are the scenes, [`plan`] says which contestants solve them, [`runner`] does one of these runs,
//! [`records`] does many and keeps them (and goes on where it was stopped), and [`summary`] makes numbers of the
//! records, [`figures`] and [`page`] show them; [`priors`] compares what the search starts from; [`observations`] are
//! inputs that need verdicts on single observations, [`photographed`] those among them that are as people photograph,
//! [`long`] those that grow long; [`real`] holds this program beside another one on real sequences. The scores are
//! those of [`scpsfm_core::evaluation`]. May depend on it, `solver`, `synthetic`, `statistics`, `formats`, `report` and
//! `domain`; knows nothing of jobs or transport.

pub mod figures;
pub mod long;
pub mod observations;
pub mod page;
pub mod photographed;
pub mod plan;
pub mod priors;
pub mod real;
pub mod records;
pub mod runner;
pub mod summary;
pub mod sweeps;

pub use sweeps::Sweep;
