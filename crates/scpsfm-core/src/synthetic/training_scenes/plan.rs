//! What a batch of scenes holds: one size, one kind of holes, and either scenes of all kinds or scenes that are like
//! what real image matching gives. Numbers without another reason are those of the prototype, whose network found
//! inliers at 97 % outliers, on tracks as long as the scene and on banded ones.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::draw::{chance, log_uniform, pick, uniform};
use super::holes::Holes;

/// Share of the batches that have the paper's size, which most evaluations have.
const PAPER_SIZED: f64 = 0.3;
const PAPER_SIZE: (usize, usize) = (10, 200);
/// Numbers of views; some more often, so that most batches are of middle size.
const VIEWS: [usize; 12] = [4, 5, 6, 7, 8, 10, 10, 10, 12, 14, 16, 20];
/// Range of the tracks, uniform in the logarithm.
const TRACKS: (f64, f64) = (50.0, 500.0);
/// Observations that the scenes of a batch have in all, or as near as whole scenes get: about what keeps a core's
/// cache busy, and a gradient of even size.
const OBSERVATIONS: usize = 16_000;
/// Training scenes of a batch: two at least, or its gradient would be one scene's.
const SCENES: (usize, usize) = (2, 24);

/// Share of the batches that are like real matching. They are larger than the others and have fewer scenes, so that a
/// quarter of the scenes comes from a third of the batches.
const REAL_LIKE: f64 = 0.32;
/// Views of real-like batches: mostly five, the window that seeds a sequence.
const REAL_VIEWS: [usize; 8] = [5, 5, 5, 5, 6, 8, 10, 12];
/// Tracks of real-like batches: matching gives hundreds.
const REAL_TRACKS: (f64, f64) = (150.0, 500.0);

/// What becomes of the observations of a batch: complete, banded, or missing at random.
const HOLES: [f64; 3] = [0.55, 0.3, 0.15];
/// The same for real-like batches, most of which are banded as tracks of a sequence are.
const REAL_HOLES: [f64; 3] = [0.3, 0.55, 0.15];
/// Share of the observations that are missing where they are at random.
const MISSING: (f64, f64) = (0.05, 0.45);

/// Share of the scenes of complete batches that are the product's own scenes, on which it is evaluated.
const PRODUCT_SCENES: f64 = 0.3;

/// What the scenes of one batch have in common.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub views: usize,
    pub tracks: usize,
    pub scenes: usize,
    pub holes: Holes,
    /// Whether the scenes are like what matching of real images gives.
    pub real_like: bool,
}

impl Plan {
    pub fn draw(rng: &mut ChaCha8Rng) -> Self {
        let real_like = chance(REAL_LIKE, rng);
        let (views, tracks) = draw_size(real_like, rng);
        let most = (OBSERVATIONS / (views * tracks)).clamp(SCENES.0, SCENES.1);
        let shares = if real_like { REAL_HOLES } else { HOLES };
        let missing = uniform(MISSING, rng);
        let [complete, banded, random] = shares;
        let holes = pick(&[(Holes::None, complete), (Holes::Banded, banded), (Holes::Random(missing), random)], rng);
        Self { views, tracks, scenes: most, holes, real_like }
    }

    /// Whether the next scene shall be one of the product's own scenes, which have no holes.
    pub fn draws_product_scene(&self, rng: &mut ChaCha8Rng) -> bool {
        !self.real_like && self.holes == Holes::None && chance(PRODUCT_SCENES, rng)
    }
}

/// Views and tracks.
fn draw_size(real_like: bool, rng: &mut ChaCha8Rng) -> (usize, usize) {
    if chance(PAPER_SIZED, rng) {
        PAPER_SIZE
    } else if real_like {
        (REAL_VIEWS[rng.random_range(0..REAL_VIEWS.len())], uniform(REAL_TRACKS, rng) as usize)
    } else {
        (VIEWS[rng.random_range(0..VIEWS.len())], log_uniform(TRACKS, rng).round() as usize)
    }
}
