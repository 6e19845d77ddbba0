//! COLMAP goes on from what is exported: its mapper from the database, its tools from the model.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::support::program::run;
use crate::support::python::{python, succeeds};

/// Writes a database of ten photographs with raw matches only, more than half of them wrong. Ids of images, frames, rig
/// and camera all differ, names descend where ids ascend, and the camera says nothing of its focal length.
const SCENE: &str = r#"
import sys, numpy, pycolmap
random = numpy.random.default_rng(11)
views, count, clutter, width, height, focal = 10, 500, 150, 1200, 900, 1000.0
points = random.uniform([-3, -2, -2], [3, 2, 2], (count, 3))
seen, ids = [], []
with pycolmap.Database.open(sys.argv[1]) as database:
    camera = pycolmap.Camera.create_from_model_id(7, pycolmap.CameraModelId.SIMPLE_RADIAL, 1440.0, width, height)
    camera_id = database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=3)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)
    for view in range(views):
        angle = 0.12 * (view - views / 2)
        centre = numpy.array([8 * numpy.sin(angle), 0.3 * numpy.sin(2.0 * view), -8 * numpy.cos(angle)])
        forward = -centre / numpy.linalg.norm(centre)
        right = numpy.cross([0.05 * view, 1.0, 0.0], forward)
        right /= numpy.linalg.norm(right)
        rotation = numpy.stack([right, numpy.cross(forward, right), forward])
        local = (points - centre) @ rotation.T
        rays = local[:, :2] / local[:, 2:]
        rays = rays * (1 - 0.08 * (rays**2).sum(axis=1, keepdims=True))
        pixels = rays * focal + [width / 2 + 4, height / 2 - 3] + random.normal(0, 0.4, (count, 2))
        pixels = numpy.concatenate([pixels, random.uniform([0, 0], [width, height], (clutter, 2))])
        inside = ((pixels > 0) & (pixels < [width, height])).all(axis=1) & (random.random(count + clutter) < 0.9)
        kept = random.permutation(numpy.flatnonzero(inside))
        seen.append({point: place for place, point in enumerate(kept)})
        image = pycolmap.Image(name=f"{views - view}.jpg", camera_id=camera_id, image_id=20 + view)
        ids.append(database.write_image(image, use_image_id=True))
        frame = pycolmap.Frame(frame_id=50 + view, rig_id=3)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(ids[view], pixels[kept].astype(numpy.float32))
    for first in range(views):
        for second in range(first + 1, min(views, first + 5)):
            pairs = []
            for point, place in seen[first].items():
                is_right = point < count and point in seen[second] and random.random() < 0.65
                other = seen[second][point] if is_right else random.integers(len(seen[second]))
                pairs.append([place, other])
            pairs = random.permutation(numpy.array(pairs))
            _, unique = numpy.unique(pairs[:, 1], return_index=True)
            database.write_matches(ids[first], ids[second], pairs[unique].astype(numpy.uint32))
"#;

/// Maps the raw database and the exported one, checks that the export is what was asked for, and goes on from the
/// exported model in each of COLMAP's ways. Prints what came of each.
const GO_ON: &str = r#"
import json, os, shutil, sys, time, numpy, pycolmap
raw, out, work = sys.argv[1:]

def told(models, cpu_seconds):
    model = max(models, key=lambda model: model.num_reg_images())
    return dict(models=len(models), images=model.num_reg_images(), points=model.num_points3D(),
        observations=model.compute_num_observations(), error_px=model.compute_mean_reprojection_error(),
        cpu_seconds=round(cpu_seconds, 2))

def measured(name, work_on):
    folder = os.path.join(work, name)
    os.makedirs(folder)
    begin = time.process_time()
    models = work_on(folder)
    results[name] = told(models, time.process_time() - begin)

results = {}
database = os.path.join(work, "raw.db")
shutil.copy(raw, database)
with pycolmap.Database.open(database) as opened:
    names = {image.image_id: image.name for image in opened.read_all_images()}
    keypoints = {id: opened.read_keypoints(id)[:, :2] for id in names}
    raw_matches = sum(len(matches) for matches in opened.read_all_matches()[1])
    pairs = [(a, b) for a in names for b in names if a < b and opened.exists_matches(a, b)]
listed = os.path.join(work, "pairs.txt")
with open(listed, "w") as file:
    file.writelines(f"{names[a]} {names[b]}\n" for a, b in pairs)

def map_raw(folder):
    pycolmap.verify_matches(database, listed)
    return list(pycolmap.incremental_mapping(database, work, folder).values())

measured("raw", map_raw)
exported = os.path.join(work, "exported.db")
shutil.copy(os.path.join(out, "colmap-db", "database.db"), exported)
measured("exported", lambda folder: list(pycolmap.incremental_mapping(exported, work, folder).values()))

# The copy: the same keypoints and matches, and geometries that fit the matches.
worst, kept, configs = 0.0, 0, set()
with pycolmap.Database.open(exported) as opened:
    assert {image.image_id: image.name for image in opened.read_all_images()} == names
    assert all((opened.read_keypoints(id)[:, :2] == keypoints[id]).all() for id in names)
    assert sum(len(matches) for matches in opened.read_all_matches()[1]) == raw_matches
    camera = opened.read_camera(7)
    for a in names:
        for b in names:
            if a < b and opened.exists_two_view_geometry(a, b):
                geometry = opened.read_two_view_geometry(a, b)
                matches = geometry.inlier_matches
                configs.add(pycolmap.TwoViewGeometryConfiguration(geometry.config).name)
                kept += len(matches)
                rays = [numpy.c_[camera.cam_from_img(keypoints[id][matches[:, side]]), numpy.ones(len(matches))]
                    for side, id in enumerate([a, b])]
                lines = rays[0] @ geometry.E.T
                apart = abs((rays[1] * lines).sum(axis=1)) / numpy.linalg.norm(lines[:, :2], axis=1)
                worst = max(worst, float(numpy.median(apart)) * camera.focal_length)
                pose = geometry.cam2_from_cam1
                t = pose.translation
                cross = numpy.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
                assert numpy.allclose(cross @ pose.rotation.matrix(), geometry.E, atol=1e-9)
results["database"] = dict(raw_matches=raw_matches, kept_matches=kept, configs=sorted(configs), worst_median_px=worst,
    model=camera.model.name, known=camera.has_prior_focal_length, focal_px=camera.focal_length)

# The model: the database's images, and all their keypoints.
def model():
    return pycolmap.Reconstruction(os.path.join(out, "colmap"))

for id, image in model().images.items():
    assert image.name == names[id] and image.camera_id == 7 and image.frame_id == id + 30
    at = numpy.array([point.xy for point in image.points2D])
    assert at.shape == keypoints[id].shape and (at == keypoints[id]).all()
results["model"] = told([model()], 0.0)
measured("triangulated", lambda folder: [pycolmap.triangulate_points(model(), exported, work, folder)])
measured("continued", lambda folder: list(pycolmap.incremental_mapping(exported, work, folder,
    input_path=os.path.join(out, "colmap")).values()))

def adjusted(folder):
    refined = model()
    pycolmap.bundle_adjustment(refined)
    refined.update_point_3d_errors()
    return [refined]

measured("adjusted", adjusted)
print(json.dumps(results))
"#;

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

#[test]
fn colmap_goes_on_from_the_exported_database_and_model() {
    let Some(python) = python("COLMAP's mapper", "pycolmap") else { return };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let database = path("database.db");
    succeeds(Command::new(&python).args(["-c", SCENE]).arg(&database));
    let before = fs::read(&database).expect("a database");
    let solved = run([
        "solve",
        text(&database),
        "--out",
        text(&path("out")),
        "--method",
        "geometry",
        "--json",
        "--export",
        "colmap-db,colmap",
    ]);
    assert_eq!(solved.code, Some(0), "{solved:?}");
    assert!(!solved.stderr.contains("exported"), "{solved:?}");
    assert!(fs::read(&database).expect("a database") == before, "the input was changed");
    let result: Value = serde_json::from_str(&solved.stdout).expect("JSON");
    let registered = result["registered_views"].as_u64().expect("a count");
    assert_eq!(registered, 10, "{result}");

    fs::create_dir(path("work")).expect("created");
    let printed = succeeds(Command::new(&python).args(["-c", GO_ON]).args([&database, &path("out"), &path("work")]));
    let last = printed.lines().last().expect("a line");
    let found: Value = serde_json::from_str(last).unwrap_or_else(|error| panic!("{error} in {printed}"));
    println!("{found:#}");
    let number =
        |run: &str, name: &str| found[run][name].as_f64().unwrap_or_else(|| panic!("no {name} of {run}: {found}"));
    for run in ["exported", "model", "triangulated", "continued", "adjusted"] {
        assert!(number(run, "images") >= number("raw", "images"), "{run}: {found}");
        assert!(number(run, "points") >= 0.9 * number("raw", "points"), "{run}: {found}");
    }
    for run in ["exported", "triangulated", "continued", "adjusted"] {
        assert!(number(run, "error_px") < number("raw", "error_px"), "{run}: {found}");
    }
    assert_eq!(found["database"]["configs"], serde_json::json!(["CALIBRATED"]), "{found}");
    assert_eq!((&found["database"]["model"], &found["database"]["known"]), (&"SIMPLE_RADIAL".into(), &true.into()));
    assert!(number("database", "worst_median_px") < 1.0, "{found}");
    assert!((number("database", "focal_px") / 1000.0 - 1.0).abs() < 0.03, "{found}");
}
