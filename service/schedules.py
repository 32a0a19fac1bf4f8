"""The service's schedules: what `pipeline.schedule` has, and the jobs. No SQL, no HTTP."""

from __future__ import annotations

import dataclasses
import datetime as dt
from enum import StrEnum

from pipeline.schedule import Entry, Outcome, Rules
from service.jobs import JobRequest

OUTCOMES = (Outcome.SUBMITTED, Outcome.WAITING, Outcome.SKIPPED, Outcome.MISSED, Outcome.FAILED)
"""The possible outcomes of a slot of the service, or of a run by hand."""


class Trigger(StrEnum):
    """The cause of a run."""

    CLOCK = "clock"
    """Its time had come."""
    HAND = "hand"
    """A client requested it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Definition(Rules):
    """A schedule as the client defines it; already checked."""

    title: str | None = None
    """A text by the user; also the title of its jobs if the request has none."""
    request: JobRequest
    """The request of each of its jobs."""
    priority: int = 0
    """Priority of its jobs; higher runs first."""

    def job_request(self) -> JobRequest:
        """The request of the next job."""
        return dataclasses.replace(self.request, title=self.request.title or self.title)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleRun(Entry):
    """An entry in the history of a schedule."""

    schedule_id: str
    """The schedule."""
    number: int
    """Counts up within the schedule, from 1."""
    trigger: Trigger
    """Its cause."""
    job_id: str | None = None
    """The job that was made, or the one that was under way; it may be removed by now."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Schedule:
    """A schedule as it is stored."""

    schedule_id: str
    """32 hexadecimal digits, random: it cannot be guessed."""
    owner: str | None
    """Id of the key that made it; its jobs belong to the same key. None if keys are not used."""
    definition: Definition
    """The client's part."""
    version: int
    """Counts the client's changes, from 1."""
    created_at: dt.datetime
    """With a time zone, like all times here."""
    updated_at: dt.datetime
    """Time of the client's last change."""
    decided_until: dt.datetime
    """Time up to which all slots are decided."""
    next_at: dt.datetime | None
    """Time of the next look; None while it is paused."""
    waiting_slot: dt.datetime | None = None
    """The slot that waits for a job to end."""
    counts: dict[Outcome, int] = dataclasses.field(default_factory=dict)
    """Slots and runs by hand by outcome, since the schedule was made."""
    last_run: ScheduleRun | None = None
    """The latest one that made a job."""
