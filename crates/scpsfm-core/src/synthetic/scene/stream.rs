//! Random numbers: one stream for the paper's scene and one for each thing beyond it.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What random numbers are drawn for.
///
/// The paper's scene draws from [`Stream::Paper`] alone and whatever else is asked for from a stream of its own, so
/// that turning an option on leaves the rest of the scene as it was: scenes can be compared pair by pair.
#[derive(Debug, Clone, Copy)]
pub enum Stream {
    Paper = 0,
    Shape = 1,
    Motion = 2,
    Contamination = 3,
    SecondBody = 4,
    Zoom = 5,
    Roll = 6,
    WrongObservations = 7,
    DeletedObservations = 8,
    Visibility = 9,
    OwnCameras = 10,
}

impl Stream {
    /// The stream of this seed, from its start.
    pub fn of(self, seed: u64) -> ChaCha8Rng {
        rng(self as u64, seed)
    }
}

/// A numbered stream of this seed, from its start.
pub fn rng(stream: u64, seed: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}
