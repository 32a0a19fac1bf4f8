"""What a batch that runs at its times remembers of them: up to when they are decided, and what became of each."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path

from pipeline.batch.batch_file import ScheduleTable
from pipeline.errors import RunError
from pipeline.schedule import Cron, Missed, Overlap, PassedSlots, decide, passed_slots

NAME = "schedule.json"
"""File in the work folder: up to when all times are decided, what became of them, and of the runs."""
KEPT = 500
"""Entries that are remembered; the counts go on."""


class Outcome(StrEnum):
    """What became of a time, or of a run."""

    RAN = "ran"
    """A run was made, and ended well."""
    INCOMPLETE = "incomplete"
    """A run was made, and some tiles failed."""
    FAILED = "failed"
    """A run was made, and ended with an error."""
    INTERRUPTED = "interrupted"
    """A run was made, and cut off; where the schedule itself was ended, it goes on when that is started again."""
    SKIPPED = "skipped"
    """A run was still under way."""
    MISSED = "missed"
    """Nobody saw it in time, a later time took its place, or the schedule was paused while it waited."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """What became of a time, of several that were missed together, or of a run that went on."""

    outcome: Outcome
    """What became of it."""
    slot: str | None
    """When it was due, ISO 8601 in UTC; of several the last one."""
    slots: int = 1
    """How many there were."""
    is_counted: bool = True
    """Whether `slots` is exact; else there were more."""
    at: str
    """When this was decided, of a run when it ended."""
    started_at: str | None = None
    """When its run began; None where there was none."""
    exit_code: int | None = None
    """Of its run."""
    message: str = ""
    """Why, in a sentence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleState:
    """What is remembered between two looks at the clock."""

    decided_until: dt.datetime
    """Up to when all times are decided."""
    waiting: dt.datetime | None = None
    """The time that waits for a run to end."""
    running: dt.datetime | None = None
    """The time whose run is under way, or was cut off together with this process."""
    times: str = ""
    """Cron expression and time zone by which they were decided."""
    counts: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Times by outcome."""
    entries: tuple[Entry, ...] = ()
    """The newest, in order."""

    def with_entry(self, entry: Entry) -> ScheduleState:
        """With one thing more to tell."""
        counts = {**self.counts, entry.outcome.value: self.counts.get(entry.outcome.value, 0) + entry.slots}
        return dataclasses.replace(self, counts=counts, entries=(*self.entries, entry)[-KEPT:])

    def to_json(self) -> str:
        """As the file holds it."""
        told = dataclasses.asdict(self)
        for name in ("decided_until", "waiting", "running"):
            told[name] = iso(getattr(self, name))
        return json.dumps(told, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> ScheduleState:
        """As it was written.

        Raises
        ------
        ValueError
            It is damaged.
        """
        try:
            told = json.loads(text)
            until = dt.datetime.fromisoformat(told["decided_until"])
            entries = tuple(Entry(**{**entry, "outcome": Outcome(entry["outcome"])}) for entry in told["entries"])
            state = cls(
                decided_until=until,
                waiting=_time(told["waiting"]),
                running=_time(told["running"]),
                times=told.get("times", ""),
                counts=dict(told["counts"]),
                entries=entries,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error
        if any(at is not None and at.tzinfo is None for at in (state.decided_until, state.waiting, state.running)):
            raise ValueError("a time without a time zone")
        return state


def look(
    state: ScheduleState, table: ScheduleTable, now: dt.datetime, *, is_busy: bool
) -> tuple[ScheduleState, dt.datetime | None]:
    """Decide the times that have passed.

    Parameters
    ----------
    state : ScheduleState
        What is remembered.
    table : ScheduleTable
        When the batch is to run.
    now : datetime
        The present, with a time zone.
    is_busy : bool
        Whether a run of this batch is under way, also one that somebody started by hand.

    Returns
    -------
    ScheduleState
        With what became of them.
    datetime or None
        The time that is to be run now.
    """
    if table.paused:
        if state.waiting is not None:
            state = state.with_entry(missed(state.waiting, now, "the schedule was paused while it waited"))
        return dataclasses.replace(state, decided_until=max(now, state.decided_until), waiting=None), None
    passed = passed_slots(Cron(table.cron, table.time_zone), state.decided_until, now)
    decision = decide(
        passed,
        waiting=state.waiting,
        is_busy=is_busy,
        now=now,
        missed=Missed(table.missed),
        overlap=Overlap(table.overlap),
        grace=dt.timedelta(seconds=table.grace_s),
    )
    if passed is not None and passed.before_latest is not None:
        state = state.with_entry(_missed_before(passed, now))
    if decision.late is not None:
        state = state.with_entry(missed(decision.late, now, "it was seen too late"))
    if decision.replaced is not None:
        state = state.with_entry(missed(decision.replaced, now, "a later time took its place while it waited"))
    if decision.skipped is not None:
        message = "a run was still under way"
        entry = Entry(outcome=Outcome.SKIPPED, slot=iso(decision.skipped), at=str(iso(now)), message=message)
        state = state.with_entry(entry)
    # a clock that was put back brings no time a second time
    return dataclasses.replace(state, decided_until=max(now, state.decided_until), waiting=decision.waits), decision.run


def missed(slot: dt.datetime, now: dt.datetime, message: str) -> Entry:
    """A time that was not run, and why."""
    return Entry(outcome=Outcome.MISSED, slot=iso(slot), at=str(iso(now)), message=message)


def _missed_before(passed: PassedSlots, now: dt.datetime) -> Entry:
    return Entry(
        outcome=Outcome.MISSED,
        slot=iso(passed.before_latest),
        slots=passed.earlier,
        is_counted=passed.is_counted,
        at=str(iso(now)),
        message=f"nobody looked from {iso(passed.first)} on",
    )


def read_schedule(work_folder: str) -> ScheduleState | None:
    """What is remembered of a batch's times; None where it was never run by them.

    Raises
    ------
    RunError
        It cannot be read.
    """
    path = Path(work_folder, NAME)
    try:
        return ScheduleState.from_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise RunError(
            f"{path} cannot be read: {error}. Remove it to begin anew; times until then are not known"
        ) from error


def iso(time: dt.datetime | None) -> str | None:
    """A time as it is written: ISO 8601 in UTC."""
    return None if time is None else time.astimezone(dt.UTC).isoformat(timespec="seconds")


def _time(text: str | None) -> dt.datetime | None:
    return None if text is None else dt.datetime.fromisoformat(text)
