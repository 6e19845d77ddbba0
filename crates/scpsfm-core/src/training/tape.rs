//! The soft-subspace network on burn's tape: the same function as its
//! [`forward`](crate::network::subspace::SubspaceNet::forward) (a test compares), for several scenes of one size at
//! once, with derivatives.
//!
//! # The derivative of the ridge regressions
//! Nothing differentiates a decomposition. The inverse `X` of `G` is computed off the tape, and one Newton step on the
//! tape, `X (2 I - G X)`, puts it there: since `X` is the inverse, the step changes no value, and its derivative is
//! that of the inverse, `-X dG X`. A test compares with finite differences.
//!
//! Shapes: `B` scenes, `n` views, `m` tracks; features come before tracks, so that sums run along memory.

use burn_tensor::activation::{relu, sigmoid, softmax};
use burn_tensor::{DType, Device, Tensor, TensorData};
use nalgebra::DMatrix;

use super::Error;
use super::pairs::Pairs;
use crate::network::subspace::{
    Block, DEPTH_RANGE, LEAST_MEAN_DEPTH, LEAVE_ONE_OUT_FLOOR, Layer, MOST_PREDICTED, RESIDUAL_FLOOR, SubspaceNet,
    VARIANCE_FLOOR,
};

/// Training scenes as the network sees them.
pub struct Batch {
    /// B x n x 2 x m, see [`Cloud`](crate::network::subspace::Cloud).
    pub places: Tensor<4>,
    /// B x n x 1 x m, 1 where observed.
    pub visible: Tensor<4>,
}

/// What the network says of them.
pub struct Output {
    /// Logits of the tracks after every block, B x 1 x m.
    pub tracks: Vec<Tensor<3>>,
    /// Logits of the observations, B x n x 1 x m.
    pub observations: Tensor<4>,
    /// Homogeneous points times the last block's depths, holes filled, B x n x 3 x m.
    pub columns: Tensor<4>,
}

/// What a block's selections leave of every track.
struct Residuals {
    /// B x H x 3n x m
    left: Tensor<4>,
    /// Logarithms, B x n x H x m.
    of_observations: Tensor<4>,
    /// Logarithms, B x H x m.
    of_tracks: Tensor<3>,
    /// Logarithms, B x H x m.
    leverages: Tensor<3>,
    /// What pairs of views say beside the selections, B x n x 3 x m.
    of_pairs: Option<Tensor<4>>,
}

/// Training scenes on their way through the blocks.
struct State<'a> {
    batch: &'a Batch,
    /// Homogeneous points, B x n x 3 x m, and their squared lengths, B x n x 1 x m.
    homogeneous: Tensor<4>,
    squared_lengths: Tensor<4>,
    /// 1 where unobserved, B x n x 1 x m.
    hidden: Tensor<4>,
    /// 1 x 1 x 3n x 3n
    identity: Tensor<4>,
    /// One over the views that show each track, B x 1 x 1 x m.
    share: Tensor<4>,
    /// Half of each place, and visible: what every encoder sees beside the residuals, B x n x 3 x m.
    context: Tensor<4>,
    /// B x C x m
    tracks: Tensor<3>,
    /// B x n x 1 x m
    depths: Tensor<4>,
    /// B x n x 3 x m
    columns: Tensor<4>,
    /// Where they are asked.
    pairs: Option<Pairs>,
}

impl SubspaceNet<Tensor<2>> {
    /// Runs the network, every block's logits kept.
    ///
    /// # Errors
    /// [`Error::Backend`] for a defect of burn.
    pub fn on_tape(&self, batch: &Batch, dtype: DType) -> Result<Output, Error> {
        let mut state = State::new(self, batch, dtype)?;
        let mut tracks = Vec::with_capacity(self.blocks.len());
        let mut last = None;
        for block in &self.blocks {
            let residuals = state.residuals(block, dtype)?;
            state.advance(block, &residuals);
            state.rescale(block, &residuals);
            tracks.push(affine3(&block.logit, state.tracks.clone()));
            last = Some(residuals);
        }
        let last = last.ok_or_else(|| Error::Backend("a network without blocks".into()))?;
        let columns = state.columns.clone();
        Ok(Output { tracks, observations: state.observations(self, last), columns })
    }
}

impl<'a> State<'a> {
    fn new(network: &SubspaceNet<Tensor<2>>, batch: &'a Batch, dtype: DType) -> Result<Self, Error> {
        let (places, visible) = (batch.places.clone(), batch.visible.clone());
        let [scenes, views, _, _] = places.dims();
        let share = visible.clone().sum_dim(1).clamp_min(1.0).recip();
        let hidden = visible.clone().neg().add_scalar(1.0);
        let means = (places.clone() * visible.clone()).sum_dim(1) * share.clone();
        let offsets = (places.clone() - means.clone()) * visible.clone();
        let ones = Tensor::ones_like(&visible);
        let homogeneous = Tensor::cat(vec![places.clone(), ones.clone()], 2);
        let filling = Tensor::cat(vec![means, ones.clone().slice([0..scenes, 0..1])], 2);
        let columns = homogeneous.clone() * visible.clone() + filling * hidden.clone();
        let squared_lengths = homogeneous.clone().square().sum_dim(2);
        let context = Tensor::cat(vec![places.clone().mul_scalar(0.5), visible.clone()], 2);

        let features = Tensor::cat(vec![places, offsets.clone(), offsets.square(), visible.clone()], 2);
        let encoded = relu(affine4(&network.first_encoder, features));
        let tracks = normalised(affine3(&network.first_state, pooled(encoded, &visible, &share)));
        let identity = DMatrix::<f64>::identity(3 * views, 3 * views).as_slice().to_vec();
        let identity = constant(identity, [1, 1, 3 * views, 3 * views], dtype, &columns.device());
        let pairs = network.blocks.first().and_then(|block| block.pairs.as_ref());
        let pairs = pairs.map(|layers| Pairs::new(batch, &homogeneous, layers, dtype)).transpose()?;
        let depths = ones;
        Ok(Self {
            batch,
            identity,
            homogeneous,
            squared_lengths,
            hidden,
            share,
            context,
            tracks,
            depths,
            columns,
            pairs,
        })
    }

    fn residuals(&mut self, block: &Block<Tensor<2>>, dtype: DType) -> Result<Residuals, Error> {
        let [scenes, views, _, tracks] = self.columns.dims();
        let [selections, _] = block.log_ridge.dims();
        let rows = 3 * views;
        let columns = self.columns.clone().reshape([scenes, 1, rows, tracks]);
        let shares =
            softmax(affine3(&block.selection, self.tracks.clone()), 2).reshape([scenes, selections, 1, tracks]);
        let ridge = block.log_ridge.clone().exp().reshape([1, selections, 1, 1]);
        let scatter = (columns.clone() * shares.clone()).matmul(columns.clone().transpose());
        let scatter = scatter + self.identity.clone() * ridge.clone();
        let solved = newton_step(scatter, dtype)?.matmul(columns.clone());
        let leverages = (columns * solved.clone()).sum_dim(2);
        let kept = (shares * leverages.clone()).neg().add_scalar(1.0).clamp_min(f64::from(LEAVE_ONE_OUT_FLOOR));
        let left = solved * (ridge.clone() / kept);
        let squared = left.clone().square().reshape([scenes * selections, views, 3, tracks]).sum_dim(2);
        let squared = squared.reshape([scenes, selections, views, tracks]).swap_dims(1, 2);
        let mean = (squared.clone() * self.batch.visible.clone()).sum_dim(1) * self.share.clone();
        let leverages = (leverages * ridge).div_scalar(views as f64).squeeze_dim(2);
        let of_pairs = match (&mut self.pairs, &block.pairs) {
            (Some(pairs), Some(layers)) => Some(pairs.ask(layers, &self.tracks)?),
            _ => None,
        };
        Ok(Residuals {
            left,
            of_observations: logarithm(squared),
            of_tracks: logarithm(mean).squeeze_dim(1),
            leverages: logarithm(leverages),
            of_pairs,
        })
    }

    fn advance(&mut self, block: &Block<Tensor<2>>, residuals: &Residuals) {
        let mut features = vec![residuals.of_observations.clone(), self.context.clone()];
        features.extend(residuals.of_pairs.clone());
        let features = Tensor::cat(features, 2);
        let encoded = relu(affine4(&block.encoder, features));
        let pooled = pooled(encoded, &self.batch.visible, &self.share);
        let half = |logarithms: &Tensor<3>| logarithms.clone().mul_scalar(0.5);
        let inputs = vec![self.tracks.clone(), pooled, half(&residuals.of_tracks), half(&residuals.leverages)];
        let hidden = relu(normalised(affine3(&block.hidden, Tensor::cat(inputs, 1))));
        let change = affine3(&block.change, Tensor::cat(vec![hidden, self.tracks.clone()], 1));
        self.tracks = self.tracks.clone() + change;
    }

    fn rescale(&mut self, block: &Block<Tensor<2>>, residuals: &Residuals) {
        let [scenes, views, _, tracks] = self.columns.dims();
        let [selections, _] = block.log_ridge.dims();
        let mixture = softmax(residuals.of_tracks.clone().neg(), 1).reshape([scenes, selections, 1, tracks]);
        let mixed = (residuals.left.clone() * mixture).sum_dim(1).reshape([scenes, views, 3, tracks]);
        let predicted = self.columns.clone() - mixed;
        let factor = (predicted.clone() * self.homogeneous.clone()).sum_dim(2) / self.squared_lengths.clone();
        let factor = factor.clamp(f64::from(DEPTH_RANGE.0), f64::from(DEPTH_RANGE.1));
        let rate = sigmoid(block.depth_rate.clone()).reshape([1, 1, 1, 1]);
        self.depths = self.depths.clone() + (factor - self.depths.clone()) * rate;
        let visible = self.batch.visible.clone();
        let mean = (self.depths.clone() * visible.clone()).sum_dim(1) * self.share.clone();
        let relative = self.depths.clone() * visible / mean.clamp_min(f64::from(LEAST_MEAN_DEPTH));
        let most = f64::from(MOST_PREDICTED);
        self.columns = self.homogeneous.clone() * relative + predicted.clamp(-most, most) * self.hidden.clone();
    }

    fn observations(self, network: &SubspaceNet<Tensor<2>>, residuals: Residuals) -> Tensor<4> {
        let [scenes, views, _, tracks] = self.columns.dims();
        let [_, selections, _, _] = residuals.left.dims();
        let by_coordinate = residuals.left.reshape([scenes * selections, views, 3, tracks]);
        let in_image = by_coordinate.slice([0..scenes * selections, 0..views, 0..2]).square().sum_dim(2);
        let in_image = logarithm(in_image.reshape([scenes, selections, views, tracks]).swap_dims(1, 2)).mul_scalar(0.5);
        let of_tracks = residuals.of_tracks.mean_dim(1).mul_scalar(0.5);
        let shared = Tensor::cat(vec![of_tracks, self.tracks], 1);
        let [_, features, _] = shared.dims();
        let shared = shared.reshape([scenes, 1, features, tracks]).expand([scenes, views, features, tracks]);
        let mut features = vec![residuals.of_observations, in_image, self.context, shared];
        features.extend(residuals.of_pairs);
        let features = Tensor::cat(features, 2);
        affine4(&network.observation_logit, relu(affine4(&network.observation_hidden, features)))
    }
}

/// Mean over the views that show a track, and largest: B x n x E x m to B x 2E x m.
fn pooled(encoded: Tensor<4>, visible: &Tensor<4>, share: &Tensor<4>) -> Tensor<3> {
    let encoded = encoded * visible.clone();
    let mean = encoded.clone().sum_dim(1) * share.clone();
    Tensor::cat(vec![mean, encoded.max_dim(1)], 2).squeeze_dim(1)
}

/// `X (2 I - G X)` with `X = G⁻¹` as a constant, for every matrix of a batch.
fn newton_step(scatter: Tensor<4>, dtype: DType) -> Result<Tensor<4>, Error> {
    let device = scatter.device();
    let [scenes, selections, rows, _] = scatter.dims();
    let inverses: Vec<f64> = numbers(scatter.clone())?
        .chunks_exact(rows * rows)
        .flat_map(|scatter| inverse(DMatrix::from_row_slice(rows, rows, scatter)).as_slice().to_vec())
        .collect();
    let inverses = constant(inverses, [scenes, selections, rows, rows], dtype, &device);
    let correction = inverses.clone().matmul(scatter).matmul(inverses.clone());
    Ok(inverses.mul_scalar(2.0) - correction)
}

/// Inverse of a symmetric positive definite matrix; of one that rounding has made singular, zeros, which predict
/// nothing.
fn inverse(scatter: DMatrix<f64>) -> DMatrix<f64> {
    let size = scatter.nrows();
    scatter.cholesky().map_or_else(|| DMatrix::zeros(size, size), |factor| factor.inverse())
}

/// A constant tensor of a type from values row by row.
pub fn constant<const D: usize>(values: Vec<f64>, shape: [usize; D], dtype: DType, device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), (device, dtype))
}

/// The values of a tensor row by row, off the tape.
pub fn numbers<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f64>, Error> {
    let data = tensor.inner().into_data().convert::<f64>();
    data.try_into_vec().map_err(|error| Error::Backend(format!("{error:?}")))
}

fn logarithm<const D: usize>(squared: Tensor<D>) -> Tensor<D> {
    squared.add_scalar(f64::from(RESIDUAL_FLOOR)).log()
}

/// Every row to mean 0 and variance 1 over the tracks.
fn normalised(values: Tensor<3>) -> Tensor<3> {
    let centred = values.clone() - values.mean_dim(2);
    let variance = centred.clone().square().mean_dim(2);
    centred / variance.add_scalar(f64::from(VARIANCE_FLOOR)).sqrt()
}

/// `W X + b`, B x F x m.
pub fn affine3(layer: &Layer<Tensor<2>>, input: Tensor<3>) -> Tensor<3> {
    let [outputs, inputs] = layer.weight.dims();
    let weight = layer.weight.clone().reshape([1, outputs, inputs]);
    weight.matmul(input) + layer.bias.clone().reshape([1, outputs, 1])
}

/// `W X + b`, B x n x F x m.
fn affine4(layer: &Layer<Tensor<2>>, input: Tensor<4>) -> Tensor<4> {
    let [scenes, views, inputs, tracks] = input.dims();
    let output = affine3(layer, input.reshape([scenes * views, inputs, tracks]));
    let [_, outputs, _] = output.dims();
    output.reshape([scenes, views, outputs, tracks])
}
