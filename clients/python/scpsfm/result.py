"""What a solve found, as arrays.

Pixels: the centre of the top-left pixel is (0, 0). A metric pose takes a point X of the reconstruction to K (R X + t),
up to the lens's distortion.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from google.protobuf.message import DecodeError

from ._result_data import ResultData
from ._result_parts import (
    Calibration,
    Camera,
    Grade,
    LeftOut,
    ObservationResults,
    ResultStatus,
    ResultWarning,
    SecondStructure,
    Split,
    TrackResults,
    TwoViewTracks,
)
from ._stubs import result_pb2
from .errors import InvalidArgument
from .exports import to_colmap_database, to_nerfstudio, to_opensfm
from .tracks import Tracks

__all__ = [
    "Calibration",
    "Camera",
    "Grade",
    "LeftOut",
    "ObservationResults",
    "Result",
    "ResultStatus",
    "ResultWarning",
    "SecondStructure",
    "Split",
    "TrackResults",
    "TwoViewTracks",
]


class Result(ResultData):
    """Everything that a solve found. Properties are computed once; arrays cannot be written to."""

    @classmethod
    def load(cls, path: str | PathLike[str], tracks: Tracks | None = None) -> Result:
        """A result that `save` wrote.

        Args:
            path: The file.
            tracks: The input, which exports need.

        Raises:
            InvalidArgument: The file is no such result.
            OSError: It cannot be read.

        """
        try:
            return cls(result_pb2.JobResult.FromString(Path(path).read_bytes()), tracks)
        except DecodeError as error:
            raise InvalidArgument(f"{path}: is no saved result: {error}", reason="INVALID_FILE") from None

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the result as the server sent it (an encoded scpsfm.v1.JobResult)."""
        Path(path).write_bytes(self.message.SerializeToString())

    def with_tracks(self, tracks: Tracks) -> Result:
        """The same result, of this input."""
        return Result(self.message, tracks)

    def to_colmap_database(self, path: str | PathLike[str]) -> None:
        """Writes a COLMAP database of the right observations; see `scpsfm.to_colmap_database`."""
        to_colmap_database(self._with_input(), path, self)

    def to_nerfstudio(self, path: str | PathLike[str], *, part: int = 0, images: str = "images") -> None:
        """Writes nerfstudio's `transforms.json` into a folder; see `scpsfm.to_nerfstudio`."""
        to_nerfstudio(self._with_input(), path, self, part=part, images=images)

    def to_opensfm(self, path: str | PathLike[str]) -> None:
        """Writes OpenSfM's `reconstruction.json` into a folder; see `scpsfm.to_opensfm`."""
        to_opensfm(self._with_input(), path, self)

    def _with_input(self) -> Tracks:
        if self.input is None:
            raise InvalidArgument("exports need the input: result.with_tracks(tracks)", reason="NO_INPUT")
        return self.input
