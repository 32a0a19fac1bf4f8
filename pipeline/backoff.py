"""Pauses between attempts: when something that failed is tried again. No clock and no sleep: times are arguments."""

from __future__ import annotations

import dataclasses
import datetime as dt
import math


@dataclasses.dataclass(frozen=True, kw_only=True)
class Backoff:
    """Pauses that grow from attempt to attempt, and when there is no further attempt."""

    first_s: float
    """Seconds after the first failure."""
    longest_s: float = math.inf
    """Longest pause in seconds."""
    factor: float = 2.0
    """Each pause is so many times the one before."""
    jitter: tuple[float, float] = (1.0, 1.0)
    """Range of the random factor of a pause, so that those that failed together do not return together."""
    attempts: int | None = None
    """Largest number of attempts; None if only the time limits them."""
    limit_s: float = math.inf
    """Seconds after the first attempt when no other begins."""

    def bound_s(self, failures: int) -> float:
        """Seconds after a number of failures in a row, before the random factor.

        >>> [Backoff(first_s=0.5, longest_s=4.0).bound_s(failures) for failures in (1, 2, 3, 4, 5, 2000)]
        [0.5, 1.0, 2.0, 4.0, 4.0, 4.0]
        """
        return min(self.longest_s, self.first_s * self.factor ** min(failures - 1, 50))

    def pause_s(
        self, failures: int, *, elapsed_s: float = 0.0, draw: float = 0.5, wanted_s: float = 0.0
    ) -> float | None:
        """Seconds until the next attempt; None if there is none.

        Parameters
        ----------
        failures : int
            Failures in a row, from 1.
        elapsed_s : float
            Seconds since the first attempt.
        draw : float
            A random number from 0 to 1.
        wanted_s : float
            The pause that the other side asks for. If it ends after the limit, there is no further attempt.

        Examples
        --------
        >>> backoff = Backoff(first_s=1.0, longest_s=30.0, jitter=(0.5, 1.0), attempts=4, limit_s=60.0)
        >>> [backoff.pause_s(failures, draw=1.0) for failures in (1, 2, 3, 4)]
        [1.0, 2.0, 4.0, None]
        >>> backoff.pause_s(2, draw=0.0), backoff.pause_s(2, wanted_s=7.0), backoff.pause_s(2, wanted_s=90.0)
        (1.0, 7.0, None)
        >>> backoff.pause_s(3, elapsed_s=59.5), backoff.pause_s(3, elapsed_s=60.0)
        (0.5, None)
        """
        left_s = self.limit_s - elapsed_s
        is_last = self.attempts is not None and failures >= self.attempts
        if is_last or left_s <= 0.0 or wanted_s > left_s:
            return None
        low, high = self.jitter
        own_s = self.bound_s(failures) * (low + (high - low) * draw)
        return max(wanted_s, min(own_s, left_s))


class Pauses:
    """The pauses of one loop: they grow while it fails, and begin anew after a success.

    >>> pauses = Pauses(Backoff(first_s=0.5, longest_s=4.0))
    >>> pauses.next_s(), pauses.next_s()
    (0.5, 1.0)
    >>> pauses.begin_anew()
    >>> pauses.next_s()
    0.5
    """

    def __init__(self, backoff: Backoff) -> None:
        self._backoff = backoff
        self._failures = 0

    def next_s(self) -> float:
        """Seconds to wait after a further failure."""
        self._failures += 1
        return self._backoff.bound_s(self._failures)

    def begin_anew(self) -> None:
        """Count failures from 0 again: it succeeded."""
        self._failures = 0


def wanted_pause_s(retry_after: str | None, now: dt.datetime | None = None) -> float:
    """The pause in seconds that a header Retry-After wants; 0 without one, or if it cannot be read.

    A date is read only with the present.

    >>> wanted_pause_s("120"), wanted_pause_s(None), wanted_pause_s("Sun, 01 Mar 2026 00:00:30 GMT")
    (120.0, 0.0, 0.0)
    >>> wanted_pause_s("Sun, 01 Mar 2026 00:00:30 GMT", dt.datetime(2026, 3, 1, tzinfo=dt.UTC))
    30.0
    """
    text = (retry_after or "").strip()
    if text.isascii() and text.isdigit():
        return float(text)
    if now is None:
        return 0.0
    from email.utils import parsedate_to_datetime

    try:
        at = parsedate_to_datetime(text)
    except ValueError:
        return 0.0
    return max(0.0, ((at if at.tzinfo is not None else at.replace(tzinfo=dt.UTC)) - now).total_seconds())
