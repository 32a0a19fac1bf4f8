"""The state and history of a batch's schedule, in a file in its work folder."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import RunError
from pipeline.io import LocalStorage
from pipeline.schedule import Entry, Outcome, ScheduleState

NAME = "schedule.json"
"""The file."""
MAX_KEPT = 500
"""Entries that are stored; the counts include all."""

_TIMES = ("slot", "first_slot", "at", "started_at")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchEntry(Entry):
    """An entry in the history of a batch's schedule."""

    started_at: dt.datetime | None = None
    """Start of its run; None if it had none."""
    exit_code: int | None = None
    """Exit code of its run."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleRecord:
    """The content of the file."""

    state: ScheduleState
    """Which slots are decided, and which one waits."""
    running: dt.datetime | None = None
    """The slot whose run is under way, or was cut off together with the schedule's process."""
    times: str = ""
    """Cron expression and time zone of these slots."""
    counts: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Slots by outcome."""
    entries: tuple[BatchEntry, ...] = ()
    """The newest entries, in order."""

    def with_entry(self, entry: BatchEntry) -> ScheduleRecord:
        """Add an entry; the final one of a slot that waited replaces its entry `WAITING`."""
        entries = [one for one in self.entries if one.outcome is not Outcome.WAITING or one.slot != entry.slot]
        counts = dict(self.counts)
        if entry.outcome is not Outcome.WAITING:
            counts[entry.outcome.value] = counts.get(entry.outcome.value, 0) + entry.slots
        return dataclasses.replace(self, counts=counts, entries=(*entries, entry)[-MAX_KEPT:])

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "decided_until": iso(self.state.decided_until),
            "waiting": iso(self.state.waiting),
            "running": iso(self.running),
            "times": self.times,
            "counts": dict(self.counts),
            "entries": [vars(entry) | {name: iso(getattr(entry, name)) for name in _TIMES} for entry in self.entries],
        }

    @classmethod
    def from_dict(cls, found: Mapping[str, Any]) -> ScheduleRecord:
        """The opposite of `as_dict`."""
        try:
            until, waiting, running = (_time(found[name]) for name in ("decided_until", "waiting", "running"))
            if until is None:
                raise ValueError("decided_until is null")
            return cls(
                state=ScheduleState(decided_until=until, waiting=waiting),
                running=running,
                times=found.get("times", ""),
                counts=dict(found["counts"]),
                entries=tuple(_entry(entry) for entry in found["entries"]),
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error


class FileBook:
    """The `ScheduleBook` of a batch.

    Parameters
    ----------
    now : datetime
        A new schedule begins here.

    Raises
    ------
    RunError
        The file cannot be read.
    """

    def __init__(self, folder: Path, now: dt.datetime) -> None:
        self._folder = folder
        self._stored: ScheduleRecord | None = None
        self.record = read_schedule(str(folder)) or ScheduleRecord(state=ScheduleState(decided_until=now))

    @property
    def state(self) -> ScheduleState:
        """Which slots are decided, and which one waits."""
        return self.record.state

    @state.setter
    def state(self, state: ScheduleState) -> None:
        self.change(state=state)

    def change(self, **values: Any) -> None:
        """Change fields of the record."""
        self.record = dataclasses.replace(self.record, **values)

    def add(self, entry: Entry) -> None:
        """Add to the history and count it."""
        self.record = self.record.with_entry(entry if isinstance(entry, BatchEntry) else BatchEntry(**vars(entry)))

    def has_run(self, slot: dt.datetime) -> bool:
        """Whether the history has a run of a slot; also one that failed once it had begun."""
        over = {Outcome.RAN, Outcome.INCOMPLETE}
        return any(
            entry.slot == slot and (entry.outcome in over or entry.started_at is not None)
            for entry in self.record.entries
        )

    @property
    def is_changed(self) -> bool:
        """Whether more changed since this process stored the record than that no slot has passed."""
        stored = self._stored
        if stored is None:
            return True
        state = dataclasses.replace(self.state, decided_until=stored.state.decided_until)
        return dataclasses.replace(self.record, state=state) != stored

    def save(self) -> None:
        """Write the file."""
        content = json.dumps(self.record.as_dict(), indent=1) + "\n"
        LocalStorage(root=self._folder).put(NAME, content.encode())
        self._stored = self.record


def read_schedule(work_folder: str) -> ScheduleRecord | None:
    """The schedule of a batch, None if it never ran on a schedule; raises RunError if the file cannot be read."""
    path = Path(work_folder, NAME)
    try:
        return ScheduleRecord.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise RunError(
            f"{path} cannot be read: {error}. Remove it to begin anew; times until then are not known"
        ) from error


def iso(time: dt.datetime | None) -> str | None:
    """A time as it is stored: ISO 8601 in UTC."""
    return None if time is None else time.astimezone(dt.UTC).isoformat(timespec="seconds")


def _time(text: str | None) -> dt.datetime | None:
    time = None if text is None else dt.datetime.fromisoformat(text)
    if time is not None and time.tzinfo is None:
        raise ValueError(f"{text} has no time zone")
    return time


def _entry(found: Mapping[str, Any]) -> BatchEntry:
    times = {name: _time(found.get(name)) for name in _TIMES}
    return BatchEntry(**{**found, **times, "outcome": Outcome(found["outcome"])})
