"""Tracks of photos: SIFT features, matched between all pairs, joined into tracks. Writes view,track,x,y to stdout."""

import sys
from itertools import combinations

import cv2

sift, matcher = cv2.SIFT_create(4000), cv2.BFMatcher()
images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in sys.argv[1:]]
found = [sift.detectAndCompute(image, None) for image in images]
parent = {}  # a keypoint (view, index) -> another of its track


def root(keypoint):
    while parent.setdefault(keypoint, keypoint) != keypoint:
        parent[keypoint] = keypoint = parent[parent[keypoint]]
    return keypoint


for a, b in combinations(range(len(images)), 2):
    for first, second in matcher.knnMatch(found[a][1], found[b][1], k=2):
        if first.distance < 0.8 * second.distance:  # Lowe's ratio test
            parent[root((a, first.queryIdx))] = root((b, first.trainIdx))

tracks = {}  # root -> view -> position; of two keypoints in one view the first counts
for view, index in sorted(parent):
    tracks.setdefault(root((view, index)), {}).setdefault(view, found[view][0][index].pt)
print("view,track,x,y")
for track, seen in enumerate(tracks.values()):
    for view, (x, y) in seen.items():
        print(f"{view},{track},{x},{y}")
print(f"--width {images[0].shape[1]} --height {images[0].shape[0]}", file=sys.stderr)
