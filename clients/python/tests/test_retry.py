from __future__ import annotations

import grpc
import pytest

import scpsfm
from scpsfm._retry import Backoff
from scpsfm.errors import ScpsfmError, is_transient

AWAY = scpsfm.Unavailable("away", code=grpc.StatusCode.UNAVAILABLE)


def full(seconds: float) -> ScpsfmError:
    code = grpc.StatusCode.RESOURCE_EXHAUSTED
    return scpsfm.QueueFull("full", reason="QUEUE_FULL", retry_after=seconds, code=code)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def backoff(clock: Clock, jitter: float = 0.0, **policy: float) -> Backoff:
    return Backoff(scpsfm.RetryPolicy(**policy), clock, lambda low, high: (low + high + jitter * (high - low)) / 2.0)


def test_pauses_double_to_the_longest_and_end_with_the_patience() -> None:
    clock = Clock()
    tries = backoff(clock, patience_s=35.0)
    pauses = []
    with pytest.raises(scpsfm.Unavailable):
        while True:
            pauses.append(tries.failed(AWAY))
            clock.now += pauses[-1]
    assert pauses[:7] == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0])
    assert max(pauses) == 5.0
    # The last pause is cut short, so that the last try is a second before the end.
    assert sum(pauses) == pytest.approx(34.0)


def test_the_jitter_changes_every_pause_by_its_share() -> None:
    assert backoff(Clock(), jitter=1.0).failed(AWAY) == pytest.approx(0.12)
    assert backoff(Clock(), jitter=-1.0).failed(AWAY) == pytest.approx(0.08)


def test_no_pause_is_shorter_than_the_server_asks_for() -> None:
    clock = Clock()
    for jitter in (-1.0, 0.0, 1.0):
        pause = backoff(clock, jitter=jitter).failed(full(7.0))
        assert 7.0 <= pause <= 7.0 * 1.2, jitter
    # One that is small is no invitation to come back at once.
    tries = backoff(clock)
    for _ in range(5):
        tries.failed(full(0.01))
    assert tries.failed(full(0.01)) == pytest.approx(3.2)


def test_a_delay_beyond_the_patience_is_raised_at_once() -> None:
    with pytest.raises(scpsfm.QueueFull) as raised:
        backoff(Clock(), patience_s=35.0).failed(full(60.0))
    assert raised.value.retry_after == 60.0
    assert backoff(Clock(), jitter=-1.0, patience_s=100.0).failed(full(60.0)) == pytest.approx(60.0)


def test_what_arrives_ends_the_trouble() -> None:
    clock = Clock()
    tries = backoff(clock, patience_s=2.0)
    for _ in range(100):
        clock.now += 1.5
        assert tries.failed(AWAY) == pytest.approx(0.1)
        tries.reset()
    assert tries.left() is None
    assert tries.last() is None


def test_a_stream_that_lived_ended_the_trouble_and_one_that_broke_at_once_did_not() -> None:
    clock = Clock()
    tries = backoff(clock, patience_s=35.0)
    tries.failed(AWAY)
    tries.failed(AWAY)
    tries.accepted()
    clock.now += 600.0
    assert tries.failed(AWAY) == pytest.approx(0.1)
    clock = Clock()
    tries = backoff(clock, patience_s=35.0)
    with pytest.raises(scpsfm.Unavailable):
        for _ in range(1000):
            clock.now += tries.failed(AWAY)
            tries.accepted()
            clock.now += 0.01


def test_no_patience_is_no_retry() -> None:
    with pytest.raises(scpsfm.Unavailable):
        backoff(Clock(), patience_s=0.0).failed(AWAY)


def test_only_what_may_fare_better_is_repeated() -> None:
    code = grpc.StatusCode

    def transient(kind: type[ScpsfmError], status: grpc.StatusCode, message: str = "", reason: str = "") -> bool:
        return is_transient(kind(message, reason=reason, code=status))

    assert transient(scpsfm.Unavailable, code.UNAVAILABLE)
    assert transient(scpsfm.Unavailable, code.UNAVAILABLE, reason="DRAINING")
    assert transient(scpsfm.InternalError, code.UNKNOWN, "Stream removed")
    assert transient(scpsfm.InternalError, code.INTERNAL, "Received RST_STREAM with error code 2")
    assert transient(scpsfm.InternalError, code.CANCELLED, "CANCELLED")
    assert is_transient(full(1.0))
    assert not transient(scpsfm.InternalError, code.CANCELLED, "Locally cancelled by application!")
    assert not transient(scpsfm.InternalError, code.CANCELLED, "Channel closed!")
    assert not transient(scpsfm.InternalError, code.INTERNAL, "internal error", "INTERNAL")
    assert not transient(scpsfm.InternalError, code.INTERNAL, "Exception deserializing response!")
    assert not transient(scpsfm.Unavailable, code.UNAVAILABLE, "Ssl handshake failed: CERTIFICATE_VERIFY_FAILED")
    assert not transient(scpsfm.ResourceExhausted, code.RESOURCE_EXHAUSTED, reason="QUEUE_FULL")
    for kind, status in ((scpsfm.InvalidArgument, code.INVALID_ARGUMENT), (scpsfm.NotFound, code.NOT_FOUND)):
        assert not transient(kind, status)


@pytest.mark.parametrize("wrong", [{"patience_s": -1.0}, {"first_pause_s": 0.0}, {"jitter": 1.0}])
def test_a_policy_that_makes_no_sense_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="RetryPolicy"):
        scpsfm.RetryPolicy(**wrong)
