"""Query parameters of lists."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, Field, WithJsonSchema

from pipeline.model import Status
from service.errors import RequestError
from service.jobs import JobStatus
from service.wire import patterns

_MILLISECOND = dt.timedelta(microseconds=999)
"""The rest of the millisecond that a time in an answer names."""
_LAST = dt.datetime.max.replace(tzinfo=dt.UTC)

MAX_WORDS = 100
"""Most words of one query parameter."""

Limit = Annotated[int, Field(ge=1, le=1000, description="Maximum number of entries of the page.")]
Offset = Annotated[int, Field(ge=0, le=2**31 - 1, description="Number of entries before the page.")]


def words(allowed: Sequence[str] = ()) -> Callable[[list[str] | None], list[str] | None]:
    """Splits a parameter that may come several times, with commas, or both; checks the words if some are allowed."""

    def split(values: list[str] | None) -> list[str] | None:
        if values is None:
            return None
        found = list(dict.fromkeys(word for value in values for part in value.split(",") if (word := part.strip(" "))))
        if len(found) > MAX_WORDS:
            raise ValueError(f"use at most {MAX_WORDS} words")
        if allowed and not set(found) <= set(allowed):
            raise ValueError(f"use one of {', '.join(allowed)}")
        return found

    return split


def entry_of(allowed: Iterable[str]) -> WithJsonSchema:
    """The schema of one value of such a parameter."""
    return WithJsonSchema({"type": "string", **patterns.stated(patterns.any_of(allowed))})


Words = Annotated[list[str] | None, AfterValidator(words())]
Statuses = Annotated[list[Annotated[str, entry_of(Status)]] | None, AfterValidator(words(list(Status)))]
"""Statuses of buildings."""


def window(text: str, *, in_degrees: bool, northing_first: bool = False) -> list[tuple[float, float, float, float]]:
    """The boxes of a parameter bbox, easting first: two where a window in degrees crosses the 180th meridian.

    Raises
    ------
    RequestError
        It is not a window.

    Examples
    --------
    >>> window("170,-10,-170,10", in_degrees=True)
    [(170.0, -10.0, 180.0, 10.0), (-180.0, -10.0, -170.0, 10.0)]
    """
    try:
        # Python also reads 1_000
        values = [float(part) for part in text.replace("_", "?").split(",", 6)]
    except ValueError:
        values = []
    problem = f"query bbox is {text[:80]!r}"
    if len(values) != 4 or not all(map(math.isfinite, values)):
        raise RequestError([f"{problem}: give four numbers, such as 4.35,52.00,4.37,52.01"])
    west, south, east, north = (values[k] for k in ((1, 0, 3, 2) if northing_first else range(4)))
    if in_degrees and (max(abs(west), abs(east)) > 180.0 or max(abs(south), abs(north)) > 90.0):
        raise RequestError([f"{problem}: longitudes reach from -180 to 180, latitudes to 90"])
    if south > north:
        raise RequestError([f"{problem}: its south {south:g} lies north of its north {north:g}"])
    if west <= east:
        return [(west, south, east, north)]
    if not in_degrees:
        raise RequestError([f"{problem}: its west {west:g} lies east of its east {east:g}"])
    return [(west, south, 180.0, north), (-180.0, south, east, north)]


def interval(text: str | None) -> tuple[dt.datetime | None, dt.datetime | None]:
    """First and last time of an interval. A single time covers its millisecond, as times in answers are cut to it.

    Raises
    ------
    ValueError
        It is not an interval.

    >>> interval("../2026-03-01T09:30:00Z")[1].isoformat()
    '2026-03-01T09:30:00+00:00'
    """
    if text is None:
        return None, None
    parts = text.split("/")
    if len(parts) > 2:
        raise ValueError("use one time, or two with a slash between them")
    first = _instant(parts[0], is_open=len(parts) == 2)
    if len(parts) == 1:
        # nothing comes after the last instant that can be represented
        return first, None if first is None or first > _LAST - _MILLISECOND else first + _MILLISECOND
    last = _instant(parts[1], is_open=True)
    if first is not None and last is not None and first > last:
        raise ValueError("use an end that is not before the start")
    return first, last


def _instant(text: str, *, is_open: bool) -> dt.datetime | None:
    """An RFC 3339 time in UTC; None for an open end."""
    if is_open and text in {"", ".."}:
        return None
    if not patterns.fits(patterns.TIME, text):
        raise ValueError("use a time such as 2026-03-01T09:30:00Z")
    try:
        # in a query an unescaped plus is a space
        at = dt.datetime.fromisoformat(text.replace(" ", "+"))
        return (at if at.tzinfo is not None else at.replace(tzinfo=dt.UTC)).astimezone(dt.UTC)
    except (ValueError, OverflowError):
        raise ValueError("use a day that exists, as in 2026-03-01T09:30:00Z") from None


def is_interval(text: str | None) -> str | None:
    """Refuse a text that is not an interval."""
    interval(text)
    return text


Seconds = Annotated[float, Field(ge=0.0, le=1e9, allow_inf_nan=False, description="Seconds.")]


class Page(BaseModel):
    """Which page of a list."""

    limit: Limit = 100
    offset: Offset = 0


class JobQuery(Page):
    """Which jobs."""

    type: Words = Field(None, description="The only type is `process`.")
    processID: Words = Field(None, description="Only jobs of these processes.")
    status: Annotated[list[Annotated[str, entry_of(JobStatus)]] | None, AfterValidator(words([*JobStatus]))] = Field(
        None, description=f"Only jobs with these: {', '.join(JobStatus)}."
    )
    scheduleID: str | None = Field(None, description="Only jobs of this schedule.")
    q: Annotated[str | None, Field(max_length=200)] = Field(
        None, description="Only jobs with each of these words in title, id or process; case does not matter."
    )
    datetime: Annotated[str | None, AfterValidator(is_interval)] = Field(
        None,
        description="Time of creation: an RFC 3339 time, or `a/b`, `../b`, `a/..`.",
        json_schema_extra=patterns.stated(patterns.INTERVAL),
    )
    minDuration: Seconds | None = None
    maxDuration: Seconds | None = None
    limit: Annotated[int, Field(ge=1, le=10_000, description="Maximum number of jobs of the page.")] = 100


class ScheduleQuery(Page):
    """Which schedules."""

    state: Literal["active", "paused"] | None = Field(None, description="Only schedules in this state.")
    processID: str | None = Field(None, description="Only schedules of this process.")


class EventQuery(BaseModel):
    """Which events, and how."""

    f: Literal["json", "sse"] | None = Field(None, description="Overrides the header Accept.")
    after: int = Field(0, ge=0, le=2**31 - 1, description="Only events with a higher id.")
    limit: int = Field(500, ge=1, le=500, description="Maximum number of events of a list.")


class LogQuery(BaseModel):
    """Which lines of a log, and how."""

    f: Literal["json", "text"] | None = Field(None, description="Overrides the header Accept.")
    after: int = Field(0, ge=0, le=2**31 - 1, description="Only lines with a higher number; the first ones of them.")
    before: int | None = Field(None, ge=1, le=2**31 - 1, description="Only lines with a lower number.")
    level: Literal["info", "warning", "error"] = Field("info", description="Only lines as serious as this, or more.")
    limit: int = Field(100, ge=1, le=2000, description="Maximum number of lines: the newest, unless `after` is given.")
