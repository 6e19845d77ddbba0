//! Results, without loss: a client writes the same files from a [`proto::JobResult`] as a solve in process would.

use prost::Message;

use super::enums::{Twin, optional_to_wire};
use super::time::{duration_to_wire, seconds_from_wire};
use super::{progress, required, second_structures, tracks};
use crate::domain::job::JobName;
use crate::domain::result::{ProposalTime, Sigmas, StageTime, ViewResult};
use crate::domain::{
    Calibration, Grade, LeftOut, LensProjection, Method, Proposal, Sha256Digest, Solution, Stage, Status, Violation,
    Warning, WarningCode,
};
use crate::rpc::proto;

/// The bytes that every read of the result gives; see [`crate::engine::ResultEncoder`].
pub fn encode(name: &JobName, solution: &Solution) -> Vec<u8> {
    to_wire(name, solution).encode_to_vec()
}

fn to_wire(name: &JobName, solution: &Solution) -> proto::JobResult {
    proto::JobResult {
        job: name.to_string(),
        server_version: env!("CARGO_PKG_VERSION").to_owned(),
        status: solution.status.to_wire(),
        grade: optional_to_wire(solution.grade),
        method: solution.method.to_wire(),
        winning_proposal: optional_to_wire(solution.winning_proposal),
        iteration_count: solution.iterations,
        seed: solution.seed,
        calibrations: solution.calibrations.iter().map(calibration_to_wire).collect(),
        plane_at_infinity: solution.plane_at_infinity.map(|[x, y, z]| proto::PlaneAtInfinity { x, y, z }),
        views: solution.views.iter().map(view_to_wire).collect(),
        tracks: Some(tracks::to_wire(&solution.tracks)),
        observations: Some(tracks::observations_to_wire(&solution.observations)),
        track_splits: solution.splits.iter().map(tracks::split_to_wire).collect(),
        two_view_tracks: solution.two_view_tracks.iter().map(tracks::two_view_track_to_wire).collect(),
        second_structures: solution.second_structures.iter().map(second_structures::to_wire).collect(),
        noise_px: solution.noise_px,
        reprojection_rms_px: solution.reprojection_rms_px,
        reprojection_mean_px: solution.reprojection_mean_px,
        warnings: warnings_to_wire(&solution.warnings),
        solve_duration: Some(duration_to_wire(solution.seconds)),
        stage_durations: solution
            .stages
            .iter()
            .map(|time| proto::StageDuration {
                stage: time.stage.to_wire(),
                duration: Some(duration_to_wire(time.seconds)),
            })
            .collect(),
        proposal_durations: solution
            .proposal_times
            .iter()
            .map(|time| proto::ProposalDuration {
                proposal: time.proposal.to_wire(),
                duration: time.seconds.map(duration_to_wire),
                step_count: time.steps,
            })
            .collect(),
        progress_records: solution.history.iter().map(progress::to_wire).collect(),
        trained_network_sha256: digest_to_wire(solution.trained_network_sha256),
        input_content_sha256: digest_to_wire(solution.input_content_sha256),
        joined_tracks: solution.joined_tracks.as_ref().map(tracks::joined_tracks_to_wire),
    }
}

/// # Errors
/// A violation that names the field which no server of this version would send.
pub fn from_wire(result: proto::JobResult) -> Result<Solution, Violation> {
    let track_results = tracks::from_wire(required(result.tracks, "tracks")?)?;
    let track_count = track_results.weight.len();
    Ok(Solution {
        status: Status::required(result.status, "status")?,
        grade: Grade::from_wire(result.grade, "grade")?,
        method: Method::required(result.method, "method")?,
        winning_proposal: Proposal::known(result.winning_proposal),
        iterations: result.iteration_count,
        seed: result.seed,
        calibrations: result.calibrations.iter().map(calibration_from_wire).collect::<Result<_, _>>()?,
        plane_at_infinity: result.plane_at_infinity.map(|plane| [plane.x, plane.y, plane.z]),
        views: result.views.iter().enumerate().map(view_from_wire).collect::<Result<_, _>>()?,
        observations: tracks::observations_from_wire(required(result.observations, "observations")?)?,
        splits: result.track_splits.iter().enumerate().map(tracks::split_from_wire).collect::<Result<_, _>>()?,
        two_view_tracks: tracks::two_view_tracks_from_wire(&result.two_view_tracks, track_count)?,
        second_structures: second_structures::from_wire(&result.second_structures, result.views.len(), track_count)?,
        tracks: track_results,
        noise_px: result.noise_px,
        reprojection_rms_px: result.reprojection_rms_px,
        reprojection_mean_px: result.reprojection_mean_px,
        warnings: warnings_from_wire(&result.warnings),
        seconds: seconds_from_wire(result.solve_duration, "solve_duration")?,
        stages: result
            .stage_durations
            .iter()
            .filter_map(|time| Some((Stage::known(time.stage)?, time)))
            .map(|(stage, time)| {
                Ok(StageTime { stage, seconds: seconds_from_wire(time.duration, "stage_durations.duration")? })
            })
            .collect::<Result<_, Violation>>()?,
        proposal_times: result
            .proposal_durations
            .iter()
            .filter_map(|time| Some((Proposal::known(time.proposal)?, time)))
            .map(|(proposal, time)| {
                let seconds = match time.duration {
                    Some(duration) => Some(seconds_from_wire(Some(duration), "proposal_durations.duration")?),
                    None => None,
                };
                Ok(ProposalTime { proposal, seconds, steps: time.step_count })
            })
            .collect::<Result<_, Violation>>()?,
        history: result
            .progress_records
            .iter()
            .filter_map(|record| progress::from_wire(record).transpose())
            .collect::<Result<_, _>>()?,
        trained_network_sha256: digest_from_wire(&result.trained_network_sha256, "trained_network_sha256")?,
        input_content_sha256: digest_from_wire(&result.input_content_sha256, "input_content_sha256")?,
        joined_tracks: result.joined_tracks.map(tracks::joined_tracks_from_wire).transpose()?,
    })
}

fn digest_to_wire(digest: Option<Sha256Digest>) -> Vec<u8> {
    digest.map_or_else(Vec::new, |digest| digest.0.to_vec())
}

pub fn digest_from_wire(bytes: &[u8], field: &str) -> Result<Option<Sha256Digest>, Violation> {
    if bytes.is_empty() {
        return Ok(None);
    }
    let wrong = |_| Violation::of(field, format!("{} bytes are not the 32 of a SHA-256", bytes.len()));
    bytes.try_into().map(|digest| Some(Sha256Digest(digest))).map_err(wrong)
}

/// Warnings of a result or of its summary.
pub(super) fn warnings_to_wire(warnings: &[Warning]) -> Vec<proto::Warning> {
    let warning = |warning: &Warning| proto::Warning {
        code: warning.code.to_wire(),
        detail: warning.detail.clone(),
        camera_group: warning.camera_group,
    };
    warnings.iter().map(warning).collect()
}

pub(super) fn warnings_from_wire(warnings: &[proto::Warning]) -> Vec<Warning> {
    let warning = |warning: &proto::Warning| Warning {
        code: WarningCode::known(warning.code).unwrap_or(WarningCode::Unknown),
        detail: warning.detail.clone(),
        camera_group: warning.camera_group,
    };
    warnings.iter().map(warning).collect()
}

fn calibration_to_wire(calibration: &Calibration) -> proto::Calibration {
    proto::Calibration {
        camera_group: calibration.camera_group,
        focal_px: calibration.focal_px,
        sigma_log_focal: calibration.sigma_log_focal,
        principal_point_x_px: calibration.principal_point_px[0],
        principal_point_y_px: calibration.principal_point_px[1],
        aspect: calibration.aspect,
        lens_projection: calibration.lens_projection.to_wire(),
        radial_k1: calibration.radial_k1,
        radial_k2: calibration.radial_k2,
        grade: optional_to_wire(calibration.grade),
        sigma_principal_point_x_px: calibration.sigmas.principal_point_px.map(|[x, _]| x),
        sigma_principal_point_y_px: calibration.sigmas.principal_point_px.map(|[_, y]| y),
        sigma_aspect: calibration.sigmas.aspect,
        sigma_radial_k1: calibration.sigmas.radial_k1,
        sigma_radial_k2: calibration.sigmas.radial_k2,
        radial_k3: calibration.radial_k3,
        tangential_p1: calibration.tangential_p1,
        tangential_p2: calibration.tangential_p2,
        sigma_radial_k3: calibration.sigmas.radial_k3,
        sigma_tangential_p1: calibration.sigmas.tangential_p1,
        sigma_tangential_p2: calibration.sigmas.tangential_p2,
    }
}

fn calibration_from_wire(calibration: &proto::Calibration) -> Result<Calibration, Violation> {
    Ok(Calibration {
        camera_group: calibration.camera_group,
        focal_px: calibration.focal_px,
        sigma_log_focal: calibration.sigma_log_focal,
        principal_point_px: [calibration.principal_point_x_px, calibration.principal_point_y_px],
        aspect: calibration.aspect,
        lens_projection: LensProjection::from_wire(calibration.lens_projection, "calibrations.lens_projection")?
            .unwrap_or_default(),
        radial_k1: calibration.radial_k1,
        radial_k2: calibration.radial_k2,
        radial_k3: calibration.radial_k3,
        tangential_p1: calibration.tangential_p1,
        tangential_p2: calibration.tangential_p2,
        grade: Grade::from_wire(calibration.grade, "calibrations.grade")?,
        sigmas: Sigmas {
            principal_point_px: calibration
                .sigma_principal_point_x_px
                .zip(calibration.sigma_principal_point_y_px)
                .map(|(x, y)| [x, y]),
            aspect: calibration.sigma_aspect,
            radial_k1: calibration.sigma_radial_k1,
            radial_k2: calibration.sigma_radial_k2,
            radial_k3: calibration.sigma_radial_k3,
            tangential_p1: calibration.sigma_tangential_p1,
            tangential_p2: calibration.sigma_tangential_p2,
        },
    })
}

fn view_to_wire(view: &ViewResult) -> proto::ViewResult {
    proto::ViewResult {
        projection: view.projection.iter().flatten().flatten().copied().collect(),
        rotation: view.rotation.iter().flatten().flatten().copied().collect(),
        translation: view.translation.iter().flatten().copied().collect(),
        focal_px: view.focal_px,
        part: view.projection.is_some().then_some(view.part),
        camera_group: view.camera_group,
        left_out: view.left_out.map(left_out_to_wire),
        name: view.name.as_deref().unwrap_or_default().to_owned(),
    }
}

fn left_out_to_wire(left_out: LeftOut) -> proto::LeftOut {
    use proto::LeftOutReason as Reason;
    let (reason, point_count, agreeing_point_count) = match left_out {
        LeftOut::NoObservations => (Reason::NoObservations, 0, 0),
        LeftOut::OutsideBlock => (Reason::OutsideBlock, 0, 0),
        LeftOut::NotRegistered { points, agreeing } => (Reason::NotRegistered, points, agreeing),
        LeftOut::Unknown => (Reason::Unspecified, 0, 0),
    };
    proto::LeftOut { reason: reason.into(), point_count, agreeing_point_count }
}

fn left_out_from_wire(left_out: &proto::LeftOut) -> LeftOut {
    use proto::LeftOutReason as Reason;
    match left_out.reason() {
        Reason::Unspecified => LeftOut::Unknown,
        Reason::NoObservations => LeftOut::NoObservations,
        Reason::OutsideBlock => LeftOut::OutsideBlock,
        Reason::NotRegistered => {
            LeftOut::NotRegistered { points: left_out.point_count, agreeing: left_out.agreeing_point_count }
        }
    }
}

fn view_from_wire((index, view): (usize, &proto::ViewResult)) -> Result<ViewResult, Violation> {
    let wrong = |name: &str, count: usize, numbers: &[f64]| {
        Violation::at(format!("views.{name}"), index, format!("{} numbers, not 0 or {count}", numbers.len()))
    };
    Ok(ViewResult {
        name: (!view.name.is_empty()).then(|| view.name.as_str().into()),
        projection: rows(&view.projection).map_err(|()| wrong("projection", 12, &view.projection))?,
        rotation: rows(&view.rotation).map_err(|()| wrong("rotation", 9, &view.rotation))?,
        translation: match view.translation.as_slice() {
            [] => None,
            &[x, y, z] => Some([x, y, z]),
            other => return Err(wrong("translation", 3, other)),
        },
        focal_px: view.focal_px,
        part: view.part.unwrap_or(0),
        camera_group: view.camera_group,
        left_out: view.left_out.as_ref().map(left_out_from_wire),
    })
}

/// Three rows of `N` numbers each, or none at all.
pub(super) fn rows<const N: usize>(numbers: &[f64]) -> Result<Option<[[f64; N]; 3]>, ()> {
    if numbers.is_empty() {
        return Ok(None);
    }
    if numbers.len() != 3 * N {
        return Err(());
    }
    Ok(Some(std::array::from_fn(|row| std::array::from_fn(|column| numbers[N * row + column]))))
}

#[cfg(test)]
#[path = "result_tests.rs"]
mod tests;
