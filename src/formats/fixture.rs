//! A hand-made solution for tests: the truth of a synthetic scene, dressed as an answer.

use nalgebra::{Matrix3, Matrix3x4, Matrix4, Vector3};
use std::path::Path;

use super::{Label, LabelledInput};
use crate::domain::result::{ObservationResults, ProposalTime, StageTime, TrackResults, TrackSplit, ViewResult};
use crate::domain::second_structure::{SecondStructure, SecondStructureKind, StructurePoint, StructurePose};
use crate::domain::{
    Calibration, Grade, HeadProgress, LeftOut, LensProjection, Losses, Method, Phase, Progress, Proposal,
    ReconstructionProgress, Solution, Stage, Status, Warning, WarningCode,
};
use crate::synthetic::{Scene, SceneOptions, Sequence, SequenceOptions};

/// A solved scene of 5 views and 40 tracks, labels 10 x view + 3 and 2 x track + 100.
pub(crate) fn solved() -> (LabelledInput, Solution) {
    solved_with(&SceneOptions { views: 5, tracks: 40, outliers: 0.5, seed: 7, ..SceneOptions::default() })
}

/// The same for a scene of any size.
pub(crate) fn solved_with(options: &SceneOptions) -> (LabelledInput, Solution) {
    let scene = Scene::generate(options).expect("valid options");
    let mut input = LabelledInput::unlabelled(scene.input.clone(), Path::new("observations.csv"));
    input.view_labels = (0..input.raw.views.len() as u64).map(|view| Label::Number(10 * view + 3)).collect();
    input.track_labels = (0..input.raw.track_count as u64).map(|track| Label::Number(2 * track + 100)).collect();
    let solution = solution(&scene);
    (input, solution)
}

/// The solved scene with its last two views and some of its tracks in a part of their own: of the inlier tracks every
/// other one is seen by the first three views only, the rest by the last two.
pub(crate) fn solved_in_two_parts() -> (LabelledInput, Solution) {
    let (input, mut solution) = solved();
    solution.views.iter_mut().skip(3).for_each(|view| view.part = 1);
    let inliers: Vec<usize> =
        (0..solution.tracks.inlier.len()).filter(|&track| solution.tracks.inlier[track]).collect();
    solution.tracks.part = vec![0; solution.tracks.inlier.len()];
    inliers.iter().skip(1).step_by(2).for_each(|&track| solution.tracks.part[track] = 1);
    for k in 0..input.raw.x.len() {
        let part = solution.tracks.part[input.raw.track[k] as usize];
        if solution.views[input.raw.view[k] as usize].part != part {
            solution.observations.inlier[k] = false;
            solution.observations.residual_px[k] = None;
        }
    }
    (input, solution)
}

/// The solved scene with two of its right tracks joined: of one the first three views, of the other the last two, under
/// the number of the first. The other is empty then.
pub(crate) fn solved_with_a_split() -> (LabelledInput, Solution) {
    let (mut input, mut solution) = solved();
    let mut inliers = (0..solution.tracks.inlier.len()).filter(|&track| solution.tracks.inlier[track]);
    let (Some(first), Some(second)) = (inliers.next(), inliers.next()) else { panic!("no inliers") };
    solution.splits =
        vec![TrackSplit { track: first as u32, number: 1, weight: 0.9, point: solution.tracks.point[second].take() }];
    (solution.tracks.inlier[second], solution.tracks.weight[second]) = (false, 0.0);
    let place = |track: usize, view: u32| {
        let of = |k: &usize| input.raw.track[*k] as usize == track && input.raw.view[*k] == view;
        (0..input.raw.x.len()).find(of).expect("complete tracks")
    };
    let moved: Vec<(usize, usize)> = (3..5).map(|view| (place(first, view), place(second, view))).collect();
    for (to, from) in moved {
        (input.raw.x[to], input.raw.y[to]) = (input.raw.x[from], input.raw.y[from]);
        (solution.observations.inlier[to], solution.observations.split[to]) = (false, 1);
    }
    let of_second = |k: &usize| input.raw.track[*k] as usize == second;
    for k in (0..input.raw.x.len()).filter(of_second) {
        (solution.observations.inlier[k], solution.observations.residual_px[k]) = (false, None);
    }
    (input, solution)
}

/// The solved scene with a moving body that has poses and a point, and a second structure without either.
pub(crate) fn solved_with_second_structures() -> (LabelledInput, Solution) {
    let (input, mut solution) = solved();
    let rotation = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
    solution.tracks.second_structure = (0..solution.tracks.inlier.len()).map(|track| [0, 1, 0, 2][track % 4]).collect();
    solution.second_structures = vec![
        SecondStructure {
            number: 1,
            kind: Some(SecondStructureKind::MovingBody),
            poses: [0, 3].map(|view| StructurePose { view, rotation, translation: [1.0, 2.0, 3.0] }).to_vec(),
            points: vec![StructurePoint { track: 5, point: [4.0, 5.0, 6.0] }],
        },
        SecondStructure { number: 2, kind: None, poses: Vec::new(), points: Vec::new() },
    ];
    (input, solution)
}

/// A view that is not registered, for this reason.
pub(crate) fn left_out(reason: LeftOut) -> ViewResult {
    ViewResult { left_out: Some(reason), ..ViewResult::default() }
}

/// The truth of a synthetic sequence as the solver answers it; of the fixture of a scene what is no sequence's.
pub(crate) fn solved_sequence(options: &SequenceOptions) -> (LabelledInput, Solution) {
    let sequence = Sequence::generate(options).expect("valid options");
    let (truth, raw) = (&sequence.truth, &sequence.input);
    let (_, base) = solved();
    let [cx, cy] = truth.principal_point_px;
    let k = Matrix3::new(truth.focal_px, 0.0, cx, 0.0, truth.focal_px, cy, 0.0, 0.0, 1.0);
    let pose = |view: usize| {
        let mut pose = Matrix3x4::zeros();
        let rotation = truth.rotations[view];
        pose.fixed_columns_mut::<3>(0).copy_from(&Matrix3::from_fn(|row, column| rotation[row][column]));
        pose.set_column(3, &Vector3::from(truth.translations[view]));
        k * pose
    };
    let cameras: Vec<Matrix3x4<f64>> = (0..options.views).map(pose).collect();
    let residual = |n: usize| {
        let seen = cameras[raw.view[n] as usize] * Vector3::from(truth.points[raw.track[n] as usize]).push(1.0);
        (seen.x / seen.z - raw.x[n]).hypot(seen.y / seen.z - raw.y[n])
    };
    let view = |(view, camera): (usize, &Matrix3x4<f64>)| ViewResult {
        projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| camera[(row, column)]))),
        rotation: Some(truth.rotations[view]),
        translation: Some(truth.translations[view]),
        ..ViewResult::default()
    };
    let solution = Solution {
        calibrations: vec![Calibration {
            focal_px: truth.focal_px,
            radial_k1: options.radial_k1,
            ..base.calibrations[0]
        }],
        views: cameras.iter().enumerate().map(view).collect(),
        tracks: TrackResults {
            weight: truth.inlier.iter().map(|&yes| if yes { 0.97 } else { 0.02 }).collect(),
            inlier: truth.inlier.clone(),
            network_weight: Vec::new(),
            point: truth.inlier.iter().zip(&truth.points).map(|(&yes, &point)| yes.then_some(point)).collect(),
            part: Vec::new(),
            second_structure: Vec::new(),
        },
        observations: ObservationResults {
            inlier: truth.observation_right.clone(),
            residual_px: (0..raw.x.len()).map(|n| Some(residual(n))).collect(),
            ..ObservationResults::unjudged(raw.x.len())
        },
        ..base
    };
    (LabelledInput::unlabelled(raw.clone(), Path::new("observations.csv")), solution)
}

/// The solved scene as the solver answers under [`Grade::ProjectiveOnly`]: no calibration, no plane at infinity, no
/// poses, and cameras and points in the frame `P1 = [I|0]`.
pub(crate) fn projective_only() -> (LabelledInput, Solution) {
    let (input, mut solution) = solved();
    let camera = |view: &ViewResult| {
        let rows = view.projection.expect("every view of the fixture is registered");
        Matrix3x4::from_fn(|row, column| rows[row][column])
    };
    let mut frame = Matrix4::identity();
    frame.fixed_rows_mut::<3>(0).copy_from(&camera(&solution.views[0]));
    let back = frame.try_inverse().expect("a finite camera");
    for view in &mut solution.views {
        let moved = camera(view) * back;
        let projection = std::array::from_fn(|row| std::array::from_fn(|column| moved[(row, column)]));
        *view = ViewResult { projection: Some(projection), ..ViewResult::default() };
    }
    for point in solution.tracks.point.iter_mut().flatten() {
        let moved = frame * Vector3::from(*point).push(1.0);
        *point = std::array::from_fn(|axis| moved[axis] / moved[3]);
    }
    solution.grade = Some(Grade::ProjectiveOnly);
    solution.calibrations.clear();
    solution.plane_at_infinity = None;
    solution.warnings = vec![Warning::new(WarningCode::UnobservableFocal, "the camera only moved sideways")];
    (input, solution)
}

fn solution(scene: &Scene) -> Solution {
    let truth = &scene.truth;
    let [cx, cy] = truth.principal_point_px;
    let k = Matrix3::new(truth.focal_px, 0.0, cx, 0.0, truth.focal_px, cy, 0.0, 0.0, 1.0);
    let cameras: Vec<Matrix3x4<f64>> = (0..scene.options.views)
        .map(|view| {
            let mut pose = Matrix3x4::zeros();
            pose.fixed_columns_mut::<3>(0)
                .copy_from(&Matrix3::from_fn(|row, column| truth.rotations[view][row][column]));
            pose.set_column(3, &Vector3::from(truth.translations[view]));
            k * pose
        })
        .collect();
    let inlier = &truth.inlier;
    let residual = |n: usize| {
        let track = scene.input.track[n] as usize;
        let seen = cameras[scene.input.view[n] as usize] * Vector3::from(truth.points[track]).push(1.0);
        (seen.x / seen.z - scene.input.x[n]).hypot(seen.y / seen.z - scene.input.y[n])
    };
    let inlier_of = |n: usize| inlier[scene.input.track[n] as usize];
    let count = scene.input.x.len();
    let kept: Vec<f64> = (0..count).filter(|&n| inlier_of(n)).map(residual).collect();
    let weight = |hit: f32, miss: f32| inlier.iter().map(|&yes| if yes { hit } else { miss }).collect::<Vec<f32>>();
    Solution {
        status: Status::Solved,
        grade: Some(Grade::Metric),
        method: Method::Auto,
        winning_proposal: Some(Proposal::Network),
        iterations: 150,
        seed: scene.options.seed,
        calibrations: vec![Calibration {
            camera_group: 0,
            focal_px: truth.focal_px,
            sigma_log_focal: Some(0.004),
            principal_point_px: truth.principal_point_px,
            aspect: 1.0,
            lens_projection: LensProjection::Perspective,
            radial_k1: -0.02,
            radial_k2: 0.0,
            radial_k3: 0.0,
            tangential_p1: 0.0,
            tangential_p2: 0.0,
            grade: Some(Grade::Metric),
            sigmas: Default::default(),
        }],
        plane_at_infinity: Some([1e-4, -2e-5, 0.03]),
        views: cameras
            .iter()
            .enumerate()
            .map(|(view, camera)| ViewResult {
                projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| camera[(row, column)]))),
                rotation: Some(truth.rotations[view]),
                translation: Some(truth.translations[view]),
                ..ViewResult::default()
            })
            .collect(),
        tracks: TrackResults {
            weight: weight(0.98, 0.03),
            inlier: inlier.clone(),
            network_weight: weight(0.8, 0.2),
            point: inlier.iter().zip(&truth.points).map(|(&yes, &point)| yes.then_some(point)).collect(),
            part: Vec::new(),
            second_structure: Vec::new(),
        },
        observations: ObservationResults {
            inlier: (0..count).map(inlier_of).collect(),
            residual_px: (0..count).map(|n| inlier_of(n).then(|| residual(n))).collect(),
            ..ObservationResults::unjudged(count)
        },
        splits: Vec::new(),
        two_view_tracks: Vec::new(),
        second_structures: Vec::new(),
        noise_px: Some(3.1),
        reprojection_rms_px: Some((kept.iter().map(|r| r * r).sum::<f64>() / kept.len() as f64).sqrt()),
        reprojection_mean_px: Some(kept.iter().sum::<f64>() / kept.len() as f64),
        warnings: vec![Warning::new(WarningCode::FewInliers, "<b>hostile</b> & \"quoted\" detail")],
        seconds: 1.5,
        stages: Stage::ALL.iter().map(|&stage| StageTime { stage, seconds: 0.3 }).collect(),
        proposal_times: vec![ProposalTime { proposal: Proposal::Uniform, seconds: None, steps: 600 }],
        history: history(truth.focal_px),
        trained_network_sha256: None,
        input_content_sha256: None,
        joined_tracks: None,
    }
}

fn history(focal_px: f64) -> Vec<Progress> {
    (0..150u32)
        .map(|iteration| {
            let share = f64::from(iteration) / 150.0;
            Progress {
                stage: Stage::ALL[(share * 5.0) as usize],
                fraction: share,
                iteration,
                losses: Some(Losses {
                    num: 1e4 * (-12.0 * share).exp(),
                    proj: 3.0 - 2.0 * share,
                    daq: 0.5 + (1.0 - share),
                }),
                head: Some(head(iteration)),
                inliers: (20.0 * share) as u32,
                focal_px: (iteration > 30)
                    .then(|| focal_px * (1.0 + 0.1 * (1.0 - share) * (f64::from(iteration)).sin())),
                best_cost: (iteration > 10).then_some(1.0 - 0.5 * share),
                elapsed_seconds: share * 1.5,
                reconstruction: ReconstructionProgress::default(),
            }
        })
        .collect()
}

/// Two heads of 75 iterations each, whose weights part.
fn head(iteration: u32) -> HeadProgress {
    let (head, iteration) = (iteration / 75 + 1, iteration % 75 + 1);
    let share = f64::from(iteration) / 75.0;
    let phase = match share {
        share if share < 0.6 => Phase::Relaxation,
        share if share < 0.8 => Phase::Rank,
        _ => Phase::Growth,
    };
    let wrong = (1000.0 * (0.5 - 0.5 * share)) as u32;
    HeadProgress {
        head,
        iteration,
        phase: Some(phase),
        weight_sum: 40.0 - 20.0 * share,
        weight_histogram: [60 - wrong / 10, 0, 0, 0, 0, wrong / 10, 0, 0, 0, 20],
        tolerance: (phase == Phase::Growth).then_some(0.04),
        best_daq_residual: (head > 1).then_some(0.3),
    }
}
