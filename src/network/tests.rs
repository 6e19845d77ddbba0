//! Scenes for the tests of this folder, and what the optimisation as a whole must do.

use nalgebra::DMatrix;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::synthetic::{Scene, SceneOptions};

/// The balanced measurement matrix of a scene with depths and 0.3 % noise, and which of its tracks are inliers.
pub fn balanced_scene(views: usize, tracks: usize, outliers: f64, seed: u64) -> (DMatrix<f64>, Vec<bool>) {
    let options = SceneOptions { views, tracks, outliers, seed, with_depths: true, ..SceneOptions::default() };
    let scene = Scene::generate(&options).expect("valid options");
    let [centre_x, centre_y] = scene.truth.principal_point_px;
    let width = f64::from(crate::synthetic::scene::IMAGE_SIDE_PX);
    let mut matrix = DMatrix::zeros(3 * views, tracks);
    let input = &scene.input;
    for k in 0..input.x.len() {
        let (row, column, depth) = (3 * input.view[k] as usize, input.track[k] as usize, input.depth[k]);
        matrix[(row, column)] = depth * (input.x[k] - centre_x) / width;
        matrix[(row + 1, column)] = depth * (input.y[k] - centre_y) / width;
        matrix[(row + 2, column)] = depth;
    }
    balance(&mut matrix);
    (matrix, scene.truth.inlier)
}

/// Three rounds of view blocks to equal energy and columns to unit norm.
fn balance(matrix: &mut DMatrix<f64>) {
    for _ in 0..3 {
        for view in 0..matrix.nrows() / 3 {
            let mut block = matrix.rows_mut(3 * view, 3);
            block /= block.norm();
        }
        for mut column in matrix.column_iter_mut() {
            column /= column.norm();
        }
    }
}

/// Weights uniform in [0.05, 0.95].
pub fn random_weights(columns: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..columns).map(|_| rng.random_range(0.05..0.95)).collect()
}
