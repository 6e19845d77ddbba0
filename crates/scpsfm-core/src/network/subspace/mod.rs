//! The soft-subspace network: a set network that has seen many scenes and says of a new one which tracks are right.
//!
//! Where the [PointNet](super::head) is optimised on each request from random weights, this network was trained
//! once, by `scpsfm train-prior`, and is only run. It needs no depths, knows neither the number of views nor that of
//! tracks, and skips what is unobserved.
//!
//! # The architecture
//! Image points of right tracks, one under the other, lie near a subspace of few dimensions: exactly of 4 with the right
//! depths, nearly of 4 (affine cameras) without. Each of `L` blocks makes `H` soft selections of the tracks and asks how
//! well the selected ones predict every track:
//!
//! 1. Weights `a_h = softmax over tracks` of a linear function of the tracks' states (`C` numbers each).
//! 2. `G_h = Y diag(a_h) Yᵀ + λ_h I` with `Y` (3n x m) the columns of the tracks: points times depths, 1 at first.
//! 3. What a ridge regression on the others leaves of each track, `R = λ G⁻¹ Y / max(1 - a yᵀ G⁻¹ y, floor)`
//!    (leave-one-out residuals), a 3-vector for every observation and selection, and the leverage `yᵀ G⁻¹ y`.
//! 4. Logarithms of squared residuals, encoded for each observation and pooled over the views (mean and maximum), and
//!    those of residual and leverage of each track, move the track's state; what all tracks share is normalised away.
//! 5. The prediction `Y - R`, mixed over the selections by how well each fits, moves the depths towards what it implies
//!    (projective factorisation with soft selections) and fills what is unobserved.
//!
//! A network may also ask [pairs](pairs) of neighbouring views: what these say of an observation joins its encoding in
//! every block, and what its logit is read from.
//!
//! A linear layer reads a logit for every track after every block (training looks at all, the solver at the last) and
//! another for every observation after the last block.
//!
//! Time and memory are linear in the tracks and, per track, quadratic in the views: `G` is 3n x 3n.
//!
//! Everything is f32 but the inverse of `G`, which is taken in f64, and the fundamental matrices of pairs.

mod arrays;
mod cloud;
mod file;
mod forward;
mod layers;
pub mod pairs;
mod ridge;
mod rows;
mod shipped;
#[cfg(test)]
mod tests;

pub use arrays::{Block, Layer, PairLayers, Shape, SubspaceNet};
pub use cloud::Cloud;
pub use file::{Origin, PriorFile};
#[cfg(test)]
use shipped::shipped;
pub use shipped::{current, current_sha256, install};

/// Added to a squared residual before its logarithm is taken: residuals below .3 % of a view's spread are noise.
pub const RESIDUAL_FLOOR: f32 = 1e-5;
/// Least share of itself that a track's own selection may leave of it (the denominator of a leave-one-out residual).
pub const LEAVE_ONE_OUT_FLOOR: f32 = 0.02;
/// Added to the variance that normalises a feature over the tracks.
pub const VARIANCE_FLOOR: f32 = 1e-3;
/// Range of the factor by which a prediction may scale a homogeneous point: depths within one scene differ by less.
pub const DEPTH_RANGE: (f32, f32) = (0.3, 3.0);
/// Least mean depth of a track that its depths are divided by.
pub const LEAST_MEAN_DEPTH: f32 = 0.1;
/// Coordinates are kept within this of a view's median, in units of [`SPREAD_PER_DEVIATION`] deviations: beyond, a
/// point is far out, and how far says no more.
pub const MOST_OFFSET: f32 = 5.0;
/// Predictions of what is unobserved are kept within this, which leaves room beyond [`MOST_OFFSET`].
pub const MOST_PREDICTED: f32 = 8.0;
/// A view's unit of length in median absolute deviations.
pub const SPREAD_PER_DEVIATION: f64 = 1.5;
/// Views beyond which the network is not asked: the inverse of `G` would cost more than what follows it, and training
/// has seen no more than 20.
pub const MOST_VIEWS: usize = 64;
