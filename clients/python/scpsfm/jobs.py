"""What is said to and of a job: settings, state, progress, events."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._fields import plain
from ._result_parts import Grade, ResultStatus, grade_of
from ._stubs import job_pb2, progress_pb2, result_pb2, settings_pb2
from ._wire import Word, member, optional, seconds, word
from .errors import InvalidArgument, Violation

__all__ = [
    "Capabilities",
    "Event",
    "InputInfo",
    "JobInfo",
    "JobState",
    "JobSummary",
    "Progress",
    "Settings",
    "Webhook",
    "WebhookState",
]


class JobState(Word):
    """Where a job stands."""

    UNSPECIFIED = "UNSPECIFIED"
    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"
    DEADLINE_EXCEEDED = "DEADLINE_EXCEEDED"

    @property
    def is_final(self) -> bool:
        """Whether the job has ended."""
        return self not in (JobState.UNSPECIFIED, JobState.QUEUED, JobState.RUNNING)


class WebhookState(Word):
    """How far the delivery of a webhook has come."""

    UNSPECIFIED = "UNSPECIFIED"
    PENDING = "PENDING"
    DELIVERED = "DELIVERED"
    GIVEN_UP = "GIVEN_UP"


def state_of(number: int) -> JobState:
    """The state of this number."""
    state: JobState = member(JobState, job_pb2.JobState, number, "JOB_STATE_")
    return state


@dataclass(frozen=True)
class Settings:
    """How a job is solved. What is `None` is the server's default; `settings.proto` says what each means."""

    method: str | None = None
    """`auto`, `geometry`, `scpsfm`, `paper` or `psfm`."""

    use_daq: bool | None = None
    alpha: float | None = None
    beta: float | None = None
    min_inliers: float | None = None
    kappa: float | None = None
    learning_rate: float | None = None
    iterations: int | None = None
    network_width: float | None = None

    seed: int | None = None
    """Of every random choice: the same build, processor, backend, input and seed give the same answer."""

    noise_px: float | None = None
    """What the observation noise is believed to be: one standard deviation of a coordinate, in pixels."""

    weights_every: int | None = None
    """Interim weights every so many iterations of the paper's network."""

    backend: str | None = None
    """`flex` or `ndarray`."""

    focal_per_view: bool | None = None
    """Whether every view has a focal length of its own (a zoom)."""

    epipolar_depths: bool | None = None

    def to_proto(self) -> settings_pb2.SolveSettings:
        """The message of the API.

        Raises:
            InvalidArgument: A value of the wrong kind.

        """
        message = settings_pb2.SolveSettings()
        for field in fields(self):
            value = plain(getattr(self, field.name))
            if value is None:
                continue
            if field.name in ("method", "backend"):
                enum = {"method": settings_pb2.Method, "backend": settings_pb2.Backend}[field.name]
                value = _number(enum, field.name, value)
            try:
                setattr(message, field.name, value)
            except (TypeError, ValueError, OverflowError) as error:
                raise _wrong(field.name, str(error)) from None
        return message


def _number(enum: Any, field: str, value: str) -> int:
    prefix = f"{field.upper()}_"
    names = [name.removeprefix(prefix) for name in enum.keys() if not name.endswith("_UNSPECIFIED")]  # noqa: SIM118
    wanted = str(value).upper().removeprefix(prefix)
    if wanted not in names:
        raise _wrong(field, f"{value!r} is none of {', '.join(name.lower() for name in names)}")
    return int(enum.Value(prefix + wanted))


def _wrong(field: str, what: str) -> InvalidArgument:
    path = f"settings.{field}"
    return InvalidArgument(f"{path}: {what}", reason="INVALID_ARGUMENT", violations=[Violation(path, what)])


@dataclass(frozen=True)
class Progress:
    """The state of a running job."""

    stage: str
    """`PREPARE`, `SEARCH`, `REFINE`, `CALIBRATE`, `EXTEND` or `CLASSIFY`."""

    fraction: float
    """Share of the work done, 0 to 1, never decreasing within an attempt."""

    iteration_count: int
    """Iterations of the paper's network done so far."""

    inlier_track_count: int
    """Inlier tracks of the best hypothesis so far. The result's verdicts come later: they may be more or fewer."""

    focal_px: float | None
    """Current estimate of the focal length in pixels."""

    best_cost: float | None
    """Cost of the best hypothesis so far: 0 is a perfect consensus of all tracks, 1 is none."""

    elapsed_seconds: float
    """Since the attempt began."""

    registered_view_count: int
    """Views that have a camera now."""

    view_count: int
    """Views in which anything is observed; 0: not known yet."""

    attempt: int
    sequence: int
    """Sequence number of the event: `job.progress(after_sequence=...)` goes on after it."""

    message: progress_pb2.Progress
    """All that the server said."""

    @classmethod
    def of(cls, message: progress_pb2.Progress, attempt: int = 0, sequence: int = 0) -> Progress:
        """From the message of the API."""
        return cls(
            stage=word(progress_pb2.Stage, message.stage, "STAGE_"),
            fraction=message.fraction,
            iteration_count=message.iteration_count,
            inlier_track_count=message.inlier_track_count,
            focal_px=optional(message, "focal_px"),
            best_cost=optional(message, "best_cost"),
            elapsed_seconds=seconds(message.elapsed_duration),
            registered_view_count=message.reconstruction.registered_view_count,
            view_count=message.reconstruction.view_count,
            attempt=attempt,
            sequence=sequence,
            message=message,
        )


@dataclass(frozen=True)
class JobSummary:
    """What a job found, without its arrays."""

    status: ResultStatus
    grade: Grade
    focal_px: float | None
    sigma_log_focal: float | None
    inlier_track_count: int
    registered_view_count: int
    reprojection_rms_px: float | None
    solve_seconds: float
    result_size_bytes: int
    warnings: tuple[tuple[str, str], ...]
    """Code and detail of the first warnings."""

    @classmethod
    def of(cls, message: job_pb2.JobSummary) -> JobSummary:
        """From the message of the API."""
        return cls(
            status=member(ResultStatus, result_pb2.ResultStatus, message.status, "RESULT_STATUS_"),
            grade=grade_of(message.grade),
            focal_px=optional(message, "focal_px"),
            sigma_log_focal=optional(message, "sigma_log_focal"),
            inlier_track_count=message.inlier_track_count,
            registered_view_count=message.registered_view_count,
            reprojection_rms_px=optional(message, "reprojection_rms_px"),
            solve_seconds=seconds(message.solve_duration),
            result_size_bytes=message.result_size_bytes,
            warnings=tuple(
                (word(result_pb2.WarningCode, found.code, "WARNING_CODE_"), found.detail) for found in message.warnings
            ),
        )


@dataclass(frozen=True, eq=False)
class Event:
    """Something that happened to a job. One of `state`, `progress`, `weights` and `summary` is set."""

    job: str
    """Name of the job."""

    sequence: int
    """Strictly increasing within a job, from 1; 0: interim weights, which are not replayed."""

    attempt: int
    time: datetime
    state: JobState | None = None
    """The job entered this state."""

    progress: Progress | None = None
    weights: NDArray[np.float32] | None = None
    """What the network thinks of each track so far. (tracks,)."""

    summary: JobSummary | None = None
    """The result stands; the final state follows."""

    error_reason: str = ""
    """Why the job failed, for programs."""

    error_message: str = ""
    """Why the job failed, in words."""

    @classmethod
    def of(cls, message: job_pb2.JobEvent) -> Event:
        """From the message of the API."""
        body = message.WhichOneof("body")
        change = message.state_change
        return cls(
            job=message.job,
            sequence=message.sequence,
            attempt=message.attempt,
            time=_time(message.time),
            state=state_of(change.state) if body == "state_change" else None,
            progress=Progress.of(message.progress, message.attempt, message.sequence) if body == "progress" else None,
            weights=np.array(message.weights.weights, dtype=np.float32) if body == "weights" else None,
            summary=JobSummary.of(message.summary) if body == "summary" else None,
            error_reason=change.error.reason if body == "state_change" else "",
            error_message=change.error.message if body == "state_change" else "",
        )


def _time(message: Any) -> datetime:
    # To the microsecond, without the rounding of a float.
    return datetime.fromtimestamp(message.seconds, tz=timezone.utc).replace(microsecond=message.nanos // 1000)


@dataclass(frozen=True)
class Webhook:
    """Where the end of a job is sent, and how far that has come."""

    url: str
    state: WebhookState
    attempt_count: int
    """Attempts begun so far."""

    last_error: str
    """Why the latest attempt that ended failed; empty: it did not."""

    @classmethod
    def of(cls, message: job_pb2.Webhook) -> Webhook:
        """From the message of the API."""
        return cls(
            url=message.url,
            state=member(WebhookState, job_pb2.WebhookState, message.state, "WEBHOOK_STATE_"),
            attempt_count=message.attempt_count,
            last_error=message.last_error,
        )


@dataclass(frozen=True)
class JobInfo:
    """A job as it stood when it was asked for."""

    name: str
    """`tenants/{tenant}/jobs/{job}`."""

    state: JobState
    labels: dict[str, str]
    priority: int
    attempt_count: int
    view_count: int
    track_count: int
    observation_count: int
    create_time: datetime
    end_time: datetime | None
    deadline_time: datetime | None
    expire_time: datetime | None
    progress: Progress | None
    summary: JobSummary | None
    error_reason: str
    """Why it failed, for programs; empty: it has not."""

    error_message: str
    cancel_requested: bool
    last_sequence: int
    etag: str
    input: str
    """The uploaded input that it was created with; empty: the input came with the job."""

    webhook: Webhook | None
    message: job_pb2.Job
    """All that the server said."""

    @classmethod
    def of(cls, message: job_pb2.Job) -> JobInfo:
        """From the message of the API."""

        def time(field: str) -> datetime | None:
            return _time(getattr(message, field)) if message.HasField(field) else None

        return cls(
            name=message.name,
            state=state_of(message.state),
            labels=dict(message.labels),
            priority=message.priority,
            attempt_count=message.attempt_count,
            view_count=message.view_count,
            track_count=message.track_count,
            observation_count=message.observation_count,
            create_time=_time(message.create_time),
            end_time=time("end_time"),
            deadline_time=time("deadline_time"),
            expire_time=time("expire_time"),
            progress=Progress.of(message.progress, message.attempt_count) if message.HasField("progress") else None,
            summary=JobSummary.of(message.summary) if message.HasField("summary") else None,
            error_reason=message.error.reason,
            error_message=message.error.message,
            cancel_requested=message.cancel_requested,
            last_sequence=message.last_sequence,
            etag=message.etag,
            input=message.input,
            webhook=Webhook.of(message.webhook) if message.HasField("webhook") else None,
            message=message,
        )


@dataclass(frozen=True)
class InputInfo:
    """An uploaded input."""

    name: str
    """`tenants/{tenant}/inputs/{input}`: what `submit` takes instead of tracks."""

    size_bytes: int
    sha256: bytes
    view_count: int
    track_count: int
    observation_count: int
    create_time: datetime

    @classmethod
    def of(cls, message: Any) -> InputInfo:
        """From the message of the API."""
        return cls(
            name=message.name,
            size_bytes=message.size_bytes,
            sha256=message.sha256,
            view_count=message.view_count,
            track_count=message.track_count,
            observation_count=message.observation_count,
            create_time=_time(message.create_time),
        )


@dataclass(frozen=True)
class Capabilities:
    """What a server can do."""

    server_version: str
    max_views: int
    max_tracks: int
    max_observations: int
    max_message_bytes: int
    max_upload_bytes: int
    max_chunk_bytes: int
    max_batch_requests: int
    methods: tuple[str, ...]
    backends: tuple[str, ...]
    message: Any
    """All that the server said."""

    @classmethod
    def of(cls, message: Any) -> Capabilities:
        """From the message of the API."""
        limits = message.input_limits
        return cls(
            server_version=message.server_version,
            max_views=limits.max_views,
            max_tracks=limits.max_tracks,
            max_observations=limits.max_observations,
            max_message_bytes=limits.max_message_bytes,
            max_upload_bytes=message.upload_limits.max_upload_bytes,
            max_chunk_bytes=message.upload_limits.max_chunk_bytes,
            max_batch_requests=message.max_batch_requests,
            methods=tuple(word(settings_pb2.Method, method, "METHOD_") for method in message.methods),
            backends=tuple(word(settings_pb2.Backend, backend, "BACKEND_") for backend in message.backends),
            message=message,
        )
