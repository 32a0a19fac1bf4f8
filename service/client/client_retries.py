"""When a request is sent again, and when the client gives up. No clock: times are arguments."""

from __future__ import annotations

import dataclasses
import math

from pipeline.backoff import Backoff

BACKOFF = Backoff(first_s=0.5, longest_s=15.0)
"""Pauses that the client chooses by itself."""
FIRST_CONTACT_S = 5.0
"""Timeout in seconds for a service that has never answered: its URL is probably wrong."""
PATIENCE_S = 300.0
"""Default timeout in seconds of a call: enough for the restart of a service."""

PASSING = frozenset({408, 425, 429, 502, 503, 504})
"""Status codes after which another attempt may help."""


def is_passing(status: int, retry_after: str | None) -> bool:
    """Whether another attempt may help: by the status, or because the service says when.

    >>> is_passing(503, None), is_passing(507, None), is_passing(507, "60"), is_passing(404, None)
    (True, False, True, False)
    """
    return status in PASSING or (status >= 400 and retry_after is not None)


class Attempts:
    """The failures of one call without progress between them.

    Parameters
    ----------
    limit_s : float
        Seconds without progress after which the call ends.

    >>> attempts = Attempts(2.0)
    >>> [attempts.pause_s(at_s) for at_s in (10.0, 10.5, 11.5, 12.0)]
    [0.5, 1.0, 0.5, None]
    >>> attempts.progressed()
    >>> attempts.pause_s(50.0), attempts.pause_s(50.5, wanted_s=60.0)
    (0.5, None)
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._since_s: float | None = None
        self._failures = 0

    def progressed(self) -> None:
        """Begin anew: something has arrived."""
        self._since_s, self._failures = None, 0

    def pause_s(self, now_s: float, *, wanted_s: float = 0.0, limit_s: float = math.inf) -> float | None:
        """Seconds until the next attempt, after one that has failed; None if there is none.

        Parameters
        ----------
        now_s : float
            A monotonic time.
        wanted_s : float
            The pause that the service wants.
        limit_s : float
            A lower limit for this failure.
        """
        if self._since_s is None:
            self._since_s = now_s
        self._failures += 1
        backoff = dataclasses.replace(BACKOFF, limit_s=min(self.limit_s, limit_s))
        return backoff.pause_s(self._failures, elapsed_s=now_s - self._since_s, wanted_s=wanted_s)
