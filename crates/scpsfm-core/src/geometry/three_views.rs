//! Three cameras from the fundamental matrices of their pairs (Hartley & Zisserman, section 15.4).

use nalgebra::{SMatrix, SVector, Vector2};

use super::fundamental::Fundamental;
use super::null_vector::{projection_equations, smallest_eigenvector};
use super::observation::Observation;
use super::{Camera, triangulation};

/// Cameras whose pairs have these fundamental matrices, up to a projective transform. Where the matrices contradict
/// each other, the third camera is that of least algebraic error.
///
/// The first two cameras are those of their own matrix. The third one, `P`, is linear in the rest: `Pᵀ F Q` is
/// skew-symmetric where `F` is the matrix from the view of the camera `Q` (result 9.12), and it images the points that
/// all three views see, which the first two determine.
///
/// * `[first_to_second, first_to_third, second_to_third]`: of the pairs of views
/// * `common`: image points of tracks that all three views see
///
/// Returns `None` where the equations hold what is no finite number.
///
/// # Pitfall
/// Where the three centres are on a line, the matrices leave four unknowns of the third camera open, and a common point
/// determines one of them: with fewer than four of these the camera is one of many.
pub fn cameras(
    [first_to_second, first_to_third, second_to_third]: [&Fundamental; 3],
    common: &[[Vector2<f64>; 3]],
) -> Option<[Camera; 3]> {
    let [first, second] = first_to_second.cameras();
    let mut normal = SMatrix::<f64, 12, 12>::zeros();
    for (fundamental, camera) in [(first_to_third, &first), (second_to_third, &second)] {
        let from = fundamental.matrix() * camera;
        for i in 0..4 {
            for j in i..4 {
                // Entry (row, column) of the camera is unknown 4 row + column.
                let mut equation = SVector::<f64, 12>::zeros();
                for row in 0..3 {
                    equation[4 * row + i] += from[(row, j)];
                    equation[4 * row + j] += from[(row, i)];
                }
                normal += equation * equation.transpose();
            }
        }
    }
    for [in_first, in_second, in_third] in common {
        let seen = [Observation::new(0, 0, *in_first), Observation::new(1, 0, *in_second)];
        let Some(point) = triangulation::linear(&[first, second], &seen).try_normalize(f64::MIN_POSITIVE) else {
            continue;
        };
        for equation in projection_equations::<4, 12>(&point, in_third) {
            normal += equation * equation.transpose();
        }
    }
    let solution = smallest_eigenvector(&normal)?;
    Some([first, second, Camera::from_fn(|row, column| solution[4 * row + column])])
}

#[cfg(test)]
mod tests {
    use super::super::bundle::testing;
    use super::super::fundamental::{self, Match, matrix_of_cameras};
    use super::*;
    use crate::domain::StopToken;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Every point but one is seen by two views only.
    #[test]
    fn three_cameras_come_of_the_matrices_of_their_pairs() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 3, 60, 1e-6);
            let of = |view: usize, point: usize| {
                scene.observations.iter().find(|seen| (seen.view, seen.point) == (view, point)).expect("seen").xy
            };
            let matrix = |from: usize, to: usize, third: usize| {
                let matches: Vec<Match> = (0..59)
                    .filter(|point| point % 3 == third)
                    .map(|point| Match { from: of(from, point), to: of(to, point) })
                    .collect();
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                fundamental::robust(&matches, 1e-5, &mut rng, &StopToken::default()).expect("enough matches").model
            };
            let matrices = [matrix(0, 1, 2), matrix(0, 2, 1), matrix(1, 2, 0)];
            let found = cameras(matrices.each_ref(), &[[0, 1, 2].map(|view| of(view, 59))]).expect("cameras");
            let truth = scene.cameras();
            for (from, to) in [(0, 1), (0, 2), (1, 2)] {
                let [found, truth] =
                    [&found[..], &truth].map(|cameras| matrix_of_cameras(&cameras[from], &cameras[to]).normalize());
                let apart = (found - truth).norm().min((found + truth).norm());
                assert!(apart < 1e-2, "seed {seed}, {from} to {to}: {apart}");
            }
            // Not the matrices alone: the third camera is in the frame of the others.
            for point in 0..59 {
                let seen = [0, 1].map(|view| Observation::new(view, 0, of(view, point)));
                let placed = triangulation::linear(&found[..2], &seen);
                let image = found[2] * placed;
                let error = (image.xy() / image.z - of(2, point)).norm();
                assert!(error < 1e-2, "seed {seed}, point {point}: {error}");
            }
        }
    }
}
