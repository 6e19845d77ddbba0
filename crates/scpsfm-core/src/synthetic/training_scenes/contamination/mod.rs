//! What is wrong with the tracks of a scene: kinds that spoil each track by itself (`single`), and kinds in which
//! wrong tracks agree among themselves (`groups`). All of them put observations elsewhere; the labels follow from where
//! they end up.

mod groups;
mod single;

use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::draft::Draft;
use super::draw::{chance, log_uniform, pick, uniform};
use super::plan::Plan;

/// What the wrong observations of a scene are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Points of other wrong tracks of the same view.
    Permuted,
    /// Anywhere in the image.
    Uniform,
    /// Permuted or anywhere, but in some views of a track only.
    Partial,
    /// Of a second rigid body.
    SecondMotion,
    /// On the epipolar lines of the first view's points.
    Slid,
    /// Following one point and then another, as matching from image to image does.
    Chained,
    /// Displaced by one vector, the same for all: repeated structure.
    Shifted,
    /// Near the right place: repeated texture.
    Local,
    /// Always in the same place of the image: dirt, overlays, the bonnet of a car.
    Static,
    /// In a few blobs that move about.
    Clusters,
}

/// The kinds and how often each is drawn (the prototype's mix).
const KINDS: [(Kind, f64); 10] = [
    (Kind::Permuted, 0.32),
    (Kind::Uniform, 0.07),
    (Kind::Partial, 0.09),
    (Kind::SecondMotion, 0.1),
    (Kind::Slid, 0.09),
    (Kind::Chained, 0.09),
    (Kind::Shifted, 0.05),
    (Kind::Local, 0.07),
    (Kind::Static, 0.08),
    (Kind::Clusters, 0.04),
];
/// The same for real-like scenes: matching goes from image to image, so that most wrong tracks are chains.
const REAL_KINDS: [(Kind, f64); 5] =
    [(Kind::Chained, 0.6), (Kind::Permuted, 0.1), (Kind::Local, 0.1), (Kind::Slid, 0.1), (Kind::Partial, 0.1)];

/// Share of the scenes with a moderate share of outliers, and that share. The others are near the limit of what can be
/// found, where a learned prior is worth most.
const MODERATE: f64 = 0.4;
const MODERATE_WRONG: (f64, f64) = (0.3, 0.9);
/// Shares of outliers near the limit; with many tracks more of them may be wrong.
const HARD_WRONG: (f64, f64) = (0.88, 0.985);
const HARD_WRONG_OF_MANY: (f64, f64) = (0.88, 0.99);
const MANY_TRACKS: usize = 300;
/// Noise in image widths.
const NOISE: (f64, f64) = (2e-4, 0.04);
/// Shares of outliers and noise of real-like scenes: detectors are good to a few tenths of a pixel.
const REAL_WRONG: (f64, f64) = (0.1, 0.85);
const REAL_NOISE: (f64, f64) = (4e-5, 0.003);

/// Right tracks that are left at least, in complete views: five, or four (one more than any set of cameras fits) where
/// the share of outliers is beyond [`EXTREME_WRONG`]. Holes ask for more of them, so that a view shows as many.
const LEAST_RIGHT: usize = 5;
const LEAST_RIGHT_EXTREME: usize = 4;
const EXTREME_WRONG: f64 = 0.979;

/// Share of the scenes of [`Kind::Clusters`] in which every wrong track is in a cluster, with outliers and noise at
/// most: no method copes with them yet, and only the right tracks fit as well as the noise allows.
const CLUSTERS_DOMINATE: f64 = 0.3;
const DOMINANT_WRONG: f64 = 0.9;
const DOMINANT_NOISE: f64 = 0.005;

/// Which contamination a scene has, and how much.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recipe {
    pub kind: Kind,
    /// Share of the tracks that are wrong, if that leaves enough right ones.
    pub wrong: f64,
    /// Standard deviation of the noise in image widths, if the image is not too small for it.
    pub noise: f64,
    /// Whether clusters have no bound.
    pub dominant: bool,
}

impl Recipe {
    pub fn draw(plan: &Plan, rng: &mut ChaCha8Rng) -> Self {
        let (kinds, noise) = if plan.real_like { (&REAL_KINDS[..], REAL_NOISE) } else { (&KINDS[..], NOISE) };
        let kind = pick(kinds, rng);
        let noise = log_uniform(noise, rng);
        let wrong = if plan.real_like {
            uniform(REAL_WRONG, rng)
        } else if chance(MODERATE, rng) {
            uniform(MODERATE_WRONG, rng)
        } else {
            uniform(if plan.tracks < MANY_TRACKS { HARD_WRONG } else { HARD_WRONG_OF_MANY }, rng)
        };
        if kind == Kind::Clusters && chance(CLUSTERS_DOMINATE, rng) {
            return Self { kind, wrong: wrong.min(DOMINANT_WRONG), noise: noise.min(DOMINANT_NOISE), dominant: true };
        }
        Self { kind, wrong, noise, dominant: false }
    }

    /// How many tracks stay right where this share of the observations is there.
    fn kept(&self, tracks: usize, visible: f64) -> usize {
        let least = if self.wrong < EXTREME_WRONG { LEAST_RIGHT } else { LEAST_RIGHT_EXTREME };
        let kept = ((1.0 - self.wrong) * tracks as f64).round() as usize;
        kept.max((least as f64 / visible).ceil() as usize).min(tracks)
    }
}

/// Spoils tracks as the draft's recipe says.
pub fn apply(draft: &mut Draft, rng: &mut ChaCha8Rng) {
    let visible = draft.visible.iter().filter(|&&visible| visible).count() as f64 / draft.visible.len() as f64;
    let kept = draft.recipe.kept(draft.tracks, visible);
    let mut wrong: Vec<usize> = (0..draft.tracks).collect();
    wrong.shuffle(rng);
    wrong.truncate(draft.tracks - kept);
    let frames = frames(draft);
    match draft.recipe.kind {
        Kind::Permuted => single::permute(draft, &wrong, &frames, rng),
        Kind::Uniform => single::scatter(draft, &wrong, &frames, rng),
        Kind::Partial => single::spoil_partly(draft, &wrong, &frames, rng),
        Kind::Chained => single::chain(draft, &wrong, rng),
        kind => {
            let group = &wrong[..groups::size(draft, kind, kept, wrong.len(), rng)];
            groups::spoil(draft, kind, group, &frames, rng);
            single::permute(draft, &wrong[group.len()..], &frames, rng);
        }
    }
}

/// The rectangle that holds the exact points of a view.
struct Frame {
    low: [f64; 2],
    size: [f64; 2],
}

impl Frame {
    fn anywhere(&self, rng: &mut ChaCha8Rng) -> [f64; 2] {
        std::array::from_fn(|axis| self.low[axis] + self.size[axis] * rng.random::<f64>())
    }
}

fn frames(draft: &Draft) -> Vec<Frame> {
    let bound = |view: &[[f64; 2]], axis: usize, of: fn(f64, f64) -> f64| {
        view.iter().map(|point| point[axis]).reduce(of).unwrap_or_default()
    };
    let frame = |view: &[[f64; 2]]| {
        let low = [bound(view, 0, f64::min), bound(view, 1, f64::min)];
        Frame { low, size: std::array::from_fn(|axis| bound(view, axis, f64::max) - low[axis]) }
    };
    draft.exact.chunks(draft.tracks).map(frame).collect()
}

/// Mean side of the views' rectangles: the size of the images.
fn image_size(frames: &[Frame]) -> f64 {
    frames.iter().map(|frame| f64::midpoint(frame.size[0], frame.size[1])).sum::<f64>() / frames.len().max(1) as f64
}
