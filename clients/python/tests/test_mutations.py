"""Files that were damaged at random are read, or refused in words: nothing else ever happens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import scpsfm
from scpsfm import Tracks

from . import scene
from .test_files import binary_model, database, opensfm, text_model

TEXT = b'0123456789,.-+eE \t\n"naif_\x00\xff\xc3'


def mutate(rng: np.random.Generator, data: bytes, is_text: bool) -> bytes:
    """One to four changes: bytes exchanged, removed, doubled or cut off."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if not changed:
            break
        at = int(rng.integers(0, len(changed)))
        length = int(rng.integers(1, 12))
        kind = int(rng.integers(0, 5))
        if kind == 0:
            changed[at] = TEXT[rng.integers(0, len(TEXT))] if is_text else int(rng.integers(0, 256))
        elif kind == 1:
            del changed[at : at + length]
        elif kind == 2:
            changed[at:at] = changed[at : at + length]
        elif kind == 3:
            changed[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\xf0\x7f"])
        elif rng.integers(0, 4) == 0:
            del changed[at:]
    return bytes(changed)


def table(folder: Path) -> Path:
    return scene.write_csv(scene.make(seed=1, views=3, tracks=12).tracks, folder / "o.csv")


def quoted(folder: Path) -> Path:
    path = folder / "o.csv"
    path.write_text('view,track,x,y,sigma,note\n0,0,1,2,.5,a\n1,0,"3",4,.5,b\n\n0,1,5,6,.5,\n1,1,7,8,.5,c\n')
    return path


CASES: list[tuple[str, Callable[[Path], Path], str, bool, int]] = [
    ("table", table, "", True, 300),
    ("quoted", quoted, "", True, 300),
    ("opensfm", opensfm, "", True, 300),
    ("exif", opensfm, "../exif/a.jpg.exif", True, 200),
    ("cameras.txt", text_model, "cameras.txt", True, 200),
    ("images.txt", text_model, "images.txt", True, 300),
    ("cameras.bin", binary_model, "cameras.bin", False, 300),
    ("images.bin", binary_model, "images.bin", False, 500),
    ("database", lambda folder: database(folder / "database.db"), "", False, 500),
]


@pytest.mark.parametrize(("name", "make", "file", "is_text", "rounds"), CASES, ids=[case[0] for case in CASES])
def test_damaged_files_are_read_or_refused(
    tmp_path: Path, name: str, make: Callable[[Path], Path], file: str, is_text: bool, rounds: int
) -> None:
    path = make(tmp_path)
    damaged = path if not file else (path / file if path.is_dir() else (path / file).resolve())
    if file.startswith(".."):
        damaged = tmp_path / file.removeprefix("../")
    whole = damaged.read_bytes()
    seed = 17
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    read = refused = 0
    for number in range(rounds):
        damaged.write_bytes(mutate(rng, whole, is_text))
        try:
            tracks = Tracks.read(path)
        except scpsfm.InvalidArgument as error:
            assert error.file is not None, number
            assert str(tmp_path) in str(error), number
            assert "\n" not in str(error), number
            refused += 1
        else:
            assert len(tracks) > 0
            assert np.isfinite(tracks.xy).all()
            read += 1
    assert refused > rounds // 10
    assert read > 0
