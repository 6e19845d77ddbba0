"""Synthetic scenes whose truth is known, and results that say the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import scpsfm
from scpsfm._stubs import result_pb2

WIDTH, HEIGHT = 1200, 900


def rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation of an angle-axis vector, by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


@dataclass
class Scene:
    tracks: scpsfm.Tracks
    focal_px: float
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    points: NDArray[np.float64]
    right: NDArray[np.bool_]
    """Of each track."""


def make(seed: int, views: int = 8, tracks: int = 120, wrong: float = 0.3, noise_px: float = 0.5) -> Scene:
    """Cameras around a cloud of points; wrong tracks are points at random. All inside the images."""
    print(f"scene of seed {seed}")
    rng = np.random.default_rng(seed)
    focal = float(rng.uniform(900.0, 1400.0))
    middle = np.array([(WIDTH - 1) / 2.0, (HEIGHT - 1) / 2.0])
    K = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    points = rng.uniform(-1.0, 1.0, (tracks, 3))
    R, t = [], []
    for view in range(views):
        turn = np.array([rng.uniform(-0.25, 0.25), -0.5 + view / (views - 1), rng.uniform(-0.3, 0.3)])
        R.append(rotation(turn))
        t.append(np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), 5.0 + rng.uniform(-0.3, 0.3)]))
    rotations, translations = np.array(R), np.array(t)
    seen = np.einsum("vij,nj->vni", rotations, points) + translations[:, None]
    pixels = seen[..., :2] / seen[..., 2:] * focal + middle
    right = np.ones(tracks, dtype=bool)
    right[rng.choice(tracks, round(wrong * tracks), replace=False)] = False
    pixels += rng.normal(0.0, noise_px, pixels.shape)
    pixels[:, ~right] = rng.uniform([0.0, 0.0], [WIDTH - 1, HEIGHT - 1], pixels[:, ~right].shape)
    inside = (pixels >= 0).all(axis=2) & (pixels <= [WIDTH - 1, HEIGHT - 1]).all(axis=2)
    pixels[~inside] = np.nan
    names = [f"IMG_{view:03}.jpg" for view in range(views)]
    given = scpsfm.Tracks.from_points(pixels, width=WIDTH, height=HEIGHT, names=names)
    return Scene(given, focal, K, rotations, translations, points, right)


def true_result(scene: Scene, job: str = "tenants/default/jobs/true", **calibration: float) -> result_pb2.JobResult:
    """What a server would say that knows the truth."""
    message = result_pb2.JobResult(job=job, server_version="0", status="RESULT_STATUS_SOLVED", grade="GRADE_METRIC")
    message.method = 1
    one = message.calibrations.add(focal_px=scene.focal_px, sigma_log_focal=0.001, aspect=1.0, grade="GRADE_METRIC")
    one.principal_point_x_px, one.principal_point_y_px = scene.K[0, 2], scene.K[1, 2]
    for name, value in calibration.items():
        setattr(one, name, value)
    for view, (R, t) in enumerate(zip(scene.R, scene.t, strict=True)):
        P = scene.K @ np.hstack([R @ scene.R[0].T @ np.linalg.inv(scene.K), np.zeros((3, 1))])
        P[:, 3] = scene.K @ (t - R @ scene.R[0].T @ scene.t[0])
        message.views.add(projection=P.ravel(), rotation=R.ravel(), translation=t, name=scene.tracks.views[view].name)
    right = scene.right
    message.tracks.weights.extend(right.astype(float))
    message.tracks.inliers.extend(right.tolist())
    message.tracks.point_track_indices.extend(np.flatnonzero(right))
    message.tracks.points.extend(scene.points[right].ravel())
    of_observation = right[scene.tracks.track_index]
    count = len(scene.tracks)
    message.observations.inliers.extend(of_observation.tolist())
    message.observations.classified.extend([True] * count)
    message.observations.residuals_px.extend(np.where(of_observation, 0.5, 99.0))
    message.observations.weights.extend(of_observation.astype(float))
    message.warnings.add(code="WARNING_CODE_PRINCIPAL_POINT_UNOBSERVABLE", detail="taken to be the middle")
    return message


def write_csv(tracks: scpsfm.Tracks, path: Path) -> Path:
    """Writes tracks as `view,track,x,y`."""
    rows = zip(tracks.view_index, tracks.track_index, tracks.x.tolist(), tracks.y.tolist(), strict=True)
    path.write_text("view,track,x,y\n" + "".join(f"{view},{track},{x!r},{y!r}\n" for view, track, x, y in rows))
    return path


def write_opensfm(tracks: scpsfm.Tracks, folder: Path) -> Path:
    """Writes tracks as an OpenSfM data set: `tracks.csv` of version 2, and a file in `exif/` for each image."""
    (folder / "exif").mkdir(parents=True)
    for name in tracks.names:
        content = json.dumps({"width": WIDTH, "height": HEIGHT, "camera": "one"})
        (folder / "exif" / f"{name}.exif").write_text(content)
    side = max(WIDTH, HEIGHT)
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for k in range(len(tracks)):
        x, y = (tracks.x[k] - (WIDTH - 1) / 2) / side, (tracks.y[k] - (HEIGHT - 1) / 2) / side
        name, track = tracks.names[int(tracks.view_index[k])], int(tracks.track_index[k])
        lines.append("\t".join(map(str, (name, track, k, float(x), float(y), 0.001, 1, 2, 3, -1, -1))))
    path = folder / "tracks.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def from_proto(message: Any) -> scpsfm.Tracks:
    """Tracks of a message of the API, checked as any."""
    views = [
        scpsfm.View(
            view.name,
            (view.size.width_px, view.size.height_px) if view.HasField("size") else None,
            view.camera_group,
            scpsfm.FocalPrior(view.focal_prior.focal_px, view.focal_prior.sigma_log)
            if view.HasField("focal_prior")
            else None,
        )
        for view in message.views
    ]
    return scpsfm.Tracks.from_arrays(
        list(message.view_indices),
        list(message.track_indices),
        list(message.xs),
        list(message.ys),
        views=views,
        track_count=message.track_count,
        sigma_px=list(message.sigmas_px) or None,
        depth=list(message.depths) or None,
    )
