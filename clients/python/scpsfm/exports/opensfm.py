"""OpenSfM's reconstruction.json.

Lengths of cameras are in units of the larger image side, the origin is the middle of the image; a shot's rotation is an
angle-axis vector, world to camera.
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from .._read.tables import frame
from .._result_data import ResultData
from ..tracks import Tracks
from .model import Floats, Intrinsics, Model, colour, models, quaternion

__all__ = ["to_opensfm"]

_MIDDLE_PX = 1e-6
"""Distance of a principal point from the middle of the image below which it is the middle."""


def to_opensfm(tracks: Tracks, path: str | PathLike[str], result: ResultData) -> None:
    """Writes `reconstruction.json` of a metric result: a list of reconstructions, one a part, the largest first.

    Args:
        tracks: The input; the names of its views are those of the shots, without folders where they differ without.
        path: Folder that it is written into; made where it is not there.
        result: What was found of it.

    Raises:
        FailedPrecondition: The result has no metric poses.
        InvalidArgument: The result is of other tracks.
        OSError: The file cannot be written.

    """
    parts = models(tracks, result)
    names = [name for model in parts for name in model.names]
    # OpenSfM keeps all images in one folder: a name has no folders, unless two images would have one name then.
    is_unique = len({name.rpartition("/")[2] for name in names}) == len(names)
    found = [_reconstruction(model, is_unique) for model in parts]
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    content = json.dumps(found, indent=1, allow_nan=False)
    (folder / "reconstruction.json").write_text(content + "\n", encoding="utf-8")


def _reconstruction(model: Model, without_folders: bool) -> dict[str, Any]:
    points: dict[str, Any] = {}
    for label, position, weight in model.points:
        name = str(label)
        # Those of the tracks come first: no name of another point may be that of a track.
        while name in points:
            name += "+"
        points[name] = {"coordinates": position.tolist(), "color": list(colour(weight))}
    shots = {}
    for view, camera, name in zip(model.views, model.camera_of, model.names, strict=True):
        assert view.R is not None and view.t is not None
        shots[name.rpartition("/")[2] if without_folders else name] = {
            "camera": _name(model.cameras[camera]),
            "rotation": _angle_axis(view.R),
            "translation": view.t.tolist(),
        }
    return {
        "cameras": {_name(camera): _camera(camera) for camera in model.cameras},
        "shots": shots,
        "points": points,
    }


def _name(camera: Intrinsics) -> str:
    return f"scpsfm camera {camera.id}"


def _camera(camera: Intrinsics) -> dict[str, Any]:
    """`perspective` or `fisheye` where two radial coefficients are all, else `brown` or `fisheye_opencv`."""
    calibration = camera.calibration
    middle_x, middle_y, side = frame(camera.size)
    x, y = calibration.principal_point_px
    offset = (x - middle_x, y - middle_y)
    (k1, k2, k3), (p1, p2) = calibration.radial, calibration.tangential
    focal = camera.focal_px / side
    base: dict[str, Any] = {"width": camera.size[0], "height": camera.size[1]}
    is_middle = max(map(abs, offset)) < _MIDDLE_PX
    if is_middle and calibration.aspect == 1.0 and k3 == p1 == p2 == 0.0:
        kind = "fisheye" if calibration.is_fisheye else "perspective"
        return {"projection_type": kind, **base, "focal": focal, "k1": k1, "k2": k2}
    values = {
        **base,
        "focal_x": focal,
        "focal_y": focal * calibration.aspect,
        "c_x": offset[0] / side,
        "c_y": offset[1] / side,
        "k1": k1,
        "k2": k2,
        "k3": k3,
    }
    if calibration.is_fisheye:
        # A fourth radial term, which our model does not have.
        return {"projection_type": "fisheye_opencv", **values, "k4": 0.0}
    return {"projection_type": "brown", **values, "p1": p1, "p2": p2}


def _angle_axis(rotation: Floats) -> list[float]:
    w, *axis = quaternion(rotation).tolist()
    length = float(np.linalg.norm(axis))
    if length < 1e-15:
        return [0.0, 0.0, 0.0]
    angle = 2.0 * np.arctan2(length, w)
    return [float(value * angle / length) for value in axis]
