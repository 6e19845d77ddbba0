"""Matches from arrays: what is sent, what is refused, and the tracks that come back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from scpsfm import FocalPrior, InternalError, InvalidArgument, Matches, View
from scpsfm._stubs import input_pb2, result_pb2

KEYPOINTS: list[Any] = [[(10, 50), (20, 60), (30, 70)], [(12, 51), (22, 61)], [(14.5, 52), (24, 62)]]
PAIRS: dict[tuple[int, int], Any] = {(0, 1): [(0, 1), (1, 0)], (1, 2): [(1, 0)]}


def matches(**more: Any) -> Matches:
    return Matches(**{"keypoints": KEYPOINTS, "pairs": PAIRS, **more})


def test_the_message_is_that_of_the_proto_comment() -> None:
    found = matches(names=["a.jpg", "b.jpg", "c.jpg"], width=640, height=480, focal_prior=FocalPrior(500.0))
    message = found.to_proto()
    assert [view.name for view in message.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert {view.size.width_px for view in message.views} == {640}
    assert {view.focal_prior.focal_px for view in message.views} == {500.0}
    assert list(message.keypoint_counts) == [3, 2, 2]
    assert list(message.xs) == [10, 20, 30, 12, 22, 14.5, 24]
    assert list(message.ys) == [50, 60, 70, 51, 61, 52, 62]
    assert (list(message.first_view_indices), list(message.second_view_indices)) == ([0, 1], [1, 2])
    assert list(message.match_counts) == [2, 1]
    assert list(message.first_keypoint_indices) == [0, 1, 1]
    assert list(message.second_keypoint_indices) == [1, 0, 0]
    assert repr(found) == "Matches(3 views, 7 keypoints, 2 pairs, 3 matches)"


def test_head_and_chunks_add_up_to_the_message() -> None:
    count = 40_000
    many = Matches([np.zeros((count, 2)), np.ones((count, 2))], {(1, 0): np.arange(count).repeat(2).reshape(-1, 2)})
    whole = many._head()
    chunks = list(many._chunks())
    for chunk in chunks:
        for field, values in chunk.ListFields():
            getattr(whole, field.name).extend(values)
    assert len(chunks) == 5
    assert whole == many.to_proto()


def test_empty_pairs_are_left_out_and_a_match_counts_once() -> None:
    found = matches(pairs={(0, 1): [(2, 1), (0, 0), (2, 1)], (0, 2): [], (2, 1): np.zeros((0, 2), dtype=int)})
    assert list(found.pairs) == [(0, 1)]
    assert found.pairs[0, 1].tolist() == [[0, 0], [2, 1]]
    assert len(found) == 2


@pytest.mark.parametrize(
    ("more", "field", "words"),
    [
        ({"pairs": {}}, "pairs", "no matches"),
        ({"pairs": {(0, 0): [(0, 0)]}}, "pairs[0,0]", "matched with itself"),
        ({"pairs": {(0, 3): [(0, 0)]}}, "pairs[0,3]", "view 3 is outside the 3 views"),
        ({"pairs": {(0, 1): [(0, 0)], (1, 0): [(0, 0)]}}, "pairs[1,0]", "give a pair once"),
        ({"pairs": {(0, 1): [(0, 0), (1, 2)]}}, "pairs[0,1][1,1]", "2 is outside the 2 keypoints of view 1"),
        ({"pairs": {(0, 1): [(-1, 0)]}}, "pairs[0,1][0,0]", "-1 is outside"),
        ({"pairs": {(0, 1): [(0.5, 0)]}}, "pairs[0,1]", "whole numbers"),
        ({"pairs": {(0, 1): [0, 1]}}, "pairs[0,1]", "two numbers an entry"),
        ({"pairs": {7: [(0, 1)]}}, "pairs", "no pair of views"),
        ({"keypoints": [*KEYPOINTS[:2], [(float("nan"), 1)]]}, "keypoints[2][0,0]", "no position"),
        ({"keypoints": [*KEYPOINTS[:2], [(0, 1e9)]]}, "keypoints[2][0,1]", "no position"),
        ({"keypoints": [*KEYPOINTS[:2], [1, 2, 3]]}, "keypoints[2]", "two numbers an entry"),
        ({"keypoints": KEYPOINTS[:1]}, "views", "at least 2"),
        ({"views": [View()] * 2}, "views", "keypoints of 3 views"),
        ({"names": ["a"]}, "names", "has 1 entry, there are 3"),
        ({"camera_groups": [0]}, "camera_groups", "has 1 entry"),
        ({"width": 640}, "views", "width and height"),
        ({"names": ["a", "b", "a"]}, "views[2].name", "name of view 0"),
    ],
)
def test_defects_are_named(more: dict[str, Any], field: str, words: str) -> None:
    with pytest.raises(InvalidArgument, match=words) as caught:
        matches(**more)
    assert caught.value.field == f"match_set.{field}"


def joined(change: Callable[[Any], None] = lambda _: None) -> result_pb2.JobResult:
    message = result_pb2.JobResult()
    message.joined_tracks.view_indices.extend([0, 1, 2, 0, 1])
    message.joined_tracks.track_indices.extend([0, 0, 0, 1, 1])
    message.joined_tracks.keypoint_indices.extend([0, 1, 0, 1, 0])
    change(message.joined_tracks)
    return message


def test_the_tracks_that_the_server_joined_come_back() -> None:
    tracks = matches(names=["a", "b", "c"])._joined(joined())
    assert (tracks.track_count, tracks.names) == (2, ("a", "b", "c"))
    assert tracks.track_index.tolist() == [0, 0, 0, 1, 1]
    assert tracks.xy.tolist() == [[10, 50], [22, 61], [14.5, 52], [20, 60], [12, 51]]
    assert tracks.keypoint_index is not None
    assert tracks.keypoint_index.tolist() == [0, 1, 0, 1, 0]


def test_what_no_server_sends_is_told() -> None:
    def of_no_view(tracks: Any) -> None:
        tracks.view_indices[2] = 3

    def of_no_keypoint(tracks: Any) -> None:
        tracks.keypoint_indices[1] = 2

    for change in (lambda tracks: tracks.Clear(), of_no_view, of_no_keypoint):
        with pytest.raises(InternalError):
            matches()._joined(joined(change))


def test_views_are_those_of_a_track_set() -> None:
    views = [View("a.jpg", (640, 480), 3, FocalPrior(500.0, 0.2)), View(), View()]
    head = matches(views=views)._head()
    expected = input_pb2.View(name="a.jpg", camera_group=3)
    expected.size.width_px, expected.size.height_px = 640, 480
    expected.focal_prior.focal_px, expected.focal_prior.sigma_log = 500.0, 0.2
    assert list(head.views) == [expected, input_pb2.View(), input_pb2.View()]
