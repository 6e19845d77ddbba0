"""Keypoints of images and the matches between them: what the server joins into tracks and solves.

Pixels as in `scpsfm.tracks`: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._fields import MAX_INDEX, invalid
from ._stubs import input_pb2, result_pb2
from ._track_arrays import MAX_POSITION_PX
from ._views import FocalPrior, View, alike, append_views, plain_views, view_problems
from ._words import counted
from .errors import InternalError, InvalidArgument
from .tracks import Tracks

__all__ = ["Matches"]

_CHUNK_ENTRIES = 16384


class Matches:
    """Keypoints of images and matches between pairs of images.

    `Client.solve`, `submit` and `upload` take them in place of `Tracks`. The server joins the matches into tracks, the
    best supported first; wrong matches need no filtering. The result's `input` is the tracks: their `keypoint_index`
    says which keypoint each observation is.
    """

    _FIELD: ClassVar[str] = "match_set"

    views: tuple[View, ...]
    """One entry a view."""

    keypoints: tuple[NDArray[np.float64], ...]
    """Positions of the keypoints of each view in pixels. (n, 2) each."""

    pairs: dict[tuple[int, int], NDArray[np.uint32]]
    """Indices of the matched keypoints in the first and in the second view, for each pair of views. (m, 2) each."""

    def __init__(
        self,
        keypoints: Sequence[ArrayLike],
        pairs: Mapping[tuple[int, int], ArrayLike],
        *,
        views: Sequence[View] | None = None,
        width: int | None = None,
        height: int | None = None,
        names: Sequence[str] | None = None,
        camera_groups: Sequence[int] | None = None,
        focal_prior: FocalPrior | None = None,
    ) -> None:
        """Matches from arrays.

        Args:
            keypoints: Positions of the keypoints of each view in pixels. (n, 2) each.
            pairs: For each pair of views, such as (0, 1), the indices of the matched keypoints. (m, 2) each. Pairs
                without matches may be among them; a match that is listed twice counts once.
            views: What is known of each view; or, for all alike, the arguments from `width` to `focal_prior`.
            width: Width of every image in pixels.
            height: Height of every image in pixels.
            names: Name of each view.
            camera_groups: Camera group of each view.
            focal_prior: Of every view.

        Raises:
            InvalidArgument: What is wrong, by field and index.

        """
        self.keypoints = tuple(_positions(f"keypoints[{view}]", given) for view, given in enumerate(keypoints))
        if views is None:
            views = alike(self._FIELD, len(self.keypoints), width, height, names, camera_groups, focal_prior)
        elif any(given is not None for given in (width, height, names, camera_groups, focal_prior)):
            raise _wrong("views", "give either views, or width, height, names, camera_groups and focal_prior")
        self.views = tuple(views)
        if len(self.views) != len(self.keypoints):
            entries, of_views = counted(len(self.views), "entry"), counted(len(self.keypoints), "view")
            raise _wrong("views", f"has {entries}, there are keypoints of {of_views}")
        if len(self.views) < 2:
            raise _wrong("views", f"{counted(len(self.views), 'view')}; at least 2 are needed")
        problems = list(view_problems(self.views))
        if problems:
            raise invalid(problems, field=self._FIELD)
        self.views = plain_views(self.views)
        self.pairs = {}
        for pair, given in pairs.items():
            first, second = self._pair(pair)
            found = self._matches(f"pairs[{first},{second}]", (first, second), given)
            if len(found):
                self.pairs[first, second] = found
        if not self.pairs:
            raise _wrong("pairs", "there are no matches")
        for of_view in self.keypoints:
            of_view.setflags(write=False)
        for of_pair in self.pairs.values():
            of_pair.setflags(write=False)

    def _pair(self, pair: tuple[int, int]) -> tuple[int, int]:
        try:
            first, second = (int(view) for view in pair)
        except (TypeError, ValueError):
            raise _wrong("pairs", f"{pair!r} is no pair of views, such as (0, 1)") from None
        for view in (first, second):
            if not 0 <= view < len(self.views):
                raise _wrong(f"pairs[{first},{second}]", f"view {view} is outside the {len(self.views)} views given")
        if first == second:
            raise _wrong(f"pairs[{first},{second}]", f"view {first} is matched with itself")
        if (second, first) in self.pairs:
            raise _wrong(f"pairs[{first},{second}]", f"pairs[{second},{first}] is there already; give a pair once")
        return first, second

    def _matches(self, field: str, pair: tuple[int, int], of_pair: ArrayLike) -> NDArray[np.uint32]:
        array = _two_columns(field, of_pair)
        if array.size and array.dtype.kind not in "iu":
            raise _wrong(field, f"has the type {array.dtype}; whole numbers are needed")
        counts = np.array([len(self.keypoints[view]) for view in pair])
        wrong = np.argwhere((array < 0) | (array > MAX_INDEX) | (array >= counts))
        if wrong.size:
            match, side = wrong[0]
            what = f"{array[match, side]} is outside the {counted(int(counts[side]), 'keypoint')} of view {pair[side]}"
            raise _wrong(f"{field}[{match},{side}]", what)
        return np.unique(array.astype(np.uint32), axis=0) if array.size else np.zeros((0, 2), dtype=np.uint32)

    def __len__(self) -> int:
        """Number of matches."""
        return sum(len(found) for found in self.pairs.values())

    def __repr__(self) -> str:
        count = sum(len(of_view) for of_view in self.keypoints)
        views, keypoints, pairs = counted(len(self.views), "view"), counted(count, "keypoint"), len(self.pairs)
        return f"Matches({views}, {keypoints}, {counted(pairs, 'pair')}, {counted(len(self), 'match')})"

    def _head(self) -> input_pb2.MatchSet:
        """The message without the arrays of keypoints and matches."""
        head = input_pb2.MatchSet(keypoint_counts=[len(of_view) for of_view in self.keypoints])
        append_views(head, self.views)
        return head

    def _rows(self) -> dict[str, NDArray[Any]]:
        """The arrays of the message."""
        xy = np.concatenate(self.keypoints)
        views = np.array(list(self.pairs), dtype=np.uint32)
        found = np.concatenate(list(self.pairs.values()))
        return {
            "xs": xy[:, 0],
            "ys": xy[:, 1],
            "first_view_indices": views[:, 0],
            "second_view_indices": views[:, 1],
            "match_counts": np.array([len(of_pair) for of_pair in self.pairs.values()], dtype=np.uint32),
            "first_keypoint_indices": found[:, 0],
            "second_keypoint_indices": found[:, 1],
        }

    def to_proto(self) -> input_pb2.MatchSet:
        """The message of the API that holds these matches."""
        message = self._head()
        for field, row in self._rows().items():
            getattr(message, field).extend(row.tolist())
        return message

    @property
    def _longest(self) -> int:
        """Entries of the longest array of the message."""
        return max(len(self), sum(len(of_view) for of_view in self.keypoints))

    def _chunks(self) -> Iterator[input_pb2.MatchSetChunk]:
        """Keypoints and matches in messages of less than a megabyte each."""
        rows = self._rows()
        for begin in range(0, self._longest, _CHUNK_ENTRIES):
            chunk = input_pb2.MatchSetChunk()
            for field, row in rows.items():
                getattr(chunk, field).extend(row[begin : begin + _CHUNK_ENTRIES].tolist())
            yield chunk

    def _locate(self, error: InvalidArgument) -> InvalidArgument:
        """There is no file."""
        return error

    def _joined(self, message: result_pb2.JobResult) -> Tracks:
        """The tracks that the server joined."""
        joined = message.joined_tracks
        view, track, keypoint = (
            np.array(row, dtype=np.int64)
            for row in (joined.view_indices, joined.track_indices, joined.keypoint_indices)
        )
        starts = np.cumsum([0, *(len(of_view) for of_view in self.keypoints)])
        if not len(view) == len(track) == len(keypoint) > 0 or view.max() >= len(self.views):
            raise InternalError("the result has no tracks of these matches", reason="INVALID_RESULT")
        if (keypoint >= np.diff(starts)[view]).any():
            raise InternalError("the result has keypoints that are not there", reason="INVALID_RESULT")
        xy = np.concatenate(self.keypoints)[starts[view] + keypoint]
        return Tracks.from_arrays(view, track, xy[:, 0], xy[:, 1], views=self.views, keypoint_index=keypoint)


def _wrong(field: str, what: str) -> InvalidArgument:
    return invalid([(field, what)], field=Matches._FIELD)


def _two_columns(field: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError:
        raise _wrong(field, "is ragged: two numbers an entry are needed") from None
    if array.size == 0:
        return array.reshape(0, 2)
    if array.ndim != 2 or array.shape[1] != 2:
        raise _wrong(field, f"has the shape {array.shape}; two numbers an entry are needed")
    return array


def _positions(field: str, values: ArrayLike) -> NDArray[np.float64]:
    array = _two_columns(field, values)
    if array.size and array.dtype.kind not in "iuf":
        raise _wrong(field, f"has the type {array.dtype}; numbers are needed")
    positions = array.astype(np.float64)
    wrong = np.argwhere(~(np.abs(positions) <= MAX_POSITION_PX))
    if wrong.size:
        keypoint, axis = wrong[0]
        what = f"{positions[keypoint, axis]} is no position within {MAX_POSITION_PX:.0f} px of the origin"
        raise _wrong(f"{field}[{keypoint},{axis}]", what)
    return positions
