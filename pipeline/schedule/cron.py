r"""Cron times in a time zone.

Five fields, as in Debian's cron (`man 5 crontab`): minute, hour, day of the month, month, day of the week. It has `*`,
lists, ranges, steps, names of months and days, `L` (the last day of the month), `LW` (its last weekday), `5L` (its last
Friday) and `MON#2` (its second Monday). If neither field of days starts with a star, a day must fit one of them;
otherwise both.

Clock changes
-------------
As in Debian's cron there are two kinds of expression:

- *Fixed times* have no star at the start of minute and hour (`30 2 * * *`). A local time that the clock skips comes at
  the first minute after the gap; several in one gap come once. A local time that exists twice counts only the first
  time. A daily time therefore comes exactly once a day.
- *Wildcards* have a star at the start of one of the two (`*/15 * * * *`, `0 */6 * * *`). They follow the local clock: a
  skipped time does not come, a repeated one comes twice. The interval therefore stays the same.

`*/30 2 * * *` is of the second kind: it does not come on the day without an hour 2.
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
"""Most characters of an expression."""

WORDS: Mapping[str, str] = {
    "@hourly": "0 * * * *",
    "@daily": "0 0 * * *",
    "@midnight": "0 0 * * *",
    "@weekly": "0 0 * * 0",
    "@monthly": "0 0 1 * *",
    "@yearly": "0 0 1 1 *",
    "@annually": "0 0 1 1 *",
}
"""Words for five fields."""

FIELDS: Mapping[str, str] = {
    "minute": "0 to 59",
    "hour": "0 to 23",
    "day-of-month": "1 to 31, L or LW",
    "month": "1 to 12 or JAN to DEC",
    "day-of-week": "0 to 7 (0 and 7 are Sunday) or SUN to SAT, with L or #1 to #5 behind it",
}
"""The fields in their order, and their values."""

_MINUTE = dt.timedelta(minutes=1)
_PROBE = dt.datetime(2000, 1, 1)  # noqa: DTZ001 - the calendar has no time zone
"""Start of the test whether an expression ever comes: in the 50 years from here 29 February falls on every day of the
week."""


@dataclasses.dataclass(frozen=True)
class Cron:
    """An expression in a time zone, checked at construction.

    Raises
    ------
    SettingsError
        The expression, the time zone or both are not valid.

    >>> Cron("30 2 * * *", "Europe/Amsterdam").next_time(dt.datetime(2026, 3, 29, tzinfo=dt.UTC)).isoformat()
    '2026-03-29T03:00:00+02:00'
    """

    expression: str
    """Five fields, or one of `WORDS`."""
    time_zone: str
    """A name of the IANA database, such as `UTC`."""

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
        """Whether it follows the local clock through clock changes."""
        minute, hour = self.fields.split()[:2]
        return minute.startswith("*") or hour.startswith("*")

    def times(self, after: dt.datetime) -> Iterator[dt.datetime]:
        """All times after a time, in the time zone and in order.

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


# The library walks over the calendar without a time zone; this code decides which local times exist, and how often.
# (With one it loses times where clocks are shifted by half an hour.)


def _fixed_times(fields: str, start: dt.datetime, zone: dt.tzinfo) -> Iterator[dt.datetime]:
    """Each local time once, in UTC: the first of two, or the end of its gap."""
    for wall in CronSim(fields, start.replace(tzinfo=None)):
        real = wall
        while not (found := _instants(real, zone)):
            real += _MINUTE
        yield found[0]


def _wildcard_times(fields: str, start: dt.datetime, zone: dt.tzinfo) -> Iterator[dt.datetime]:
    """Each local time as often as it exists, in UTC and in order."""
    wall_start = start.replace(tzinfo=None)
    both = [start.replace(fold=fold).utcoffset() or dt.timedelta() for fold in (0, 1)]
    # times before the start, in an hour that exists twice, may come again
    held: list[dt.datetime] = []
    for wall in CronSim(fields, wall_start - abs(both[1] - both[0])):
        found = _instants(wall, zone)
        if found:
            # no later local time comes before the first instant of this one
            while held and held[0] < found[0]:
                yield heapq.heappop(held)
            for at in found:
                heapq.heappush(held, at)
    while held:
        yield heapq.heappop(held)


def _instants(wall: dt.datetime, zone: dt.tzinfo) -> list[dt.datetime]:
    """The instants of a local time, in UTC: one, two or none."""
    found = [wall.replace(tzinfo=zone, fold=fold).astimezone(dt.UTC) for fold in (0, 1)]
    if found[0] == found[1]:
        return found[:1]
    return [at for at in found if at.astimezone(zone).replace(tzinfo=None, fold=0) == wall]


def expression_faults(expression: str) -> list[str]:
    """The faults of an expression, one sentence each."""
    shown = f"cron is {expression[:80]!r}"
    if len(expression) > LONGEST:
        return [f"{shown}... with {len(expression)} characters: use at most {LONGEST}"]
    parts = _fields_of(expression).split()
    if expression.strip().startswith("@") and expression.strip().lower() not in WORDS:
        return [f"{shown}: use one of {', '.join(WORDS)}, or five fields"]
    if len(parts) != len(FIELDS):
        return [f"{shown} with {len(parts)} fields: use five, {', '.join(FIELDS)}, such as '30 2 * * *'"]
    faults = [
        f"{shown}: its {name} is {part[:40]!r}, use {allowed}{_about_ranges(part)}"
        for (name, allowed), part, place in zip(FIELDS.items(), parts, range(len(parts)), strict=True)
        if not _is_usable(" ".join("*" * place) + f" {part} " + " ".join("*" * (len(FIELDS) - 1 - place)))
    ]
    if not faults and not _comes(" ".join(parts)):
        faults.append(f"{shown}: this date never occurs; use a day that the month has")
    return faults


def _fields_of(expression: str) -> str:
    """The five fields of an expression or a word."""
    return WORDS.get(expression.strip().lower(), expression)


def _about_ranges(part: str) -> str:
    """A hint about ranges."""
    return "; a range goes up, and SUN is 0: write FRI,SAT,SUN for FRI-SUN" if "-" in part else ""


def _is_usable(fields: str) -> bool:
    """Whether the library can read them; Python refuses numbers of thousands of digits."""
    try:
        CronSim(fields, _PROBE)
    except (CronSimError, ValueError):
        return False
    return True


def _comes(fields: str) -> bool:
    """Whether there is such a time."""
    try:
        return next(CronSim(fields, _PROBE), None) is not None
    except CronSimError:
        return False
