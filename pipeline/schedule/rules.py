"""When a schedule is due, and what happens to slots that are late or overlap a run."""

from __future__ import annotations

import dataclasses
from enum import StrEnum

from pipeline.schedule.cron import Cron


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
