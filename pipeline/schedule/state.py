"""The state and history of a schedule, and what one look at the clock makes of them.

A batch stores both in its work folder, the service in its database: two implementations of `ScheduleBook`.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Callable
from enum import StrEnum
from typing import Protocol

from pipeline.schedule.rules import Missed, Overlap, Rules
from pipeline.schedule.slots import PassedSlots, passed_slots

PUT_BACK = dt.timedelta(minutes=10)
"""How far the clock may be behind what is decided: a correction, or machines whose clocks differ, is less. Within it no
slot comes before what is decided; behind it the clock was put back, and the schedule goes by the present clock."""


class Outcome(StrEnum):
    """What became of a slot or of a run. These words are stored, shown and counted."""

    SUBMITTED = "submitted"
    """The service made a job."""
    WAITING = "waiting"
    """It waits until the run before it is over. Not final and not counted."""
    RAN = "ran"
    """A batch run ended well."""
    INCOMPLETE = "incomplete"
    """A batch run ended, and some tiles failed."""
    INTERRUPTED = "interrupted"
    """A batch run was cut off; if the schedule itself was ended, the run continues when it is started again."""
    SKIPPED = "skipped"
    """The run before it was still under way, or it had its run before the clock was put back."""
    MISSED = "missed"
    """It was seen too late, a later slot replaced it, or the schedule was paused while it waited. An entry with this
    outcome also notes that the clock was put back."""
    FAILED = "failed"
    """No run could be made, or a batch run ended with an error; the message says why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """History: what became of a slot, of several slots that were missed together, or of a run without a slot."""

    outcome: Outcome
    """What became of it."""
    slot: dt.datetime | None
    """When it was due, the last one of several; None for a run by hand."""
    first_slot: dt.datetime | None = None
    """The first of several slots; None for a single one."""
    slots: int = 1
    """Number of slots."""
    is_counted: bool = True
    """Whether `slots` is exact; otherwise there are more."""
    at: dt.datetime
    """When this was decided; for a batch run, when it ended."""
    message: str = ""
    """The reason, in a sentence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleState:
    """What has to be remembered between two looks at the clock."""

    decided_until: dt.datetime
    """Time up to which all slots are decided."""
    waiting: dt.datetime | None = None
    """The slot that waits for a run to end."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """The result of a look at the clock."""

    state: ScheduleState
    """The state from now on."""
    entries: tuple[Entry, ...] = ()
    """New history, in order."""
    due: dt.datetime | None = None
    """The slot to run now. Its entry is for the caller to write."""


class ScheduleBook(Protocol):
    """Stores the state and history of one schedule."""

    state: ScheduleState
    """As read or last changed; stored with `save`."""

    def add(self, entry: Entry) -> None:
        """Add to the history and count it by its outcome.

        The final entry of a slot that waited replaces its entry `WAITING`. Old entries are dropped, their counts stay.
        """

    def has_run(self, slot: dt.datetime) -> bool:
        """Whether the history has a run of a slot."""

    def save(self) -> None:
        """Store state and history."""


def enter(book: ScheduleBook, found: Look) -> dt.datetime | None:
    """Enter the result of a look into the book, without saving it; return the slot to run now."""
    for entry in found.entries:
        book.add(entry)
    book.state = found.state
    return found.due


def was_put_back(state: ScheduleState, now: dt.datetime) -> bool:
    """Whether the clock is so far behind what is decided that the schedule goes by the present clock."""
    return state.decided_until - now > PUT_BACK


def decided_by(state: ScheduleState, now: dt.datetime) -> dt.datetime:
    """Time up to which all slots are decided after a look; up to the present if the clock was put back."""
    return now if was_put_back(state, now) else max(now, state.decided_until)


def look(
    state: ScheduleState,
    rules: Rules,
    now: dt.datetime,
    *,
    under_way: str | None,
    has_run: Callable[[dt.datetime], bool] = lambda _slot: False,
) -> Look:
    """Decide all slots that have passed: the latest one is run, waits, is skipped or missed, those before are missed.

    Two runs of one schedule never overlap, whatever its rules are.

    Parameters
    ----------
    under_way : str or None
        The run of this schedule that is under way, in words for the history; None if there is none.
    has_run : callable
        Whether a slot had its run already: it may come again after the clock was put back.

    >>> from pipeline.schedule import Cron
    >>> state = ScheduleState(decided_until=dt.datetime(2026, 1, 1, tzinfo=dt.UTC))
    >>> hourly = Rules(cron=Cron("@hourly", "UTC"), missed=Missed.SKIP, overlap=Overlap.WAIT)
    >>> on_time = state.decided_until + dt.timedelta(hours=1)
    >>> look(state, hourly, on_time, under_way=None).due == on_time
    True
    >>> look(state, hourly, on_time, under_way="a run").state.waiting == on_time
    True
    >>> look(state, hourly, on_time + dt.timedelta(minutes=30), under_way=None).entries[0].outcome.value
    'missed'
    """
    decided_until = decided_by(state, now)
    if rules.is_paused:
        found = miss_waiting(state, now, "the schedule was paused while it waited")
        return dataclasses.replace(found, state=ScheduleState(decided_until=decided_until))
    passed = passed_slots(rules.cron, state.decided_until, now)
    slot, waiting = None if passed is None else passed.latest, state.waiting
    again = slot is not None and has_run(slot)
    is_late = slot is not None and not again and rules.missed is Missed.SKIP and _seconds(slot, now) > rules.grace_s
    entries = [_note_put_back(state, now)] if was_put_back(state, now) else []
    if passed is not None and (is_late or passed.earlier):
        fate = f"seen later than {rules.grace_s:g} s" if is_late else "only the latest of them counts"
        message = f"the clock was not looked at from {utc(passed.first or passed.latest)} to {utc(now)}: {fate}"
        entries.append(_missed_together(passed, now, message, with_latest=is_late))
    if again:
        message = "it had its run before the clock was put back"
        entries.append(Entry(outcome=Outcome.SKIPPED, slot=slot, at=now, message=message))
    elif slot is not None and not is_late:
        if under_way is not None and rules.overlap is Overlap.SKIP:
            message = f"{under_way} was still under way"
            entries.append(Entry(outcome=Outcome.SKIPPED, slot=slot, at=now, message=message))
        else:
            entries += miss_waiting(state, now, "a later slot took its place while it waited").entries
            waiting = slot
    if under_way is None:
        return Look(state=ScheduleState(decided_until=decided_until), entries=tuple(entries), due=waiting)
    if waiting != state.waiting:
        entries.append(Entry(outcome=Outcome.WAITING, slot=waiting, at=now, message=f"waits until {under_way} is over"))
    return Look(state=ScheduleState(decided_until=decided_until, waiting=waiting), entries=tuple(entries))


def _seconds(slot: dt.datetime, now: dt.datetime) -> float:
    """How long ago a slot was, by time and not by the wall: clocks are shifted."""
    return (now.astimezone(dt.UTC) - slot.astimezone(dt.UTC)).total_seconds()


def _note_put_back(state: ScheduleState, now: dt.datetime) -> Entry:
    """The entry about a clock that was put back."""
    message = (
        f"the clock was put back from {utc(state.decided_until)} or later to {utc(now)}: the schedule goes by the "
        "present clock, and times that had their run are not run again"
    )
    return Entry(outcome=Outcome.MISSED, slot=now, at=now, message=message)


def miss_passed(state: ScheduleState, rules: Rules, now: dt.datetime, message: str) -> Look:
    """Miss all slots that have passed and are not decided; the slot that waits goes on waiting."""
    passed = None if rules.is_paused else passed_slots(rules.cron, state.decided_until, now)
    entries = () if passed is None else (_missed_together(passed, now, message, with_latest=True),)
    after = dataclasses.replace(state, decided_until=decided_by(state, now))
    return Look(state=after, entries=entries)


def miss_waiting(state: ScheduleState, now: dt.datetime, message: str) -> Look:
    """Miss the slot that waits, if there is one."""
    if state.waiting is None:
        return Look(state=state)
    entry = Entry(outcome=Outcome.MISSED, slot=state.waiting, at=now, message=message)
    return Look(state=dataclasses.replace(state, waiting=None), entries=(entry,))


def _missed_together(passed: PassedSlots, now: dt.datetime, message: str, *, with_latest: bool) -> Entry:
    return Entry(
        outcome=Outcome.MISSED,
        slot=passed.latest if with_latest else passed.before_latest,
        first_slot=passed.first,
        slots=passed.earlier + with_latest,
        is_counted=passed.is_counted,
        at=now,
        message=message,
    )


def utc(at: dt.datetime) -> str:
    """A time in a message: ISO 8601 in UTC."""
    return at.astimezone(dt.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
