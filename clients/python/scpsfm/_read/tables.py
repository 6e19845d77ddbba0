"""Tables of observations: `view,track,x,y`, and OpenSfM's tracks.csv."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._track_arrays import Made
from .._views import MAX_SIDE_PX, FocalPrior, Label, View
from .._words import counted
from .problems import Problems, dense, number, of_file, quote, whole

__all__ = ["frame", "read_csv", "read_opensfm"]

_REQUIRED = ("view", "track", "x", "y")
_OPTIONAL = ("depth", "sigma")
_FORM = "`view,track,x,y[,depth][,sigma]`"
_SQLITE = b"SQLite format 3\0"
_OPENSFM = "OPENSFM_TRACKS_VERSION"
_OPENSFM_HEADER = "OPENSFM_TRACKS_VERSION_v"
_OPENSFM_COLUMNS = (8, 9, 11)
"""Columns of the versions 0, 1 and 2: image track feature x y [scale] r g b [segmentation instance]."""


def frame(size: tuple[int, int]) -> tuple[float, float, float]:
    """Middle of an image and the length that is 1 for OpenSfM, in pixels: (x, y, larger side)."""
    width, height = size
    return (width - 1) / 2.0, (height - 1) / 2.0, float(max(width, height))


def _lines(path: Path) -> Iterator[tuple[int, str | None]]:
    """Lines of a text file, counted from 1, without their ends; `None` for what is no text."""
    with path.open("rb") as file:
        for line, data in enumerate(file, start=1):
            if line == 1 and data.startswith((b"\xff\xfe", b"\xfe\xff")):
                raise of_file(path, "is UTF-16 text; save it as UTF-8")
            try:
                text = data.decode("utf-8-sig" if line == 1 else "utf-8").rstrip("\r\n")
            except UnicodeDecodeError:
                text = "\0"
            yield line, None if "\0" in text else text


def _unquote(field: str) -> str:
    field = field.strip()
    if len(field) >= 2 and field[0] == field[-1] == '"':
        field = field[1:-1].strip()
    return field


def read_csv(
    kind: type[Made],
    path: Path,
    size: tuple[int, int] | None,
    names: Mapping[int, str] | None,
    focal_prior: FocalPrior | None,
) -> Made:
    """Reads a table of observations, see `Tracks.from_csv`."""
    with path.open("rb") as file:
        if file.read(len(_SQLITE)) == _SQLITE:
            raise of_file(path, "is a COLMAP (SQLite) database, not a table; see Tracks.from_colmap_database")
    header: list[str] | None = None
    places: list[int] = []
    rows: dict[str, list[Any]] = {}
    lines: list[int] = []
    problems = Problems(path)
    columns: list[tuple[str, Any]] = []
    for line, text in _lines(path):
        if text is None:
            if header is None:
                raise of_file(path, "is not a text file", line=line)
            problems.add(line, "", "is not text; the file may be damaged")
            continue
        if not text.strip():
            continue
        if header is None:
            if text.startswith(_OPENSFM):
                raise of_file(path, "is an OpenSfM tracks.csv; see Tracks.from_opensfm")
            header, places = _header(path, line, text)
            quick = _quick(path, header, line)
            if quick is not None:
                return _labelled(
                    kind, path, quick, np.arange(line + 1, line + 1 + len(quick["x"])), size, names, focal_prior
                )
            columns = [(name, whole if name in ("view", "track") else number) for name in _REQUIRED]
            columns += [(name, number) for name in _OPTIONAL if name in header]
            rows = {name: [] for name, _ in columns}
            continue
        fields = text.split(",")
        if len(fields) != len(header):
            problems.add(line, "", _wrong_count(len(fields), header))
            continue
        values = []
        for (name, parse), place in zip(columns, places, strict=True):
            try:
                values.append(parse(_unquote(fields[place])))
            except ValueError as error:
                problems.add(line, name, str(error))
                break
        else:
            for (name, _), value in zip(columns, values, strict=True):
                rows[name].append(value)
            lines.append(line)
    if header is None:
        raise of_file(path, f"is empty; a header {_FORM} is needed")
    problems.raise_any()
    if not lines:
        raise of_file(path, "has a header but no observations")
    columns_of = {
        name: np.array(row, np.uint64 if parse is whole else np.float64)
        for (name, parse), row in zip(columns, rows.values(), strict=True)
    }
    return _labelled(kind, path, columns_of, np.array(lines, dtype=np.int64), size, names, focal_prior)


def _quick(path: Path, header: list[str], line: int) -> dict[str, NDArray[Any]] | None:
    """The columns of a table that is as plain as can be; `None` where it is not, or where anything is wrong.

    What is wrong is then told by whoever reads line by line, which takes ten times as long.
    """
    if set(header) - {*_REQUIRED, *_OPTIONAL}:
        return None
    kinds = np.dtype([(name, np.uint64 if name in ("view", "track") else np.float64) for name in header])
    try:
        with path.open("rb") as file:
            blocks = iter(lambda: file.read(1 << 20), b"")
            ends = last = 0
            for block in blocks:
                ends += block.count(b"\n")
                last = block[-1]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            table = np.loadtxt(path, kinds, comments=None, delimiter=",", skiprows=line, encoding="utf-8", ndmin=1)
    except (ValueError, OverflowError, Warning):
        return None
    # Blank lines have been left out: then the lines of the observations are not known.
    if len(table) == 0 or len(table) != ends - line + (last != ord("\n")):
        return None
    columns = {name: np.ascontiguousarray(table[name]) for name in header}
    if any(not np.isfinite(column).all() for column in columns.values()):
        return None
    return columns


def _labelled(
    kind: type[Made],
    path: Path,
    columns: dict[str, NDArray[Any]],
    lines: NDArray[np.int64],
    size: tuple[int, int] | None,
    names: Mapping[int, str] | None,
    focal_prior: FocalPrior | None,
) -> Made:
    """The tracks of a table, views and tracks in the ascending order of their numbers."""
    view_labels, view_index = np.unique(columns["view"], return_inverse=True)
    track_labels, track_index = np.unique(columns["track"], return_inverse=True)
    known = [int(label) for label in view_labels]
    unknown = sorted(set(names or ()) - set(known), key=str)
    if unknown:
        raise of_file(path, f"has no view {unknown[0]}, of which a name is given", field="names")
    return kind(
        views=tuple(View(name=(names or {}).get(label, ""), size=size, focal_prior=focal_prior) for label in known),
        track_count=len(track_labels),
        view_index=view_index.astype(np.uint32),
        track_index=track_index.astype(np.uint32),
        x=columns["x"],
        y=columns["y"],
        depth=columns.get("depth"),
        sigma_px=columns.get("sigma"),
        view_labels=tuple(known),
        track_labels=tuple(int(label) for label in track_labels),
        file=str(path),
        lines=lines,
    )


def _header(path: Path, line: int, text: str) -> tuple[list[str], list[int]]:
    """The names of the columns, and the places of those that are used."""
    for separator, what in (("\t", "tabs"), (";", "semicolons")):
        if separator in text and "," not in text:
            raise of_file(path, f"columns are separated by {what}; commas are needed: view,track,x,y", line=line)
    header = [_unquote(name).lower() for name in text.split(",")]
    places = []
    for name in (*_REQUIRED, *_OPTIONAL):
        if header.count(name) > 1:
            raise of_file(path, f"the header names the column `{name}` twice", line=line)
        if name in header:
            places.append(header.index(name))
        elif name in _REQUIRED:
            try:
                [float(field) for field in header]
            except ValueError:
                what = f"the header {quote(text)} has no column `{name}`; {_FORM} is needed"
            else:
                what = f"no header; the first line must be {_FORM}, not {quote(text)}"
            raise of_file(path, what, line=line)
    return header, places


def _wrong_count(count: int, header: list[str]) -> str:
    hint = ""
    if count < len(header):
        hint = "; the file may be truncated"
    elif count == len(header) + 2 + sum(name in header for name in _OPTIONAL):
        hint = "; decimals are marked by a point, not a comma"
    return f"{counted(count, 'field')} where the header has {len(header)}{hint}"


@dataclass(frozen=True)
class _Shot:
    """What is known of an image beside its points."""

    size: tuple[int, int]
    camera: str
    is_own: bool
    focal_ratio: float


def read_opensfm(kind: type[Made], path: Path, size: tuple[int, int] | None, focal_sigma_log: float | None) -> Made:
    """Reads OpenSfM's tracks.csv, see `Tracks.from_opensfm`."""
    if path.is_dir():
        path = path / "tracks.csv"
    columns = _OPENSFM_COLUMNS[0]
    shots: dict[str, _Shot | None] = {}
    images: list[str] = []
    tracks: list[Label] = []
    xs: list[float] = []
    ys: list[float] = []
    lines: list[int] = []
    features: list[int] = []
    problems = Problems(path)
    for line, text in _lines(path):
        if text is None:
            if line == 1:
                raise of_file(path, "is not a text file", line=line)
            problems.add(line, "", "is not text; the file may be damaged")
            continue
        if line == 1 and text.startswith(_OPENSFM):
            version = text.removeprefix(_OPENSFM_HEADER).strip()
            if not (version.isdigit() and int(version) < len(_OPENSFM_COLUMNS)):
                what = f"{quote(text)} is not a known version of OpenSfM's tracks; {_OPENSFM_HEADER}0 to 2 are"
                raise of_file(path, what, line=line)
            columns = _OPENSFM_COLUMNS[int(version)]
            continue
        if not text.strip():
            continue
        fields = text.split("\t")
        if len(fields) != columns:
            hint = "; the file may be truncated" if len(fields) < columns else ""
            what = f"{counted(len(fields), 'field')} where this version has {columns}, separated by tabs{hint}"
            problems.add(line, "", what)
            continue
        column = "x"
        try:
            x = number(fields[3].strip())
            column = "y"
            y = number(fields[4].strip())
            column = "image"
            image = fields[0]
            if image not in shots:
                shots[image] = None
                shots[image] = _shot(path, image, size)
            column = "track_id"
            track = _label(fields[1])
        except ValueError as error:
            problems.add(line, column, str(error))
            continue
        shot = shots[image]
        # That an image has no size is told once.
        if shot is None:
            continue
        middle_x, middle_y, side = frame(shot.size)
        images.append(image)
        tracks.append(track)
        xs.append(x * side + middle_x)
        ys.append(y * side + middle_y)
        lines.append(line)
        feature = fields[2].strip()
        features.append(int(feature) if feature.isascii() and feature.isdigit() else -1)
    problems.raise_any()
    if not lines:
        raise of_file(path, "has no observations")
    view_labels, view_of = dense(images)
    track_labels, track_of = dense(tracks)
    known = {image: shot for image, shot in shots.items() if shot is not None}
    _, group_of = dense([shot.camera for shot in known.values()])
    views = []
    for label in view_labels:
        shot = known[str(label)]
        prior = None
        if focal_sigma_log is not None and shot.focal_ratio > 0.0:
            prior = FocalPrior(shot.focal_ratio * max(shot.size), focal_sigma_log)
        views.append(View(str(label), shot.size, group_of[shot.camera], prior))
    return kind(
        views=tuple(views),
        track_count=len(track_labels),
        view_index=np.array([view_of[image] for image in images], dtype=np.uint32),
        track_index=np.array([track_of[track] for track in tracks], dtype=np.uint32),
        x=np.array(xs, dtype=np.float64),
        y=np.array(ys, dtype=np.float64),
        keypoint_index=np.array(features, dtype=np.int64),
        view_labels=view_labels,
        track_labels=track_labels,
        file=str(path),
        lines=np.array(lines, dtype=np.int64),
        notes=_size_note(list(known.values()), size),
    )


def _label(text: str) -> Label:
    """An id that is a number where it is written as numbers are, else a name."""
    if not text:
        raise ValueError("has no name")
    if text.isascii() and text.isdigit() and str(int(text)) == text and int(text) < 2**64:
        return int(text)
    return text


def _shot(tracks: Path, image: str, size: tuple[int, int] | None) -> _Shot:
    """What is known of an image that comes for the first time.

    Raises:
        ValueError: No size is known, or its file is wrong; in words.

    """
    if not image:
        raise ValueError("has no name")
    own = _exif(tracks.parent / "exif", image)
    if own is not None:
        return own
    if size is None:
        raise ValueError(f"no size is known of {quote(image)}: give width and height, or exif/IMAGE.exif")
    return _Shot(size, "", False, 0.0)


def _exif(folder: Path, image: str) -> _Shot | None:
    """What OpenSfM keeps of an image in `exif/IMAGE.exif`; `None` where there is no such file."""
    parts = PurePosixPath(image).parts
    # A name from a foreign file leads nowhere outside the folder.
    if not parts or image.startswith("/") or ".." in parts or "\\" in image:
        return None
    try:
        content = (folder / f"{image}.exif").read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"exif/{image}.exif cannot be read: {error}") from None
    try:
        values = json.loads(content)
        width, height = values["width"], values["height"]
        camera, ratio = values.get("camera") or "", values.get("focal_ratio") or 0.0
        if not all(isinstance(side, int) for side in (width, height)):
            raise TypeError("width and height are no whole numbers")
        focal_ratio = float(ratio)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"exif/{image}.exif has no width and height: {error!r}") from None
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise ValueError(f"exif/{image}.exif: {width} x {height} px is no size of an image")
    return _Shot((width, height), str(camera), True, focal_ratio)


def _size_note(shots: list[_Shot], size: tuple[int, int] | None) -> tuple[str, ...]:
    own = sum(shot.is_own for shot in shots)
    if size is None or own == 0:
        return ()
    others = f"{size[0]} x {size[1]} px"
    if own == len(shots):
        return (f"all image sizes were read from exif/; {others} was not used",)
    return (f"{own} of {len(shots)} image sizes were read from exif/; {others} is that of the others",)
