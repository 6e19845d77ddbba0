from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import scpsfm
from scpsfm import FocalPrior, InvalidArgument, Tracks, View
from scpsfm._stubs import input_pb2

VIEW = [0, 0, 1, 1]
TRACK = [0, 1, 0, 1]
X = [1.0, 2.0, 3.0, 4.0]
Y = [5.0, 6.0, 7.0, 8.0]


def refused(field: str, words: str, call: Any, *given: Any, **named: Any) -> InvalidArgument:
    with pytest.raises(InvalidArgument) as raised:
        call(*given, **named)
    assert raised.value.field == field
    assert words in str(raised.value)
    assert isinstance(raised.value, ValueError)
    return raised.value


def test_arrays_become_the_message_of_the_api() -> None:
    tracks = Tracks.from_arrays(
        VIEW, TRACK, X, Y, width=640, height=480, names=["a.jpg", "b.jpg"], camera_groups=[3, 4],
        focal_prior=FocalPrior(500.0, 0.2), sigma_px=[1, 1, 2, 2], depth=[1.0, -1.0, 2.0, 3.0], track_count=5,
        keypoint_index=[9, 8, 7, 6],
    )  # fmt: skip
    message = tracks.to_proto()
    expected = input_pb2.TrackSet(
        track_count=5, view_indices=VIEW, track_indices=TRACK, xs=X, ys=Y, sigmas_px=[1, 1, 2, 2], depths=[1, -1, 2, 3]
    )
    for name, group in (("a.jpg", 3), ("b.jpg", 4)):
        view = expected.views.add(name=name, camera_group=group)
        view.size.width_px, view.size.height_px = 640, 480
        view.focal_prior.focal_px, view.focal_prior.sigma_log = 500.0, 0.2
    assert message == expected
    assert len(tracks) == 4
    assert tracks.keypoint_index is not None
    assert tracks.keypoint_index.tolist() == [9, 8, 7, 6]
    assert tracks.xy.tolist() == [[1, 5], [2, 6], [3, 7], [4, 8]]


def test_the_chunks_are_the_whole() -> None:
    seed = 2
    print(f"seed {seed}")
    points = np.random.default_rng(seed).uniform(0, 100, (3, 20_000, 2))
    tracks = Tracks.from_points(points, depth=np.ones((3, 20_000)))
    whole = tracks._head()
    assert not whole.xs
    chunks = list(tracks._chunks())
    assert len(chunks) > 2
    for chunk in chunks:
        assert chunk.ByteSize() < 1 << 20
        for field in ("view_indices", "track_indices", "xs", "ys", "sigmas_px", "depths"):
            getattr(whole, field).extend(getattr(chunk, field))
    assert whole == tracks.to_proto()


def test_points_that_are_not_observed_are_nan() -> None:
    points = np.array([[[1, 2], [3, 4], [np.nan, np.nan]], [[5, 6], [np.nan, np.nan], [7, 8]]])
    depth = np.array([[1, 2, np.nan], [3, np.nan, 4]])
    tracks = Tracks.from_points(points, depth=depth, names=["a", "b"])
    assert tracks.view_index.tolist() == [0, 0, 1, 1]
    assert tracks.track_index.tolist() == [0, 1, 0, 2]
    assert tracks.xy.tolist() == [[1, 2], [3, 4], [5, 6], [7, 8]]
    assert tracks.depth is not None
    assert tracks.depth.tolist() == [1, 2, 3, 4]
    assert (tracks.track_count, tracks.names) == (3, ("a", "b"))


def test_views_and_tracks_without_observations_are_kept() -> None:
    tracks = Tracks.from_arrays(VIEW, TRACK, X, Y, views=[View()] * 4, track_count=9)
    assert (len(tracks.to_proto().views), tracks.to_proto().track_count) == (4, 9)
    assert tracks.names == ("view-00000", "view-00001", "view-00002", "view-00003")


def test_arrays_cannot_be_written_to_and_those_given_can() -> None:
    x = np.array(X)
    tracks = Tracks.from_arrays(VIEW, TRACK, x, Y)
    with pytest.raises(ValueError, match="read-only"):
        tracks.x[0] = np.nan
    x[0] = np.nan
    assert tracks.x[0] == 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        tracks.track_count = 7  # type: ignore[misc]


def test_other_views_are_checked_too() -> None:
    tracks = Tracks.from_arrays(VIEW, TRACK, X, Y)
    assert tracks.with_views([View("a"), View("b")]).names == ("a", "b")
    refused("track_set.views[1].name", "of view 0 already", tracks.with_views, [View("a"), View("a")])
    three = Tracks.from_arrays([0, 0, 1, 2], TRACK, X, Y)
    refused("track_set.view_indices[3]", "2 is not below 2", three.with_views, [View(), View()])
    refused("track_set.views", "1 view; at least 2", tracks.with_views, [View()])


@pytest.mark.parametrize("field", ["x", "y", "sigma_px", "depth"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(field: str, value: float) -> None:
    rows: dict[str, Any] = {"x": list(X), "y": list(Y), "sigma_px": [1.0] * 4, "depth": [1.0] * 4}
    rows[field][2] = value
    api = {"x": "xs", "y": "ys", "sigma_px": "sigmas_px", "depth": "depths"}[field]
    error = refused(f"track_set.{api}[2]", f"{field}[2]: {value}", Tracks.from_arrays, VIEW, TRACK, **rows)
    assert len(error.violations) == 1


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        ({"x": [1.0, 2.0, 3.0]}, "track_set.xs", "x has 3"),
        ({"y": [1.0]}, "track_set.ys", "y has 1"),
        ({"track_index": [0, 1]}, "track_set.track_indices", "track_index has 2"),
        ({"sigma_px": [1.0]}, "track_set.sigmas_px", "sigma_px has 1"),
        ({"keypoint_index": [1]}, "track_set.keypoint_index", "keypoint_index has 1"),
        ({"x": [[1.0], [2.0, 3.0], [4.0], [5.0]]}, "track_set.xs", "ragged"),
        ({"x": [[1.0], [2.0], [3.0], [4.0]]}, "track_set.xs", "shape (4, 1)"),
        ({"x": ["1", "2", "3", "4"]}, "track_set.xs", "numbers are needed"),
        ({"x": 1.0}, "track_set.xs", "shape ()"),
        ({"x": [1.0, 2.0, 3.0, 1.1e7]}, "track_set.xs[3]", "from the origin"),
        ({"view_index": [0, 0, 1, -1]}, "track_set.view_indices[3]", "-1 is not a whole number"),
        ({"view_index": [0, 0, 1, 1.5]}, "track_set.view_indices[3]", "1.5 is not a whole number"),
        ({"view_index": [0, 0, 1, np.nan]}, "track_set.view_indices[3]", "nan is not a whole number"),
        ({"view_index": [0, 0, 1, 2**32]}, "track_set.view_indices[3]", "is not a whole number"),
        ({"view_index": ["a"] * 4}, "track_set.view_indices", "whole numbers are needed"),
        ({"track_index": [0, 1, 0, 0]}, "track_set.track_indices[3]", "track 0 is observed a second time in view 1"),
        ({"track_count": 1}, "track_set.track_indices[1]", "not below 1"),
        ({"track_count": "3"}, "track_set.track_count", "'3' is not a whole number"),
        ({"views": [View()] * 2, "camera_groups": np.array([0, 1])}, "track_set.views", "either views, or"),
        ({"width": np.array([640]), "height": 480}, "track_set.views[0].size.width_px", "is not a whole number"),
        ({"track_count": 0}, "track_set.track_count", "0 is not a whole number from 1"),
        ({"views": [View()]}, "track_set.views", "at least 2"),
        ({"views": [View()] * 2, "width": 3}, "track_set.views", "either views, or"),
        ({"views": ["a.jpg", "b.jpg"]}, "track_set.views[0]", "a scpsfm.View is needed"),
        ({"width": 640}, "track_set.views", "width and height are given together"),
        ({"width": 0, "height": 480}, "track_set.views[0].size.width_px", "0 is not a whole number from 1"),
        ({"width": 640, "height": 1_000_001}, "track_set.views[0].size.height_px", "1000001"),
        ({"names": ["a"]}, "track_set.names", "has 1 entry, there are 2"),
        ({"names": ["a", "a"]}, "track_set.views[1].name", "is the name of view 0 already"),
        ({"names": ["a", "b\n"]}, "track_set.views[1].name", "control characters"),
        ({"names": ["a", "\u00e9" * 2049]}, "track_set.views[1].name", "longer than 4096 bytes"),
        ({"camera_groups": [0, -1]}, "track_set.views[1].camera_group", "-1"),
        ({"camera_groups": [0, np.nan]}, "track_set.views[1].camera_group", "nan"),
        ({"camera_groups": [0, "1"]}, "track_set.views[1].camera_group", "'1' is not a whole number"),
        ({"names": ["a", None]}, "track_set.views[1].name", "is None, a text is needed, which is empty"),
        ({"names": ["a", 7]}, "track_set.views[1].name", "is int, a text is needed"),
        ({"width": np.nan, "height": 480}, "track_set.views[0].size.width_px", "nan is not a whole number"),
        ({"width": 640, "height": "480"}, "track_set.views[0].size.height_px", "'480' is not a whole number"),
        ({"views": [View(), View(size=(640, 480, 3))]}, "track_set.views[1].size", "not a width and a height"),
        ({"views": [View(), View(size=640)]}, "track_set.views[1].size", "not a width and a height"),
        ({"focal_prior": 500.0}, "track_set.views[0].focal_prior", "is float, a scpsfm.FocalPrior is needed"),
        ({"focal_prior": FocalPrior(-1.0)}, "track_set.views[0].focal_prior.focal_px", "-1.0"),
        ({"focal_prior": FocalPrior(np.nan)}, "track_set.views[0].focal_prior.focal_px", "nan"),
        ({"focal_prior": FocalPrior(1e10)}, "track_set.views[0].focal_prior.focal_px", "from 1e-06 to 1e+09"),
        ({"focal_prior": FocalPrior("500")}, "track_set.views[0].focal_prior.focal_px", "'500' is not a number"),
        ({"focal_prior": FocalPrior(1.0, np.inf)}, "track_set.views[0].focal_prior.sigma_log", "inf"),
        ({"sigma_px": [1.0, 1.0, 0.0, 1.0]}, "track_set.sigmas_px[2]", "not from 0.0001"),
        ({"depth": [1.0, 1.0, 0.0, 1.0]}, "track_set.depths[2]", "other than 0"),
    ],
)
def test_defects_are_named(change: dict[str, Any], field: str, words: str) -> None:
    given: dict[str, Any] = {"view_index": VIEW, "track_index": TRACK, "x": X, "y": Y, **change}
    refused(field, words, Tracks.from_arrays, **given)


@pytest.mark.parametrize("number", [np.array, np.float64, np.float32])
def test_numbers_may_be_numpys(number: Any) -> None:
    tracks = Tracks.from_arrays(
        VIEW,
        TRACK,
        X,
        Y,
        track_count=number(5),
        width=number(640),
        height=number(480),
        camera_groups=np.array([0, 1]),
        focal_prior=FocalPrior(number(500.0), number(0.125)),
    )
    assert tracks.track_count == 5
    assert tracks.views == tuple(View("", (640, 480), group, FocalPrior(500.0, 0.125)) for group in (0, 1))
    assert isinstance(tracks.views[0].size[0], int)  # type: ignore[index]
    message = tracks.to_proto()
    assert (message.track_count, message.views[1].size.width_px, message.views[1].camera_group) == (5, 640, 1)
    assert message.views[0].focal_prior.focal_px == 500.0


def test_too_little_is_refused() -> None:
    refused("track_set.views", "0 views", Tracks.from_arrays, [], [], [], [])
    refused("track_set.xs", "no observations", Tracks.from_arrays, [], [], [], [], views=[View()] * 2)
    refused("track_set.view_indices", "all observations are in one view", Tracks.from_arrays, [0, 0], [0, 1], [1, 2],
            [1, 2], views=[View()] * 2)  # fmt: skip
    refused("track_set.points", "shape (2, 2)", Tracks.from_points, np.zeros((2, 2)))
    refused("track_set.points", "no array", Tracks.from_points, [[[1, 2]], [[1, 2], [3, 4]]])
    half = np.array([[[1.0, np.nan]], [[1.0, 2.0]]])
    refused("track_set.points[0,0]", "one of the two", Tracks.from_points, half)
    refused("track_set.depths", "shape (1, 1)", Tracks.from_points, np.zeros((2, 1, 2)), depth=[[1.0]])


def test_many_defects_are_counted_and_some_told() -> None:
    error = refused("track_set.xs[0]", "and 12 more", Tracks.from_points, np.full((2, 10, 2), 2e7))
    assert len(error.violations) == 20


def test_random_inputs_are_taken_or_refused_with_a_field() -> None:
    seed = 11
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    taken = refusals = 0
    for _ in range(300):
        count = int(rng.integers(0, 8))
        view = rng.integers(-1, 4, count)
        track = rng.integers(0, 4, count)
        x = rng.choice([0.0, 1.5, np.nan, 1e8], count, p=[0.5, 0.4, 0.05, 0.05])
        try:
            tracks = Tracks.from_arrays(view, track, x, x)
        except scpsfm.InvalidArgument as error:
            assert error.field is not None
            assert error.field.startswith("track_set.")
            refusals += 1
        else:
            pairs = set(zip(tracks.view_index.tolist(), tracks.track_index.tolist(), strict=True))
            assert len(pairs) == count >= 2
            assert np.isfinite(tracks.x).all()
            assert tracks.view_index.tolist() == view.tolist()
            taken += 1
    assert taken > 5
    assert refusals > 5
