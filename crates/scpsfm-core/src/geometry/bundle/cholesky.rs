//! Cholesky factorisation of the reduced system, in place.
//!
//! Most systems have 60 to 240 unknowns and are solved by the thousand. Small ones take a plain loop, the others faer.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::{MatMut, MatRef, Par};

use crate::simd::vectorised;

/// Unknowns up to which the plain loop is used: at 60 it takes as long as faer's blocks, at 120 a fifth longer.
const PLAIN_LIMIT: usize = 96;

/// Factors and solves systems of one size, with the scratch they need.
pub(super) struct CholeskySolver {
    dimension: usize,
    memory: MemBuffer,
}

impl CholeskySolver {
    pub fn new(dimension: usize) -> Self {
        let scratch = if dimension > PLAIN_LIMIT {
            llt::factor::cholesky_in_place_scratch::<f64>(dimension, Par::Seq, Default::default())
        } else {
            faer::dyn_stack::StackReq::EMPTY
        };
        Self { dimension, memory: MemBuffer::new(scratch) }
    }

    /// Solves `A x = b` in place of `b`; `false` when `A` is not positive definite.
    ///
    /// * `matrix`: `A`, column-major, lower triangle; overwritten by its factor
    pub fn solve(&mut self, matrix: &mut [f64], vector: &mut [f64]) -> bool {
        let n = self.dimension;
        if n <= PLAIN_LIMIT {
            return vectorised(
                #[inline(always)]
                || {
                    let definite = factor(matrix, n);
                    if definite {
                        substitute(matrix, vector);
                    }
                    definite
                },
            );
        }
        let stack = MemStack::new(&mut self.memory);
        let whole = MatMut::from_column_major_slice_mut(matrix, n, n);
        if llt::factor::cholesky_in_place(whole, Default::default(), Par::Seq, stack, Default::default()).is_err() {
            return false;
        }
        llt::solve::solve_in_place(
            MatRef::from_column_major_slice(matrix, n, n),
            MatMut::from_column_major_slice_mut(vector, n, 1),
            Par::Seq,
            stack,
        );
        true
    }
}

/// Left-looking factorisation, column by column, four earlier columns at a time.
#[inline(always)]
fn factor(matrix: &mut [f64], n: usize) -> bool {
    for j in 0..n {
        let (earlier, rest) = matrix.split_at_mut(j * n);
        let column = &mut rest[j..n];
        let mut k = 0;
        while k + 4 <= j {
            subtract_four(column, [0, 1, 2, 3].map(|offset| &earlier[(k + offset) * n + j..(k + offset + 1) * n]));
            k += 4;
        }
        while k < j {
            let other = &earlier[k * n + j..(k + 1) * n];
            subtract(column, other, other[0]);
            k += 1;
        }
        let pivot = column[0];
        // Written so that NaN fails.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return false;
        }
        let scale = pivot.sqrt().recip();
        column.iter_mut().for_each(|value| *value *= scale);
    }
    true
}

/// `column -= sum_k others[k] * others[k][0]`
#[inline(always)]
fn subtract_four(column: &mut [f64], others: [&[f64]; 4]) {
    let length = column.len();
    let [a, b, c, d] = others.map(|other| &other[..length]);
    let (fa, fb, fc, fd) = (a[0], b[0], c[0], d[0]);
    let mut i = 0;
    while i < length {
        column[i] -= fa * a[i] + fb * b[i] + fc * c[i] + fd * d[i];
        i += 1;
    }
}

/// `column -= other * factor`
#[inline(always)]
fn subtract(column: &mut [f64], other: &[f64], factor: f64) {
    for (value, other) in column.iter_mut().zip(other) {
        *value -= factor * other;
    }
}

/// Forward and back substitution with the factor.
#[inline(always)]
fn substitute(factor: &[f64], vector: &mut [f64]) {
    let n = vector.len();
    for j in 0..n {
        let column = &factor[j * n + j..(j + 1) * n];
        vector[j] /= column[0];
        let known = vector[j];
        subtract(&mut vector[j + 1..], &column[1..], known);
    }
    for j in (0..n).rev() {
        let column = &factor[j * n + j..(j + 1) * n];
        let sum: f64 = column[1..].iter().zip(&vector[j + 1..]).map(|(factor, known)| factor * known).sum();
        vector[j] = (vector[j] - sum) / column[0];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn solves_small_and_large_systems() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for n in [0, 1, 3, 4, 5, 61, PLAIN_LIMIT, PLAIN_LIMIT + 1] {
            let root = DMatrix::from_fn(n, n + 2, |_, _| rng.random_range(-1.0..1.0));
            let matrix = &root * root.transpose();
            let expected = DVector::from_fn(n, |_, _| rng.random_range(-1.0..1.0));
            let mut vector = (&matrix * &expected).as_slice().to_vec();
            let mut lower = matrix.lower_triangle();
            assert!(CholeskySolver::new(n).solve(lower.as_mut_slice(), &mut vector), "n {n}");
            let error = (DVector::from_vec(vector) - expected).norm();
            assert!(error < 1e-6, "n {n}: {error}");
        }
    }

    #[test]
    fn refuses_what_is_not_positive_definite() {
        for n in [3, PLAIN_LIMIT + 1] {
            for wrong in [-1.0, f64::NAN] {
                let mut matrix = DMatrix::<f64>::identity(n, n);
                matrix[(n / 2, n / 2)] = wrong;
                assert!(!CholeskySolver::new(n).solve(matrix.as_mut_slice(), &mut vec![1.0; n]), "n {n}, {wrong}");
            }
        }
    }
}
