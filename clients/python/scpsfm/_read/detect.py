"""What kind of input a path holds."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from .colmap_model import model_kind
from .problems import of_file

__all__ = ["Kind", "kind_of"]

Kind = Literal["csv", "opensfm", "colmap_database", "colmap_model"]

_SQLITE = b"SQLite format 3\0"
_OPENSFM = b"OPENSFM_TRACKS_VERSION"
_BELOW = ("database.db", "tracks.csv", "observations.csv", "sparse/0", "sparse")


def kind_of(path: Path, width: int | None, height: int | None) -> Kind:
    """What a path holds, told from its name and content; a size is refused where the kind carries those of images."""
    if path.is_dir():
        if model_kind(path) is None:
            found = next((name for name in _BELOW if (path / name).exists()), None)
            what = "(cameras and images, .bin or .txt)" if found is None else f"; give its {found}"
            raise of_file(path, f"is a folder without a COLMAP model {what}".replace(" ;", ";"))
        _refuse_size(path, width, height)
        return "colmap_model"
    with path.open("rb") as file:
        beginning = file.read(8192)
    stem, _, extension = path.name.lower().rpartition(".")
    if stem in ("cameras", "images", "points3d", "rigs", "frames") and extension in ("bin", "txt"):
        raise of_file(path, "is one file of a COLMAP model; give the folder that holds it")
    if beginning.startswith(_SQLITE) or path.name.lower().endswith(".db"):
        _refuse_size(path, width, height)
        return "colmap_database"
    text = beginning.removeprefix(b"\xef\xbb\xbf")
    if text.startswith(_OPENSFM) or text.split(b"\n")[0].count(b"\t") >= 7:
        return "opensfm"
    return "csv"


def _refuse_size(path: Path, width: int | None, height: int | None) -> None:
    if width is not None or height is not None:
        raise of_file(path, "carries the sizes of its images; leave out width and height")
