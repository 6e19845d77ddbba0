//! What a solver is held against: the truth of [`synthetic`](crate::synthetic) scenes.
//!
//! [`measures`] scores an answer, [`oracle`] does what the best could do who knows the truth, [`bound`] says how well
//! intrinsics can be known at all and [`connection`] which views can be registered together, and [`proposal`] looks at
//! one source of proposals by itself. Which scenes are solved by whom, records and tables are the program's.

pub mod bound;
pub mod connection;
pub mod measures;
pub mod oracle;
pub mod proposal;
