"""Arguments as they come from callers, and the errors that name what is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InvalidArgument, Violation

__all__ = ["ARRAYS", "MAX_INDEX", "indices", "invalid", "is_whole", "is_within", "keypoints", "numbers", "plain"]

MAX_INDEX = 2**32 - 1

_LISTED = 8

ARRAYS = {
    "view_index": "view_indices",
    "track_index": "track_indices",
    "x": "xs",
    "y": "ys",
    "sigma_px": "sigmas_px",
    "depth": "depths",
}
"""The arrays of observations here, and what the API calls them."""


def invalid(
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
    return f"{ARRAYS.get(array, array)}{bracket}{rest}"


def indices(field: str, values: ArrayLike) -> NDArray[np.uint32]:
    """An array of indices; whole numbers of any type, floating-point ones too."""
    array = _one_row(field, values)
    if array.size == 0:
        return np.zeros(0, dtype=np.uint32)
    if array.dtype.kind not in "iuf":
        raise invalid([(field, f"has the type {array.dtype}; whole numbers are needed")])
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero(~((array >= 0) & (array <= MAX_INDEX) & (array == np.floor(array))))
    if wrong.size:
        raise invalid([(f"{field}[{k}]", f"{array[k]} is not a whole number from 0 to {MAX_INDEX}") for k in wrong])
    return array.astype(np.uint32)


def keypoints(values: ArrayLike) -> NDArray[np.int64]:
    """Indices of keypoints."""
    return indices("keypoint_index", values).astype(np.int64)


def numbers(field: str, values: ArrayLike) -> NDArray[np.float64]:
    """An array of numbers."""
    array = _one_row(field, values)
    if array.size and array.dtype.kind not in "iufb":
        raise invalid([(field, f"has the type {array.dtype}; numbers are needed")])
    return array.astype(np.float64)


def _one_row(field: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError:
        raise invalid([(field, "is ragged: one number an entry is needed")]) from None
    if array.ndim != 1:
        raise invalid([(field, f"has the shape {array.shape}; one number an observation is needed")])
    return array


def plain(value: Any) -> Any:
    """A number of numpy, an array of no dimension among them, as Python's own."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value


def is_within(value: Any, least: float, most: float) -> bool:
    """Whether a value is a number of this range."""
    value = plain(value)
    return isinstance(value, Real) and bool(least <= float(value) <= most)


def is_whole(value: Any, least: int, most: int) -> bool:
    """Whether a value is a whole number of this range."""
    return is_within(value, least, most) and bool(value == int(value))
