"""What is wrong with a file, collected, so that one reading tells of several defects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import InvalidArgument, Violation

__all__ = ["Problems", "dense", "number", "of_file", "quote", "whole"]

_LISTED = 8
_QUOTED = 40


class Problems:
    """Defects of one file by line and column."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: list[tuple[int, str, str]] = []
        self._unlisted = 0

    def add(self, line: int, column: str, what: str) -> None:
        """Notes a defect; `column` is empty where it is of the whole line."""
        if len(self._found) < _LISTED:
            self._found.append((line, column, what))
        else:
            self._unlisted += 1

    def raise_any(self) -> None:
        """Raises an `InvalidArgument` that tells of all defects, if there are any."""
        if not self._found:
            return
        said = [
            f"line {line}: {column}: {what}" if column else f"line {line}: {what}" for line, column, what in self._found
        ]
        if self._unlisted:
            said.append(f"and {self._unlisted} more")
        error = InvalidArgument(
            f"{self._path}: " + "; ".join(said),
            reason="INVALID_FILE",
            violations=[Violation(column, what) for _, column, what in self._found],
        )
        error.file, error.line = str(self._path), self._found[0][0]
        raise error


def of_file(path: Path, what: str, *, line: int | None = None, field: str = "") -> InvalidArgument:
    """One defect of a file, as an exception."""
    place = f"{path}: " if line is None else f"{path}: line {line}: "
    error = InvalidArgument(
        f"{place}{field}: {what}" if field else f"{place}{what}",
        reason="INVALID_FILE",
        violations=[Violation(field, what)] if field else [],
    )
    error.file, error.line = str(path), line
    return error


def quote(value: str) -> str:
    """A foreign value as it may stand in a message: short, control characters escaped."""
    shown = "".join(character if character.isprintable() else repr(character)[1:-1] for character in value[:_QUOTED])
    return f"`{shown}{'...' if len(value) > _QUOTED else ''}`"


def whole(text: str) -> int:
    """A whole number of 64 bits.

    Raises:
        ValueError: What is wrong with the text, in words.

    """
    if text.isascii() and text.isdigit():
        value = int(text) if len(text) <= 20 else 2**64
        if value < 2**64:
            return value
        raise ValueError(f"{quote(text)} is too large a number")
    raise ValueError("is empty" if not text else f"{quote(text)} is not a whole number >= 0")


def number(text: str) -> float:
    """A number; NaN and infinities are refused.

    Raises:
        ValueError: What is wrong with the text, in words.

    """
    if not text:
        raise ValueError("is empty; leave out the line of a point that was not observed")
    try:
        # Python also takes 1_000.
        value = float("x" if "_" in text else text)
    except ValueError:
        raise ValueError(f"{quote(text)} is not a number") from None
    if value - value != 0.0:
        raise ValueError(f"{quote(text)} is not a finite number")
    return value


def dense(labels: Sequence[int | str]) -> tuple[tuple[int | str, ...], dict[int | str, int]]:
    """The distinct labels in ascending order, numbers before names, and the position of each."""
    distinct = tuple(sorted(set(labels), key=lambda label: (isinstance(label, str), label)))
    return distinct, {label: position for position, label in enumerate(distinct)}
