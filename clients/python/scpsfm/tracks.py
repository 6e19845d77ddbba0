"""Tracks of image points: what is solved.

Pixels everywhere: the centre of the top-left pixel is (0, 0), x to the right, y downwards.
"""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._stubs import input_pb2
from .errors import InvalidArgument, Violation

__all__ = ["FocalPrior", "Label", "Tracks", "View"]

Label = int | str
"""What a file calls a view or a track: a number or a name."""

MAX_SIDE_PX = 1_000_000
MAX_POSITION_PX = 1e7
MAX_NAME_BYTES = 4096
SIGMA_PX = (1e-4, 1e4)
FOCAL_PX = (1e-6, 1e9)
SIGMA_LOG = (1e-9, 1e3)
MAX_INDEX = 2**32 - 1

_CHUNK_OBSERVATIONS = 16384
_LISTED = 8


@dataclass(frozen=True)
class FocalPrior:
    """What is known of a focal length beforehand (EXIF, a guess of another system)."""

    focal_px: float
    """In pixels, 1e-6 to 1e9."""

    sigma_log: float = 0.1
    """One standard deviation of its natural logarithm, 1e-9 to 1e3. 0.1 is about ten per cent."""


@dataclass(frozen=True)
class View:
    """One image."""

    name: str = ""
    """Such as the name of its file; no two views have the same. Empty: none."""

    size: tuple[int, int] | None = None
    """Width and height in pixels. `None`: unknown; the extent of the points stands in, and the result warns of it."""

    camera_group: int = 0
    """Views of one group were taken by one camera with one constant calibration."""

    focal_prior: FocalPrior | None = None


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of tracks in views: entry k of each array is observation k.

    Made by `from_arrays`, `from_points`, `from_csv`, `from_opensfm`, `from_colmap_database`, `from_colmap_model` or
    `read`, which checks everything; a defect is an `InvalidArgument` that names field, file and line. The arrays cannot
    be written to.
    """

    _FIELD: ClassVar[str] = "track_set"

    views: tuple[View, ...]
    """One entry a view."""

    track_count: int
    """Tracks are numbered 0 to track_count - 1; some may be without observations."""

    view_index: NDArray[np.uint32]
    """View of each observation. (n,)."""

    track_index: NDArray[np.uint32]
    """Track of each observation. (n,)."""

    x: NDArray[np.float64]
    """Position of each observation in pixels. (n,)."""

    y: NDArray[np.float64]

    sigma_px: NDArray[np.float64] | None = None
    """One standard deviation of a coordinate of each observation, in pixels. (n,)."""

    depth: NDArray[np.float64] | None = None
    """Projective depth of each observation, in any common scale, which may be negative; not 0. (n,)."""

    keypoint_index: NDArray[np.int64] | None = None
    """Which keypoint of its image each observation is. Stays with the client. (n,)."""

    track_labels: tuple[Label, ...] | None = None
    """What the file calls each track; `None`: the numbers of the tracks."""

    view_labels: tuple[Label, ...] | None = None
    """What the file calls each view; `None`: the views' names, or numbers."""

    image_ids: NDArray[np.uint32] | None = None
    """COLMAP's id of each view's image, kept for exports. (number of views,)."""

    file: str | None = None
    """The file that it was read from."""

    lines: NDArray[np.int64] | None = None
    """Line of each observation in the file, counted from 1. (n,)."""

    notes: tuple[str, ...] = ()
    """What reading changed or left out, a sentence each."""

    def __post_init__(self) -> None:
        _check(self)
        object.__setattr__(self, "track_count", int(self.track_count))
        object.__setattr__(self, "views", _plain_views(self.views))

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.x)

    def __repr__(self) -> str:
        source = "" if self.file is None else f", file={self.file!r}"
        return f"Tracks({len(self.views)} views, {self.track_count} tracks, {len(self)} observations{source})"

    @property
    def xy(self) -> NDArray[np.float64]:
        """Positions in pixels. (n, 2)."""
        return np.stack([self.x, self.y], axis=1)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each view; `view-00017` where it has none and no label."""
        labels: Sequence[Label | None] = self.view_labels or (None,) * len(self.views)
        return tuple(
            view.name or (f"view-{index:05}" if label is None or isinstance(label, int) else label)
            for index, (view, label) in enumerate(zip(self.views, labels, strict=True))
        )

    @classmethod
    def from_arrays(
        cls,
        view_index: ArrayLike,
        track_index: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        *,
        views: Sequence[View] | None = None,
        track_count: int | None = None,
        width: int | None = None,
        height: int | None = None,
        names: Sequence[str] | None = None,
        camera_groups: Sequence[int] | None = None,
        focal_prior: FocalPrior | None = None,
        sigma_px: ArrayLike | None = None,
        depth: ArrayLike | None = None,
        keypoint_index: ArrayLike | None = None,
    ) -> Tracks:
        """Tracks from parallel arrays.

        Args:
            view_index: View of each observation, counted from 0. (n,).
            track_index: Track of each observation, counted from 0. (n,).
            x: Position in pixels. (n,).
            y: Position in pixels. (n,).
            views: What is known of each view; or, for all alike, the arguments from `width` to `focal_prior`.
            track_count: Number of tracks. Left out: the largest index and one.
            width: Width of every image in pixels.
            height: Height of every image in pixels.
            names: Name of each view.
            camera_groups: Camera group of each view.
            focal_prior: Of every view.
            sigma_px: One standard deviation of a coordinate of each observation, in pixels. (n,).
            depth: Projective depth of each observation. (n,).
            keypoint_index: Which keypoint of its image each observation is. (n,).

        Raises:
            InvalidArgument: What is wrong, by field and index.

        """
        views_of = _indices("view_index", view_index)
        tracks_of = _indices("track_index", track_index)
        if views is None:
            told = [len(of_view) for of_view in (names, camera_groups) if of_view is not None]
            count = max([int(views_of.max()) + 1 if len(views_of) else 0, *told])
            views = _alike(cls._FIELD, count, width, height, names, camera_groups, focal_prior)
        elif any(given is not None for given in (width, height, names, camera_groups, focal_prior)):
            raise _invalid([("views", "give either views, or width, height, names, camera_groups and focal_prior")])
        return cls(
            views=tuple(views),
            track_count=(int(tracks_of.max()) + 1 if len(tracks_of) else 0) if track_count is None else track_count,
            view_index=views_of,
            track_index=tracks_of,
            x=_numbers("x", x),
            y=_numbers("y", y),
            sigma_px=None if sigma_px is None else _numbers("sigma_px", sigma_px),
            depth=None if depth is None else _numbers("depth", depth),
            keypoint_index=None if keypoint_index is None else _keypoints(keypoint_index),
        )

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        *,
        depth: ArrayLike | None = None,
        views: Sequence[View] | None = None,
        width: int | None = None,
        height: int | None = None,
        names: Sequence[str] | None = None,
        camera_groups: Sequence[int] | None = None,
        focal_prior: FocalPrior | None = None,
    ) -> Tracks:
        """Tracks from a full array of positions, observations in the order of views and then of tracks.

        Args:
            points: Position of every track in every view in pixels; NaN where it is not observed.
                (views, tracks, 2).
            depth: Projective depth of each; NaN where it is not observed. (views, tracks).
            views: As in `from_arrays`, and so are the others.
            width: See there.
            height: See there.
            names: See there.
            camera_groups: See there.
            focal_prior: See there.

        Raises:
            InvalidArgument: What is wrong, by field and index.

        """
        try:
            positions = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise _invalid([("points", f"is no array of numbers (views, tracks, 2): {error}")]) from None
        if positions.ndim != 3 or positions.shape[2] != 2:
            raise _invalid([("points", f"has the shape {positions.shape}; (views, tracks, 2) is needed")])
        missing = np.isnan(positions)
        half = missing[..., 0] != missing[..., 1]
        if half.any():
            view, track = np.argwhere(half)[0]
            raise _invalid([(f"points[{view},{track}]", "one of the two coordinates is NaN")])
        view_index, track_index = np.nonzero(~missing[..., 0])
        depths = None
        if depth is not None:
            full = _numbers("depth", np.ravel(np.asarray(depth)))
            if np.shape(depth) != positions.shape[:2]:
                raise _invalid([("depth", f"has the shape {np.shape(depth)}; {positions.shape[:2]} is needed")])
            depths = full.reshape(positions.shape[:2])[view_index, track_index]
        if views is None:
            views = _alike(cls._FIELD, positions.shape[0], width, height, names, camera_groups, focal_prior)
        return cls.from_arrays(
            view_index,
            track_index,
            positions[view_index, track_index, 0],
            positions[view_index, track_index, 1],
            views=views,
            track_count=positions.shape[1],
            depth=depths,
        )

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        *,
        width: int | None = None,
        height: int | None = None,
        names: Mapping[int, str] | None = None,
        focal_prior: FocalPrior | None = None,
    ) -> Tracks:
        """Tracks from a table with a header `view,track,x,y[,depth][,sigma]`, one observation a line.

        Views and tracks are any whole numbers; they are put in ascending order, and the file's own are in
        `view_labels` and `track_labels`.

        Args:
            path: The file.
            width: Width of every image in pixels.
            height: Height of every image in pixels.
            names: Name of the image of each view, by the file's number of it.
            focal_prior: Of every view.

        Raises:
            InvalidArgument: What is wrong, by line and column.
            OSError: The file cannot be read.

        """
        from ._read.tables import read_csv

        return read_csv(cls, Path(path), _size(cls._FIELD, width, height), names, focal_prior)

    @classmethod
    def from_opensfm(
        cls,
        path: str | PathLike[str],
        *,
        width: int | None = None,
        height: int | None = None,
        focal_sigma_log: float | None = None,
    ) -> Tracks:
        """Tracks from OpenSfM's `tracks.csv`, or the folder of the data set that holds it.

        Sizes and cameras of the images are read from `exif/` beside it.

        Args:
            path: The file or the folder.
            width: Width in pixels of images of which the data set tells none.
            height: Height of these.
            focal_sigma_log: If given, the focal lengths in `exif/` are priors with this standard deviation of their
                logarithms.

        Raises:
            InvalidArgument: What is wrong, by line and column.
            OSError: The file cannot be read.

        """
        from ._read.tables import read_opensfm

        return read_opensfm(cls, Path(path), _size(cls._FIELD, width, height), focal_sigma_log)

    @classmethod
    def from_colmap_database(
        cls, path: str | PathLike[str], *, matches: str | None = None, focal_sigma_log: float = 0.1
    ) -> Tracks:
        """Tracks from a COLMAP database: matches of keypoints joined into tracks, the best supported first.

        A match that would put two keypoints of an image into one track is cut; `notes` tells how many were. Cameras
        whose focal length COLMAP knows beforehand give priors.

        Args:
            path: `database.db`.
            matches: `"verified"` or `"raw"`. Left out: verified ones where there are any, else raw ones.
            focal_sigma_log: Standard deviation of the logarithm of such a focal length.

        Raises:
            InvalidArgument: What is wrong, by table and row.
            OSError: The file cannot be read.

        """
        from ._read.colmap_database import read_database

        return read_database(cls, Path(path), matches, focal_sigma_log)

    @classmethod
    def from_colmap_model(cls, path: str | PathLike[str]) -> Tracks:
        """Tracks from the folder of a COLMAP sparse model: `cameras` and `images`, `.bin` or `.txt`.

        Poses, points and calibration are left alone.

        Args:
            path: The folder.

        Raises:
            InvalidArgument: What is wrong, by line or byte.
            OSError: A file cannot be read.

        """
        from ._read.colmap_model import read_model

        return read_model(cls, Path(path))

    @classmethod
    def read(cls, path: str | PathLike[str], *, width: int | None = None, height: int | None = None) -> Tracks:
        """Tracks from a file of any of these kinds, told from its name and content.

        Args:
            path: The file or folder.
            width: Width of every image in pixels, for files that carry none.
            height: Height of every image in pixels.

        Raises:
            InvalidArgument: What is wrong with the file, or with the arguments for this kind of file.
            OSError: The file cannot be read.

        """
        from ._read.detect import read_any

        return read_any(cls, Path(path), width, height)

    def with_views(self, views: Sequence[View]) -> Tracks:
        """The same observations with something else known of the views."""
        return replace(self, views=tuple(views))

    def _head(self) -> input_pb2.TrackSet:
        """The message without the arrays of observations."""
        head = input_pb2.TrackSet(track_count=self.track_count)
        _append_views(head, self.views)
        return head

    def to_proto(self) -> input_pb2.TrackSet:
        """The message of the API that holds these tracks."""
        message = self._head()
        self._append(message, 0, len(self))
        return message

    def _append(self, message: Any, begin: int, end: int) -> None:
        """Appends observations to a TrackSet or a TrackSetChunk."""
        message.view_indices.extend(self.view_index[begin:end].tolist())
        message.track_indices.extend(self.track_index[begin:end].tolist())
        message.xs.extend(self.x[begin:end].tolist())
        message.ys.extend(self.y[begin:end].tolist())
        if self.sigma_px is not None:
            message.sigmas_px.extend(self.sigma_px[begin:end].tolist())
        if self.depth is not None:
            message.depths.extend(self.depth[begin:end].tolist())

    @property
    def _longest(self) -> int:
        """Entries of the longest array of the message."""
        return len(self)

    def _chunks(self) -> Iterator[input_pb2.TrackSetChunk]:
        """The observations in messages of less than a megabyte each."""
        for begin in range(0, len(self), _CHUNK_OBSERVATIONS):
            chunk = input_pb2.TrackSetChunk()
            self._append(chunk, begin, begin + _CHUNK_OBSERVATIONS)
            yield chunk

    def _locate(self, error: InvalidArgument) -> InvalidArgument:
        """Says where in the file the first field stands that a server found fault with."""
        if self.file is None:
            return error
        error.file = self.file
        array, bracket, index = (error.field or "").rpartition(".")[2].partition("[")
        if bracket and self.lines is not None and array in _ARRAYS.values() and index[:-1].isdigit():
            observation = int(index[:-1])
            if observation < len(self.lines):
                error.line = int(self.lines[observation])
                error.args = (f"{self.file}: line {error.line}: {error.message}", *error.args[1:])
                return error
        error.args = (f"{self.file}: {error.message}", *error.args[1:])
        return error


_ARRAYS = {
    "view_index": "view_indices",
    "track_index": "track_indices",
    "x": "xs",
    "y": "ys",
    "sigma_px": "sigmas_px",
    "depth": "depths",
}
"""The arrays of observations here, and what the API calls them."""


def _append_views(head: Any, views: Sequence[View]) -> None:
    """Appends views to a TrackSet or a MatchSet."""
    for view in views:
        message = head.views.add(name=view.name, camera_group=view.camera_group)
        if view.size is not None:
            message.size.width_px, message.size.height_px = view.size
        if view.focal_prior is not None:
            message.focal_prior.focal_px = view.focal_prior.focal_px
            message.focal_prior.sigma_log = view.focal_prior.sigma_log


def _invalid(
    problems: Sequence[tuple[str, str]],
    file: str | None = None,
    line: int | None = None,
    field: str = "track_set",
) -> InvalidArgument:
    """An error of fields and what is wrong with them; the first has the line."""
    words = [f"{path}: {what}" if path else what for path, what in problems[:_LISTED]]
    if len(problems) > _LISTED:
        words.append(f"and {len(problems) - _LISTED} more")
    place = "" if file is None else f"{file}: " if line is None else f"{file}: line {line}: "
    error = InvalidArgument(
        place + "; ".join(words),
        reason="INVALID_ARGUMENT",
        violations=[Violation(f"{field}.{_api_path(path)}", what) for path, what in problems if path],
    )
    error.file, error.line = file, line
    return error


def _api_path(path: str) -> str:
    """`xs[17]` for `x[17]`: a field has one name, whoever finds fault with it."""
    array, bracket, rest = path.partition("[")
    return f"{_ARRAYS.get(array, array)}{bracket}{rest}"


def _size(field: str, width: int | None, height: int | None) -> tuple[int, int] | None:
    if (width is None) != (height is None):
        raise _invalid([("views", "width and height are given together, or neither")], field=field)
    return None if width is None or height is None else (width, height)


def _alike(
    field: str,
    count: int,
    width: int | None,
    height: int | None,
    names: Sequence[str] | None,
    camera_groups: Sequence[int] | None,
    focal_prior: FocalPrior | None,
) -> tuple[View, ...]:
    size = _size(field, width, height)
    for what, given in (("names", names), ("camera_groups", camera_groups)):
        if given is not None and len(given) != count:
            raise _invalid([(what, f"has {len(given)} entries, there are {count} views")], field=field)
    return tuple(
        View(
            name="" if names is None else names[index],
            size=size,
            camera_group=0 if camera_groups is None else camera_groups[index],
            focal_prior=focal_prior,
        )
        for index in range(count)
    )


def _indices(field: str, values: ArrayLike) -> NDArray[np.uint32]:
    """An array of indices; whole numbers of any type, floating-point ones too."""
    array = _one_row(field, values)
    if array.size == 0:
        return np.zeros(0, dtype=np.uint32)
    if array.dtype.kind not in "iuf":
        raise _invalid([(field, f"has the type {array.dtype}; whole numbers are needed")])
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero(~((array >= 0) & (array <= MAX_INDEX) & (array == np.floor(array))))
    if wrong.size:
        raise _invalid([(f"{field}[{k}]", f"{array[k]} is not a whole number from 0 to {MAX_INDEX}") for k in wrong])
    return array.astype(np.uint32)


def _keypoints(values: ArrayLike) -> NDArray[np.int64]:
    return _indices("keypoint_index", values).astype(np.int64)


def _numbers(field: str, values: ArrayLike) -> NDArray[np.float64]:
    array = _one_row(field, values)
    if array.size and array.dtype.kind not in "iufb":
        raise _invalid([(field, f"has the type {array.dtype}; numbers are needed")])
    return array.astype(np.float64)


def _one_row(field: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError:
        raise _invalid([(field, "is ragged: one number an entry is needed")]) from None
    if array.ndim != 1:
        raise _invalid([(field, f"has the shape {array.shape}; one number an observation is needed")])
    return array


def _is_control(name: str) -> bool:
    return any(unicodedata.category(character) == "Cc" for character in name)


def _plain(value: Any) -> Any:
    """A number of numpy, an array of no dimension among them, as Python's own."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value


def _is_within(value: Any, least: float, most: float) -> bool:
    value = _plain(value)
    return isinstance(value, Real) and bool(least <= float(value) <= most)


def _is_whole(value: Any, least: int, most: int) -> bool:
    return _is_within(value, least, most) and bool(value == int(value))


def _plain_views(views: Sequence[View]) -> tuple[View, ...]:
    """Views without a problem, their numbers Python's own."""

    def plain(view: View) -> View:
        size, prior = view.size, view.focal_prior
        return View(
            name=view.name,
            size=None if size is None else (int(size[0]), int(size[1])),
            camera_group=int(view.camera_group),
            focal_prior=None if prior is None else FocalPrior(float(prior.focal_px), float(prior.sigma_log)),
        )

    return tuple(plain(view) for view in views)


def _view_problems(views: Sequence[View]) -> Iterator[tuple[str, str]]:
    names: dict[str, int] = {}
    for index, view in enumerate(views):
        field = f"views[{index}]"
        if not isinstance(view, View):
            yield field, f"is {type(view).__name__}, a scpsfm.View is needed"
            continue
        if not isinstance(view.name, str):
            kind = "None" if view.name is None else type(view.name).__name__
            yield f"{field}.name", f"is {kind}, a text is needed, which is empty where there is no name"
        elif view.name:
            first = names.setdefault(view.name, index)
            if first != index:
                yield f"{field}.name", f"{view.name!r} is the name of view {first} already"
            if len(view.name.encode(errors="replace")) > MAX_NAME_BYTES:
                yield f"{field}.name", f"is longer than {MAX_NAME_BYTES} bytes"
            if _is_control(view.name):
                yield f"{field}.name", f"{view.name!r} holds control characters"
        if view.size is not None and not (isinstance(view.size, Sequence | np.ndarray) and len(view.size) == 2):
            yield f"{field}.size", f"{view.size!r} is not a width and a height"
        elif view.size is not None:
            for side, what in zip(view.size, ("width", "height"), strict=True):
                if not _is_whole(side, 1, MAX_SIDE_PX):
                    yield f"{field}.size.{what}_px", f"{side!r} is not a whole number from 1 to {MAX_SIDE_PX}"
        if not _is_whole(view.camera_group, 0, MAX_INDEX):
            yield f"{field}.camera_group", f"{view.camera_group!r} is not a whole number from 0 to {MAX_INDEX}"
        if isinstance(view.focal_prior, FocalPrior):
            for what, (least, most) in (("focal_px", FOCAL_PX), ("sigma_log", SIGMA_LOG)):
                value = getattr(view.focal_prior, what)
                if not _is_within(value, least, most):
                    yield f"{field}.focal_prior.{what}", f"{value!r} is not a number from {least:g} to {most:g}"
        elif view.focal_prior is not None:
            yield f"{field}.focal_prior", f"is {type(view.focal_prior).__name__}, a scpsfm.FocalPrior is needed"


def _check(tracks: Tracks) -> None:
    """Raises what is wrong; afterwards the arrays are read-only."""
    count = len(tracks.x)
    rows = {field: getattr(tracks, field) for field in (*_ARRAYS, "keypoint_index", "lines")}
    rows = {field: row for field, row in rows.items() if row is not None}

    def fail(problems: Sequence[tuple[str, str]], observation: int | None = None) -> InvalidArgument:
        line = None if observation is None or tracks.lines is None else int(tracks.lines[observation])
        return _invalid(problems, tracks.file, line)

    lengths = {field: len(row) for field, row in rows.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{field} has {length}" for field, length in lengths.items())
        usual = Counter(lengths.values()).most_common(1)[0][0]
        odd = next(field for field, length in lengths.items() if length != usual)
        raise fail([(odd, f"arrays of observations have one entry an observation each: {told}")])
    problems = list(_view_problems(tracks.views))
    if problems:
        raise fail(problems)
    if len(tracks.views) < 2:
        raise fail([("views", f"{len(tracks.views)} views; at least 2 are needed")])
    if count == 0:
        raise fail([("x", "there are no observations")])
    if not _is_whole(tracks.track_count, 1, MAX_INDEX):
        raise fail([("track_count", f"{tracks.track_count!r} is not a whole number from 1 to {MAX_INDEX}")])
    bounds = {"view_index": len(tracks.views), "track_index": tracks.track_count}
    for field, bound in bounds.items():
        _refuse(fail, field, rows[field], rows[field] >= bound, f"is not below {bound}, the number of them")
    for field in ("x", "y"):
        _refuse(fail, field, rows[field], ~np.isfinite(rows[field]), "is not a finite number")
        what = f"is more than {MAX_POSITION_PX:.0f} px from the origin"
        _refuse(fail, field, rows[field], np.abs(rows[field]) > MAX_POSITION_PX, what)
    if "sigma_px" in rows:
        least, most = SIGMA_PX
        wrong = ~((rows["sigma_px"] >= least) & (rows["sigma_px"] <= most))
        _refuse(fail, "sigma_px", rows["sigma_px"], wrong, f"is not from {least:g} to {most:g}")
    if "depth" in rows:
        wrong = ~np.isfinite(rows["depth"]) | (rows["depth"] == 0.0)
        _refuse(fail, "depth", rows["depth"], wrong, "is not a finite number other than 0")
    _refuse_duplicates(tracks, fail)
    if len(np.unique(tracks.view_index)) < 2:
        raise fail([("view_index", "all observations are in one view; at least 2 views with observations are needed")])
    for field, entries in (("track_labels", tracks.track_count), ("view_labels", len(tracks.views))):
        labels = getattr(tracks, field)
        if labels is not None and len(labels) != entries:
            raise fail([(field, f"has {len(labels)} entries, {entries} are needed")])
    if tracks.image_ids is not None and len(tracks.image_ids) != len(tracks.views):
        raise fail([("image_ids", f"has {len(tracks.image_ids)} entries, there are {len(tracks.views)} views")])
    for row in (*rows.values(), tracks.image_ids):
        if row is not None:
            row.setflags(write=False)


def _refuse(fail: Any, field: str, row: NDArray[Any], wrong: NDArray[np.bool_], what: str) -> None:
    places = np.flatnonzero(wrong)
    if places.size:
        raise fail([(f"{field}[{k}]", f"{row[k]} {what}") for k in places], int(places[0]))


def _refuse_duplicates(tracks: Tracks, fail: Any) -> None:
    keys = tracks.view_index.astype(np.uint64) * np.uint64(2**32) + tracks.track_index
    order = np.argsort(keys, kind="stable")
    again = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    if not again.size:
        return
    later, first = int(order[again[0] + 1]), int(order[again[0]])
    view, track = int(tracks.view_index[later]), int(tracks.track_index[later])
    view_label = view if tracks.view_labels is None else tracks.view_labels[view]
    track_label = track if tracks.track_labels is None else tracks.track_labels[track]
    where = f"observation {first}" if tracks.lines is None else f"line {tracks.lines[first]}"
    what = f"track {track_label} is observed a second time in view {view_label} (first: {where})"
    raise fail([(f"track_index[{later}]", what)], later)
