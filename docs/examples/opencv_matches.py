"""Solves photos on a server: SIFT features, matched between all pairs. The server joins the matches into tracks."""

import sys
from itertools import combinations

import cv2
import scpsfm

address, *photos = sys.argv[1:]
sift, matcher = cv2.SIFT_create(4000), cv2.BFMatcher()
images = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in photos]
found = [sift.detectAndCompute(image, None) for image in images]
pairs = {}
for a, b in combinations(range(len(images)), 2):
    candidates = matcher.knnMatch(found[a][1], found[b][1], k=2)
    # Lowe's ratio test
    pairs[a, b] = [(m.queryIdx, m.trainIdx) for m, second in candidates if m.distance < 0.8 * second.distance]
matches = scpsfm.Matches(
    keypoints=[cv2.KeyPoint.convert(keypoints) for keypoints, _ in found],
    pairs=pairs,
    views=[
        scpsfm.View(name=path, size=(image.shape[1], image.shape[0]))
        for path, image in zip(photos, images, strict=True)
    ],
)
with scpsfm.Client(address) as client:
    result = client.solve(matches)
print(result.grade, result.focal_px, int(result.tracks.inlier.sum()), "right tracks")
for camera in result.cameras:
    print(camera.name, camera.K, camera.R, camera.t)
