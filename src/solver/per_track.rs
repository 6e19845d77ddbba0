//! How work that is done track by track, each some ten microseconds, is shared among threads.

/// Tracks that a thread takes at a time, and from how many on a second thread is worth its beginning.
pub const TRACKS_A_RUN: usize = 16;
pub const WORTH_A_THREAD: usize = 64;
/// Tracks between two entries of what was found: bounds what is found and not yet entered.
pub const BATCH: usize = 8_192;
