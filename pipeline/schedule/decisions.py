"""Decides about slots that have passed: one is run, waits or is skipped; the others are missed.

Two runs of one schedule never overlap, whatever is set here.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from enum import StrEnum

from pipeline.schedule.cron import Cron
from pipeline.schedule.slots import PassedSlots


class Missed(StrEnum):
    """What happens to slots that are seen too late, for example after the service was down or the machine slept."""

    RUN_LATEST = "run-latest"
    """The latest slot is run once; those before it are missed."""
    SKIP = "skip"
    """All are missed; the next run is at its own time."""


class Overlap(StrEnum):
    """What happens to a slot that comes while the previous run is under way."""

    SKIP = "skip"
    """It is skipped."""
    WAIT = "wait"
    """It is run when that run is over; a later slot replaces it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rules:
    """When a schedule is due, and what happens to slots that are late or overlap a run."""

    cron: Cron
    """Its times."""
    missed: Missed = Missed.RUN_LATEST
    """What happens to a slot that is seen later than `grace_s`."""
    grace_s: float = 300.0
    """How late a slot may be seen and still count as seen in time, in seconds."""
    overlap: Overlap = Overlap.SKIP
    """What happens to a slot that comes while a run is under way."""
    is_paused: bool = False
    """Whether the clock is ignored. Slots that pass meanwhile are not missed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Decision:
    """What to do now."""

    run: dt.datetime | None = None
    """The slot to run now."""
    waits: dt.datetime | None = None
    """The slot that waits from now on."""
    skipped: dt.datetime | None = None
    """The slot that came while a run was under way."""
    replaced: dt.datetime | None = None
    """The slot that waited and is replaced by a later one."""
    late: dt.datetime | None = None
    """The latest slot, missed because it was seen too late."""


def decide(
    passed: PassedSlots | None, rules: Rules, *, waiting: dt.datetime | None, is_busy: bool, now: dt.datetime
) -> Decision:
    """Decide about the latest slot and the one that waits. Slots before the latest one are missed in any case.

    Parameters
    ----------
    passed : PassedSlots or None
        Slots that have passed since the last look.
    waiting : datetime or None
        The slot that waits for a run to end.

    >>> at = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
    >>> now = {"waiting": None, "is_busy": False, "now": at + dt.timedelta(hours=1)}
    >>> hourly = Cron("@hourly", "UTC")
    >>> decide(PassedSlots(latest=at), Rules(cron=hourly), **now).run == at
    True
    >>> decide(PassedSlots(latest=at), Rules(cron=hourly, missed=Missed.SKIP), **now).late == at
    True
    """
    unchanged = Decision(waits=waiting) if is_busy else Decision(run=waiting)
    if passed is None:
        return unchanged
    slot = passed.latest
    is_late = now.astimezone(dt.UTC) - slot.astimezone(dt.UTC) > dt.timedelta(seconds=rules.grace_s)
    if is_late and rules.missed is Missed.SKIP:
        return dataclasses.replace(unchanged, late=slot)
    if not is_busy:
        return Decision(run=slot, replaced=waiting)
    if rules.overlap is Overlap.WAIT:
        return Decision(waits=slot, replaced=waiting)
    return Decision(waits=waiting, skipped=slot)
