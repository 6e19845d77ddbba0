"""nerfstudio's transforms.json, and the points beside it.

nerfstudio takes camera-to-world matrices of OpenGL's cameras (x right, y up, z backwards), and principal points as
COLMAP has them: the centre of the top-left pixel is (.5, .5), where ours is (0, 0).
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from .._read.colmap import FIRST_PIXEL
from .._result_data import ResultData
from ..errors import InvalidArgument, Violation
from ..tracks import Tracks
from .model import Intrinsics, Model, colour, models

__all__ = ["to_nerfstudio"]

_POINTS = "sparse_pc.ply"


def to_nerfstudio(
    tracks: Tracks, path: str | PathLike[str], result: ResultData, *, part: int = 0, images: str = "images"
) -> None:
    """Writes `transforms.json` and `sparse_pc.ply` of one part of a metric result.

    Args:
        tracks: The input; the names of its views are those of the images.
        path: Folder that both are written into; made where it is not there.
        result: What was found of it.
        part: Which reconstruction, the largest being 0.
        images: Folder of the images, as seen from there.

    Raises:
        FailedPrecondition: The result has no metric poses.
        InvalidArgument: It has no such part, or is of other tracks.
        OSError: A file cannot be written.

    """
    found = next((model for model in models(tracks, result) if model.part == part), None)
    if found is None:
        what = f"the result has no part {part}"
        raise InvalidArgument(f"part: {what}", reason="INVALID_ARGUMENT", violations=[Violation("part", what)])
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    if found.points:
        (folder / _POINTS).write_text(_ply(found), encoding="ascii")
    content = json.dumps(_transforms(found, images), indent=1, allow_nan=False)
    (folder / "transforms.json").write_text(content + "\n", encoding="utf-8")


def _transforms(model: Model, images: str) -> dict[str, Any]:
    intrinsics = [_intrinsics(camera) for camera in model.cameras]
    # The model of the lens is one for all; where cameras differ in anything else, every frame says what is its own.
    common = intrinsics[0] if len(intrinsics) == 1 else {}
    kinds = {one["camera_model"] for one in intrinsics}
    frames = []
    for view, camera, name in zip(model.views, model.camera_of, model.names, strict=True):
        frame: dict[str, Any] = {"file_path": f"{images}/{name}" if images else name}
        if not common:
            frame.update({key: value for key, value in intrinsics[camera].items() if key != "camera_model"})
            if len(kinds) > 1:
                frame["camera_model"] = intrinsics[camera]["camera_model"]
        assert view.R is not None and view.center is not None
        to_world = np.eye(4)
        # OpenGL's y and z point the other way.
        to_world[:3, :3] = view.R.T * np.array([1.0, -1.0, -1.0])
        to_world[:3, 3] = view.center
        frame["transform_matrix"] = to_world.tolist()
        frames.append(frame)
    top = dict(common)
    if not common and len(kinds) == 1:
        top["camera_model"] = kinds.pop()
    points = {"ply_file_path": _POINTS} if model.points else {}
    return {**top, **points, "frames": frames}


def _intrinsics(camera: Intrinsics) -> dict[str, Any]:
    calibration = camera.calibration
    (k1, k2, k3), (p1, p2) = calibration.radial, calibration.tangential
    x, y = calibration.principal_point_px
    values: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if calibration.is_fisheye else "OPENCV",
        "fl_x": camera.focal_px,
        "fl_y": camera.focal_px * calibration.aspect,
        "cx": x + FIRST_PIXEL,
        "cy": y + FIRST_PIXEL,
        "w": camera.size[0],
        "h": camera.size[1],
        "k1": k1,
        "k2": k2,
        "k3": k3,
    }
    if calibration.is_fisheye:
        return {**values, "k4": 0.0}
    return {**values, "p1": p1, "p2": p2}


def _ply(model: Model) -> str:
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(model.points)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    for _, position, weight in model.points:
        x, y, z = position.tolist()
        lines.append(f"{x!r} {y!r} {z!r} {' '.join(map(str, colour(weight)))}")
    return "\n".join(lines) + "\n"
