//! How well the intrinsics are determined, whatever the gauge.

use faer::{MatRef, Side};
use nalgebra::{DMatrix, SMatrix};

use super::engine::Layout;
use super::metric::{IntrinsicsModel, Metric, POINT, POSE, Reconstruction};
use super::reduced::{Linearisation, Reduced};
use super::{Loss, Observation};

/// Dimensions of a similarity: directions of the poses that no observation can see.
const GAUGE: usize = 7;
/// Eigenvalue of the poses' scaled information, relative to the largest, that counts as null beside the gauge:
/// above what rounding leaves (1e-15 times the dimension), far below what weak but real parallax gives (1e-7).
const NULL_POSE: f64 = 1e-11;
/// The same for the information on the intrinsics, scaled by what they would have with everything else known.
const NULL_INTRINSICS: f64 = 1e-10;

/// Variances of the intrinsics for observations with unit variance; multiply by the squared noise.
///
/// `None`: the observations do not determine it (the variance is infinite). Fixed intrinsics have variance 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicsVariance {
    /// Of the natural logarithm.
    pub log_focal: Option<f64>,
    pub principal_point: [Option<f64>; 2],
    /// Of the natural logarithm.
    pub log_aspect: Option<f64>,
}

/// Variances of the free intrinsics with poses and points marginalised, at this reconstruction.
///
/// The seven directions of a similarity are projected out; a null direction of what remains makes every intrinsic
/// that takes part in it infinite, rather than vanish in a pseudo-inverse.
pub fn intrinsics_variance(
    reconstruction: &Reconstruction,
    observations: &[Observation],
    model: IntrinsicsModel,
) -> IntrinsicsVariance {
    let [log_focal, px, py, log_aspect] = match model {
        IntrinsicsModel::Fixed => [Some(0.0); 4],
        IntrinsicsModel::Focal => variances::<1>(reconstruction, observations),
        IntrinsicsModel::FocalPrincipalPoint => variances::<3>(reconstruction, observations),
        IntrinsicsModel::FocalPrincipalPointAspect => variances::<4>(reconstruction, observations),
    };
    IntrinsicsVariance { log_focal, principal_point: [px, py], log_aspect }
}

/// Variance of each of the four intrinsics, the first `G` being free.
fn variances<const G: usize>(reconstruction: &Reconstruction, observations: &[Observation]) -> [Option<f64>; 4] {
    let free = information::<G>(reconstruction, observations).map(|(information, known)| invert(&information, &known));
    std::array::from_fn(|k| if k < G { free.and_then(|free| free[k]) } else { Some(0.0) })
}

/// Information on the intrinsics with poses and points marginalised, and its diagonal with both known.
fn information<const G: usize>(
    reconstruction: &Reconstruction,
    observations: &[Observation],
) -> Option<(SMatrix<f64, G, G>, [f64; G])> {
    let poses = reconstruction.poses.len();
    if poses == 0 {
        return None;
    }
    let layout = Layout::new(observations, poses, reconstruction.points.len());
    let problem = Metric::<G>(reconstruction.clone());
    let mut linearisation = Linearisation::<G, POSE, POINT>::new(&layout, poses);
    linearisation.fill(&problem, &layout, Loss::Squared);
    let known = std::array::from_fn(|k| linearisation.globals_diagonal()[k]);
    let mut reduced = Reduced::new(&layout, poses);
    if !reduced.build(&problem, &layout, &linearisation, 0.0) {
        return None;
    }
    let dimension = G + POSE * poses;
    let full = DMatrix::from_column_slice(dimension, dimension, &reduced.matrix);
    let mut information = SMatrix::<f64, G, G>::from_fn(|row, column| full[(row.max(column), row.min(column))]);
    // Unit diagonal, so that rotations and translations are compared alike.
    let scale: Vec<f64> = (G..dimension).map(|k| full[(k, k)].max(f64::MIN_POSITIVE).sqrt().recip()).collect();
    let scaled = DMatrix::from_fn(dimension - G, dimension - G, |row, column| {
        full[(G + row.max(column), G + row.min(column))] * scale[row] * scale[column]
    });
    if scaled.iter().any(|value| !value.is_finite()) {
        return None;
    }
    let coupling = DMatrix::from_fn(dimension - G, G, |row, column| full[(G + row, column)] * scale[row]);
    let n = dimension - G;
    let eigen = MatRef::from_column_major_slice(scaled.as_slice(), n, n).self_adjoint_eigen(Side::Lower).ok()?;
    // Eigenvalues come in ascending order.
    let largest = eigen.S()[n - 1];
    for k in GAUGE.min(n)..n {
        let value = eigen.S()[k];
        if value <= NULL_POSE * largest {
            continue;
        }
        let direction = nalgebra::DVector::from_fn(n, |row, _| eigen.U()[(row, k)]);
        let along = SMatrix::<f64, G, 1>::from_fn(|row, _| coupling.column(row).dot(&direction));
        information -= along * along.transpose() / value;
    }
    Some((information, known))
}

/// Diagonal of the inverse; `None` where a null direction takes part.
fn invert<const G: usize>(information: &SMatrix<f64, G, G>, known: &[f64; G]) -> [Option<f64>; G] {
    let scale: [f64; G] = std::array::from_fn(|k| if known[k] > 0.0 { known[k].sqrt().recip() } else { 0.0 });
    let scaled = DMatrix::from_fn(G, G, |row, column| information[(row, column)] * scale[row] * scale[column]);
    if scaled.iter().any(|value| !value.is_finite()) {
        return [None; G];
    }
    let eigen = scaled.symmetric_eigen();
    std::array::from_fn(|k| {
        let mut variance = 0.0;
        for (direction, &value) in eigen.eigenvalues.iter().enumerate() {
            let share = eigen.eigenvectors[(k, direction)].powi(2);
            if value > NULL_INTRINSICS {
                variance += share / value;
            } else if share > NULL_INTRINSICS {
                return None;
            }
        }
        (scale[k] > 0.0).then(|| variance * scale[k] * scale[k])
    })
}

#[cfg(test)]
mod tests {
    use super::super::testing::{self, Motion, NOISE, TestScene};
    use super::*;

    fn reconstruction(scene: &TestScene) -> Reconstruction {
        Reconstruction { intrinsics: scene.intrinsics, poses: scene.poses.clone(), points: scene.points.clone() }
    }

    #[test]
    fn translation_and_forward_motion_leave_the_focal_length_free() {
        for motion in [Motion::Translation, Motion::Forward] {
            for seed in 0..3 {
                let scene = testing::scene_of(seed, 10, 20, 0.0, motion, false);
                let variance =
                    intrinsics_variance(&reconstruction(&scene), &scene.observations, IntrinsicsModel::Focal);
                println!("{motion:?} seed {seed}: {variance:?}");
                assert_eq!(variance.log_focal, None, "{motion:?} seed {seed}");
            }
        }
    }

    #[test]
    fn general_motion_determines_everything_and_more_freedom_costs() {
        for seed in 0..3 {
            let scene = testing::scene(seed, 10, 20, 0.0);
            let deviation = |model| {
                let variance = intrinsics_variance(&reconstruction(&scene), &scene.observations, model);
                assert!(variance.principal_point.iter().all(Option::is_some), "seed {seed}: {variance:?}");
                variance.log_focal.expect("observable").sqrt() * NOISE
            };
            let alone = deviation(IntrinsicsModel::Focal);
            let with_centre = deviation(IntrinsicsModel::FocalPrincipalPoint);
            let with_aspect = deviation(IntrinsicsModel::FocalPrincipalPointAspect);
            println!("seed {seed}: sigma of log f {alone:.5}, {with_centre:.5}, {with_aspect:.5}");
            // Cramer-Rao bound of this setting: median .5 % over scenes.
            assert!((1e-4..0.02).contains(&alone), "seed {seed}: {alone}");
            assert!(with_centre >= alone && with_aspect >= with_centre);
        }
    }
}
