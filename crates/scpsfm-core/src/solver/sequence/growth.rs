//! Views added to a reconstruction one after the other, and the tracks that hold it: the same whether it is projective
//! or metric.

use std::cmp::Reverse;

use super::options::GrowthOptions;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

/// A reconstruction under way.
pub trait Growth {
    /// Views that it has.
    fn registered(&self) -> usize;

    /// Whether a view may be added.
    fn is_open(&self, view: usize) -> bool;

    /// The observations of a view whose points may support its registration.
    fn supporting(&self, view: usize) -> Vec<usize>;

    /// Registers a view by some of these if enough of them agree; how many do.
    fn register(&mut self, view: usize, seen: &[usize], recorder: &mut Recorder) -> usize;

    /// Adjusts everything and triangulates it anew.
    fn settle(&mut self, recorder: &mut Recorder);
}

/// What came of the trials of a view.
#[derive(Debug, Clone, Copy, Default)]
pub struct Trial {
    pub count: usize,
    /// Points that it saw at the last, how many of them were asked, and how many agreed.
    seen: usize,
    pub points: usize,
    pub agreeing: usize,
}

/// Adds every view that can be registered, those that see most of the points first.
///
/// * `trials`: one a view
pub fn grow(
    problem: &Problem,
    growth: &mut impl Growth,
    options: &GrowthOptions,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let mut settled_at = growth.registered();
    loop {
        problem.stopped()?;
        let registered = growth.registered();
        let is_due = registered > settled_at && registered as f64 >= options.adjust_growth * settled_at as f64;
        let is_paused = is_due || registered >= options.most_views;
        let Some((view, seen)) = (!is_paused).then(|| next(growth, options, trials)).flatten() else {
            if registered == settled_at {
                return Ok(());
            }
            // What a last adjustment moves may let a view fit that did not.
            growth.settle(recorder);
            settled_at = registered;
            continue;
        };
        let step = seen.len().div_ceil(options.most_points).max(1);
        let asked: Vec<usize> = seen.iter().copied().step_by(step).collect();
        let agreeing = growth.register(view, &asked, recorder);
        recorder.heartbeat();
        trials[view] = Trial { count: trials[view].count + 1, seen: seen.len(), points: asked.len(), agreeing };
    }
}

/// The view to try next, the one that sees most points, with these observations; one that failed is tried again once it
/// sees more. Takes time linear in the observations of all open views.
fn next(growth: &impl Growth, options: &GrowthOptions, trials: &[Trial]) -> Option<(usize, Vec<usize>)> {
    let is_worth = |(view, seen): &(usize, Vec<usize>)| {
        let trial = &trials[*view];
        let sees_more = trial.count == 0 || seen.len() as f64 >= options.retry_growth * trial.seen as f64;
        seen.len() >= options.least_agreeing && trial.count < options.most_trials && sees_more
    };
    let open = (0..trials.len()).filter(|&view| growth.is_open(view)).map(|view| (view, growth.supporting(view)));
    // The first of equals, so that one input has one answer.
    open.filter(is_worth).min_by_key(|(view, seen)| (Reverse(seen.len()), *view))
}

/// The tracks with most support until every view has as many kept observations as wanted, or all that it has;
/// increasing.
///
/// * `kept`: one an observation
/// * `wanted`: one a view
pub fn covering(
    problem: &Problem,
    mut tracks: Vec<usize>,
    support: impl Fn(usize) -> usize,
    kept: &[bool],
    wanted: &[usize],
) -> Vec<usize> {
    tracks.sort_unstable_by_key(|&track| (Reverse(support(track)), track));
    tracks.dedup();
    let mut observed = vec![0usize; wanted.len()];
    tracks.retain(|&track| {
        let views = || problem.of_track(track).filter(|&k| kept[k]).map(|k| problem.view_of(k));
        let is_needed = views().any(|view| observed[view] < wanted[view]);
        if is_needed {
            views().for_each(|view| observed[view] += 1);
        }
        is_needed
    });
    tracks.sort_unstable();
    tracks
}
