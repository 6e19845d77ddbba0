"""What is written for other programs, read back by them where they are there, or by the definition of their formats."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import scpsfm
from scpsfm import FocalPrior, Result, Tracks, View
from scpsfm.exports.colmap import pairs_of, parameters
from scpsfm.exports.model import quaternion

from . import scene

LENSES: list[dict[str, Any]] = [
    {},
    {"aspect": 1.05},
    {"radial_k1": -0.1},
    {"radial_k1": -0.1, "radial_k2": 0.02},
    {"radial_k1": -0.1, "radial_k2": 0.02, "radial_k3": 0.003},
    {"tangential_p1": 0.001, "tangential_p2": -0.002},
    {"radial_k1": -0.1, "tangential_p2": -0.002, "aspect": 0.95},
    {"lens_projection": 2},
    {"lens_projection": 2, "radial_k1": 0.05},
    {"lens_projection": 2, "radial_k1": 0.05, "radial_k2": -0.01},
    {"lens_projection": 2, "radial_k1": 0.05, "radial_k2": -0.01, "radial_k3": 0.004, "aspect": 1.02},
]


@pytest.fixture
def result(small: scene.Scene) -> Result:
    return Result(scene.true_result(small), small.tracks)


def test_a_database_comes_back_as_the_right_tracks(result: Result, small: scene.Scene, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    result.to_colmap_database(path)
    back = Tracks.from_colmap_database(path)
    assert back.names == small.tracks.names
    right = small.right[small.tracks.track_index]
    seen = np.bincount(small.tracks.track_index[right], minlength=small.tracks.track_count)
    assert back.track_count == np.count_nonzero(seen >= 2)
    assert len(back) == seen[seen >= 2].sum()
    # Keypoints are observations; positions go through four-byte numbers.
    for k in range(len(back)):
        own = np.flatnonzero(small.tracks.view_index == back.view_index[k])
        assert back.keypoint_index is not None
        observation = own[back.keypoint_index[k]]
        assert right[observation]
        assert back.xy[k] == pytest.approx(small.tracks.xy[observation], abs=1e-3)
    assert {view.focal_prior for view in back.views} == {FocalPrior(small.focal_px)}
    raw = Tracks.from_colmap_database(path, matches="raw")
    all_seen = np.bincount(small.tracks.track_index)
    assert len(raw) == all_seen[all_seen >= 2].sum()
    with pytest.raises(FileExistsError):
        result.to_colmap_database(path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["database.db"]


def test_a_database_has_a_match_for_every_two_observations_of_a_point(
    result: Result, small: scene.Scene, tmp_path: Path
) -> None:
    path = tmp_path / "database.db"
    result.to_colmap_database(path)
    for table, kept in (
        ("matches", np.ones(len(small.tracks), dtype=bool)),
        ("two_view_geometries", result.observations.inlier),
    ):
        expected: dict[tuple[int, int], int] = {}
        for track in range(small.tracks.track_count):
            views = sorted(small.tracks.view_index[kept & (small.tracks.track_index == track)].tolist())
            for i, a in enumerate(views):
                for b in views[i + 1 :]:
                    expected[(a + 1, b + 1)] = expected.get((a + 1, b + 1), 0) + 1
        assert {(a, b): rows for a, b, rows in pairs_of(path, table)} == expected


def test_the_geometries_of_pairs_hold_for_their_matches(result: Result, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    result.to_colmap_database(path)
    with closing(sqlite3.connect(path)) as connection:
        points = {
            image: np.frombuffer(data, "<f4").reshape(-1, 2).astype(float)
            for image, data in connection.execute("SELECT image_id, data FROM keypoints")
        }
        rows = connection.execute("SELECT pair_id, data, config, F, E, qvec, tvec FROM two_view_geometries").fetchall()
    assert len(rows) == 28
    distances = []
    for pair_id, data, config, F, E, q, t in rows:
        assert config == 2
        first, second = divmod(pair_id, 2_147_483_647)
        matches = np.frombuffer(data, "<u4").reshape(-1, 2)
        fundamental = np.frombuffer(F).reshape(3, 3)
        a = np.column_stack([points[first][matches[:, 0]], np.ones(len(matches))])
        b = np.column_stack([points[second][matches[:, 1]], np.ones(len(matches))])
        lines = a @ fundamental.T
        distances.append(np.abs((b * lines).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1]))
        w, x, y, z = np.frombuffer(q)
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        one, other = result.cameras[first - 1], result.cameras[second - 1]
        assert one.R is not None
        assert other.R is not None
        assert turn @ one.R == pytest.approx(other.R)
        tx, ty, tz = np.frombuffer(t)
        cross = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]])
        assert np.frombuffer(E).reshape(3, 3) == pytest.approx(cross @ turn)
    # Half a pixel of noise on either side.
    assert np.median(np.concatenate(distances)) < 1.0


def test_a_database_without_a_result_has_priors_and_guesses(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 100, (4, 30, 2))
    views = [
        View("a", (640, 480), 0, FocalPrior(500.0)),
        View("b", (640, 480), 0, FocalPrior(500.0)),
        View("c", (640, 480), 1),
        View("", None, 1),
    ]
    path = tmp_path / "database.db"
    scpsfm.to_colmap_database(Tracks.from_points(points, views=views), path)
    with closing(sqlite3.connect(path)) as connection:
        cameras = connection.execute("SELECT model, width, height, params, prior_focal_length FROM cameras").fetchall()
        names = [name for (name,) in connection.execute("SELECT name FROM images ORDER BY image_id")]
    told = [(width, height, np.frombuffer(params)[0], known) for _, width, height, params, known in cameras]
    assert told == [(640, 480, 500.0, 1), (640, 480, 768.0, 0), (101, 101, pytest.approx(121.2), 0)]
    assert names == ["a", "b", "c", "view-00003"]


def test_a_result_of_other_tracks_is_refused(result: Result, tmp_path: Path) -> None:
    other = scene.make(seed=2, tracks=60).tracks
    for write in (scpsfm.to_colmap_database, scpsfm.to_nerfstudio, scpsfm.to_opensfm):
        with pytest.raises(scpsfm.InvalidArgument, match="is of 8 views, 120 tracks"):
            write(other, tmp_path / "out", result)
    assert not list(tmp_path.iterdir())


def test_cameras_are_exported_of_metric_results_only(small: scene.Scene, tmp_path: Path) -> None:
    message = scene.true_result(small)
    message.grade = 3
    del message.calibrations[:]
    for view in message.views:
        del view.rotation[:], view.translation[:]
    projective = Result(message, small.tracks)
    for write in (projective.to_nerfstudio, projective.to_opensfm):
        with pytest.raises(scpsfm.FailedPrecondition, match="PROJECTIVE_ONLY"):
            write(tmp_path / "out")
    # The verdicts are worth something all the same.
    projective.to_colmap_database(tmp_path / "database.db")
    with closing(sqlite3.connect(tmp_path / "database.db")) as connection:
        assert {config for (config,) in connection.execute("SELECT config FROM two_view_geometries")} == {3}


def brown(u: Any, v: Any, values: dict[str, float]) -> tuple[Any, Any]:
    """OpenCV's model, written out."""
    r2 = u * u + v * v
    s = 1 + values["k1"] * r2 + values["k2"] * r2**2 + values.get("k3", 0.0) * r2**3
    p1, p2 = values.get("p1", 0.0), values.get("p2", 0.0)
    return u * s + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * s + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v


def fisheye(u: Any, v: Any, values: dict[str, float]) -> tuple[Any, Any]:
    """OpenCV's fisheye, written out."""
    r = np.hypot(u, v)
    a = np.arctan(r)
    s = a / r * (1 + values["k1"] * a**2 + values["k2"] * a**4 + values.get("k3", 0.0) * a**6)
    return u * s, v * s


def expected_pixels(result: Result, view: int) -> NDArray[np.float64]:
    return result.cameras[view].project(result.points)


@pytest.mark.parametrize("lens", LENSES)
def test_nerfstudio_projects_to_the_same_pixels(small: scene.Scene, tmp_path: Path, lens: dict[str, Any]) -> None:
    result = Result(scene.true_result(small, **lens), small.tracks)
    result.to_nerfstudio(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert len(content["frames"]) == 8
    for view, frame in enumerate(content["frames"]):
        assert frame["file_path"] == f"images/IMG_{view:03}.jpg"
        values = {**content, **frame}
        to_world = np.array(values["transform_matrix"])
        seen = (result.points - to_world[:3, 3]) @ to_world[:3, :3]
        # OpenGL looks along -z, and its y points up.
        u, v = seen[:, 0] / -seen[:, 2], seen[:, 1] / seen[:, 2]
        model = {"OPENCV": brown, "OPENCV_FISHEYE": fisheye}[values["camera_model"]]
        x, y = model(u, v, values)
        pixels = np.column_stack([values["fl_x"] * x + values["cx"], values["fl_y"] * y + values["cy"]])
        assert pixels - 0.5 == pytest.approx(expected_pixels(result, view))
        assert (values["w"], values["h"]) == (scene.WIDTH, scene.HEIGHT)
    lines = (tmp_path / content["ply_file_path"]).read_text().splitlines()
    body = lines[lines.index("end_header") + 1 :]
    assert f"element vertex {len(body)}" in lines
    points = np.array([[float(value) for value in line.split()[:3]] for line in body])
    assert points == pytest.approx(result.points)


def test_nerfstudio_is_told_of_no_points_where_there_are_none(small: scene.Scene, tmp_path: Path) -> None:
    message = scene.true_result(small)
    for field in ("points", "point_track_indices", "point_parts"):
        message.tracks.ClearField(field)
    Result(message, small.tracks).to_nerfstudio(tmp_path)
    assert "ply_file_path" not in json.loads((tmp_path / "transforms.json").read_text())
    assert not (tmp_path / "points.ply").exists()


def test_opensfm_names_have_no_folders_where_they_differ_without(small: scene.Scene, tmp_path: Path) -> None:
    for last, expected in (("e.jpg", "e.jpg"), ("0.jpg", "right/0.jpg")):
        names = [f"left/{view}.jpg" for view in range(len(small.tracks.views) - 1)] + [f"right/{last}"]
        views = [replace(view, name=name) for view, name in zip(small.tracks.views, names, strict=True)]
        Result(scene.true_result(small), replace(small.tracks, views=views)).to_opensfm(tmp_path)
        shots = json.loads((tmp_path / "reconstruction.json").read_text())[0]["shots"]
        assert expected in shots


def test_nerfstudio_frames_have_their_own_intrinsics_where_cameras_differ(small: scene.Scene, tmp_path: Path) -> None:
    message = scene.true_result(small)
    message.calibrations.add().CopyFrom(message.calibrations[0])
    message.calibrations[1].camera_group, message.calibrations[1].focal_px = 1, 77.0
    for view in message.views[4:]:
        view.camera_group = 1
    result = Result(message, small.tracks)
    result.to_nerfstudio(tmp_path, images="")
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert "fl_x" not in content
    assert content["camera_model"] == "OPENCV"
    assert [frame["fl_x"] for frame in content["frames"]] == [small.focal_px] * 4 + [77.0] * 4
    assert content["frames"][0]["file_path"] == "IMG_000.jpg"
    with pytest.raises(scpsfm.InvalidArgument, match="no part 1"):
        result.to_nerfstudio(tmp_path, part=1)


@pytest.mark.parametrize("lens", LENSES)
def test_opensfm_projects_to_the_same_pixels(small: scene.Scene, tmp_path: Path, lens: dict[str, Any]) -> None:
    result = Result(scene.true_result(small, **lens), small.tracks)
    result.to_opensfm(tmp_path)
    (content,) = json.loads((tmp_path / "reconstruction.json").read_text())
    assert set(content["points"]) == {str(track) for track in result.point_track_indices}
    assert len(content["shots"]) == 8
    side = max(scene.WIDTH, scene.HEIGHT)
    for view, name in enumerate(small.tracks.names):
        shot = content["shots"][name]
        camera = content["cameras"][shot["camera"]]
        seen = result.points @ scene.rotation(np.array(shot["rotation"])).T + shot["translation"]
        kind = camera["projection_type"]
        model = brown if kind in ("perspective", "brown") else fisheye
        x, y = model(seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], camera)
        fx, fy = camera.get("focal_x", camera.get("focal")), camera.get("focal_y", camera.get("focal"))
        normalised = np.column_stack([fx * x + camera.get("c_x", 0.0), fy * y + camera.get("c_y", 0.0)])
        pixels = normalised * side + [(scene.WIDTH - 1) / 2, (scene.HEIGHT - 1) / 2]
        assert pixels == pytest.approx(expected_pixels(result, view))


def test_quaternions_are_those_of_rotations() -> None:
    seed = 3
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    turns = [rng.normal(size=3) * scale for scale in (1e-9, 0.1, 1.0, 2.0) for _ in range(20)]
    turns += [np.pi * axis for axis in np.eye(3)] + [np.zeros(3)]
    for turn in turns:
        w, x, y, z = quaternion(scene.rotation(turn))
        assert w >= 0
        assert np.linalg.norm([w, x, y, z]) == pytest.approx(1.0)
        angle = np.linalg.norm(turn)
        half = turn / angle * np.sin(angle / 2) if angle else turn
        expected = np.array([np.cos(angle / 2), *half])
        assert abs(expected @ [w, x, y, z]) == pytest.approx(1.0)


@pytest.mark.parametrize("lens", LENSES)
def test_colmap_projects_to_the_same_pixels(small: scene.Scene, lens: dict[str, Any]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    result = Result(scene.true_result(small, **lens), small.tracks)
    model, values = parameters(result.calibrations[0], small.focal_px)
    camera = pycolmap.Camera(model=model, width=scene.WIDTH, height=scene.HEIGHT, params=values)
    seen = result.points @ small.R[0].T + small.t[0]
    assert np.array(camera.img_from_cam(seen)) - 0.5 == pytest.approx(expected_pixels(result, 0))


def test_colmap_opens_the_database_and_maps_it(small: scene.Scene, result: Result, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "database.db"
    result.to_colmap_database(path)
    (tmp_path / "images").mkdir()
    (tmp_path / "out").mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(path, tmp_path / "images", tmp_path / "out", options=options)
    assert len(models) == 1
    model = models[0]
    assert model.num_reg_images() == 8
    assert model.num_points3D() >= 0.95 * small.right.sum()
    assert model.compute_mean_reprojection_error() < 1.0
    (camera,) = model.cameras.values()
    assert camera.focal_length_x == pytest.approx(small.focal_px, rel=0.02)
    # What it writes comes back.
    back = Tracks.from_colmap_model(tmp_path / "out" / "0")
    assert back.names == small.tracks.names
    assert back.track_count == model.num_points3D()
    for image in model.images.values():
        own = back.names.index(image.name)
        keypoints = [point.xy - 0.5 for point in image.points2D if point.has_point3D()]
        assert back.xy[back.view_index == own] == pytest.approx(np.array(keypoints))


def test_what_colmap_itself_makes_is_read(tmp_path: Path) -> None:
    """Its database, of its newest tables, and its model, both of one scene that it synthesises."""
    pycolmap = pytest.importorskip("pycolmap")
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, 4, 100
    database = pycolmap.Database.open(tmp_path / "database.db")
    model = pycolmap.synthesize_dataset(options, database)
    database.close()
    tracks = Tracks.from_colmap_database(tmp_path / "database.db")
    assert {view.name for view in tracks.views} == {image.name for image in model.images.values()}
    assert len({view.camera_group for view in tracks.views}) == len(model.cameras) == 2
    # Each track is one of the model's points, whole.
    expected = {
        frozenset((model.images[element.image_id].name, element.point2D_idx) for element in point.track.elements)
        for point in model.points3D.values()
    }
    assert tracks.keypoint_index is not None
    found: dict[int, set[tuple[str, int]]] = {}
    for view, track, keypoint in zip(tracks.view_index, tracks.track_index, tracks.keypoint_index, strict=True):
        found.setdefault(int(track), set()).add((tracks.views[int(view)].name, int(keypoint)))
    assert {frozenset(members) for members in found.values()} == expected
    for binary in (True, False):
        folder = tmp_path / str(binary)
        folder.mkdir()
        if binary:
            model.write_binary(folder)
        else:
            model.write_text(folder)
        again = Tracks.from_colmap_model(folder)
        assert again.track_count == len(expected)
        assert again.names == tracks.names
        by_keypoint = {
            (int(view), int(keypoint)): tuple(xy)
            for view, keypoint, xy in zip(again.view_index, again.keypoint_index, again.xy.tolist(), strict=True)
        }
        for view, keypoint, xy in zip(tracks.view_index, tracks.keypoint_index, tracks.xy.tolist(), strict=True):
            # The database has four bytes a coordinate.
            assert by_keypoint[(int(view), int(keypoint))] == pytest.approx(xy, abs=1e-3)
