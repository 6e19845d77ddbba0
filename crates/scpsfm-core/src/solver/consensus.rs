//! A projective reconstruction of a block, and every track judged by it.

pub use crate::domain::LEAST_VIEWS;
use crate::domain::StopToken;
use crate::geometry::bundle::Loss;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::chi_square_gate;
use crate::geometry::triangulation::batch::{Batch, LANES};
use crate::geometry::{Camera, Point};

const OPTIONS: ConsensusOptions = ConsensusOptions::DEFAULT;
/// Tracks below which projective cameras of three views or more are not determined by image points:
/// `2nk > 11n + 3k - 15`.
pub const LEAST_SUPPORT: usize = 7;
/// Inliers that geometry can verify: one track more than determine the cameras.
pub const LEAST_INLIERS: usize = LEAST_SUPPORT + 1;

options! {
    /// How tracks are judged, and cameras fitted to those that are right.
    pub struct ConsensusOptions {
        /// Refinement steps of a triangulated point.
        point_steps: usize = 6,
        /// Tracks whose linear residual is this many gates away are not refined. No refinement brings them back.
        hopeless_gates: f64 = 100.0,
        /// Scale of the Cauchy loss in units of the noise. Residuals beyond it are on their way to being outliers.
        cauchy_scale: f64 = 3.0,
    }
}

impl ConsensusOptions {
    /// Robust loss at a noise level.
    pub fn loss(&self, noise: f64) -> Loss {
        Loss::Cauchy { scale: self.cauchy_scale * noise }
    }
}

options! {
    /// How the noise of a consensus is settled.
    pub struct NoiseOptions {
        /// Noise that growing starts from when the caller gives none, as a share of the image side. High on purpose:
        /// twice too low loses the scene, ten times too high costs nothing.
        initial: f64 = 0.005,
        /// Rounds of re-estimating it. From ten times too high two or three suffice.
        rounds: usize = 6,
        /// Relative change below which it has settled.
        settled: f64 = 0.05,
        /// Bounds of the estimate, normalised units. A hundredth of a pixel in a 10,000 px image, and a tenth of the
        /// image.
        bounds: (f64, f64) = (1e-6, 0.1),
    }
}

impl NoiseOptions {
    /// The noise within the bounds of an estimate; the least for what is no number.
    pub fn clamp(&self, noise: f64) -> f64 {
        noise.max(self.bounds.0).min(self.bounds.1)
    }
}

/// Cameras, and every track of the block judged by them.
#[derive(Debug, Clone)]
pub struct Consensus {
    pub cameras: Vec<Camera>,
    /// Triangulated point of every track.
    pub points: Vec<Point>,
    /// Sum of squared reprojection residuals of every track, normalised units.
    pub squared: Vec<f64>,
    pub inlier: Vec<bool>,
    /// Noise that the gate assumes: one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Truncated cost as a share of the cost of calling every track an outlier, 0 to 1.
    pub score: f64,
}

impl Consensus {
    /// The inlier tracks, increasing.
    pub fn inliers(&self) -> Vec<usize> {
        (0..self.inlier.len()).filter(|&track| self.inlier[track]).collect()
    }

    pub fn inlier_count(&self) -> usize {
        self.inlier.iter().filter(|&&inlier| inlier).count()
    }
}

/// Constraints that `tracks` complete tracks in `views` views leave to a projective reconstruction.
pub fn constraint_count(views: usize, tracks: usize) -> f64 {
    (2 * views * tracks) as f64 - (11 * views + 3 * tracks) as f64 + 15.0
}

/// Squared-residual gate of a complete track in units of the variance.
pub fn gate(views: usize) -> f64 {
    chi_square_gate((2 * views) as f64 - 3.0)
}

/// Judges every track of a block by cameras.
///
/// Once `stop` fires the remaining tracks are outliers: nobody will look at the result.
pub fn judge(block: &CompleteBlock, cameras: Vec<Camera>, noise: f64, stop: &StopToken) -> Consensus {
    let gate = gate(block.views()) * noise * noise;
    let mut points = Vec::with_capacity(block.tracks());
    let mut squared = Vec::with_capacity(block.tracks());
    for first in (0..block.tracks()).step_by(LANES) {
        if stop.is_stopped() {
            points.resize(block.tracks(), Point::new(0.0, 0.0, 0.0, 1.0));
            squared.resize(block.tracks(), f64::MAX);
            break;
        }
        let tracks: Vec<_> = (first..block.tracks().min(first + LANES)).map(|track| block.track(track)).collect();
        let batch = Batch::new(&cameras, &tracks);
        let start = batch.linear();
        let found = batch.refine(start, |track| start.cost(track) < OPTIONS.hopeless_gates * gate, OPTIONS.point_steps);
        points.extend((0..batch.tracks()).map(|track| found.point(track)));
        let finite = |cost: f64| if cost.is_finite() { cost } else { f64::MAX };
        squared.extend((0..batch.tracks()).map(|track| finite(found.cost(track))));
    }
    let inlier: Vec<bool> = squared.iter().map(|&cost| cost < gate).collect();
    let score = squared.iter().map(|&cost| (cost / gate).min(1.0)).sum::<f64>() / block.tracks().max(1) as f64;
    Consensus { cameras, points, squared, inlier, noise, score }
}

/// The observations of some tracks; point `k` is `support[k]`.
pub fn observations_of(block: &CompleteBlock, support: &[usize]) -> Vec<Observation> {
    support
        .iter()
        .enumerate()
        .flat_map(|(point, &track)| block.track(track).iter().map(move |seen| Observation { point, ..*seen }))
        .collect()
}
