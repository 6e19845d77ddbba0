//! Views joined to what stands, one after the other.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adjust;
use super::growth::{self, Growth, Trial};
use super::model::Model;
use super::options::{ExtensionOptions, GrowthOptions};
use super::structure;
use crate::domain::LeftOut;
use crate::geometry::bundle::metric::{Intrinsics, Pose};
use crate::geometry::observation::Correspondence;
use crate::geometry::pose;
use crate::solver::consensus::LEAST_VIEWS;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: GrowthOptions = GrowthOptions::METRIC;
const EXTENSION: ExtensionOptions = ExtensionOptions::DEFAULT;

/// A component of a model that grows.
struct Component<'a> {
    problem: &'a Problem<'a>,
    model: &'a mut Model,
    component: u32,
    options: &'a GrowthOptions,
    rng: ChaCha8Rng,
}

/// Joins to a component every view that can be, as [`join_again`], and adjusts it first.
pub fn join(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    Component::new(problem, model, component, &OPTIONS).settle(recorder);
    join_again(problem, model, component, &OPTIONS, trials, recorder)
}

/// Joins to a component every view without a pose, or of another component, that can be. Their trials count anew: views
/// that another component could not take may fit this one, and what stands now may place them better.
pub fn join_again(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    options: &GrowthOptions,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    for (view, trial) in trials.iter_mut().enumerate() {
        if model.poses[view].is_none() || model.component_of[view] != component {
            trial.count = 0;
        }
    }
    growth::grow(problem, &mut Component::new(problem, model, component, options), options, trials, recorder)
}

impl<'a> Component<'a> {
    fn new(problem: &'a Problem<'a>, model: &'a mut Model, component: u32, options: &'a GrowthOptions) -> Self {
        Self { problem, model, component, options, rng: ChaCha8Rng::seed_from_u64(problem.settings.seed) }
    }
}

/// The views that were not registered, with what came of the last trial of each.
pub fn left_out(problem: &Problem, model: &Model, trials: &[Trial]) -> Vec<(usize, LeftOut)> {
    let reason = |view: usize| LeftOut::NotRegistered {
        points: trials[view].points as u32,
        agreeing: trials[view].agreeing as u32,
    };
    let views = problem.observed_views().into_iter();
    views.filter(|&view| model.poses[view].is_none()).map(|view| (view, reason(view))).collect()
}

impl Growth for Component<'_> {
    fn registered(&self) -> usize {
        self.model.of_component(self.component).len()
    }

    /// A view of another component may move here if it sees more of this component's points than hold it there,
    /// [`GrowthOptions::moving_ratio`] times as many: a component that began with a wrong block would keep its views from
    /// the right one.
    fn is_open(&self, view: usize) -> bool {
        let Self { problem, model, component, options, .. } = self;
        let Some(_) = model.poses[view] else { return true };
        if model.component_of[view] == *component {
            return false;
        }
        let seen = self.supporting(view).len();
        seen >= options.least_agreeing && seen > options.moving_ratio * model.held_by(problem, view)
    }

    fn supporting(&self, view: usize) -> Vec<usize> {
        let supports = |k: &usize| {
            let landmark = self.model.landmarks[self.problem.track_of(*k)];
            landmark.is_some_and(|landmark| landmark.component == self.component && landmark.supports())
        };
        self.problem.of_view[view].iter().map(|&k| k as usize).filter(supports).collect()
    }

    fn register(&mut self, view: usize, seen: &[usize], recorder: &mut Recorder) -> usize {
        let Self { problem, model, component, options, rng } = self;
        let is_new_lens = model.is_focal_unknown(problem, view);
        let mut found: Option<(Intrinsics, Pose, usize)> = None;
        for intrinsics in guesses(problem, model, view) {
            let to_beat = found.as_ref().map_or(0, |(.., agreeing)| *agreeing);
            let better = robust_pose(problem, model, &intrinsics, seen, to_beat, rng);
            let better = better.filter(|(_, agreeing)| found.is_none() || *agreeing > to_beat);
            found = better.map(|(pose, agreeing)| (intrinsics, pose, agreeing)).or(found);
        }
        let Some((intrinsics, pose, agreeing)) = found else { return 0 };
        let is_enough =
            agreeing >= options.least_agreeing && agreeing as f64 >= options.least_share * seen.len() as f64;
        let is_held = model.poses[view].is_some();
        if !is_enough || (is_held && agreeing <= options.moving_ratio * model.held_by(problem, view)) {
            return agreeing;
        }
        model.set_intrinsics(problem, view, intrinsics);
        let left = model.poses[view].map(|_| model.component_of[view]);
        model.register(problem, view, *component, pose);
        let mut changed = vec![view];
        if let Some(rest) = left.map(|left| model.of_component(left)).filter(|rest| rest.len() < LEAST_VIEWS) {
            model.unregister(problem, &rest);
            changed.extend(rest);
        }
        structure::triangulate_seen(problem, model, &changed, recorder);
        adjust::around(problem, model, view, is_new_lens, recorder);
        structure::triangulate_seen(problem, model, &[view], recorder);
        let registered = model.registered();
        let focal = model.log_focal(problem.camera_of[view], &registered).exp();
        recorder.progress.focal_px = Some(focal * problem.scale_px);
        recorder.registered(registered.len());
        let share = registered.len() as f64 / problem.observed_views().len() as f64;
        recorder.report(EXTENSION.share_of_registering * share);
        agreeing
    }

    fn settle(&mut self, recorder: &mut Recorder) {
        adjust::while_growing(self.problem, self.model, self.component, recorder);
        adjust::rescale(self.problem, self.model, self.component);
        structure::triangulate_seen(self.problem, self.model, &self.model.of_component(self.component), recorder);
        recorder.progress.inliers = adjust::verified(self.model).len() as u32;
    }
}

/// Lenses to try a view with: its camera's own, or, of one that is not known yet, pinholes, behind the lens that
/// is undone, of what the input says, give or take its deviation, or of a scan. Where views have focal lengths of their
/// own, the scan is about that of the nearest view, behind the lens that they share: a zoom takes time.
fn guesses(problem: &Problem, model: &Model, view: usize) -> Vec<Intrinsics> {
    let camera = problem.camera_of[view];
    let lens = &model.lenses[camera];
    if !model.is_focal_unknown(problem, view) {
        return vec![lens.intrinsics];
    }
    let behind_undone = |focal: f64| {
        let pinhole = Intrinsics::from_focal(focal);
        problem.undone.as_ref().map_or(pinhole, |undone| undone.behind(camera, &pinhole))
    };
    if let Some(prior) = problem.input.views()[view].focal_prior.filter(|_| !problem.has_own_focals()) {
        let focal = prior.focal_px / problem.scale_px;
        return [0.0, -1.0, 1.0].map(|by| behind_undone(focal * (by * prior.sigma_log).exp())).to_vec();
    }
    let others = model.determined().into_iter().filter(|other| *other != view);
    let nearest = others.min_by_key(|other| other.abs_diff(view));
    let nearest = nearest.filter(|_| problem.has_own_focals());
    let about = nearest.map_or(lens.intrinsics, |nearest| model.intrinsics_of(problem, nearest));
    let focal = |step: i32| about.focal * (f64::from(step) / EXTENSION.focals_per_octave).exp2();
    // Of equals the first counts: from the middle outwards.
    let mut steps: Vec<i32> = EXTENSION.other_focals.collect();
    steps.sort_by_key(|step| (step.abs(), *step));
    let guess = |step: i32| match nearest {
        Some(_) => Intrinsics { focal: focal(step), ..about },
        None => behind_undone(focal(step)),
    };
    steps.into_iter().map(guess).collect()
}

/// The pose that most of these observations agree with, and how many do.
///
/// * `inliers_to_beat`: as of [`pose::robust`]
fn robust_pose(
    problem: &Problem,
    model: &Model,
    intrinsics: &Intrinsics,
    seen: &[usize],
    inliers_to_beat: usize,
    rng: &mut ChaCha8Rng,
) -> Option<(Pose, usize)> {
    let datum = |&k: &usize| {
        let undone = intrinsics.undistorted(&problem.observation(k))?;
        let xy = intrinsics.pinhole().ray(&undone.xy)?;
        let point = model.landmarks[problem.track_of(k)]?.position;
        Some(Correspondence { point, xy, weight: undone.weight })
    };
    let seen: Vec<_> = seen.iter().filter_map(datum).collect();
    let gate = problem.gate(model.noise) / intrinsics.focal.powi(2);
    let found = pose::robust(&seen, gate, model.has_common_centre, inliers_to_beat, rng, problem.stop)?;
    Some((found.model, found.inlier_count()))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Rotation3, Vector3};

    use super::*;
    use crate::domain::{Input, Limits, Silent, SolveSettings, StopToken};
    use crate::parallel::Threads;
    use crate::solver::sequence::model::FIRST;
    use crate::synthetic::{Sequence, SequenceOptions};

    /// Views that a wrong component holds by a few points go to the one that most of their points are of; views of a
    /// component that is right stay.
    #[test]
    fn views_go_to_the_component_that_more_of_their_points_hold_them_in() {
        for seed in 0..5 {
            let options = SequenceOptions { views: 14, tracks: 600, seed, ..SequenceOptions::default() };
            let Sequence { input, truth, .. } = Sequence::generate(&options).expect("valid options");
            let input = Input::new(input, &Limits::default(), "sequence").expect("a valid sequence");
            let (settings, stop) = (SolveSettings::default(), StopToken::default());
            let problem = Problem::new(&input, &settings, Threads::ONE, &stop);
            let intrinsics = Intrinsics::from_focal(truth.focal_px / problem.scale_px);
            let pose = |view: usize, turn: f64| {
                let rotation = Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
                let turn = Rotation3::from_scaled_axis(Vector3::new(0.0, turn, 0.5 * turn)).into_inner();
                Pose { rotation: turn * rotation, translation: turn * Vector3::from(truth.translations[view]) }
            };
            let mut silent = Silent;
            let mut recorder = Recorder::new(&mut silent, options.views);
            // Those of the wrong component are turned about in turns, so that they contradict each other.
            let mut components_after = |is_wrong: &dyn Fn(usize) -> bool, is_other: &dyn Fn(usize) -> bool| {
                let mut model = Model::new(&problem, intrinsics, options.noise);
                for view in 0..options.views {
                    let turn = if is_wrong(view) { 0.01 * [1.0, -1.0][view % 2] } else { 0.0 };
                    model.register(&problem, view, FIRST + u32::from(is_other(view)), pose(view, turn));
                }
                structure::triangulate(&problem, &mut model, &mut recorder);
                let mut trials = vec![Trial::default(); options.views];
                join(&problem, &mut model, FIRST, &mut trials, &mut recorder).expect("not stopped");
                [FIRST, FIRST + 1].map(|component| model.of_component(component).len())
            };
            let is_late = |view: usize| view >= 10;
            assert_eq!(components_after(&is_late, &is_late), [14, 0], "seed {seed}: the other one is wrong");
            let is_early = |view: usize| view < 4;
            assert_eq!(components_after(&is_early, &|view| view >= 4), [4, 10], "seed {seed}: it is wrong itself");
        }
    }
}
