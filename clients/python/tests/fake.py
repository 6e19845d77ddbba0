"""A server within the test's process that does what it is told, broken connections included."""

from __future__ import annotations

import threading
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import grpc
from google.protobuf import any_pb2, duration_pb2, empty_pb2
from google.rpc import error_details_pb2, status_pb2

from scpsfm._crc32c import crc32c
from scpsfm._stubs import (
    calibration_service_pb2,
    calibration_service_pb2_grpc,
    input_pb2,
    input_service_pb2,
    input_service_pb2_grpc,
    job_pb2,
    job_service_pb2,
    job_service_pb2_grpc,
    result_pb2,
)


class _Status(NamedTuple):
    code: grpc.StatusCode
    details: str
    trailing_metadata: Any


class Refusal(Exception, grpc.Status):
    """A status with google.rpc details, as the service sends them."""

    def __init__(
        self,
        code: grpc.StatusCode,
        message: str,
        reason: str = "",
        *,
        fields: dict[str, str] | None = None,
        metadata: dict[str, str] | None = None,
        retry_s: float | None = None,
    ) -> None:
        super().__init__(message)
        details: list[Any] = []
        if reason:
            details.append(error_details_pb2.ErrorInfo(reason=reason, domain="scpsfm", metadata=metadata or {}))
        if fields:
            violations = [
                error_details_pb2.BadRequest.FieldViolation(field=field, description=what)
                for field, what in fields.items()
            ]
            details.append(error_details_pb2.BadRequest(field_violations=violations))
        if retry_s is not None:
            delay = duration_pb2.Duration()
            delay.FromNanoseconds(round(retry_s * 1e9))
            details.append(error_details_pb2.RetryInfo(retry_delay=delay))
        packed = [any_pb2.Any() for _ in details]
        for into, detail in zip(packed, details, strict=True):
            into.Pack(detail)
        whole = status_pb2.Status(code=code.value[0], message=message, details=packed)
        self.code = code
        self.details = message
        self.trailing_metadata = (("grpc-status-details-bin", whole.SerializeToString()),) if details else ()


def away(message: str = "away") -> Refusal:
    """What a server that goes down says."""
    return Refusal(grpc.StatusCode.UNAVAILABLE, message)


class Fake(
    job_service_pb2_grpc.JobServiceServicer,
    input_service_pb2_grpc.InputServiceServicer,
    calibration_service_pb2_grpc.CalibrationServiceServicer,
):
    """Jobs that end at once, with `events` progress events each, and one result for all."""

    def __init__(self, result: result_pb2.JobResult, events: int = 5) -> None:
        self.result = result
        self.events = events
        self.final_state = job_pb2.JOB_STATE_SUCCEEDED
        self.max_message_bytes = 1 << 30
        self.chunk_bytes = 1000
        self.calls: dict[str, list[Any]] = defaultdict(list)
        self.metadata: list[dict[str, str]] = []
        # Of each call, in the order of the calls: before anything is done, and after all is done.
        self.before: dict[str, list[Refusal | None]] = defaultdict(list)
        self.after: dict[str, list[Refusal | None]] = defaultdict(list)
        # Messages after which a stream breaks, one entry a call.
        self.breaks: dict[str, list[int]] = defaultdict(list)
        self.corrupt: list[int] = []
        self.jobs: dict[str, job_pb2.Job] = {}
        self.by_request_id: dict[str, str] = {}
        self.uploads: dict[str, bytearray] = {}
        self.sizes: dict[str, int] = {}
        self.inputs: dict[str, input_pb2.Input] = {}
        self.received_chunks: list[tuple[int, int]] = []
        self.never_ends = False
        self.cancelled: set[str] = set()
        self._lock = threading.Lock()

    # The order of what happens in a call.

    def _begin(self, method: str, request: Any, context: grpc.ServicerContext) -> None:
        with self._lock:
            self.calls[method].append(request)
            self.metadata.append({key: str(value) for key, value in context.invocation_metadata()})
            refusal = self.before[method].pop(0) if self.before[method] else None
        if refusal is not None:
            context.abort_with_status(refusal)

    def _end(self, method: str, context: grpc.ServicerContext) -> None:
        with self._lock:
            refusal = self.after[method].pop(0) if self.after[method] else None
        if refusal is not None:
            context.abort_with_status(refusal)

    def _stream(self, method: str, messages: Iterator[Any], context: grpc.ServicerContext) -> Iterator[Any]:
        most = self.breaks[method].pop(0) if self.breaks[method] else None
        for number, message in enumerate(messages):
            if number == most:
                context.abort_with_status(away(f"{method} broke"))
            yield message
        self._end(method, context)

    # JobService.

    def _create(self, request: job_service_pb2.CreateJobRequest) -> job_pb2.Job:
        with self._lock:
            known = self.by_request_id.get(request.request_id)
            if known is not None:
                return self.jobs[known]
            name = f"tenants/default/jobs/{request.job_id or f'j{len(self.jobs)}'}"
            job = job_pb2.Job(name=name, state=self.final_state, labels=request.job.labels)
            job.last_sequence = self.events + 3
            job.input = request.input
            job.create_time.seconds = 1_700_000_000
            if self.never_ends:
                job.state, job.last_sequence = job_pb2.JOB_STATE_RUNNING, 1
            if self.final_state == job_pb2.JOB_STATE_FAILED:
                job.error.reason, job.error.message = "INTERNAL", "a defect"
            self.jobs[name] = job
            self.by_request_id[request.request_id] = name
            return job

    def _check_size(self, request: Any, context: Any) -> None:
        if request.ByteSize() > self.max_message_bytes:
            refusal = Refusal(grpc.StatusCode.OUT_OF_RANGE, "message too large", "MESSAGE_TOO_LARGE")
            context.abort_with_status(refusal)

    def CreateJob(self, request: Any, context: Any) -> Any:
        self._begin("CreateJob", request, context)
        self._check_size(request, context)
        job = self._create(request)
        self._end("CreateJob", context)
        return job

    def BatchCreateJobs(self, request: Any, context: Any) -> Any:
        self._begin("BatchCreateJobs", request, context)
        self._check_size(request, context)
        jobs = [self._create(one) for one in request.requests]
        self._end("BatchCreateJobs", context)
        return job_service_pb2.BatchCreateJobsResponse(jobs=jobs)

    def _job(self, name: str, context: Any) -> job_pb2.Job:
        job = self.jobs.get(name)
        if job is None:
            context.abort_with_status(Refusal(grpc.StatusCode.NOT_FOUND, f"there is no job {name}", "JOB_NOT_FOUND"))
        return job

    def GetJob(self, request: Any, context: Any) -> Any:
        self._begin("GetJob", request, context)
        return self._job(request.name, context)

    def ListJobs(self, request: Any, context: Any) -> Any:
        self._begin("ListJobs", request, context)
        jobs = list(self.jobs.values())
        first = int(request.page_token or 0)
        last = first + (request.page_size or 50)
        token = str(last) if last < len(jobs) else ""
        return job_service_pb2.ListJobsResponse(jobs=jobs[first:last], next_page_token=token)

    def _events(self, name: str, after: int, context: Any) -> Iterator[job_pb2.JobEvent]:
        bodies: list[Callable[[job_pb2.JobEvent], None]] = []

        def state(value: Any) -> Callable[[job_pb2.JobEvent], None]:
            def fill(event: job_pb2.JobEvent) -> None:
                event.state_change.state = value
                if value == job_pb2.JOB_STATE_FAILED:
                    event.state_change.error.reason, event.state_change.error.message = "INTERNAL", "a defect"

            return fill

        def progress(number: int) -> Callable[[job_pb2.JobEvent], None]:
            def fill(event: job_pb2.JobEvent) -> None:
                event.progress.fraction = number / self.events
                event.progress.stage = 2
                event.progress.inlier_track_count = number

            return fill

        def summary(event: job_pb2.JobEvent) -> None:
            event.summary.status = result_pb2.RESULT_STATUS_SOLVED

        bodies.append(state(job_pb2.JOB_STATE_RUNNING))
        bodies += [progress(number + 1) for number in range(self.events)]
        if not self.never_ends:
            bodies += [summary, state(self.final_state)]
        for sequence, fill in enumerate(bodies, start=1):
            if sequence > after:
                event = job_pb2.JobEvent(job=name, attempt=1, sequence=sequence)
                fill(event)
                yield event
        while self.never_ends and context.is_active():
            if name in self.cancelled:
                event = job_pb2.JobEvent(job=name, attempt=1, sequence=len(bodies) + 1)
                event.state_change.state = job_pb2.JOB_STATE_CANCELLED
                yield event
                return
            threading.Event().wait(0.01)

    def WatchJob(self, request: Any, context: Any) -> Any:
        self._begin("WatchJob", request, context)
        self._job(request.name, context)
        yield from self._stream("WatchJob", self._events(request.name, request.after_sequence, context), context)

    def CancelJob(self, request: Any, context: Any) -> Any:
        self._begin("CancelJob", request, context)
        job = self._job(request.name, context)
        self.cancelled.add(request.name)
        if self.never_ends:
            job.state = job_pb2.JOB_STATE_CANCELLED
        self._end("CancelJob", context)
        return job

    def RetryJob(self, request: Any, context: Any) -> Any:
        self._begin("RetryJob", request, context)
        job = self._job(request.name, context)
        job.state = job_pb2.JOB_STATE_QUEUED
        self._end("RetryJob", context)
        return job

    def SetJobPriority(self, request: Any, context: Any) -> Any:
        self._begin("SetJobPriority", request, context)
        job = self._job(request.name, context)
        job.priority = request.priority
        self._end("SetJobPriority", context)
        return job

    def DeleteJob(self, request: Any, context: Any) -> Any:
        self._begin("DeleteJob", request, context)
        self._job(request.name, context)
        del self.jobs[request.name]
        self._end("DeleteJob", context)
        return empty_pb2.Empty()

    def ReadJobResult(self, request: Any, context: Any) -> Any:
        self._begin("ReadJobResult", request, context)
        self._job(request.name, context)
        import hashlib

        data = self.result.SerializeToString(deterministic=True)

        def chunks() -> Iterator[Any]:
            for offset in range(request.offset, len(data), self.chunk_bytes):
                piece = data[offset : offset + self.chunk_bytes]
                yield job_service_pb2.ResultChunk(
                    data=piece, offset=offset, size_bytes=len(data), sha256=hashlib.sha256(data).digest()
                )

        yield from self._stream("ReadJobResult", chunks(), context)

    # CalibrationService.

    def Solve(self, requests: Any, context: Any) -> Any:
        config: Any = None
        for message in requests:
            kind = message.WhichOneof("message")
            if kind == "config":
                config = message.config
            else:
                self.received_chunks.append((0, len(message.track_set_chunk.xs)))
        self._begin("Solve", config, context)
        self.solved = len(config.track_set.xs), sum(count for _, count in self.received_chunks)
        job = self._create(config)
        yield from self._stream("Solve", self._events(job.name, 0, context), context)

    def GetCapabilities(self, request: Any, context: Any) -> Any:
        self._begin("GetCapabilities", request, context)
        answer = calibration_service_pb2.Capabilities(server_version="9.9", methods=[1, 3], backends=[1])
        answer.input_limits.max_views = 2000
        return answer

    # InputService.

    def GetUploadStatus(self, request: Any, context: Any) -> Any:
        self._begin("GetUploadStatus", request, context)
        if request.upload_id not in self.uploads:
            refusal = Refusal(grpc.StatusCode.NOT_FOUND, "there is no such upload", "UPLOAD_NOT_FOUND")
            context.abort_with_status(refusal)
        committed = len(self.uploads[request.upload_id])
        return input_service_pb2.UploadStatus(committed_bytes=committed, size_bytes=self.sizes[request.upload_id])

    def UploadInput(self, requests: Any, context: Any) -> Any:
        start = next(requests).start
        self._begin("UploadInput", start, context)
        data = self.uploads.setdefault(start.upload_id, bytearray())
        self.sizes[start.upload_id] = start.size_bytes
        name = f"tenants/default/inputs/{start.upload_id}"
        if name in self.inputs:
            return self.inputs[name]
        most = self.breaks["UploadInput"].pop(0) if self.breaks["UploadInput"] else None
        for number, message in enumerate(requests):
            if number == most:
                context.abort_with_status(away("UploadInput broke"))
            if message.WhichOneof("message") == "finish":
                assert len(data) == start.size_bytes
                import hashlib

                assert hashlib.sha256(data).digest() == message.finish.sha256 == start.sha256
                self.inputs[name] = input_pb2.Input(name=name, size_bytes=len(data), sha256=start.sha256)
                break
            chunk = message.chunk
            self.received_chunks.append((chunk.offset, len(chunk.data)))
            if chunk.offset != len(data):
                refusal = Refusal(
                    grpc.StatusCode.INVALID_ARGUMENT, "a gap", "INVALID_ARGUMENT", fields={"chunk.offset": "a gap"}
                )
                context.abort_with_status(refusal)
            if self.corrupt and self.corrupt[0] == number:
                self.corrupt.pop(0)
                refusal = Refusal(grpc.StatusCode.DATA_LOSS, "damaged", "CHUNK_CORRUPTED", metadata={"offset": "0"})
                context.abort_with_status(refusal)
            assert crc32c(chunk.data) == chunk.crc32c != zlib.crc32(chunk.data)
            data += chunk.data
        self._end("UploadInput", context)
        return self.inputs[name]

    def ListInputs(self, request: Any, context: Any) -> Any:
        self._begin("ListInputs", request, context)
        return input_service_pb2.ListInputsResponse(inputs=list(self.inputs.values()))

    def DeleteInput(self, request: Any, context: Any) -> Any:
        self._begin("DeleteInput", request, context)
        if self.inputs.pop(request.name, None) is None:
            context.abort_with_status(Refusal(grpc.StatusCode.NOT_FOUND, "no such input", "INPUT_NOT_FOUND"))
        self._end("DeleteInput", context)
        return empty_pb2.Empty()


class Running:
    """A fake on a free port of the loopback interface."""

    def __init__(self, fake: Fake) -> None:
        self.fake = fake
        self._server = grpc.server(
            ThreadPoolExecutor(max_workers=16), options=[("grpc.max_receive_message_length", -1)]
        )
        job_service_pb2_grpc.add_JobServiceServicer_to_server(fake, self._server)
        input_service_pb2_grpc.add_InputServiceServicer_to_server(fake, self._server)
        calibration_service_pb2_grpc.add_CalibrationServiceServicer_to_server(fake, self._server)
        self.port = self._server.add_insecure_port("127.0.0.1:0")
        self._server.start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def stop(self) -> None:
        self.fake.never_ends = False
        self._server.stop(0).wait()
