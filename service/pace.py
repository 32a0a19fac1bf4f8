"""Whether bytes come fast enough. No clock: times are arguments."""

from __future__ import annotations

from service.settings import ServiceSettings

MOST_LOOKS = 20
"""Looks at a wait within its shortest limit: it ends at most a twentieth later."""


class Pace:
    """The pace of a transfer. It is divided into shares, and each must arrive within the same time.

    A share is what arrives in that time at the lowest rate that is allowed. The next share begins when one is complete,
    so a transfer that is fast enough may pause.

    Parameters
    ----------
    bytes_per_s : float
        The lowest rate in bytes per second.
    within_s : float
        Seconds for one share.
    now_s : float
        The time at which the first share begins, seconds.

    >>> pace = Pace(1000.0, 60.0, now_s=0.0)
    >>> pace.took(59_999, now_s=59.0), pace.is_slow(60.0), pace.is_slow(60.1)
    (False, False, True)
    >>> pace.took(1, now_s=60.0), pace.is_slow(119.0), pace.total_bytes
    (True, False, 60000)
    """

    def __init__(self, bytes_per_s: float, within_s: float, now_s: float) -> None:
        self._share = bytes_per_s * within_s
        self._within_s = within_s
        self._begun_s = now_s
        self._have = 0
        self.total_bytes = 0
        """All bytes so far."""

    @classmethod
    def of(cls, settings: ServiceSettings, now_s: float) -> Pace:
        """The pace that the settings ask for."""
        return cls(settings.min_bytes_per_s, settings.slow_s, now_s)

    def took(self, count: int, now_s: float) -> bool:
        """Add bytes that have arrived; whether they complete a share."""
        self.total_bytes += count
        self._have += count
        if self._have < self._share:
            return False
        self._begun_s, self._have = now_s, 0
        return True

    def rest(self, seconds: float) -> None:
        """Leave out a time in which nothing is expected."""
        self._begun_s += seconds

    def is_slow(self, now_s: float) -> bool:
        """Whether the time for the present share is over."""
        return now_s - self._begun_s > self._within_s


def look_s(*limits_s: float) -> float:
    """Seconds between looks at a wait with these limits.

    >>> look_s(60.0, 3600.0), look_s(0.2)
    (3.0, 0.01)
    """
    return min(limits_s) / MOST_LOOKS
