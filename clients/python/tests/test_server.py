"""Both clients against a real server: SCPSFM_BIN names it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scpsfm
from scpsfm import _flows as flows

from . import scene, support
from .flaky import Flaky

HERE = Path(__file__).resolve().parent.parent
NO_PATIENCE = scpsfm.RetryPolicy(patience_s=0.0)


@pytest.fixture(scope="module")
def table(small: scene.Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write_csv(small.tracks, tmp_path_factory.mktemp("table") / "observations.csv")


def f1(found: Any, right: Any) -> float:
    return float(2 * (found & right).sum() / (found.sum() + right.sum()))


def test_a_solve_finds_the_truth(real: Any, small: scene.Scene) -> None:
    told: list[scpsfm.Progress] = []
    result = real.solve(small.tracks, progress=told.append)
    assert result.status == "SOLVED"
    assert result.is_metric
    assert result.focal_px == pytest.approx(small.focal_px, rel=0.05)
    assert f1(result.tracks.inlier, small.right) > 0.95
    assert [camera.name for camera in result.cameras] == list(small.tracks.names)
    assert all(camera.is_registered for camera in result.cameras)
    # Poses, calibration and points together image what was observed.
    errors_px = [
        np.linalg.norm(result.cameras[view].project(result.tracks.points[track][None])[0] - small.tracks.xy[k])
        for k, (view, track) in enumerate(zip(small.tracks.view_index, small.tracks.track_index, strict=True))
        if result.observations.inlier[k] and np.isfinite(result.tracks.points[track]).all()
    ]
    assert len(errors_px) > 400
    assert np.median(errors_px) < 2.0
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)
    assert [progress.sequence for progress in told] == sorted({progress.sequence for progress in told})


def test_a_webhook_is_sent_along_and_refused_by_a_server_without_a_secret(real: Any, small: scene.Scene) -> None:
    for wrong, field in (("https://hooks.example/jobs", "job.webhook"), ("ftp://hooks.example/", "job.webhook.url")):
        with pytest.raises(scpsfm.InvalidArgument) as refused:
            real.submit(small.tracks, webhook=wrong)
        assert refused.value.field == field


def test_a_job_gives_the_same_as_a_solve_and_its_events_are_resumed(real: Any, small: scene.Scene) -> None:
    settings = scpsfm.Settings(method="geometry", seed=5)
    job = real.submit(small.tracks, settings, labels={"kind": "same"}, priority=3)
    assert job.known.labels == {"kind": "same"}
    assert (job.known.view_count, job.known.track_count) == (8, 120)
    assert job.known.observation_count == len(small.tracks)
    result = job.result(timeout=support.PATIENCE)
    solved = real.solve(small.tracks, settings)
    assert result.method == solved.method == "GEOMETRY"
    assert result.seed == 5
    assert np.array_equal(result.tracks.weight, solved.tracks.weight)
    assert np.array_equal(result.points, solved.points)
    events = list(job.events())
    sequences = [event.sequence for event in events]
    assert sequences == list(range(1, len(sequences) + 1))
    assert events[-1].state is scpsfm.JobState.SUCCEEDED
    (summary,) = [event.summary for event in events if event.summary is not None]
    assert summary.focal_px == result.focal_px
    assert [event.sequence for event in job.events(after_sequence=sequences[-3])] == sequences[-2:]
    assert list(job.events(after_sequence=sequences[-1])) == []
    progress = list(job.progress())
    assert [entry.sequence for entry in progress] == [event.sequence for event in events if event.progress is not None]
    info = job.info()
    assert (info.state, info.summary.grade, info.end_time >= info.create_time) == ("SUCCEEDED", result.grade, True)
    assert result.job == job.name


def test_every_kind_of_input_is_taken(real: Any, small: scene.Scene, tmp_path: Path) -> None:
    points = np.full((8, 120, 2), np.nan)
    points[small.tracks.view_index, small.tracks.track_index] = small.tracks.xy
    database = tmp_path / "database.db"
    scpsfm.to_colmap_database(small.tracks, database)
    inputs = [
        scpsfm.Tracks.from_points(points, width=scene.WIDTH, height=scene.HEIGHT),
        scpsfm.Tracks.from_csv(
            scene.write_csv(small.tracks, tmp_path / "o.csv"), width=scene.WIDTH, height=scene.HEIGHT
        ),
        scpsfm.Tracks.from_colmap_database(database),
        scpsfm.Tracks.read(scene.write_opensfm(small.tracks, tmp_path / "opensfm")),
    ]
    jobs = real.submit_batch(inputs, scpsfm.Settings(method="geometry"))
    for job, tracks in zip(jobs, inputs, strict=True):
        result = job.result(timeout=support.PATIENCE)
        assert result.focal_px == pytest.approx(small.focal_px, rel=0.05), tracks
        assert len(result.tracks.inlier) == tracks.track_count
        assert [camera.name for camera in result.cameras] == [view.name for view in tracks.views]


def matched(tracks: scpsfm.Tracks) -> scpsfm.Matches:
    """Every observation as a keypoint, in the order of the observations, and a match for every two of a track."""
    of_view = [np.flatnonzero(tracks.view_index == view) for view in range(len(tracks.views))]
    pairs = {}
    for first, second in combinations(range(len(of_view)), 2):
        tracks_of = [tracks.track_index[of_view[view]] for view in (first, second)]
        _, in_first, in_second = np.intersect1d(*tracks_of, return_indices=True)
        pairs[first, second] = np.stack([in_first, in_second], axis=1)
    return scpsfm.Matches([tracks.xy[rows] for rows in of_view], pairs, views=tracks.views)


def test_matches_are_joined_into_the_tracks_that_they_come_from(real: Any, small: scene.Scene) -> None:
    matches = matched(small.tracks)
    settings = scpsfm.Settings(method="geometry")
    solved = real.solve(matches, settings)
    stored = real.submit(real.upload(matches), settings).result(timeout=support.PATIENCE)
    tracks = solved.input
    assert isinstance(tracks, scpsfm.Tracks)
    assert tracks.keypoint_index is not None
    lengths = np.bincount(small.tracks.track_index)
    assert len(tracks) == lengths[lengths >= 2].sum() == len(solved.observations.inlier)
    of_keypoint = {}
    for view in range(len(small.tracks.views)):
        rows = np.flatnonzero(small.tracks.view_index == view)
        of_keypoint.update({(view, k): int(small.tracks.track_index[row]) for k, row in enumerate(rows)})
    names = {}
    for view, keypoint, track in zip(tracks.view_index, tracks.keypoint_index, tracks.track_index, strict=True):
        right = of_keypoint[int(view), int(keypoint)]
        assert names.setdefault(int(track), right) == right
    assert len(set(names.values())) == tracks.track_count == len(solved.tracks.inlier)
    assert solved.focal_px == pytest.approx(small.focal_px, rel=0.05)
    assert np.array_equal(solved.points, stored.points)
    assert stored.message.joined_tracks == solved.message.joined_tracks
    assert stored.message.joined_tracks.cut_match_count == 0
    job = real.submit(matches, settings)
    assert job.known.track_count == tracks.track_count
    assert job.result(timeout=support.PATIENCE).input.track_count == tracks.track_count


def test_sigmas_depths_groups_and_priors_are_taken(real: Any, small: scene.Scene) -> None:
    tracks = scpsfm.Tracks.from_arrays(
        small.tracks.view_index,
        small.tracks.track_index,
        small.tracks.x,
        small.tracks.y,
        track_count=125,
        views=[
            *(
                scpsfm.View(view.name, view.size, 7, scpsfm.FocalPrior(small.focal_px, 0.05))
                for view in small.tracks.views
            ),
            scpsfm.View("nothing is seen here"),
        ],
        sigma_px=np.full(len(small.tracks), 0.5),
    )
    result = real.solve(tracks)
    assert len(result.cameras) == 9
    assert len(result.tracks.inlier) == 125
    assert result.cameras[8].left_out.reason == "NO_OBSERVATIONS"
    assert result.cameras[8].name == "nothing is seen here"
    assert {calibration.camera_group for calibration in result.calibrations} >= {7}
    assert result.cameras[0].focal_px == pytest.approx(small.focal_px, rel=0.05)


def test_what_the_server_finds_fault_with_is_named(real: Any, small: scene.Scene, table: Path) -> None:
    for settings, field in (
        (scpsfm.Settings(alpha=-1.0), "settings.alpha"),
        (scpsfm.Settings(iterations=100_000), "settings.iterations"),
    ):
        for call in (real.submit, real.solve):
            with pytest.raises(scpsfm.InvalidArgument) as raised:
                call(small.tracks, settings)
            assert raised.value.field in (field, f"job.{field}")
            assert raised.value.reason == "INVALID_ARGUMENT"
    tracks = scpsfm.Tracks.from_csv(table)
    # What this client would not let through.
    x = np.array(tracks.x)
    x[17] = np.nan
    object.__setattr__(tracks, "x", x)
    for call in (real.submit, real.solve, real.upload, lambda tracks: real.submit_batch([small.tracks, tracks])):
        with pytest.raises(scpsfm.InvalidArgument) as raised:
            call(tracks)
        assert raised.value.field is not None
        assert raised.value.field.endswith("track_set.xs[17]")
        assert (raised.value.file, raised.value.line) == (str(table), 19)
        assert f"{table}: line 19" in str(raised.value)


def test_the_client_refuses_what_the_server_would(real: Any, small: scene.Scene) -> None:
    """Both have the same rules, and the same names of fields."""
    changes: list[tuple[str, Any]] = [
        ("xs", lambda message: message.xs.__setitem__(3, float("inf"))),
        ("ys", lambda message: message.ys.__setitem__(3, 1.0e7 + 1)),
        ("view_indices", lambda message: message.view_indices.__setitem__(3, 8)),
        ("track_indices", lambda message: message.track_indices.__setitem__(3, 120)),
        ("sigmas_px", lambda message: message.sigmas_px.extend([0.0] * len(message.xs))),
        ("depths", lambda message: message.depths.extend([0.0] * len(message.xs))),
        ("views[1]", lambda message: setattr(message.views[1], "name", message.views[0].name)),
        ("views[1]", lambda message: setattr(message.views[1], "name", "a\x01")),
        ("views[1]", lambda message: setattr(message.views[1], "name", "a" * 4097)),
        ("views[1]", lambda message: setattr(message.views[1].size, "width_px", 0)),
        ("views[1]", lambda message: setattr(message.views[1].focal_prior, "focal_px", -1.0)),
    ]
    for field, change in changes:
        message = small.tracks.to_proto()
        change(message)

        class Raw(scpsfm.Tracks):
            def __init__(self, message: Any) -> None:
                object.__setattr__(self, "_message", message)
                object.__setattr__(self, "file", None)

            def to_proto(self) -> Any:
                return self._message  # type: ignore[attr-defined]

        with pytest.raises(scpsfm.InvalidArgument) as raised:
            real.submit(Raw(message))
        theirs = str(raised.value.field)
        with pytest.raises(scpsfm.InvalidArgument) as raised:
            scene.from_proto(message)
        ours = str(raised.value.field)
        assert theirs.startswith(f"track_set.{field}"), (field, theirs)
        # The server may name the message where this client names the field in it.
        assert ours.startswith(theirs) or theirs.startswith(ours), (ours, theirs)


def test_a_request_id_stands_for_one_job(real: Any, small: scene.Scene) -> None:
    request_id = str(uuid.uuid4())
    job = real.submit(small.tracks, request_id=request_id)
    assert real.submit(small.tracks, request_id=request_id).name == job.name
    with pytest.raises(scpsfm.AlreadyExists):
        real.submit(small.tracks, priority=1, request_id=request_id)
    other = real.submit(small.tracks, job_id=f"mine-{request_id}")
    assert other.name.endswith(f"/mine-{request_id}")
    # The last part of a name is enough, for every call.
    short = real.job(f"mine-{request_id}")
    assert short.result().job == other.name
    assert list(short.events())[-1].state == "SUCCEEDED"
    assert short.cancel().name == other.name
    short.delete()
    job.wait()
    job.delete()
    with pytest.raises(scpsfm.NotFound) as raised:
        job.info()
    assert raised.value.reason == "JOB_NOT_FOUND"


def test_jobs_are_listed_by_label_and_page(real: Any, small: scene.Scene) -> None:
    label = str(uuid.uuid4())
    settings = scpsfm.Settings(method="geometry")
    jobs = real.submit_batch([small.tracks] * 5, settings, labels={"run": label}, request_id=label)
    again = real.submit_batch([small.tracks] * 5, settings, labels={"run": label}, request_id=label)
    assert [job.name for job in again] == [job.name for job in jobs]
    found = list(real.jobs(f'labels.run = "{label}"', page_size=2, order_by="create_time"))
    assert [job.name for job in found] == sorted(job.name for job in jobs) or {job.name for job in found} == {
        job.name for job in jobs
    }
    assert len(found) == 5
    with pytest.raises(scpsfm.InvalidArgument) as raised:
        list(real.jobs("nonsense"))
    assert raised.value.field == "filter"
    for job in jobs:
        job.wait()


def slow(tracks: int = 1500) -> tuple[scpsfm.Tracks, scpsfm.Settings]:
    """A job that goes on until it is stopped."""
    return scene.make(seed=4, tracks=tracks).tracks, scpsfm.Settings(method="scpsfm", iterations=10_000)


def test_a_job_is_cancelled_and_waits_are_given_up(real: Any) -> None:
    job = real.submit(*slow())
    with pytest.raises(scpsfm.DeadlineExceeded):
        job.result(timeout=0.2)
    assert not job.state().is_final
    with pytest.raises(scpsfm.FailedPrecondition):
        job.delete()
    job.cancel()
    with pytest.raises(scpsfm.JobCancelled) as raised:
        job.result()
    assert raised.value.job == job.name
    assert job.cancel().state == "CANCELLED"
    assert not job.retry().state.is_final
    job.cancel()
    assert job.wait().state == "CANCELLED"
    with pytest.raises(scpsfm.FailedPrecondition):
        job.set_priority(1)
    job.delete()


def test_a_solve_that_is_given_up_leaves_no_job(real: Any) -> None:
    tracks, settings = slow()
    label = str(uuid.uuid4())
    with pytest.raises(scpsfm.DeadlineExceeded):
        real.solve(tracks, settings, labels={"run": label}, timeout=4.0)
    (job,) = real.jobs(f'labels.run = "{label}"')
    assert job.wait().state == "CANCELLED"


def test_a_time_limit_ends_a_job(real: Any) -> None:
    tracks, settings = slow()
    with pytest.raises(scpsfm.JobDeadlineExceeded):
        real.solve(tracks, settings, time_limit=0.3)
    with pytest.raises(scpsfm.JobDeadlineExceeded):
        real.submit(tracks, settings, time_limit=0.3).result()


def test_an_uploaded_input_is_shared_by_jobs(server: support.Server, kind: str, small: scene.Scene) -> None:
    # The seed differs by client, so that neither finds the other's input.
    other = scene.make(seed=21 if kind == "sync" else 22)
    with support.client_of(kind, server.address, upload_above_bytes=1000) as client:
        told: list[tuple[int, int]] = []
        stored = client.upload(other.tracks, on_upload=lambda have, whole: told.append((have, whole)))
        assert stored.observation_count == len(other.tracks)
        assert stored.sha256 == flows.Encoded("track_set", other.tracks.to_proto()).sha256
        assert told[0] == (0, stored.size_bytes)
        assert told[-1] == (stored.size_bytes, stored.size_bytes)
        job = client.submit(other.tracks, scpsfm.Settings(method="geometry"))
        assert job.known.input == stored.name
        second = client.submit(stored, scpsfm.Settings(method="geometry", seed=1))
        assert second.known.input == stored.name
        assert stored.name in [entry.name for entry in client.inputs()]
        solved = client.solve(stored, scpsfm.Settings(method="geometry"))
        assert np.array_equal(solved.tracks.inlier, job.result().tracks.inlier)
        assert solved.input is None
        with pytest.raises(scpsfm.InvalidArgument, match="with_tracks"):
            solved.to_opensfm("nowhere")
        client.delete_input(stored)
        for one in (job, second):
            assert one.result().focal_px == pytest.approx(other.focal_px, rel=0.05)
        with pytest.raises(scpsfm.NotFound) as raised:
            client.submit(stored)
        assert raised.value.reason == "INPUT_NOT_FOUND"


def test_a_large_solve_goes_in_chunks(real: Any) -> None:
    tracks = scene.make(seed=6, views=10, tracks=3000, wrong=0.1).tracks
    assert len(tracks) > flows.SMALL_OBSERVATIONS
    label = str(uuid.uuid4())
    events = 0

    class Enough(BaseException):
        pass

    def stop(progress: scpsfm.Progress) -> None:
        nonlocal events
        events += 1
        raise Enough

    with pytest.raises(Enough):
        real.solve(tracks, slow()[1], labels={"run": label}, progress=stop)
    (job,) = real.jobs(f'labels.run = "{label}"')
    assert job.known.observation_count == len(tracks)
    assert job.wait().state == "CANCELLED"
    assert events == 1


def test_colmap_maps_what_was_solved(server: support.Server, tmp_path: Path) -> None:
    """Half of the tracks are wrong: the database of the result leads COLMAP to the true camera."""
    pycolmap = pytest.importorskip("pycolmap")
    one = scene.make(seed=14, views=9, tracks=200, wrong=0.5)
    with scpsfm.Client(server.address) as client:
        result = client.solve(one.tracks)
    assert result.focal_px == pytest.approx(one.focal_px, rel=0.05)
    result.to_colmap_database(tmp_path / "database.db")
    for folder in ("images", "out"):
        (tmp_path / folder).mkdir()
    models = pycolmap.incremental_mapping(tmp_path / "database.db", tmp_path / "images", tmp_path / "out")
    assert len(models) == 1
    assert models[0].num_reg_images() == 9
    (camera,) = models[0].cameras.values()
    assert camera.focal_length_x == pytest.approx(one.focal_px, rel=0.05)
    # And back: its model is solved again, under the names of the images.
    tracks = scpsfm.Tracks.from_colmap_model(tmp_path / "out" / "0")
    with scpsfm.Client(server.address) as client:
        again = client.solve(tracks, scpsfm.Settings(method="geometry"))
    assert [camera.name for camera in again.cameras] == list(one.tracks.names)
    assert again.tracks.inlier.mean() > 0.95


def test_capabilities_are_told(real: Any) -> None:
    found = real.capabilities()
    assert {"AUTO", "GEOMETRY", "SCPSFM", "PAPER", "PSFM"} <= set(found.methods)
    assert found.max_chunk_bytes >= flows.CHUNK_BYTES
    assert found.max_observations > 1_000_000
    assert re.match(r"\d+\.\d+\.\d+", found.server_version)


def test_a_full_queue_is_said_and_waited_for(kind: str, small: scene.Scene, tmp_path: Path) -> None:
    server = support.Server(tmp_path / "data", "--workers", "1", "--queue", "1")
    try:
        tracks, settings = slow()
        with support.client_of(kind, server.address, retry=NO_PATIENCE) as client:
            jobs = []
            with pytest.raises(scpsfm.QueueFull) as raised:
                for _ in range(10):
                    jobs.append(client.submit(tracks, settings))
            assert len(jobs) >= 1
            assert raised.value.reason == "QUEUE_FULL"
            assert raised.value.metadata["bound"] == "jobs"
            assert raised.value.retry_after is not None
            assert raised.value.retry_after > 0
            # Room is made while another client waits for it.
            timer = threading.Timer(0.5, cancel_all, [server.address])
            timer.start()
            with support.client_of(kind, server.address) as patient:
                patient.submit(small.tracks, scpsfm.Settings(method="geometry")).result()
            timer.join()
    finally:
        server.stop()


def cancel_all(address: str) -> None:
    with scpsfm.Client(address) as client:
        for job in client.jobs("state = QUEUED OR state = RUNNING"):
            job.cancel()


def test_keys_decide_whose_jobs_are_seen(kind: str, small: scene.Scene, tmp_path: Path) -> None:
    acme, other = "a" * 40, "b" * 40
    environment = {"SCPSFM_AUTH__KEYS": f"acme:{acme},other:{other}"}
    server = support.Server(tmp_path / "data", environment=environment)
    try:
        with support.client_of(kind, server.address, api_key=acme) as client:
            job = client.submit(small.tracks, scpsfm.Settings(method="geometry"))
            assert job.name.startswith("tenants/acme/jobs/")
            assert job.result().job == job.name
            assert [entry.name for entry in client.jobs()] == [job.name]
        with support.client_of(kind, server.address, api_key=other) as client:
            assert list(client.jobs()) == []
            with pytest.raises(scpsfm.NotFound):
                client.job(job.name).info()
        with support.client_of(kind, server.address, api_key=acme, tenant="other") as client:
            with pytest.raises(scpsfm.NotFound) as missing:
                list(client.jobs())
            assert missing.value.reason == "TENANT_NOT_FOUND"
        for key, reason in ((None, "API_KEY_MISSING"), ("c" * 40, "API_KEY_UNKNOWN")):
            with support.client_of(kind, server.address, api_key=key) as client:
                for call in (client.capabilities, lambda: client.solve(small.tracks), lambda: list(client.jobs())):
                    with pytest.raises(scpsfm.Unauthenticated) as raised:
                        call()
                    assert raised.value.reason == reason
    finally:
        server.stop()


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[support.Server, Any, Any]]:
    """A server that asks for certificates of an authority, that authority, and a client's certificate."""
    trustme = pytest.importorskip("trustme")
    support.binary()
    folder = tmp_path_factory.mktemp("tls")
    authority = trustme.CA()
    ours = authority.issue_cert("solver.example")
    ours.private_key_pem.write_to_path(folder / "server.key")
    for blob in ours.cert_chain_pems:
        blob.write_to_path(folder / "server.pem", append=True)
    authority.cert_pem.write_to_path(folder / "ca.pem")
    flags = ["--tls-certificate", "server.pem", "--tls-key", "server.key", "--tls-client-ca", "ca.pem"]
    paths = [flag if flag.startswith("--") else str(folder / flag) for flag in flags]
    server = support.Server(folder / "data", *paths)
    yield server, authority, authority.issue_cert("client.example")
    server.stop()


def test_tls_and_client_certificates(
    secure: tuple[support.Server, Any, Any], kind: str, small: scene.Scene, tmp_path: Path
) -> None:
    server, authority, mine = secure
    assert server.address.startswith("https://")
    certificate = b"".join(blob.bytes() for blob in mine.cert_chain_pems)
    (tmp_path / "key.pem").write_bytes(mine.private_key_pem.bytes())
    named: dict[str, Any] = {
        "tls_ca": authority.cert_pem.bytes(),
        "tls_cert": certificate,
        "tls_key": tmp_path / "key.pem",
        "tls_server_name": "solver.example",
    }
    with support.client_of(kind, server.address, **named) as client:
        result = client.solve(small.tracks, scpsfm.Settings(method="geometry"))
        assert result.focal_px == pytest.approx(small.focal_px, rel=0.05)
    trustme = pytest.importorskip("trustme")
    stranger = trustme.CA().cert_pem.bytes()
    # With a patience that the test would not survive: what is not trusted is not asked again.
    patient = scpsfm.RetryPolicy(patience_s=10_000.0)
    for change in ({"tls_ca": stranger}, {"tls_server_name": "elsewhere.example"}):
        with support.client_of(kind, server.address, retry=patient, **{**named, **change}) as client:
            with pytest.raises(scpsfm.Unavailable):
                client.capabilities()
    with support.client_of(kind, server.address, retry=NO_PATIENCE, tls_ca=named["tls_ca"]) as client:
        with pytest.raises(scpsfm.Unavailable):
            client.capabilities()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("style", ["sync", "async"])
def test_ctrl_c_cancels_a_solve(server: support.Server, style: str, tmp_path: Path) -> None:
    tracks, settings = slow()
    path = scene.write_csv(tracks, tmp_path / "o.csv")
    label = str(uuid.uuid4())
    call = (
        f"tracks, scpsfm.Settings(method={settings.method!r}, iterations={settings.iterations}), "
        f"labels={{'run': {label!r}}}, progress=lambda progress: print(progress.fraction, flush=True)"
    )
    program = f"import asyncio, scpsfm\ntracks = scpsfm.Tracks.from_csv({str(path)!r})\n"
    if style == "sync":
        program += f"scpsfm.Client({server.address!r}).solve({call})\n"
    else:
        program += (
            "async def main():\n"
            f"    async with scpsfm.AsyncClient({server.address!r}) as client:\n"
            f"        await client.solve({call})\n"
            "asyncio.run(main())\n"
        )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(HERE)},
    )
    watchdog = threading.Timer(support.PATIENCE, process.kill)
    watchdog.start()
    assert process.stdout is not None
    assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    watchdog.cancel()
    assert "KeyboardInterrupt" in err
    with scpsfm.Client(server.address) as client:
        (job,) = client.jobs(f'labels.run = "{label}"')
        assert job.known is not None
        # Asked for by the program itself, before it ended.
        assert job.known.cancel_requested or job.known.state == "CANCELLED"
        assert job.wait().state == "CANCELLED"


def test_threads_share_a_client(server: support.Server) -> None:
    scenes = [scene.make(seed=40 + number, views=5, tracks=60) for number in range(8)]
    settings = scpsfm.Settings(method="geometry")
    with scpsfm.Client(server.address) as client, ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda one: client.solve(one.tracks, settings), scenes))
    for one, result in zip(scenes, results, strict=True):
        assert result.input is one.tracks
        assert f1(result.tracks.inlier, one.right) > 0.9


# Broken networks and crashes.


def test_everything_comes_through_a_network_that_breaks(server: support.Server, kind: str) -> None:
    seed = 30 if kind == "sync" else 31
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    host, port = server.address.rpartition("//")[2].split(":")
    # What a connection may carry grows, so that the longest message gets through at last.
    grown = iter(range(10_000))
    flaky = Flaky((host, int(port)), lambda: int(rng.integers(2_000, 60_000) + 20_000 * next(grown)))
    large = scene.make(seed=seed, views=12, tracks=3000, wrong=0.2)
    small = scene.make(seed=seed + 10)
    label = str(uuid.uuid4())
    quick = scpsfm.RetryPolicy(patience_s=60.0, first_pause_s=0.01, longest_pause_s=0.1)
    try:
        with support.client_of(kind, flaky.address, retry=quick, upload_above_bytes=100_000) as client:
            stored = client.upload(large.tracks)
            assert stored.observation_count == len(large.tracks)
            settings = scpsfm.Settings(method="geometry")
            jobs = [client.submit(small.tracks, settings, labels={"run": label}) for _ in range(10)]
            for job in jobs:
                events = list(job.events())
                assert [event.sequence for event in events] == list(range(1, len(events) + 1))
                assert job.result().focal_px == pytest.approx(small.focal_px, rel=0.05)
            solved = client.solve(small.tracks, settings, labels={"run": label})
            assert solved.focal_px == pytest.approx(small.focal_px, rel=0.05)
        assert flaky.cuts >= 5
    finally:
        flaky.stop()
    with scpsfm.Client(server.address) as client:
        assert sum(1 for _ in client.jobs(f'labels.run = "{label}"')) == 11


def test_waits_and_uploads_survive_a_crash(kind: str, tmp_path: Path) -> None:
    server = support.Server(tmp_path / "data", "--workers", "1")
    tracks = scene.make(seed=8, views=20, tracks=4000, wrong=0.2).tracks
    try:
        with support.client_of(kind, server.address, upload_above_bytes=1000) as client:
            small = scene.make(seed=9)
            first = client.submit(small.tracks, scpsfm.Settings(method="geometry"), labels={"n": "1"})
            crashed = threading.Event()

            def crash() -> None:
                if not crashed.is_set():
                    crashed.set()
                    server.kill()
                    server.start()

            def on_upload(have: int, whole: int) -> None:
                if have == 0:
                    crash()

            stored = client.upload(tracks, on_upload=on_upload)
            assert crashed.is_set()
            assert stored.observation_count == len(tracks)
            assert stored.size_bytes > flows.CHUNK_BYTES
            sequences = []
            crashed.clear()
            second = client.submit(small.tracks, labels={"n": "2"})
            for event in second.events():
                sequences.append(event.sequence)
                if event.state is scpsfm.JobState.RUNNING:
                    crash()
            assert crashed.is_set()
            assert sequences == list(range(1, len(sequences) + 1))
            for job in (first, second):
                assert job.result().focal_px == pytest.approx(small.focal_px, rel=0.05)
            assert {job.name for job in client.jobs()} == {first.name, second.name}
    finally:
        server.stop()


def test_a_solve_survives_a_crash(kind: str, small: scene.Scene, tmp_path: Path) -> None:
    server = support.Server(tmp_path / "data", "--workers", "1")
    crashes = 0

    def on_progress(progress: scpsfm.Progress) -> None:
        nonlocal crashes
        if crashes == 0:
            crashes += 1
            server.kill()
            server.start()

    try:
        with support.client_of(kind, server.address) as client:
            # The network takes seconds, of which progress is told about twice a second.
            settings = scpsfm.Settings(method="scpsfm", iterations=3000)
            result = client.solve(small.tracks, settings, progress=on_progress)
            assert result.focal_px == pytest.approx(small.focal_px, rel=0.05)
            assert crashes == 1
            assert len(list(client.jobs())) == 1
    finally:
        server.stop()


# Examples.


def test_thirty_jobs_survive_two_crashes(tmp_path: Path) -> None:
    program = HERE / "examples" / "thirty_jobs.py"
    assert len(program.read_text(encoding="utf-8").splitlines()) <= 25
    paths = [
        str(scene.write_csv(scene.make(seed=100 + number, views=5, tracks=40).tracks, tmp_path / f"{number:02}.csv"))
        for number in range(30)
    ]
    server = support.Server(tmp_path / "data", "--workers", "1")
    try:
        address = server.address
        process = subprocess.Popen(
            [sys.executable, str(program), address, *paths],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(HERE)},
            text=True,
        )
        watchdog = threading.Timer(4 * support.PATIENCE, process.kill)
        watchdog.start()
        crashes = 0
        with scpsfm.Client(address) as client:
            for least in (4, 12):
                while process.poll() is None and sum(1 for _ in client.jobs()) < least:
                    pass
                assert process.poll() is None, "it ended before the crash"
                server.kill()
                server.start()
                crashes += 1
            out, err = process.communicate()
            watchdog.cancel()
            assert process.returncode == 0, err
            assert crashes == 2
            jobs = list(client.jobs())
        assert [line.split()[0] for line in out.splitlines()] == paths
        # None lost, none twice.
        assert sorted(job.known.labels["file"] for job in jobs) == paths
        assert {job.known.state for job in jobs} == {scpsfm.JobState.SUCCEEDED}
    finally:
        server.stop()


def test_the_notebook_runs(
    server: support.Server, table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "observations.csv").write_bytes(table.read_bytes())
    monkeypatch.setenv("SCPSFM_SERVER", server.address)
    notebook = json.loads((HERE / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))
    names: dict[str, Any] = {}
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 4
    for number, cell in enumerate(cells):
        exec(compile(cell, f"cell {number}", "exec"), names)
    assert names["result"].is_metric
    for written in ("database.db", "nerfstudio/transforms.json", "opensfm/reconstruction.json"):
        assert (tmp_path / written).is_file()
    names["client"].close()


def test_the_example_of_the_readme_runs(
    server: support.Server, small: scene.Scene, table: Path, tmp_path: Path
) -> None:
    text = (HERE / "README.md").read_text(encoding="utf-8")
    program = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert program is not None
    lines = program[1].strip().splitlines()
    assert len(lines) <= 10
    (tmp_path / "observations.csv").write_bytes(table.read_bytes())
    source = program[1].replace("127.0.0.1:50051", server.address)
    assert source != program[1]
    output = subprocess.run(
        [sys.executable, "-c", source],
        check=True,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(HERE)},
        timeout=support.PATIENCE,
    ).stdout
    grade, focal, right = output.split()[:3]
    assert grade in ("METRIC", "WEAK")
    assert float(focal) == pytest.approx(small.focal_px, rel=0.05)
    assert int(right) == pytest.approx(small.right.sum(), abs=6)
