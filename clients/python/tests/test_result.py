from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scpsfm
from scpsfm import Grade, Result, ResultStatus
from scpsfm._stubs import result_pb2

from . import scene


def test_a_result_is_arrays(small: scene.Scene) -> None:
    result = Result(scene.true_result(small), small.tracks)
    assert (result.status, result.grade, result.is_solved, result.is_metric) == ("SOLVED", "METRIC", True, True)
    assert str(result.grade) == "METRIC"
    assert result.focal_px == small.focal_px
    assert result.sigma_log_focal == 0.001
    assert result.method == "AUTO"
    assert [(warning.code, warning.camera_group) for warning in result.warnings] == [
        ("PRINCIPAL_POINT_UNOBSERVABLE", None)
    ]
    assert np.array_equal(result.tracks.inlier, small.right)
    assert result.tracks.inlier.dtype == bool
    assert result.tracks.weight.dtype == np.float32
    assert np.array_equal(result.tracks.points[small.right], small.points[small.right])
    assert np.isnan(result.tracks.points[~small.right]).all()
    assert result.tracks.part.tolist() == np.where(small.right, 0, -1).tolist()
    assert np.array_equal(result.points, small.points[small.right])
    assert result.point_track_indices.tolist() == np.flatnonzero(small.right).tolist()
    assert result.tracks.network_weight is None
    assert not result.tracks.second_structure_number.any()
    message = scene.true_result(small)
    message.tracks.second_structure_numbers.extend(2 * ~small.right)
    assert np.array_equal(Result(message, small.tracks).tracks.second_structure_number, 2 * ~small.right)
    assert result.observations.inlier.shape == (len(small.tracks),)
    for array in (result.points, result.tracks.inlier, result.tracks.points, result.observations.residual_px):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert repr(result).startswith("Result(SOLVED, METRIC, focal ")


def test_cameras_project_points_to_the_observations(small: scene.Scene) -> None:
    result = Result(scene.true_result(small), small.tracks)
    errors = []
    for k in np.flatnonzero(result.observations.inlier):
        camera = result.cameras[int(small.tracks.view_index[k])]
        point = result.tracks.points[small.tracks.track_index[k]]
        assert camera.P is not None
        # x ~ K (R X + t), and the projective camera in the frame of the first one.
        assert camera.K is not None
        assert camera.R is not None
        assert camera.t is not None
        x = camera.K @ (camera.R @ point + camera.t)
        pixel = x[:2] / x[2]
        errors.append(np.linalg.norm(pixel - small.tracks.xy[k]))
        assert camera.project(point[None])[0] == pytest.approx(pixel)
        assert result.cameras[0].K is not None
        in_first = result.cameras[0].K @ (small.R[0] @ point + small.t[0])
        x = camera.P @ np.append(in_first, 1.0)
        assert x[:2] / x[2] == pytest.approx(pixel)
    assert len(errors) > 100
    # The noise is half a pixel an axis: sqrt(pi / 2) / 2 on average.
    assert np.mean(errors) == pytest.approx(0.627, abs=0.1)
    center = result.cameras[2].center
    assert center is not None
    assert small.R[2] @ center + small.t[2] == pytest.approx(np.zeros(3), abs=1e-12)


@pytest.mark.parametrize("fisheye", [False, True])
def test_the_lens_distorts_as_the_proto_says(small: scene.Scene, fisheye: bool) -> None:
    intrinsics = {"aspect": 1.1, "radial_k1": -0.1, "radial_k2": 0.02, "radial_k3": -0.003}
    if not fisheye:
        intrinsics.update(tangential_p1=0.004, tangential_p2=-0.005)
    message = scene.true_result(small, lens_projection=2 if fisheye else 1, **intrinsics)
    camera = Result(message, small.tracks).cameras[1]
    f, (cx, cy) = small.focal_px, small.K[:2, 2]
    for point in small.points[:20]:
        x, y, z = small.R[1] @ point + small.t[1]
        u, v = x / z, y / z
        r2 = u * u + v * v
        r = np.sqrt(r2)
        s = 1 - 0.1 * r2 + 0.02 * r2**2 - 0.003 * r2**3
        p1, p2 = 0.004, -0.005
        if fisheye:
            a = np.arctan(r)
            s, p1, p2 = a * (1 - 0.1 * a**2 + 0.02 * a**4 - 0.003 * a**6) / r, 0.0, 0.0
        expected = [
            f * (u * s + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) + cx,
            1.1 * f * (v * s + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v) + cy,
        ]
        assert camera.project(point[None])[0] == pytest.approx(expected, abs=1e-9)
    # On the axis nothing is divided by 0.
    assert camera.R is not None
    assert camera.t is not None
    on_axis = camera.R.T @ (np.array([0.0, 0.0, 2.0]) - camera.t)
    assert camera.project(on_axis[None])[0] == pytest.approx([cx, cy])


def test_calibrations_are_those_of_the_groups() -> None:
    message = result_pb2.JobResult(status=1, grade=2)
    for group, focal in ((4, 100.0), (9, 200.0)):
        message.calibrations.add(camera_group=group, focal_px=focal, aspect=1.0, grade=2)
    for group in (9, 4, 9):
        view = message.views.add(camera_group=group, translation=[0.0, 0.0, 1.0])
        view.rotation.extend(np.eye(3).ravel())
    message.views[2].focal_px = 250.0
    result = Result(message)
    assert [calibration.camera_group for calibration in result.calibrations] == [4, 9]
    assert [camera.focal_px for camera in result.cameras] == [200.0, 100.0, 250.0]
    assert [camera.K[0, 0] for camera in result.cameras if camera.K is not None] == [200.0, 100.0, 250.0]
    assert (result.focal_px, result.sigma_log_focal) == (100.0, None)
    # A group without a calibration has no other's.
    del message.calibrations[1]
    alone = Result(message)
    assert [calibration.camera_group for calibration in alone.calibrations] == [4]
    assert [camera.focal_px for camera in alone.cameras] == [None, 100.0, None]
    assert (alone.cameras[0].calibration, alone.cameras[0].R) == (None, None)


def test_nothing_found_is_a_result_too() -> None:
    message = result_pb2.JobResult(status=2)
    message.views.add()
    left = message.views.add().left_out
    left.reason, left.point_count = 3, 7
    message.tracks.weights.extend([0.0, 0.0])
    message.tracks.inliers.extend([False, False])
    message.observations.inliers.extend([False])
    message.observations.classified.extend([False])
    message.observations.residuals_px.extend([0.0])
    message.observations.weights.extend([0.0])
    message.warnings.add(code=7, detail="none")
    result = Result(message)
    assert (result.status, result.grade) == (ResultStatus.NO_RECONSTRUCTION, Grade.UNSPECIFIED)
    assert (result.focal_px, result.calibrations, result.noise_px, result.plane_at_infinity) == (None, (), None, None)
    assert result.points.shape == (0, 3)
    assert np.isnan(result.observations.residual_px).all()
    assert not any(camera.is_registered for camera in result.cameras)
    assert result.cameras[1].left_out == scpsfm.LeftOut("NOT_REGISTERED", 7, 0)
    assert result.cameras[0].left_out is None
    assert (result.cameras[0].P, result.cameras[0].center, result.cameras[0].part) == (None, None, None)
    with pytest.raises(ValueError, match="no metric pose"):
        result.cameras[0].project(np.zeros((1, 3)))
    assert [str(warning) for warning in result.warnings] == ["NO_CONSENSUS: none"]


def test_words_of_later_servers_do_no_harm() -> None:
    message = result_pb2.JobResult(status=77, grade=77, method=77)
    message.warnings.add(code=77, detail="new", camera_group=0)
    result = Result(message)
    assert (result.status, result.grade, result.method) == ("UNSPECIFIED", "UNSPECIFIED", "UNKNOWN_77")
    assert result.warnings == (scpsfm.ResultWarning("UNKNOWN_77", "new", 0),)


def test_lengths_that_do_not_fit_are_told(small: scene.Scene) -> None:
    for change, words in (
        (lambda message: message.tracks.points.pop(), "coordinates of points"),
        (lambda message: message.tracks.weights.pop(), "weights of tracks"),
        (lambda message: message.tracks.point_track_indices.__setitem__(0, 120), "a track beyond its 120"),
        (lambda message: message.observations.residuals_px.pop(), "residuals"),
        (lambda message: message.observations.classified.pop(), "verdicts"),
        (lambda message: setattr(message.calibrations[0], "lens_projection", 77), "lens is of a kind"),
        (lambda message: message.views[1].rotation.pop(), "numbers in a rotation"),
    ):
        message = scene.true_result(small)
        change(message)
        result = Result(message)
        with pytest.raises(scpsfm.InternalError, match=words):
            _ = (result.tracks, result.observations, result.cameras)


def test_splits_and_parts_are_told(small: scene.Scene) -> None:
    message = scene.true_result(small)
    message.track_splits.add(track_index=3, number=1, weight=0.75, point=[1.0, 2.0, 3.0])
    message.track_splits.add(track_index=3, number=2, weight=0.5)
    message.tracks.point_parts.extend([0] * (len(message.tracks.point_track_indices) - 1) + [1])
    message.observations.split_numbers.extend([0] * (len(small.tracks) - 1) + [2])
    result = Result(message)
    assert [(split.track, split.number, split.weight) for split in result.splits] == [(3, 1, 0.75), (3, 2, 0.5)]
    assert result.splits[0].point is not None
    assert result.splits[0].point.tolist() == [1, 2, 3]
    assert result.splits[1].point is None
    assert result.observations.split[-1] == 2
    assert result.point_parts[-1] == 1


def test_tracks_of_two_views_are_told(small: scene.Scene) -> None:
    message = scene.true_result(small)
    assert len(Result(message).two_view_tracks.track) == 0
    message.two_view_tracks.add(track_index=3, weight=0.75, point=[1.0, 2.0, 3.0])
    message.two_view_tracks.add(track_index=5, weight=0.5, part=1)
    found = Result(message).two_view_tracks
    assert (found.track.tolist(), found.weight.tolist(), found.part.tolist()) == ([3, 5], [0.75, 0.5], [0, 1])
    assert found.points[0].tolist() == [1, 2, 3]
    assert np.isnan(found.points[1]).all()
    message.two_view_tracks[0].point.pop()
    with pytest.raises(scpsfm.InternalError, match="coordinates of points"):
        _ = Result(message).two_view_tracks


@pytest.mark.parametrize(
    ("field", "add", "words"),
    [
        ("two_view_tracks", lambda message: message.two_view_tracks.add(track_index=120), "two views of a track"),
        ("splits", lambda message: message.track_splits.add(track_index=120, number=1), "several points of a track"),
        (
            "second_structures",
            lambda message: message.second_structures.add(number=1).points.add(track_index=120, point=[1, 2, 3]),
            "a second structure of a track",
        ),
        (
            "second_structures",
            lambda message: message.second_structures.add(number=1).poses.add(
                view_index=99, rotation=[0] * 9, translation=[0] * 3
            ),
            "a second structure of a view",
        ),
    ],
)
def test_indices_beyond_the_input_are_refused(small: scene.Scene, field: str, add: Any, words: str) -> None:
    message = scene.true_result(small)
    add(message)
    with pytest.raises(scpsfm.InternalError, match=f"{words} beyond its "):
        getattr(Result(message), field)


def test_second_structures_are_told(small: scene.Scene) -> None:
    message = scene.true_result(small)
    assert Result(message).second_structures == ()
    moving = message.second_structures.add(number=1, kind=result_pb2.SECOND_STRUCTURE_KIND_MOVING_BODY)
    for view in (0, 2):
        moving.poses.add(view_index=view, rotation=small.R[view].ravel(), translation=small.t[view])
    moving.points.add(track_index=3, point=[1.0, 2.0, 3.0])
    message.second_structures.add(number=2)
    message.second_structures.add(number=3, kind=77)  # type: ignore[arg-type]
    first, second, third = Result(message).second_structures
    assert (first.number, first.kind, first.view.tolist(), first.track.tolist()) == (1, "MOVING_BODY", [0, 2], [3])
    assert np.array_equal(first.R, small.R[[0, 2]])
    assert np.array_equal(first.t, small.t[[0, 2]])
    assert first.points.tolist() == [[1, 2, 3]]
    for array in (first.view, first.R, first.t, first.track, first.points):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert (second.number, second.kind, third.kind) == (2, None, None)
    assert (second.R.shape, second.t.shape, second.points.shape) == ((0, 3, 3), (0, 3), (0, 3))
    for change, words in (
        (lambda pose: pose.rotation.pop(), "numbers in a rotation"),
        (lambda pose: pose.translation.pop(), "numbers in a translation"),
    ):
        wrong = result_pb2.JobResult.FromString(message.SerializeToString())
        change(wrong.second_structures[0].poses[1])
        with pytest.raises(scpsfm.InternalError, match=words):
            _ = Result(wrong).second_structures
    moving.points[0].point.append(4.0)
    with pytest.raises(scpsfm.InternalError, match="coordinates of a point"):
        _ = Result(message).second_structures


def test_a_result_is_saved_and_loaded(small: scene.Scene, tmp_path: Path) -> None:
    result = Result(scene.true_result(small), small.tracks)
    result.save(tmp_path / "r.pb")
    loaded = Result.load(tmp_path / "r.pb", small.tracks)
    assert loaded.message == result.message
    (tmp_path / "bad.pb").write_bytes(b"\xff" * 40)
    with pytest.raises(scpsfm.InvalidArgument, match=r"bad\.pb"):
        Result.load(tmp_path / "bad.pb")
    with pytest.raises(scpsfm.InvalidArgument, match="with_tracks"):
        Result.load(tmp_path / "r.pb").to_opensfm(tmp_path / "out")
