"""What a solve found, as arrays.

Pixels: the centre of the top-left pixel is (0, 0). A metric pose takes a point X of the reconstruction to K (R X + t),
up to the lens's distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from ._stubs import progress_pb2, result_pb2, settings_pb2
from .errors import InternalError, InvalidArgument

if TYPE_CHECKING:
    from .tracks import Tracks

__all__ = [
    "Calibration",
    "Camera",
    "Grade",
    "LeftOut",
    "ObservationResults",
    "Result",
    "ResultStatus",
    "ResultWarning",
    "SecondStructure",
    "Split",
    "TrackResults",
    "TwoViewTracks",
]

Floats = NDArray[np.float64]


class _Word(str, Enum):
    """An enum whose members equal their names."""

    def __str__(self) -> str:
        return str(self.value)


class ResultStatus(_Word):
    """Whether a reconstruction stands. A scene that cannot be solved is a result, not a failure."""

    UNSPECIFIED = "UNSPECIFIED"
    SOLVED = "SOLVED"
    NO_RECONSTRUCTION = "NO_RECONSTRUCTION"


class Grade(_Word):
    """How far a calibration can be relied on, by the standard deviation of log f."""

    UNSPECIFIED = "UNSPECIFIED"
    """There is no reconstruction to grade."""
    METRIC = "METRIC"
    """Below 0.02."""
    WEAK = "WEAK"
    """0.02 to 0.1."""
    PROJECTIVE_ONLY = "PROJECTIVE_ONLY"
    """Above 0.1, or a motion or scene that carries no calibration: only the projective part is to be used."""


def word(enum: Any, number: int, prefix: str) -> str:
    """Name of an enum's value without its prefix; `UNKNOWN_99` for one that a later server has."""
    value = enum.DESCRIPTOR.values_by_number.get(number)
    return f"UNKNOWN_{number}" if value is None else str(value.name).removeprefix(prefix)


def _member(kind: Any, enum: Any, number: int, prefix: str) -> Any:
    try:
        return kind(word(enum, number, prefix))
    except ValueError:
        return kind.UNSPECIFIED


def _grade(number: int) -> Grade:
    grade: Grade = _member(Grade, result_pb2.Grade, number, "GRADE_")
    return grade


def optional(message: Any, field: str) -> float | None:
    """A field of a message that may be left out."""
    return float(getattr(message, field)) if message.HasField(field) else None


def seconds(duration: Any) -> float:
    """A google.protobuf.Duration in seconds."""
    return float(duration.seconds) + float(duration.nanos) * 1e-9


def _row(values: Any, kind: Any, expected: int | None = None, what: str = "") -> NDArray[Any]:
    array = np.array(values, dtype=kind)
    if expected is not None and len(array) != expected:
        raise InternalError(f"the result has {len(array)} {what} where {expected} are due", reason="INVALID_RESULT")
    array.setflags(write=False)
    return array


def _below(values: Any, count: int, what: str) -> NDArray[np.int64]:
    """Indices of views or tracks, of which there are `count`."""
    array = _row(values, np.int64)
    if array.size and int(array.max()) >= count:
        raise InternalError(f"the result has {what} beyond its {count}", reason="INVALID_RESULT")
    return array


def _rows(values: Any, width: int, what: str) -> Floats:
    array = np.array([_row(row, np.float64, width, what) for row in values], dtype=np.float64).reshape(-1, width)
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class ResultWarning:
    """What a caller must know about a result."""

    code: str
    """For programs, such as `PLANAR_SCENE`."""

    detail: str
    """In words; views by their numbers."""

    camera_group: int | None = None
    """The camera group that it is of; `None`: of the result as a whole, or of cameras solved as one."""

    def __str__(self) -> str:
        return f"{self.code}: {self.detail}"


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of one camera group: zero skew, at most three radial and two tangential coefficients of distortion.

    A point at (u, v, 1) in camera coordinates is imaged at x = f (u s + 2 p1 u v + p2 (r^2 + 2 u^2)) + px,
    y = aspect f (v s + p1 (r^2 + 2 v^2) + 2 p2 u v) + py with r^2 = u^2 + v^2 and s = 1 + k1 r^2 + k2 r^4 + k3 r^6:
    OpenCV's model. Behind a fisheye s = t (1 + k1 t^2 + k2 t^4 + k3 t^6) / r with t = atan r, and p1 = p2 = 0.
    """

    camera_group: int
    """The group that it is of."""

    focal_px: float
    """Horizontal focal length in pixels."""

    sigma_log_focal: float | None
    """One standard deviation of its natural logarithm; `None`: unobservable."""

    principal_point_px: tuple[float, float]

    aspect: float
    """Vertical over horizontal focal length."""

    radial: tuple[float, float, float]
    """k1, k2, k3."""

    tangential: tuple[float, float]
    """p1, p2."""

    is_fisheye: bool
    grade: Grade

    sigma_principal_point_px: tuple[float | None, float | None] = (None, None)
    """One standard deviation of each; `None`: it was not estimated. The same holds for those below."""

    sigma_aspect: float | None = None
    sigma_radial: tuple[float | None, float | None, float | None] = (None, None, None)
    sigma_tangential: tuple[float | None, float | None] = (None, None)

    def matrix(self, focal_px: float | None = None) -> Floats:
        """The calibration matrix K, in pixels. (3, 3).

        Args:
            focal_px: A view's own focal length instead of the group's.

        """
        focal = self.focal_px if focal_px is None else focal_px
        x, y = self.principal_point_px
        return np.array([[focal, 0.0, x], [0.0, focal * self.aspect, y], [0.0, 0.0, 1.0]])

    def distort(self, points: Floats) -> Floats:
        """Where the lens puts points of unit depth: what K then takes to pixels.

        Args:
            points: (u, v) in camera coordinates. (n, 2).

        """
        u, v = points[:, 0], points[:, 1]
        squared = u * u + v * v
        k1, k2, k3 = self.radial
        if self.is_fisheye:
            radius = np.sqrt(squared)
            angle = np.arctan(radius)
            square = angle * angle
            scale = np.where(radius > 0.0, angle / np.where(radius > 0.0, radius, 1.0), 1.0)
            scale = scale * (1.0 + square * (k1 + square * (k2 + square * k3)))
            return np.stack([u * scale, v * scale], axis=1)
        scale = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
        p1, p2 = self.tangential
        return np.stack(
            [
                u * scale + 2.0 * p1 * u * v + p2 * (squared + 2.0 * u * u),
                v * scale + p1 * (squared + 2.0 * v * v) + 2.0 * p2 * u * v,
            ],
            axis=1,
        )


@dataclass(frozen=True)
class LeftOut:
    """Why a view is not registered."""

    reason: str
    """`NO_OBSERVATIONS`, `OUTSIDE_BLOCK` or `NOT_REGISTERED`."""

    point_count: int
    """Of a view that was not registered: points of the reconstruction that it sees, 0 for too few to try."""

    agreeing_point_count: int
    """How many of them agreed on a pose."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One view of a result."""

    view: int
    """Number of the view."""

    name: str
    """Name of its image, as in the input; empty: none."""

    camera_group: int

    part: int | None
    """Which reconstruction it belongs to, the largest being 0; parts have frames and scales of their own. `None`: the
    view is not registered."""

    P: Floats | None
    """Projective camera in pixels, in the frame P1 = [I|0] of the first registered view of the part. (3, 4).

    `None`: the view is not registered."""

    K: Floats | None
    """Calibration matrix in pixels. (3, 3). `None`: no metric pose."""

    R: Floats | None
    """Rotation of the metric pose, x ~ K (R X + t). (3, 3)."""

    t: Floats | None
    """Translation of it, in the reconstruction's own scale. (3,)."""

    focal_px: float | None
    """Focal length in pixels, the view's own where every view has one."""

    calibration: Calibration | None
    """Of its group, with the distortion of the lens."""

    left_out: LeftOut | None
    """Why it is not registered; `None`: it is, or nothing was reconstructed."""

    @property
    def is_registered(self) -> bool:
        """Whether it has a projective camera."""
        return self.P is not None

    @property
    def center(self) -> Floats | None:
        """Where it stands in the frame of the points, -R^T t. (3,)."""
        if self.R is None or self.t is None:
            return None
        center: Floats = -self.R.T @ self.t
        return center

    def project(self, points: Floats) -> Floats:
        """Where metric points are imaged in pixels, with the lens's distortion. (n, 2).

        Args:
            points: In the frame of the camera's part. (n, 3).

        Raises:
            ValueError: The camera has no metric pose.

        """
        if self.R is None or self.t is None or self.K is None or self.calibration is None:
            raise ValueError(f"view {self.view} has no metric pose")
        seen = np.asarray(points, dtype=np.float64) @ self.R.T + self.t
        distorted = self.calibration.distort(seen[:, :2] / seen[:, 2:])
        pixels: Floats = distorted @ self.K[:2, :2].T + self.K[:2, 2]
        return pixels


@dataclass(frozen=True, eq=False)
class TrackResults:
    """What is said of every track of the input: entry j of an array is track j."""

    weight: NDArray[np.float32]
    """Probability that the track is right, 0 to 1. (tracks,)."""

    inlier: NDArray[np.bool_]
    """Whether the track is right. (tracks,)."""

    network_weight: NDArray[np.float32] | None
    """What a network says of the track by itself, 0 to 1; `None`: none ran. (tracks,)."""

    second_structure_number: NDArray[np.int64]
    """Which of the motions that `SECOND_STRUCTURE` reports a rejected track agrees with, from 1; 0: none. (tracks,)."""

    points: Floats
    """X, Y, Z of each track; NaN where it has no point. (tracks, 3)."""

    part: NDArray[np.int64]
    """In whose frame the point is; -1 where it has none. (tracks,)."""


@dataclass(frozen=True, eq=False)
class ObservationResults:
    """What is said of every observation: entry k of an array is observation k of the input."""

    inlier: NDArray[np.bool_]
    classified: NDArray[np.bool_]
    """Whether it was classified; residual and verdict have no meaning otherwise."""

    residual_px: Floats
    """Reprojection error (distance) in pixels; NaN where it was not classified."""

    weight: NDArray[np.float32]
    """Probability that it shows its track's point, if the track is right."""

    split: NDArray[np.int64]
    """0, or which of the other points that its track joins it shows: see `Split.number`."""


@dataclass(frozen=True, eq=False)
class Split:
    """A point beside its own that a track shows, where a wrong link joined two."""

    track: int
    number: int
    """From 1 within a track."""

    weight: float
    """Probability that the point is right."""

    point: Floats | None
    """(3,); `None`: at infinity."""


@dataclass(frozen=True, eq=False)
class TwoViewTracks:
    """The tracks that two registered views of one part see: consistent with these, not verified."""

    track: NDArray[np.int64]
    """Index of each, in rising order. (tracks,)."""

    weight: NDArray[np.float32]
    """Probability that the track is right by its residuals and by the share of right ones among others. (tracks,)."""

    part: NDArray[np.int64]
    """The part whose views see it. (tracks,)."""

    points: Floats
    """X, Y, Z in the frame of that part; NaN at infinity. (tracks, 3)."""


@dataclass(frozen=True, eq=False)
class SecondStructure:
    """A rigid motion of its own, of tracks that are no inliers.

    Poses and points are in a frame and a scale of the structure's own. With the pose (R, t) of a view in the scene and
    its pose (Rs, ts) against the structure, a point X of the structure is at R^T (s (Rs X + ts) - t) in the scene at
    that view, for a positive scale s, the same for all views, that images do not determine.
    """

    number: int
    """As `TrackResults.second_structure_number` has it, from 1."""

    kind: str | None
    """`MOVING_BODY` (it stands still between less than a fifth of all pairs of its views) or `REPEATED_STRUCTURE`
    (between a fifth or more: copies of one part of the scene, or a body that stood still for a while).

    `None`: fewer than three views have poses, or this version does not know the kind."""

    view: NDArray[np.int64]
    """Index of each view that has a pose in its frame, in rising order. (views,). Empty without a metric result, and
    where its tracks make no reconstruction under the calibration."""

    R: Floats
    """Rotation of each, x ~ K (R X + t). (views, 3, 3)."""

    t: Floats
    """Translation of each. (views, 3)."""

    track: NDArray[np.int64]
    """Index of each track that has a point, in rising order. (points,)."""

    points: Floats
    """X, Y, Z of each of these. (points, 3)."""


class Result:
    """Everything that a solve found. Properties are computed once; arrays cannot be written to."""

    def __init__(self, message: result_pb2.JobResult, tracks: Tracks | None = None) -> None:
        """Wraps the message of the API.

        Args:
            message: What the server sent; everything that has no property here is in it.
            tracks: The input, which exports need.

        """
        self.message = message
        self.input = tracks

    @classmethod
    def load(cls, path: str | PathLike[str], tracks: Tracks | None = None) -> Result:
        """A result that `save` wrote.

        Args:
            path: The file.
            tracks: The input, which exports need.

        Raises:
            InvalidArgument: The file is no such result.
            OSError: It cannot be read.

        """
        try:
            return cls(result_pb2.JobResult.FromString(Path(path).read_bytes()), tracks)
        except DecodeError as error:
            raise InvalidArgument(f"{path}: is no saved result: {error}", reason="INVALID_FILE") from None

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the result as the server sent it (an encoded scpsfm.v1.JobResult)."""
        Path(path).write_bytes(self.message.SerializeToString())

    def with_tracks(self, tracks: Tracks) -> Result:
        """The same result, of this input."""
        return Result(self.message, tracks)

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
        status: ResultStatus = _member(ResultStatus, result_pb2.ResultStatus, self.message.status, "RESULT_STATUS_")
        return status

    @property
    def is_solved(self) -> bool:
        """Whether a reconstruction stands."""
        return self.status is ResultStatus.SOLVED

    @property
    def grade(self) -> Grade:
        """How far the calibration can be relied on: the worst of its groups that have enough views."""
        return _grade(self.message.grade)

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
        return _row([plane.x, plane.y, plane.z], np.float64)

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
                    P=_row(view.projection, np.float64, 12, "numbers in a camera").reshape(3, 4)
                    if view.projection
                    else None,
                    K=calibration.matrix(focal) if has_pose and calibration is not None else None,
                    R=_row(view.rotation, np.float64, 9, "numbers in a rotation").reshape(3, 3) if has_pose else None,
                    t=_row(view.translation, np.float64, 3, "numbers in a translation") if has_pose else None,
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
        return _row(self.message.tracks.points, np.float64, 3 * count, "coordinates of points").reshape(count, 3)

    @cached_property
    def point_parts(self) -> NDArray[np.int64]:
        """In the frame of which part each of `points` is. (points,)."""
        parts = self.message.tracks.point_parts
        count = len(self.point_track_indices)
        return _row(parts, np.int64, count, "parts of points") if parts else _row([0] * count, np.int64)

    @cached_property
    def tracks(self) -> TrackResults:
        """What is said of every track of the input."""
        message = self.message.tracks
        inlier = _row(message.inliers, np.bool_)
        count = len(inlier)
        points = np.full((count, 3), np.nan)
        part = np.full(count, -1, dtype=np.int64)
        points[self.point_track_indices] = self.points
        part[self.point_track_indices] = self.point_parts
        for row in (points, part):
            row.setflags(write=False)
        network, second = message.network_weights, message.second_structure_numbers
        return TrackResults(
            weight=_row(message.weights, np.float32, count, "weights of tracks"),
            inlier=inlier,
            network_weight=_row(network, np.float32, count, "weights of a network") if network else None,
            second_structure_number=_row(second or [0] * count, np.int64, count, "numbers of a second structure"),
            points=points,
            part=part,
        )

    @cached_property
    def observations(self) -> ObservationResults:
        """What is said of every observation of the input."""
        message = self.message.observations
        inlier = _row(message.inliers, np.bool_)
        count = len(inlier)
        classified = _row(message.classified, np.bool_, count, "verdicts")
        residual = np.array(message.residuals_px, dtype=np.float64)
        if len(residual) != count:
            raise InternalError(f"the result has {len(residual)} residuals, {count} are due", reason="INVALID_RESULT")
        residual[~classified] = np.nan
        residual.setflags(write=False)
        return ObservationResults(
            inlier=inlier,
            classified=classified,
            residual_px=residual,
            weight=_row(message.weights, np.float32, count, "weights of observations"),
            split=_row(message.split_numbers if message.split_numbers else [0] * count, np.int64, count, "splits"),
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
                _row(found.point, np.float64, 3, "coordinates of a point") if found.point else None,
            )
            for found in self.message.track_splits
        )

    @cached_property
    def two_view_tracks(self) -> TwoViewTracks:
        """The tracks that two registered views of one part see and that are consistent with these."""
        found = self.message.two_view_tracks
        points = [track.point if track.point else (np.nan,) * 3 for track in found]
        row = _row([x for point in points for x in point], np.float64, 3 * len(found), "coordinates of points")
        return TwoViewTracks(
            track=self._track_indices([track.track_index for track in found], "two views"),
            weight=_row([track.weight for track in found], np.float32),
            part=_row([track.part for track in found], np.int64),
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
            view=_below(views, len(self.message.views), "a second structure of a view"),
            R=_rows([pose.rotation for pose in poses], 9, "numbers in a rotation").reshape(len(poses), 3, 3),
            t=_rows([pose.translation for pose in poses], 3, "numbers in a translation"),
            track=self._track_indices([point.track_index for point in points], "a second structure"),
            points=_rows([point.point for point in points], 3, "coordinates of a point"),
        )

    def _track_indices(self, values: Any, of: str) -> NDArray[np.int64]:
        return _below(values, len(self.message.tracks.inliers), f"{of} of a track")

    def to_colmap_database(self, path: str | PathLike[str]) -> None:
        """Writes a COLMAP database of the right observations; see `scpsfm.to_colmap_database`."""
        from .exports import to_colmap_database

        to_colmap_database(self._with_input(), path, self)

    def to_nerfstudio(self, path: str | PathLike[str], *, part: int = 0, images: str = "images") -> None:
        """Writes nerfstudio's `transforms.json` into a folder; see `scpsfm.to_nerfstudio`."""
        from .exports import to_nerfstudio

        to_nerfstudio(self._with_input(), path, self, part=part, images=images)

    def to_opensfm(self, path: str | PathLike[str]) -> None:
        """Writes OpenSfM's `reconstruction.json` into a folder; see `scpsfm.to_opensfm`."""
        from .exports import to_opensfm

        to_opensfm(self._with_input(), path, self)

    def _with_input(self) -> Tracks:
        if self.input is None:
            raise InvalidArgument("exports need the input: result.with_tracks(tracks)", reason="NO_INPUT")
        return self.input


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
        grade=_grade(message.grade),
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
