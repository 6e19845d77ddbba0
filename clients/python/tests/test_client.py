"""Both clients against a server that breaks on purpose."""

from __future__ import annotations

import asyncio
import re
import sys
import threading
import uuid
from typing import Any

import grpc
import numpy as np
import pytest

import scpsfm
from scpsfm import _flows as flows
from scpsfm._stubs import input_pb2, job_pb2

from . import scene, support
from .conftest import QUICK
from .fake import Fake, Refusal, Running, away


def test_a_solve_answers_with_arrays_and_tells_its_progress(client: Any, fake: Fake, small: scene.Scene) -> None:
    told: list[scpsfm.Progress] = []
    result = client.solve(small.tracks, scpsfm.Settings(method="geometry", seed=3), progress=told.append)
    assert result.status == "SOLVED"
    assert result.grade is scpsfm.Grade.METRIC
    assert result.focal_px == small.focal_px
    assert np.array_equal(result.tracks.inlier, small.right)
    assert result.input is small.tracks
    assert [progress.fraction for progress in told] == [0.2, 0.4, 0.6, 0.8, 1.0]
    assert [progress.sequence for progress in told] == [2, 3, 4, 5, 6]
    config = fake.calls["Solve"][0]
    assert config.job.settings.method == 3
    assert config.job.settings.seed == 3
    assert list(config.track_set.xs) == small.tracks.x.tolist()
    assert [view.name for view in config.track_set.views] == list(small.tracks.names)


def test_every_call_that_creates_has_a_request_id_of_its_own(client: Any, fake: Fake, small: scene.Scene) -> None:
    client.submit(small.tracks)
    client.submit(small.tracks)
    client.solve(small.tracks)
    client.submit_batch([small.tracks, small.tracks])
    requests = fake.calls["CreateJob"] + fake.calls["Solve"] + list(fake.calls["BatchCreateJobs"][0].requests)
    ids = [request.request_id for request in requests]
    assert len(set(ids)) == len(ids) == 5
    assert all(uuid.UUID(request_id).version == 4 for request_id in ids)


def test_a_creation_whose_answer_was_lost_is_made_again_under_its_id(
    client: Any, fake: Fake, small: scene.Scene
) -> None:
    fake.before["CreateJob"] = [away(), away()]
    fake.after["CreateJob"] = [away("the answer is lost"), None]
    job = client.submit(small.tracks, labels={"a": "b"})
    ids = [request.request_id for request in fake.calls["CreateJob"]]
    assert len(ids) == 4
    assert len(set(ids)) == 1
    assert list(fake.jobs) == [job.name]
    assert job.known.labels == {"a": "b"}


def test_a_batch_is_stored_once_over_lost_answers(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.after["BatchCreateJobs"] = [away("the answer is lost"), None]
    jobs = client.submit_batch([small.tracks] * 3, request_id="batch")
    assert [job.name for job in jobs] == list(fake.jobs)
    assert len(fake.calls["BatchCreateJobs"]) == 2
    for call in fake.calls["BatchCreateJobs"]:
        assert [request.request_id for request in call.requests] == ["batch-1", "batch-2", "batch-3"]


def test_a_full_queue_is_waited_for_as_long_as_it_asks(client: Any, fake: Fake, small: scene.Scene) -> None:
    full = Refusal(grpc.StatusCode.RESOURCE_EXHAUSTED, "full", "QUEUE_FULL", metadata={"bound": "jobs"}, retry_s=0.01)
    fake.before["CreateJob"] = [full, full]
    client.submit(small.tracks)
    assert len(fake.calls["CreateJob"]) == 3


def test_a_refusal_comes_with_reason_metadata_and_delay(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.before["CreateJob"] = [
        Refusal(grpc.StatusCode.RESOURCE_EXHAUSTED, "full", "QUEUE_FULL", metadata={"bound": "jobs"}, retry_s=3600.5)
    ]
    with pytest.raises(scpsfm.QueueFull) as raised:
        client.submit(small.tracks, request_id="mine")
    error = raised.value
    assert (error.reason, error.retry_after, error.metadata) == ("QUEUE_FULL", 3600.5, {"bound": "jobs"})
    assert error.code is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert error.request_id == "mine"
    assert len(fake.calls["CreateJob"]) == 1
    assert str(error) == "full (QUEUE_FULL, request_id=mine)"


@pytest.mark.parametrize(
    ("code", "reason", "kind_of_error"),
    [
        ("NOT_FOUND", "TENANT_NOT_FOUND", scpsfm.NotFound),
        ("ALREADY_EXISTS", "REQUEST_ID_REUSED", scpsfm.AlreadyExists),
        ("FAILED_PRECONDITION", "JOB_NOT_ENDED", scpsfm.FailedPrecondition),
        ("ABORTED", "ETAG_MISMATCH", scpsfm.Aborted),
        ("UNAUTHENTICATED", "API_KEY_UNKNOWN", scpsfm.Unauthenticated),
        ("PERMISSION_DENIED", "", scpsfm.PermissionDenied),
        ("DEADLINE_EXCEEDED", "INPUT_STALLED", scpsfm.DeadlineExceeded),
        ("RESOURCE_EXHAUSTED", "MEMORY", scpsfm.MemoryFull),
        ("RESOURCE_EXHAUSTED", "RATE_LIMITED", scpsfm.RateLimited),
        ("RESOURCE_EXHAUSTED", "STORE_FULL", scpsfm.StoreFull),
        ("RESOURCE_EXHAUSTED", "UPLOADS_FULL", scpsfm.UploadsFull),
        ("RESOURCE_EXHAUSTED", "SOMETHING_NEW", scpsfm.ResourceExhausted),
        ("DATA_LOSS", "HASH_MISMATCH", scpsfm.DataLoss),
        ("UNIMPLEMENTED", "", scpsfm.Unimplemented),
        ("INTERNAL", "INTERNAL", scpsfm.InternalError),
    ],
)
def test_a_status_is_an_exception_of_its_own(
    client: Any, fake: Fake, code: str, reason: str, kind_of_error: type[scpsfm.ScpsfmError]
) -> None:
    fake.before["GetJob"] = [Refusal(grpc.StatusCode[code], "words", reason)]
    with pytest.raises(scpsfm.ScpsfmError) as raised:
        client.job("tenants/default/jobs/j").info()
    assert type(raised.value) is kind_of_error
    assert raised.value.reason == reason
    assert "words" in str(raised.value)
    assert len(fake.calls["GetJob"]) == 1


def test_a_field_is_named_by_file_and_line(client: Any, fake: Fake, tmp_path: Any) -> None:
    path = tmp_path / "o.csv"
    path.write_text("view,track,x,y\n\n7,1,0,0\n9,1,1,1\n7,2,5,5\n9,2,6,6\n")
    tracks = scpsfm.Tracks.from_csv(path)
    refusal = Refusal(
        grpc.StatusCode.INVALID_ARGUMENT,
        "track_set.ys[2]: is odd",
        "INVALID_ARGUMENT",
        fields={"track_set.ys[2]": "is odd", "track_set.views[0]": "too"},
    )
    for method, call in (("CreateJob", client.submit), ("Solve", client.solve)):
        fake.before[method] = [refusal]
        with pytest.raises(scpsfm.InvalidArgument) as raised:
            call(tracks)
        error = raised.value
        assert error.field == "track_set.ys[2]"
        assert (error.file, error.line) == (str(path), 5)
        assert str(error).startswith(f"{path}: line 5: track_set.ys[2]: is odd")
        assert [violation.field for violation in error.violations] == ["track_set.ys[2]", "track_set.views[0]"]
    fake.before["BatchCreateJobs"] = [
        Refusal(
            grpc.StatusCode.INVALID_ARGUMENT,
            "requests[1].track_set.ys[2]: is odd",
            "INVALID_ARGUMENT",
            fields={"requests[1].track_set.ys[2]": "is odd"},
        )
    ]
    other = scpsfm.Tracks.from_points(np.zeros((2, 1, 2)))
    with pytest.raises(scpsfm.InvalidArgument) as raised:
        client.submit_batch([other, tracks])
    assert raised.value.field == "requests[1].track_set.ys[2]"
    assert (raised.value.file, raised.value.line) == (str(path), 5)


def test_a_watch_goes_on_after_its_last_event(client: Any, fake: Fake, small: scene.Scene) -> None:
    job = client.submit(small.tracks)
    fake.breaks["WatchJob"] = [3, 0, 1, 2]
    fake.before["WatchJob"] = [None, away(), None]
    sequences = [event.sequence for event in job.events()]
    assert sequences == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [request.after_sequence for request in fake.calls["WatchJob"]] == [0, 3, 3, 3, 4, 6]
    assert [progress.sequence for progress in job.progress(4)] == [5, 6]
    kinds = [
        (event.state, event.progress is not None, event.summary is not None) for event in job.events(after_sequence=5)
    ]
    assert kinds == [(None, True, False), (None, False, True), (scpsfm.JobState.SUCCEEDED, False, False)]


def test_a_watch_that_is_left_ends_its_call(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.never_ends = True
    job = client.submit(small.tracks)
    events = job.events()
    assert next(events).state == "RUNNING"
    events.close()
    assert job.info().state == "RUNNING"
    assert not fake.calls["CancelJob"]


def test_a_result_goes_on_after_its_last_byte(client: Any, fake: Fake, small: scene.Scene) -> None:
    job = client.submit(small.tracks)
    fake.breaks["ReadJobResult"] = [2, 0, 3]
    result = job.result()
    assert result.message == fake.result
    assert [request.offset for request in fake.calls["ReadJobResult"]] == [0, 2000, 2000, 5000]
    # It had ended: there was nothing to wait for.
    assert not fake.calls["WatchJob"]


def test_a_result_that_is_not_whole_is_never_given(
    client: Any, fake: Fake, small: scene.Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = client.submit(small.tracks)
    honest = fake._stream

    def changed(method: str, messages: Any, context: Any) -> Any:
        for message in honest(method, messages, context):
            if method == "ReadJobResult" and message.offset == 2000:
                message.data = bytes(len(message.data))
            yield message

    monkeypatch.setattr(fake, "_stream", changed)
    with pytest.raises(scpsfm.DataLoss, match="SHA-256"):
        job.result()

    def cut(method: str, messages: Any, context: Any) -> Any:
        for message in honest(method, messages, context):
            if method != "ReadJobResult" or message.offset < 2000:
                yield message

    monkeypatch.setattr(fake, "_stream", cut)
    with pytest.raises(scpsfm.InternalError, match="ended at 2000 of"):
        job.result()


def test_a_solve_over_broken_streams_tells_each_event_once(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.breaks["Solve"] = [2, 4, 0, 4, 5]
    fake.before["Solve"] = [away(), None, None]
    told: list[scpsfm.Progress] = []
    result = client.solve(small.tracks, progress=told.append)
    assert [progress.sequence for progress in told] == [2, 3, 4, 5, 6]
    assert len({request.request_id for request in fake.calls["Solve"]}) == 1
    assert len(fake.calls["Solve"]) == 7
    assert len(fake.jobs) == 1
    assert result.focal_px == small.focal_px


def test_a_job_without_a_result_is_an_exception(client: Any, fake: Fake, small: scene.Scene) -> None:
    for state, kind_of_error in (
        (job_pb2.JOB_STATE_FAILED, scpsfm.JobFailed),
        (job_pb2.JOB_STATE_CANCELLED, scpsfm.JobCancelled),
        (job_pb2.JOB_STATE_DEADLINE_EXCEEDED, scpsfm.JobDeadlineExceeded),
    ):
        fake.final_state = state
        job = client.submit(small.tracks)
        assert job.wait().state.is_final
        for call in (job.result, lambda: client.solve(small.tracks)):
            with pytest.raises(scpsfm.JobError) as raised:
                call()
            assert type(raised.value) is kind_of_error
            assert raised.value.job in fake.jobs
        if kind_of_error is scpsfm.JobFailed:
            assert raised.value.reason == "INTERNAL"
            assert "a defect" in str(raised.value)
    assert not fake.calls["ReadJobResult"]
    assert not fake.calls["CancelJob"]


def test_the_timeout_of_a_wait_leaves_the_job_alone(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.never_ends = True
    job = client.submit(small.tracks)
    for wait in (job.wait, job.result, lambda timeout: list(job.events(timeout=timeout))):
        with pytest.raises(scpsfm.DeadlineExceeded) as raised:
            wait(timeout=0.3)
        assert raised.value.reason == "CLIENT_TIMEOUT"
        assert isinstance(raised.value, TimeoutError)
    assert not fake.calls["CancelJob"]


def test_a_solve_that_is_given_up_cancels_its_job(client: Any, fake: Fake, small: scene.Scene) -> None:
    fake.never_ends = True
    with pytest.raises(scpsfm.DeadlineExceeded):
        client.solve(small.tracks, timeout=3.0)
    assert [request.name for request in fake.calls["CancelJob"]] == list(fake.jobs)

    class Interrupted(BaseException):
        """As Ctrl-C, which asyncio treats in a way of its own."""

    def interrupted(progress: scpsfm.Progress) -> None:
        raise Interrupted

    with pytest.raises(Interrupted):
        client.solve(small.tracks, progress=interrupted)
    assert [request.name for request in fake.calls["CancelJob"]] == list(fake.jobs)
    assert len(fake.jobs) == 2


def test_a_task_that_is_cancelled_cancels_its_job(running: Running, fake: Fake, small: scene.Scene) -> None:
    fake.never_ends = True

    async def program() -> None:
        begun = asyncio.Event()
        async with scpsfm.AsyncClient(running.address, retry=QUICK) as client:
            solve = client.solve(small.tracks, progress=lambda progress: begun.set())
            task = asyncio.ensure_future(solve)
            await asyncio.wait_for(begun.wait(), support.PATIENCE)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(program())
    assert [request.name for request in fake.calls["CancelJob"]] == list(fake.jobs)


def test_a_cancel_from_another_thread_ends_a_solve(running: Running, fake: Fake, small: scene.Scene) -> None:
    fake.never_ends = True
    with scpsfm.Client(running.address, retry=QUICK) as client:

        def cancel() -> None:
            job = next(iter(client.jobs()))
            assert job.cancel().state == "CANCELLED"

        threads: list[threading.Thread] = []

        def on_progress(progress: scpsfm.Progress) -> None:
            if not threads:
                threads.append(threading.Thread(target=cancel))
                threads[0].start()

        with pytest.raises(scpsfm.JobCancelled):
            client.solve(small.tracks, progress=on_progress)
        threads[0].join(support.PATIENCE)


def test_nobody_there_is_told_once_the_patience_is_over(kind: str, small: scene.Scene) -> None:
    policy = scpsfm.RetryPolicy(patience_s=1.3, first_pause_s=0.01, longest_pause_s=0.05)
    # Nothing listens on the port of the discard protocol.
    with support.client_of(kind, "127.0.0.1:9", retry=policy) as client:
        with pytest.raises(scpsfm.Unavailable) as raised:
            client.submit(small.tracks, request_id="mine")
        assert raised.value.request_id == "mine"
        assert isinstance(raised.value, ConnectionError)
    patient = scpsfm.RetryPolicy(patience_s=1000.0, first_pause_s=0.01, longest_pause_s=0.05)
    with support.client_of(kind, "127.0.0.1:9", retry=patient) as client:
        with pytest.raises(scpsfm.DeadlineExceeded, match="before that") as late:
            client.capabilities(timeout=1.0)
        assert late.value.reason == "CLIENT_TIMEOUT"


def test_a_delete_whose_answer_was_lost_is_done(client: Any, fake: Fake, small: scene.Scene) -> None:
    job = client.submit(small.tracks)
    fake.after["DeleteJob"] = [away("the answer is lost")]
    job.delete()
    assert not fake.jobs
    assert len(fake.calls["DeleteJob"]) == 2
    with pytest.raises(scpsfm.NotFound) as raised:
        job.delete()
    assert raised.value.reason == "JOB_NOT_FOUND"


def test_lists_are_read_page_by_page(client: Any, fake: Fake, small: scene.Scene) -> None:
    for _ in range(5):
        client.submit(small.tracks)
    fake.before["ListJobs"] = [None, away()]
    found = [job.name for job in client.jobs("state = SUCCEEDED", page_size=2)]
    assert found == list(fake.jobs)
    assert [call.page_token for call in fake.calls["ListJobs"]] == ["", "2", "2", "4"]
    assert {call.filter for call in fake.calls["ListJobs"]} == {"state = SUCCEEDED"}


def test_capabilities_come_as_words(client: Any) -> None:
    found = client.capabilities()
    assert (found.server_version, found.methods, found.max_views) == ("9.9", ("AUTO", "GEOMETRY"), 2000)


def test_the_key_goes_with_every_call_and_is_shown_nowhere(running: Running, fake: Fake, kind: str) -> None:
    key = "0123456789abcdef0123456789abcdef"
    with support.client_of(kind, running.address, api_key=f"{key}\n", tenant="acme") as client:
        client.capabilities()
        list(client.jobs())
        shown = repr(client._inner if kind == "async" else client)
        shown += repr(client._access if kind == "sync" else client._inner._access)
    assert len(fake.metadata) == 2
    assert {call["authorization"] for call in fake.metadata} == {f"Bearer {key}"}
    assert fake.calls["ListJobs"][0].parent == "tenants/acme"
    assert key not in shown


# Uploads.


@pytest.fixture
def large() -> scpsfm.Tracks:
    """More than two chunks of an upload."""
    seed = 5
    print(f"seed {seed}")
    points = np.random.default_rng(seed).uniform(0.0, 1000.0, (3, 20_000, 2))
    return scpsfm.Tracks.from_points(points, width=1001, height=1001)


@pytest.fixture
def uploading(running: Running, kind: str) -> Any:
    with support.client_of(kind, running.address, retry=QUICK, upload_above_bytes=1000) as client:
        yield client


def test_a_large_input_is_uploaded_and_goes_on_where_it_broke(uploading: Any, fake: Fake, large: scpsfm.Tracks) -> None:
    fake.breaks["UploadInput"] = [1, 0, 1]
    fake.before["GetUploadStatus"] = [away()]
    fake.after["UploadInput"] = [away("the answer is lost")]
    told: list[tuple[int, int]] = []
    job = uploading.submit(large, on_upload=lambda have, whole: told.append((have, whole)))
    (stored,) = fake.inputs.values()
    request = fake.calls["CreateJob"][-1]
    assert request.WhichOneof("source") == "input"
    assert request.input == stored.name == job.known.input
    (data,) = fake.uploads.values()
    assert input_pb2.InputData.FromString(bytes(data)).track_set == large.to_proto()
    size = len(data)
    assert size > 2 * flows.CHUNK_BYTES
    # No byte that the server had was sent again.
    assert fake.received_chunks == [
        (offset, min(flows.CHUNK_BYTES, size - offset)) for offset in range(0, size, flows.CHUNK_BYTES)
    ]
    assert told[-1] == (size, size)
    assert [have for have, _ in told] == sorted(have for have, _ in told)
    # One that is done is not sent again, by another client either.
    sent = len(fake.received_chunks)
    assert uploading.upload(large).name == stored.name
    assert len(fake.received_chunks) == sent


def test_a_chunk_that_was_damaged_is_sent_again(uploading: Any, fake: Fake, large: scpsfm.Tracks) -> None:
    fake.corrupt = [1]
    uploading.upload(large)
    offsets = [offset for offset, _ in fake.received_chunks]
    assert offsets[:3] == [0, flows.CHUNK_BYTES, flows.CHUNK_BYTES]


def test_what_another_stream_wrote_meanwhile_is_not_sent_again(
    uploading: Any, fake: Fake, large: scpsfm.Tracks
) -> None:
    taken = Refusal(grpc.StatusCode.ABORTED, "another stream goes on", "UPLOAD_TAKEN_OVER")
    gap = Refusal(
        grpc.StatusCode.INVALID_ARGUMENT, "an overlap", "INVALID_ARGUMENT", fields={"chunk.offset": "an overlap"}
    )
    fake.before["UploadInput"] = [taken, gap]
    uploading.upload(large)
    assert len(fake.calls["UploadInput"]) == 3


def test_an_input_that_is_refused_is_told_with_its_field(uploading: Any, fake: Fake, large: scpsfm.Tracks) -> None:
    fake.after["UploadInput"] = [
        Refusal(grpc.StatusCode.INVALID_ARGUMENT, "wrong", "INVALID_ARGUMENT", fields={"track_set.xs[3]": "wrong"})
    ]
    with pytest.raises(scpsfm.InvalidArgument) as raised:
        uploading.submit(large)
    assert raised.value.field == "track_set.xs[3]"
    assert not fake.calls["CreateJob"]


def test_a_message_above_the_servers_limit_is_uploaded_instead(
    running: Running, fake: Fake, kind: str, large: scpsfm.Tracks
) -> None:
    fake.max_message_bytes = 1000
    with support.client_of(kind, running.address, retry=QUICK) as client:
        job = client.submit(large)
        assert len(fake.calls["CreateJob"]) == 2
        assert job.known.input in fake.inputs
        jobs = client.submit_batch([large, large])
    assert len(fake.calls["BatchCreateJobs"]) == 2
    assert [one.known.input for one in jobs] == [job.known.input] * 2


def test_a_batch_uploads_what_does_not_fit(
    running: Running, fake: Fake, kind: str, large: scpsfm.Tracks, small: scene.Scene
) -> None:
    with support.client_of(kind, running.address, retry=QUICK, upload_above_bytes=100_000) as client:
        jobs = client.submit_batch([small.tracks, large, small.tracks])
        assert [entry.name for entry in client.inputs()] == [jobs[1].known.input]
        client.delete_input(jobs[1].known.input)
    kinds = [request.WhichOneof("source") for request in fake.calls["BatchCreateJobs"][0].requests]
    assert kinds == ["track_set", "input", "track_set"]
    assert not fake.inputs


def test_a_large_solve_is_sent_in_chunks(client: Any, fake: Fake, large: scpsfm.Tracks) -> None:
    fake.result = scene.result_pb2.JobResult(status=2)
    client.solve(large)
    in_first, in_chunks = fake.solved
    assert (in_first, in_chunks) == (0, len(large))
    assert max(count for _, count in fake.received_chunks) <= flows.SMALL_OBSERVATIONS
    assert len(fake.calls["Solve"][0].track_set.views) == 3


# Access.


@pytest.mark.parametrize(
    ("address", "named", "word"),
    [
        ("user:secret@host:1", {}, "user or a password"),
        ("ftp://host:1", {}, "HOST:PORT"),
        ("host", {}, "no port"),
        ("host:x", {}, "HOST:PORT"),
        ("http://host:1/path", {}, "HOST:PORT"),
        ("http://host:1", {"tls_ca": b"pem"}, "https://"),
        ("https://host:1", {"tls_cert": b"pem"}, "together"),
        ("https://host:1", {"tls_ca": "/nowhere/ca.pem"}, "No such file"),
        ("127.0.0.1:1", {"api_key": "two words"}, "characters"),
        ("far.example:1", {"api_key": "k" * 32}, "readable"),
        ("http://10.0.0.1:1", {"api_key": "k" * 32}, "readable"),
        ("localhost.far.example:1", {"api_key": "k" * 32}, "readable"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(address: str, named: dict[str, Any], word: str) -> None:
    for make in (scpsfm.Client, scpsfm.AsyncClient):
        with pytest.raises(scpsfm.InvalidArgument, match=re.escape(word)) as raised:
            make(address, **named)
        assert raised.value.field
        assert "secret" not in str(raised.value)
        assert "k" * 32 not in str(raised.value)


@pytest.mark.parametrize(
    ("address", "named", "target", "secure"),
    [
        ("127.0.0.1:1", {"api_key": "k" * 32}, "127.0.0.1:1", False),
        ("[::1]:1", {"api_key": "k" * 32}, "[::1]:1", False),
        ("http://localhost:7", {"api_key": "k" * 32}, "localhost:7", False),
        ("https://far.example", {"api_key": "k" * 32}, "far.example:443", True),
        ("far.example:1", {"api_key": "k" * 32, "plaintext_keys": True}, "far.example:1", False),
        ("far.example:1", {"tls_server_name": "other"}, "far.example:1", True),
    ],
)
def test_addresses_are_read(address: str, named: dict[str, Any], target: str, secure: bool) -> None:
    with scpsfm.Client(address, **named) as client:
        assert (client._access.target, client._access.secure) == (target, secure)


def test_key_and_tenant_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCPSFM_API_KEY", "k" * 32)
    monkeypatch.setenv("SCPSFM_TENANT", "acme")
    with scpsfm.Client("127.0.0.1:1") as client:
        assert client._access.metadata == (("authorization", f"Bearer {'k' * 32}"),)
        assert client._access.parent == "tenants/acme"
    with scpsfm.Client("127.0.0.1:1", api_key="x" * 32, tenant="other") as client:
        assert client._access.metadata == (("authorization", f"Bearer {'x' * 32}"),)
        assert client._access.parent == "tenants/other"


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan")])
def test_a_timeout_that_is_none_is_refused(client: Any, timeout: float) -> None:
    with pytest.raises(scpsfm.InvalidArgument, match="timeout"):
        client.capabilities(timeout=timeout)


def test_a_job_is_queued_again_and_has_another_priority(client: Any, fake: Fake, small: scene.Scene) -> None:
    job = client.submit(small.tracks)
    fake.before["RetryJob"] = [away()]
    assert job.retry(etag="e").state == "QUEUED"
    assert [(call.name, call.etag) for call in fake.calls["RetryJob"]] == [(job.name, "e")] * 2
    job.set_priority(7, etag="e")
    (call,) = fake.calls["SetJobPriority"]
    assert (call.name, call.priority, call.etag) == (job.name, 7, "e")
    with pytest.raises(scpsfm.InvalidArgument, match=r"^priority: "):
        job.set_priority(2**40)
    assert client.retry(job.name).known.state == "QUEUED"
    assert client.set_priority(job.name, -3).name == job.name
    assert fake.calls["RetryJob"][-1].name == job.name
    assert fake.calls["SetJobPriority"][-1].priority == -3


def test_settings_of_the_wrong_kind_are_named_before_anything_is_sent(
    client: Any, fake: Fake, small: scene.Scene
) -> None:
    for settings, field in (
        (scpsfm.Settings(method="magic"), "settings.method"),
        (scpsfm.Settings(iterations=-1), "settings.iterations"),
        (scpsfm.Settings(alpha="much"), "settings.alpha"),  # type: ignore[arg-type]
        (scpsfm.Settings(seed=2**64), "settings.seed"),
    ):
        for call in (client.submit, client.solve):
            with pytest.raises(scpsfm.InvalidArgument) as raised:
                call(small.tracks, settings)
            assert raised.value.field == field
    wrong: list[tuple[str, Any, str]] = [
        ("labels", {"a": 1}, "job.labels"),
        ("labels", 5, "job.labels"),
        ("priority", 2**40, "job.priority"),
        ("time_limit", float("nan"), "job.time_limit"),
        ("webhook", 5, "job.webhook"),
        ("job_id", 5, "job_id"),
        ("request_id", 5, "request_id"),
    ]
    for name, value, field in wrong:
        with pytest.raises(scpsfm.InvalidArgument, match=f"^{name}: ") as raised:
            client.submit(small.tracks, **{name: value})
        assert raised.value.field == field
    assert not fake.calls["CreateJob"]
    assert not fake.calls["Solve"]


def test_a_bar_is_shown(client: Any, small: scene.Scene, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tqdm")
    client.solve(small.tracks, progress=True)
    shown = capsys.readouterr().err
    assert "search: 100%" in shown
    assert "inliers=5" in shown


def test_a_bar_without_tqdm_says_what_to_install(
    client: Any, fake: Fake, small: scene.Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match=r"scpsfm\[progress\]"):
        client.solve(small.tracks, progress=True)
    assert not fake.jobs
