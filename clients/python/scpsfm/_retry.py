"""One policy of retries for every call: when to try again, how long to wait, when to give up."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass

from .errors import ScpsfmError, is_transient

__all__ = ["Backoff", "RetryPolicy"]

_LAST_TRY_S = 1.0
"""What is left of the time for the last try, so that it is not over before it begins."""


@dataclass(frozen=True)
class RetryPolicy:
    """How calls are repeated that broke off, or that the server asks to repeat later.

    Pauses double from `first_pause_s` to `longest_pause_s`, each made longer or shorter by `jitter`. Where the server
    says when to come back (google.rpc.RetryInfo), no pause is shorter than that. Trouble that lasts longer than
    `patience_s` without any progress is raised, and at once where the server asks for a longer pause than is left.
    """

    patience_s: float = 35.0
    """Seconds that a trouble is waited for, tries and pauses together. 0: nothing is repeated."""

    first_pause_s: float = 0.1
    longest_pause_s: float = 5.0

    jitter: float = 0.2
    """Largest change of a pause as a share of it, at random, so that many clients do not come back at once."""

    def __post_init__(self) -> None:
        if not (self.patience_s >= 0.0 and self.longest_pause_s >= self.first_pause_s > 0.0 and 0.0 <= self.jitter < 1):
            raise ValueError(
                "RetryPolicy: patience_s >= 0, longest_pause_s >= first_pause_s > 0 and 0 <= jitter < 1 are needed, "
                f"not {self!r}"
            )


class Backoff:
    """Counts tries that came to nothing, and the time since the first of them."""

    def __init__(
        self,
        policy: RetryPolicy,
        clock: Callable[[], float] = time.monotonic,
        uniform: Callable[[float, float], float] = random.uniform,
    ) -> None:
        self._policy = policy
        self._clock = clock
        self._uniform = uniform
        self._tries = 0
        self._end: float | None = None
        self._last: ScpsfmError | None = None
        self._accepted: float | None = None

    def reset(self) -> None:
        """Something arrived: the next trouble is a new one."""
        self._tries = 0
        self._end = None
        self._last = None
        self._accepted = None

    def accepted(self) -> None:
        """A stream was opened; how long it lives tells whether the trouble is over."""
        self._accepted = self._clock()

    def left(self) -> float | None:
        """Seconds that the trouble is still waited for; `None` where there is none."""
        return None if self._end is None else max(0.0, self._end - self._clock())

    def last(self) -> ScpsfmError | None:
        """What the latest try of the trouble came to."""
        return self._last

    def failed(self, error: ScpsfmError) -> float:
        """Notes what a try came to.

        Returns:
            Seconds to wait before the next one.

        Raises:
            ScpsfmError: `error`, where another try is of no use or the trouble has lasted too long.

        """
        if not is_transient(error):
            raise error
        now = self._clock()
        lived = 0.0 if self._accepted is None else now - self._accepted
        self._accepted = None
        if lived >= self._policy.longest_pause_s:
            # The stream worked, though nothing came: a job that waits has no events.
            self.reset()
        elif self._end is not None:
            self._end += lived
        if self._end is None:
            self._end = now + self._policy.patience_s
        self._last = error
        # The exponent is bounded: a long patience makes for many tries.
        pause = min(self._policy.longest_pause_s, self._policy.first_pause_s * 2.0 ** min(self._tries, 40))
        pause *= 1.0 + self._uniform(-self._policy.jitter, self._policy.jitter)
        if error.retry_after is not None:
            # Never earlier than the server asked for; later by as much as the jitter, so that not all come at once.
            pause = max(pause, error.retry_after * (1.0 + self._uniform(0.0, self._policy.jitter)))
        elif now + pause > self._end - _LAST_TRY_S:
            # The last pause is cut short, not left out: what was said to be the wait is the wait.
            pause = self._end - _LAST_TRY_S - now
        if pause <= 0.0 or now + pause > self._end:
            raise error
        self._tries += 1
        return pause
