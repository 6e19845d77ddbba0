//! Numbers, vectors and symmetric matrices of `N` tracks side by side: what is done, is done for all of them at once in
//! the processor's widest vectors. A track on its own fills a quarter of such a vector at best.
//!
//! Everything is inlined into its caller, which [`vectorised`](crate::simd::vectorised) compiles.

use std::array::from_fn;
use std::ops::{Add, AddAssign, Div, Mul, Sub};

/// What is added to the diagonal for a null vector, as a share of the trace: it moves no eigenvector, and makes the
/// factorisation of what rounding left singular or indefinite (1e-16 of the trace) safe.
const SHIFT: f64 = 1e-14;
/// Change of the unit vector between two iterations that ends them, and iterations at most. Of two eigenvalues within a
/// twentieth of each other no caller minds which mixture of their directions it gets.
const TOLERANCE: f64 = 1e-9;
const MOST_ITERATIONS: usize = 60;
/// Squarings of the inverse before: each doubles what an iteration does, for the price of four, of which a dozen were
/// needed without.
const SQUARINGS: usize = 3;

/// A number of every track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct F64xN<const N: usize>(pub [f64; N]);

/// A truth of every track.
pub type Mask<const N: usize> = [bool; N];

impl<const N: usize> F64xN<N> {
    pub const ZERO: Self = Self([0.0; N]);
    pub const ONE: Self = Self([1.0; N]);

    #[inline(always)]
    pub fn map(self, f: impl Fn(f64) -> f64) -> Self {
        Self(self.0.map(f))
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        Self(from_fn(|lane| f(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    pub fn compare(self, other: Self, f: impl Fn(f64, f64) -> bool) -> Mask<N> {
        from_fn(|lane| f(self.0[lane], other.0[lane]))
    }

    /// This where the mask holds, the other elsewhere.
    #[inline(always)]
    pub fn or(self, mask: Mask<N>, other: Self) -> Self {
        Self(from_fn(|lane| if mask[lane] { self.0[lane] } else { other.0[lane] }))
    }

    #[inline(always)]
    pub fn sqrt(self) -> Self {
        self.map(f64::sqrt)
    }

    #[inline(always)]
    pub fn recip(self) -> Self {
        self.map(f64::recip)
    }
}

macro_rules! lane_by_lane {
    ($operator:ident, $function:ident, $symbol:tt) => {
        impl<const N: usize> $operator for F64xN<N> {
            type Output = Self;

            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                self.zip(other, |a, b| a $symbol b)
            }
        }
    };
}

lane_by_lane!(Add, add, +);
lane_by_lane!(Sub, sub, -);
lane_by_lane!(Mul, mul, *);
lane_by_lane!(Div, div, /);

impl<const N: usize> Mul<f64> for F64xN<N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, factor: f64) -> Self {
        self.map(|a| a * factor)
    }
}

impl<const N: usize> AddAssign for F64xN<N> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// A homogeneous point of every track.
pub type Points<const N: usize> = [F64xN<N>; 4];

/// Places of the diagonal in a [`Symmetric`] matrix.
pub const DIAGONAL: [usize; 4] = [0, 2, 5, 9];

/// A symmetric 4x4 matrix of every track: entry (a, b) with b <= a at a (a + 1) / 2 + b.
#[derive(Clone, Copy)]
pub struct Symmetric<const N: usize>(pub [F64xN<N>; 10]);

impl<const N: usize> Symmetric<N> {
    pub const ZERO: Self = Self([F64xN::ZERO; 10]);

    /// Where no camera tells the last unknown, as of cameras that are all at the origin, it stays what it is.
    #[inline(always)]
    pub fn hold_unseen(&mut self) {
        let last = &DIAGONAL[3];
        let is_unseen = self.0[*last].compare(F64xN::ZERO, |a, b| a == b);
        self.0[*last] = self.trace().or(is_unseen, self.0[*last]);
    }

    /// Adds `weight` times the outer product of a vector with itself.
    #[inline(always)]
    pub fn add_square(&mut self, weight: F64xN<N>, v: Points<N>) {
        let [a, b, c, d] = v;
        let [wa, wb, wc, wd] = [weight * a, weight * b, weight * c, weight * d];
        let m = &mut self.0;
        m[0] += wa * a;
        m[1] += wb * a;
        m[2] += wb * b;
        m[3] += wc * a;
        m[4] += wc * b;
        m[5] += wc * c;
        m[6] += wd * a;
        m[7] += wd * b;
        m[8] += wd * c;
        m[9] += wd * d;
    }

    #[inline(always)]
    pub fn trace(&self) -> F64xN<N> {
        let m = &self.0;
        m[0] + m[2] + m[5] + m[9]
    }

    /// The unit eigenvector to the smallest eigenvalue of a positive semidefinite matrix, by inverse iteration (Golub &
    /// Van Loan, section 8.2.2). A sequence of 1,000 views took a quarter less time with it than with a full
    /// decomposition, which had been a third of the whole.
    ///
    /// Not a number where the matrix is none, or zero.
    #[inline(always)]
    pub fn null_vectors(mut self) -> Points<N> {
        let shift = self.trace() * SHIFT;
        for diagonal in DIAGONAL {
            self.0[diagonal] += shift;
        }
        let mut power = self.factor().inverse();
        for _ in 0..SQUARINGS {
            // Of trace 1: its squares stay in range.
            let scale = power.trace().recip();
            power = Self(power.0.map(|entry| entry * scale)).squared();
        }
        // One column at least is not orthogonal to what is sought: the longest.
        let [first, others @ ..] = power.columns();
        let (mut vector, mut longest) = (first, power.0[DIAGONAL[0]]);
        for (column, place) in others.into_iter().zip(&DIAGONAL[1..]) {
            let diagonal = power.0[*place];
            let is_longer = diagonal.compare(longest, |a, b| a > b);
            vector = choose(is_longer, column, vector);
            longest = diagonal.or(is_longer, longest);
        }
        let mut vector = normalised(vector);
        let mut going = [true; N];
        for _ in 0..MOST_ITERATIONS {
            // The powers of the inverse are positive definite: the sign stays.
            let next = normalised(power.times(vector));
            let moved = [next[0] - vector[0], next[1] - vector[1], next[2] - vector[2], next[3] - vector[3]];
            vector = choose(going, next, vector);
            let moves = dot(moved, moved);
            for (going, moved) in going.iter_mut().zip(moves.0) {
                // Not a number has arrived, too.
                *going &= moved >= TOLERANCE * TOLERANCE;
            }
            if going == [false; N] {
                break;
            }
        }
        vector
    }

    #[inline(always)]
    fn times(&self, v: Points<N>) -> Points<N> {
        let [a, b, c, d] = self.columns();
        [dot(a, v), dot(b, v), dot(c, v), dot(d, v)]
    }

    #[inline(always)]
    fn columns(&self) -> [Points<N>; 4] {
        let m = &self.0;
        [[m[0], m[1], m[3], m[6]], [m[1], m[2], m[4], m[7]], [m[3], m[4], m[5], m[8]], [m[6], m[7], m[8], m[9]]]
    }

    /// The matrix times itself.
    #[inline(always)]
    fn squared(&self) -> Self {
        let [a, b, c, d] = self.columns();
        Self([
            dot(a, a),
            dot(b, a),
            dot(b, b),
            dot(c, a),
            dot(c, b),
            dot(c, c),
            dot(d, a),
            dot(d, b),
            dot(d, c),
            dot(d, d),
        ])
    }

    /// Cholesky's factor (Golub & Van Loan, section 4.2); not a number where the matrix is not positive definite.
    #[inline(always)]
    pub fn factor(&self) -> Factor<N> {
        let m = &self.0;
        let l00 = m[0].sqrt().recip();
        let (l10, l20, l30) = (m[1] * l00, m[3] * l00, m[6] * l00);
        let l11 = (m[2] - l10 * l10).sqrt().recip();
        let l21 = (m[4] - l20 * l10) * l11;
        let l31 = (m[7] - l30 * l10) * l11;
        let l22 = (m[5] - l20 * l20 - l21 * l21).sqrt().recip();
        let l32 = (m[8] - l30 * l20 - l31 * l21) * l22;
        let l33 = (m[9] - l30 * l30 - l31 * l31 - l32 * l32).sqrt().recip();
        Factor { inverted: [l00, l11, l22, l33], below: [l10, l20, l21, l30, l31, l32] }
    }
}

/// A lower triangular factor.
pub struct Factor<const N: usize> {
    /// One over each entry of the diagonal.
    inverted: [F64xN<N>; 4],
    /// The entries below it, row by row.
    below: [F64xN<N>; 6],
}

impl<const N: usize> Factor<N> {
    #[inline(always)]
    pub fn solve(&self, right: Points<N>) -> Points<N> {
        let [d0, d1, d2, d3] = self.inverted;
        let [l10, l20, l21, l30, l31, l32] = self.below;
        let [a, b, c, d] = right;
        let a = a * d0;
        let b = (b - l10 * a) * d1;
        let c = (c - l20 * a - l21 * b) * d2;
        let d = (d - l30 * a - l31 * b - l32 * c) * d3;
        let d = d * d3;
        let c = (c - l32 * d) * d2;
        let b = (b - l21 * c - l31 * d) * d1;
        let a = (a - l10 * b - l20 * c - l30 * d) * d0;
        [a, b, c, d]
    }

    /// `L^-T L^-1`
    #[inline(always)]
    fn inverse(&self) -> Symmetric<N> {
        let [d0, d1, d2, d3] = self.inverted;
        let [l10, l20, l21, l30, l31, l32] = self.below;
        // The inverse of the factor, below its diagonal.
        let i10 = F64xN::ZERO - l10 * d0 * d1;
        let i20 = F64xN::ZERO - (l20 * d0 + l21 * i10) * d2;
        let i21 = F64xN::ZERO - l21 * d1 * d2;
        let i30 = F64xN::ZERO - (l30 * d0 + l31 * i10 + l32 * i20) * d3;
        let i31 = F64xN::ZERO - (l31 * d1 + l32 * i21) * d3;
        let i32 = F64xN::ZERO - l32 * d2 * d3;
        Symmetric([
            d0 * d0 + i10 * i10 + i20 * i20 + i30 * i30,
            d1 * i10 + i21 * i20 + i31 * i30,
            d1 * d1 + i21 * i21 + i31 * i31,
            d2 * i20 + i32 * i30,
            d2 * i21 + i32 * i31,
            d2 * d2 + i32 * i32,
            d3 * i30,
            d3 * i31,
            d3 * i32,
            d3 * d3,
        ])
    }
}

#[inline(always)]
pub fn dot<const N: usize>(v: Points<N>, w: Points<N>) -> F64xN<N> {
    v[0] * w[0] + v[1] * w[1] + v[2] * w[2] + v[3] * w[3]
}

#[inline(always)]
pub fn normalised<const N: usize>(v: Points<N>) -> Points<N> {
    let factor = dot(v, v).sqrt().recip();
    [v[0] * factor, v[1] * factor, v[2] * factor, v[3] * factor]
}

#[inline(always)]
pub fn choose<const N: usize>(mask: Mask<N>, v: Points<N>, w: Points<N>) -> Points<N> {
    [v[0].or(mask, w[0]), v[1].or(mask, w[1]), v[2].or(mask, w[2]), v[3].or(mask, w[3])]
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix4, Vector4};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn null_vector(matrix: &Matrix4<f64>) -> Vector4<f64> {
        let entry = |k: usize| F64xN([matrix[PLACES[k]]]);
        Symmetric::<1>(std::array::from_fn(entry)).null_vectors().map(|lanes| lanes.0[0]).into()
    }

    const PLACES: [(usize, usize); 10] =
        [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2), (3, 0), (3, 1), (3, 2), (3, 3)];

    /// A matrix with these eigenvalues and random eigenvectors.
    fn with_eigenvalues(values: [f64; 4], rng: &mut ChaCha8Rng) -> Matrix4<f64> {
        let basis = Matrix4::from_fn(|_, _| rng.random_range(-1.0..1.0)).qr().q();
        basis * Matrix4::from_diagonal(&values.into()) * basis.transpose()
    }

    #[test]
    fn nothing_is_shrunk_more() {
        let cases = [
            [3.0, 2.0, 1.0, 0.0],
            [3.0, 2.0, 1.0, 1e-9],
            [1.0, 1e-6, 1e-7, 1e-8],
            [1e12, 1.0, 0.1, 0.05],
            [1.0, 1.0, 1.0, 0.9],
            [1e-20, 1e-21, 1e-22, 1e-26],
        ];
        for seed in 0..50 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for values in cases {
                let matrix = with_eigenvalues(values, &mut rng);
                let found = null_vector(&matrix);
                let quotient = (matrix * found).dot(&found);
                let excess = (quotient - values[3]) / (values[2] - values[3]);
                assert!(excess.abs() < 1e-3 + 1e-11 * values[0] / values[2], "seed {seed}, {values:?}: {excess}");
                assert!((found.norm() - 1.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn degenerate_matrices_have_some_direction_and_no_number_has_none() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for values in [[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [1.0; 4]] {
            let matrix = with_eigenvalues(values, &mut rng);
            let found = null_vector(&matrix);
            assert!((matrix * found).dot(&found) < values[3] + 1e-9, "{values:?}");
        }
        for none in [0.0, f64::NAN, f64::INFINITY].map(Matrix4::from_diagonal_element) {
            assert!(null_vector(&none).iter().any(|entry| !entry.is_finite()), "{none}");
        }
    }
}
