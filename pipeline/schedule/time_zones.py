"""Time zones by their names in the IANA database, with suggestions for unknown names."""

from __future__ import annotations

import contextlib
import datetime as dt
import difflib
import functools
import re
import zoneinfo

from pipeline.errors import SettingsError

_NAME = re.compile(r"[A-Za-z0-9_+-]{1,32}(/[A-Za-z0-9_+-]{1,32}){0,2}")
_OF_THE_MACHINE = frozenset({"localtime", "posixrules", "Factory"})
"""Names whose zone depends on the machine."""
_OTHER_CLOCKS = ("right/", "posix/")
"""Folders of the database: clocks with leap seconds, and copies."""


@functools.cache
def time_zone(name: str) -> dt.tzinfo:
    """Look up a time zone.

    Parameters
    ----------
    name : str
        `UTC`, or a name of the IANA database: `Europe/Amsterdam`. UTC works without the database.

    Raises
    ------
    SettingsError
        The name is unknown, or this machine has no database of time zones.

    >>> import datetime as dt
    >>> dt.datetime(2026, 7, 1, tzinfo=time_zone("Asia/Kathmandu")).utcoffset()
    datetime.timedelta(seconds=20700)
    """
    if name in {"UTC", "Etc/UTC"}:
        return dt.UTC
    if _NAME.fullmatch(name) and name not in _OF_THE_MACHINE and not name.startswith(_OTHER_CLOCKS):
        with contextlib.suppress(zoneinfo.ZoneInfoNotFoundError, OSError, ValueError):
            return zoneinfo.ZoneInfo(name)
    known = _known()
    shown = f"time zone is {name[:80]!r}"
    if len(known) <= 1:
        fix = "install the system's package tzdata or Python's package tzdata, or use UTC"
        raise SettingsError([f"{shown}: this machine has no database of time zones; {fix}"])
    by_lower_case = {zone.lower(): zone for zone in known}
    near = [
        by_lower_case[found] for found in difflib.get_close_matches(name[:80].lower(), by_lower_case, n=2, cutoff=0.75)
    ]
    fix = f"did you mean {' or '.join(near)}?" if near else "use a name such as Europe/Amsterdam, or UTC"
    raise SettingsError([f"{shown}, which is not known: {fix}"])


def _known() -> set[str]:
    """Names in this machine's database, without those that are refused."""
    return {
        name
        for name in zoneinfo.available_timezones()
        if name not in _OF_THE_MACHINE and not name.startswith(_OTHER_CLOCKS)
    }
