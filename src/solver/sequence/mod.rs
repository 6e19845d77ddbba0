//! From blocks of complete tracks to a reconstruction of all views.
//!
//! Tracks of real sequences live a few views, and a right track may hold wrong observations: no block of complete
//! tracks holds them all. A block that was searched is the seed. Where it is calibrated, view after view is resected
//! against the points that stand ([`register`]), its tracks are triangulated ([`structure`]), and bundle adjustment
//! with the calibration free keeps the whole straight ([`adjust`]); where it is not, the same is done without a
//! calibration ([`projective`]), and the whole is calibrated then. Views that share no tracks with it become [`parts`]
//! of their own under the same calibration. What the whole says of the calibration is graded anew ([`calibrate`]) and
//! checked between its [`windows`], and every track and observation is judged by it ([`assemble`]).

mod adjust;
mod assemble;
mod calibrate;
mod model;
mod options;
mod own_focals;
mod parts;
mod projective;
mod register;
mod structure;
mod windows;

pub use assemble::solved;
pub use projective::Projective;

use super::attempt::{self, Attempt};
use super::calibration::Outcome;
use super::grow::LEAST_INLIERS;
use super::recorder::Recorder;
use super::{Context, Error, assemble as of_attempt, block};
use crate::domain::{Grade, Method, Stage, Task, Warning, WarningCode};
use model::{Model, Scene};
use options::ProjectiveOptions;

/// Rounds of adjusting everything and triangulating it anew that end an extension; the third moves nothing that a
/// gate would see.
const FINAL_ROUNDS: usize = 3;
/// Share of an extension's time before its calibration that registering takes, the rounds the rest: .71 and .67 as
/// measured on 1,000 views with 350 and 87 observations a view.
pub const SHARE_OF_REGISTERING: f64 = 0.7;
/// Share of the views that an extension must register for no other seed to be tried: one that carries most of them is a
/// part of whatever another would lead to.
const ENOUGH_REGISTERED: f64 = 0.5;

/// Growth of the retained observations, once each is judged by itself, from which a whole input is extended: with a
/// tenth more of them sigma falls by a twentieth.
const WORTH_EXTENDING: f64 = 1.1;

/// Subsets that are tried before the whole is searched at length.
const FIRST_SUBSETS: usize = 3;

/// A sequence that stands, with the block that it grew from.
pub struct Extended<'a> {
    seed: Attempt,
    scene: Scene<'a>,
    model: Model,
    /// One a camera of the scene.
    calibrations: Vec<Outcome>,
    /// Views that could not be registered, with the reason.
    unregistered: Vec<register::Unregistered>,
}

/// What came of a sequence.
pub enum Ended<'a> {
    Extended(Box<Extended<'a>>),
    /// Nothing stands beyond a block, if that: the best one that was tried.
    Block(Option<Box<Attempt>>),
}

/// Whether an input is one that is extended beyond a block.
pub fn applies(context: &Context) -> bool {
    matches!(context.settings.method, Method::Auto | Method::Geometry) && !context.input.has_depths()
}

/// Solves and extends block after block until one carries a reconstruction of most of the views.
///
/// In order of cost: the `whole` input as one block, where its tracks are complete; blocks that are calibrated and
/// extended metrically; blocks and small subsets of them that are extended projectively and calibrated then; at last
/// the whole again, with everything that a search can try.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn solve<'a>(
    whole: Option<Vec<usize>>,
    candidates: &[Vec<usize>],
    context: &Context<'a>,
    recorder: &mut Recorder,
) -> Result<Ended<'a>, Error> {
    let seeding = Context { seeding: true, ..*context };
    let extract = |views: &[usize]| block::extract(context.input, context.ranges, context.normalization, views);
    // A calibrated reconstruction that another might be better than.
    let mut metric: Option<Box<Extended>> = None;
    let by_calibration = if let Some(views) = &whole {
        let attempt = attempt::solve_block(extract(views), &Context { quick: true, ..*context }, recorder)?;
        if attempt.is_trusted() {
            return finished(attempt, &seeding, recorder);
        }
        match attempt.is_calibrated() {
            true => metric_of(attempt, &seeding, recorder)?,
            false => Ended::Block(Some(Box::new(attempt))),
        }
    } else {
        by_calibrated_blocks(candidates, &seeding, recorder)?
    };
    let first = match by_calibration {
        Ended::Extended(extended) if extended.is_settled() => return Ok(Ended::Extended(extended)),
        Ended::Extended(extended) if extended.is_calibrated() => {
            metric = Some(extended);
            None
        }
        Ended::Extended(extended) => Some(extended.seed),
        Ended::Block(attempt) => attempt.map(|attempt| *attempt),
    };
    let sets = whole.as_ref().map_or(candidates, std::slice::from_ref);
    let subsets = block::subsets(sets);
    // Where the whole can still be searched at length, that comes before the rest of its subsets.
    let (cheap, rest) = subsets.split_at(subsets.len().min(if whole.is_some() { FIRST_SUBSETS } else { usize::MAX }));
    let mut best = by_projective_extension(first, cheap, &seeding, recorder)?;
    if let Some(views) = whole.filter(|_| !stands(&best)) {
        let attempt = attempt::solve_block(extract(&views), context, recorder)?;
        if attempt.projective.is_some() {
            return finished(attempt, &seeding, recorder);
        }
        let others = by_projective_extension(None, rest, &seeding, recorder)?;
        best = if stands(&others) { others } else { Some(attempt) };
    }
    let Some(best) = best else { return Ok(metric.map_or(Ended::Block(None), Ended::Extended)) };
    if metric.is_some() && !best.is_trusted() {
        return Ok(metric.map_or(Ended::Block(None), Ended::Extended));
    }
    Ok(match (metric_of(best, &seeding, recorder)?, metric) {
        (Ended::Extended(found), Some(metric)) if found.rank() > metric.rank() => Ended::Extended(found),
        (_, Some(metric)) => Ended::Extended(metric),
        (found, None) => found,
    })
}

/// Whether there is a reconstruction.
fn stands(attempt: &Option<Attempt>) -> bool {
    attempt.as_ref().is_some_and(|attempt| attempt.projective.is_some())
}

/// Blocks that are calibrated and extended from there.
fn by_calibrated_blocks<'a>(
    candidates: &[Vec<usize>],
    context: &Context<'a>,
    recorder: &mut Recorder,
) -> Result<Ended<'a>, Error> {
    let mut best: Option<Extended> = None;
    let mut unextended: Option<Attempt> = None;
    recorder.expect_extension();
    for (k, views) in candidates.iter().enumerate() {
        context.stopped()?;
        recorder.begin_block(k, candidates.len());
        let block = block::extract(context.input, context.ranges, context.normalization, views);
        let attempt = attempt::solve_block(block, context, recorder)?;
        if attempt.is_good() {
            let extended = extend(attempt, context, recorder)?;
            if !extended.stands() {
                unextended = better(unextended, extended.seed);
                continue;
            }
            let enough = extended.is_calibrated() && extended.holds_most_views();
            if best.as_ref().is_none_or(|best| extended.merit() > best.merit()) {
                best = Some(extended);
            }
            if enough {
                break;
            }
        } else {
            unextended = better(unextended, attempt);
        }
    }
    if let Some(best) = best {
        return Ok(Ended::Extended(Box::new(best)));
    }
    match unextended {
        Some(seed) if seed.has_metric() => metric_of(seed, context, recorder),
        unextended => Ok(Ended::Block(unextended.map(Box::new))),
    }
}

/// The best of an attempt and of those on these sets of views, each extended to all views without a calibration and
/// calibrated then; the first that is METRIC.
fn by_projective_extension(
    first: Option<Attempt>,
    sets: &[Vec<usize>],
    context: &Context,
    recorder: &mut Recorder,
) -> Result<Option<Attempt>, Error> {
    let scene = Scene::new(context);
    let options = ProjectiveOptions::default();
    let context = &Context { quick: true, ..*context };
    let mut best: Option<Attempt> = None;
    let mut unsolved = None;
    let mut first = first;
    let starts = usize::from(first.is_some()) + sets.len();
    for k in 0..starts {
        context.stopped()?;
        let mut attempt = match first.take() {
            Some(attempt) => attempt,
            None => {
                recorder.begin_block(k, starts);
                let views = &sets[k - (starts - sets.len())];
                let block = block::extract(context.input, context.ranges, context.normalization, views);
                attempt::search_block(block, context, recorder)?
            }
        };
        let Some(start) = attempt.projective.take() else {
            unsolved = unsolved.or(Some(attempt));
            continue;
        };
        recorder.enter(Stage::Extend);
        let extended = projective::extend(&scene, start, &options, recorder)?;
        if extended.views.len() < block::LEAST_VIEWS || extended.tracks.len() < LEAST_INLIERS {
            // The reason is that of an attempt without a consensus: nothing stands.
            attempt.consensus = None;
            unsolved = unsolved.or(Some(attempt));
            continue;
        }
        attempt.projective = Some(extended);
        attempt::calibrate(&mut attempt, context, recorder)?;
        let rank = |attempt: &Attempt| {
            let evidence = attempt.projective.as_ref().map_or(0.0, |found| found.evidence(scene.outlier_density));
            (attempt.merit().0 >= attempt::WEAK_MERIT, evidence)
        };
        if best.as_ref().is_none_or(|best| rank(&attempt) > rank(best)) {
            best = Some(attempt);
        }
        if best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    Ok(best.or(unsolved))
}

/// Extends an attempt metrically where it has a metric reconstruction and that stands.
fn metric_of<'a>(attempt: Attempt, context: &Context<'a>, recorder: &mut Recorder) -> Result<Ended<'a>, Error> {
    if !attempt.has_metric() {
        return Ok(Ended::Block(Some(Box::new(attempt))));
    }
    let extended = extend(attempt, context, recorder)?;
    Ok(if extended.stands() {
        Ended::Extended(Box::new(extended))
    } else {
        Ended::Block(Some(Box::new(extended.seed)))
    })
}

/// An attempt on the whole input, extended where it leaves views aside, where several cameras or a lens that distorts
/// take part, where observations are not equally noisy, and where some are to be gained once each is judged by itself.
fn finished<'a>(mut attempt: Attempt, context: &Context<'a>, recorder: &mut Recorder) -> Result<Ended<'a>, Error> {
    let is_whole = attempt.views().len() == block::observed_views(context.input).len();
    let is_one_pinhole = !attempt.has_lens() && context.camera_groups_of(attempt.views()).1 == 1;
    let is_done = is_whole && is_one_pinhole && !context.input.has_sigmas();
    if let Some(projective) = attempt.projective.as_ref().filter(|_| is_done) {
        recorder.enter(Stage::Judge);
        let judged = of_attempt::judged(context, &attempt, projective, recorder);
        let of_block = |track: &usize| attempt.block.tracks.binary_search(track).is_ok();
        let retained: usize =
            (0..judged.retained.len()).filter(of_block).map(|track| judged.retained[track].len()).sum();
        if retained as f64 <= WORTH_EXTENDING * projective.observations.len() as f64 {
            attempt.judged = Some(judged);
            return Ok(Ended::Block(Some(Box::new(attempt))));
        }
    }
    if !attempt.has_metric()
        && let Some(start) = attempt.projective.take()
    {
        extend_projectively(&mut attempt, start, context, recorder)?;
    }
    metric_of(attempt, context, recorder)
}

/// Extends what an attempt starts from to all views and tracks, and calibrates it anew.
fn extend_projectively(
    attempt: &mut Attempt,
    start: Projective,
    context: &Context,
    recorder: &mut Recorder,
) -> Result<(), Error> {
    recorder.enter(Stage::Extend);
    attempt.projective =
        Some(projective::extend(&Scene::new(context), start, &ProjectiveOptions::default(), recorder)?);
    attempt::calibrate(attempt, context, recorder)
}

/// The one of the two that has more merit, the first of equals.
fn better(best: Option<Attempt>, attempt: Attempt) -> Option<Attempt> {
    match best {
        Some(best) if best.merit() >= attempt.merit() => Some(best),
        _ => Some(attempt),
    }
}

/// Extends a block, which must be metric, to every view that can be registered.
fn extend<'a>(seed: Attempt, context: &Context<'a>, recorder: &mut Recorder) -> Result<Extended<'a>, Error> {
    recorder.begin_extension();
    recorder.enter(Stage::Extend);
    let scene = Scene::new(context);
    let mut model = parts::first(&scene, &seed, recorder);
    let mut trials = vec![register::Trial::default(); context.input.view_count()];
    register::join(&scene, &mut model, parts::FIRST, &mut trials, recorder)?;
    parts::others(&scene, &mut model, &seed, &mut trials, recorder)?;
    recorder.end_parts();
    for round in 0..FINAL_ROUNDS {
        context.stopped()?;
        let within = SHARE_OF_REGISTERING + (1.0 - SHARE_OF_REGISTERING) * round as f64 / FINAL_ROUNDS as f64;
        recorder.step(Task::Adjust, round + 1, FINAL_ROUNDS, within);
        adjust::all(&scene, &mut model, recorder);
        structure::triangulate(&scene, &mut model, recorder);
        for part in 0..=model.part_of.iter().copied().max().unwrap_or(parts::FIRST) {
            parts::drop_unsupported(&scene, &mut model, part, recorder);
        }
        recorder.tell(within);
    }
    context.stopped()?;
    recorder.enter(Stage::Calibrate);
    let mut calibrations = calibrate::calibrate(&scene, &mut model, context, recorder)?;
    if model.is_strained {
        calibrations.iter_mut().for_each(|outcome| refuse(outcome, &model, context));
    }
    context.stopped()?;
    parts::largest_first(&mut model);
    let unregistered = register::left(&scene, &model, &trials);
    Ok(Extended { seed, scene, model, calibrations, unregistered })
}

/// Takes back a calibration under which the sequence does not hold together.
fn refuse(outcome: &mut Outcome, model: &Model, context: &Context) {
    let detail = format!(
        "the views together fit much worse than the block that they were registered against: more than {:.2} px",
        model.noise * context.scale_px
    );
    outcome.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    outcome.grade = Grade::ProjectiveOnly;
}

impl Extended<'_> {
    /// The worst of the cameras that have enough registered views to be calibrated by themselves: a few photographs of
    /// another camera take nothing from the rest. Of all cameras where none has.
    fn grade(&self) -> Grade {
        let mut views = vec![0; self.scene.cameras];
        self.model.registered().into_iter().for_each(|view| views[self.scene.camera_of[view]] += 1);
        let worst = |least: usize| {
            let grades = self.calibrations.iter().zip(&views).filter(|(_, views)| **views >= least);
            grades.map(|(outcome, _)| outcome.grade).reduce(Grade::worse)
        };
        worst(block::LEAST_VIEWS).or_else(|| worst(1)).unwrap_or(Grade::ProjectiveOnly)
    }

    fn is_calibrated(&self) -> bool {
        self.grade() != Grade::ProjectiveOnly
    }

    /// Larger is better: a calibration before none, then the number of views.
    fn merit(&self) -> (bool, usize) {
        (self.is_calibrated(), self.model.registered().len())
    }

    /// What decides between reconstructions that were found in different ways: a calibration that fits as well as
    /// projective cameras before others, then how well the observations fit.
    fn rank(&self) -> (bool, f64) {
        let model = &self.model;
        let verified = adjust::verified(model);
        let observations = verified.iter().filter_map(|&track| model.landmarks[track]).map(|point| point.support).sum();
        let unknowns = 6 * model.registered().len() + 3 * verified.len();
        let evidence = projective::evidence(observations, unknowns, model.noise, self.scene.outlier_density);
        (self.is_calibrated() && self.fits(), evidence)
    }

    /// Whether nothing says that projective cameras would fit better.
    fn fits(&self) -> bool {
        let mut warnings = self.calibrations.iter().flat_map(|outcome| &outcome.warnings);
        warnings.all(|warning| warning.code != WarningCode::ModelMismatch)
    }

    /// Whether there is anything that geometry verifies: views that points hold, and enough points.
    fn stands(&self) -> bool {
        self.model.registered().len() >= block::LEAST_VIEWS
            && adjust::verified(&self.model).len() >= LEAST_INLIERS
            && self.calibrations.iter().any(|outcome| outcome.metric.is_some())
    }

    /// Whether nothing is to be gained by extending without a calibration: most views hold together so precisely that
    /// wrong observations do not.
    fn is_settled(&self) -> bool {
        let is_precise = self.model.noise <= attempt::INITIAL_NOISE;
        // Windows that differ a little are told as a mismatch of a METRIC one too.
        is_precise && self.holds_most_views() && (self.fits() || self.grade() == Grade::Metric)
    }

    fn holds_most_views(&self) -> bool {
        let registered = self.model.registered().len();
        registered as f64 >= ENOUGH_REGISTERED * (registered + self.unregistered.len()) as f64
    }
}
