//! Search over lenses: an input that pinholes do not calibrate is searched again behind the fisheyes that explain its
//! seeds best.
//!
//! Sampled lenses serve as well as minimal solvers with a lens parameter (Tzamos, Kocur, Ding, Sattler & Kukelova
//! 2024). With weak distortion a pinhole's seed suffices. With strong distortion it is small or wrong, and a plane or a
//! turning camera looks like a scene with depth. Where that calibrates a part of the scene, the input is searched once
//! more, behind the lenses that were calibrated.

use std::f64::consts::SQRT_2;

use super::ended::Ended;
use super::extended::Extended;
use super::quick_pass::QuickPass;
use super::starts::QUICK_SEED;
use crate::domain::Grade;
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::homography;
use crate::solver::calibration::Outcome;
use crate::solver::error::Error;
use crate::solver::noise_model;
use crate::solver::problem::{Problem, Undone};
use crate::solver::projective::ProjectiveReconstruction;
use crate::solver::recorder::Recorder;
use crate::solver::{attempt, view_selection};

options! {
    /// Which lenses are sampled, and when one is searched behind.
    struct LensSearchOptions {
        /// Focal lengths of the equidistant fisheyes, in units of the longer image side. From 85 degrees off the axis
        /// at the corner of a 4:3 image to where the corner is bent by an eighth of its distance, which pinhole seeds
        /// take for depth where a camera only turns. From one to the next the distortion changes by a quarter.
        focals: [f64; 8] = [0.42, 0.47, 0.53, 0.6, 0.68, 0.78, 0.88, 1.0],
        /// Factors by which the best of them is moved to either side, one after the other. Half, a quarter and an
        /// eighth of a step: homographies at 75 degrees off the axis tell one from the other.
        refining: [f64; 3] = [1.06, 1.03, 1.015],
        /// Sets of views that are searched quickly behind each. One may be of views that hardly move, or hold few right
        /// tracks.
        sets: usize = 2,
        /// Least gain in log evidence over a pinhole, beside what it has. A factor of twenty thousand: seeds are
        /// searched at random.
        least_gain: f64 = 10.0,
        /// Share of the pinhole's evidence that the gain must exceed, too. Of four turning fisheyes the best lens
        /// gained 7 to 20 %, most lenses far from it less than 2 %.
        least_share: f64 = 0.05,
        /// Share of the evidence of what stands without that a calibration behind lenses must have: that of projective
        /// cameras, which take up some of what lenses bend, is not far below. Where all views were calibrated it was
        /// .96 and .99, where a part was, .03 and .25 (two scenes each).
        least_kept: f64 = 0.9,
    }
}

const OPTIONS: LensSearchOptions = LensSearchOptions::DEFAULT;
/// Unknowns of the homography between two views.
const HOMOGRAPHY_UNKNOWNS: usize = 8;

/// Whether an answer behind lenses replaces one without: it has a calibration, and explains nearly as much. That of a
/// part is not to replace a reconstruction of the whole.
pub fn replaces(behind: &Ended, of_pinholes: &Ended, problem: &Problem) -> bool {
    behind.calibrated_extension(problem).is_some()
        && behind.evidence(problem) > OPTIONS.least_kept * of_pinholes.evidence(problem)
}

/// Solves an input behind the lenses that explain seeds better than pinholes, and where that does not replace what
/// pinholes gave, behind those that it calibrated; `None` where no lens explains seeds better, or most views. The
/// answer comes with its lenses, to be undone where it is accepted: none is undone in the problem then.
pub fn solve_behind(
    problem: &mut Problem,
    of_pinholes: &Ended,
    recorder: &mut Recorder,
) -> Result<Option<(Ended, Option<Undone>)>, Error> {
    if !undo(problem, recorder)? {
        return Ok(None);
    }
    let quick = QuickPass::new(problem, recorder)?;
    let found = &quick.ended;
    // Seeds gain by a lens by chance, and the whole then explains no more: three translations had .99 to 1.00 of what
    // they had without, three scenes behind real lenses 1.14 to 1.33 times as much.
    let explains_more = found.evidence(problem) > of_pinholes.evidence(problem);
    if found.calibrated_extension(problem).is_none() && found.holds_most_views() && !explains_more {
        problem.undone = None;
        return Ok(None);
    }
    let mut ended = quick.finish(problem, recorder)?;
    let calibrated = ended.calibrated_extension(problem).filter(|_| !replaces(&ended, of_pinholes, problem));
    if calibrated.is_some_and(|extended| undo_calibrated(problem, extended)) {
        ended = QuickPass::new(problem, recorder)?.finish(problem, recorder)?;
    }
    Ok(Some((ended, problem.undone.take())))
}

/// Undoes the lenses that an extension calibrated, each in place of a sampled one; whether there is any. A sampled lens
/// is off by some per cent. Where a camera only turns, that error looks like parallax, and only some tracks fit it.
fn undo_calibrated(problem: &mut Problem, extended: &Extended) -> bool {
    let calibrated = |(camera, outcome): (usize, &Outcome)| {
        let lens = extended.model.lenses[camera];
        let stands = lens.is_known && outcome.grade != Grade::ProjectiveOnly && outcome.metric.is_some();
        stands.then_some((camera, lens.intrinsics))
    };
    let lenses: Vec<_> = extended.calibrations.iter().enumerate().filter_map(calibrated).collect();
    if lenses.is_empty() {
        return false;
    }
    let Some(found) = Undone::new(problem, problem.undone.as_ref(), lenses) else { return false };
    problem.undone = Some(found);
    true
}

/// Undoes the lenses that explain quick seeds of each camera better than pinholes do; whether any camera has one.
fn undo(problem: &mut Problem, recorder: &mut Recorder) -> Result<bool, Error> {
    for camera in 0..problem.cameras {
        let open: Vec<bool> = problem.camera_of.iter().map(|of| *of == camera).collect();
        let sets = view_selection::candidate_views_among(problem, &open);
        let subsets = view_selection::subsets(&sets);
        let seeds: Vec<(Vec<usize>, f64)> = subsets
            .into_iter()
            .chain(sets)
            .take(OPTIONS.sets)
            .map(|views| evidence(problem, &views, recorder).map(|of_pinhole| (views, of_pinhole)))
            .collect::<Result<_, _>>()?;
        let of_pinholes = seeds.iter().map(|(_, of_pinhole)| of_pinhole).sum::<f64>();
        let without = problem.undone.take();
        // The equidistant fisheye that explains the seeds best: its focal length, their evidence and what is undone.
        let mut best: Option<(f64, f64, Undone)> = None;
        let (mut focals, mut refining) = (OPTIONS.focals.to_vec(), OPTIONS.refining.into_iter());
        loop {
            for focal in focals {
                problem.undone = Undone::new(problem, without.as_ref(), [(camera, Intrinsics::equidistant(focal))]);
                let found = total_evidence(problem, &seeds, recorder)?.zip(problem.undone.take());
                let most = best.as_ref().map_or(of_pinholes, |(_, evidence, _)| *evidence);
                best = found.filter(|(total, _)| *total > most).map(|(total, undone)| (focal, total, undone)).or(best);
            }
            let Some(((focal, ..), factor)) = best.as_ref().zip(refining.next()) else { break };
            focals = vec![focal * factor, focal / factor];
        }
        let least = of_pinholes + OPTIONS.least_gain.max(OPTIONS.least_share * of_pinholes);
        problem.undone = best.filter(|(_, evidence, _)| *evidence > least).map(|(_, _, undone)| undone).or(without);
    }
    Ok(problem.undone.is_some())
}

/// Evidence of quick seeds behind the lenses that are undone. `None` where none is, or where a seed is worse than
/// behind a pinhole: one of few tracks may find another set of them by chance and gain by it, hardly each seed does.
///
/// * `seeds`: their views, with the evidence behind a pinhole
fn total_evidence(
    problem: &Problem,
    seeds: &[(Vec<usize>, f64)],
    recorder: &mut Recorder,
) -> Result<Option<f64>, Error> {
    if problem.undone.is_none() {
        return Ok(None);
    }
    let mut total = 0.0;
    for (views, of_pinhole) in seeds {
        let evidence = evidence(problem, views, recorder)?;
        if evidence <= of_pinhole - OPTIONS.least_gain {
            return Ok(None);
        }
        total += evidence;
    }
    Ok(Some(total))
}

/// Evidence of a quick seed on these views.
fn evidence(problem: &Problem, views: &[usize], recorder: &mut Recorder) -> Result<f64, Error> {
    problem.stopped()?;
    let attempt = attempt::search_block(problem, problem.block(views), QUICK_SEED, recorder)?;
    Ok(attempt.projective.as_ref().map_or(0.0, |found| {
        f64::max(found.evidence(problem.outlier_density), by_homographies(problem, found).unwrap_or(0.0))
    }))
}

/// Evidence of the homographies between the views of a reconstruction: where a camera only turns or the scene is a
/// plane, projective cameras fit much of what a lens distorts, and homographies nothing. `None` where there are none.
fn by_homographies(problem: &Problem, found: &ProjectiveReconstruction) -> Option<f64> {
    let (views, observations) = (found.cameras.len(), &found.observations);
    let residual = homography::median_residual(observations, views, found.noise, f64::INFINITY)?;
    // Homographies are fitted where pinholes would see the points: back in the image by the mean scale of the lens.
    let ln_scale = observations.iter().map(|seen| 0.5 * seen.weight.ln()).sum::<f64>() / observations.len() as f64;
    // Of two views.
    let noise = residual * found.noise / SQRT_2 * ln_scale.exp();
    let unknowns = HOMOGRAPHY_UNKNOWNS * (views - 1) + 2 * found.points.len();
    Some(noise_model::evidence(observations.len(), unknowns, noise, problem.outlier_density))
}
