//! What depths say beyond image points: seeds, a consensus of few tracks, the last word on tracks in strong noise.
//!
//! Four complete tracks leave ten projective cameras undetermined; with depths and one focal length they leave fifty
//! constraints over. What stands on fewer tracks than image points can verify is never graded METRIC.

use super::all_tracks::AllTracksOptions;
use super::block::Block;
use super::calibration::{Outcome, few_inliers};
use super::classification::{ClassificationOptions, Geometry, Judged};
use super::consensus::{Consensus, NoiseOptions};
use super::problem::Problem;
use super::search::Seed;
use super::search::rigid::{Rigid, RigidSearch};
use super::spread;
use crate::domain::{Grade, Warning, WarningCode};
use crate::geometry::bundle::metric::{
    Information, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Parameter, Pose,
};
use crate::geometry::bundle::sequence;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::or_zeros;
use crate::geometry::triangulation;

/// Directions that no observation sees: a similarity's.
const SIMILARITY: usize = 7;

options! {
    /// When depths have a say.
    pub struct DepthOptions {
        /// Constraints beyond the unknowns from which a focal length is looked for. Its variance is then known to 45 %.
        least_freedom: usize = 10,
        /// Distance in log focal between what depths and what image points say from which they contradict each other:
        /// by itself, and in standard deviations of the latter. Depths alone are off by some per cent in strong noise.
        most_strayed: f64 = 0.1,
        strayed_sigmas: f64 = 4.0,
        /// Noise from which depths judge what image points have verified, normalised units. Below, image points alone
        /// lose next to no track (mean F1 1.000 at 1 %, .997 at 2 %: `scpsfm evaluate --sweeps noise --depths none`),
        /// and the time is saved. From it on, what depths verify is not replaced by image points alone: with 8 right
        /// tracks of 200, F1 rises from .85 to .99 at 3 % and from .84 to .97 at 5 % (20 scenes each).
        strong_noise: f64 = 0.015,
        /// Share of the consensus's inliers that must be rigid for depths to judge. Of depths that are not true to one
        /// scale next to none are.
        rigid_share: f64 = 0.8,
        /// Tracks that are weighed at most. A fit of more takes seconds.
        most_weighed: usize = AllTracksOptions::DEFAULT.most_tracks,
    }
}

const OPTIONS: DepthOptions = DepthOptions::DEFAULT;

/// The seed that a rigid consensus gives to growing without depths.
pub fn seed(rigid: &Rigid) -> Seed {
    let support: Vec<usize> = (0..rigid.inlier.len()).filter(|&track| rigid.inlier[track]).collect();
    let points = rigid.homogeneous_points();
    Seed { cameras: rigid.cameras(), points: support.iter().map(|&track| points[track]).collect(), support }
}

/// A rigid consensus as the rest of the solver knows one: inliers by image points and depths, residuals by image
/// points.
///
/// * `noise`: that it was found at
pub fn consensus(block: &CompleteBlock, rigid: &Rigid, noise: f64) -> Consensus {
    let cameras = rigid.cameras();
    let points = rigid.homogeneous_points();
    let squared = (0..block.tracks())
        .map(|track| triangulation::squared_residual(&cameras, &points[track], block.track(track)))
        .map(|cost| if cost.is_finite() { cost } else { f64::MAX })
        .collect();
    Consensus {
        cameras,
        points,
        squared,
        inlier: rigid.inlier.clone(),
        noise: NoiseOptions::DEFAULT.clamp(rigid.noise().unwrap_or(noise)),
        score: rigid.cost / block.tracks().max(1) as f64,
    }
}

/// Calibrates such a consensus by metric bundle adjustment of its image points from where it stands: the search over
/// projective reconstructions has nothing to start from.
///
/// * `focal`: that of the consensus's cameras, `K [R|t]`
pub fn calibrate(problem: &Problem, block: &CompleteBlock, consensus: &Consensus, focal: f64) -> Outcome {
    let inliers = consensus.inliers();
    let mut outcome = Outcome::refused(Vec::new());
    let fit = &problem.calibration_options.fit;
    if inliers.len() < fit.least_inliers {
        outcome.warnings.push(few_inliers(inliers.len(), fit));
    }
    let refused = |mut outcome: Outcome, code: WarningCode, detail: String| {
        outcome.warnings.push(Warning::new(code, detail));
        outcome
    };
    let observations: Vec<Observation> = super::consensus::observations_of(block, &inliers);
    let model = IntrinsicsModel::FOCAL;
    let unknowns = 6 * block.views() + 3 * inliers.len() + model.parameters().len() - SIMILARITY;
    let freedom = (2 * observations.len()).saturating_sub(unknowns);
    if freedom < OPTIONS.least_freedom {
        let detail = format!("{} tracks leave {freedom} constraints for a focal length, too few", inliers.len());
        return refused(outcome, WarningCode::UnobservableFocal, detail);
    }
    let Some(mut found) = start(consensus, &inliers, focal) else { return outcome };
    let options = problem.calibration_options.search.to_convergence();
    let report =
        sequence::adjust_all(&mut found, &observations, model, &[IntrinsicsPrior::NONE], &options, problem.stop);
    let noise = consensus.noise.max((report.cost / freedom as f64).sqrt());
    let sigma = Information::new(&found, &observations)
        .and_then(|information| {
            information.optimum(model, &[IntrinsicsPrior::NONE]).variance_of(0, Parameter::LogFocal)
        })
        .map(|variance| variance.sqrt() * noise)
        .filter(|sigma| sigma.is_finite());
    let cheirality = crate::geometry::metric::cheirality(&found, &observations);
    // Image points and depths tell one story, or there is none.
    let strayed = (found.intrinsics[0].focal / focal).ln().abs();
    if strayed.is_nan() || strayed > OPTIONS.most_strayed.max(OPTIONS.strayed_sigmas * sigma.unwrap_or(0.0)) {
        let detail = format!("image points alone give a focal length that differs by a factor of {:.2}", strayed.exp());
        return refused(outcome, WarningCode::ModelMismatch, detail);
    }
    if cheirality < problem.calibration_options.grades.least_in_front {
        let detail = format!("{:.1} % of the observations lie behind their cameras", 100.0 * (1.0 - cheirality));
        return refused(outcome, WarningCode::Cheirality, detail);
    }
    outcome.grade = problem.calibration_options.grades.grade(sigma).worse(Grade::Weak);
    outcome.sigma_log_focal = sigma;
    outcome.metric = Some(found);
    outcome
}

/// The consensus as a metric reconstruction of its inliers.
fn start(consensus: &Consensus, inliers: &[usize], focal: f64) -> Option<MetricReconstruction> {
    let intrinsics = Intrinsics::from_focal(focal);
    let uncalibrate = intrinsics.matrix().try_inverse()?;
    let poses = consensus
        .cameras
        .iter()
        .map(|camera| {
            let pose = uncalibrate * camera;
            Pose { rotation: pose.fixed_columns::<3>(0).into_owned(), translation: pose.column(3).into_owned() }
        })
        .collect();
    let points = inliers.iter().map(|&track| consensus.points[track].xyz()).collect();
    Some(MetricReconstruction::new(intrinsics, poses, points))
}

/// Probability of tracks to be right by image points and depths together.
pub struct TrackWeights {
    /// Tracks of the input, increasing.
    tracks: Vec<usize>,
    /// One a track of these.
    weights: Vec<f64>,
}

/// Weighs the complete tracks over the views of a block, under the rigid consensus refitted to all of them; `None`
/// where that does not hold for the consensus.
///
/// At a noise of a tenth of the image the image points alone lose right tracks; a third coordinate and fewer unknowns
/// keep them.
pub fn weights(
    problem: &Problem,
    searched: &Block,
    consensus: &Consensus,
    found: Option<&Rigid>,
) -> Option<TrackWeights> {
    let all = problem.block(&searched.views).sample_with(OPTIONS.most_weighed, problem.settings.seed, &searched.tracks);
    let block = &all.complete;
    let search = RigidSearch::new(block, spread::spread(block), problem.stop)?;
    let place = |track: usize| all.tracks.binary_search(&searched.tracks[track]).ok();
    let inliers: Vec<usize> = consensus.inliers().into_iter().filter_map(place).collect();
    let rigid = search.refit(found?, &inliers)?;
    let shared = inliers.iter().filter(|&&track| rigid.inlier[track]).count();
    if (shared as f64) < OPTIONS.rigid_share * inliers.len() as f64 {
        return None;
    }
    let noise = NoiseOptions::DEFAULT.clamp(rigid.noise()?);
    let freedom = (3 * block.views()) as f64 - 3.0;
    // A uniform distribution of that standard deviation is sqrt(12) times as wide.
    let ln_wrong = -freedom * (12f64.sqrt() * search.spread()).ln();
    let ln_core = -0.5 * freedom * (std::f64::consts::TAU * noise * noise).ln();
    let share = (rigid.inlier_count() as f64 + 1.0) / (block.tracks() as f64 + 2.0);
    let prior = (share / (1.0 - share)).ln();
    let weight = |squared: &f64| {
        let ln_odds = prior + ln_core - 0.5 * squared / (noise * noise) - ln_wrong;
        1.0 / (1.0 + (-ln_odds).exp())
    };
    let weights = rigid.squared.iter().map(weight).collect();
    Some(TrackWeights { tracks: all.tracks, weights })
}

impl TrackWeights {
    /// Puts these in place of what image points alone say of the tracks.
    pub fn judge(&self, problem: &Problem, geometry: &Geometry, judged: &mut Judged) {
        let cameras = or_zeros(&geometry.cameras);
        for (&track, &weight) in self.tracks.iter().zip(&self.weights) {
            judged.tracks.weight[track] = weight as f32;
            let inlier = weight > 0.5;
            if inlier == judged.tracks.inlier[track] || problem.stop.is_stopped() {
                continue;
            }
            judged.tracks.inlier[track] = inlier;
            let registered = geometry.of_track(problem, track).into_iter();
            let seen: Vec<(usize, Observation)> = registered.map(|k| (k, geometry.observation(problem, k))).collect();
            let observations: Vec<Observation> = seen.iter().map(|(_, observation)| *observation).collect();
            let start = triangulation::linear(&cameras, &observations);
            let point =
                triangulation::refine(&cameras, &observations, start, ClassificationOptions::DEFAULT.point_steps).0;
            for (k, observation) in seen {
                let place = problem.input.caller_index(k);
                let residual = triangulation::reprojection(&cameras[observation.view], &point, &observation.xy).norm();
                judged.observations.inlier[place] = inlier;
                judged.observations.weight[place] = judged.noise.weight(residual * residual) as f32;
                judged.observations.residual_px[place] =
                    Some(residual * problem.scale_px).filter(|residual| residual.is_finite());
            }
            judged.points[track] = inlier.then_some(point);
            judged.retained[track] = if inlier { observations } else { Vec::new() };
        }
    }
}
