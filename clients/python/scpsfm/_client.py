"""The client whose calls wait."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from os import PathLike
from types import TracebackType
from typing import Any, TypeVar

import grpc

from . import _flows as flows
from ._access import Access
from ._bar import OnProgress, Watcher
from ._flows import Call, Close, Context, Emit, Flow, JobOptions, Open, Read, Sleep, Stream
from ._retry import RetryPolicy
from ._stubs import calibration_service_pb2, job_service_pb2
from ._stubs_of import methods
from .errors import JobError, ScpsfmError, from_rpc
from .jobs import Capabilities, Event, InputInfo, JobInfo, JobState, Progress, Settings
from .matches import Matches
from .result import Result
from .tracks import Tracks

__all__ = ["Client", "Job"]

T = TypeVar("T")

UPLOAD_ABOVE_BYTES = 4 << 20
"""Inputs above this are uploaded in chunks by default: a broken connection then costs a chunk and not the input."""

CANCEL_SECONDS = 5.0
"""How long a client that gives up a solve tries to tell the server so."""


class Client:
    """A connection to a server; reconnects by itself. Threads may share one.

    Every call that breaks off is repeated under the retry policy: a creation under its request id, a watch after its
    last event, an upload and a result from their last byte. Every call may raise a `ScpsfmError`.
    """

    def __init__(
        self,
        address: str,
        *,
        api_key: str | None = None,
        tenant: str | None = None,
        tls_ca: str | PathLike[str] | bytes | None = None,
        tls_cert: str | PathLike[str] | bytes | None = None,
        tls_key: str | PathLike[str] | bytes | None = None,
        tls_server_name: str | None = None,
        plaintext_keys: bool = False,
        retry: RetryPolicy | None = None,
        upload_above_bytes: int = UPLOAD_ABOVE_BYTES,
        options: Sequence[tuple[str, Any]] = (),
    ) -> None:
        """Prepares the connection, which the first call makes.

        Args:
            address: HOST:PORT, http://HOST:PORT or https://HOST:PORT.
            api_key: Sent with every call. Left out: the variable SCPSFM_API_KEY, if it is set.
            tenant: Whose jobs these are. Left out: the variable SCPSFM_TENANT, else the tenant of the key.
            tls_ca: Authorities that the server's certificate must lead to: a PEM file, or its bytes. Left out: those
                that gRPC carries.
            tls_cert: Certificate to show to a server that asks for one, likewise.
            tls_key: Private key of that certificate.
            tls_server_name: Name in the server's certificate, where it is not that of the address.
            plaintext_keys: Send the key to another machine without TLS: whoever listens in has it.
            retry: When calls are repeated.
            upload_above_bytes: Inputs above this are uploaded in chunks.
            options: More options of the gRPC channel.

        Raises:
            InvalidArgument: An argument that cannot be used.

        """
        access = Access.of(
            address,
            api_key=api_key,
            tenant=tenant,
            tls_ca=tls_ca,
            tls_cert=tls_cert,
            tls_key=tls_key,
            tls_server_name=tls_server_name,
            plaintext_keys=plaintext_keys,
            options=options,
        )
        self.address = address
        self._access = access
        self._context = Context(access.parent, retry or RetryPolicy(), upload_above_bytes)
        credentials = access.credentials()
        if credentials is None:
            self._channel = grpc.insecure_channel(access.target, access.options)
        else:
            self._channel = grpc.secure_channel(access.target, credentials, access.options)
        self._methods = methods(self._channel)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.address!r})"

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; calls that are under way end."""
        self._channel.close()

    # What a flow asks for.

    def _do(self, op: flows.Op) -> Any:
        """Does what a flow asks for; errors of gRPC become those of this package."""
        if isinstance(op, Sleep):
            time.sleep(op.seconds)
            return None
        if isinstance(op, Close):
            op.stream.call.cancel()
            return None
        try:
            if isinstance(op, Call):
                return self._methods[op.method](op.request, timeout=op.timeout, metadata=self._access.metadata)
            if isinstance(op, Open):
                call = self._methods[op.method](op.request, timeout=op.timeout, metadata=self._access.metadata)
                call.initial_metadata()
                return Stream(call, call.is_active())
            if isinstance(op, Read):
                return next(op.stream.call, None)
        except grpc.RpcError as error:
            raise from_rpc(error) from None
        raise AssertionError(op)

    def _steps(self, flow: Flow[T]) -> Generator[Any, None, T]:
        """Runs a flow; yields what it emits, and returns what it comes to."""
        answer: Any = None
        raised: ScpsfmError | None = None
        streams: list[Stream] = []
        try:
            while True:
                try:
                    op = flow.send(answer) if raised is None else flow.throw(raised)
                except StopIteration as stop:
                    came_to: T = stop.value
                    return came_to
                answer = raised = None
                if isinstance(op, Emit):
                    yield op.value
                    continue
                try:
                    answer = self._do(op)
                except ScpsfmError as error:
                    raised = error
                if isinstance(answer, Stream):
                    streams = [answer]
        finally:
            for stream in streams:
                stream.call.cancel()
            flow.close()

    def _run(self, flow: Flow[T], on_emit: Callable[[Any], None] | None = None) -> T:
        """Runs a flow to its end and returns what it comes to."""
        steps = self._steps(flow)
        try:
            while True:
                value = next(steps)
                if on_emit is not None:
                    on_emit(value)
        except StopIteration as stop:
            value_of_flow: T = stop.value
            return value_of_flow
        finally:
            # A caller that is interrupted leaves no call behind.
            steps.close()

    # Calls.

    def capabilities(self, *, timeout: float | None = None) -> Capabilities:
        """What the server can do.

        Args:
            timeout: Seconds for the call, with its repetitions. Left out: as long as the retry policy allows.

        """
        request = calibration_service_pb2.GetCapabilitiesRequest()
        return Capabilities.of(self._run(flows.call(self._context, "GetCapabilities", request, timeout)))

    def solve(
        self,
        tracks: Tracks | Matches | InputInfo | str,
        settings: Settings | None = None,
        *,
        labels: Mapping[str, str] | None = None,
        priority: int = 0,
        time_limit: float | None = None,
        request_id: str | None = None,
        timeout: float | None = None,
        progress: OnProgress = False,
    ) -> Result:
        """Solves while the caller waits. A caller that is interrupted, or that gives up, cancels the job.

        Args:
            tracks: The input; or an uploaded one, or its name.
            settings: How to solve. Left out: the server's defaults.
            labels: The caller's own marks of the job.
            priority: Of the tenant's queued jobs, those of larger priority run first. -1000 to 1000.
            time_limit: Seconds after which the server gives the job up.
            request_id: Makes the call safe to repeat. Left out: one is made.
            timeout: Seconds after which this call is given up, and the job cancelled.
            progress: True shows a bar (needs tqdm); a function is called with each `Progress`.

        Raises:
            InvalidArgument: The input or a setting breaks a rule.
            JobError: The job ended without a result.
            ScpsfmError: Anything else.

        """
        options = JobOptions(settings, labels, priority, time_limit, None, request_id)
        source = tracks.name if isinstance(tracks, InputInfo) else tracks
        follower = flows.EventFollower()
        with Watcher(progress) as watcher:
            try:
                message = self._run(flows.solve(self._context, source, options, follower, timeout), watcher)
            except JobError:
                raise
            except BaseException:
                if follower.name:
                    with contextlib.suppress(Exception):
                        self.job(follower.name).cancel(timeout=CANCEL_SECONDS)
                raise
        return flows.finished(message, source)

    def submit(
        self,
        tracks: Tracks | Matches | InputInfo | str,
        settings: Settings | None = None,
        *,
        labels: Mapping[str, str] | None = None,
        priority: int = 0,
        time_limit: float | None = None,
        job_id: str | None = None,
        request_id: str | None = None,
        webhook: str | None = None,
        timeout: float | None = None,
        on_upload: Callable[[int, int], None] | None = None,
    ) -> Job:
        """Leaves a job with the server, which survives this program and the server.

        Args:
            tracks: The input; or an uploaded one, or its name.
            settings: How to solve. Left out: the server's defaults.
            labels: The caller's own marks of the job.
            priority: Of the tenant's queued jobs, those of larger priority run first. -1000 to 1000.
            time_limit: Seconds after which the server gives the job up.
            job_id: Last part of the job's name: 1 to 63 of a-z, 0-9 and `-`. Left out: the server chooses.
            request_id: Makes the call safe to repeat: the same id with the same input answers with the same job. Left
                out: one is made, so that this call's own repetitions are safe.
            webhook: URL that the server sends the job's end to, where its webhooks are on.
            timeout: Seconds for the call, with its repetitions.
            on_upload: Called with the bytes that the server has and those of the whole, where the input is uploaded.

        """
        options = JobOptions(settings, labels, priority, time_limit, job_id, request_id, webhook)
        source = tracks.name if isinstance(tracks, InputInfo) else tracks
        emit = None if on_upload is None else lambda value: on_upload(*value)
        job = self._run(flows.submit(self._context, source, options, timeout), emit)
        return Job(self, job.name, JobInfo.of(job), None if isinstance(source, str) else source)

    def submit_batch(
        self,
        inputs: Sequence[Tracks | Matches | InputInfo | str],
        settings: Settings | None = None,
        *,
        labels: Mapping[str, str] | None = None,
        priority: int = 0,
        time_limit: float | None = None,
        request_id: str | None = None,
        webhook: str | None = None,
        timeout: float | None = None,
    ) -> list[Job]:
        """Leaves a job of each input with the server, all or none.

        Args:
            inputs: The inputs, or uploaded ones.
            settings: How to solve each. Left out: the server's defaults.
            labels: The caller's own marks of each job.
            priority: Of each job.
            time_limit: Seconds after which the server gives each job up.
            request_id: With the number of the job after it, the request id of each. Left out: each gets one.
            webhook: URL that the server sends the end of each job to, where its webhooks are on.
            timeout: Seconds for the call, with its repetitions.

        """
        options = JobOptions(settings, labels, priority, time_limit, None, request_id, webhook)
        sources = [tracks.name if isinstance(tracks, InputInfo) else tracks for tracks in inputs]
        jobs = self._run(flows.submit_batch(self._context, sources, options, timeout))
        return [
            Job(self, job.name, JobInfo.of(job), None if isinstance(source, str) else source)
            for job, source in zip(jobs, sources, strict=True)
        ]

    def upload(
        self,
        tracks: Tracks | Matches,
        *,
        timeout: float | None = None,
        on_upload: Callable[[int, int], None] | None = None,
    ) -> InputInfo:
        """Leaves an input with the server, for any number of jobs. What the server has of it already is not sent again.

        Args:
            tracks: The input.
            timeout: Seconds for the call, with its repetitions.
            on_upload: Called with the bytes that the server has and those of the whole.

        """
        emit = None if on_upload is None else lambda value: on_upload(*value)
        return InputInfo.of(self._run(flows.upload(self._context, tracks, timeout), emit))

    def inputs(self, *, page_size: int = 0, timeout: float | None = None) -> Iterator[InputInfo]:
        """The tenant's uploaded inputs, the newest first."""
        return self._steps(flows.list_inputs(self._context, page_size, timeout))

    def delete_input(self, tracks: InputInfo | str, *, timeout: float | None = None) -> None:
        """Deletes an uploaded input; jobs that were created with it keep it."""
        name = tracks.name if isinstance(tracks, InputInfo) else tracks
        self._run(flows.delete_input(self._context, name, timeout))

    def job(self, name: str, tracks: Tracks | Matches | None = None) -> Job:
        """A job that is known by its name; no call is made.

        Args:
            name: `tenants/{tenant}/jobs/{job}`, or the last part of it.
            tracks: Its input, which results need for exports.

        """
        return Job(self, flows.job_name(self._context, name), None, tracks)

    def retry(self, job: Job | str, *, timeout: float | None = None) -> Job:
        """Queues a job again, or the one of this name; see `Job.retry`."""
        job = self.job(job) if isinstance(job, str) else job
        job.retry(timeout=timeout)
        return job

    def set_priority(self, job: Job | str, priority: int, *, timeout: float | None = None) -> Job:
        """Changes the priority of a job, or of the one of this name; see `Job.set_priority`."""
        job = self.job(job) if isinstance(job, str) else job
        job.set_priority(priority, timeout=timeout)
        return job

    def jobs(
        self, filter: str = "", *, order_by: str = "", page_size: int = 0, timeout: float | None = None
    ) -> Iterator[Job]:
        """The tenant's jobs, the newest first; pages are read as they are needed.

        Args:
            filter: Such as `state = QUEUED OR state = RUNNING AND labels.site = "north 3"`.
            order_by: `create_time` or `create_time desc`.
            page_size: Jobs that are read at a time. 0: the server's choice.
            timeout: Seconds for all of it.

        """
        for job in self._steps(flows.list_jobs(self._context, filter, order_by, page_size, timeout)):
            yield Job(self, job.name, JobInfo.of(job))


class Job:
    """A job of a server."""

    def __init__(self, client: Client, name: str, info: JobInfo | None, tracks: Tracks | Matches | None = None) -> None:
        self._client = client
        self.name = name
        """`tenants/{tenant}/jobs/{job}`."""
        self.known = info
        """The job as it was last told; `None`: it was not asked for yet."""
        self.tracks = tracks
        """Its input, where this program has it."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}{'' if self.known is None else f', {self.known.state}'})"

    def info(self, *, timeout: float | None = None) -> JobInfo:
        """Asks the server how the job stands."""
        request = job_service_pb2.GetJobRequest(name=self.name)
        return self._told(self._client._run(flows.call(self._client._context, "GetJob", request, timeout)))

    def state(self, *, timeout: float | None = None) -> JobState:
        """Asks the server where the job stands."""
        return self.info(timeout=timeout).state

    def events(self, after_sequence: int = 0, *, timeout: float | None = None) -> Iterator[Event]:
        """The job's events after a sequence number, then new ones as they happen, until its end.

        Over broken connections and restarts of the server no event is missed or repeated.
        """
        for event in self._client._steps(flows.watch(self._client._context, self.name, after_sequence, timeout)):
            yield Event.of(event)

    def progress(self, after_sequence: int = 0, *, timeout: float | None = None) -> Iterator[Progress]:
        """The job's progress until its end, however that is; `sequence` of each is where another call goes on."""
        for event in self.events(after_sequence, timeout=timeout):
            if event.progress is not None:
                yield event.progress

    def wait(self, *, timeout: float | None = None, progress: OnProgress = False) -> JobInfo:
        """Waits for the job's end, however that is.

        Args:
            timeout: Seconds to wait; the job goes on afterwards.
            progress: True shows a bar (needs tqdm); a function is called with each new `Progress`.

        """
        with Watcher(progress) as watcher:
            return self._told(self._client._run(flows.wait(self._client._context, self.name, timeout), watcher))

    def result(self, *, timeout: float | None = None, progress: OnProgress = False) -> Result:
        """Waits for the job's end and reads its result.

        Args:
            timeout: Seconds to wait; the job goes on afterwards.
            progress: True shows a bar (needs tqdm); a function is called with each new `Progress`.

        Raises:
            JobError: The job ended without a result.

        """
        with Watcher(progress) as watcher:
            message = self._client._run(flows.result(self._client._context, self.name, timeout), watcher)
        return flows.finished(message, self.tracks)

    def cancel(self, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Asks the job to stop. One that has ended is answered as it is.

        Args:
            etag: `JobInfo.etag`; a job that has changed since is not cancelled (`Aborted`).
            timeout: Seconds for the call, with its repetitions.

        """
        request = job_service_pb2.CancelJobRequest(name=self.name, etag=etag)
        return self._told(self._client._run(flows.call(self._client._context, "CancelJob", request, timeout)))

    def retry(self, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Queues the job again, which ended without a result. One that waits or runs is answered as it is.

        Args:
            etag: `JobInfo.etag`; a job that has changed since is not queued again (`Aborted`).
            timeout: Seconds for the call, with its repetitions.

        """
        request = job_service_pb2.RetryJobRequest(name=self.name, etag=etag)
        return self._told(self._client._run(flows.call(self._client._context, "RetryJob", request, timeout)))

    def set_priority(self, priority: int, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Changes the priority of the job, which must wait.

        Args:
            priority: Of the tenant's queued jobs, those of larger priority run first. -1000 to 1000.
            etag: `JobInfo.etag`; a job that has changed since is left as it is (`Aborted`).
            timeout: Seconds for the call, with its repetitions.

        """
        request = flows.priority_request(self.name, priority, etag)
        return self._told(self._client._run(flows.call(self._client._context, "SetJobPriority", request, timeout)))

    def delete(self, *, etag: str = "", timeout: float | None = None) -> None:
        """Removes the job, which must have ended, with its input, events and result."""
        self._client._run(flows.delete(self._client._context, self.name, etag, timeout))

    def _told(self, message: Any) -> JobInfo:
        self.known = JobInfo.of(message)
        return self.known
