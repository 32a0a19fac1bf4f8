r"""Cron times in a time zone.

Five fields, as in Debian's cron (`man 5 crontab`): minute, hour, day of the month, month, day of the week. Beside `*`,
lists, ranges, steps and names of months and days there are `L` (the month's last day), `LW` (its last weekday), `5L`
(its last Friday) and `MON#2` (its second Monday). Where neither field of days starts with a star, a day that fits one
of them counts; else it must fit both.

Clocks that are put forward and back
------------------------------------
As in Debian's cron there are two kinds of expression:

- *Fixed times* have no star at the start of minute and hour (`30 2 * * *`). A local time that the clock leaps over
  comes at the first minute after the gap; several that fall into one gap come once. A local time that comes twice
  counts the first time only. So there is exactly one run a day where one was meant.
- *Wildcards* have a star at the start of one of the two (`*/15 * * * *`, `0 */6 * * *`). They follow the clock on the
  wall: what it leaps over does not come, what comes twice runs twice. So the distance in time stays the same.

`*/30 2 * * *` is of the second kind: it does not come at all on the day on which there is no hour 2.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import heapq
from collections.abc import Iterator, Mapping

from cronsim import CronSim, CronSimError

from pipeline.errors import SettingsError
from pipeline.schedule.time_zones import time_zone

LONGEST = 200
"""Characters of an expression."""

WORDS: Mapping[str, str] = {
    "@hourly": "0 * * * *",
    "@daily": "0 0 * * *",
    "@midnight": "0 0 * * *",
    "@weekly": "0 0 * * 0",
    "@monthly": "0 0 1 * *",
    "@yearly": "0 0 1 1 *",
    "@annually": "0 0 1 1 *",
}
"""Words that stand for five fields."""

FIELDS: Mapping[str, str] = {
    "minute": "0 to 59",
    "hour": "0 to 23",
    "day-of-month": "1 to 31, L or LW",
    "month": "1 to 12 or JAN to DEC",
    "day-of-week": "0 to 7 (0 and 7 are Sunday) or SUN to SAT, with L or #1 to #5 behind it",
}
"""The fields in their order, and what they take."""

_MINUTE = dt.timedelta(minutes=1)
_PROBE = dt.datetime(2000, 1, 1)  # noqa: DTZ001 - the calendar has no time zone
"""Where it is tried whether an expression ever comes: within the 50 years after this each 29 February falls on each day
of the week."""


@dataclasses.dataclass(frozen=True)
class Cron:
    """An expression in a time zone; checked when it is made.

    Raises
    ------
    SettingsError
        The expression, the time zone, or both cannot be used.

    >>> Cron("30 2 * * *", "Europe/Amsterdam").next_time(dt.datetime(2026, 3, 29, tzinfo=dt.UTC)).isoformat()
    '2026-03-29T03:00:00+02:00'
    """

    expression: str
    """Five fields, or one of `WORDS`."""
    time_zone: str
    """A name of the IANA database; `UTC` where nothing else is said."""

    def __post_init__(self) -> None:
        faults = expression_faults(self.expression)
        try:
            time_zone(self.time_zone)
        except SettingsError as error:
            faults += error.faults
        if faults:
            raise SettingsError(faults)

    @property
    def fields(self) -> str:
        """The five fields."""
        return _fields_of(self.expression)

    @property
    def is_wildcard(self) -> bool:
        """Whether it follows the clock on the wall, where that is put forward and back."""
        minute, hour = self.fields.split()[:2]
        return minute.startswith("*") or hour.startswith("*")

    def times(self, after: dt.datetime) -> Iterator[dt.datetime]:
        """All times after a time, in the time zone; each later than the one before it.

        Parameters
        ----------
        after : datetime
            With a time zone.

        Raises
        ------
        ValueError
            `after` has no time zone.
        """
        if after.tzinfo is None:
            raise ValueError(f"{after} has no time zone")
        zone = time_zone(self.time_zone)
        start = after.astimezone(zone)
        found = (
            _wildcard_times(self.fields, start, zone) if self.is_wildcard else _fixed_times(self.fields, start, zone)
        )
        last = after.astimezone(dt.UTC)
        for at in found:
            if at > last:
                last = at
                yield at.astimezone(zone)

    def next_time(self, after: dt.datetime) -> dt.datetime:
        """The first time after a time, in the time zone.

        Raises
        ------
        SettingsError
            There is none in the fifty years that follow.
        """
        found = next(self.times(after), None)
        if found is None:
            raise SettingsError([f"cron is {self.expression!r}: no such time comes in the 50 years after {after}"])
        return found

    def next_times(self, after: dt.datetime, count: int) -> list[dt.datetime]:
        """The first few times after a time, in the time zone."""
        return [at for at, _ in zip(self.times(after), range(count), strict=False)]


# The library walks over the calendar without a time zone; which times on the wall exist, and how often, is told here.
# (With one it loses times where clocks are shifted by half an hour.)


def _fixed_times(fields: str, start: dt.datetime, zone: dt.tzinfo) -> Iterator[dt.datetime]:
    """Each time on the wall once, in UTC: the first of two, or the end of the gap that it falls into."""
    for wall in CronSim(fields, start.replace(tzinfo=None)):
        real = wall
        while not (found := _instants(real, zone)):
            real += _MINUTE
        yield found[0]


def _wildcard_times(fields: str, start: dt.datetime, zone: dt.tzinfo) -> Iterator[dt.datetime]:
    """Each time on the wall as often as it comes, in UTC and in order."""
    wall_start = start.replace(tzinfo=None)
    both = [start.replace(fold=fold).utcoffset() or dt.timedelta() for fold in (0, 1)]
    # what lies before the start in an hour that comes twice may come again
    held: list[dt.datetime] = []
    for wall in CronSim(fields, wall_start - abs(both[1] - both[0])):
        found = _instants(wall, zone)
        if found:
            # nothing that follows comes before the first time of this one
            while held and held[0] < found[0]:
                yield heapq.heappop(held)
            for at in found:
                heapq.heappush(held, at)
    while held:
        yield heapq.heappop(held)


def _instants(wall: dt.datetime, zone: dt.tzinfo) -> list[dt.datetime]:
    """When a clock on the wall shows a time, in UTC: once, twice, or never."""
    found = [wall.replace(tzinfo=zone, fold=fold).astimezone(dt.UTC) for fold in (0, 1)]
    if found[0] == found[1]:
        return found[:1]
    return [at for at in found if at.astimezone(zone).replace(tzinfo=None, fold=0) == wall]


def expression_faults(expression: str) -> list[str]:
    """What is wrong with an expression, in a sentence each; empty where nothing is."""
    told = f"cron is {expression[:80]!r}"
    if len(expression) > LONGEST:
        return [f"{told}... with {len(expression)} characters: use at most {LONGEST}"]
    parts = _fields_of(expression).split()
    if expression.strip().startswith("@") and expression.strip().lower() not in WORDS:
        return [f"{told}: use one of {', '.join(WORDS)}, or five fields"]
    if len(parts) != len(FIELDS):
        return [f"{told} with {len(parts)} fields: use five, {', '.join(FIELDS)}, such as '30 2 * * *'"]
    faults = [
        f"{told}: its {name} is {part[:40]!r}, use {allowed}{_about_ranges(part)}"
        for (name, allowed), part, place in zip(FIELDS.items(), parts, range(len(parts)), strict=True)
        if not _is_usable(" ".join("*" * place) + f" {part} " + " ".join("*" * (len(FIELDS) - 1 - place)))
    ]
    if not faults and not _comes(" ".join(parts)):
        faults.append(f"{told}: no such day ever comes, use a day that the month has")
    return faults


def _fields_of(expression: str) -> str:
    """The five fields that an expression stands for."""
    return WORDS.get(expression.strip().lower(), expression)


def _about_ranges(part: str) -> str:
    """What is easily overlooked about ranges."""
    return "; a range goes up, and SUN is 0: write FRI,SAT,SUN for FRI-SUN" if "-" in part else ""


def _is_usable(fields: str) -> bool:
    """Whether the library reads them; a number of thousands of digits is no number to Python."""
    try:
        CronSim(fields, _PROBE)
    except (CronSimError, ValueError):
        return False
    return True


def _comes(fields: str) -> bool:
    """Whether there is any such time."""
    try:
        return next(CronSim(fields, _PROBE), None) is not None
    except CronSimError:
        return False
