"""A COLMAP sparse model: a folder with `cameras` and `images`, both `.bin` or both `.txt`."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._track_arrays import Made
from ..errors import InvalidArgument
from .colmap import MODELS, Camera, Images
from .problems import number, of_file, quote, whole

__all__ = ["model_kind", "read_model"]

_NO_POINT = 2**64 - 1
_KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_BY_ID = {model.id: model for model in MODELS}
_BY_NAME = {model.name: model for model in MODELS}


class _Observations:
    """Observations, image after image."""

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray[Any], ...]] = []

    def add(self, image: int, points: NDArray[Any], line: int) -> None:
        """Adds those keypoints of an image that show a point."""
        index = np.flatnonzero(points["point"] != _NO_POINT)
        shown = points[index]
        xy = np.stack([shown["x"], shown["y"]], axis=1)
        count = len(index)
        images, lines = np.full(count, image, dtype=np.int64), np.full(count, line, dtype=np.int64)
        self._parts.append((images, shown["point"].astype(np.uint64), xy, index.astype(np.int64), lines))

    def columns(self) -> list[NDArray[Any]]:
        """Image, track, xy, keypoint and line of all."""
        if not self._parts:
            none = np.zeros(0, np.int64)
            return [none, np.zeros(0, np.uint64), np.zeros((0, 2)), none, none]
        return [np.concatenate(column) for column in zip(*self._parts, strict=True)]


def model_kind(folder: Path) -> str | None:
    """`bin` or `txt`, whichever files are there; `None` where the folder holds no model."""
    for kind in ("bin", "txt"):
        if all((folder / f"{table}.{kind}").is_file() for table in ("cameras", "images")):
            return kind
    return None


def read_model(kind: type[Made], folder: Path) -> Made:
    """Reads a model, see `Tracks.from_colmap_model`."""
    extension = model_kind(folder)
    if extension is None:
        if not folder.exists():
            raise FileNotFoundError(f"{folder}: there is no such folder")
        raise of_file(folder, "is no COLMAP model: cameras and images, .bin or .txt, are needed")
    cameras_path, images_path = (folder / f"{table}.{extension}" for table in ("cameras", "images"))
    images, observations = Images(), _Observations()
    if extension == "bin":
        _binary_cameras(_Bytes(cameras_path), images)
        _binary_images(_Bytes(images_path), images, observations)
        lines: NDArray[np.int64] | None = None
        image, track, xy, keypoint, _ = observations.columns()
    else:
        _text_cameras(cameras_path, images)
        _text_images(images_path, images, observations)
        image, track, xy, keypoint, lines = observations.columns()
    return images.tracks(kind, images_path, image, track, xy, keypoint, lines, [])


class _Bytes:
    """A binary file that is read from its beginning on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = path.read_bytes()
        self.offset = 0
        self.record = "its beginning"

    def wrong(self, what: str, offset: int | None = None) -> InvalidArgument:
        """An error at this byte."""
        return of_file(self.path, f"byte {self.offset if offset is None else offset}: {self.record}: {what}")

    def take(self, form: str) -> tuple[Any, ...]:
        """The next values, little-endian."""
        form = "<" + form
        end = self.offset + struct.calcsize(form)
        if end > len(self._data):
            raise self.wrong("the file ends here; it may be truncated")
        values = struct.unpack_from(form, self._data, self.offset)
        self.offset = end
        return values

    def count(self, what: str, each: int) -> int:
        """A number of records, of at least so many bytes each."""
        start = self.offset
        count: int = self.take("Q")[0]
        room = (len(self._data) - self.offset) // each
        if count > room:
            raise self.wrong(f"{count} {what} are announced, the file has room for {room}; it may be truncated", start)
        return count

    def name(self) -> str:
        """Text up to a zero byte."""
        end = self._data.find(b"\0", self.offset)
        if end < 0:
            raise self.wrong("the image's name does not end; the file may be damaged")
        try:
            name = self._data[self.offset : end].decode()
        except UnicodeDecodeError:
            raise self.wrong("the image's name is not UTF-8") from None
        self.offset = end + 1
        return name

    def array(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        """So many records."""
        rows = np.frombuffer(self._data, dtype=kind, count=count, offset=self.offset)
        self.offset += rows.nbytes
        return rows

    def end(self) -> None:
        """Nothing may follow."""
        if self.offset != len(self._data):
            raise self.wrong("the file goes on after its last record")


def _binary_cameras(data: _Bytes, images: Images) -> None:
    data.record = "the count of cameras"
    for _ in range(data.count("cameras", 24)):
        start = data.offset
        camera_id, model_id, width, height = data.take("IiQQ")
        data.record = f"camera {camera_id}"
        model = _BY_ID.get(model_id)
        if model is None:
            raise data.wrong(f"model {model_id} is not one of COLMAP's; the file may be damaged", start)
        data.take(f"{model.parameters}d")
        try:
            images.add_camera(camera_id, Camera.of(model, width, height, None, 0.0))
        except ValueError as error:
            raise data.wrong(str(error), start) from None
    data.end()


def _binary_images(data: _Bytes, images: Images, observations: _Observations) -> None:
    data.record = "the count of images"
    for _ in range(data.count("images", 73)):
        start = data.offset
        image_id, *_pose, camera_id = data.take("I7dI")
        data.record = f"image {image_id}"
        name = data.name()
        try:
            position = images.add_image(image_id, name, camera_id)
        except ValueError as error:
            raise data.wrong(str(error), start) from None
        rows = data.array(_KEYPOINT, data.count("keypoints", 24))
        for axis in ("x", "y"):
            wrong = np.flatnonzero(~np.isfinite(rows[axis]) & (rows["point"] != _NO_POINT))
            if wrong.size:
                raise data.wrong(f"keypoint {wrong[0]}: {axis} is not a finite number", start)
        observations.add(position, rows, 0)
    data.end()


def _text_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError:
        raise of_file(path, "is not a text file") from None


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _text_cameras(path: Path, images: Images) -> None:
    for place, line in enumerate(_text_lines(path), start=1):
        if _is_comment(line):
            continue
        fields = line.split()
        try:
            if len(fields) < 4:
                raise ValueError("ID MODEL WIDTH HEIGHT PARAMETERS are needed; the file may be truncated")
            model = _BY_NAME.get(fields[1])
            if model is None:
                raise ValueError(f"{quote(fields[1])} is not one of COLMAP's camera models")
            parameters = [number(field) for field in fields[4:]]
            if len(parameters) != model.parameters:
                raise ValueError(
                    f"{len(parameters)} parameters where {model.name} has {model.parameters}; the file may be truncated"
                )
            images.add_camera(whole(fields[0]), Camera.of(model, whole(fields[2]), whole(fields[3]), None, 0.0))
        except ValueError as error:
            raise of_file(path, str(error), line=place) from None


def _text_images(path: Path, images: Images, observations: _Observations) -> None:
    lines = _text_lines(path)
    place = 0
    while place < len(lines):
        line = lines[place]
        place += 1
        if _is_comment(line):
            continue
        fields = re.split(r"\s+", line.strip(), maxsplit=9)
        try:
            if len(fields) < 10:
                raise ValueError("ID QW QX QY QZ TX TY TZ CAMERA NAME are needed; the file may be truncated")
            for field in fields[1:8]:
                number(field)
            position = images.add_image(whole(fields[0]), fields[9], whole(fields[8]))
        except ValueError as error:
            raise of_file(path, str(error), line=place) from None
        # COLMAP ends the last image with a line too, be it an empty one.
        if place >= len(lines):
            raise of_file(path, f"image {fields[0]} has no line of keypoints; it may be truncated", line=place)
        try:
            rows = _text_keypoints(lines[place])
        except ValueError as error:
            raise of_file(path, f"image {fields[0]}: {error}", line=place + 1) from None
        observations.add(position, rows, place + 1)
        place += 1


def _text_keypoints(line: str) -> NDArray[Any]:
    fields = line.split()
    if len(fields) % 3:
        raise ValueError(f"keypoint {len(fields) // 3} has no `X Y POINT`; the file may be truncated")
    rows = np.zeros(len(fields) // 3, dtype=_KEYPOINT)
    for index in range(len(rows)):
        x, y, point = fields[3 * index : 3 * index + 3]
        try:
            rows[index] = number(x), number(y), _NO_POINT if point == "-1" else whole(point)
        except ValueError as error:
            raise ValueError(f"keypoint {index}: {error}") from None
    return rows
