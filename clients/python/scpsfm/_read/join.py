"""Joining matches of image pairs into tracks, no track with two keypoints of one image.

A track is a connected component of the matches, but one wrong match joins two points for good. So matches are taken one
by one, the best supported first, and one that would bring two keypoints of an image together is cut: Kruskal's
algorithm under a constraint.

A match is supported by every third keypoint that is matched with both of its ends. Supported matches come first; among
equals, that of the image pair with more matches, then that of the smaller numbers. Then pieces are joined by the number
of matches between them, those first that are each other's best, and then the other matches follow in the same order.
The service itself joins in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Joined", "join"]

_MOST_NEIGHBOURS = 64
"""Neighbours that are looked at for the support of a match, so that one of thousands does not cost the square."""


_PIECE_ROUNDS = 4
"""Rounds in which pieces are joined by the number of matches between them, at most."""


@dataclass(frozen=True)
class Joined:
    """Tracks from matches."""

    keypoints: NDArray[np.int64]
    """Keypoint of each observation: by track, then ascending. (n,)."""

    track: NDArray[np.int64]
    """Track of each observation; tracks are in the order of their first keypoints. (n,)."""

    tracks: int
    cut: int
    """Matches that were cut."""


def join(matches: NDArray[np.int64], image_of: NDArray[np.int64]) -> Joined:
    """Joins matches.

    Args:
        matches: Two keypoints, and the number of matches of their image pair. (n, 3).
        image_of: Image of each keypoint, ascending. (keypoints,).

    """
    known, places = np.unique(matches[:, :2], return_inverse=True)
    pairs = np.sort(places.reshape(-1, 2), axis=1)
    support = _support(pairs, len(known))
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -matches[:, 2], -support))
    parents = list(range(len(known)))
    images = [{int(image)} for image in image_of[known]]

    def root(keypoint: int) -> int:
        while parents[keypoint] != keypoint:
            parents[keypoint] = parents[parents[keypoint]]
            keypoint = parents[keypoint]
        return keypoint

    def link(a: int, b: int) -> bool:
        large, small = root(a), root(b)
        if large == small:
            return True
        if len(images[large]) < len(images[small]):
            large, small = small, large
        if not images[large].isdisjoint(images[small]):
            return False
        parents[small] = large
        images[large] |= images[small]
        images[small] = set()
        return True

    def link_pieces() -> bool:
        between: dict[tuple[int, int], tuple[int, int]] = {}
        for (a, b), size in zip(ranked, sizes, strict=True):
            ends = root(a), root(b)
            if ends[0] != ends[1]:
                ends = min(ends), max(ends)
                count, largest = between.get(ends, (0, 0))
                between[ends] = count + 1, max(largest, size)
        links = [
            (-count, -largest, a, b) for (a, b), (count, largest) in between.items() if images[a].isdisjoint(images[b])
        ]
        has_better: set[int] = set()
        for *_, a, b in sorted(links):
            is_best = a not in has_better and b not in has_better
            has_better.update((a, b))
            if is_best:
                link(a, b)
        return bool(links)

    ranked, sizes = pairs[order].tolist(), matches[order, 2].tolist()
    for a, b in ranked[: int((support > 0).sum())]:
        link(a, b)
    for _ in range(_PIECE_ROUNDS):
        if not link_pieces():
            break
    cut = sum(not link(a, b) for a, b in ranked)
    numbers: dict[int, int] = {}
    keypoints, tracks = [], []
    for place, keypoint in enumerate(known.tolist()):
        head = root(place)
        if len(images[head]) >= 2:
            keypoints.append(keypoint)
            tracks.append(numbers.setdefault(head, len(numbers)))
    track = np.array(tracks, dtype=np.int64)
    by_track = np.argsort(track, kind="stable")
    return Joined(np.array(keypoints, dtype=np.int64)[by_track], track[by_track], len(numbers), cut)


def _support(pairs: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """How many third keypoints support each match. (n,)."""
    neighbours: list[list[int]] = [[] for _ in range(count)]
    for a, b in pairs.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    for row in neighbours:
        row.sort()
    sets = [frozenset(row) for row in neighbours]
    support = np.zeros(len(pairs), dtype=np.int64)
    for place, (a, b) in enumerate(pairs.tolist()):
        few, many = (a, b) if len(neighbours[a]) <= len(neighbours[b]) else (b, a)
        support[place] = sum(keypoint in sets[many] for keypoint in neighbours[few][:_MOST_NEIGHBOURS])
    return support
