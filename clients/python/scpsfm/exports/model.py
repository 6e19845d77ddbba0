"""What all exports share: cameras by group and size, posed images, and points that images see."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .._result_data import ResultData
from .._result_parts import Calibration, Camera
from .._words import counted
from ..errors import FailedPrecondition, InvalidArgument, Violation
from ..tracks import Label, Tracks

__all__ = ["Intrinsics", "Model", "check", "colour", "models", "points_of_observations", "quaternion", "sizes"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Intrinsics:
    """A camera as exports name it: a group's calibration for images of one size."""

    id: int
    """Counted from 1; COLMAP's own where the input came from it."""

    size: tuple[int, int]
    focal_px: float
    calibration: Calibration


@dataclass(frozen=True)
class Model:
    """One part of a metric result."""

    part: int
    cameras: tuple[Intrinsics, ...]
    views: tuple[Camera, ...]
    """The posed views."""

    camera_of: tuple[int, ...]
    """Index into `cameras` of each of `views`."""

    names: tuple[str, ...]
    """Name of the image of each of `views`."""

    result: ResultData
    tracks: Tracks

    @cached_property
    def points(self) -> list[tuple[Label, Floats, float]]:
        """Name, position and weight of each point that two of the views see or more; those of the tracks first."""
        posed = np.zeros(len(self.tracks.views), dtype=bool)
        posed[[view.view for view in self.views]] = True
        place = points_of_observations(self.tracks, self.result)
        shown = place[(place >= 0) & posed[self.tracks.view_index]]
        count = self.tracks.track_count
        seen = np.bincount(shown, minlength=count + len(self.result.splits))
        labels = self.tracks.track_labels
        found: list[tuple[Label, Floats, float]] = []
        in_part = (self.result.tracks.part == self.part) & (seen[:count] >= 2)
        for track in np.flatnonzero(in_part).tolist():
            label: Label = track if labels is None else labels[track]
            found.append((label, self.result.tracks.points[track], float(self.result.tracks.weight[track])))
        for index, split in enumerate(self.result.splits):
            if (
                split.point is not None
                and seen[count + index] >= 2
                and self.result.tracks.part[split.track]
                in (
                    -1,
                    self.part,
                )
            ):
                own = split.track if labels is None else labels[split.track]
                found.append((f"{own}+{split.number}", split.point, split.weight))
        return found


def check(tracks: Tracks, result: ResultData) -> None:
    """Raises an `InvalidArgument` where a result is not one of these tracks."""
    told = (len(result.cameras), len(result.tracks.inlier), len(result.observations.inlier))
    given = (len(tracks.views), tracks.track_count, len(tracks))
    if told != given:
        views, track_count, observations = (
            counted(count, noun) for count, noun in zip(told, ("view", "track", "observation"), strict=True)
        )
        what = f"is of {views}, {track_count} and {observations}, the tracks have {given}"
        raise InvalidArgument(f"result: {what}", reason="INVALID_ARGUMENT", violations=[Violation("result", what)])


def sizes(tracks: Tracks, result: ResultData | None = None) -> list[tuple[int, int]]:
    """Size of every image; of an unknown one, that which has the principal point or the points in it."""
    found = []
    for index, view in enumerate(tracks.views):
        if view.size is not None:
            found.append((int(view.size[0]), int(view.size[1])))
            continue
        calibration = None if result is None else result.cameras[index].calibration
        if calibration is not None:
            x, y = calibration.principal_point_px
            found.append((max(1, round(2.0 * x) + 1), max(1, round(2.0 * y) + 1)))
            continue
        # One size for all that are unknown, as the service takes it.
        found.append((max(1, int(np.ceil(tracks.x.max())) + 1), max(1, int(np.ceil(tracks.y.max())) + 1)))
    return found


def points_of_observations(tracks: Tracks, result: ResultData) -> NDArray[np.int64]:
    """Which point each observation shows.

    The index of its track for the track's own, behind all tracks the position among the splits for another; -1: none.
    (n,).
    """
    place = np.where(result.observations.inlier, tracks.track_index.astype(np.int64), -1)
    numbers = {(split.track, split.number): index for index, split in enumerate(result.splits)}
    for k in np.flatnonzero(result.observations.split > 0).tolist():
        index = numbers.get((int(tracks.track_index[k]), int(result.observations.split[k])))
        if index is not None:
            place[k] = tracks.track_count + index
    return place


def models(tracks: Tracks, result: ResultData) -> list[Model]:
    """The parts of a metric result, the largest first.

    Raises:
        FailedPrecondition: The result has no metric poses.

    """
    check(tracks, result)
    posed = [camera for camera in result.cameras if camera.is_registered and camera.R is not None]
    if not result.is_metric or not posed:
        raise FailedPrecondition(
            f"the result is {result.grade} and has {len(posed)} metric poses; cameras are exported of metric ones only",
            reason="NOT_METRIC",
        )
    return [
        _model(tracks, result, part, [camera for camera in posed if camera.part == part])
        for part in sorted({camera.part for camera in posed if camera.part is not None})
    ]


def _model(tracks: Tracks, result: ResultData, part: int, posed: list[Camera]) -> Model:
    all_sizes = sizes(tracks, result)
    names = tracks.names
    has_own_focal = any(view.HasField("focal_px") for view in result.message.views)
    known: dict[tuple[int, tuple[int, int], int], int] = {}
    cameras: list[Intrinsics] = []
    camera_of = []
    for view in posed:
        key = (view.camera_group, all_sizes[view.view], view.view if has_own_focal else -1)
        if key not in known:
            known[key] = len(cameras)
            calibration, focal = view.calibration, view.focal_px
            # A view with a rotation has both.
            assert calibration is not None and focal is not None
            cameras.append(Intrinsics(len(cameras) + 1, all_sizes[view.view], focal, calibration))
        camera_of.append(known[key])
    return Model(
        part, tuple(cameras), tuple(posed), tuple(camera_of), tuple(names[view.view] for view in posed), result, tracks
    )


def quaternion(rotation: Floats) -> Floats:
    """A rotation as a unit quaternion (w, x, y, z) with w >= 0. (4,)."""
    m = rotation
    # The quaternion is the eigenvector of the largest eigenvalue: nothing is divided by what may be near 0.
    k = (
        np.array(
            [
                [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
                [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
                [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
                [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
            ]
        )
        / 3.0
    )
    q: Floats = np.linalg.eigh(k)[1][:, -1]
    return -q if q[0] < 0.0 else q


def colour(weight: float) -> tuple[int, int, int]:
    """A point's colour: from red for a weight of 0 to green for 1."""
    share = min(1.0, max(0.0, weight))
    return round(255 * (1.0 - share)), round(255 * share), 64
