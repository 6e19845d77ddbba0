//! What tests have in the place of a database.

pub(crate) mod simulated;
