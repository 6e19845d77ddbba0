"""What can go wrong, as exceptions.

Every exception of this package is a `ScpsfmError`. What the server says for programs is in `reason`, `field`,
`violations`, `metadata` and `retry_after`; they come from the google.rpc details of a status.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

__all__ = [
    "Aborted",
    "AlreadyExists",
    "DataLoss",
    "DeadlineExceeded",
    "FailedPrecondition",
    "InternalError",
    "InvalidArgument",
    "JobCancelled",
    "JobDeadlineExceeded",
    "JobError",
    "JobFailed",
    "MemoryFull",
    "MessageTooLarge",
    "NotFound",
    "PermissionDenied",
    "QueueFull",
    "RateLimited",
    "ResourceExhausted",
    "ScpsfmError",
    "StoreFull",
    "Unauthenticated",
    "Unavailable",
    "Unimplemented",
    "UploadsFull",
    "Violation",
]


@dataclass(frozen=True)
class Violation:
    """A field that breaks a rule."""

    field: str
    """The field with its index, such as `track_set.xs[17]`."""

    description: str
    """What is wrong with it, in words."""


class ScpsfmError(Exception):
    """Base of every exception of this package."""

    reason: str
    """Upper-case and stable for programs, such as `QUEUE_FULL`; empty where the server gave none."""

    field: str | None
    """The first field that breaks a rule."""

    violations: tuple[Violation, ...]
    """All such fields that were told."""

    metadata: Mapping[str, str]
    """More for programs, such as `{"bound": "tenant_jobs"}`."""

    retry_after: float | None
    """Seconds after which the server asks to be asked again."""

    code: grpc.StatusCode | None
    """The gRPC status; absent where no call failed."""

    job: str | None
    """Name of the job that it is about."""

    request_id: str | None
    """Request id of a creation that came to nothing, or whose answer was lost: with it the call can be repeated."""

    def __init__(
        self,
        message: str,
        *,
        reason: str = "",
        violations: Sequence[Violation] = (),
        metadata: Mapping[str, str] | None = None,
        retry_after: float | None = None,
        code: grpc.StatusCode | None = None,
        job: str | None = None,
        request_id: str | None = None,
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.violations = tuple(violations)
        self.field = self.violations[0].field if self.violations else None
        self.metadata = dict(metadata or {})
        self.retry_after = retry_after
        self.code = code
        self.job = job
        self.request_id = request_id

    @property
    def message(self) -> str:
        """What went wrong, in words."""
        return str(self.args[0])

    def __str__(self) -> str:
        known = [self.reason] if self.reason else []
        if self.request_id is not None:
            known.append(f"request_id={self.request_id}")
        return f"{self.message} ({', '.join(known)})" if known else self.message


class InvalidArgument(ScpsfmError, ValueError):
    """The input or a setting breaks a rule: see `field`. Raised before anything is sent, or by the server."""

    file: str | None = None
    """The file that it stands in."""

    line: int | None = None
    """The line of that file, counted from 1."""


class NotFound(ScpsfmError, LookupError):
    """There is no such job, input, upload or tenant, or it is another tenant's."""


class AlreadyExists(ScpsfmError):
    """An id or a request id is taken by something else."""


class FailedPrecondition(ScpsfmError):
    """The job is not in the state that the call needs, such as a result that does not stand yet."""


class Aborted(ScpsfmError):
    """Something else changed meanwhile: an `etag` that is old, an upload that another stream took over."""


class ResourceExhausted(ScpsfmError):
    """The server has no room now: see `retry_after`."""


class QueueFull(ResourceExhausted):
    """Too many jobs wait; `metadata["bound"]` says of what."""


class MemoryFull(ResourceExhausted):
    """The calls under way hold as many bytes as they may together."""


class RateLimited(ResourceExhausted):
    """The key calls, or the tenant creates jobs, more often than it may; after `retry_after` the call would pass."""


class StoreFull(ResourceExhausted):
    """The server's disk is full. Nothing was stored."""


class UploadsFull(ResourceExhausted):
    """The tenant has as many uploads, or bytes of them, as it may."""


class MessageTooLarge(ScpsfmError):
    """A message above the server's limit."""


class Unauthenticated(ScpsfmError):
    """The server asks for an API key, or does not know this one."""


class PermissionDenied(ScpsfmError):
    """The caller may not do this."""


class DeadlineExceeded(ScpsfmError, TimeoutError):
    """The `timeout` of a call passed, or the server waited too long for its messages."""


class Unavailable(ScpsfmError, ConnectionError):
    """No server answered for as long as the retry policy waits.

    A creation may have been carried out all the same, its answer lost: repeat it with the same `request_id`.
    """


class DataLoss(ScpsfmError):
    """Bytes changed on their way."""


class Unimplemented(ScpsfmError):
    """The server does not know the call: it is older than this client, or another kind of server."""


class InternalError(ScpsfmError):
    """A defect of the server or of this client."""


class JobError(ScpsfmError):
    """A job that ended without a result."""


class JobFailed(JobError):
    """The server failed at the job; `reason` says how."""


class JobCancelled(JobError):
    """The job was cancelled."""


class JobDeadlineExceeded(JobError, TimeoutError):
    """The job's own deadline passed before a result stood."""


_BY_REASON: dict[str, type[ScpsfmError]] = {
    "QUEUE_FULL": QueueFull,
    "MEMORY": MemoryFull,
    "RATE_LIMITED": RateLimited,
    "STORE_FULL": StoreFull,
    "UPLOADS_FULL": UploadsFull,
}

_BY_CODE: dict[grpc.StatusCode, type[ScpsfmError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidArgument,
    grpc.StatusCode.NOT_FOUND: NotFound,
    grpc.StatusCode.ALREADY_EXISTS: AlreadyExists,
    grpc.StatusCode.FAILED_PRECONDITION: FailedPrecondition,
    grpc.StatusCode.ABORTED: Aborted,
    grpc.StatusCode.RESOURCE_EXHAUSTED: ResourceExhausted,
    grpc.StatusCode.OUT_OF_RANGE: MessageTooLarge,
    grpc.StatusCode.UNAUTHENTICATED: Unauthenticated,
    grpc.StatusCode.PERMISSION_DENIED: PermissionDenied,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceeded,
    grpc.StatusCode.UNAVAILABLE: Unavailable,
    grpc.StatusCode.DATA_LOSS: DataLoss,
    grpc.StatusCode.UNIMPLEMENTED: Unimplemented,
}

_NOT_TRUSTED = ("CERTIFICATE_VERIFY_FAILED", "WRONG_VERSION_NUMBER", "Hostname Verification", "not in peer certificate")
"""What gRPC says of a handshake that no other try makes better."""

_OF_THIS_CLIENT = ("Locally cancelled", "Channel closed", "serializing", "Exception iterating requests")
"""What gRPC says where this client gave up, or could not write or read a message."""

_DETAILS_KEY = "grpc-status-details-bin"


def from_rpc(error: Any) -> ScpsfmError:
    """The exception that a failed call means.

    Args:
        error: A `grpc.RpcError` with code, details and trailing metadata, of the sync or the async API.

    """
    code: grpc.StatusCode = error.code()
    message = error.details() or code.name
    details = _details(error.trailing_metadata())
    info = error_details_pb2.ErrorInfo()
    bad = error_details_pb2.BadRequest()
    retry = error_details_pb2.RetryInfo()
    retry_after = None
    for detail in details:
        if detail.Is(info.DESCRIPTOR):
            detail.Unpack(info)
        elif detail.Is(bad.DESCRIPTOR):
            detail.Unpack(bad)
        elif detail.Is(retry.DESCRIPTOR):
            detail.Unpack(retry)
            if retry.HasField("retry_delay"):
                retry_after = max(0.0, retry.retry_delay.seconds + retry.retry_delay.nanos * 1e-9)
    kind = _BY_REASON.get(info.reason) or _BY_CODE.get(code, InternalError)
    if kind is InternalError:
        message = f"{message} [{code.name}]"
    return kind(
        message,
        reason=info.reason,
        violations=[Violation(found.field, found.description) for found in bad.field_violations],
        metadata=dict(info.metadata),
        retry_after=retry_after,
        code=code,
    )


def _details(trailing: Any) -> list[Any]:
    """The google.rpc details of trailing metadata; none where there are none that can be read."""
    for key, value in trailing or ():
        if key == _DETAILS_KEY:
            try:
                return list(status_pb2.Status.FromString(value).details)
            except DecodeError:
                return []
    return []


def is_transient(error: ScpsfmError) -> bool:
    """Whether the same call may fare better soon.

    So it is where the connection broke, the server goes down, or it says itself when to come back.
    """
    if error.code is grpc.StatusCode.UNAVAILABLE:
        # A certificate that is not trusted stays so, and so does a port without TLS.
        return not any(words in error.message for words in _NOT_TRUSTED)
    if error.reason:
        return error.retry_after is not None and error.code is grpc.StatusCode.RESOURCE_EXHAUSTED
    # A balancer that cuts an answer short, a stream that was reset: our server gives a reason with everything it says.
    return error.code in (grpc.StatusCode.UNKNOWN, grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED) and (
        not any(words in error.message for words in _OF_THIS_CLIENT)
    )
