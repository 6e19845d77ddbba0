"""What a message of a result holds, as arrays."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._result_parts import (
    Calibration,
    Camera,
    Grade,
    LeftOut,
    ObservationResults,
    ResultStatus,
    ResultWarning,
    SecondStructure,
    Split,
    TrackResults,
    TwoViewTracks,
    grade_of,
)
from ._stubs import progress_pb2, result_pb2, settings_pb2
from ._wire import Floats, member, optional, read_indices, read_row, read_rows, seconds, word
from .errors import InternalError
from .tracks import Tracks

__all__ = ["ResultData"]


class ResultData:
    """Everything that a solve found. Properties are computed once; arrays cannot be written to.

    Exports depend on this class, and `scpsfm.Result`, which has a method for each, on exports.
    """

    def __init__(self, message: result_pb2.JobResult, tracks: Tracks | None = None) -> None:
        """Wraps the message of the API.

        Args:
            message: What the server sent; everything that has no property here is in it.
            tracks: The input, which exports need.

        """
        self.message = message
        self.input = tracks

    def __repr__(self) -> str:
        focal = "none" if self.focal_px is None else f"{self.focal_px:.2f} px"
        return (
            f"Result({self.status}, {self.grade}, focal {focal}, {int(self.tracks.inlier.sum())} of "
            f"{len(self.tracks.inlier)} tracks right, {sum(camera.is_registered for camera in self.cameras)} of "
            f"{len(self.cameras)} views)"
        )

    @property
    def job(self) -> str:
        """Name of the job."""
        return self.message.job

    @property
    def status(self) -> ResultStatus:
        """Whether a reconstruction stands."""
        status: ResultStatus = member(ResultStatus, result_pb2.ResultStatus, self.message.status, "RESULT_STATUS_")
        return status

    @property
    def is_solved(self) -> bool:
        """Whether a reconstruction stands."""
        return self.status is ResultStatus.SOLVED

    @property
    def grade(self) -> Grade:
        """How far the calibration can be relied on: the worst of its groups that have enough views."""
        return grade_of(self.message.grade)

    @property
    def is_metric(self) -> bool:
        """Whether there are metric poses: a calibration of grade METRIC or WEAK."""
        return self.grade in (Grade.METRIC, Grade.WEAK)

    @property
    def focal_px(self) -> float | None:
        """Focal length of the first camera group with registered views, in pixels; `None` without a calibration."""
        return self._first_calibration.focal_px if self._first_calibration else None

    @property
    def sigma_log_focal(self) -> float | None:
        """One standard deviation of its natural logarithm; `None`: unobservable, or no calibration."""
        return self._first_calibration.sigma_log_focal if self._first_calibration else None

    @property
    def method(self) -> str:
        """The method that was used, such as `AUTO`."""
        return word(settings_pb2.Method, self.message.method, "METHOD_")

    @property
    def winning_proposal(self) -> str:
        """What proposed the tracks of the accepted hypothesis, such as `LEARNED`."""
        return word(result_pb2.Proposal, self.message.winning_proposal, "PROPOSAL_")

    @property
    def seed(self) -> int:
        """The seed that was used."""
        return self.message.seed

    @property
    def server_version(self) -> str:
        """Version of the server that solved it."""
        return self.message.server_version

    @property
    def noise_px(self) -> float | None:
        """Estimated observation noise: one standard deviation of a coordinate, in pixels."""
        return optional(self.message, "noise_px")

    @property
    def reprojection_rms_px(self) -> float | None:
        """Root mean square of the reprojection errors of the inlier observations, in pixels."""
        return optional(self.message, "reprojection_rms_px")

    @property
    def reprojection_mean_px(self) -> float | None:
        """Mean of the reprojection errors of the inlier observations, in pixels."""
        return optional(self.message, "reprojection_mean_px")

    @property
    def solve_seconds(self) -> float:
        """Time of the solve alone, without that in the queue."""
        return seconds(self.message.solve_duration)

    @cached_property
    def stage_seconds(self) -> dict[str, float]:
        """Time by stage, in the order in which they ran."""
        times: dict[str, float] = {}
        for entry in self.message.stage_durations:
            stage = word(progress_pb2.Stage, entry.stage, "STAGE_")
            times[stage] = times.get(stage, 0.0) + seconds(entry.duration)
        return times

    @cached_property
    def warnings(self) -> tuple[ResultWarning, ...]:
        """What must be known about the result."""
        return tuple(
            ResultWarning(
                word(result_pb2.WarningCode, found.code, "WARNING_CODE_"),
                found.detail,
                found.camera_group if found.HasField("camera_group") else None,
            )
            for found in self.message.warnings
        )

    @cached_property
    def plane_at_infinity(self) -> Floats | None:
        """(x, y, z) of the plane (x, y, z, 1) in pixels, in the frame of the projective cameras. (3,)."""
        if not self.message.HasField("plane_at_infinity"):
            return None
        plane = self.message.plane_at_infinity
        return read_row([plane.x, plane.y, plane.z], np.float64)

    @cached_property
    def calibrations(self) -> tuple[Calibration, ...]:
        """One entry a camera group with registered views, ascending; empty without a metric reconstruction."""
        return tuple(_calibration(message) for message in self.message.calibrations)

    @cached_property
    def _first_calibration(self) -> Calibration | None:
        return next(iter(self.calibrations), None)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """One entry a view of the input, registered or not."""
        calibrations = {calibration.camera_group: calibration for calibration in self.calibrations}
        cameras = []
        for index, view in enumerate(self.message.views):
            calibration = calibrations.get(view.camera_group)
            has_pose = bool(view.rotation) and calibration is not None
            own = optional(view, "focal_px")
            focal = None if calibration is None or not has_pose else own if own is not None else calibration.focal_px
            left_out = None
            if view.HasField("left_out"):
                reason = word(result_pb2.LeftOutReason, view.left_out.reason, "LEFT_OUT_REASON_")
                left_out = LeftOut(reason, view.left_out.point_count, view.left_out.agreeing_point_count)
            cameras.append(
                Camera(
                    view=index,
                    name=view.name or (self.input.views[index].name if self.input is not None else ""),
                    camera_group=view.camera_group,
                    part=view.part if view.projection else None,
                    P=read_row(view.projection, np.float64, 12, "numbers in a camera").reshape(3, 4)
                    if view.projection
                    else None,
                    K=calibration.matrix(focal) if has_pose and calibration is not None else None,
                    R=read_row(view.rotation, np.float64, 9, "numbers in a rotation").reshape(3, 3)
                    if has_pose
                    else None,
                    t=read_row(view.translation, np.float64, 3, "numbers in a translation") if has_pose else None,
                    focal_px=focal,
                    calibration=calibration,
                    left_out=left_out,
                )
            )
        return tuple(cameras)

    @cached_property
    def point_track_indices(self) -> NDArray[np.int64]:
        """The tracks that have a point, in rising order. (points,)."""
        return self._track_indices(self.message.tracks.point_track_indices, "a point")

    @cached_property
    def points(self) -> Floats:
        """X, Y, Z of each of `point_track_indices`, metric where the result is metric. (points, 3)."""
        count = len(self.point_track_indices)
        return read_row(self.message.tracks.points, np.float64, 3 * count, "coordinates of points").reshape(count, 3)

    @cached_property
    def point_parts(self) -> NDArray[np.int64]:
        """In the frame of which part each of `points` is. (points,)."""
        parts = self.message.tracks.point_parts
        count = len(self.point_track_indices)
        return read_row(parts, np.int64, count, "parts of points") if parts else read_row([0] * count, np.int64)

    @cached_property
    def tracks(self) -> TrackResults:
        """What is said of every track of the input."""
        message = self.message.tracks
        inlier = read_row(message.inliers, np.bool_)
        count = len(inlier)
        points = np.full((count, 3), np.nan)
        part = np.full(count, -1, dtype=np.int64)
        points[self.point_track_indices] = self.points
        part[self.point_track_indices] = self.point_parts
        for row in (points, part):
            row.setflags(write=False)
        network, second = message.network_weights, message.second_structure_numbers
        return TrackResults(
            weight=read_row(message.weights, np.float32, count, "weights of tracks"),
            inlier=inlier,
            network_weight=read_row(network, np.float32, count, "weights of a network") if network else None,
            second_structure_number=read_row(second or [0] * count, np.int64, count, "numbers of a second structure"),
            points=points,
            part=part,
        )

    @cached_property
    def observations(self) -> ObservationResults:
        """What is said of every observation of the input."""
        message = self.message.observations
        inlier = read_row(message.inliers, np.bool_)
        count = len(inlier)
        classified = read_row(message.classified, np.bool_, count, "verdicts")
        residual = np.array(message.residuals_px, dtype=np.float64)
        if len(residual) != count:
            raise InternalError(f"the result has {len(residual)} residuals, {count} are due", reason="INVALID_RESULT")
        residual[~classified] = np.nan
        residual.setflags(write=False)
        return ObservationResults(
            inlier=inlier,
            classified=classified,
            residual_px=residual,
            weight=read_row(message.weights, np.float32, count, "weights of observations"),
            split=read_row(message.split_numbers if message.split_numbers else [0] * count, np.int64, count, "splits"),
        )

    @cached_property
    def splits(self) -> tuple[Split, ...]:
        """The other points of tracks that join several, by track and number."""
        self._track_indices([found.track_index for found in self.message.track_splits], "several points")
        return tuple(
            Split(
                found.track_index,
                found.number,
                found.weight,
                read_row(found.point, np.float64, 3, "coordinates of a point") if found.point else None,
            )
            for found in self.message.track_splits
        )

    @cached_property
    def two_view_tracks(self) -> TwoViewTracks:
        """The tracks that two registered views of one part see and that are consistent with these."""
        found = self.message.two_view_tracks
        points = [track.point if track.point else (np.nan,) * 3 for track in found]
        row = read_row([x for point in points for x in point], np.float64, 3 * len(found), "coordinates of points")
        return TwoViewTracks(
            track=self._track_indices([track.track_index for track in found], "two views"),
            weight=read_row([track.weight for track in found], np.float32),
            part=read_row([track.part for track in found], np.int64),
            points=row.reshape(len(found), 3),
        )

    @cached_property
    def second_structures(self) -> tuple[SecondStructure, ...]:
        """The rigid motions that `SECOND_STRUCTURE` reports, by number."""
        return tuple(self._second_structure(message) for message in self.message.second_structures)

    def _second_structure(self, message: result_pb2.SecondStructure) -> SecondStructure:
        kind = word(result_pb2.SecondStructureKind, message.kind, "SECOND_STRUCTURE_KIND_")
        poses, points = message.poses, message.points
        views = [pose.view_index for pose in poses]
        return SecondStructure(
            number=message.number,
            kind=None if kind.startswith(("UNSPECIFIED", "UNKNOWN")) else kind,
            view=read_indices(views, len(self.message.views), "a second structure of a view"),
            R=read_rows([pose.rotation for pose in poses], 9, "numbers in a rotation").reshape(len(poses), 3, 3),
            t=read_rows([pose.translation for pose in poses], 3, "numbers in a translation"),
            track=self._track_indices([point.track_index for point in points], "a second structure"),
            points=read_rows([point.point for point in points], 3, "coordinates of a point"),
        )

    def _track_indices(self, values: Any, of: str) -> NDArray[np.int64]:
        return read_indices(values, len(self.message.tracks.inliers), f"{of} of a track")


def _calibration(message: result_pb2.Calibration) -> Calibration:
    lens = word(result_pb2.LensProjection, message.lens_projection, "LENS_PROJECTION_")
    if lens.startswith("UNKNOWN"):
        raise InternalError(f"the lens is of a kind that this version does not know: {lens}", reason="INVALID_RESULT")
    return Calibration(
        camera_group=message.camera_group,
        focal_px=message.focal_px,
        sigma_log_focal=optional(message, "sigma_log_focal"),
        principal_point_px=(message.principal_point_x_px, message.principal_point_y_px),
        aspect=message.aspect,
        radial=(message.radial_k1, message.radial_k2, message.radial_k3),
        tangential=(message.tangential_p1, message.tangential_p2),
        is_fisheye=lens == "FISHEYE",
        grade=grade_of(message.grade),
        sigma_principal_point_px=(
            optional(message, "sigma_principal_point_x_px"),
            optional(message, "sigma_principal_point_y_px"),
        ),
        sigma_aspect=optional(message, "sigma_aspect"),
        sigma_radial=(
            optional(message, "sigma_radial_k1"),
            optional(message, "sigma_radial_k2"),
            optional(message, "sigma_radial_k3"),
        ),
        sigma_tangential=(optional(message, "sigma_tangential_p1"), optional(message, "sigma_tangential_p2")),
    )
