"""Progress for eyes."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any

from ._stubs import job_pb2
from .jobs import Progress

__all__ = ["Watcher"]

OnProgress = bool | Callable[[Progress], None]


class Watcher:
    """Hands a job's progress to a function, or shows it as a bar."""

    def __init__(self, progress: OnProgress) -> None:
        self._call = progress if callable(progress) else None
        self._bar: Any = None
        if progress is True:
            try:
                from tqdm.auto import tqdm
            except ImportError:
                raise ImportError("progress=True needs tqdm: pip install 'scpsfm[progress]'") from None
            self._bar = tqdm(
                total=100.0, desc="waiting", unit="%", bar_format="{desc}{percentage:3.0f}%|{bar}| {elapsed}{postfix}"
            )

    def __enter__(self) -> Watcher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, value: Any) -> None:
        """Takes what a flow emits; only progress of a job is looked at."""
        if not isinstance(value, job_pb2.JobEvent) or value.WhichOneof("body") != "progress":
            return
        progress = Progress.of(value.progress, value.attempt, value.sequence)
        if self._call is not None:
            self._call(progress)
        if self._bar is not None:
            self._bar.set_description(progress.stage.lower(), refresh=False)
            self._bar.set_postfix(inliers=progress.inlier_track_count, refresh=False)
            # A new attempt begins anew.
            self._bar.n = 100.0 * progress.fraction
            self._bar.refresh()
