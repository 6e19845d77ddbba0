"""COLMAP as the peer of `scpsfm evaluate --peer`: solves tracks with pycolmap's incremental mapper.

    pip install pycolmap numpy
    scpsfm evaluate --photographed --seeds 60 --peer 'python docs/examples/colmap_peer.py'

Usage: colmap_peer.py observations.csv WIDTH HEIGHT -o FILE. The model is SIMPLE_RADIAL, one camera, with COLMAP's
default options and its default first focal length of 1.2 times the longer side. Matches are those of the tracks.
"""

import argparse
import csv
import json
import tempfile
from collections import defaultdict
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

parser = argparse.ArgumentParser()
parser.add_argument("observations")
parser.add_argument("width", type=int)
parser.add_argument("height", type=int)
parser.add_argument("-o", "--out", required=True)
args = parser.parse_args()
pycolmap.logging.minloglevel = 3

with open(args.observations, newline="") as file:
    rows = [(int(r["view"]), int(r["track"]), float(r["x"]), float(r["y"])) for r in csv.DictReader(file)]
keypoints = defaultdict(dict)  # view -> track -> (line, x, y)
for line, (view, track, x, y) in enumerate(rows):
    # COLMAP puts the centre of the top-left pixel at (0.5, 0.5).
    keypoints[view][track] = (line, x + 0.5, y + 0.5)
views = sorted(keypoints)
place = {view: {track: k for k, track in enumerate(keypoints[view])} for view in views}
lines = {view: [entry[0] for entry in keypoints[view].values()] for view in views}

with tempfile.TemporaryDirectory() as directory:
    database = Path(directory) / "database.db"
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        focal = 1.2 * max(args.width, args.height)
        model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera = pycolmap.Camera.create_from_model_id(1, model, focal, args.width, args.height)
        camera.camera_id = db.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        for image_id, view in enumerate(views, 1):
            image = pycolmap.Image(name=f"{view}.png", camera_id=camera.camera_id, image_id=image_id)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_image(image, use_image_id=True)
            points = [entry[1:] for entry in keypoints[view].values()]
            db.write_keypoints(image_id, np.array(points, np.float32))
        for (i, first), (j, second) in combinations(enumerate(views, 1), 2):
            shared = [(place[first][track], place[second][track]) for track in place[first] if track in place[second]]
            if shared:
                db.write_matches(i, j, np.array(shared, np.uint32))
    pycolmap.geometric_verification(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    models = pycolmap.incremental_mapping(database, directory, Path(directory) / "models", options)

    answer = {"views": 0, "focal": None, "observation_inlier": [0] * len(rows)}
    if models:
        best = max(models.values(), key=lambda model: model.num_reg_images())
        answer["views"] = best.num_reg_images()
        answer["focal"], answer["k1"] = float(best.cameras[1].params[0]), float(best.cameras[1].params[3])
        answer["reproj"] = best.compute_mean_reprojection_error()
        for point in best.points3D.values():
            for element in point.track.elements:
                answer["observation_inlier"][lines[views[element.image_id - 1]][element.point2D_idx]] = 1
        kept = [(row[0], row[1]) for row, inlier in zip(rows, answer["observation_inlier"]) if inlier]
        answer["observations"] = kept
    Path(args.out).write_text(json.dumps(answer))
