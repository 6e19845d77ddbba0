//! Random numbers: one stream for each subject, so that an option changes nothing but its own subject.

use rand_chacha::ChaCha8Rng;

use crate::synthetic::scene::stream;

/// What random numbers are drawn for. Streams below 100 are those of the paper's scenes.
#[derive(Debug, Clone, Copy)]
pub enum Stream {
    Motion = 100,
    Points = 101,
    Wrong = 102,
    SecondBody = 103,
    Noise = 104,
    /// The order in which the values of each choice come, and what else is drawn of the options.
    MotionChoice = 110,
    LensChoice = 111,
    FocalChoice = 112,
    VisibilityChoice = 113,
    WrongChoice = 114,
    Sizes = 115,
}

impl Stream {
    /// The stream of this seed, from its start.
    pub fn of(self, seed: u64) -> ChaCha8Rng {
        stream::rng(self as u64, seed)
    }
}
