//! The fundamental matrix of two views: from correspondences, robustly, with its epipole and the depths it implies.
//!
//! One convention throughout: `x_toᵀ F x_from = 0`, and the epipole `e` is that of the view `to`, `eᵀ F = 0`: the image
//! of the centre of the camera `from`.

use nalgebra::{Matrix3, Matrix4, SMatrix, SVector, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;

use super::Camera;
use super::null_vector::smallest_eigenvector;
use super::ransac::{self, Estimator, RobustModel};
use crate::domain::StopToken;

/// Correspondences that determine a fundamental matrix linearly.
pub const LEAST_MATCHES: usize = 8;
/// Samples of the robust estimate at most: enough where 43 % of the matches are right. At ninety per cent outliers
/// 10⁸ would be, which nobody waits for.
const MOST_SAMPLES: usize = 4_000;
/// Chi-square quantile of .95 for one degree of freedom, which is what a Sampson distance has.
const GATE: f64 = 3.841_459;
/// Refits to the matches within a gate, each of which changes them.
const REFITS: usize = 3;
/// Spread of points, as a share of their distance from the origin, below which they coincide but for rounding.
const COINCIDENT: f64 = 1e-12;
/// Least squared sine of the angle between an image point and the epipole: at the epipole itself every depth fits.
const LEAST_SQUARED_SINE: f64 = 1e-12;

/// A point seen in two views, normalised coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    pub from: Vector2<f64>,
    pub to: Vector2<f64>,
}

/// A fundamental matrix of rank 2 and unit norm, with its epipole in the view `to`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fundamental {
    matrix: Matrix3<f64>,
    /// Unit norm; the sign is arbitrary, as is the matrix's.
    epipole: Vector3<f64>,
}

/// `x_toᵀ F x_from` and the squared norm of its gradient by the four coordinates: the square of the one over the other
/// is the squared Sampson distance.
pub fn algebraic(fundamental: &Matrix3<f64>, seen: &Match) -> (f64, f64) {
    let (from, to) = (seen.from.push(1.0), seen.to.push(1.0));
    let line = fundamental * from;
    let back = fundamental.tr_mul(&to);
    (to.dot(&line), line.xy().norm_squared() + back.xy().norm_squared())
}

/// `F` of two cameras, of any scale (Hartley & Zisserman, eq. 17.3): zero where their centres coincide.
pub fn matrix_of_cameras(from: &Camera, to: &Camera) -> Matrix3<f64> {
    let [from, to] = [from, to].map(|camera| [0, 1, 2].map(|row| camera.remove_row(row)));
    Matrix3::from_fn(|of_to, of_from| {
        let mut rows = Matrix4::zeros();
        rows.fixed_rows_mut::<2>(0).copy_from(&from[of_from]);
        rows.fixed_rows_mut::<2>(2).copy_from(&to[of_to]);
        if (of_to + of_from) % 2 == 0 { rows.determinant() } else { -rows.determinant() }
    })
}

impl Fundamental {
    /// That of two views that are not turned to each other, `[e]ₓ`.
    pub(super) fn of_translation(epipole: Vector3<f64>) -> Self {
        Self { matrix: epipole.cross_matrix(), epipole }
    }

    /// `F`, of rank 2 and unit norm.
    pub(super) fn matrix(&self) -> &Matrix3<f64> {
        &self.matrix
    }

    /// A pair of cameras that have it, that of the view `from` first (Hartley & Zisserman, result 9.14).
    pub(super) fn cameras(&self) -> [Camera; 2] {
        let mut to = Camera::zeros();
        to.fixed_columns_mut::<3>(0).copy_from(&(self.epipole.cross_matrix() * self.matrix));
        to.set_column(3, &self.epipole);
        [Camera::identity(), to]
    }

    /// Squared Sampson distance of a match (Hartley & Zisserman, eq. 11.9): to first order its squared distance in the
    /// units of the coordinates from the nearest match that fits exactly.
    pub fn sampson_squared(&self, seen: &Match) -> f64 {
        let (error, gradient_squared) = algebraic(&self.matrix, seen);
        if gradient_squared > f64::MIN_POSITIVE { error * error / gradient_squared } else { f64::INFINITY }
    }

    /// Projective depth of a match in the view `to` per unit of its depth in the view `from` (Sturm & Triggs 1996,
    /// eq. 3): `((e × x_to) · (F x_from)) / |e × x_to|²`.
    ///
    /// From `λ_to x_to = P_to X`, `λ_from x_from = P_from X` and `F = [e]ₓ P_to P_from⁺` follows
    /// `λ_to (e × x_to) = λ_from F x_from`, whose least-squares solution this is. Scale and sign of F and e are
    /// arbitrary, so that one factor, which may be negative, is common to all matches of a pair of views.
    ///
    /// Returns `None` at the epipole, where every depth fits, and for what is no finite number.
    pub fn depth_ratio(&self, seen: &Match) -> Option<f64> {
        let to = seen.to.push(1.0);
        let across = self.epipole.cross(&to);
        let squared = across.norm_squared();
        let ratio = across.dot(&(self.matrix * seen.from.push(1.0))) / squared;
        (squared > LEAST_SQUARED_SINE * to.norm_squared() && ratio.is_finite()).then_some(ratio)
    }

    /// Whether all of some matches lie on the same side of both cameras (Chum, Werner & Matas 2004): a sample with
    /// outliers rarely does, and one look spares scoring it.
    fn is_oriented(&self, sample: &[Match]) -> bool {
        let in_front = sample.iter().filter(|seen| self.depth_ratio(seen).is_some_and(|ratio| ratio > 0.0)).count();
        in_front == 0 || in_front == sample.len()
    }
}

/// The fundamental matrix of least algebraic error in Hartley's normalised coordinates (Hartley 1997), of rank 2.
///
/// * `weights`: one a match, not negative
///
/// Returns `None` for fewer than [`LEAST_MATCHES`] matches, points that all coincide, or what is no finite number.
///
/// # Pitfall
/// Points on a plane, or views from one place, have a family of such matrices; one of it is returned.
fn eight_point(matches: &[Match], weights: &[f64]) -> Option<Fundamental> {
    if matches.len() < LEAST_MATCHES || weights.len() != matches.len() {
        return None;
    }
    let total: f64 = weights.iter().sum();
    let from = hartley(matches.iter().map(|seen| seen.from).zip(weights.iter().copied()), total)?;
    let to = hartley(matches.iter().map(|seen| seen.to).zip(weights.iter().copied()), total)?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (seen, weight) in matches.iter().zip(weights) {
        let (a, b) = (from * seen.from.push(1.0), to * seen.to.push(1.0));
        // Entry (row, column) of F is unknown 3 row + column.
        let equation = SVector::<f64, 9>::from_fn(|k, _| b[k / 3] * a[k % 3]);
        normal.syger(*weight, &equation, &equation, 1.0);
    }
    normal.fill_upper_triangle_with_lower_triangle();
    let solution = smallest_eigenvector(&normal)?;
    let svd = Matrix3::from_row_slice(solution.as_slice()).svd(true, true);
    let (u, vt, mut singular) = (svd.u?, svd.v_t?, svd.singular_values);
    let smallest = singular.imin();
    singular[smallest] = 0.0;
    let normalised = u * Matrix3::from_diagonal(&singular) * vt;
    let matrix = (to.transpose() * normalised * from).try_normalize(f64::MIN_POSITIVE)?;
    let epipole = (to.try_inverse()? * u.column(smallest)).try_normalize(f64::MIN_POSITIVE)?;
    let finite = matrix.iter().chain(epipole.iter()).all(|entry| entry.is_finite());
    finite.then_some(Fundamental { matrix, epipole })
}

/// The similarity that brings weighted points to mean 0 and root mean square distance `sqrt 2`.
fn hartley(points: impl Iterator<Item = (Vector2<f64>, f64)> + Clone, total: f64) -> Option<Matrix3<f64>> {
    let mean = points.clone().map(|(point, weight)| point * weight).sum::<Vector2<f64>>() / total;
    let spread = (points.map(|(point, weight)| weight * (point - mean).norm_squared()).sum::<f64>() / total).sqrt();
    let scale = std::f64::consts::SQRT_2 / spread;
    let usable = spread.is_finite() && scale.is_finite() && spread > COINCIDENT * mean.norm();
    usable.then(|| Matrix3::new(scale, 0.0, -scale * mean.x, 0.0, scale, -scale * mean.y, 0.0, 0.0, 1.0))
}

/// Squared Sampson distance within which 95 % of the right matches lie.
pub fn squared_gate(noise: f64) -> f64 {
    GATE * noise * noise
}

/// The matrix of least truncated squared Sampson distances, by samples of eight.
///
/// * `noise`: standard deviation of a coordinate, in the units of the matches
///
/// Reliable down to 43 % inliers. Returns `None` for too few matches, no usable noise, or when no sample gives a
/// matrix.
pub(crate) fn robust(
    matches: &[Match],
    noise: f64,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<RobustModel<Fundamental>> {
    ransac::estimate(&matches, squared_gate(noise), None, 0, MOST_SAMPLES, rng, stop)
}

impl Estimator<0> for &[Match] {
    type Model = Fundamental;

    const SAMPLE: usize = LEAST_MATCHES;

    fn len(&self) -> usize {
        <[Match]>::len(self)
    }

    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Fundamental> {
        let sample: [Match; LEAST_MATCHES] = ransac::chosen(self, sample);
        eight_point(&sample, &[1.0; LEAST_MATCHES]).filter(|found| found.is_oriented(&sample))
    }

    fn squared_residual(&self, fundamental: &Fundamental, datum: usize) -> f64 {
        fundamental.sampson_squared(&self[datum])
    }

    /// Refitted to the matches within the gate, each weighted so that its algebraic error is its Sampson distance under
    /// the matrix before.
    fn refined(&self, fundamental: &Fundamental, gate: f64) -> Option<Fundamental> {
        (0..REFITS).try_fold(*fundamental, |found, _| {
            let weigh = |seen: &Match| {
                if found.sampson_squared(seen) < gate { algebraic(&found.matrix, seen).1.recip() } else { 0.0 }
            };
            let weights: Vec<f64> = self.iter().map(weigh).collect();
            let weighted = weights.iter().filter(|&&weight| weight > 0.0).count();
            (weighted >= LEAST_MATCHES).then(|| eight_point(self, &weights)).flatten()
        })
    }
}

#[cfg(test)]
#[path = "fundamental_tests.rs"]
mod tests;
