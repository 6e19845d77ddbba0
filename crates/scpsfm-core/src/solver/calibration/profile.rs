//! The profile of the cost along the focal length: how it rises, and how tracks pull on it.

use nalgebra::Vector2;

use super::Uncalibrated;
use super::models::Candidate;
use crate::geometry::bundle::Options;
use crate::geometry::bundle::metric::{IntrinsicsModel, IntrinsicsPrior, MetricReconstruction};
use crate::geometry::bundle::sequence;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::chi_square_quantile;

/// Factors on the standard deviation of the log focal length that a linearisation gives for independent noise.
#[derive(Debug, Clone, Copy)]
pub(super) struct Profile {
    /// By how much the cost rises less than the linearisation has it; not below 1.
    pub widening: f64,
    /// Root of the squared influences of whole tracks over what they would be if the noise of the observations of a
    /// track were independent; 1 where chance explains it.
    pub correlation: f64,
}

impl Uncalibrated<'_> {
    /// Holds the focal length, of several groups all in their ratios, three standard deviations away to either side,
    /// while everything else adjusts.
    ///
    /// The chi-square should rise by nine. Near critical motions the linearisation is optimistic: it is taken where the
    /// noise has moved the scene.
    pub(super) fn profile(&self, best: &Candidate) -> Profile {
        let none = Profile { widening: 1.0, correlation: 1.0 };
        let Some(sigma) = best.sigma_log_focal() else { return none };
        let options = &self.options.models;
        let shift = (options.profile_deviations * sigma).min(options.profile_longest);
        if shift <= 0.0 {
            return none;
        }
        let (above, rise_above) = self.held(best, shift);
        let (below, rise_below) = self.held(best, -shift);
        let by_rise = shift / rise_above.min(rise_below).sqrt().max(f64::MIN_POSITIVE);
        let along = |seen: &_| (above.residual(seen) - below.residual(seen)) / (2.0 * shift);
        Profile { widening: (by_rise / sigma).max(1.0), correlation: self.correlation(best, along) }
    }

    /// The best reconstruction with its log focal length held at this distance, and the rise in chi-square.
    fn held(&self, best: &Candidate, shift: f64) -> (MetricReconstruction, f64) {
        let mut moved = best.minimum.reconstruction.clone();
        moved.scale_focals(shift.exp());
        let options = Options::squared(self.options.models.profile_iterations);
        let (observations, model) = (self.observations, best.model.without_focal());
        let report = sequence::adjust_all(&mut moved, observations, model, &best.priors, &options, self.stop);
        let of_priors = IntrinsicsPrior::cost_of(&best.priors, IntrinsicsModel::FOCAL, &moved.intrinsics);
        let rise = (report.cost + of_priors - best.minimum.cost).max(0.0) / best.fit.noise.powi(2);
        (moved, rise)
    }

    /// As [`Profile::correlation`]; 1 of several focal lengths, along whose common profile their ratios do not follow.
    ///
    /// The variance of an estimate from clusters whose noise is independent of each other (Liang & Zeger 1986): what
    /// moves along a track, as an optical flow that drifts or a lens that no model here has, moves the focal length
    /// with all its observations at once. Along the profile the points follow, so that their residuals are without
    /// effect; what the cameras take up of the noise is counted by degrees of freedom. Scores are taken where the
    /// observations alone have their minimum, to first order: a prior pulls at all of them.
    ///
    /// * `along`: derivative of an observation's residual by the log focal length, everything else following
    fn correlation(&self, best: &Candidate, along: impl Fn(&Observation) -> Vector2<f64>) -> f64 {
        let reconstruction = &best.minimum.reconstruction;
        if reconstruction.has_own_focals() || self.groups() > 1 {
            return 1.0;
        }
        // Score and information of each track.
        let mut of_track = vec![(0.0, 0.0); reconstruction.points.len()];
        for seen in self.observations {
            let (along, (score, information)) = (along(seen), &mut of_track[seen.point]);
            *score += seen.weight * along.dot(&reconstruction.residual(seen));
            *information += seen.weight * along.norm_squared();
        }
        let sum = |of: &dyn Fn(&(f64, f64)) -> f64| of_track.iter().map(of).sum::<f64>();
        let information = sum(&|(_, information)| *information);
        let pull = sum(&|(score, _)| *score) / information;
        let squared_scores = sum(&|(score, information)| (score - pull * information).powi(2));
        let (_, of_point) = MetricReconstruction::unknowns_each(reconstruction.has_common_centre);
        let of_points = of_point * self.observed_points();
        let without_points = (2 * self.observations.len()).saturating_sub(of_points);
        let expected = best.fit.noise.powi(2) * information * best.fit.freedom as f64 / without_points as f64;
        // So many tracks of equal information vary as much (Satterthwaite 1946).
        let tracks = information.powi(2) / sum(&|(_, information)| information.powi(2));
        let ratio = squared_scores / expected;
        let by_chance = chi_square_quantile(tracks, self.options.models.significance) / tracks;
        // Neither holds of what is no number: points may end at depth zero.
        if ratio.is_finite() && ratio > by_chance { ratio.sqrt() } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector4;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::geometry::bundle::testing::{self, TestScene, normal};
    use crate::solver::calibration::options::CalibrationOptions;
    use crate::solver::calibration::tests::of_one_lens;

    const NOISE: f64 = 0.001;

    /// A scene in which every track lives five views: what is far apart is held together by many weak links.
    fn banded(seed: u64, views: usize) -> TestScene {
        let mut scene = testing::scene(seed, views, 10 * views, NOISE);
        let first = |point: usize| point % (views - 4);
        scene.observations.retain(|seen| (first(seen.point)..first(seen.point) + 5).contains(&seen.view));
        scene
    }

    /// The focal length held, everything else follows to the bottom of the valley, however long that takes.
    #[test]
    fn the_profile_is_taken_where_all_else_has_followed() {
        let turning = [0.1, 0.02].into_iter().flat_map(|turning| {
            (0..3).map(move |seed| {
                (format!("turning {turning}, seed {seed}"), testing::scene_turning(seed, 40, NOISE, turning))
            })
        });
        let banded = [10, 20, 40]
            .into_iter()
            .flat_map(|views| (0..3).map(move |seed| (format!("{views} views, seed {seed}"), banded(seed, views))));
        let options = CalibrationOptions::DEFAULT.models;
        let mut longest = 0;
        for (case, scene) in turning.chain(banded) {
            let points: Vec<Vector4<f64>> = scene.points.iter().map(|point| point.push(1.0)).collect();
            let cameras = scene.cameras();
            let problem = of_one_lens(&cameras, &points, &scene.observations, NOISE);
            let priors = problem.priors(NOISE);
            let reconstruction = scene.reconstruction();
            for model in [IntrinsicsModel::FOCAL, IntrinsicsModel::FULL] {
                let minimum = problem.search(&priors).converged(reconstruction.clone(), model);
                let best = Candidate::new(minimum, model, priors.clone(), &problem);
                let sigma = best.sigma_log_focal().expect("observable");
                let profiled = sigma * problem.profile(&best).widening;
                let shift = (options.profile_deviations * sigma).min(options.profile_longest);
                let mut rise = |shift: f64| {
                    let mut moved = best.minimum.reconstruction.clone();
                    moved.scale_focals(shift.exp());
                    let options = Options { max_iterations: 5000, relative_tolerance: 1e-13, ..Options::DEFAULT };
                    let model = model.without_focal();
                    let (observations, stop) = (problem.observations, problem.stop);
                    let report = sequence::adjust_all(&mut moved, observations, model, &priors, &options, stop);
                    longest = longest.max(report.iterations);
                    (report.cost - best.minimum.cost) / best.fit.noise.powi(2)
                };
                let expected = sigma.max(shift / rise(shift).min(rise(-shift)).sqrt());
                println!("{case}, {}: sigma {sigma:.5}, profiled {profiled:.5} for {expected:.5}", model.name());
                assert!((profiled / expected - 1.0).abs() < 0.01, "{case}: {profiled} for {expected}");
            }
        }
        println!("{longest} iterations at most");
        assert!(longest < options.profile_iterations, "{longest} iterations");
    }

    /// Noise of whole tracks in the direction in which they pull at the focal length, `step` times that of the
    /// observations, widens sigma by the root of `1 + step²`; independent noise does not.
    #[test]
    fn what_moves_along_tracks_widens_sigma() {
        let seeds = 40;
        let model = IntrinsicsModel::FOCAL;
        for step in [0.0f64, 2.0] {
            let (mut raised, mut before, mut after) = (0, 0.0, 0.0);
            for seed in 0..seeds {
                let mut scene = testing::scene(seed, 10, 60, NOISE);
                let points: Vec<Vector4<f64>> = scene.points.iter().map(|point| point.push(1.0)).collect();
                let (cameras, observations) = (scene.cameras(), scene.observations.clone());
                let problem = of_one_lens(&cameras, &points, &observations, NOISE);
                let priors = problem.priors(NOISE);
                let truth = scene.reconstruction();
                let best_of = |problem: &Uncalibrated| {
                    let minimum = problem.search(&priors).converged(truth.clone(), model);
                    Candidate::new(minimum, model, priors.clone(), problem)
                };
                let independent = best_of(&problem);
                let [(above, _), (below, _)] = [0.01, -0.01].map(|shift| problem.held(&independent, shift));
                let along: Vec<Vector2<f64>> =
                    observations.iter().map(|seen| above.residual(seen) - below.residual(seen)).collect();
                let mut squared = vec![0.0; points.len()];
                observations.iter().zip(&along).for_each(|(seen, along)| squared[seen.point] += along.norm_squared());
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let pulls: Vec<f64> =
                    squared.iter().map(|squared| step * NOISE * normal(&mut rng) / squared.sqrt()).collect();
                scene
                    .observations
                    .iter_mut()
                    .zip(&along)
                    .for_each(|(seen, along)| seen.xy += pulls[seen.point] * along);
                let problem = of_one_lens(&cameras, &points, &scene.observations, NOISE);
                let best = best_of(&problem);
                let correlation = problem.profile(&best).correlation;
                let error = best.minimum.log_focal() - scene.intrinsics.focal.ln();
                let squared = (error / best.sigma_log_focal().expect("observable")).powi(2) / seeds as f64;
                (before, after) = (before + squared, after + squared / correlation.powi(2));
                raised += usize::from(correlation > 1.0);
            }
            let expected = 1.0 + step * step;
            println!("step {step}: raised in {raised}, mean squared deviation {before:.2}, then {after:.2}");
            // A mean of 40 squares is known to a fifth, and so is the influence of 60 tracks of unequal weight, by which
            // the squares are divided.
            assert!((before / expected - 1.0).abs() < 0.6, "step {step}: {before} for {expected}");
            assert!((0.5..2.0).contains(&after), "step {step}: {after} for 1");
            assert!(if step == 0.0 { raised <= 1 } else { raised >= 36 }, "step {step}: raised in {raised} of {seeds}");
        }
    }
}
