//! The two sides: this program in this process, and a peer in one of its own.

use std::cmp::Reverse;
use std::collections::HashSet;
use std::process::Command;
use std::time::Duration;

use nalgebra::{Matrix3, Vector3};
use scpsfm_core::evaluation::measures;

use super::{Answer, Declared, FocalError, Sample};
use crate::domain::result::ViewResult;
use crate::domain::{Grade, Input, Limits, Silent, Solution, SolveSettings, StopToken, WarningCode};
use crate::evaluation::real::child::{self, Ended, Outcome};
use crate::evaluation::real::peer;
use crate::formats::observations;
use crate::formats::result_files::OBSERVATIONS;
use crate::solver;

/// Wall time after which a peer is ended.
const PEER_SECONDS: u64 = 600;

/// This program's answer; `None` where it was stopped.
pub fn ours(sample: &Sample, declared: Declared, stop: &StopToken) -> Result<Option<Answer>, String> {
    let input = Input::new(sample.input.clone(), &Limits::default(), "scene").map_err(|error| error.to_string())?;
    let settings = SolveSettings { focal_per_view: declared == Declared::FocalPerView, ..SolveSettings::default() };
    let is_own_peak = child::forget_peak_memory();
    let begun = child::thread_cpu_seconds();
    let solution = match solver::solve(&input, &settings, &mut Silent, stop) {
        Ok(solution) => solution,
        Err(solver::Error::Stopped(_)) => return Ok(None),
        Err(error) => return Err(error.to_string()),
    };
    let spent = begun.zip(child::thread_cpu_seconds()).map(|(begun, now)| now - begun);
    let largest = (0..solution.part_count()).max_by_key(|&part| (views_of(&solution, part).count(), Reverse(part)));
    let registered: Vec<usize> = largest.map_or_else(Vec::new, |part| views_of(&solution, part).collect());
    let warns = |code: WarningCode| solution.warnings.iter().any(|warning| warning.code == code);
    Ok(Some(Answer {
        views: share_of_due(sample, registered.iter().filter(|&&view| sample.due[view]).count()),
        grade: solution.grade,
        focals: focals(sample, &solution),
        mismatch: warns(WarningCode::ModelMismatch),
        second_structure: warns(WarningCode::SecondStructure),
        seconds: spent.unwrap_or(solution.seconds),
        trajectory_error: trajectory_error(sample, &solution, &registered),
        peak_bytes: is_own_peak.then(child::peak_memory).flatten(),
        tracks: solution.tracks.inlier,
        observations: solution.observations.inlier,
    }))
}

fn views_of(solution: &Solution, part: u32) -> impl Iterator<Item = usize> {
    let of_part = move |(_, view): &(usize, &ViewResult)| view.projection.is_some() && view.part == part;
    solution.views.iter().enumerate().filter(of_part).map(|(index, _)| index)
}

/// Absolute trajectory error of these views over the length of their true path; `None` where the truth is not known, or
/// nothing is metric.
fn trajectory_error(sample: &Sample, solution: &Solution, registered: &[usize]) -> Option<f64> {
    let truth = sample.centres.as_ref()?;
    let centre = |&view: &usize| {
        let ViewResult { rotation, translation, .. } = &solution.views[view];
        let rows = (*rotation)?;
        let rotation = Matrix3::from_fn(|row, column| rows[row][column]);
        Some(-(rotation.tr_mul(&Vector3::from((*translation)?))))
    };
    let (found, truth): (Vec<Vector3<f64>>, Vec<Vector3<f64>>) =
        registered.iter().filter_map(|view| Some((centre(view)?, truth[*view]))).unzip();
    let path_length: f64 = truth.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    measures::rms_after_alignment(&found, &truth).map(|rms| rms / path_length).filter(|error| error.is_finite())
}

/// So many of the views that shall be registered, as a share.
fn share_of_due(sample: &Sample, count: usize) -> f64 {
    let due = sample.due.iter().filter(|&&due| due).count();
    count.min(due) as f64 / due.max(1) as f64
}

/// Every focal length that the answer gives: of views, or of camera groups (against each that its views have).
fn focals(sample: &Sample, solution: &Solution) -> Vec<FocalError> {
    let mut found = Vec::new();
    for (group, calibration) in solution.cameras() {
        let Some(calibration) = calibration else { continue };
        let mut truths: Vec<(f64, f64, Option<f64>)> = solution
            .views
            .iter()
            .zip(sample.focals())
            .filter(|(view, _)| view.camera_group == group && view.rotation.is_some())
            .map(|(view, (truth, bound))| (view.focal_px.unwrap_or(calibration.focal_px), truth, bound))
            .collect();
        truths.dedup();
        let sigma = calibration.sigma_log_focal;
        let error = |(focal, truth, bound): (f64, f64, _)| FocalError { log_error: (focal / truth).ln(), sigma, bound };
        found.extend(truths.into_iter().map(error));
    }
    found
}

/// The answer of another program, or why there is none; `None` where it was stopped.
pub fn peer(sample: &Sample, words: &[String], stop: &StopToken) -> Result<Option<Result<Answer, String>>, String> {
    let scratch = tempfile::tempdir().map_err(|error| error.to_string())?;
    let file = scratch.path().join(OBSERVATIONS);
    std::fs::write(&file, observations::csv(&sample.input)).map_err(|error| error.to_string())?;
    let run = |command: &mut Command| -> Result<Option<Outcome>, String> {
        let limits = child::Limits { wall: Some(Duration::from_secs(PEER_SECONDS)), stop };
        let outcome = child::run(command, &limits, scratch.path())
            .map_err(|error| format!("cannot run {}: {error}", command.get_program().display()))?;
        Ok((outcome.ended != Ended::Stopped).then_some(outcome))
    };
    // What the program takes to start, its imports above all.
    let (program, arguments) = words.split_first().ok_or("the peer has no name")?;
    let Some(start) = run(Command::new(program).args(arguments).arg("--help"))? else { return Ok(None) };
    let Some(outcome) = run(&mut peer::command(words, &file, sample.size, scratch.path()))? else { return Ok(None) };
    let Ended::Exited(status) = outcome.ended else {
        return Ok(Some(Err(format!("ended after {PEER_SECONDS} s, its limit"))));
    };
    let seconds = |outcome: &Outcome| outcome.usage.cpu_seconds.unwrap_or(outcome.usage.wall_seconds);
    let taken = (seconds(&outcome) - seconds(&start)).max(0.0);
    let said = peer::read(scratch.path(), status, &outcome.complaint);
    Ok(Some(said.map(|said| Answer { seconds: taken, ..peer_answer(sample, &said) })))
}

fn peer_answer(sample: &Sample, said: &peer::PeerFile) -> Answer {
    let tracks: Vec<bool> = (0..sample.inlier.len()).map(|track| said.keeps_track(track).unwrap_or(false)).collect();
    let kept: Option<HashSet<[u64; 2]>> = said.observations.as_ref().map(|kept| kept.iter().copied().collect());
    let ids = sample.input.view.iter().zip(&sample.input.track);
    let observations = ids
        .enumerate()
        .map(|(k, (&view, &track))| match &kept {
            Some(kept) => kept.contains(&[view.into(), track.into()]),
            None => said.keeps_observation(k).unwrap_or(tracks[track as usize]),
        })
        .collect();
    let focal = said.focal.filter(|&focal| focal > 0.0);
    let sigma = said.sigma_log_focal;
    let mut truths: Vec<f64> = sample.focals_px.clone();
    truths.dedup();
    let errors = |focal: f64| truths.iter().map(move |truth| (focal / truth).ln());
    let focals =
        focal.into_iter().flat_map(errors).map(|log_error| FocalError { log_error, sigma, bound: None }).collect();
    // A peer says how many views it has registered, and need not say which.
    let views = share_of_due(sample, said.views);
    Answer { tracks, observations, views, grade: focal.map(|_| Grade::Metric), focals, ..Answer::default() }
}
