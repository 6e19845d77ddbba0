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
use crate::geometry::pose::{self, Correspondences};
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

/// Joins to a component every view that can be.
///
/// # Errors
/// [`Error::Stopped`].
pub fn join(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    // Views that another component could not take may fit this one.
    trials.iter_mut().for_each(|trial| trial.count = 0);
    let mut growth = Component::new(problem, model, component, &OPTIONS);
    growth.settle(recorder);
    growth::grow(problem, &mut growth, &OPTIONS, trials, recorder)
}

/// Tries these views again, as [`join`] does: what stands now may place them better.
///
/// * `views`: their trials count anew
///
/// # Errors
/// [`Error::Stopped`].
pub fn join_again(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    options: &GrowthOptions,
    views: &[usize],
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    views.iter().for_each(|&view| trials[view].count = 0);
    growth::grow(problem, &mut Component::new(problem, model, component, options), options, trials, recorder)
}

impl<'a> Component<'a> {
    fn new(problem: &'a Problem<'a>, model: &'a mut Model, component: u32, options: &'a GrowthOptions) -> Self {
        model.turn_to(problem, component);
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

    fn is_open(&self, view: usize) -> bool {
        self.model.poses[view].is_none()
    }

    fn support(&self, view: usize) -> usize {
        self.model.supported[view]
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
        let found = guesses(problem, model, view)
            .into_iter()
            .filter_map(|intrinsics| Some((intrinsics, robust_pose(problem, model, &intrinsics, seen, rng)?)))
            // The first of equals.
            .rev()
            .max_by_key(|(_, (_, agreeing))| *agreeing);
        let Some((intrinsics, (pose, agreeing))) = found else { return 0 };
        if agreeing < options.least_agreeing || (agreeing as f64) < options.least_share * seen.len() as f64 {
            return agreeing;
        }
        model.set_intrinsics(problem, view, intrinsics);
        model.register(problem, view, *component, pose);
        structure::triangulate_seen(problem, model, &[view], recorder);
        adjust::around(problem, model, view, is_new_lens, recorder);
        structure::triangulate_seen(problem, model, &[view], recorder);
        let registered = model.registered();
        let focal = model.log_focal(problem.camera_of[view], &registered).exp();
        recorder.hypothesis.focal_px = Some(focal * problem.scale_px);
        recorder.registered(registered.len());
        let share = registered.len() as f64 / problem.observed_views().len() as f64;
        recorder.report(EXTENSION.share_of_registering * share);
        agreeing
    }

    fn settle(&mut self, recorder: &mut Recorder) {
        adjust::while_growing(self.problem, self.model, self.component, recorder);
        adjust::rescale(self.problem, self.model, self.component);
        structure::triangulate_seen(self.problem, self.model, &self.model.of_component(self.component), recorder);
        recorder.hypothesis.inliers = adjust::verified(self.model).len() as u32;
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
    let nearest = model.determined().into_iter().min_by_key(|other| other.abs_diff(view));
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
fn robust_pose(
    problem: &Problem,
    model: &Model,
    intrinsics: &Intrinsics,
    seen: &[usize],
    rng: &mut ChaCha8Rng,
) -> Option<(Pose, usize)> {
    let datum = |&k: &usize| {
        let undone = intrinsics.undistorted(&problem.observation(k))?;
        let ray = intrinsics.pinhole().ray(&undone.xy)?;
        Some((model.landmarks[problem.track_of(k)]?.position, (ray, undone.weight)))
    };
    let (points, seen): (Vec<_>, Vec<_>) = seen.iter().filter_map(datum).unzip();
    let (rays, weights): (Vec<_>, Vec<_>) = seen.into_iter().unzip();
    let gate = problem.gate(model.noise) / intrinsics.focal.powi(2);
    let robust = if model.has_common_centre { pose::robust_rotation } else { pose::robust };
    let found = robust(&Correspondences { points: &points, seen: &rays, weights: &weights }, gate, rng, problem.stop)?;
    Some((found.model, found.inlier_count()))
}
