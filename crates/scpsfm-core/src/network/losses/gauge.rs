//! Cameras in one fixed projective frame, read off a four-dimensional span, and the derivative back to it.

use nalgebra::{Matrix3, Matrix3x4, Matrix4x3, MatrixXx3, MatrixXx4, RowVector4, Vector3, Vector4};

/// Added to the diagonal of `B Bᵀ`: keeps the inverse finite where the first view sees the span edge on.
const GRAM_FLOOR: f64 = 1e-12;
/// Added to `|a|²` and `|A|²` where they divide: keeps the scale finite where every camera is `[A|0]` or `[0|a]`.
const NORM_FLOOR: f64 = 1e-20;

/// The cameras `[A_i|a_i] = Z_i H` of a span Z (3n x 4) in the frame where the first is `[I|0]`.
///
/// `H = [B⁺ | h]` with B the first three rows of Z and h the four-dimensional cross product of its rows; then a is
/// scaled to the norm of A and its sign fixed. What remains does not depend on the basis of the span, which is what
/// gives a plane at infinity in these coordinates a meaning from one iteration to the next.
pub struct CanonicalCameras {
    span: MatrixXx4<f64>,
    first: Matrix3x4<f64>,
    inverse_gram: Matrix3<f64>,
    pseudo_inverse: Matrix4x3<f64>,
    cross: Vector4<f64>,
    /// Fourth columns before they are scaled.
    unscaled: MatrixXx3<f64>,
    /// Sign times scale of the fourth columns.
    scale: f64,
    rotational: Vec<Matrix3<f64>>,
}

impl CanonicalCameras {
    /// The cameras of a span with at least two views.
    pub fn of(span: MatrixXx4<f64>) -> Self {
        let views = span.nrows() / 3;
        let first: Matrix3x4<f64> = span.fixed_rows::<3>(0).into_owned();
        let gram = first * first.transpose() + Matrix3::from_diagonal_element(GRAM_FLOOR);
        let inverse_gram = gram.try_inverse().unwrap_or_else(Matrix3::identity);
        let pseudo_inverse = first.transpose() * inverse_gram;
        let cross = cross_of_rows(&first);
        let stacked = &span * pseudo_inverse;
        let rotational: Vec<_> = (0..views).map(|view| stacked.fixed_rows::<3>(3 * view).into_owned()).collect();
        let column = &span * cross;
        let unscaled = MatrixXx3::from_fn(views, |view, axis| column[3 * view + axis]);
        let side: f64 = column.iter().enumerate().map(|(row, entry)| entry * sign_probe(row)).sum();
        let scale = side.signum() * (stacked.norm_squared() / (column.norm_squared() + NORM_FLOOR)).sqrt();
        Self { span, first, inverse_gram, pseudo_inverse, cross, unscaled, scale, rotational }
    }

    /// `A_i`, the left 3x3 parts.
    pub fn rotational(&self) -> &[Matrix3<f64>] {
        &self.rotational
    }

    /// `a_i`, the fourth column of view `i`.
    pub fn translational(&self, view: usize) -> Vector3<f64> {
        self.unscaled.row(view).transpose() * self.scale
    }

    /// Derivative with respect to the span (3n x 4) from those with respect to every `A_i` and `a_i`.
    pub fn pull_back(&self, grad_rotational: &[Matrix3<f64>], grad_translational: &[Vector3<f64>]) -> MatrixXx4<f64> {
        let norm_squared = self.unscaled.norm_squared() + NORM_FLOOR;
        let rotational_squared = self.rotational.iter().map(Matrix3::norm_squared).sum::<f64>() + NORM_FLOOR;
        // The scale is a function of both: d log|scale| = <A, dA>/|A|² - <a, da>/|a|².
        let along: f64 = grad_translational
            .iter()
            .enumerate()
            .map(|(view, gradient)| gradient.dot(&self.unscaled.row(view).transpose()))
            .sum::<f64>()
            * self.scale;
        let mut grad_span = MatrixXx4::zeros(self.span.nrows());
        let mut grad_pseudo_inverse = Matrix4x3::zeros();
        let mut grad_cross = Vector4::zeros();
        for (view, a) in self.rotational.iter().enumerate() {
            let grad_a = grad_rotational[view] + a * (along / rotational_squared);
            let grad_column =
                grad_translational[view] * self.scale - self.unscaled.row(view).transpose() * (along / norm_squared);
            let block = self.span.fixed_rows::<3>(3 * view);
            grad_pseudo_inverse += block.transpose() * grad_a;
            grad_cross += block.transpose() * grad_column;
            let mut rows = grad_span.fixed_rows_mut::<3>(3 * view);
            rows += grad_a * self.pseudo_inverse.transpose() + grad_column * self.cross.transpose();
        }
        let mut first = grad_span.fixed_rows_mut::<3>(0);
        first += self.pull_back_pseudo_inverse(&grad_pseudo_inverse) + pull_back_cross(&self.first, &grad_cross);
        grad_span
    }

    /// Through `B⁺ = Bᵀ (B Bᵀ)⁻¹`.
    fn pull_back_pseudo_inverse(&self, gradient: &Matrix4x3<f64>) -> Matrix3x4<f64> {
        let direct = self.inverse_gram * gradient.transpose();
        let through_gram = direct * self.first.transpose() * self.inverse_gram;
        direct - (through_gram + through_gram.transpose()) * self.first
    }
}

/// A fixed direction that no camera is exactly orthogonal to; which side of it `a` lies on decides its sign.
fn sign_probe(row: usize) -> f64 {
    (1.0 + 2.4 * row as f64).sin()
}

/// The vector `h` with `h · v = det [v; b_1; b_2; b_3]`: orthogonal to the three rows.
fn cross_of_rows(rows: &Matrix3x4<f64>) -> Vector4<f64> {
    Vector4::from_fn(|column, _| {
        let minor = rows.remove_column(column).determinant();
        if column % 2 == 0 { minor } else { -minor }
    })
}

/// Through [`cross_of_rows`]: `g · h = det [g; b_1; b_2; b_3]` is linear in each row, and exchanging two rows of a
/// determinant flips its sign.
fn pull_back_cross(rows: &Matrix3x4<f64>, gradient: &Vector4<f64>) -> Matrix3x4<f64> {
    let gradient: RowVector4<f64> = gradient.transpose();
    let (b1, b2, b3) = (rows.row(0).into_owned(), rows.row(1).into_owned(), rows.row(2).into_owned());
    Matrix3x4::from_rows(&[
        -cross_of_rows(&Matrix3x4::from_rows(&[gradient, b2, b3])).transpose(),
        cross_of_rows(&Matrix3x4::from_rows(&[gradient, b1, b3])).transpose(),
        -cross_of_rows(&Matrix3x4::from_rows(&[gradient, b1, b2])).transpose(),
    ])
}
