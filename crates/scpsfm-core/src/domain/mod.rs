//! What a solver is given and what it returns: inputs and their limits, settings, progress, results.
//!
//! Pure data and rules: no I/O, no async, no linear algebra. Everything else may depend on this module; it depends
//! on nothing of ours.

pub mod digest;
pub mod duplicates;
pub mod error;
pub mod image_fit;
pub mod input;
mod input_digest;
pub mod joined_tracks;
pub mod joining;
pub mod left_out;
pub mod limits;
pub mod matches;
pub mod progress;
pub mod result;
pub mod second_structure;
pub mod settings;
pub mod stop;
pub mod warning;
pub mod words;

pub use digest::Sha256Digest;
pub use error::{InvalidInput, Violation};
pub use input::{FocalPrior, ImageSize, Input, RawInput, View};
pub use joined_tracks::{JoinedTracks, Joining};
pub use left_out::LeftOut;
pub use limits::Limits;
pub use matches::{PairMatches, RawMatches};
pub use progress::{
    HeadProgress, Losses, Observer, Phase, Progress, ReconstructionProgress, Silent, Stage, Step, Task,
};
pub use result::{Calibration, Grade, LEAST_VIEWS, LensProjection, Solution, Status, VERIFIED};
pub use settings::{Backend, Method, Proposal, SolveSettings};
pub use stop::{StopReason, StopToken};
pub use warning::{Warning, WarningCode};
pub use words::counted;
