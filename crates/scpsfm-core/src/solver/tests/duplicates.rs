//! Inputs in which tracks stand several times.

use super::*;
use crate::domain::result::TrackSplit;
use crate::synthetic::{Sequence, SequenceOptions};

/// The input with each of these tracks once more for every time that it is named; the duplicates are at the end.
fn with_duplicates(raw: &RawInput, tracks: &[u32]) -> RawInput {
    let mut more = raw.clone();
    for (n, &track) in tracks.iter().enumerate() {
        for k in (0..raw.x.len()).filter(|&k| raw.track[k] == track) {
            more.view.push(raw.view[k]);
            more.track.push((raw.track_count + n) as u32);
            more.x.push(raw.x[k]);
            more.y.push(raw.y[k]);
            more.depth.extend(raw.depth.get(k));
        }
    }
    more.track_count += tracks.len();
    more
}

fn checked(raw: RawInput) -> Input {
    Input::new(raw, &Limits::default(), "duplicates").expect("valid")
}

fn duplicates(solution: &Solution) -> Option<&str> {
    let told = solution.warnings.iter().find(|warning| warning.code == WarningCode::DuplicateTracks);
    told.map(|warning| warning.detail.as_str())
}

/// Twelve duplicates of one wrong track, which agree on whatever geometry suits the one.
#[test]
fn duplicates_of_a_wrong_track_verify_nothing() {
    let (input, _) = scene(SceneOptions { outliers: 1.0, ..SceneOptions::default() });
    let raw = with_duplicates(&input.to_raw(), &[17; 12]);
    assert_eq!(raw.track_count, 212);
    let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
    let solution = solved(&checked(raw), &settings);
    assert_eq!(solution.status, Status::NoReconstruction, "{} inliers", solution.inlier_track_count());
    assert_eq!((solution.inlier_track_count(), solution.tracks.weight.len()), (0, 212));
    let detail = duplicates(&solution).expect("a warning");
    assert!(detail.starts_with("12 of 212 tracks") && detail.contains("200 (as 17), "), "{detail}");
}

/// The answer is that of the input without the duplicates, which get the answer of the first.
fn assert_folded(raw: &RawInput, duplicated: &[u32], settings: &SolveSettings) {
    let alone = solved(&checked(raw.clone()), settings);
    assert_eq!((alone.status, duplicates(&alone)), (Status::Solved, None));
    let input = checked(with_duplicates(raw, duplicated));
    let both = solved(&input, settings);
    assert!(duplicates(&both).is_some());
    assert_eq!((&both.calibrations, both.grade, &both.views), (&alone.calibrations, alone.grade, &alone.views));
    assert_eq!(both.input_content_sha256, Some(input.to_raw().sha256()));
    let (tracks, observations) = (raw.track_count, raw.x.len());
    let mut more = observations;
    for (n, &track) in duplicated.iter().enumerate() {
        let (duplicate, track) = (tracks + n, track as usize);
        assert_eq!(both.tracks.weight[duplicate], alone.tracks.weight[track], "{track}");
        assert_eq!(both.tracks.inlier[duplicate], alone.tracks.inlier[track], "{track}");
        assert_eq!(both.tracks.point[duplicate], alone.tracks.point[track], "{track}");
        for k in (0..observations).filter(|&k| raw.track[k] as usize == track) {
            assert_eq!(both.observations.inlier[more], alone.observations.inlier[k], "{track}");
            assert_eq!(both.observations.residual_px[more], alone.observations.residual_px[k], "{track}");
            assert_eq!(both.observations.weight[more], alone.observations.weight[k], "{track}");
            assert_eq!(both.observations.split[more], alone.observations.split[k], "{track}");
            more += 1;
        }
        let of = |solution: &Solution, wanted: usize| -> Vec<TrackSplit> {
            let splits = solution.splits.iter().filter(|split| split.track as usize == wanted);
            splits.map(|split| TrackSplit { track: 0, ..*split }).collect()
        };
        assert_eq!(of(&both, duplicate), of(&alone, track), "{track}");
    }
    let first = |solution: &Solution| {
        let (tracks, judged) = (&solution.tracks, &solution.observations);
        (
            tracks.weight[..raw.track_count].to_vec(),
            tracks.point[..raw.track_count].to_vec(),
            judged.inlier[..observations].to_vec(),
            judged.residual_px[..observations].to_vec(),
        )
    };
    assert_eq!(first(&both), first(&alone));
}

#[test]
fn duplicates_change_no_answer_and_share_it() {
    let (input, scene) = scene(SceneOptions { tracks: 60, outliers: 0.5, ..SceneOptions::default() });
    let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
    let right = scene.truth.inlier.iter().position(|&inlier| inlier).expect("a right track") as u32;
    let wrong = scene.truth.inlier.iter().position(|&inlier| !inlier).expect("a wrong track") as u32;
    assert_folded(&input.to_raw(), &[right, wrong, right], &settings);
}

#[test]
fn duplicates_of_a_split_track_are_split() {
    let options = SequenceOptions { tracks: 400, joined: 0.5, ..SequenceOptions::default() };
    let sequence = Sequence::generate(&options).expect("valid");
    let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
    let alone = solved(&checked(sequence.input.clone()), &settings);
    let split = alone.splits.last().expect("a split").track;
    assert_folded(&sequence.input, &[split, 3], &settings);
}
