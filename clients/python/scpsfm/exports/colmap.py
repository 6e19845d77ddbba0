"""COLMAP's database, which its mappers and GLOMAP start from.

COLMAP's pixels begin at the corner of the image: the centre of its top-left pixel is (.5, .5), where ours is (0, 0).
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._read.colmap import FIRST_PIXEL, MODELS
from .._read.colmap_database import MAX_IMAGES
from .._result_data import ResultData
from .._result_parts import Calibration
from ..tracks import FocalPrior, Tracks
from .model import check, points_of_observations, quaternion, sizes

__all__ = ["parameters", "to_colmap_database"]

_GUESSED_FOCAL = 1.2
"""COLMAP's own guess of a focal length, in units of the larger image side."""

_CALIBRATED, _UNCALIBRATED, _PANORAMIC = 2, 3, 5
"""COLMAP's kinds of two-view geometries."""

_SCHEMA = """
CREATE TABLE cameras (
    camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL, width INTEGER NOT NULL,
    height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (
    image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE TABLE keypoints (
    image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (
    pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
"""
"""The tables that every version of COLMAP from 3.8 on opens; it adds what its own version needs."""

Pairs = list[tuple[int, int, NDArray[np.uint32]]]


def to_colmap_database(tracks: Tracks, path: str | PathLike[str], result: ResultData | None = None) -> None:
    """Writes tracks as a COLMAP database: cameras, images, keypoints, matches and verified matches.

    Keypoints are the observations of each image, in the order of the input. `matches` has every pair of observations of
    a track; `two_view_geometries` those that the result calls right, or all where no result is given. With a metric
    result the cameras have its calibration (`prior_focal_length` is set), and the pairs their relative pose, essential
    and fundamental matrix.

    Args:
        tracks: The input.
        path: The file, which must not be there yet.
        result: What was found of it.

    Raises:
        FileExistsError: There is such a file.
        InvalidArgument: The result is of other tracks.
        OSError: The file cannot be written.

    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} is there already")
    if result is not None:
        check(tracks, result)
    # It takes its name once it is whole.
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with closing(sqlite3.connect(partial)) as connection, connection:
            connection.executescript(_SCHEMA)
            _write(connection, tracks, result)
        partial.rename(path)
    except sqlite3.Error as error:
        raise OSError(f"{path}: cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def parameters(calibration: Calibration, focal_px: float) -> tuple[str, list[float]]:
    """Name of COLMAP's model that holds these intrinsics, and its parameters in COLMAP's pixels."""
    fx, fy = focal_px, focal_px * calibration.aspect
    cx, cy = (centre + FIRST_PIXEL for centre in calibration.principal_point_px)
    (k1, k2, k3), (p1, p2) = calibration.radial, calibration.tangential
    terms = 3 if k3 else 2 if k2 else 1 if k1 else 0
    is_square = calibration.aspect == 1.0
    is_simple = is_square and p1 == 0.0 and p2 == 0.0
    if calibration.is_fisheye:
        if is_square and terms < 2:
            return "SIMPLE_RADIAL_FISHEYE", [fx, cx, cy, k1]
        if is_square and terms == 2:
            return "RADIAL_FISHEYE", [fx, cx, cy, k1, k2]
        # The last is a fourth term, which our model does not have.
        return "OPENCV_FISHEYE", [fx, fy, cx, cy, k1, k2, k3, 0.0]
    if terms == 3:
        # The last three are those of a denominator that our model does not have.
        return "FULL_OPENCV", [fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    if not is_simple:
        if terms == 0 and p1 == 0.0 and p2 == 0.0:
            return "PINHOLE", [fx, fy, cx, cy]
        return "OPENCV", [fx, fy, cx, cy, k1, k2, p1, p2]
    names = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    return names[terms], [fx, cx, cy, k1, k2][: 3 + terms]


def _write(connection: sqlite3.Connection, tracks: Tracks, result: ResultData | None) -> None:
    image_ids = _cameras_and_images(connection, tracks, result)
    # Which keypoint of its image each observation is.
    order = np.argsort(tracks.view_index, kind="stable")
    starts = np.searchsorted(tracks.view_index[order], np.arange(len(tracks.views) + 1))
    keypoint = np.empty(len(tracks), dtype=np.int64)
    keypoint[order] = np.arange(len(tracks)) - np.repeat(starts[:-1], np.diff(starts))
    positions = (tracks.xy + FIRST_PIXEL).astype("<f4")
    for view, image_id in enumerate(image_ids):
        rows = positions[order[starts[view] : starts[view + 1]]]
        connection.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (image_id, len(rows), rows.tobytes()))
    all_pairs = _pairs(tracks, tracks.track_index.astype(np.int64), keypoint, image_ids)
    for first, second, rows in all_pairs:
        values = (_pair_id(image_ids, first, second), len(rows), rows.astype("<u4").tobytes())
        connection.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", values)
    verified = (
        all_pairs if result is None else _pairs(tracks, points_of_observations(tracks, result), keypoint, image_ids)
    )
    for first, second, rows in verified:
        values = (_pair_id(image_ids, first, second), len(rows), rows.astype("<u4").tobytes())
        geometry = _geometry(result, first, second)
        connection.execute("INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, ?, ?, ?, ?, ?, ?)", values + geometry)


def _cameras_and_images(connection: sqlite3.Connection, tracks: Tracks, result: ResultData | None) -> list[int]:
    """Writes cameras and images; returns the id of the image of each view."""
    by_name = {model.name: model.id for model in MODELS}
    all_sizes = sizes(tracks, result)
    image_ids = list(range(1, len(tracks.views) + 1)) if tracks.image_ids is None else tracks.image_ids.tolist()
    known: dict[Any, int] = {}
    for view, (image_id, name) in enumerate(zip(image_ids, tracks.names, strict=True)):
        camera = None if result is None else result.cameras[view]
        calibration = None if camera is None else camera.calibration
        focal = None if camera is None else camera.focal_px
        if calibration is not None and focal is None:
            focal = calibration.focal_px
        prior = tracks.views[view].focal_prior
        key = (tracks.views[view].camera_group, all_sizes[view], focal, None if calibration is not None else prior)
        if key not in known:
            known[key] = len(known) + 1
            is_known = calibration is not None or prior is not None
            model, values = _camera(all_sizes[view], calibration, focal, prior)
            row = (known[key], by_name[model], *all_sizes[view], np.array(values, "<f8").tobytes(), int(is_known))
            connection.execute("INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", row)
        connection.execute("INSERT INTO images VALUES (?, ?, ?)", (image_id, name, known[key]))
    return image_ids


def _camera(
    size: tuple[int, int], calibration: Calibration | None, focal_px: float | None, prior: FocalPrior | None
) -> tuple[str, list[float]]:
    if calibration is not None and focal_px is not None:
        return parameters(calibration, focal_px)
    focal = _GUESSED_FOCAL * max(size) if prior is None else prior.focal_px
    return "SIMPLE_RADIAL", [focal, size[0] / 2.0, size[1] / 2.0, 0.0]


def _pair_id(image_ids: list[int], first: int, second: int) -> int:
    """COLMAP's number of a pair of views, the first having the smaller id."""
    return image_ids[first] * MAX_IMAGES + image_ids[second]


def _pairs(tracks: Tracks, points: NDArray[np.int64], keypoint: NDArray[np.int64], image_ids: list[int]) -> Pairs:
    """For each two views that see points together, in COLMAP's order, the keypoints that do. (n, 2) each.

    Args:
        tracks: The input.
        points: Which point each observation shows; -1: none. (n,).
        keypoint: Which keypoint of its image each observation is. (n,).
        image_ids: COLMAP's id of each view's image.

    """
    ranks = np.argsort(np.argsort(image_ids))
    by_rank = np.argsort(image_ids)
    shown = np.flatnonzero(points >= 0)
    shown = shown[np.lexsort((ranks[tracks.view_index[shown]], points[shown]))]
    _, starts, lengths = np.unique(points[shown], return_index=True, return_counts=True)
    found = []
    for length in np.unique(lengths):
        if length < 2:
            continue
        # Observations of all points of one length at once. (points, length).
        rows = shown[starts[lengths == length][:, None] + np.arange(length)]
        first, second = np.triu_indices(length, 1)
        a, b = rows[:, first].ravel(), rows[:, second].ravel()
        views = ranks[tracks.view_index[a]], ranks[tracks.view_index[b]]
        found.append(np.stack([*views, keypoint[a], keypoint[b]], axis=1))
    if not found:
        return []
    table = np.concatenate(found)
    # An observation of a point of its own and one of another of the same track are in one view once at most.
    table = table[np.lexsort((table[:, 3], table[:, 2], table[:, 1], table[:, 0]))]
    new = np.flatnonzero(np.any(np.diff(table[:, :2], axis=0) != 0, axis=1)) + 1
    return [
        (int(by_rank[block[0, 0]]), int(by_rank[block[0, 1]]), block[:, 2:].astype(np.uint32))
        for block in np.split(table, new)
    ]


def _geometry(result: ResultData | None, first: int, second: int) -> tuple[Any, ...]:
    """Kind, F, E, H, rotation and translation of a pair of views, as COLMAP's columns."""
    if result is None:
        return (_UNCALIBRATED, None, None, None, None, None)
    a, b = result.cameras[first], result.cameras[second]
    if a.R is None or b.R is None or a.t is None or b.t is None or a.K is None or b.K is None or a.part != b.part:
        return (_UNCALIBRATED, None, None, None, None, None)
    rotation = b.R @ a.R.T
    translation = b.t - rotation @ a.t
    length = float(np.linalg.norm(translation))
    kind = _CALIBRATED
    if length > 0.0:
        translation = translation / length
    else:
        kind = _PANORAMIC
    x, y, z = translation
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    shift = np.array([[1.0, 0.0, FIRST_PIXEL], [0.0, 1.0, FIRST_PIXEL], [0.0, 0.0, 1.0]])
    to_first, to_second = np.linalg.inv(shift @ a.K), np.linalg.inv(shift @ b.K)
    fundamental = to_second.T @ essential @ to_first
    homography = shift @ b.K @ rotation @ to_first

    def blob(matrix: NDArray[np.float64]) -> bytes:
        return np.ascontiguousarray(matrix, dtype="<f8").tobytes()

    return (
        kind,
        blob(fundamental),
        blob(essential),
        blob(homography),
        blob(quaternion(rotation)),
        blob(translation),
    )


def pairs_of(path: str | PathLike[str], table: str = "two_view_geometries") -> Iterator[tuple[int, int, int]]:
    """Ids of the images of each pair of a database, and the number of its matches; for looking at what was written."""
    if table not in ("matches", "two_view_geometries"):
        raise ValueError(f"{table!r} has no pairs")
    with closing(sqlite3.connect(path)) as connection:
        for pair_id, rows in connection.execute(f"SELECT pair_id, rows FROM {table} ORDER BY pair_id"):
            yield (*divmod(pair_id, MAX_IMAGES), rows)
