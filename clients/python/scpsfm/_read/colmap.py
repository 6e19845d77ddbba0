"""Cameras and images as COLMAP's files list them, and the tracks that they make together with observations.

COLMAP's pixels begin at the corner of the image: the centre of its top-left pixel is (.5, .5), where ours is (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .._fields import MAX_INDEX
from .._track_arrays import Made
from .._views import MAX_SIDE_PX, FocalPrior, View
from .._words import counted
from .problems import dense, of_file

__all__ = ["FIRST_PIXEL", "MODELS", "Camera", "Images", "Model"]

FIRST_PIXEL = 0.5
"""COLMAP's coordinate of the centre of the first pixel, which is 0 for us."""


@dataclass(frozen=True)
class Model:
    """A camera model of COLMAP."""

    id: int
    name: str
    parameters: int
    is_solved: bool
    """Whether the service's lens is as good as this one; the focal length is the first parameter then."""


MODELS = tuple(
    Model(*row)
    for row in (
        (0, "SIMPLE_PINHOLE", 3, True),
        (1, "PINHOLE", 4, True),
        (2, "SIMPLE_RADIAL", 4, True),
        (3, "RADIAL", 5, True),
        (4, "OPENCV", 8, True),
        (5, "OPENCV_FISHEYE", 8, True),
        (6, "FULL_OPENCV", 12, True),
        (7, "FOV", 5, False),
        (8, "SIMPLE_RADIAL_FISHEYE", 4, True),
        (9, "RADIAL_FISHEYE", 5, True),
        (10, "THIN_PRISM_FISHEYE", 12, False),
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16, False),
        (12, "SIMPLE_DIVISION", 4, True),
        (13, "DIVISION", 5, True),
        (14, "SIMPLE_FISHEYE", 3, True),
        (15, "FISHEYE", 4, True),
        (16, "EUCM", 6, False),
        (17, "EQUIRECTANGULAR", 2, False),
    )
)


@dataclass(frozen=True)
class Camera:
    """What is taken over of a camera."""

    model: Model | None
    size: tuple[int, int]
    focal_prior: FocalPrior | None = None

    @classmethod
    def of(cls, model: Model | None, width: int, height: int, focal_px: float | None, sigma_log: float) -> Camera:
        """A camera whose focal length is known beforehand where `focal_px` is given.

        Raises:
            ValueError: The size is none, in words.

        """
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise ValueError(f"size {width} x {height} px is not within 1 to {MAX_SIDE_PX}")
        usable = focal_px is not None and math.isfinite(focal_px) and focal_px > 0.0
        known = usable and model is not None and model.is_solved and focal_px is not None
        return cls(model, (width, height), FocalPrior(float(focal_px or 0.0), sigma_log) if known else None)


class Images:
    """Cameras and images, added in the order of the file."""

    def __init__(self) -> None:
        self._cameras: dict[int, Camera] = {}
        self._names: dict[str, int] = {}
        self._cameras_of: list[int] = []
        self._positions: dict[int, int] = {}
        self.ids: list[int] = []

    def __len__(self) -> int:
        return len(self.ids)

    def add_camera(self, camera_id: int, camera: Camera) -> None:
        """Adds a camera.

        Raises:
            ValueError: It is there already.

        """
        if camera_id in self._cameras:
            raise ValueError("is there a second time")
        self._cameras[camera_id] = camera

    def add_image(self, image_id: int, name: str, camera_id: int) -> int:
        """Adds an image and returns its position.

        Raises:
            ValueError: Name, id or camera are wrong, in words.

        """
        if not name:
            raise ValueError("has no name")
        if not 0 <= image_id <= MAX_INDEX:
            raise ValueError(f"the id {image_id} is out of range")
        if camera_id not in self._cameras:
            raise ValueError(f"is of camera {camera_id}, which is not among the cameras")
        if name in self._names:
            raise ValueError(f"the name {name!r} is there a second time")
        if image_id in self._positions:
            raise ValueError("is there a second time")
        position = len(self.ids)
        self._names[name] = position
        self._positions[image_id] = position
        self._cameras_of.append(camera_id)
        self.ids.append(image_id)
        return position

    def position(self, image_id: int) -> int | None:
        """Position of the image with this id."""
        return self._positions.get(image_id)

    def tracks(
        self,
        kind: type[Made],
        path: Path,
        image: NDArray[np.int64],
        track: NDArray[np.uint64],
        xy: NDArray[np.float64],
        keypoint: NDArray[np.int64],
        lines: NDArray[np.int64] | None,
        notes: list[str],
    ) -> Made:
        """The tracks of observations; views are all images, in the order of their names.

        A track's second observation in an image is left out.

        Args:
            kind: The class to make.
            path: The file.
            image: Position of the image of each observation. (n,).
            track: COLMAP's id of the track of each observation. (n,).
            xy: In COLMAP's pixels. (n, 2).
            keypoint: Which keypoint of its image each is. (n,).
            lines: Line of each in the file. (n,).
            notes: What reading changed so far.

        """
        if not len(image):
            raise of_file(path, f"has {counted(len(self), 'image')}, and no keypoint of a point in space")
        order = np.lexsort((np.arange(len(image)), image, track))
        repeated = np.zeros(len(image), dtype=bool)
        again = (track[order[1:]] == track[order[:-1]]) & (image[order[1:]] == image[order[:-1]])
        repeated[order[1:][again]] = True
        if repeated.any():
            left_out = counted(int(repeated.sum()), "observation")
            notes = [*notes, f"left out {left_out} beyond the first of a track in one image"]
            kept = ~repeated
            image, track, xy, keypoint = image[kept], track[kept], xy[kept], keypoint[kept]
            lines = None if lines is None else lines[kept]
        by_position = {position: name for name, position in self._names.items()}
        names, view_of = dense([by_position[position] for position in range(len(self))])
        views_of_images = np.array([view_of[by_position[position]] for position in range(len(self))], dtype=np.uint32)
        images_of_views = np.argsort(views_of_images)
        ids, track_index = np.unique(track, return_inverse=True)
        return kind(
            views=tuple(self._view(int(position), by_position[int(position)]) for position in images_of_views),
            track_count=len(ids),
            view_index=views_of_images[image],
            track_index=track_index.astype(np.uint32),
            x=np.ascontiguousarray(xy[:, 0] - FIRST_PIXEL),
            y=np.ascontiguousarray(xy[:, 1] - FIRST_PIXEL),
            keypoint_index=keypoint,
            track_labels=tuple(int(label) for label in ids),
            view_labels=names,
            image_ids=np.array([self.ids[position] for position in images_of_views], dtype=np.uint32),
            file=str(path),
            lines=lines,
            notes=(*notes, *self._foreign()),
        )

    def _view(self, position: int, name: str) -> View:
        group = self._cameras_of[position]
        camera = self._cameras[group]
        return View(name, camera.size, group, camera.focal_prior)

    def _foreign(self) -> list[str]:
        for camera_id in sorted(set(self._cameras_of)):
            model = self._cameras[camera_id].model
            if model is None or not model.is_solved:
                name = "an unknown model" if model is None else model.name
                return [
                    f"camera {camera_id} is of COLMAP's model {name}; its images are solved as those of a perspective "
                    "lens with radial and tangential distortion or of a fisheye with radial distortion"
                ]
        return []
