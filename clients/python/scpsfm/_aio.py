"""The client for asyncio. Its names are those of `Client`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from os import PathLike
from types import TracebackType
from typing import Any, TypeVar

import grpc
import grpc.aio

from . import _flows as flows
from ._access import Access
from ._bar import OnProgress, Watcher
from ._client import CANCEL_SECONDS, UPLOAD_ABOVE_BYTES
from ._flows import Call, Close, Context, Emit, Flow, JobOptions, Open, Read, Sleep, Stream
from ._retry import RetryPolicy
from ._stubs import calibration_service_pb2, job_service_pb2
from ._stubs_of import methods
from .errors import JobError, ScpsfmError, from_rpc
from .jobs import Capabilities, Event, InputInfo, JobInfo, JobState, Progress, Settings
from .matches import Matches
from .result import Result
from .tracks import Tracks

__all__ = ["AsyncClient", "AsyncJob"]

T = TypeVar("T")


class AsyncClient:
    """`Client` for asyncio: the same arguments and names; calls are awaited, iterators are iterated by `async for`.

    It belongs to the event loop of its first call. A task that is cancelled gives up its call, and a `solve` its job.
    Writing an input as a message takes the loop's own thread, about half a second for a million observations.
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
        """Prepares the connection, which the first call makes. The arguments are those of `Client`."""
        self.address = address
        self._access = Access.of(
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
        self._context = Context(self._access.parent, retry or RetryPolicy(), upload_above_bytes)
        self._channel: Any = None
        self._methods: dict[str, Any] = {}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.address!r})"

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connection; calls that are under way end."""
        if self._channel is not None:
            await self._channel.close()

    # What a flow asks for.

    def _method(self, name: str) -> Any:
        """What makes a call. The channel is made within the loop that it will run in."""
        if self._channel is None:
            credentials = self._access.credentials()
            if credentials is None:
                self._channel = grpc.aio.insecure_channel(self._access.target, self._access.options)
            else:
                self._channel = grpc.aio.secure_channel(self._access.target, credentials, self._access.options)
            self._methods = methods(self._channel)
        return self._methods[name]

    async def _do(self, op: flows.Op) -> Any:
        """Does what a flow asks for; errors of gRPC become those of this package."""
        if isinstance(op, Sleep):
            await asyncio.sleep(op.seconds)
            return None
        if isinstance(op, Close):
            op.stream.call.cancel()
            return None
        try:
            if isinstance(op, Call):
                return await self._method(op.method)(op.request, timeout=op.timeout, metadata=self._access.metadata)
            if isinstance(op, Open):
                call = self._method(op.method)(op.request, timeout=op.timeout, metadata=self._access.metadata)
                try:
                    await call.initial_metadata()
                except BaseException:
                    call.cancel()
                    raise
                return Stream(call, not call.done())
            if isinstance(op, Read):
                message = await op.stream.call.read()
                return None if message is grpc.aio.EOF else message
        except grpc.RpcError as error:
            raise from_rpc(error) from None
        raise AssertionError(op)

    async def _steps(self, flow: Flow[T], ends: list[T] | None = None) -> AsyncGenerator[Any, None]:
        """Runs a flow; yields what it emits. What it comes to is appended to `ends`."""
        answer: Any = None
        raised: ScpsfmError | None = None
        streams: list[Stream] = []
        try:
            while True:
                try:
                    op = flow.send(answer) if raised is None else flow.throw(raised)
                except StopIteration as stop:
                    if ends is not None:
                        ends.append(stop.value)
                    return
                answer = raised = None
                if isinstance(op, Emit):
                    yield op.value
                    continue
                try:
                    answer = await self._do(op)
                except ScpsfmError as error:
                    raised = error
                if isinstance(answer, Stream):
                    streams = [answer]
        finally:
            for stream in streams:
                stream.call.cancel()
            flow.close()

    async def _run(self, flow: Flow[T], on_emit: Callable[[Any], None] | None = None) -> T:
        """Runs a flow to its end and returns what it comes to."""
        ends: list[T] = []
        async with contextlib.aclosing(self._steps(flow, ends)) as steps:
            async for value in steps:
                if on_emit is not None:
                    on_emit(value)
        return ends[0]

    # Calls.

    async def capabilities(self, *, timeout: float | None = None) -> Capabilities:
        """What the server can do; see `Client.capabilities`."""
        request = calibration_service_pb2.GetCapabilitiesRequest()
        return Capabilities.of(await self._run(flows.call(self._context, "GetCapabilities", request, timeout)))

    async def solve(
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
        """Solves while the caller waits; see `Client.solve`. A task that is cancelled cancels the job."""
        options = JobOptions(settings, labels, priority, time_limit, None, request_id)
        source = tracks.name if isinstance(tracks, InputInfo) else tracks
        follower = flows.EventFollower()
        with Watcher(progress) as watcher:
            try:
                message = await self._run(flows.solve(self._context, source, options, follower, timeout), watcher)
            except JobError:
                raise
            except BaseException:
                if follower.name:
                    with contextlib.suppress(Exception):
                        cancel = self.job(follower.name).cancel(timeout=CANCEL_SECONDS)
                        await asyncio.shield(asyncio.ensure_future(cancel))
                raise
        return flows.finished(message, source)

    async def submit(
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
    ) -> AsyncJob:
        """Leaves a job with the server, which survives this program and the server; see `Client.submit`."""
        options = JobOptions(settings, labels, priority, time_limit, job_id, request_id, webhook)
        source = tracks.name if isinstance(tracks, InputInfo) else tracks
        emit = None if on_upload is None else lambda value: on_upload(*value)
        job = await self._run(flows.submit(self._context, source, options, timeout), emit)
        return AsyncJob(self, job.name, JobInfo.of(job), None if isinstance(source, str) else source)

    async def submit_batch(
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
    ) -> list[AsyncJob]:
        """Leaves a job of each input with the server, all or none; see `Client.submit_batch`."""
        options = JobOptions(settings, labels, priority, time_limit, None, request_id, webhook)
        sources = [tracks.name if isinstance(tracks, InputInfo) else tracks for tracks in inputs]
        jobs = await self._run(flows.submit_batch(self._context, sources, options, timeout))
        return [
            AsyncJob(self, job.name, JobInfo.of(job), None if isinstance(source, str) else source)
            for job, source in zip(jobs, sources, strict=True)
        ]

    async def upload(
        self,
        tracks: Tracks | Matches,
        *,
        timeout: float | None = None,
        on_upload: Callable[[int, int], None] | None = None,
    ) -> InputInfo:
        """Leaves an input with the server, for any number of jobs; see `Client.upload`."""
        emit = None if on_upload is None else lambda value: on_upload(*value)
        return InputInfo.of(await self._run(flows.upload(self._context, tracks, timeout), emit))

    def inputs(self, *, page_size: int = 0, timeout: float | None = None) -> AsyncIterator[InputInfo]:
        """The tenant's uploaded inputs, the newest first."""
        return self._steps(flows.list_inputs(self._context, page_size, timeout))

    async def delete_input(self, tracks: InputInfo | str, *, timeout: float | None = None) -> None:
        """Deletes an uploaded input; jobs that were created with it keep it."""
        name = tracks.name if isinstance(tracks, InputInfo) else tracks
        await self._run(flows.delete_input(self._context, name, timeout))

    def job(self, name: str, tracks: Tracks | Matches | None = None) -> AsyncJob:
        """A job that is known by its name; no call is made. See `Client.job`."""
        return AsyncJob(self, flows.job_name(self._context, name), None, tracks)

    async def retry(self, job: AsyncJob | str, *, timeout: float | None = None) -> AsyncJob:
        """Queues a job again, or the one of this name; see `AsyncJob.retry`."""
        job = self.job(job) if isinstance(job, str) else job
        await job.retry(timeout=timeout)
        return job

    async def set_priority(self, job: AsyncJob | str, priority: int, *, timeout: float | None = None) -> AsyncJob:
        """Changes the priority of a job, or of the one of this name; see `AsyncJob.set_priority`."""
        job = self.job(job) if isinstance(job, str) else job
        await job.set_priority(priority, timeout=timeout)
        return job

    async def jobs(
        self, filter: str = "", *, order_by: str = "", page_size: int = 0, timeout: float | None = None
    ) -> AsyncIterator[AsyncJob]:
        """The tenant's jobs, the newest first; see `Client.jobs`."""
        async for job in self._steps(flows.list_jobs(self._context, filter, order_by, page_size, timeout)):
            yield AsyncJob(self, job.name, JobInfo.of(job))


class AsyncJob:
    """A job of a server. Its names are those of `Job`."""

    def __init__(
        self, client: AsyncClient, name: str, info: JobInfo | None, tracks: Tracks | Matches | None = None
    ) -> None:
        self._client = client
        self.name = name
        """`tenants/{tenant}/jobs/{job}`."""
        self.known = info
        """The job as it was last told; `None`: it was not asked for yet."""
        self.tracks = tracks
        """Its input, where this program has it."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}{'' if self.known is None else f', {self.known.state}'})"

    async def info(self, *, timeout: float | None = None) -> JobInfo:
        """Asks the server how the job stands."""
        request = job_service_pb2.GetJobRequest(name=self.name)
        return self._told(await self._client._run(flows.call(self._client._context, "GetJob", request, timeout)))

    async def state(self, *, timeout: float | None = None) -> JobState:
        """Asks the server where the job stands."""
        return (await self.info(timeout=timeout)).state

    async def events(self, after_sequence: int = 0, *, timeout: float | None = None) -> AsyncIterator[Event]:
        """The job's events after a sequence number, then new ones as they happen, until its end; see `Job.events`."""
        flow = flows.watch(self._client._context, self.name, after_sequence, timeout)
        async for event in self._client._steps(flow):
            yield Event.of(event)

    async def progress(self, after_sequence: int = 0, *, timeout: float | None = None) -> AsyncIterator[Progress]:
        """The job's progress until its end; `sequence` of each is where another call goes on."""
        async for event in self.events(after_sequence, timeout=timeout):
            if event.progress is not None:
                yield event.progress

    async def wait(self, *, timeout: float | None = None, progress: OnProgress = False) -> JobInfo:
        """Waits for the job's end, however that is; see `Job.wait`."""
        with Watcher(progress) as watcher:
            return self._told(await self._client._run(flows.wait(self._client._context, self.name, timeout), watcher))

    async def result(self, *, timeout: float | None = None, progress: OnProgress = False) -> Result:
        """Waits for the job's end and reads its result; see `Job.result`."""
        with Watcher(progress) as watcher:
            message = await self._client._run(flows.result(self._client._context, self.name, timeout), watcher)
        return flows.finished(message, self.tracks)

    async def cancel(self, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Asks the job to stop; see `Job.cancel`."""
        request = job_service_pb2.CancelJobRequest(name=self.name, etag=etag)
        return self._told(await self._client._run(flows.call(self._client._context, "CancelJob", request, timeout)))

    async def retry(self, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Queues the job again, which ended without a result; see `Job.retry`."""
        request = job_service_pb2.RetryJobRequest(name=self.name, etag=etag)
        return self._told(await self._client._run(flows.call(self._client._context, "RetryJob", request, timeout)))

    async def set_priority(self, priority: int, *, etag: str = "", timeout: float | None = None) -> JobInfo:
        """Changes the priority of the job, which must wait; see `Job.set_priority`."""
        request = flows.priority_request(self.name, priority, etag)
        return self._told(
            await self._client._run(flows.call(self._client._context, "SetJobPriority", request, timeout))
        )

    async def delete(self, *, etag: str = "", timeout: float | None = None) -> None:
        """Removes the job, which must have ended, with its input, events and result."""
        await self._client._run(flows.delete(self._client._context, self.name, etag, timeout))

    def _told(self, message: Any) -> JobInfo:
        self.known = JobInfo.of(message)
        return self.known
