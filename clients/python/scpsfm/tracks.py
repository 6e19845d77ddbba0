"""Tracks of image points: what is solved.

Pixels everywhere: the centre of the top-left pixel is (0, 0), x to the right, y downwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ._fields import ARRAYS, indices, invalid, keypoints, numbers
from ._read.colmap_database import read_database
from ._read.colmap_model import read_model
from ._read.detect import kind_of
from ._read.tables import read_csv, read_opensfm
from ._stubs import input_pb2
from ._track_arrays import TrackArrays
from ._views import FocalPrior, Label, View, alike, append_views, size_of
from ._words import counted
from .errors import InvalidArgument

__all__ = ["FocalPrior", "Label", "Tracks", "View"]

_CHUNK_OBSERVATIONS = 16384


@dataclass(frozen=True, eq=False)
class Tracks(TrackArrays):
    """Observations of tracks in views: entry k of each array is observation k.

    Made by `from_arrays`, `from_points`, `from_csv`, `from_opensfm`, `from_colmap_database`, `from_colmap_model` or
    `read`, which checks everything; a defect is an `InvalidArgument` that names field, file and line. The arrays cannot
    be written to.
    """

    _FIELD: ClassVar[str] = "track_set"

    def __repr__(self) -> str:
        source = "" if self.file is None else f", file={self.file!r}"
        views, tracks = counted(len(self.views), "view"), counted(self.track_count, "track")
        return f"Tracks({views}, {tracks}, {counted(len(self), 'observation')}{source})"

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
        views_of = indices("view_index", view_index)
        tracks_of = indices("track_index", track_index)
        if views is None:
            told = [len(of_view) for of_view in (names, camera_groups) if of_view is not None]
            count = max([int(views_of.max()) + 1 if len(views_of) else 0, *told])
            views = alike(cls._FIELD, count, width, height, names, camera_groups, focal_prior)
        elif any(given is not None for given in (width, height, names, camera_groups, focal_prior)):
            raise invalid([("views", "give either views, or width, height, names, camera_groups and focal_prior")])
        return cls(
            views=tuple(views),
            track_count=(int(tracks_of.max()) + 1 if len(tracks_of) else 0) if track_count is None else track_count,
            view_index=views_of,
            track_index=tracks_of,
            x=numbers("x", x),
            y=numbers("y", y),
            sigma_px=None if sigma_px is None else numbers("sigma_px", sigma_px),
            depth=None if depth is None else numbers("depth", depth),
            keypoint_index=None if keypoint_index is None else keypoints(keypoint_index),
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
            raise invalid([("points", f"is no array of numbers (views, tracks, 2): {error}")]) from None
        if positions.ndim != 3 or positions.shape[2] != 2:
            raise invalid([("points", f"has the shape {positions.shape}; (views, tracks, 2) is needed")])
        missing = np.isnan(positions)
        half = missing[..., 0] != missing[..., 1]
        if half.any():
            view, track = np.argwhere(half)[0]
            raise invalid([(f"points[{view},{track}]", "one of the two coordinates is NaN")])
        view_index, track_index = np.nonzero(~missing[..., 0])
        depths = None
        if depth is not None:
            full = numbers("depth", np.ravel(np.asarray(depth)))
            if np.shape(depth) != positions.shape[:2]:
                raise invalid([("depth", f"has the shape {np.shape(depth)}; {positions.shape[:2]} is needed")])
            depths = full.reshape(positions.shape[:2])[view_index, track_index]
        if views is None:
            views = alike(cls._FIELD, positions.shape[0], width, height, names, camera_groups, focal_prior)
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
        return read_csv(cls, Path(path), size_of(cls._FIELD, width, height), names, focal_prior)

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
        return read_opensfm(cls, Path(path), size_of(cls._FIELD, width, height), focal_sigma_log)

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
        match kind_of(Path(path), width, height):
            case "colmap_model":
                return cls.from_colmap_model(path)
            case "colmap_database":
                return cls.from_colmap_database(path)
            case "opensfm":
                return cls.from_opensfm(path, width=width, height=height)
            case "csv":
                return cls.from_csv(path, width=width, height=height)

    def with_views(self, views: Sequence[View]) -> Tracks:
        """The same observations with something else known of the views."""
        return replace(self, views=tuple(views))

    def _head(self) -> input_pb2.TrackSet:
        """The message without the arrays of observations."""
        head = input_pb2.TrackSet(track_count=self.track_count)
        append_views(head, self.views)
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
        if bracket and self.lines is not None and array in ARRAYS.values() and index[:-1].isdigit():
            observation = int(index[:-1])
            if observation < len(self.lines):
                error.line = int(self.lines[observation])
                error.args = (f"{self.file}: line {error.line}: {error.message}", *error.args[1:])
                return error
        error.args = (f"{self.file}: {error.message}", *error.args[1:])
        return error
