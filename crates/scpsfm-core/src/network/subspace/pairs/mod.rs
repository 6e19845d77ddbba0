//! What pairs of neighbouring views say of every observation.
//!
//! A model of all views knows residuals no smaller than what it leaves out: without depths, a subspace leaves the
//! parallax. Two views have exact equations without depths, `x_toᵀ F x_from = 0`, so that their distances tell a near
//! miss from a hit. Every block estimates `F` anew for every pair, by one step of an iteratively reweighted eight-point
//! algorithm whose weights the network gives (after Ranftl & Koltun 2018, section 3):
//!
//! 1. A match of views `v` and `v + s` weighs `sigmoid(linear(state of the track)) c / (c + e)`: what is known of the
//!    track, times Cauchy's weight (Holland & Welsch 1977) of its squared distance `e` in the block before, 0 at first.
//! 2. `f`, the nine numbers of `F`, is the eigenvector to the smallest eigenvalue of the weighted [`Scatter`]. Places
//!    are in units of their view's spread around its middle, which is what Hartley (1997) asks for. Rank 2 is not
//!    enforced: it moves what noise leaves undetermined, and costs a decomposition.
//! 3. `e` is the squared Sampson distance (Hartley & Zisserman, eq. 11.9), whatever the scale and the sign of `f`.
//! 4. An observation hears the least and the mean of `ln(e + floor) / 2` over its pairs, and how many these are.
//!
//! Pairs are [`Shape::strides`](super::Shape::strides) views apart at most, so that time is linear in the views.

mod scatter;
#[cfg(test)]
mod tests;

pub use scatter::{Matches, Scatter, UNKNOWNS, least_direction, trace};

use super::arrays::{PAIR_FEATURES, PairLayers};
use super::cloud::Cloud;
use super::rows::{accumulate, logarithm, row, row_mut, rows};

/// Added to a squared distance before its logarithm is taken: a thousandth of a view's spread is some tenths of a
/// pixel, and what lies closer is right wherever it lies.
pub const DISTANCE_FLOOR: f32 = 1e-6;
/// Added to the squared gradient that a Sampson distance is divided by: at both epipoles every point lies on its line.
/// Elsewhere the gradient of a unit vector `f` is some tenths.
pub const GRADIENT_FLOOR: f32 = 1e-6;
/// What an observation without pairs hears in place of logarithms: halfway between those of a right match with noise of
/// some thousandths of the spread, -6, and of a wrong one, -1.
pub const NEUTRAL: f32 = -3.5;
/// Matches without which a pair is not asked: eight determine a fundamental matrix whatever they are, and fewer than as
/// many again do not say whether they agree.
pub const LEAST_MATCHES: usize = 16;
/// The fundamental matrix in place of one that cannot be estimated: nothing fits it.
pub const NOTHING_FITS: [f64; UNKNOWNS] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];

/// The pairs of some views: stride by stride, counted from 0, then view by view.
pub fn pairs(views: usize, strides: usize) -> impl Iterator<Item = Pair> {
    let of_stride = move |stride: usize| {
        let apart = stride + 1;
        (apart..views).map(move |to| Pair { stride, from: to - apart, to })
    };
    (0..strides).flat_map(of_stride)
}

/// Two views that are `stride + 1` apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    pub stride: usize,
    pub from: usize,
    pub to: usize,
}

/// Who is seen by both views of a pair, 1 or 0; nobody, where too few are for the pair to be asked.
pub fn seen_by_both<T: Copy + Into<f64> + From<u8>>(from: &[T], to: &[T]) -> Vec<T> {
    let both: Vec<bool> = from.iter().zip(to).map(|(&from, &to)| from.into() * to.into() > 0.5).collect();
    let is_asked = both.iter().filter(|both| **both).count() >= LEAST_MATCHES;
    both.into_iter().map(|both| T::from(u8::from(both && is_asked))).collect()
}

/// The pairs of one cloud on their way through the blocks.
pub struct Pairs<'a> {
    cloud: &'a Cloud,
    strides: usize,
    pairs: Vec<Asked>,
}

/// A pair that is asked.
struct Asked {
    pair: Pair,
    /// Who is seen by both views, m.
    seen: Vec<f32>,
    /// Squared distances of the block before, m.
    squared: Vec<f32>,
}

/// What pairs say of every observation, n x [`PAIR_FEATURES`] x m; nothing, where they are not asked.
#[derive(Default)]
pub struct PairFeatures {
    tracks: usize,
    values: Vec<f32>,
}

impl<'a> Pairs<'a> {
    pub fn new(cloud: &'a Cloud, strides: usize) -> Self {
        let tracks = cloud.tracks();
        let asked = |pair: Pair| {
            let seen = seen_by_both(row(cloud.visible(), tracks, pair.from), row(cloud.visible(), tracks, pair.to));
            let is_asked = seen.iter().any(|&seen| seen > 0.0);
            // At distance 0 Cauchy's weight is 1: the first block has none.
            is_asked.then(|| Asked { pair, seen, squared: vec![0.0; tracks] })
        };
        Self { cloud, strides, pairs: pairs(cloud.views(), strides).filter_map(asked).collect() }
    }

    /// One step of every pair, and what comes of it.
    ///
    /// * `state`: of the tracks, C x m
    #[inline(always)]
    pub fn ask(&mut self, layers: &PairLayers<Vec<f32>>, state: &[f32]) -> PairFeatures {
        let tracks = self.cloud.tracks();
        let mut trust = layers.trust.affine(&[state], tracks);
        trust.iter_mut().for_each(|logit| *logit = 1.0 / (1.0 + (-*logit).exp()));
        let mut features = PairFeatures::new(self.cloud.views(), tracks);
        let mut weights = vec![0.0; tracks];
        for Asked { pair, seen, squared } in &mut self.pairs {
            let scale = layers.log_scale[pair.stride].exp();
            let trust = row(&trust, tracks, pair.stride);
            for j in 0..tracks {
                weights[j] = seen[j] * trust[j] * scale / (scale + squared[j]);
            }
            let places = |view: usize| [0, 1].map(|axis| row(self.cloud.places(), tracks, 2 * view + axis));
            let matches = Matches { from: places(pair.from), to: places(pair.to), weights: &weights };
            let fundamental = least_direction(&matches.scatter()).unwrap_or(NOTHING_FITS);
            sampson(&fundamental.map(|value| value as f32), &matches, squared);
            let logarithms = &mut weights;
            for (heard, squared) in logarithms.iter_mut().zip(&*squared) {
                *heard = 0.5 * logarithm(squared + DISTANCE_FLOOR);
            }
            features.add(pair.from, logarithms, seen);
            features.add(pair.to, logarithms, seen);
        }
        features.finish(2 * self.strides);
        features
    }
}

impl PairFeatures {
    fn new(views: usize, tracks: usize) -> Self {
        let mut values = vec![0.0; views * PAIR_FEATURES * tracks];
        values.chunks_exact_mut(PAIR_FEATURES * tracks).for_each(|of_view| of_view[..tracks].fill(f32::INFINITY));
        Self { tracks, values }
    }

    /// Hears a pair on the observations of one of its views.
    #[inline(always)]
    fn add(&mut self, view: usize, logarithms: &[f32], seen: &[f32]) {
        let tracks = self.tracks;
        let of_view = &mut self.values[view * PAIR_FEATURES * tracks..][..PAIR_FEATURES * tracks];
        let (least, rest) = of_view.split_at_mut(tracks);
        let (sum, count) = rest.split_at_mut(tracks);
        for j in 0..tracks {
            let lower = seen[j] > 0.0 && logarithms[j] < least[j];
            least[j] = if lower { logarithms[j] } else { least[j] };
            sum[j] += seen[j] * logarithms[j];
        }
        accumulate(count, seen);
    }

    /// Sums to means, and counts to shares of the most pairs that an observation can be in.
    #[inline(always)]
    fn finish(&mut self, most: usize) {
        let tracks = self.tracks;
        for of_view in self.values.chunks_exact_mut(PAIR_FEATURES * tracks) {
            for j in 0..tracks {
                let count = of_view[2 * tracks + j];
                if count > 0.0 {
                    of_view[tracks + j] /= count;
                } else {
                    of_view[j] = NEUTRAL;
                    of_view[tracks + j] = NEUTRAL;
                }
            }
            row_mut(of_view, tracks, 2).iter_mut().for_each(|count| *count /= most as f32);
        }
    }

    /// What is said of one view's observations, [`PAIR_FEATURES`] x m, or nothing.
    pub fn of_view(&self, view: usize) -> &[f32] {
        if self.values.is_empty() {
            return &[];
        }
        rows(&self.values, self.tracks, PAIR_FEATURES * view, PAIR_FEATURES)
    }
}

/// Squared Sampson distances of the matches.
#[inline(always)]
fn sampson([a, b, c, d, e, f, g, h, i]: &[f32; UNKNOWNS], matches: &Matches<f32>, squared: &mut [f32]) {
    let tracks = squared.len();
    let [x, y, u, v] = [matches.from[0], matches.from[1], matches.to[0], matches.to[1]].map(|row| &row[..tracks]);
    for j in 0..tracks {
        let (x, y, u, v) = (x[j], y[j], u[j], v[j]);
        let line = [a * x + b * y + c, d * x + e * y + f];
        let back = [a * u + d * v + g, b * u + e * v + h];
        let error = u * line[0] + v * line[1] + g * x + h * y + i;
        let gradient = line[0] * line[0] + line[1] * line[1] + back[0] * back[0] + back[1] * back[1];
        squared[j] = error * error / (gradient + GRADIENT_FLOOR);
    }
}
