"""Schedules: frozen records of what is to run again and again, and of what became of each of its times.

No SQL, no HTTP; when something is due, and what becomes of it, is told by `pipeline.schedule`.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from enum import StrEnum

from pipeline.schedule import Cron, Missed, Overlap
from service.jobs import JobRequest


class Outcome(StrEnum):
    """What became of a slot, or of a run by hand."""

    SUBMITTED = "submitted"
    """A job was made."""
    WAITING = "waiting"
    """It waits for the job before it to end."""
    SKIPPED = "skipped"
    """The job before it was under way."""
    MISSED = "missed"
    """Nobody saw it in time, or a later slot took its place."""
    FAILED = "failed"
    """No job could be made; the message tells why."""


COUNTED = tuple(outcome for outcome in Outcome if outcome is not Outcome.WAITING)
"""Outcomes that are final."""


class Trigger(StrEnum):
    """What made a run."""

    CLOCK = "clock"
    """Its time had come."""
    HAND = "hand"
    """A client asked for it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Definition:
    """What a client says about a schedule; checked already."""

    title: str | None = None
    """The user's words; also the title of its jobs, where the request has none."""
    cron: Cron
    """When it is due."""
    request: JobRequest
    """What each of its jobs is to do."""
    priority: int = 0
    """Of its jobs; higher goes first."""
    missed: Missed = Missed.RUN_LATEST
    """What becomes of slots that are seen too late."""
    grace_s: float = 300.0
    """How late a slot may be seen and still count as seen in time."""
    overlap: Overlap = Overlap.SKIP
    """What becomes of a slot that comes while a job of this schedule is under way."""
    is_paused: bool = False
    """Whether the clock is left alone; a run by hand is still possible."""

    def job_request(self) -> JobRequest:
        """The request of the next job."""
        return dataclasses.replace(self.request, title=self.request.title or self.title)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleRun:
    """What became of a slot, of a stretch of slots that were missed together, or of a run by hand."""

    schedule_id: str
    """Whose."""
    number: int
    """Counts up within the schedule, from 1."""
    trigger: Trigger
    """What made it."""
    outcome: Outcome
    """What became of it."""
    slot: dt.datetime | None
    """When it was due, of a stretch the last one; None of a run by hand."""
    first_slot: dt.datetime | None = None
    """The first slot of a stretch; None of a single one."""
    slots: int = 1
    """How many slots a stretch has."""
    is_counted: bool = True
    """Whether `slots` is exact; else there are more."""
    job_id: str | None = None
    """The job that was made, or the one that was under way; it may be gone by now."""
    at: dt.datetime
    """When this was decided."""
    message: str = ""
    """Why, in a sentence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Schedule:
    """A schedule as it is stored."""

    schedule_id: str
    """32 hexadecimal digits, random: it cannot be guessed."""
    owner: str | None
    """Id of the key that made it; its jobs belong to the same key. None where keys are not used."""
    definition: Definition
    """What the client says."""
    version: int
    """Counts the client's changes, from 1."""
    created_at: dt.datetime
    """With a time zone, as all times here."""
    updated_at: dt.datetime
    """When the client changed it last."""
    decided_until: dt.datetime
    """Up to when all its slots are decided."""
    next_at: dt.datetime | None
    """When it is looked at again; None while it is paused."""
    waiting_slot: dt.datetime | None = None
    """The slot that waits for a job to end."""
    counts: dict[Outcome, int] = dataclasses.field(default_factory=dict)
    """Slots and runs by hand by their outcome, since the schedule was made."""
    last_run: ScheduleRun | None = None
    """The latest one for which a job was made."""
