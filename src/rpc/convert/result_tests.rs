//! Results over the wire and back.

use prost::Message;

use super::*;
use crate::domain::result::{ObservationResults, TrackResults, TrackSplit, TwoViewTrack};
use crate::domain::second_structure::{SecondStructure, SecondStructureKind, StructurePoint, StructurePose};
use crate::domain::{HeadProgress, LensProjection, Losses, Phase, Progress, ReconstructionProgress};
use crate::domain::{JoinedTracks, Joining};

fn name() -> JobName {
    JobName { tenant: "default".into(), job: "a".into() }
}

/// Every field set to something that is not its default, every optional thing both present and absent.
pub(super) fn rich() -> Solution {
    let projection = Some([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [0.1, 0.2, 0.3, f64::MIN_POSITIVE]]);
    let rotation = Some([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]);
    let progress = Progress {
        stage: Stage::Search,
        fraction: 0.3,
        iteration: 7,
        losses: Some(Losses { num: 1.0, proj: 2.0, daq: 3.0 }),
        head: Some(HeadProgress {
            head: 2,
            iteration: 7,
            phase: Some(Phase::Growth),
            weight_sum: 19.5,
            weight_histogram: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
            tolerance: Some(0.04),
            best_daq_residual: Some(0.5),
        }),
        inliers: 20,
        focal_px: Some(1200.5),
        best_cost: Some(0.9),
        elapsed_seconds: 0.25,
        reconstruction: ReconstructionProgress {
            block: 1,
            blocks: 4,
            part: 1,
            registered_views: 7,
            views: 9,
            step: None,
        },
    };
    Solution {
        status: Status::Solved,
        grade: Some(Grade::Weak),
        method: Method::Auto,
        winning_proposal: Some(Proposal::Irls),
        iterations: 150,
        seed: u64::MAX,
        calibrations: vec![
            Calibration {
                camera_group: 7,
                focal_px: 1.0 / 3.0,
                sigma_log_focal: Some(0.05),
                principal_point_px: [499.5, 399.5],
                aspect: 1.25,
                lens_projection: LensProjection::Fisheye,
                radial_k1: -0.05,
                radial_k2: 0.01,
                radial_k3: -0.003,
                tangential_p1: 0.0007,
                tangential_p2: -0.0005,
                grade: Some(Grade::Weak),
                sigmas: Sigmas {
                    principal_point_px: Some([3.5, 4.5]),
                    aspect: Some(0.01),
                    radial_k1: Some(0.02),
                    radial_k2: None,
                    radial_k3: Some(0.004),
                    tangential_p1: Some(0.0001),
                    tangential_p2: Some(0.0002),
                },
            },
            Calibration::pinhole(900.0, [0.0, 0.0]),
        ],
        plane_at_infinity: Some([1e-4, -2e-4, 3e-300]),
        views: vec![
            ViewResult {
                name: Some("a.jpg".into()),
                projection,
                rotation,
                translation: Some([0.0, -1.0, 2.0]),
                focal_px: Some(987.5),
                part: 1,
                camera_group: 7,
                left_out: None,
            },
            ViewResult { projection, ..ViewResult::default() },
            ViewResult::default(),
            ViewResult { left_out: Some(LeftOut::NoObservations), ..ViewResult::default() },
            ViewResult { left_out: Some(LeftOut::OutsideBlock), ..ViewResult::default() },
            ViewResult { left_out: Some(LeftOut::NotRegistered { points: 12, agreeing: 4 }), ..ViewResult::default() },
        ],
        tracks: TrackResults {
            weight: vec![0.0, 1.0, 0.25],
            inlier: vec![false, true, true],
            network_weight: vec![0.1, 0.2, 0.3],
            point: vec![None, Some([1.0, -2.0, 3.5]), None],
            part: vec![0, 1, 0],
            second_structure: vec![0, 0, 2],
        },
        observations: ObservationResults {
            inlier: vec![true, false, false],
            residual_px: vec![Some(0.0), Some(17.25), None],
            weight: vec![0.875, 0.25, 0.0],
            split: vec![0, 2, 0],
        },
        splits: vec![
            TrackSplit { track: 1, number: 1, weight: 0.75, point: None },
            TrackSplit { track: 1, number: 2, weight: 0.5, point: Some([1.0, -2.0, 3e-9]) },
        ],
        two_view_tracks: vec![
            TwoViewTrack { track: 0, weight: 0.75, part: 1, point: Some([4.0, 5.0, 6.0]) },
            TwoViewTrack { track: 2, weight: 0.875, part: 0, point: None },
        ],
        second_structures: vec![
            SecondStructure { number: 1, kind: None, poses: Vec::new(), points: Vec::new() },
            SecondStructure {
                number: 2,
                kind: Some(SecondStructureKind::RepeatedStructure),
                poses: vec![
                    StructurePose {
                        view: 0,
                        rotation: [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
                        translation: [0.5, -1.5, 2.5],
                    },
                    StructurePose {
                        view: 5,
                        rotation: [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
                        translation: [1.0 / 3.0, 0.0, 0.0],
                    },
                ],
                points: vec![
                    StructurePoint { track: 0, point: [7.0, -8.0, 9.5] },
                    StructurePoint { track: 2, point: [1e-9, 2.0, 3.0] },
                ],
            },
        ],
        noise_px: Some(0.5),
        reprojection_rms_px: Some(0.7),
        reprojection_mean_px: Some(0.6),
        warnings: vec![
            Warning::new(WarningCode::ViewsLeftOut, "views 3, 4"),
            Warning::new(WarningCode::UnobservableFocal, "no turning").of_group(7),
        ],
        seconds: 1.5,
        stages: vec![StageTime { stage: Stage::Prepare, seconds: 0.1 }],
        proposal_times: vec![
            ProposalTime { proposal: Proposal::Network, seconds: Some(0.5), steps: 80 },
            ProposalTime { proposal: Proposal::Uniform, seconds: None, steps: 6000 },
        ],
        history: vec![progress, Progress { losses: None, head: None, focal_px: None, best_cost: None, ..progress }],
        trained_network_sha256: Some(Sha256Digest([0x5e; 32])),
        input_content_sha256: Some(Sha256Digest([0xd1; 32])),
        joined_tracks: Some(JoinedTracks {
            view: vec![0, 1, 0],
            track: vec![0, 0, 1],
            joining: Joining { keypoint: vec![7, 0, 9], match_count: 5, cut_match_count: 2 },
        }),
    }
}

fn over_the_wire(solution: &Solution) -> Solution {
    let bytes = to_wire(&name(), solution).encode_to_vec();
    from_wire(proto::JobResult::decode(bytes.as_slice()).expect("decodes")).expect("well formed")
}

#[test]
fn a_solution_survives_the_wire_unchanged() {
    assert_eq!(over_the_wire(&rich()), rich());
}

#[test]
fn a_solution_without_a_reconstruction_survives_too() {
    let bare = Solution {
        status: Status::NoReconstruction,
        grade: None,
        winning_proposal: None,
        calibrations: Vec::new(),
        plane_at_infinity: None,
        views: vec![ViewResult::default(); 2],
        tracks: TrackResults::default(),
        observations: ObservationResults::default(),
        two_view_tracks: Vec::new(),
        second_structures: Vec::new(),
        trained_network_sha256: None,
        noise_px: None,
        reprojection_rms_px: None,
        reprojection_mean_px: None,
        ..rich()
    };
    assert_eq!(over_the_wire(&bare), bare);
}

#[test]
fn a_malformed_answer_names_its_field() {
    let with = |change: &dyn Fn(&mut proto::JobResult)| {
        let mut result = to_wire(&name(), &rich());
        change(&mut result);
        from_wire(result).expect_err("malformed").path()
    };
    assert_eq!(with(&|result| result.status = 0), "status");
    assert_eq!(with(&|result| result.grade = 9), "grade");
    assert_eq!(with(&|result| result.tracks = None), "tracks");
    assert_eq!(with(&|result| result.input_content_sha256.truncate(31)), "input_content_sha256");
    assert_eq!(with(&|result| result.views[1].projection.truncate(5)), "views.projection[1]");
    let tracks = |result: &mut proto::JobResult, change: &dyn Fn(&mut proto::TrackResults)| {
        change(result.tracks.as_mut().expect("set"));
    };
    assert_eq!(with(&|result| tracks(result, &|tracks| tracks.inliers.truncate(1))), "tracks");
    assert_eq!(with(&|result| tracks(result, &|tracks| tracks.second_structure_numbers.truncate(1))), "tracks");
    assert_eq!(
        with(&|result| tracks(result, &|tracks| tracks.point_track_indices[0] = 3)),
        "tracks.point_track_indices[0]"
    );
    assert_eq!(with(&|result| tracks(result, &|tracks| tracks.points.truncate(2))), "tracks.points");
    assert_eq!(with(&|result| tracks(result, &|tracks| tracks.point_parts.push(1))), "tracks.point_parts");
    let two_view_track = "two_view_tracks.track_index[1]";
    assert_eq!(with(&|result| result.two_view_tracks[1].track_index = 3), two_view_track);
    assert_eq!(with(&|result| result.two_view_tracks[1].track_index = 0), two_view_track);
    assert_eq!(with(&|result| result.two_view_tracks[0].point.truncate(2)), "two_view_tracks.point[0]");
    let structures = |result: &mut proto::JobResult, change: &dyn Fn(&mut proto::SecondStructure)| {
        change(&mut result.second_structures[1]);
    };
    let number = "second_structures[1].number";
    assert_eq!(with(&|result| result.second_structures[0].number = 0), "second_structures[0].number");
    assert_eq!(with(&|result| structures(result, &|structure| structure.number = 1)), number);
    assert_eq!(with(&|result| structures(result, &|structure| structure.number = 3)), number);
    let view = "second_structures[1].poses[1].view_index";
    assert_eq!(with(&|result| structures(result, &|structure| structure.poses[1].view_index = 6)), view);
    assert_eq!(with(&|result| structures(result, &|structure| structure.poses[1].view_index = 0)), view);
    let track = "second_structures[1].points[1].track_index";
    assert_eq!(with(&|result| structures(result, &|structure| structure.points[1].track_index = 3)), track);
    assert_eq!(with(&|result| structures(result, &|structure| structure.points[1].track_index = 0)), track);
    for count in [0, 8] {
        let rotation = with(&|result| structures(result, &|structure| structure.poses[0].rotation.truncate(count)));
        assert_eq!(rotation, "second_structures[1].poses[0].rotation");
    }
    for count in [0, 2] {
        let translation =
            with(&|result| structures(result, &|structure| structure.poses[0].translation.truncate(count)));
        assert_eq!(translation, "second_structures[1].poses[0].translation");
        let point = with(&|result| structures(result, &|structure| structure.points[0].point.truncate(count)));
        assert_eq!(point, "second_structures[1].points[0].point");
    }
    assert_eq!(with(&|result| result.calibrations[0].grade = 9), "calibrations.grade");
    assert_eq!(with(&|result| result.calibrations[0].lens_projection = 9), "calibrations.lens_projection");
}

/// A number that a later version added costs the answer the record that it stands in, and no more.
#[test]
fn what_only_a_later_version_knows_is_left_out() {
    let mut result = to_wire(&name(), &rich());
    let mut expected = rich();
    result.winning_proposal = 99;
    expected.winning_proposal = None;
    result.stage_durations[0].stage = 99;
    expected.stages.remove(0);
    result.proposal_durations[0].proposal = 99;
    expected.proposal_times.remove(0);
    result.progress_records[0].stage = 99;
    expected.history.remove(0);
    result.views[3].left_out.as_mut().expect("set").reason = 99;
    expected.views[3].left_out = Some(LeftOut::Unknown);
    result.second_structures[1].kind = 99;
    expected.second_structures[1].kind = None;
    result.warnings[0].code = 99;
    expected.warnings[0].code = WarningCode::Unknown;
    assert_eq!(from_wire(result), Ok(expected.clone()));
    // What is unknown stays so where it is written again.
    assert_eq!(over_the_wire(&expected), expected);
}

/// 0 is a part: only what is absent tells that a view has none.
#[test]
fn only_registered_views_have_a_part() {
    let result = to_wire(&name(), &rich());
    for (view, solved) in result.views.iter().zip(rich().views) {
        assert_eq!(view.part, solved.projection.map(|_| solved.part));
    }
    assert!(
        result.views.iter().any(|view| view.part == Some(0)) && result.views.iter().any(|view| view.part.is_none())
    );
}
