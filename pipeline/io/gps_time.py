"""GPS times of point records as dates: adjusted standard time has one, seconds of the week have none."""

from __future__ import annotations

import datetime as dt
from enum import StrEnum

SECONDS_PER_WEEK = 604_800.0
ADJUSTMENT_S = 1e9
"""What LAS subtracts from the seconds since 1980-01-06 to keep digits (LAS 1.4 R15, global encoding bit 0)."""
GPS_EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)

LEAP_SECONDS = (
    (dt.datetime(2017, 1, 1, tzinfo=dt.UTC), 18),
    (dt.datetime(2015, 7, 1, tzinfo=dt.UTC), 17),
    (dt.datetime(2012, 7, 1, tzinfo=dt.UTC), 16),
    (dt.datetime(2009, 1, 1, tzinfo=dt.UTC), 15),
    (dt.datetime(2006, 1, 1, tzinfo=dt.UTC), 14),
    (dt.datetime(1999, 1, 1, tzinfo=dt.UTC), 13),
)
"""Seconds that GPS time is ahead of UTC since a date, newest first (IERS Bulletin C); 12 before."""


class GpsTimeKind(StrEnum):
    """How the GPS times of a file are to be read."""

    NONE = "none"
    """The file has none, or all are one value."""
    WEEK = "week"
    """Seconds of an unnamed GPS week: no date follows."""
    ADJUSTED = "adjusted"
    """Adjusted standard GPS time: a date follows."""
    UNKNOWN = "unknown"
    """The values fit neither."""


def kind_of(smallest_s: float, largest_s: float, *, flagged_as_adjusted: bool) -> GpsTimeKind:
    """How to read times of a range in seconds, by the header's flag and by what the values can be.

    Writers forget the flag, bit 0 of the global encoding, so values beyond a week are taken as adjusted standard time
    even without it. With the flag, values within one week would mean mid September 2011 and are far more often seconds
    of the week: unknown.
    """
    if smallest_s == largest_s:
        return GpsTimeKind.NONE
    within_a_week = smallest_s >= 0.0 and largest_s <= SECONDS_PER_WEEK
    if within_a_week:
        return GpsTimeKind.UNKNOWN if flagged_as_adjusted else GpsTimeKind.WEEK
    # Airborne laser scanning begins in the 1990s, and 1e9 adjusted seconds is the year 2043.
    if smallest_s >= -7e8 and largest_s < ADJUSTMENT_S:
        return GpsTimeKind.ADJUSTED
    return GpsTimeKind.UNKNOWN


def utc_of(adjusted_s: float) -> dt.datetime:
    """UTC of an adjusted standard GPS time.

    >>> utc_of(297417271.0).isoformat()
    '2021-02-15T09:40:53+00:00'
    """
    gps = GPS_EPOCH + dt.timedelta(seconds=adjusted_s + ADJUSTMENT_S)
    for since, seconds in LEAP_SECONDS:
        utc = gps - dt.timedelta(seconds=seconds)
        if utc >= since:
            return utc
    return gps - dt.timedelta(seconds=12)
