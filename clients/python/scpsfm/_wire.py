"""Values of the API's messages as Python's and numpy's own."""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InternalError

__all__ = ["Floats", "Word", "member", "optional", "read_indices", "read_row", "read_rows", "seconds", "word"]

Floats = NDArray[np.float64]


class Word(str, Enum):
    """An enum whose members equal their names."""

    def __str__(self) -> str:
        return str(self.value)


def word(enum: Any, number: int, prefix: str) -> str:
    """Name of an enum's value without its prefix; `UNKNOWN_99` for one that a later server has."""
    value = enum.DESCRIPTOR.values_by_number.get(number)
    return f"UNKNOWN_{number}" if value is None else str(value.name).removeprefix(prefix)


def member(kind: Any, enum: Any, number: int, prefix: str) -> Any:
    try:
        return kind(word(enum, number, prefix))
    except ValueError:
        return kind.UNSPECIFIED


def optional(message: Any, field: str) -> float | None:
    """A field of a message that may be left out."""
    return float(getattr(message, field)) if message.HasField(field) else None


def seconds(duration: Any) -> float:
    """A google.protobuf.Duration in seconds."""
    return float(duration.seconds) + float(duration.nanos) * 1e-9


def read_row(values: Any, kind: Any, expected: int | None = None, what: str = "") -> NDArray[Any]:
    """An array of a type, of the expected length where there is one, that cannot be written to."""
    array = np.array(values, dtype=kind)
    if expected is not None and len(array) != expected:
        raise InternalError(f"the result has {len(array)} {what} where {expected} are due", reason="INVALID_RESULT")
    array.setflags(write=False)
    return array


def read_indices(values: Any, count: int, what: str) -> NDArray[np.int64]:
    """Indices of views or tracks, of which there are `count`."""
    array = read_row(values, np.int64)
    if array.size and int(array.max()) >= count:
        raise InternalError(f"the result has {what} beyond its {count}", reason="INVALID_RESULT")
    return array


def read_rows(values: Any, width: int, what: str) -> Floats:
    """Rows of `width` numbers each. (n, width)."""
    array = np.array([read_row(row, np.float64, width, what) for row in values], dtype=np.float64).reshape(-1, width)
    array.setflags(write=False)
    return array
