"""What is known of each image beforehand."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._fields import MAX_INDEX, invalid, is_whole, is_within
from ._words import counted

__all__ = [
    "MAX_SIDE_PX",
    "FocalPrior",
    "Label",
    "View",
    "alike",
    "append_views",
    "plain_views",
    "size_of",
    "view_problems",
]

Label = int | str
"""What a file calls a view or a track: a number or a name."""

MAX_SIDE_PX = 1_000_000
MAX_NAME_BYTES = 4096
FOCAL_PX = (1e-6, 1e9)
SIGMA_LOG = (1e-9, 1e3)


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


def size_of(field: str, width: int | None, height: int | None) -> tuple[int, int] | None:
    """Width and height, or neither."""
    if (width is None) != (height is None):
        raise invalid([("views", "width and height are given together, or neither")], field=field)
    return None if width is None or height is None else (width, height)


def alike(
    field: str,
    count: int,
    width: int | None,
    height: int | None,
    names: Sequence[str] | None,
    camera_groups: Sequence[int] | None,
    focal_prior: FocalPrior | None,
) -> tuple[View, ...]:
    """Views of which the same is known, but for names and camera groups."""
    size = size_of(field, width, height)
    for what, given in (("names", names), ("camera_groups", camera_groups)):
        if given is not None and len(given) != count:
            words = f"has {counted(len(given), 'entry')}, there are {counted(count, 'view')}"
            raise invalid([(what, words)], field=field)
    return tuple(
        View(
            name="" if names is None else names[index],
            size=size,
            camera_group=0 if camera_groups is None else camera_groups[index],
            focal_prior=focal_prior,
        )
        for index in range(count)
    )


def append_views(head: Any, views: Sequence[View]) -> None:
    """Appends views to a TrackSet or a MatchSet."""
    for view in views:
        message = head.views.add(name=view.name, camera_group=view.camera_group)
        if view.size is not None:
            message.size.width_px, message.size.height_px = view.size
        if view.focal_prior is not None:
            message.focal_prior.focal_px = view.focal_prior.focal_px
            message.focal_prior.sigma_log = view.focal_prior.sigma_log


def _is_control(name: str) -> bool:
    return any(unicodedata.category(character) == "Cc" for character in name)


def plain_views(views: Sequence[View]) -> tuple[View, ...]:
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


def view_problems(views: Sequence[View]) -> Iterator[tuple[str, str]]:
    """Field of each defect of views, and what is wrong."""
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
                if not is_whole(side, 1, MAX_SIDE_PX):
                    yield f"{field}.size.{what}_px", f"{side!r} is not a whole number from 1 to {MAX_SIDE_PX}"
        if not is_whole(view.camera_group, 0, MAX_INDEX):
            yield f"{field}.camera_group", f"{view.camera_group!r} is not a whole number from 0 to {MAX_INDEX}"
        if isinstance(view.focal_prior, FocalPrior):
            for what, (least, most) in (("focal_px", FOCAL_PX), ("sigma_log", SIGMA_LOG)):
                value = getattr(view.focal_prior, what)
                if not is_within(value, least, most):
                    yield f"{field}.focal_prior.{what}", f"{value!r} is not a number from {least:g} to {most:g}"
        elif view.focal_prior is not None:
            yield f"{field}.focal_prior", f"is {type(view.focal_prior).__name__}, a scpsfm.FocalPrior is needed"
