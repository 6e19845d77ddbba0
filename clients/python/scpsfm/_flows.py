"""What the clients do, without doing it: generators that ask for calls and pauses, and are told what came of them.

The sync and the async client run the same flows, so that retries, resumption and request ids are written once.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import grpc
from google.protobuf.message import DecodeError

from . import jobs as views
from ._crc32c import crc32c
from ._retry import Backoff, RetryPolicy
from ._stubs import (
    calibration_service_pb2,
    input_pb2,
    input_service_pb2,
    job_pb2,
    job_service_pb2,
    result_pb2,
)
from .errors import (
    DataLoss,
    DeadlineExceeded,
    InternalError,
    InvalidArgument,
    JobCancelled,
    JobDeadlineExceeded,
    JobError,
    JobFailed,
    MessageTooLarge,
    NotFound,
    ScpsfmError,
    Violation,
)
from .jobs import JobState, Settings, state_of
from .matches import Matches
from .result import Result
from .tracks import Tracks

CHUNK_BYTES = 512 * 1024
"""Bytes of one chunk of an upload: what any server takes, and little to send again."""

SMALL_OBSERVATIONS = 16384
"""Up to so many observations a Solve has its input in its first message."""

T = TypeVar("T")

Source = Tracks | Matches
"""An input that is at hand."""


@dataclass(frozen=True)
class Call:
    """Make a call with one answer; `request` is a message, or an iterator of messages for a streaming one."""

    method: str
    request: Any
    timeout: float | None


@dataclass(frozen=True)
class Open:
    """Begin a call that answers with a stream; comes to a `Stream`."""

    method: str
    request: Any
    timeout: float | None


@dataclass
class Stream:
    """A call that answers with a stream."""

    call: Any
    accepted: bool
    """Whether the server has begun to answer."""


@dataclass(frozen=True)
class Read:
    """Read the next message; `None` at the end."""

    stream: Stream


@dataclass(frozen=True)
class Close:
    """Give a stream up."""

    stream: Stream


@dataclass(frozen=True)
class Sleep:
    """Wait."""

    seconds: float


@dataclass(frozen=True)
class Emit:
    """Hand something to the caller."""

    value: Any


Op = Call | Open | Read | Close | Sleep | Emit
Flow = Generator[Op, Any, T]


@dataclass(frozen=True)
class Context:
    """What all flows of a client share."""

    parent: str
    policy: RetryPolicy
    upload_above_bytes: int
    clock: Callable[[], float] = time.monotonic


class Trouble:
    """The tries of one operation, under the caller's timeout."""

    def __init__(self, context: Context, timeout: float | None) -> None:
        if timeout is not None and not timeout > 0.0:
            raise InvalidArgument(
                f"timeout: {timeout} is not positive",
                reason="INVALID_ARGUMENT",
                violations=[Violation("timeout", f"{timeout} is not positive")],
            )
        self._clock = context.clock
        self._timeout = timeout
        self._end = None if timeout is None else context.clock() + timeout
        self.backoff = Backoff(context.policy, context.clock)

    def left(self) -> float | None:
        """Seconds that the caller still waits; `None`: for ever."""
        return None if self._end is None else max(0.0, self._end - self._clock())

    def limit(self) -> float | None:
        """Seconds that the next try of a call may take: in times of trouble no longer than that is waited for."""
        bounds = [bound for bound in (self.left(), self.backoff.left()) if bound is not None]
        # Nothing comes of a call without any time.
        return max(0.05, min(bounds)) if bounds else None

    def failed(self, error: ScpsfmError) -> Sleep:
        """The pause before another try.

        Raises:
            ScpsfmError: No other try is made.

        """
        left = self.left()
        is_local = isinstance(error, DeadlineExceeded) and not error.reason
        if is_local and (left is None or left > 0.0):
            # The try was cut short, by the time that a trouble is waited for.
            error = self.backoff.last() or error
        elif is_local:
            raise self._too_late(self.backoff.last()) from error
        pause = self.backoff.failed(error)
        if left is not None and pause >= left:
            raise self._too_late(error) from error
        return Sleep(pause)

    def _too_late(self, last: ScpsfmError | None) -> DeadlineExceeded:
        words = f"the timeout of {self._timeout:g} s passed"
        if last is not None:
            words += f"; before that: {last}"
        return DeadlineExceeded(words, reason="CLIENT_TIMEOUT", code=grpc.StatusCode.DEADLINE_EXCEEDED)


def call(context: Context, method: str, request: Any, timeout: float | None = None) -> Flow[Any]:
    """A call that may be repeated."""
    return (yield from _call(Trouble(context, timeout), method, request))


def _call(trouble: Trouble, method: str, request: Any) -> Flow[Any]:
    while True:
        try:
            answer = yield Call(method, request, trouble.limit())
        except ScpsfmError as error:
            yield trouble.failed(error)
        else:
            trouble.backoff.reset()
            return answer


@dataclass(frozen=True)
class JobOptions:
    """What is said of a job beside input and settings."""

    settings: Settings | None = None
    labels: Mapping[str, str] | None = None
    priority: int = 0
    time_limit: float | None = None
    job_id: str | None = None
    request_id: str | None = None
    webhook: str | None = None


def create_request(context: Context, options: JobOptions) -> job_service_pb2.CreateJobRequest:
    """A request without its input, with a request id, so that it can be made again where the answer is lost."""
    request = job_service_pb2.CreateJobRequest(parent=context.parent)
    request.job.SetInParent()
    job = request.job
    with _argument("labels", "job.labels"):
        job.labels.update(options.labels or {})
    with _argument("priority", "job.priority"):
        job.priority = options.priority
    if options.time_limit is not None:
        with _argument("time_limit", "job.time_limit"):
            job.time_limit.FromNanoseconds(round(options.time_limit * 1e9))
    if options.settings is not None:
        with _argument("settings", "job.settings"):
            job.settings.CopyFrom(options.settings.to_proto())
    if options.webhook is not None:
        with _argument("webhook", "job.webhook"):
            job.webhook.url = options.webhook
    with _argument("job_id", "job_id"):
        request.job_id = options.job_id or ""
    with _argument("request_id", "request_id"):
        request.request_id = options.request_id or str(uuid.uuid4())
    return request


def priority_request(name: str, priority: int, etag: str) -> job_service_pb2.SetJobPriorityRequest:
    """A request for another priority of a job."""
    request = job_service_pb2.SetJobPriorityRequest(name=name, etag=etag)
    with _argument("priority", "priority"):
        request.priority = priority
    return request


@contextlib.contextmanager
def _argument(name: str, field: str) -> Iterator[None]:
    """Names the argument that has no form in a message, such as one of another type."""
    try:
        yield
    except InvalidArgument:
        raise
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        what = f"a value that cannot be sent ({error})"
        raise InvalidArgument(
            f"{name}: {what}", reason="INVALID_ARGUMENT", violations=[Violation(field, what)]
        ) from None


def _named(error: ScpsfmError, request_id: str, tracks: Source | str | None) -> ScpsfmError:
    """The error of a creation, with its request id, and the file and line of the input."""
    if isinstance(error, InvalidArgument):
        return error if tracks is None or isinstance(tracks, str) else tracks._locate(error)
    error.request_id = request_id
    return error


def submit(context: Context, tracks: Source | str, options: JobOptions, timeout: float | None) -> Flow[job_pb2.Job]:
    """Creates a job; a large input is uploaded first. Emits how many of how many bytes the server has."""
    trouble = Trouble(context, timeout)
    request = create_request(context, options)
    try:
        if isinstance(tracks, str):
            request.input = tracks
            return (yield from _call(trouble, "CreateJob", request))
        whole = tracks.to_proto()
        getattr(request, tracks._FIELD).CopyFrom(whole)
        if request.ByteSize() <= context.upload_above_bytes:
            try:
                return (yield from _call(trouble, "CreateJob", request))
            except MessageTooLarge:
                pass
        stored = yield from _upload(context, trouble, Encoded(tracks._FIELD, whole))
        request.input = stored.name
        return (yield from _call(trouble, "CreateJob", request))
    except ScpsfmError as error:
        raise _named(error, request.request_id, tracks) from error.__cause__


def submit_batch(
    context: Context, inputs: Sequence[Source | str], options: JobOptions, timeout: float | None
) -> Flow[list[job_pb2.Job]]:
    """Creates a job of each input, all or none; large ones are uploaded first."""
    trouble = Trouble(context, timeout)
    try:
        return (yield from _create_batch(context, trouble, inputs, options, context.upload_above_bytes))
    except MessageTooLarge:
        # A server that takes less in a message.
        return (yield from _create_batch(context, trouble, inputs, options, 0))


def _create_batch(
    context: Context, trouble: Trouble, inputs: Sequence[Source | str], options: JobOptions, room: int
) -> Flow[list[job_pb2.Job]]:
    """Creates a job of each input; those that together have more than `room` bytes are uploaded first."""
    batch = job_service_pb2.BatchCreateJobsRequest(parent=context.parent)
    for number, tracks in enumerate(inputs, start=1):
        # One that is given stands, with the number of the job after it, for each of them.
        request_id = None if options.request_id is None else f"{options.request_id}-{number}"
        request = create_request(context, replace(options, request_id=request_id))
        if isinstance(tracks, str):
            request.input = tracks
        else:
            whole = tracks.to_proto()
            if whole.ByteSize() <= room:
                getattr(request, tracks._FIELD).CopyFrom(whole)
                room -= whole.ByteSize()
            else:
                try:
                    stored = yield from _upload(context, trouble, Encoded(tracks._FIELD, whole))
                except InvalidArgument as error:
                    raise tracks._locate(error) from None
                request.input = stored.name
        batch.requests.append(request)
    try:
        answer = yield from _call(trouble, "BatchCreateJobs", batch)
    except InvalidArgument as error:
        raise _of_request(error, inputs) from None
    jobs: list[job_pb2.Job] = list(answer.jobs)
    return jobs


def _of_request(error: InvalidArgument, inputs: Sequence[Source | str]) -> InvalidArgument:
    """Says where in which file the first field stands that a batch was refused for."""
    number, bracket, rest = (error.field or "").removeprefix("requests[").partition("].")
    if not bracket or not number.isdigit() or int(number) >= len(inputs):
        return error
    tracks = inputs[int(number)]
    if not isinstance(tracks, str):
        field, error.field = error.field, rest
        tracks._locate(error)
        error.field = field
    return error


class Encoded:
    """An input in the form in which it is uploaded."""

    def __init__(self, field: str, whole: input_pb2.TrackSet | input_pb2.MatchSet) -> None:
        data = input_pb2.InputData()
        getattr(data, field).CopyFrom(whole)
        self.data: bytes = data.SerializeToString()
        self.sha256 = hashlib.sha256(self.data).digest()

    @property
    def upload_id(self) -> str:
        """A UUID of version 8 (RFC 9562): of the same bytes always the same.

        So a program that is started again goes on where the first one was stopped.
        """
        value = bytearray(self.sha256[:16])
        value[6] = (value[6] & 0x0F) | 0x80
        value[8] = (value[8] & 0x3F) | 0x80
        return str(uuid.UUID(bytes=bytes(value)))

    def messages(self, parent: str, begin: int) -> Iterator[input_service_pb2.UploadInputRequest]:
        """Every message of a stream that goes on from there."""
        yield input_service_pb2.UploadInputRequest(
            start=input_service_pb2.UploadStart(
                parent=parent, upload_id=self.upload_id, size_bytes=len(self.data), sha256=self.sha256
            )
        )
        for offset in range(begin, len(self.data), CHUNK_BYTES):
            data = self.data[offset : offset + CHUNK_BYTES]
            yield input_service_pb2.UploadInputRequest(
                chunk=input_service_pb2.UploadChunk(offset=offset, data=data, crc32c=crc32c(data))
            )
        yield input_service_pb2.UploadInputRequest(finish=input_service_pb2.UploadFinish(sha256=self.sha256))


_GOES_ON = ("CHUNK_CORRUPTED", "UPLOAD_TAKEN_OVER", "INPUT_STALLED")


def _goes_on(error: ScpsfmError) -> bool:
    """Whether an answer is about a stream and not about the input.

    A chunk was damaged on its way, or another stream of the upload, perhaps an earlier one of this very client, wrote
    after its state was asked.
    """
    return error.reason in _GOES_ON or any(violation.field == "chunk.offset" for violation in error.violations)


def upload(context: Context, tracks: Source, timeout: float | None) -> Flow[input_pb2.Input]:
    """Uploads an input, or what is missing of it. Emits how many of how many bytes the server has."""
    try:
        return (yield from _upload(context, Trouble(context, timeout), Encoded(tracks._FIELD, tracks.to_proto())))
    except InvalidArgument as error:
        raise tracks._locate(error) from None


def _upload(context: Context, trouble: Trouble, encoded: Encoded) -> Flow[input_pb2.Input]:
    request = input_service_pb2.GetUploadStatusRequest(parent=context.parent, upload_id=encoded.upload_id)
    best = 0
    while True:
        try:
            try:
                # A finished one is begun again all the same, which says that it is wanted, and sends no more of it.
                committed = (yield Call("GetUploadStatus", request, trouble.limit())).committed_bytes
            except NotFound as error:
                if error.reason != "UPLOAD_NOT_FOUND":
                    raise
                committed = 0
            if committed > best:
                best = committed
                trouble.backoff.reset()
            committed = min(committed, len(encoded.data))
            yield Emit((committed, len(encoded.data)))
            stored = yield Call("UploadInput", encoded.messages(context.parent, committed), trouble.left())
        except ScpsfmError as error:
            if _goes_on(error):
                error = DataLoss(error.message, reason="", code=grpc.StatusCode.UNAVAILABLE)
            yield trouble.failed(error)
        else:
            trouble.backoff.reset()
            yield Emit((len(encoded.data), len(encoded.data)))
            return stored


def _is_end(event: job_pb2.JobEvent) -> bool:
    return event.WhichOneof("body") == "state_change" and state_of(event.state_change.state).is_final


@dataclass
class EventFollower:
    """Which of a job's events were handed on: each sequenced one once."""

    sequence: int = 0
    name: str = ""

    def follow(self, stream: Stream, trouble: Trouble) -> Flow[job_pb2.JobEvent | None]:
        """Emits the events of one stream to its end, and returns the last; `None`: it ended without a final state."""
        if stream.accepted:
            trouble.backoff.accepted()
        # The end of the job, unless more comes: it may have been retried since.
        last = None
        while True:
            try:
                event = yield Read(stream)
            except ScpsfmError:
                if last is None:
                    raise
                return last
            if event is None:
                return last
            if event.sequence and event.sequence <= self.sequence:
                continue
            trouble.backoff.reset()
            self.sequence = event.sequence or self.sequence
            self.name = event.job
            if event.WhichOneof("body") is None:
                # Of a kind that this version does not know; a job that was retried tells first that it is queued.
                continue
            yield Emit(event)
            last = event if _is_end(event) else None


def watch(context: Context, name: str, after: int, timeout: float | None) -> Flow[job_pb2.JobEvent | None]:
    """Emits a job's events after a sequence number until its end, over broken connections and restarts.

    Returns the last; `None` where the job has ended and nothing came after that number.
    """
    return (yield from _watch(Trouble(context, timeout), name, after))


def _watch(trouble: Trouble, name: str, after: int) -> Flow[job_pb2.JobEvent | None]:
    follower = EventFollower(after)
    while True:
        try:
            request = job_service_pb2.WatchJobRequest(name=name, after_sequence=follower.sequence)
            stream = yield Open("WatchJob", request, trouble.left())
            return (yield from follower.follow(stream, trouble))
        except ScpsfmError as error:
            yield trouble.failed(error)


def wait(context: Context, name: str, timeout: float | None) -> Flow[job_pb2.Job]:
    """Waits for a job's end and returns it as it ended. Emits its new events."""
    return (yield from _wait(Trouble(context, timeout), name))


def _wait(trouble: Trouble, name: str) -> Flow[job_pb2.Job]:
    request = job_service_pb2.GetJobRequest(name=name)
    while True:
        job: job_pb2.Job = yield from _call(trouble, "GetJob", request)
        state = state_of(job.state)
        if state is JobState.UNSPECIFIED:
            raise InternalError(f"the state {job.state} of {name} is of a later version", reason="UNKNOWN_STATE")
        if state.is_final:
            return job
        yield from _watch(trouble, name, job.last_sequence)


def ended(name: str, state: JobState, reason: str, message: str) -> JobError | None:
    """The exception of a job that ended without a result."""
    if state is JobState.SUCCEEDED:
        return None
    if state is JobState.CANCELLED:
        return JobCancelled(f"{name} was cancelled", job=name)
    if state is JobState.DEADLINE_EXCEEDED:
        return JobDeadlineExceeded(f"{name}: its deadline passed before a result stood", job=name)
    return JobFailed(f"{name} failed: {message or state}", reason=reason, job=name)


def result(context: Context, name: str, timeout: float | None) -> Flow[result_pb2.JobResult]:
    """Waits for a job's end and reads its result. Emits its new events."""
    trouble = Trouble(context, timeout)
    job = yield from _wait(trouble, name)
    failure = ended(name, state_of(job.state), job.error.reason, job.error.message)
    if failure is not None:
        raise failure
    return (yield from _read_result(trouble, name))


def _read_result(trouble: Trouble, name: str) -> Flow[result_pb2.JobResult]:
    data = bytearray()
    total: int | None = None
    sha256 = b""
    while True:
        try:
            request = job_service_pb2.ReadJobResultRequest(name=name, offset=len(data))
            stream = yield Open("ReadJobResult", request, trouble.left())
            while (chunk := (yield Read(stream))) is not None:
                if chunk.offset != len(data):
                    yield Close(stream)
                    raise InternalError(f"a chunk begins at {chunk.offset} where {len(data)} was due", job=name)
                data += chunk.data
                total, sha256 = chunk.size_bytes, chunk.sha256
                trouble.backoff.reset()
        except ScpsfmError as error:
            yield trouble.failed(error)
        else:
            break
    if total != len(data):
        raise InternalError(f"the result ended at {len(data)} of {total} bytes", job=name)
    if sha256 and hashlib.sha256(data).digest() != sha256:
        raise DataLoss("the result does not match its SHA-256", reason="RESULT_CORRUPTED", job=name)
    try:
        return result_pb2.JobResult.FromString(bytes(data))
    except DecodeError as error:
        raise InternalError(f"the result cannot be decoded: {error}", job=name) from None


def solve(
    context: Context, tracks: Source | str, options: JobOptions, follower: EventFollower, timeout: float | None
) -> Flow[result_pb2.JobResult]:
    """Creates a job, follows it to its end and reads its result. Emits its events.

    A broken call is made again under the same request id, which takes up the job. `follower` has the job's name, once
    it is known, so that whoever gives up can cancel it.
    """
    trouble = Trouble(context, timeout)
    config = create_request(context, options)
    chunked = None if isinstance(tracks, str) or tracks._longest <= SMALL_OBSERVATIONS else tracks
    if isinstance(tracks, str):
        config.input = tracks
    else:
        getattr(config, tracks._FIELD).CopyFrom(tracks.to_proto() if chunked is None else tracks._head())

    def messages() -> Iterator[calibration_service_pb2.SolveRequest]:
        yield calibration_service_pb2.SolveRequest(config=config)
        if chunked is not None:
            for chunk in chunked._chunks():
                message = calibration_service_pb2.SolveRequest()
                getattr(message, f"{chunked._FIELD}_chunk").CopyFrom(chunk)
                yield message

    while True:
        try:
            stream = yield Open("Solve", messages(), trouble.left())
            last = yield from follower.follow(stream, trouble)
        except ScpsfmError as error:
            try:
                yield trouble.failed(error)
            except ScpsfmError as final:
                final.job = follower.name or None
                raise _named(final, config.request_id, tracks) from final.__cause__
        else:
            break
    if last is None:
        raise InternalError("the server ended a solve without its last event", job=follower.name or None)
    change = last.state_change
    failure = ended(follower.name, state_of(change.state), change.error.reason, change.error.message)
    if failure is not None:
        raise failure
    return (yield from _read_result(trouble, follower.name))


def delete(context: Context, name: str, etag: str, timeout: float | None) -> Flow[None]:
    """Deletes a job; that it is gone after an answer was lost is no error."""
    yield from _delete(context, "DeleteJob", job_service_pb2.DeleteJobRequest(name=name, etag=etag), timeout)


def delete_input(context: Context, name: str, timeout: float | None) -> Flow[None]:
    """Deletes an uploaded input; that it is gone after an answer was lost is no error."""
    yield from _delete(context, "DeleteInput", input_service_pb2.DeleteInputRequest(name=name), timeout)


def _delete(context: Context, method: str, request: Any, timeout: float | None) -> Flow[None]:
    trouble = Trouble(context, timeout)
    while True:
        try:
            yield Call(method, request, trouble.limit())
            return
        except NotFound:
            if trouble.backoff.last() is None:
                raise
            return
        except ScpsfmError as error:
            yield trouble.failed(error)


def list_jobs(context: Context, filter: str, order_by: str, page_size: int, timeout: float | None) -> Flow[None]:
    """Emits the tenant's jobs, page by page."""
    trouble = Trouble(context, timeout)
    request = job_service_pb2.ListJobsRequest(
        parent=context.parent, page_size=page_size, filter=filter, order_by=order_by
    )
    while True:
        page = yield from _call(trouble, "ListJobs", request)
        for job in page.jobs:
            yield Emit(job)
        if not page.next_page_token:
            return
        request.page_token = page.next_page_token


def list_inputs(context: Context, page_size: int, timeout: float | None) -> Flow[None]:
    """Emits the tenant's uploaded inputs, page by page."""
    trouble = Trouble(context, timeout)
    request = input_service_pb2.ListInputsRequest(parent=context.parent, page_size=page_size)
    while True:
        page = yield from _call(trouble, "ListInputs", request)
        for stored in page.inputs:
            yield Emit(views.InputInfo.of(stored))
        if not page.next_page_token:
            return
        request.page_token = page.next_page_token


def job_name(context: Context, name: str) -> str:
    """The full name of a job of which the last part may be given; `-` stands for the tenant of the key."""
    return name if "/" in name else f"{context.parent or 'tenants/-'}/jobs/{name}"


def finished(message: result_pb2.JobResult, tracks: Source | str | None) -> Result:
    """The result for the caller, with its input where that is at hand; of matches, with the tracks joined from them."""
    if isinstance(tracks, Matches):
        return Result(message, tracks._joined(message))
    return Result(message, tracks if isinstance(tracks, Tracks) else None)
