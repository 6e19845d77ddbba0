"""The flows by themselves, with a clock that does not wait."""

from __future__ import annotations

from typing import Any

import grpc
import pytest

import scpsfm
from scpsfm import _flows as flows
from scpsfm._flows import Call, Context, Emit, Open, Read, Sleep, Stream
from scpsfm._stubs import job_pb2, job_service_pb2

AWAY = scpsfm.Unavailable("away", code=grpc.StatusCode.UNAVAILABLE)
LATE = scpsfm.DeadlineExceeded("Deadline Exceeded", code=grpc.StatusCode.DEADLINE_EXCEEDED)
NAME = "tenants/default/jobs/j"


class Stage:
    """Runs a flow step by step."""

    def __init__(self, flow: Any) -> None:
        self._flow = flow
        self.op: Any = next(flow)

    def answer(self, value: Any = None) -> Any:
        self.op = self._flow.send(value)
        return self.op

    def fail(self, error: Exception = AWAY) -> Any:
        self.op = self._flow.throw(error)
        return self.op


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def context(clock: Clock, patience_s: float = 35.0) -> Context:
    return Context("", scpsfm.RetryPolicy(patience_s=patience_s, jitter=0.0), 1 << 20, clock)


def running() -> job_pb2.Job:
    return job_pb2.Job(name=NAME, state=job_pb2.JOB_STATE_RUNNING, last_sequence=4)


def entered(state: Any, sequence: int) -> job_pb2.JobEvent:
    return job_pb2.JobEvent(job=NAME, sequence=sequence, state_change=job_pb2.StateChange(state=state))


def test_an_event_of_a_later_kind_is_left_out_and_takes_no_end_back() -> None:
    for later in ([6], [6, 7], []):
        follower = flows.EventFollower(4)
        stream = Stream(None, accepted=True)
        stage = Stage(follower.follow(stream, flows.Trouble(context(Clock()), None)))
        assert stage.op == Read(stream)
        end = entered(job_pb2.JOB_STATE_SUCCEEDED, 5)
        assert stage.answer(end) == Emit(end)
        assert stage.answer() == Read(stream)
        for sequence in later:
            assert stage.answer(job_pb2.JobEvent(job=NAME, sequence=sequence)) == Read(stream)
        with pytest.raises(StopIteration) as stopped:
            stage.answer()
        assert stopped.value.value == end
        assert follower.sequence == max([5, *later])


def test_a_state_of_a_later_version_is_no_reason_to_ask_for_ever() -> None:
    stage = Stage(flows.wait(context(Clock()), NAME, None))
    with pytest.raises(scpsfm.InternalError, match="state 77"):
        stage.answer(job_pb2.Job(name=NAME, state=77))  # type: ignore[arg-type]


def test_a_call_that_succeeded_ended_its_trouble() -> None:
    clock = Clock()
    stage = Stage(flows.wait(context(clock), NAME, None))
    assert stage.op == Call("GetJob", job_service_pb2.GetJobRequest(name=NAME), None)
    assert stage.fail() == Sleep(pytest.approx(0.1))
    # In times of trouble no try takes longer than that is waited for.
    clock.now += 10.0
    assert stage.answer().timeout == pytest.approx(25.0)
    opened = stage.answer(running())
    assert opened == Open("WatchJob", job_service_pb2.WatchJobRequest(name=NAME, after_sequence=4), None)
    # A trouble long after that one is another, with all of its pauses.
    clock.now += 3600.0
    assert stage.fail() == Sleep(pytest.approx(0.1))
    stream = Stream(None, accepted=True)
    assert isinstance(stage.answer(), Open)
    assert stage.answer(stream) == Read(stream)
    event = entered(job_pb2.JOB_STATE_RUNNING, 5)
    assert stage.answer(event) == Emit(event)
    assert stage.answer() == Read(stream)
    clock.now += 3600.0
    assert stage.fail() == Sleep(pytest.approx(0.1))
    assert stage.answer() == Open("WatchJob", job_service_pb2.WatchJobRequest(name=NAME, after_sequence=5), None)


def test_a_try_that_hangs_in_times_of_trouble_is_told_as_the_trouble() -> None:
    clock = Clock()
    stage = Stage(flows.call(context(clock), "GetJob", None))
    stage.fail()
    assert stage.answer().timeout == pytest.approx(35.0)
    clock.now += 35.0
    with pytest.raises(scpsfm.Unavailable, match="away"):
        stage.fail(LATE)


def test_the_callers_timeout_bounds_all_tries_and_pauses() -> None:
    clock = Clock()
    stage = Stage(flows.call(context(clock), "GetJob", None, 3.0))
    assert stage.op.timeout == pytest.approx(3.0)
    stage.fail()
    clock.now += 2.0
    assert stage.answer().timeout == pytest.approx(1.0)
    stage.fail()
    clock.now += 0.9
    assert stage.answer().timeout == pytest.approx(0.1)
    clock.now += 0.1
    with pytest.raises(scpsfm.DeadlineExceeded, match="timeout of 3 s passed; before that: away") as raised:
        stage.fail(LATE)
    assert raised.value.reason == "CLIENT_TIMEOUT"
    # A pause that would not end in time is not begun.
    stage = Stage(flows.call(context(clock), "GetJob", None, 0.05))
    with pytest.raises(scpsfm.DeadlineExceeded):
        stage.fail()


def test_an_upload_that_makes_no_progress_is_given_up(small: Any) -> None:
    clock = Clock()
    stage = Stage(flows.upload(context(clock), small.tracks, None))
    with pytest.raises(scpsfm.Unavailable):
        # The state is answered each time, and each stream breaks without a byte more.
        while True:
            assert stage.op.method == "GetUploadStatus"
            assert isinstance(stage.answer(flows.input_service_pb2.UploadStatus(committed_bytes=10)), Emit)
            assert stage.answer().method == "UploadInput"
            pause = stage.fail()
            clock.now += pause.seconds
            stage.answer()
    assert clock.now == pytest.approx(34.0)
