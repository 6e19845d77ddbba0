//! What [pairs of views](crate::network::subspace::pairs) say, on burn's tape: the same numbers as the network's own,
//! with derivatives.
//!
//! # The derivative of the fundamental matrices
//! Nothing differentiates a decomposition. The eigenvector `f` of the scatter `G = Σ w k kᵀ` to its smallest eigenvalue
//! `μ` is computed off the tape, and a term that is zero puts it there: `f - B (z - z₀)` with `z = Σ w k (kᵀ f)` on the
//! tape, `z₀` its value, and `B = Σ u uᵀ / (μ_u - μ)` over the other eigenpairs as a constant. Since `dz = dG f`, the
//! derivative is that of the eigenvector, `-(G - μ I)⁺ dG f` (Magnus 1985, theorem 1). The sign of `f` is arbitrary and
//! cancels in the distances. Tests compare with finite differences where neither of the following applies.
//!
//! # Where it is not the derivative
//! Reweighting is a recurrence, and its derivative through all blocks explodes: after 1,000 steps the median length of
//! a gradient was 91, nearly all of it from the first block's pairs, for .7 without pairs, and the loss of the tracks
//! rose again from step 400 on. Therefore the distances in Cauchy's weights count as given, as they do in reweighted
//! least squares, and [`LEAST_GAP`] bounds how far `f` turns. With both, lengths are those of a network without pairs.
//! The last losses of tracks and observations are .058 and .150 with both, .104 and .193 with neither, .080 and .195
//! without pairs (`train-prior --seed 0 --steps 2000`, with `--pairs` and without).
//!
//! Shapes: `B` scenes, `P` pairs of `n` views, `m` tracks.

use burn_tensor::activation::sigmoid;
use burn_tensor::{DType, Device, Tensor};
use nalgebra::{SMatrix, SymmetricEigen};

use super::Error;
use super::tape::{Batch, affine3, constant, numbers};
use crate::network::subspace::PairLayers;
use crate::network::subspace::pairs::{
    self, DISTANCE_FLOOR, GRADIENT_FLOOR, Matches, NEUTRAL, NOTHING_FITS, Pair, Scatter, UNKNOWNS, least_direction,
    seen_by_both, trace,
};

/// Least distance of another eigenvalue from the smallest one, as a share of the trace, that a derivative is divided
/// by: where matches leave a direction nearly free, noise says which way `f` turns. The losses above are .063 and .156
/// with a tenth of it, .066 and .164 with ten times as much; with a thousandth single gradients are a hundred times as
/// long as others.
const LEAST_GAP: f64 = 1e-2;
/// Rounds of the decomposition after which it is given up, as for what holds no number; it takes some twenty.
const MOST_ROUNDS: usize = 500;
/// Stands for the logarithm of a pair that an observation is not in: above that of any distance.
const ABSENT: f64 = 1e3;

/// The pairs of some scenes on their way through the blocks.
pub struct Pairs {
    dtype: DType,
    device: Device,
    pairs: Vec<Pair>,
    /// How many of them there are of each stride.
    counts: Vec<usize>,
    /// Homogeneous points in both views of each pair, B x P x 3 x m.
    from: Tensor<4>,
    to: Tensor<4>,
    /// Their products, `k` of the equations `k · f = 0`, B x P x 9 x m.
    equations: Tensor<4>,
    /// 1 where both views see the track and the pair is asked, B x P x 1 x m.
    seen: Tensor<4>,
    /// The same for each view and the pairs that it may be in, B x n x 2S x m.
    seen_by_view: Tensor<4>,
    /// Squared distances of the block before, off the tape, B x P x 1 x m.
    squared: Tensor<4>,
    /// Places off the tape, B x n x 2 x m.
    places: Vec<f64>,
}

impl Pairs {
    /// * `homogeneous`: the points, B x n x 3 x m
    /// * `layers`: those of any block, for the number of strides; there are more views than strides
    ///
    /// # Errors
    /// [`Error::Backend`] for a defect of burn.
    pub fn new(
        batch: &Batch,
        homogeneous: &Tensor<4>,
        layers: &PairLayers<Tensor<2>>,
        dtype: DType,
    ) -> Result<Self, Error> {
        let [scenes, views, _, tracks] = homogeneous.dims();
        let [strides, _] = layers.log_scale.dims();
        let device = homogeneous.device();
        let pairs: Vec<Pair> = pairs::pairs(views, strides).collect();
        let visible = numbers(batch.visible.clone())?;
        let of_view = |scene: usize, view: usize| &visible[(scene * views + view) * tracks..][..tracks];
        let of_scene =
            |scene| pairs.iter().flat_map(move |pair| seen_by_both(of_view(scene, pair.from), of_view(scene, pair.to)));
        let seen: Vec<f64> = (0..scenes).flat_map(of_scene).collect();
        let seen = constant(seen, [scenes, pairs.len(), 1, tracks], dtype, &device);
        let chosen = |view: fn(&Pair) -> usize| {
            let views = pairs.iter().map(|pair| homogeneous.clone().narrow(1, view(pair), 1)).collect();
            Tensor::cat(views, 1)
        };
        let (from, to) = (chosen(|pair| pair.from), chosen(|pair| pair.to));
        let equations = to.clone().reshape([scenes, pairs.len(), 3, 1, tracks])
            * from.clone().reshape([scenes, pairs.len(), 1, 3, tracks]);
        let equations = equations.reshape([scenes, pairs.len(), UNKNOWNS, tracks]);
        // At distance 0 Cauchy's weight is 1: the first block has none.
        let squared = Tensor::zeros_like(&seen);
        let places = numbers(batch.places.clone())?;
        let mut asked = Self {
            dtype,
            device,
            counts: (0..strides).map(|stride| pairs.iter().filter(|pair| pair.stride == stride).count()).collect(),
            pairs,
            from,
            to,
            equations,
            seen_by_view: seen.clone(),
            seen,
            squared,
            places,
        };
        asked.seen_by_view = asked.by_view(asked.seen.clone());
        Ok(asked)
    }

    /// One step of every pair, and what comes of it, B x n x 3 x m.
    ///
    /// * `state`: of the tracks, B x C x m
    ///
    /// # Errors
    /// [`Error::Backend`] for a defect of burn.
    pub fn ask(&mut self, layers: &PairLayers<Tensor<2>>, state: &Tensor<3>) -> Result<Tensor<4>, Error> {
        let [scenes, count, _, tracks] = self.seen.dims();
        let trust = sigmoid(affine3(&layers.trust, state.clone()));
        let scale = layers.log_scale.clone().exp();
        let (mut trusts, mut scales) = (Vec::new(), Vec::new());
        for (stride, &pairs) in self.counts.iter().enumerate() {
            trusts.push(trust.clone().narrow(1, stride, 1).expand([scenes, pairs, tracks]));
            scales.push(scale.clone().narrow(0, stride, 1).expand([pairs, 1]));
        }
        let trust = Tensor::cat(trusts, 1).reshape([scenes, count, 1, tracks]);
        let scale = Tensor::cat(scales, 0).reshape([1, count, 1, 1]);
        let weights = self.seen.clone() * trust * scale.clone() / (self.squared.clone() + scale);
        let fundamental = self.fundamentals(weights)?.reshape([scenes, count, 3, 3]);
        let squared = self.sampson(fundamental);
        self.squared = squared.clone().detach();
        let logarithms = squared.add_scalar(f64::from(DISTANCE_FLOOR)).log().mul_scalar(0.5);
        Ok(self.features(logarithms))
    }

    /// The numbers of every fundamental matrix, B x P x 9 x 1.
    fn fundamentals(&self, weights: Tensor<4>) -> Result<Tensor<4>, Error> {
        let [scenes, count, _, tracks] = weights.dims();
        let views = self.places.len() / (2 * scenes * tracks);
        let values = numbers(weights.clone())?;
        let (mut directions, mut turns) = (Vec::new(), Vec::new());
        for (place, weights) in values.chunks_exact(tracks).enumerate() {
            let (scene, Pair { from, to, .. }) = (place / count, self.pairs[place % count]);
            let row = |view: usize, axis: usize| &self.places[(2 * (scene * views + view) + axis) * tracks..][..tracks];
            let places = |view: usize| [row(view, 0), row(view, 1)];
            let (direction, turn) = direction(&Matches { from: places(from), to: places(to), weights }.scatter());
            directions.extend(direction);
            turns.extend(turn.as_slice());
        }
        let directions = constant(directions, [scenes, count, UNKNOWNS, 1], self.dtype, &self.device);
        let turns = constant(turns, [scenes, count, UNKNOWNS, UNKNOWNS], self.dtype, &self.device);
        let errors = directions.clone().transpose().matmul(self.equations.clone());
        let moved = self.equations.clone().matmul((errors * weights).transpose());
        let unmoved = moved.clone().detach();
        Ok(directions - turns.matmul(moved - unmoved))
    }

    /// Squared Sampson distances, B x P x 1 x m.
    fn sampson(&self, fundamental: Tensor<4>) -> Tensor<4> {
        let line = fundamental.clone().matmul(self.from.clone());
        let back = fundamental.transpose().matmul(self.to.clone());
        let error = (self.to.clone() * line.clone()).sum_dim(2);
        let in_image = |lines: Tensor<4>| lines.narrow(2, 0, 2).square().sum_dim(2);
        let gradient = in_image(line) + in_image(back);
        error.square() / gradient.add_scalar(f64::from(GRADIENT_FLOOR))
    }

    /// What every observation hears of the logarithms, B x P x 1 x m, of its pairs.
    fn features(&self, logarithms: Tensor<4>) -> Tensor<4> {
        let seen = self.seen_by_view.clone();
        let heard = self.by_view(logarithms) * seen.clone();
        let absent = seen.clone().neg().add_scalar(1.0).mul_scalar(ABSENT);
        let count = seen.sum_dim(2);
        let any = count.clone().clamp_max(1.0);
        let neutral = any.clone().neg().add_scalar(1.0).mul_scalar(f64::from(NEUTRAL));
        let least = (heard.clone() + absent).min_dim(2) * any + neutral.clone();
        let mean = heard.sum_dim(2) / count.clone().clamp_min(1.0) + neutral;
        let share = count.div_scalar((2 * self.counts.len()) as f64);
        Tensor::cat(vec![least, mean, share], 2)
    }

    /// For each view, the pairs that it may be in as the one view and as the other, zeros where there is none:
    /// B x P x 1 x m to B x n x 2S x m.
    fn by_view(&self, of_pairs: Tensor<4>) -> Tensor<4> {
        let [scenes, _, _, tracks] = of_pairs.dims();
        let mut first = 0;
        let mut all = Vec::with_capacity(2 * self.counts.len());
        for (stride, &count) in self.counts.iter().enumerate() {
            let apart = stride + 1;
            let none =
                constant(vec![0.0; scenes * apart * tracks], [scenes, apart, 1, tracks], self.dtype, &self.device);
            let of_stride = of_pairs.clone().narrow(1, first, count);
            all.push(Tensor::cat(vec![of_stride.clone(), none.clone()], 1));
            all.push(Tensor::cat(vec![none, of_stride], 1));
            first += count;
        }
        Tensor::cat(all, 2)
    }
}

/// The network's own fundamental matrix, and `B`, symmetric: how it turns with the scatter.
fn direction(scatter: &Scatter) -> ([f64; UNKNOWNS], SMatrix<f64, UNKNOWNS, UNKNOWNS>) {
    let fixed = SMatrix::zeros();
    let Some(least) = least_direction(scatter) else { return (NOTHING_FITS, fixed) };
    let matrix = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|a, b| scatter[a][b]);
    let Some(eigen) = SymmetricEigen::try_new(matrix, f64::EPSILON, MOST_ROUNDS) else { return (least, fixed) };
    let smallest = eigen.eigenvalues.imin();
    let gap = LEAST_GAP * trace(scatter);
    let mut turn = fixed;
    for (k, vector) in eigen.eigenvectors.column_iter().enumerate().filter(|(k, _)| *k != smallest) {
        let apart = (eigen.eigenvalues[k] - eigen.eigenvalues[smallest]).max(gap);
        turn += vector * vector.transpose() / apart;
    }
    (least, turn)
}
