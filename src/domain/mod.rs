//! What the service talks about: jobs, webhooks, names and quotas, and what solvers are given and return.
//!
//! Pure data and rules: no I/O, no async. Everything else may depend on this module; it depends on nothing of ours but
//! the domain of [`scpsfm_core`].

pub mod input_name;
pub mod job;
pub mod quota;
pub mod webhook;

pub use input_name::InputName;
pub use quota::{Oversize, Quota};
pub use scpsfm_core::domain::*;
pub use webhook::{Webhook, WebhookState};

/// Inputs of at most so many observations are checked, encoded, hashed and read on the thread that has them: it takes
/// less time than to wake another one.
pub const FEW_OBSERVATIONS: u32 = 2_000;
