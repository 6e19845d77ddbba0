//! Which observations a scene lacks.

use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::LEAST_RIGHT_IN_TRACK;
use super::draw::{chance, poisson, uniform};

/// Observations that every view has: two more than a camera takes.
pub const LEAST_IN_VIEW: usize = 8;
/// Views below which there is no band: it would be the whole track, or all but one view of it.
const LEAST_BANDED_VIEWS: usize = 5;

/// How observations are missing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Holes {
    None,
    /// Each track is seen in some consecutive views, as in a sequence.
    Banded,
    /// Each observation is missing with this probability.
    Random(f64),
}

impl Holes {
    /// Whether each observation is there, view by view, then track by track. Every track has three observations and
    /// every view [`LEAST_IN_VIEW`], where there are as many tracks.
    pub fn draw(self, views: usize, tracks: usize, rng: &mut ChaCha8Rng) -> Vec<bool> {
        let mut visible = match self {
            Holes::Banded if views >= LEAST_BANDED_VIEWS => banded(views, tracks, rng),
            Holes::None | Holes::Banded => return vec![true; views * tracks],
            Holes::Random(missing) => scattered(views, tracks, missing, rng),
        };
        for view in visible.chunks_mut(tracks) {
            let mut hidden: Vec<usize> = (0..tracks).filter(|&track| !view[track]).collect();
            let lacking = LEAST_IN_VIEW.saturating_sub(tracks - hidden.len());
            hidden.partial_shuffle(rng, lacking).0.iter().for_each(|&track| view[track] = true);
        }
        visible
    }
}

/// Lengths are uniform in half of the scenes; in the others most are about equal, as long as points stay in view.
fn banded(views: usize, tracks: usize, rng: &mut ChaCha8Rng) -> Vec<bool> {
    let shortest = LEAST_RIGHT_IN_TRACK;
    let mean = if chance(0.5, rng) { None } else { Some(uniform((shortest as f64, views as f64), rng)) };
    let mut visible = vec![false; views * tracks];
    for track in 0..tracks {
        let length = match mean {
            None => rng.random_range(shortest..=views),
            Some(mean) => poisson(mean, rng).clamp(shortest, views),
        };
        let first = rng.random_range(0..=views - length);
        (first..first + length).for_each(|view| visible[view * tracks + track] = true);
    }
    visible
}

fn scattered(views: usize, tracks: usize, missing: f64, rng: &mut ChaCha8Rng) -> Vec<bool> {
    let mut visible: Vec<bool> = (0..views * tracks).map(|_| !chance(missing, rng)).collect();
    for track in 0..tracks {
        let mut hidden: Vec<usize> = (0..views).filter(|view| !visible[view * tracks + track]).collect();
        let lacking = LEAST_RIGHT_IN_TRACK.saturating_sub(views - hidden.len());
        hidden.partial_shuffle(rng, lacking).0.iter().for_each(|&view| visible[view * tracks + track] = true);
    }
    visible
}
