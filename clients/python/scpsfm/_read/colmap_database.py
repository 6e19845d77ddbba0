"""A COLMAP database (SQLite): keypoints, and matches joined into tracks."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote as url_quote

import numpy as np
from numpy.typing import NDArray

from .._fields import MAX_INDEX
from .._track_arrays import Made
from .._words import counted
from .colmap import MODELS, Camera, Images
from .join import join
from .problems import of_file

__all__ = ["MAX_IMAGES", "read_database"]

MAX_IMAGES = 2_147_483_647
"""COLMAP's numbering of pairs: first * MAX_IMAGES + second, first < second."""

_TABLES = {"verified": "two_view_geometries", "raw": "matches"}
_BY_ID = {model.id: model for model in MODELS}


def read_database(kind: type[Made], path: Path, matches: str | None, sigma_log: float) -> Made:
    """Reads a database, see `Tracks.from_colmap_database`."""
    if matches is not None and matches not in _TABLES:
        raise of_file(path, f"{matches!r} is neither 'verified' nor 'raw'", field="matches")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    for suffix in ("-wal", "-journal"):
        journal = path.with_name(path.name + suffix)
        if journal.exists() and journal.stat().st_size > 0:
            raise of_file(
                path, f"{journal.name} beside it says that a change is under way or was broken off: let COLMAP end"
            )
    # Nobody else writes while this reads, so no lock and no file beside it is needed.
    uri = f"file:{url_quote(str(path.absolute()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            connection.execute("PRAGMA trusted_schema = 0")
            return _read(connection, kind, path, matches, sigma_log)
    except (sqlite3.Error, UnicodeDecodeError) as error:
        # The words of an error may name what the damaged file calls its tables.
        raise of_file(path, f"cannot be read as a COLMAP database: {error}") from None


def _read(connection: sqlite3.Connection, kind: type[Made], path: Path, matches: str | None, sigma_log: float) -> Made:
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
    tables = {name for (name,) in connection.execute(query)}
    for table in ("cameras", "images", "keypoints"):
        if table not in tables:
            raise of_file(path, f"is no COLMAP database: it has no table `{table}`")
    images = Images()
    _cameras(connection, path, images, sigma_log)
    _images(connection, path, images)
    starts, points = _keypoints(connection, path, images)
    for choice in [matches] if matches is not None else ["verified", "raw"]:
        if _TABLES[choice] not in tables:
            raise of_file(path, f"is no COLMAP database: it has no table `{_TABLES[choice]}`")
        found, pairs = _matches(connection, path, _TABLES[choice], images, starts)
        if len(found):
            image_of = (np.searchsorted(starts, np.arange(len(points)), side="right") - 1).astype(np.int64)
            joined = join(found, image_of)
            note = (
                f"joined {counted(len(found), f'{choice} match')} of {counted(pairs, 'image pair')} into "
                f"{counted(joined.tracks, 'track')}; cut {counted(joined.cut, 'match')}, which would have put two "
                "keypoints of one image into one track"
            )
            image = image_of[joined.keypoints]
            return images.tracks(
                kind,
                path,
                image,
                joined.track.astype(np.uint64),
                points[joined.keypoints].astype(np.float64),
                joined.keypoints - starts[image],
                None,
                [note],
            )
    if matches == "verified":
        raise of_file(path, "holds no verified matches; let COLMAP verify them, or take the others with matches='raw'")
    raise of_file(path, "holds no matches; let COLMAP match its images first")


def _integer(path: Path, table: str, row: Any, column: str, value: Any, most: int = 2**63 - 1) -> int:
    if not isinstance(value, int):
        raise of_file(path, f"table {table}, row {row}: {column}: {type(value).__name__} is no whole number")
    if not 0 <= value <= most:
        raise of_file(path, f"table {table}, row {row}: {column}: {value} is out of range")
    return value


def _cameras(connection: sqlite3.Connection, path: Path, images: Images, sigma_log: float) -> None:
    query = "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id"
    for camera_id, model_id, width, height, parameters, is_known in connection.execute(query):
        camera_id = _integer(path, "cameras", camera_id, "camera_id", camera_id, MAX_INDEX)
        width = _integer(path, "cameras", camera_id, "width", width)
        height = _integer(path, "cameras", camera_id, "height", height)
        focal_px = None
        if is_known and isinstance(parameters, bytes) and len(parameters) >= 8:
            (focal_px,) = struct.unpack_from("<d", parameters)
        try:
            model = _BY_ID.get(model_id) if isinstance(model_id, int) else None
            images.add_camera(camera_id, Camera.of(model, width, height, focal_px, sigma_log))
        except ValueError as error:
            raise of_file(path, f"table cameras, row {camera_id}: {error}") from None


def _images(connection: sqlite3.Connection, path: Path, images: Images) -> None:
    for image_id, camera_id, name in connection.execute("SELECT image_id, camera_id, name FROM images ORDER BY 1"):
        image_id = _integer(path, "images", image_id, "image_id", image_id, MAX_INDEX)
        camera_id = _integer(path, "images", image_id, "camera_id", camera_id, MAX_INDEX)
        if not isinstance(name, str):
            raise of_file(path, f"table images, row {image_id}: name: {type(name).__name__} is no text")
        try:
            images.add_image(image_id, name, camera_id)
        except ValueError as error:
            raise of_file(path, f"table images, row {image_id}: {error}") from None


def _matrix(path: Path, table: str, row: Any, rows: Any, columns: Any, data: Any, kind: str) -> NDArray[Any]:
    """A matrix of four-byte numbers, of which the first two columns are taken. (rows, 2)."""
    rows = _integer(path, table, row, "rows", rows)
    columns = _integer(path, table, row, "cols", columns)
    data = b"" if data is None else data
    if not isinstance(data, bytes):
        raise of_file(path, f"table {table}, row {row}: data: {type(data).__name__} is no blob")
    if rows > 0 and columns < 2:
        raise of_file(path, f"table {table}, row {row}: data: has {counted(columns, 'column')}, at least 2 are needed")
    if rows * columns * 4 != len(data):
        what = f"has {len(data)} bytes, {rows} x {columns} numbers of 4 are announced"
        raise of_file(path, f"table {table}, row {row}: data: {what}")
    if rows == 0:
        return np.zeros((0, 2), dtype=kind)
    return np.frombuffer(data, dtype=kind).reshape(rows, columns)[:, :2]


def _keypoints(
    connection: sqlite3.Connection, path: Path, images: Images
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Number of the first keypoint of each image, and all of them in COLMAP's pixels. (images + 1,), (n, 2)."""
    of_image = [np.zeros((0, 2), dtype="<f4")] * len(images)
    for image_id, rows, columns, data in connection.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        position = images.position(image_id)
        if position is None:
            raise of_file(path, f"table keypoints, row {image_id}: is of no image of the table images")
        of_image[position] = _matrix(path, "keypoints", image_id, rows, columns, data, "<f4")
    starts = np.zeros(len(images) + 1, dtype=np.int64)
    np.cumsum([len(points) for points in of_image], out=starts[1:])
    return starts, np.concatenate([np.zeros((0, 2), dtype="<f4"), *of_image])


def _pairs(connection: sqlite3.Connection, table: str) -> Iterator[Any]:
    # The name is one of ours.
    yield from connection.execute(f"SELECT pair_id, rows, cols, data FROM {table} WHERE rows <> 0 ORDER BY pair_id")


def _matches(
    connection: sqlite3.Connection, path: Path, table: str, images: Images, starts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Matched keypoints, numbered over all images, with the size of their pair, (n, 3); and the number of pairs."""
    found = []
    for pair_id, rows, columns, data in _pairs(connection, table):
        pair_id = _integer(path, table, pair_id, "pair_id", pair_id)
        first_id, second_id = divmod(pair_id, MAX_IMAGES)
        first, second = images.position(first_id), images.position(second_id)
        if first is None or second is None:
            what = f"is of the images {first_id} and {second_id}, which the table images does not have"
            raise of_file(path, f"table {table}, row {pair_id}: {what}")
        if first == second:
            raise of_file(path, f"table {table}, row {pair_id}: matches image {first_id} with itself")
        pair = _matrix(path, table, pair_id, rows, columns, data, "<u4").astype(np.int64)
        counts = np.diff(starts)[[first, second]]
        wrong = np.flatnonzero((pair >= counts).any(axis=1))
        if wrong.size:
            a, b = pair[wrong[0]]
            what = f"match {wrong[0]} joins keypoints {a} and {b}; one is not there"
            raise of_file(path, f"table {table}, row {pair_id}: {what}")
        sizes = np.full((len(pair), 1), len(pair), dtype=np.int64)
        found.append(np.hstack([pair + starts[[first, second]], sizes]))
    return (np.concatenate(found) if found else np.zeros((0, 3), dtype=np.int64)), len(found)
