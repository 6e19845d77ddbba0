//! The equations that weighted matches of two views make for their fundamental matrix, and the matrix that meets them
//! best.

use crate::network::subspace::ridge::invert;

/// Numbers of a fundamental matrix.
pub const UNKNOWNS: usize = 9;
/// Products of two homogeneous coordinates of one point: xx, xy, x, yy, y, 1.
const PRODUCTS: usize = 6;
/// Which of them the product of two coordinates is.
const PRODUCT: [[usize; 3]; 3] = [[0, 1, 2], [1, 3, 4], [2, 4, 5]];
/// Partial sums, so that they can be added side by side: two registers of four numbers, or one of eight.
const LANES: usize = 8;

/// What is added to the diagonal, as a share of the trace: it moves no eigenvector, and keeps what rounding left
/// singular or indefinite (some 1e-15 of the trace) invertible.
const SHIFT: f64 = 1e-13;
/// Squarings of the inverse before it is iterated: each doubles what an iteration does, for the price of nine.
const SQUARINGS: usize = 2;
/// Change of the unit vector between two iterations that ends them, and iterations at most. Of two eigenvalues within a
/// twentieth of each other the network may hear of any mixture.
const TOLERANCE: f64 = 1e-9;
const MOST_ITERATIONS: usize = 100;

/// `Σ w k kᵀ`, 9 x 9, with `k` the products of the homogeneous coordinates of a match, those of the point in the view
/// `to` outside: `k · f = x_toᵀ F x_from` for the rows of `F` one after the other in `f`.
pub type Scatter = [[f64; UNKNOWNS]; UNKNOWNS];

/// Weighted matches of two views, a row for each coordinate.
pub struct Matches<'a, T> {
    pub from: [&'a [T]; 2],
    pub to: [&'a [T]; 2],
    /// Not negative.
    pub weights: &'a [T],
}

impl<T: Copy + Into<f64>> Matches<'_, T> {
    /// Sums up the equations, in f64: the smallest eigenvalue is millionths of the largest.
    #[inline(always)]
    pub fn scatter(&self) -> Scatter {
        // Of 45 different entries 9 are others again: each is a product of the one view times one of the other.
        let mut sums = [[[0.0; LANES]; PRODUCTS]; PRODUCTS];
        for first in (0..self.weights.len()).step_by(LANES) {
            let weights = lanes(self.weights, first);
            let from = products(self.from.map(|row| lanes(row, first)));
            let to = products(self.to.map(|row| lanes(row, first)));
            for (sums, to) in sums.iter_mut().zip(&to) {
                for (sums, from) in sums.iter_mut().zip(&from) {
                    for lane in 0..LANES {
                        sums[lane] += weights[lane] * to[lane] * from[lane];
                    }
                }
            }
        }
        let sums = sums.map(|row| row.map(|lanes| lanes.iter().sum::<f64>()));
        let entry = |a: usize, b: usize| sums[PRODUCT[a / 3][b / 3]][PRODUCT[a % 3][b % 3]];
        std::array::from_fn(|a| std::array::from_fn(|b| entry(a, b)))
    }
}

/// Some numbers of a row, zeros behind its end.
#[inline(always)]
fn lanes<T: Copy + Into<f64>>(row: &[T], first: usize) -> [f64; LANES] {
    let mut lanes = [0.0; LANES];
    for (lane, value) in lanes.iter_mut().zip(&row[first..]) {
        *lane = (*value).into();
    }
    lanes
}

/// The products of the homogeneous coordinates of some points.
#[inline(always)]
fn products([x, y]: [[f64; LANES]; 2]) -> [[f64; LANES]; PRODUCTS] {
    let product = |a: &[f64; LANES], b: &[f64; LANES]| std::array::from_fn(|lane| a[lane] * b[lane]);
    [product(&x, &x), product(&x, &y), x, product(&y, &y), y, [1.0; LANES]]
}

/// The unit vector of least `fᵀ G f`: the eigenvector to the smallest eigenvalue, its sign arbitrary. By inverse
/// iteration (Golub & Van Loan, section 8.2.2).
///
/// Returns `None` for what is zero or holds what is no number.
#[inline(always)]
pub fn least_direction(scatter: &Scatter) -> Option<[f64; UNKNOWNS]> {
    let trace = trace(scatter);
    if !(trace > 0.0 && trace.is_finite()) {
        return None;
    }
    let mut power = *scatter;
    (0..UNKNOWNS).for_each(|k| power[k][k] += SHIFT * trace);
    if !invert(power.as_flattened_mut(), UNKNOWNS) {
        return None;
    }
    for _ in 0..SQUARINGS {
        power = squared(&power);
    }
    // One column at least is not orthogonal to what is sought: the longest.
    let longest = (0..UNKNOWNS).max_by(|&a, &b| power[a][a].total_cmp(&power[b][b]))?;
    let mut vector = unit(power[longest]);
    for _ in 0..MOST_ITERATIONS {
        let next = unit(power.map(|row| dot(&row, &vector)));
        // The powers of the inverse are positive definite: the sign stays.
        let moved: f64 = next.iter().zip(&vector).map(|(next, value)| (next - value) * (next - value)).sum();
        vector = next;
        if moved < TOLERANCE * TOLERANCE {
            break;
        }
    }
    vector.iter().all(|value| value.is_finite()).then_some(vector)
}

/// Sum of the eigenvalues.
pub fn trace(matrix: &Scatter) -> f64 {
    (0..UNKNOWNS).map(|k| matrix[k][k]).sum()
}

/// Square of a symmetric matrix, first brought to trace 1 so that it stays in range.
#[inline(always)]
fn squared(matrix: &Scatter) -> Scatter {
    let share = trace(matrix).recip();
    let matrix = matrix.map(|row| row.map(|value| share * value));
    matrix.map(|factors| {
        let mut sums = [0.0; UNKNOWNS];
        for (factor, row) in factors.iter().zip(&matrix) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += factor * value;
            }
        }
        sums
    })
}

#[inline(always)]
fn unit(vector: [f64; UNKNOWNS]) -> [f64; UNKNOWNS] {
    let length = dot(&vector, &vector).sqrt();
    vector.map(|value| value / length)
}

#[inline(always)]
fn dot(a: &[f64; UNKNOWNS], b: &[f64; UNKNOWNS]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{SMatrix, SVector, SymmetricEigen};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn equations_are_those_of_the_matches() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for tracks in [1, LANES, 2 * LANES + 3] {
            let mut draw = || (0..tracks).map(|_| rng.random_range(-2.0f32..2.0)).collect::<Vec<f32>>();
            let (from, to, weights) = ([draw(), draw()], [draw(), draw()], draw());
            let matches = Matches {
                from: from.each_ref().map(|row| &row[..]),
                to: to.each_ref().map(|row| &row[..]),
                weights: &weights,
            };
            let mut expected = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
            for j in 0..tracks {
                let point = |rows: &[Vec<f32>; 2]| [rows[0][j], rows[1][j], 1.0].map(f64::from);
                let (from, to) = (point(&from), point(&to));
                let k = SVector::<f64, UNKNOWNS>::from_fn(|row, _| to[row / 3] * from[row % 3]);
                expected += f64::from(weights[j]) * k * k.transpose();
            }
            let found = matches.scatter();
            for (a, row) in found.iter().enumerate() {
                for (b, value) in row.iter().enumerate() {
                    assert!((value - expected[(a, b)]).abs() < 1e-12 * (1.0 + value.abs()), "({a}, {b}), {tracks}");
                }
            }
        }
    }

    /// A matrix with these eigenvalues and random eigenvectors.
    fn with_eigenvalues(values: [f64; UNKNOWNS], rng: &mut ChaCha8Rng) -> Scatter {
        let basis = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|_, _| rng.random_range(-1.0..1.0)).qr().q();
        let matrix = basis * SMatrix::from_diagonal(&values.into()) * basis.transpose();
        std::array::from_fn(|a| std::array::from_fn(|b| 0.5 * (matrix[(a, b)] + matrix[(b, a)])))
    }

    #[test]
    fn the_least_direction_is_that_of_another_library() {
        let rest = [9.0, 8.0, 7.0, 4.0, 2.0, 1.0, 0.5];
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for [second, least] in [[0.1, 0.0], [0.1, 0.05], [1e-3, 1e-6], [1e-6, 1e-9], [1e-4, 0.9e-4]] {
                for scale in [1.0, 1e-20, 1e20] {
                    let mut values = [second; UNKNOWNS];
                    values[1..8].copy_from_slice(&rest);
                    values[8] = least;
                    let matrix = with_eigenvalues(values.map(|value| scale * value), &mut rng);
                    let found = SVector::from(least_direction(&matrix).expect("positive"));
                    let eigen = SymmetricEigen::new(SMatrix::<f64, 9, 9>::from_fn(|a, b| matrix[a][b]));
                    let expected = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
                    let apart = (expected - found * found.dot(&expected).signum()).norm();
                    assert!(apart < 1e-6, "seed {seed}, {second:e} and {least:e} times {scale:e}: {apart}");
                }
            }
        }
    }

    #[test]
    fn degenerate_matrices_have_some_direction_and_no_number_has_none() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for kept in [1, 4, 7] {
            let values = std::array::from_fn(|k| if k < kept { 1.0 } else { 0.0 });
            let matrix = with_eigenvalues(values, &mut rng);
            let found = least_direction(&matrix).expect("a direction");
            assert!(dot(&matrix.map(|row| dot(&row, &found)), &found) < 1e-9, "{kept}");
        }
        assert_eq!(least_direction(&[[0.0; UNKNOWNS]; UNKNOWNS]), None);
        assert_eq!(least_direction(&[[f64::NAN; UNKNOWNS]; UNKNOWNS]), None);
        assert_eq!(least_direction(&[[f64::INFINITY; UNKNOWNS]; UNKNOWNS]), None);
    }
}
