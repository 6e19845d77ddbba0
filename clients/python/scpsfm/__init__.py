"""Client of the scpsfm service, which calibrates the camera of uncalibrated image tracks.

import scpsfm

tracks = scpsfm.Tracks.from_csv("observations.csv", width=1000, height=1000)
with scpsfm.Client("127.0.0.1:50051") as client:
result = client.solve(tracks)
print(result.grade, result.focal_px, result.tracks.inlier.sum())
"""

from importlib.metadata import PackageNotFoundError, version

from . import errors
from ._aio import AsyncClient, AsyncJob
from ._client import Client, Job
from ._retry import RetryPolicy
from .errors import (
    Aborted,
    AlreadyExists,
    DataLoss,
    DeadlineExceeded,
    FailedPrecondition,
    InternalError,
    InvalidArgument,
    JobCancelled,
    JobDeadlineExceeded,
    JobError,
    JobFailed,
    MemoryFull,
    MessageTooLarge,
    NotFound,
    PermissionDenied,
    QueueFull,
    RateLimited,
    ResourceExhausted,
    ScpsfmError,
    StoreFull,
    Unauthenticated,
    Unavailable,
    Unimplemented,
    UploadsFull,
    Violation,
)
from .exports import to_colmap_database, to_nerfstudio, to_opensfm
from .jobs import (
    Capabilities,
    Event,
    InputInfo,
    JobInfo,
    JobState,
    JobSummary,
    Progress,
    Settings,
    Webhook,
    WebhookState,
)
from .matches import Matches
from .result import (
    Calibration,
    Camera,
    Grade,
    LeftOut,
    ObservationResults,
    Result,
    ResultStatus,
    ResultWarning,
    SecondStructure,
    Split,
    TrackResults,
    TwoViewTracks,
)
from .tracks import FocalPrior, Tracks, View

try:
    __version__ = version("scpsfm")
except PackageNotFoundError:
    # Run from a checkout that is not installed.
    __version__ = "0"

__all__ = [
    "Aborted",
    "AlreadyExists",
    "AsyncClient",
    "AsyncJob",
    "Calibration",
    "Camera",
    "Capabilities",
    "Client",
    "DataLoss",
    "DeadlineExceeded",
    "Event",
    "FailedPrecondition",
    "FocalPrior",
    "Grade",
    "InputInfo",
    "InternalError",
    "InvalidArgument",
    "Job",
    "JobCancelled",
    "JobDeadlineExceeded",
    "JobError",
    "JobFailed",
    "JobInfo",
    "JobState",
    "JobSummary",
    "LeftOut",
    "Matches",
    "MemoryFull",
    "MessageTooLarge",
    "NotFound",
    "ObservationResults",
    "PermissionDenied",
    "Progress",
    "QueueFull",
    "RateLimited",
    "ResourceExhausted",
    "Result",
    "ResultStatus",
    "ResultWarning",
    "RetryPolicy",
    "ScpsfmError",
    "SecondStructure",
    "Settings",
    "Split",
    "StoreFull",
    "TrackResults",
    "Tracks",
    "TwoViewTracks",
    "Unauthenticated",
    "Unavailable",
    "Unimplemented",
    "UploadsFull",
    "View",
    "Violation",
    "Webhook",
    "WebhookState",
    "__version__",
    "errors",
    "to_colmap_database",
    "to_nerfstudio",
    "to_opensfm",
]
