"""Results as the files of other programs."""

from .colmap import to_colmap_database
from .nerfstudio import to_nerfstudio
from .opensfm import to_opensfm

__all__ = ["to_colmap_database", "to_nerfstudio", "to_opensfm"]
