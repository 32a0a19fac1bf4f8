"""Times of a schedule that have passed since the last look."""

from __future__ import annotations

import dataclasses
import datetime as dt
import itertools
from collections.abc import Iterator

from pipeline.schedule.cron import Cron

MAX_COUNTED = 10_000
"""Most slots that are counted, a week of every minute; of more only the first and the last ones are found."""

_WINDOW = dt.timedelta(hours=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassedSlots:
    """Slots (times of a schedule) that have passed, in UTC."""

    latest: dt.datetime
    """The last of them."""
    earlier: int = 0
    """Number of slots before it."""
    first: dt.datetime | None = None
    """The first slot before it; None if there is none."""
    before_latest: dt.datetime | None = None
    """The last slot before it; None if there is none."""
    is_counted: bool = True
    """Whether `earlier` is exact; otherwise there are more."""


def passed_slots(cron: Cron, decided_until: dt.datetime, now: dt.datetime) -> PassedSlots | None:
    """The slots after one time and up to another.

    Parameters
    ----------
    decided_until : datetime
        All slots up to this time, inclusive, are decided. With a time zone.
    now : datetime
        The present; a slot at this very time has passed. With a time zone.

    Returns
    -------
    PassedSlots or None
        None if none has passed, also after the clock was put back.

    >>> hour, at = dt.timedelta(hours=1), dt.datetime(2026, 1, 1, 0, 30, tzinfo=dt.UTC)
    >>> found = passed_slots(Cron("@hourly", "UTC"), at, at + 3 * hour)
    >>> found.latest.hour, found.earlier, found.first.hour, found.before_latest.hour
    (3, 2, 1, 2)
    """
    found: list[dt.datetime] = []
    for at in _up_to(now, cron.times(decided_until)):
        found.append(at)
        if len(found) > MAX_COUNTED:
            return _ends_of_many(cron, found[0], now)
    if not found:
        return None
    if len(found) == 1:
        return PassedSlots(latest=found[0])
    return PassedSlots(latest=found[-1], earlier=len(found) - 1, first=found[0], before_latest=found[-2])


def _ends_of_many(cron: Cron, first: dt.datetime, now: dt.datetime) -> PassedSlots:
    """Find the last two from the end, in windows that grow."""
    back = _WINDOW
    while True:
        near = list(_up_to(now, cron.times(now.astimezone(dt.UTC) - back)))
        if len(near) >= 2:
            return PassedSlots(
                latest=near[-1], earlier=MAX_COUNTED, first=first, before_latest=near[-2], is_counted=False
            )
        back *= 4


def _up_to(now: dt.datetime, times: Iterator[dt.datetime]) -> Iterator[dt.datetime]:
    """Times up to now, compared in UTC: within one zone Python compares local times, which go back in autumn."""
    return itertools.takewhile(lambda at: at <= now.astimezone(dt.UTC), (at.astimezone(dt.UTC) for at in times))
