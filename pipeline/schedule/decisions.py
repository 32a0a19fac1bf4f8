"""What becomes of the slots that have passed: one is run, waits or is skipped; the others are missed.

Two runs of one schedule are never under way at the same time, whatever is set here.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from enum import StrEnum

from pipeline.schedule.slots import PassedSlots


class Missed(StrEnum):
    """What becomes of slots that nobody saw in time: the service was down, the machine slept."""

    RUN_LATEST = "run-latest"
    """The latest one is run, once; those before it are told as missed."""
    SKIP = "skip"
    """All are told as missed; the next run is at its own time."""


class Overlap(StrEnum):
    """What becomes of a slot that comes while the run before it is still under way."""

    SKIP = "skip"
    """It is told as skipped."""
    WAIT = "wait"
    """It is run when that one is over; a later slot takes its place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Decision:
    """What is to be done now."""

    run: dt.datetime | None = None
    """The slot to be run now."""
    waits: dt.datetime | None = None
    """The slot that waits from now on."""
    skipped: dt.datetime | None = None
    """The slot that came while a run was under way."""
    replaced: dt.datetime | None = None
    """The slot that waited, and whose place a later one takes."""
    late: dt.datetime | None = None
    """The latest slot, missed as it was seen too late."""


def decide(
    passed: PassedSlots | None,
    *,
    waiting: dt.datetime | None,
    is_busy: bool,
    now: dt.datetime,
    missed: Missed,
    overlap: Overlap,
    grace: dt.timedelta,
) -> Decision:
    """What becomes of the latest slot, and of the one that waits; slots before the latest one are missed in any case.

    Parameters
    ----------
    passed : PassedSlots or None
        What has passed since the schedule was last looked at.
    waiting : datetime or None
        The slot that waits for a run to end.
    is_busy : bool
        Whether a run of this schedule is under way.
    now : datetime
        The present, with a time zone.
    missed : Missed
        What becomes of a slot that is seen later than `grace`.
    overlap : Overlap
        What becomes of a slot that comes while a run is under way.
    grace : timedelta
        How late a slot may be seen and still count as seen in time.

    >>> at = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
    >>> late = at + dt.timedelta(hours=1)
    >>> options = {"waiting": None, "is_busy": False, "overlap": Overlap.SKIP, "grace": dt.timedelta(minutes=5)}
    >>> decide(PassedSlots(latest=at), now=late, missed=Missed.RUN_LATEST, **options).run == at
    True
    >>> decide(PassedSlots(latest=at), now=late, missed=Missed.SKIP, **options).late == at
    True
    """
    if passed is None:
        return Decision(waits=waiting) if is_busy else Decision(run=waiting)
    slot = passed.latest
    is_late = now.astimezone(dt.UTC) - slot.astimezone(dt.UTC) > grace
    if is_late and missed is Missed.SKIP:
        return dataclasses.replace(
            Decision(waits=waiting) if is_busy else Decision(run=waiting),
            late=slot,
        )
    if not is_busy:
        return Decision(run=slot, replaced=waiting)
    if overlap is Overlap.WAIT:
        return Decision(waits=slot, replaced=waiting)
    return Decision(waits=waiting, skipped=slot)
