"""Reading tables and COLMAP's and OpenSfM's files."""

from __future__ import annotations

import json
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scpsfm import FocalPrior, InvalidArgument, Tracks
from scpsfm._read.colmap_database import MAX_IMAGES
from scpsfm._read.join import join

TABLE = "view,track,x,y\n7,10,1,2\n7,5,3,4\n9,10,5,6\n9,5,7,8.5\n"


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refused(read: Any, path: Path, *words: str, line: int | None = None) -> None:
    with pytest.raises(InvalidArgument) as raised:
        read(path)
    for word in words:
        assert word in str(raised.value)
    assert str(path) in str(raised.value)
    assert raised.value.file is not None
    assert raised.value.line == line
    if line is not None:
        assert f"line {line}" in str(raised.value)


# view,track,x,y


def test_a_table_is_read_with_its_own_numbers(tmp_path: Path) -> None:
    path = write(tmp_path, "o.csv", TABLE)
    tracks = Tracks.from_csv(path, width=640, height=480, names={9: "nine.jpg"}, focal_prior=FocalPrior(300.0))
    assert tracks.view_labels == (7, 9)
    assert tracks.track_labels == (5, 10)
    assert tracks.view_index.tolist() == [0, 0, 1, 1]
    assert tracks.track_index.tolist() == [1, 0, 1, 0]
    assert tracks.x.tolist() == [1, 3, 5, 7]
    assert tracks.y.tolist() == [2, 4, 6, 8.5]
    assert tracks.lines is not None
    assert tracks.lines.tolist() == [2, 3, 4, 5]
    assert [view.name for view in tracks.views] == ["", "nine.jpg"]
    assert {(view.size, view.focal_prior) for view in tracks.views} == {((640, 480), FocalPrior(300.0))}
    assert (tracks.depth, tracks.sigma_px) == (None, None)


def test_tables_as_people_write_them(tmp_path: Path) -> None:
    text = '\ufeff\r\n "Track" , VIEW ,note,y,x,sigma,depth\r\n\r\n1,0,a,1,2,.5,1e1\r\n1,1,,3," 4 ",.25,-2\r\n'
    tracks = Tracks.from_csv(write(tmp_path, "o.csv", text))
    assert tracks.xy.tolist() == [[2, 1], [4, 3]]
    assert tracks.sigma_px is not None
    assert tracks.sigma_px.tolist() == [0.5, 0.25]
    assert tracks.depth is not None
    assert tracks.depth.tolist() == [10, -2]
    assert tracks.lines is not None
    assert tracks.lines.tolist() == [4, 5]


@pytest.mark.parametrize("extra", ["", "\n", "0"])
def test_a_plain_table_and_one_that_is_not_are_read_alike(tmp_path: Path, extra: str) -> None:
    """Blank lines and columns of other names make the reader take the longer way."""
    seed = 12
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    rows = [(v * 7 + 2**60, t * 3, *rng.normal(0, 1e3, 4).tolist()) for v in range(5) for t in range(40)]
    order = rng.permutation(len(rows))
    plain = "track,view,x,y,depth,sigma\n"
    other = plain if extra != "0" else plain.replace("sigma", "sigma,note")
    for k in order:
        view, track, x, y, depth, sigma = rows[k]
        line = f"{track},{view},{x!r},{y!r},{depth!r},{abs(sigma)!r}"
        plain += line + "\n"
        other += line + (f",{extra}\n" if extra == "0" else f"\n{extra}")
    a = Tracks.from_csv(write(tmp_path, "a.csv", plain.removesuffix("\n")))
    b = Tracks.from_csv(write(tmp_path, "b.csv", other))
    assert a.to_proto() == b.to_proto()
    assert (a.view_labels, a.track_labels) == (b.view_labels, b.track_labels)
    assert a.view_labels == tuple(v * 7 + 2**60 for v in range(5))
    assert a.lines is not None
    assert b.lines is not None
    assert a.lines.tolist() == list(range(2, 202))
    assert b.lines.tolist() == list(range(2, 402 if extra == "\n" else 202, 2 if extra == "\n" else 1))
    assert a.x.tolist() == [rows[k][2] for k in order]


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("", ["is empty; a header"], None),
        ("view,track,x,y\n", ["no observations"], None),
        ("0,0,1,2\n", ["no header", "`0,0,1,2`"], 1),
        ("view;track;x;y\n", ["semicolons"], 1),
        ("view\ttrack\tx\ty\n", ["tabs"], 1),
        ("view,track,x\n", ["no column `y`"], 1),
        ("view,track,x,y,x\n", ["`x` twice"], 1),
        ("view,track,x,y\n0,0,1,2\n0,1,nan,2\n", ["x: `nan` is not a finite number"], 3),
        ("view,track,x,y\n0,0,1,-inf\n", ["y: `-inf` is not a finite number"], 2),
        ("view,track,x,y\n0,0,1,1_0\n", ["y: `1_0` is not a number"], 2),
        ("view,track,x,y\n0,0,,1\n", ["x: is empty", "not observed"], 2),
        ("view,track,x,y\n0.0,0,1,1\n", ["view: `0.0` is not a whole number"], 2),
        ("view,track,x,y\n-1,0,1,1\n", ["view: `-1` is not a whole number"], 2),
        ("view,track,x,y\n0,99999999999999999999999,1,1\n", ["track: ", "too large"], 2),
        ("view,track,x,y\n0,0,1\n", ["3 fields where the header has 4", "truncated"], 2),
        ("view,track,x,y\n0,0,1,5,2,5\n", ["6 fields", "marked by a point"], 2),
        ("view,track,x,y\n0,0,1,2\n1,0,1,2\n\n0,0,3,4\n", ["track 0", "second time in view 0", "line 2"], 5),
        ("view,track,x,y\n0,0,1,2\n0,1,3,4\n", ["1 view; at least 2"], None),
        ("view,track,x,y\n0,0,1,2\n1,0,2e7,4\n", ["x[1]", "from the origin"], 3),
        ("view,track,x,y,sigma\n0,0,1,2,1\n1,0,2,4,0\n", ["sigma_px[1]"], 3),
        ("view,track,x,y,depth\n0,0,1,2,1\n1,0,2,4,0\n", ["depth[1]"], 3),
        ("OPENSFM_TRACKS_VERSION_v2\n", ["from_opensfm"], None),
        ("view,track,x,y\n0,0,a,2\n1,0,2,b\n", ["x: `a`", "line 3: y: `b`"], 2),
    ],
)
def test_defects_of_tables_are_named_by_line(tmp_path: Path, text: str, words: list[str], line: int | None) -> None:
    refused(Tracks.from_csv, write(tmp_path, "o.csv", text), *words, line=line)


@pytest.mark.parametrize(
    ("content", "words", "line"),
    [
        (b"SQLite format 3\0...", ["from_colmap_database"], None),
        ("view,track,x,y\n".encode("utf-16"), ["UTF-16"], None),
        (b"view,track\xff,x,y\n", ["not a text file"], 1),
        (b"view,track,x,y\n0,0,1,2\n\xff\n", ["not text; the file may be damaged"], 3),
        (b"view,track,x,y\n0,0,1,\0\n", ["not text"], 2),
    ],
)
def test_bytes_that_are_no_table_are_named(tmp_path: Path, content: bytes, words: list[str], line: int | None) -> None:
    refused(Tracks.from_csv, write(tmp_path, "o.csv", content), *words, line=line)


def test_arguments_of_tables_are_checked(tmp_path: Path) -> None:
    path = write(tmp_path, "o.csv", TABLE)
    with pytest.raises(InvalidArgument, match="has no view 8"):
        Tracks.from_csv(path, names={8: "eight.jpg"})
    with pytest.raises(InvalidArgument, match="together"):
        Tracks.from_csv(path, width=5)
    with pytest.raises(FileNotFoundError):
        Tracks.from_csv(tmp_path / "nowhere.csv")


# OpenSfM


def opensfm(folder: Path, version: int = 2) -> Path:
    middle = {0: "", 1: "\t0.004", 2: "\t0.004"}[version]
    end = {0: "", 1: "", 2: "\t-1\t-1"}[version]
    header = f"OPENSFM_TRACKS_VERSION_v{version}\n" if version else ""
    rows = [("b.jpg", "7", 3, 0.25, -0.125), ("a.jpg", "7", 1, 0.0, 0.0), ("a.jpg", "x y", 2, -0.5, 0.5)]
    text = "".join(f"{i}\t{t}\t{f}\t{x}\t{y}{middle}\t1\t2\t3{end}\n" for i, t, f, x, y in rows)
    for image, camera in (("a.jpg", "v2 one"), ("b.jpg", "v2 two")):
        exif = {"width": 640, "height": 480, "camera": camera, "focal_ratio": 0.9}
        write(folder, f"exif/{image}.exif", json.dumps(exif))
    return write(folder, "tracks.csv", header + text)


@pytest.mark.parametrize("version", [0, 1, 2])
def test_opensfm_tracks_are_read_with_sizes_cameras_and_features(tmp_path: Path, version: int) -> None:
    path = opensfm(tmp_path, version)
    for given in (path, tmp_path):
        tracks = Tracks.from_opensfm(given)
        assert [view.name for view in tracks.views] == ["a.jpg", "b.jpg"]
        assert [view.camera_group for view in tracks.views] == [0, 1]
        assert {view.size for view in tracks.views} == {(640, 480)}
        assert {view.focal_prior for view in tracks.views} == {None}
        assert tracks.track_labels == (7, "x y")
        assert tracks.view_index.tolist() == [1, 0, 0]
        assert tracks.track_index.tolist() == [0, 0, 1]
        # The middle of 640 x 480 pixels is (319.5, 239.5) where the first pixel's centre is (0, 0).
        assert tracks.xy.tolist() == [[479.5, 159.5], [319.5, 239.5], [-0.5, 559.5]]
        assert tracks.keypoint_index is not None
        assert tracks.keypoint_index.tolist() == [3, 1, 2]
    prior = Tracks.from_opensfm(path, focal_sigma_log=0.2).views[0].focal_prior
    assert prior == FocalPrior(0.9 * 640, 0.2)


def test_opensfm_images_without_a_size_are_named(tmp_path: Path) -> None:
    path = opensfm(tmp_path)
    (tmp_path / "exif" / "b.jpg.exif").unlink()
    refused(Tracks.from_opensfm, path, "no size is known of `b.jpg`", line=2)
    tracks = Tracks.from_opensfm(path, width=800, height=600)
    assert [view.size for view in tracks.views] == [(640, 480), (800, 600)]
    assert tracks.notes == ("1 of 2 image sizes were read from exif/; 800 x 600 px is that of the others",)
    for content, words in (("{", "no width and height"), ('{"width": 0, "height": 4}', "0 x 4 px is no size")):
        write(tmp_path, "exif/b.jpg.exif", content)
        refused(Tracks.from_opensfm, path, words, line=2)


def test_a_name_of_an_image_leads_nowhere_outside_the_folder(tmp_path: Path) -> None:
    write(tmp_path, "secret.exif", '{"width": 5, "height": 5}')
    row = "\t1\t1\t0\t0\t0.1\t1\t2\t3\n"
    path = write(tmp_path / "set", "tracks.csv", f"OPENSFM_TRACKS_VERSION_v1\n../../secret{row}")
    (tmp_path / "set" / "exif").mkdir()
    refused(Tracks.from_opensfm, path, "no size is known", line=2)


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("OPENSFM_TRACKS_VERSION_v3\n", ["not a known version"], 1),
        ("OPENSFM_TRACKS_VERSION_v1\n", ["no observations"], None),
        ("OPENSFM_TRACKS_VERSION_v1\na\t1\t1\t0\t0\t1\t2\t3\n", ["8 fields where this version has 9", "truncated"], 2),
        ("OPENSFM_TRACKS_VERSION_v1\na\t1\t1\tnan\t0\t1\t2\t3\t4\n", ["x: `nan`"], 2),
        ("OPENSFM_TRACKS_VERSION_v1\n\t1\t1\t0\t0\t1\t2\t3\t4\n", ["image: has no name"], 2),
        ("OPENSFM_TRACKS_VERSION_v1\na\t\t1\t0\t0\t1\t2\t3\t4\n", ["track_id: has no name"], 2),
    ],
)
def test_defects_of_opensfm_tracks_are_named(tmp_path: Path, text: str, words: list[str], line: int | None) -> None:
    write(tmp_path, "exif/a.exif", '{"width": 5, "height": 5}')
    refused(Tracks.from_opensfm, write(tmp_path, "tracks.csv", text), *words, line=line)


# COLMAP's model

CAMERAS = "# comment\n4 SIMPLE_RADIAL 640 480 500 320 240 0.1\n2 FOV 320 240 1 2 3 4 5\n"
IMAGES = (
    "# comment\n"
    "7 1 0 0 0 0 0 0 4 b with space.jpg\n10.5 20.5 100 1 2 -1 30.5 40.5 200\n"
    "3 1 0 0 0 0 0 0 2 a.jpg\n5.5 6.5 200 7.5 8.5 100 9 9 100\n"
    "9 1 0 0 0 0 0 0 4 c.jpg\n\n"
)


def text_model(folder: Path, cameras: str = CAMERAS, images: str = IMAGES) -> Path:
    write(folder, "cameras.txt", cameras)
    write(folder, "images.txt", images)
    return folder


def binary_model(folder: Path) -> Path:
    cameras = struct.pack("<Q", 2) + struct.pack("<IiQQ4d", 4, 2, 640, 480, 500, 320, 240, 0.1)
    cameras += struct.pack("<IiQQ5d", 2, 7, 320, 240, 1, 2, 3, 4, 5)
    none = 2**64 - 1
    rows: list[tuple[int, int, bytes, list[tuple[float, float, int]]]] = [
        (7, 4, b"b with space.jpg", [(10.5, 20.5, 100), (1, 2, none), (30.5, 40.5, 200)]),
        (3, 2, b"a.jpg", [(5.5, 6.5, 200), (7.5, 8.5, 100), (9, 9, 100)]),
        (9, 4, b"c.jpg", []),
    ]
    images = struct.pack("<Q", len(rows))
    for image, camera, name, points in rows:
        images += struct.pack("<I7dI", image, 1, 0, 0, 0, 0, 0, 0, camera) + name + b"\0"
        images += struct.pack("<Q", len(points)) + b"".join(struct.pack("<ddQ", *point) for point in points)
    write(folder, "cameras.bin", cameras)
    write(folder, "images.bin", images)
    return folder


@pytest.mark.parametrize("make", [text_model, binary_model])
def test_models_are_read_by_name_with_keypoints(tmp_path: Path, make: Any) -> None:
    tracks = Tracks.from_colmap_model(make(tmp_path))
    assert [view.name for view in tracks.views] == ["a.jpg", "b with space.jpg", "c.jpg"]
    assert [view.camera_group for view in tracks.views] == [2, 4, 4]
    assert [view.size for view in tracks.views] == [(320, 240), (640, 480), (640, 480)]
    assert tracks.image_ids is not None
    assert tracks.image_ids.tolist() == [3, 7, 9]
    assert tracks.track_labels == (100, 200)
    assert tracks.view_index.tolist() == [1, 1, 0, 0]
    assert tracks.track_index.tolist() == [0, 1, 1, 0]
    assert tracks.xy.tolist() == [[10, 20], [30, 40], [5, 6], [7, 8]]
    assert tracks.keypoint_index is not None
    assert tracks.keypoint_index.tolist() == [0, 2, 0, 1]
    assert "left out 1 observation beyond" in tracks.notes[0]
    assert "camera 2 is of COLMAP's model FOV" in tracks.notes[1]
    assert (tracks.lines is not None) == (make is text_model)


@pytest.mark.parametrize(
    ("cameras", "images", "words", "line"),
    [
        ("1 MAGIC 1 1\n", IMAGES, ["`MAGIC` is not one"], 1),
        ("1 PINHOLE 5 5 1 2 3\n", IMAGES, ["3 parameters where PINHOLE has 4"], 1),
        ("1 PINHOLE 0 5 1 2 3 4\n", IMAGES, ["size 0 x 5"], 1),
        (CAMERAS + "4 FOV 1 1 1 2 3 4 5\n", IMAGES, ["second time"], 4),
        (CAMERAS, "1 1 0 0 0 0 0 0 5 a\n\n", ["camera 5, which is not among"], 1),
        (CAMERAS, "1 1 0 0 0 0 0 0 4\n\n", ["are needed"], 1),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a\n1 2\n", ["keypoint 0 has no"], 2),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a\n1 nan 3\n", ["keypoint 0: `nan`"], 2),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a\n1 1 3\n1 1 0 0 0 0 0 0 4 b\n1 1 3\n", ["is there a second time"], 3),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a\n1 1 3\n2 1 0 0 0 0 0 0 4 a\n1 1 3\n", ["name 'a'"], 3),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a\n\n", ["no keypoint of a point"], None),
        (CAMERAS, "1 1 0 0 0 0 0 0 4 a", ["no line of keypoints"], 1),
    ],
)
def test_defects_of_models_are_named(
    tmp_path: Path, cameras: str, images: str, words: list[str], line: int | None
) -> None:
    folder = text_model(tmp_path, cameras, images)
    with pytest.raises(InvalidArgument) as raised:
        Tracks.from_colmap_model(folder)
    for word in words:
        assert word in str(raised.value)
    assert raised.value.line == line


def test_a_binary_model_that_is_cut_anywhere_is_refused(tmp_path: Path) -> None:
    folder = binary_model(tmp_path)
    for name in ("cameras.bin", "images.bin"):
        whole = (folder / name).read_bytes()
        for length in range(0, len(whole), 3):
            (folder / name).write_bytes(whole[:length])
            with pytest.raises(InvalidArgument, match="byte") as raised:
                Tracks.from_colmap_model(folder)
            assert raised.value.file == str(folder / name)
        (folder / name).write_bytes(whole + b"\0")
        with pytest.raises(InvalidArgument, match="goes on"):
            Tracks.from_colmap_model(folder)
        (folder / name).write_bytes(whole)


# COLMAP's database


def database(path: Path, *statements: tuple[str, tuple[Any, ...]], raw_only: bool = False) -> Path:
    """Three images of four keypoints each; keypoint k of one is matched with keypoint k of the next, k < 3."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(
            """
            CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER, width INTEGER, height INTEGER,
                params BLOB, prior_focal_length INTEGER);
            CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
            CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
            CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
            CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
            """
        )
        for camera, known in ((1, 1), (2, 0)):
            values = (camera, 2, 640, 480, struct.pack("<4d", 500.0, 320, 240, 0), known)
            connection.execute("INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", values)
        for image, name, camera in ((1, "b.jpg", 1), (2, "a.jpg", 1), (3, "c.jpg", 2)):
            connection.execute("INSERT INTO images VALUES (?, ?, ?)", (image, name, camera))
            points = np.array([[10 * image + k + 0.5, k + 0.5, 1, 0] for k in range(4)], dtype="<f4")
            connection.execute("INSERT INTO keypoints VALUES (?, 4, 4, ?)", (image, points.tobytes()))
        rows = np.array([[k, k] for k in range(3)], dtype="<u4").tobytes()
        for a, b in ((1, 2), (2, 3)):
            for table in ("matches",) if raw_only else ("matches", "two_view_geometries"):
                connection.execute(f"INSERT INTO {table} VALUES (?, 3, 2, ?)", (a * MAX_IMAGES + b, rows))
        for statement, values in statements:
            connection.execute(statement, values)
    return path


def test_a_database_is_joined_into_tracks(tmp_path: Path) -> None:
    tracks = Tracks.from_colmap_database(database(tmp_path / "database.db"))
    assert [view.name for view in tracks.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [view.camera_group for view in tracks.views] == [1, 1, 2]
    assert [view.focal_prior for view in tracks.views] == [FocalPrior(500.0), FocalPrior(500.0), None]
    assert tracks.image_ids is not None
    assert tracks.image_ids.tolist() == [2, 1, 3]
    assert tracks.track_count == 3
    table = sorted(zip(tracks.track_index, tracks.view_index, tracks.x, tracks.y, tracks.keypoint_index, strict=True))
    assert table == [
        (k, view, 10.0 * image + k, float(k), k) for k in range(3) for view, image in ((0, 2), (1, 1), (2, 3))
    ]
    assert "joined 6 verified matches of 2 image pairs into 3 tracks; cut 0 matches, " in tracks.notes[0]


def test_raw_matches_stand_in_where_none_are_verified(tmp_path: Path) -> None:
    path = database(tmp_path / "database.db", raw_only=True)
    assert "raw matches" in Tracks.from_colmap_database(path).notes[0]
    with pytest.raises(InvalidArgument, match="matches='raw'"):
        Tracks.from_colmap_database(path, matches="verified")
    with pytest.raises(InvalidArgument, match="neither"):
        Tracks.from_colmap_database(path, matches="best")


PAIR = 1 * MAX_IMAGES + 3


@pytest.mark.parametrize(
    ("statement", "values", "words"),
    [
        ("UPDATE cameras SET width = 0 WHERE camera_id = 1", (), "table cameras, row 1: size 0 x 480"),
        ("UPDATE cameras SET width = 'wide' WHERE camera_id = 1", (), "row 1: width: str is no whole number"),
        ("UPDATE images SET camera_id = 9 WHERE image_id = 2", (), "table images, row 2: is of camera 9"),
        ("UPDATE images SET name = 'b.jpg'", (), "table images, row 2: the name 'b.jpg'"),
        ("UPDATE images SET name = x'00' WHERE image_id = 3", (), "row 3: name: bytes is no text"),
        ("UPDATE keypoints SET image_id = 8 WHERE image_id = 1", (), "row 8: is of no image"),
        ("UPDATE keypoints SET rows = 5 WHERE image_id = 1", (), "row 1: data: has 64 bytes, 5 x 4"),
        ("UPDATE keypoints SET cols = 1, rows = 16 WHERE image_id = 1", (), "has 1 column,"),
        ("INSERT INTO two_view_geometries VALUES (?, 1, 2, ?)", (PAIR, struct.pack("<2I", 0, 4)), "one is not there"),
        ("INSERT INTO two_view_geometries VALUES (?, 1, 2, ?)", (PAIR + 90, b"\0" * 8), "does not have"),
        ("INSERT INTO two_view_geometries VALUES (?, 1, 2, ?)", (MAX_IMAGES + 1, b"\0" * 8), "with itself"),
        ("INSERT INTO two_view_geometries VALUES (?, 1, 2, ?)", (PAIR, b"\0" * 4), "has 4 bytes"),
        ("DROP TABLE keypoints", (), "no table `keypoints`"),
    ],
)
def test_defects_of_databases_are_named(tmp_path: Path, statement: str, values: tuple[Any, ...], words: str) -> None:
    path = database(tmp_path / "database.db", (statement, values))
    refused(Tracks.from_colmap_database, path, words)


def test_what_is_no_database_is_named(tmp_path: Path) -> None:
    refused(Tracks.from_colmap_database, write(tmp_path, "x.db", b"nothing of the kind" * 99), "cannot be read")
    refused(Tracks.from_colmap_database, write(tmp_path, "empty.db", b""), "no table")
    path = database(tmp_path / "database.db")
    write(tmp_path, "database.db-wal", b"x")
    refused(Tracks.from_colmap_database, path, "let COLMAP end")
    with pytest.raises(FileNotFoundError):
        Tracks.from_colmap_database(tmp_path / "nowhere.db")


def joined(matches: list[tuple[int, int, int]]) -> tuple[list[tuple[int, int]], int]:
    found = join(np.array(matches, dtype=np.int64), np.arange(100) // 10)
    return list(zip(found.keypoints.tolist(), found.track.tolist(), strict=True)), found.cut


def test_components_are_tracks_in_the_order_of_their_keypoints() -> None:
    observations, cut = joined([(21, 32, 1), (10, 25, 1), (0, 10, 1)])
    assert observations == [(0, 0), (10, 0), (25, 0), (21, 1), (32, 1)]
    assert cut == 0


def test_a_match_that_would_join_two_keypoints_of_an_image_is_cut() -> None:
    right = [(0, 10, 1), (10, 20, 1), (0, 20, 1), (1, 11, 1), (11, 21, 1), (1, 21, 1)]
    for place in range(len(right) + 1):
        matches = [*right[:place], (0, 21, 1), *right[place:]]
        assert joined(matches) == ([(0, 0), (10, 0), (20, 0), (1, 1), (11, 1), (21, 1)], 1)
    # Without loops the pair with more matches decides.
    assert joined([(1, 10, 5), (0, 10, 50)]) == ([(0, 0), (10, 0)], 1)


def test_pieces_of_a_point_are_joined_before_a_match_that_stands_alone() -> None:
    matches = [(0, 10, 1), (10, 20, 1), (0, 20, 1), (30, 40, 1), (40, 50, 1), (30, 50, 1)]
    matches += [(0, 30, 1), (10, 40, 1), (20, 31, 9), (50, 1, 9)]
    assert joined(matches) == ([(keypoint, 0) for keypoint in (0, 10, 20, 30, 40, 50)], 2)


def test_no_track_has_two_keypoints_of_an_image_whatever_the_matches() -> None:
    for seed in range(20):
        print(f"seed {seed}")
        rng = np.random.default_rng(seed)
        pairs = rng.integers(0, 80, (60, 2))
        matches = [(a, b, 1) for a, b in pairs.tolist() if a // 10 != b // 10]
        observations, _ = joined(matches)
        seen = [(track, keypoint // 10) for keypoint, track in observations]
        assert len(set(seen)) == len(seen) > 0
        assert joined(matches[::-1])[0] == observations


# Any kind


def test_a_kind_is_told_from_name_and_content(tmp_path: Path) -> None:
    assert Tracks.read(write(tmp_path, "o.csv", TABLE), width=9, height=9).views[0].size == (9, 9)
    assert Tracks.read(opensfm(tmp_path / "sfm")).views[0].name == "a.jpg"
    assert Tracks.read(opensfm(tmp_path / "old", 0)).track_count == 2
    assert Tracks.read(database(tmp_path / "database.db")).track_count == 3
    assert Tracks.read(text_model(tmp_path / "model")).track_count == 2
    refused(Tracks.read, tmp_path / "model" / "images.txt", "give the folder")
    refused(Tracks.read, tmp_path, "give its database.db")
    (tmp_path / "none").mkdir()
    refused(Tracks.read, tmp_path / "none", "cameras and images")
    refused(lambda path: Tracks.read(path, width=1, height=1), tmp_path / "model", "leave out width and height")
    with pytest.raises(FileNotFoundError):
        Tracks.read(tmp_path / "nowhere")
