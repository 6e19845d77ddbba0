//! The methods without search (PAPER, SCPSFM and PSFM): what they have in common, and plain projective factorisation.

use super::consensus::{self, Consensus, ConsensusOptions, LEAST_SUPPORT};
use super::grow;
use super::problem::Problem;
use crate::domain::StopToken;
use crate::geometry::bundle::{self, projective};
use crate::geometry::epipolar_depths::epipolar_depths;
use crate::geometry::factorization::{RANK, cameras_of, dominant_subspace, subspace_residuals};
use crate::geometry::measurement::{CompleteBlock, balance};
use crate::geometry::triangulation;

/// Residual (sine of the angle to the subspace) per unit of noise below which plain factorisation calls a track an
/// inlier; the same scale as the search's tolerance.
const PSFM_THRESHOLD_PER_NOISE: f64 = 4.0;
/// Bundle adjustment iterations of a selection that nothing else will refine.
const ADJUSTMENT_ITERATIONS: usize = 30;

/// What a method without search decided.
pub struct Decided {
    pub inlier: Vec<bool>,
    /// The method's own weights, one a track of the block.
    pub weights: Vec<f64>,
    /// Whether the method itself takes its answer for one; else nothing is reconstructed.
    pub is_verified: bool,
}

/// The block completed with depths from epipolar geometry, where the settings ask for them and the input has none: what
/// the paper does on real tracks.
///
/// Returns `None` where the block stays as it is: not asked for, depths given, or no fundamental matrix to be found, in
/// which case depths of 1 are what is left.
pub fn with_epipolar_depths(problem: &Problem, block: &CompleteBlock, noise: f64) -> Option<CompleteBlock> {
    let settings = problem.settings;
    if !settings.epipolar_depths || block.has_depths() {
        return None;
    }
    epipolar_depths(block, noise, settings.seed, problem.stop).map(|depths| block.with_depths(depths))
}

/// PSFM: the dominant subspace of all columns (Sturm & Triggs 1996), and the tracks that lie close to it.
pub fn psfm(block: &CompleteBlock, noise: f64) -> Decided {
    let matrix = balance(&block.measurement_matrix());
    let residuals = dominant_subspace(&matrix, RANK)
        .map_or_else(|| vec![1.0; block.tracks()], |basis| subspace_residuals(&matrix, &basis));
    let threshold = PSFM_THRESHOLD_PER_NOISE * noise;
    Decided {
        inlier: residuals.iter().map(|&residual| residual < threshold).collect(),
        weights: residuals.iter().map(|&residual| 1.0 / (1.0 + (residual / threshold).powi(2))).collect(),
        is_verified: true,
    }
}

/// Cameras from a decided set of tracks, adjusted to their image points; the set itself stays as it was decided.
///
/// Returns `None` when the set is too small to determine cameras.
pub fn reconstruct(block: &CompleteBlock, inlier: &[bool], noise: f64, stop: &StopToken) -> Option<Consensus> {
    let support: Vec<usize> = (0..inlier.len()).filter(|&track| inlier[track]).collect();
    if support.len() < LEAST_SUPPORT {
        return None;
    }
    let matrix = balance(&block.measurement_matrix()).select_columns(&support);
    let mut cameras = cameras_of(&dominant_subspace(&matrix, RANK)?);
    let mut points: Vec<_> = support.iter().map(|&track| triangulation::linear(&cameras, block.track(track))).collect();
    let observations = consensus::observations_of(block, &support);
    let mut consensus = None;
    let mut noise = noise;
    // Once at the noise assumed, once at that of the set itself.
    for _ in 0..2 {
        let options = bundle::Options {
            max_iterations: ADJUSTMENT_ITERATIONS,
            loss: ConsensusOptions::DEFAULT.loss(noise),
            ..bundle::Options::DEFAULT
        };
        projective::adjust(&mut cameras, &mut points, &observations, &options, stop);
        let judged = consensus::judge(block, cameras.clone(), noise, stop);
        noise = grow::estimate_noise(&judged, &support);
        consensus = Some(Consensus { inlier: inlier.to_vec(), noise, ..judged });
    }
    consensus
}
