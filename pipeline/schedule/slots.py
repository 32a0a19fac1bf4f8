"""Which times of a schedule have passed since it was last looked at."""

from __future__ import annotations

import dataclasses
import datetime as dt
import itertools
from collections.abc import Iterator

from pipeline.schedule.cron import Cron

MAX_COUNTED = 10_000
"""Slots that are counted one by one: a week of every minute. Of a longer stretch only its ends are known."""

_WINDOW = dt.timedelta(hours=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassedSlots:
    """Times that have passed, in UTC; a time that is due is called a slot."""

    latest: dt.datetime
    """The last of them."""
    earlier: int = 0
    """How many came before it."""
    first: dt.datetime | None = None
    """The first of those before it; None where there are none."""
    before_latest: dt.datetime | None = None
    """The last of those before it; None where there are none."""
    is_counted: bool = True
    """Whether all were counted; else there are more than `earlier`."""


def passed_slots(cron: Cron, decided_until: dt.datetime, now: dt.datetime) -> PassedSlots | None:
    """The slots after one time and up to another.

    Parameters
    ----------
    cron : Cron
        When the schedule is due.
    decided_until : datetime
        Up to which time every slot was decided, this one included. With a time zone.
    now : datetime
        The present; a slot at this very time has passed. With a time zone.

    Returns
    -------
    PassedSlots or None
        None where none has passed, also where the clock was put back.

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
    """The last two are found from the end, looking back farther and farther."""
    back = _WINDOW
    while True:
        near = list(_up_to(now, cron.times(now.astimezone(dt.UTC) - back)))
        if len(near) >= 2:
            return PassedSlots(
                latest=near[-1], earlier=MAX_COUNTED, first=first, before_latest=near[-2], is_counted=False
            )
        back *= 4


def _up_to(now: dt.datetime, times: Iterator[dt.datetime]) -> Iterator[dt.datetime]:
    """In UTC: within one zone Python would compare the clock on the wall, which goes back in autumn."""
    return itertools.takewhile(lambda at: at <= now.astimezone(dt.UTC), (at.astimezone(dt.UTC) for at in times))
