"""The arrays that tracks are made of, and what must hold of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ._fields import ARRAYS, MAX_INDEX, invalid, is_whole
from ._views import Label, View, plain_views, view_problems
from ._words import counted
from .errors import InvalidArgument

__all__ = ["MAX_POSITION_PX", "Made", "TrackArrays"]

MAX_POSITION_PX = 1e7
SIGMA_PX = (1e-4, 1e4)


@dataclass(frozen=True, eq=False)
class TrackArrays:
    """Observations of tracks in views: entry k of each array is observation k. The base of `scpsfm.Tracks`.

    Readers of files depend on this class, and `Tracks`, which has a constructor for each kind of file, on readers.
    """

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
        object.__setattr__(self, "views", plain_views(self.views))

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.x)

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


Made = TypeVar("Made", bound=TrackArrays)
"""The class that a reader is to make: that which it was called for."""


def _check(tracks: TrackArrays) -> None:
    """Raises what is wrong; afterwards the arrays are read-only."""
    count = len(tracks.x)
    rows = {field: getattr(tracks, field) for field in (*ARRAYS, "keypoint_index", "lines")}
    rows = {field: row for field, row in rows.items() if row is not None}

    def fail(problems: Sequence[tuple[str, str]], observation: int | None = None) -> InvalidArgument:
        line = None if observation is None or tracks.lines is None else int(tracks.lines[observation])
        return invalid(problems, tracks.file, line)

    lengths = {field: len(row) for field, row in rows.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{field} has {length}" for field, length in lengths.items())
        usual = Counter(lengths.values()).most_common(1)[0][0]
        odd = next(field for field, length in lengths.items() if length != usual)
        raise fail([(odd, f"arrays of observations have one entry an observation each: {told}")])
    problems = list(view_problems(tracks.views))
    if problems:
        raise fail(problems)
    if len(tracks.views) < 2:
        raise fail([("views", f"{counted(len(tracks.views), 'view')}; at least 2 are needed")])
    if count == 0:
        raise fail([("x", "there are no observations")])
    if not is_whole(tracks.track_count, 1, MAX_INDEX):
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
            raise fail([(field, f"has {counted(len(labels), 'entry')} where {entries} are needed")])
    if tracks.image_ids is not None and len(tracks.image_ids) != len(tracks.views):
        held = counted(len(tracks.image_ids), "entry")
        raise fail([("image_ids", f"has {held}, there are {len(tracks.views)} views")])
    for row in (*rows.values(), tracks.image_ids):
        if row is not None:
            row.setflags(write=False)


def _refuse(fail: Any, field: str, row: NDArray[Any], wrong: NDArray[np.bool_], what: str) -> None:
    places = np.flatnonzero(wrong)
    if places.size:
        raise fail([(f"{field}[{k}]", f"{row[k]} {what}") for k in places], int(places[0]))


def _refuse_duplicates(tracks: TrackArrays, fail: Any) -> None:
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
