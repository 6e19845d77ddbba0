"""What a result is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._stubs import result_pb2
from ._wire import Floats, Word, member

__all__ = [
    "Calibration",
    "Camera",
    "Grade",
    "LeftOut",
    "ObservationResults",
    "ResultStatus",
    "ResultWarning",
    "SecondStructure",
    "Split",
    "TrackResults",
    "TwoViewTracks",
    "grade_of",
]


class ResultStatus(Word):
    """Whether a reconstruction stands. A scene that cannot be solved is a result, not a failure."""

    UNSPECIFIED = "UNSPECIFIED"
    SOLVED = "SOLVED"
    NO_RECONSTRUCTION = "NO_RECONSTRUCTION"


class Grade(Word):
    """How far a calibration can be relied on, by the standard deviation of log f."""

    UNSPECIFIED = "UNSPECIFIED"
    """There is no reconstruction to grade."""
    METRIC = "METRIC"
    """Below 0.02."""
    WEAK = "WEAK"
    """0.02 to 0.1."""
    PROJECTIVE_ONLY = "PROJECTIVE_ONLY"
    """Above 0.1, or a motion or scene that carries no calibration: only the projective part is to be used."""


def grade_of(number: int) -> Grade:
    grade: Grade = member(Grade, result_pb2.Grade, number, "GRADE_")
    return grade


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
