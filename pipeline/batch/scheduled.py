"""A batch that runs at its times: what its process remembers of them, and the process itself.

When a time is due, and what becomes of it, is told by `pipeline.schedule`; every run is a process of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from pipeline.batch.batch_file import Batch, ScheduleTable, read_batch
from pipeline.errors import RunError, SettingsError
from pipeline.io import LocalStorage
from pipeline.runtime.events import Event, EventKind, Listener, ignore
from pipeline.runtime.work_folder import held_lock, is_held, make_work
from pipeline.schedule import Cron, Missed, Overlap, PassedSlots, decide, passed_slots

NAME = "schedule.json"
"""File in the work folder: up to when all times are decided, what became of them, and of the runs."""
LOCK = "schedule.lock"
KEPT = 500
"""Entries that are remembered; the counts go on."""
LONGEST_SLEEP_S = 30.0
"""The clock may be put forward, the batch file may change, a run by hand may end: it is looked after that long."""
_RUN_LOOK_S = 2.0
"""While a run is under way it is looked so often whether it is over."""
_BEHIND_S = 0.05
"""A time is looked for a little after it, so that it has passed."""


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


_BY_CODE = {0: Outcome.RAN, 1: Outcome.INCOMPLETE, 130: Outcome.INTERRUPTED, -signal.SIGINT: Outcome.INTERRUPTED}
"""Exit codes of `gablework batch run`; all others failed."""


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
            told[name] = _iso(getattr(self, name))
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
            return cls(
                decided_until=until,
                waiting=_time(told["waiting"]),
                running=_time(told["running"]),
                counts=told["counts"],
                entries=entries,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error


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
            state = state.with_entry(_missed(state.waiting, now, "the schedule was paused while it waited"))
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
        state = state.with_entry(_missed(decision.late, now, "it was seen too late"))
    if decision.replaced is not None:
        state = state.with_entry(_missed(decision.replaced, now, "a later time took its place while it waited"))
    if decision.skipped is not None:
        message = "a run was still under way"
        entry = Entry(outcome=Outcome.SKIPPED, slot=_iso(decision.skipped), at=str(_iso(now)), message=message)
        state = state.with_entry(entry)
    # a clock that was put back brings no time a second time
    return dataclasses.replace(state, decided_until=max(now, state.decided_until), waiting=decision.waits), decision.run


def _missed(slot: dt.datetime, now: dt.datetime, message: str) -> Entry:
    return Entry(outcome=Outcome.MISSED, slot=_iso(slot), at=str(_iso(now)), message=message)


def _missed_before(passed: PassedSlots, now: dt.datetime) -> Entry:
    return Entry(
        outcome=Outcome.MISSED,
        slot=_iso(passed.before_latest),
        slots=passed.earlier,
        is_counted=passed.is_counted,
        at=str(_iso(now)),
        message=f"nobody looked from {_iso(passed.first)} on",
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


class Run(Protocol):
    """A run that was started."""

    def poll(self) -> int | None:
        """Its exit code; None while it is under way."""

    def send_signal(self, sig: int, /) -> None:
        """Have it end."""

    def wait(self) -> int:
        """Its exit code, when it is over."""


def start_run(batch: Batch) -> Run:
    """Start a run as a process of its own, in its own group: an interrupt from the keyboard reaches it by us alone."""
    command = [sys.executable, "-m", "pipeline.cli", "batch", "run", str(batch.path)]
    return subprocess.Popen(command, process_group=0)  # noqa: S603 -- our own interpreter and program


def keep_schedule(
    path: str | Path,
    ending: threading.Event,
    on_event: Listener = ignore,
    start: Callable[[Batch], Run] = start_run,
    now: Callable[[], dt.datetime] = lambda: dt.datetime.now(tz=dt.UTC),
) -> None:
    """Run a batch at its times until it is to end; the run that is under way then is interrupted and waited for.

    The batch file is read again before every look at the clock: changed times count from the look before on, and a
    file with faults changes nothing.

    Parameters
    ----------
    path : str or Path
        The batch file, with a table `[schedule]`.
    ending : threading.Event
        Set by others where it is to end.
    on_event : callable
        Gets an `Event` for what becomes of each time.
    start : callable
        Starts a run.
    now : callable
        The time of day with a time zone.

    Raises
    ------
    SettingsError
        The batch file has faults, or no times.
    RunError
        Another process runs this schedule, or the work folder cannot be used.
    """
    keeper = _Keeper(batch=_scheduled(path), listener=on_event, start=start, now=now)
    with keeper.held():
        while not ending.is_set():
            keeper.step()
            ending.wait(keeper.sleep_s())
        keeper.interrupt()


def _scheduled(path: str | Path) -> Batch:
    """A batch that has times."""
    batch = read_batch(path)
    if not batch.schedule.cron:
        raise SettingsError([f'[schedule] cron is missing in {path}: say when, such as cron = "30 2 * * *"'])
    return batch


class _Keeper:
    """Looks at the clock for one batch."""

    def __init__(
        self, *, batch: Batch, listener: Listener, start: Callable[[Batch], Run], now: Callable[[], dt.datetime]
    ) -> None:
        self._batch, self._listener, self._start, self._now = batch, listener, start, now
        self._folder = Path(batch.work_folder)
        self._written = _written(batch.path)
        self._run: Run | None = None
        self._began = ""
        self._state = ScheduleState(decided_until=now())

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the schedule, so that no other process runs it, too."""
        make_work(self._folder)
        with held_lock(self._folder, LOCK):
            self._state = read_schedule(str(self._folder)) or self._state
            self._save(self._state)
            if self._batch.schedule.paused:
                self._tell("the schedule is paused")
            yield

    def step(self) -> None:
        """Look at the clock once."""
        self._reread()
        now, state = self._now(), self._ended(self._state)
        is_busy = self._run is not None or is_held(str(self._folder))
        due = None if is_busy else state.running  # cut off together with the process that kept the schedule
        is_busy = is_busy or due is not None
        state, slot = look(state, self._batch.schedule, now, is_busy=is_busy)
        due = due or slot
        self._save(dataclasses.replace(state, running=due or state.running))
        if due is not None:
            self._began = str(_iso(now))
            self._tell(f"the run of {_iso(due)} begins")
            self._run = self._start(self._batch)

    def sleep_s(self) -> float:
        """How long nothing needs to be looked at."""
        longest = _RUN_LOOK_S if self._run is not None else LONGEST_SLEEP_S
        table = self._batch.schedule
        if table.paused:
            return longest
        now = self._now()
        left = (Cron(table.cron, table.time_zone).next_time(now) - now).total_seconds()
        return min(longest, max(left, 0.0) + _BEHIND_S)

    def interrupt(self) -> None:
        """End the run that is under way; it goes on when the schedule is started again."""
        if self._run is not None:
            self._tell("the run is interrupted")
            self._run.send_signal(signal.SIGINT)
            self._run.wait()
            due, state = self._state.running, self._ended(self._state)
            was_cut = state.entries[-1].outcome is Outcome.INTERRUPTED
            self._save(dataclasses.replace(state, running=due if was_cut else None))

    def _ended(self, state: ScheduleState) -> ScheduleState:
        """With what became of the run, where it is over."""
        code = None if self._run is None else self._run.poll()
        if code is None:
            return state
        self._run = None
        outcome = _BY_CODE.get(code, Outcome.FAILED)
        entry = Entry(
            outcome=outcome,
            slot=_iso(state.running),
            at=str(_iso(self._now())),
            started_at=self._began,
            exit_code=code,
            message="" if outcome is Outcome.RAN else f"its exit code was {code}",
        )
        return dataclasses.replace(state.with_entry(entry), running=None)

    def _save(self, state: ScheduleState) -> None:
        """Write what is to be remembered, and tell what is new of it."""
        before = self._state.entries
        self._state = state
        LocalStorage(root=self._folder).put(NAME, state.to_json().encode())
        known = set(before)
        for entry in state.entries:
            if entry not in known:
                many = "" if entry.slots == 1 else f" and {entry.slots - 1} before it"
                told = f"{entry.slot}{many}: {entry.outcome.value}"
                kind: EventKind = "run" if entry.outcome is Outcome.RAN else "warning"
                self._tell(f"{told}, {entry.message}" if entry.message else told, kind)

    def _reread(self) -> None:
        """Take the batch file's changes: new times count from the last look at the clock on."""
        written = _written(self._batch.path)
        if written == self._written:
            return
        self._written = written
        try:
            changed = _scheduled(self._batch.path)
        except SettingsError as error:
            self._tell(f"the changed batch file is not used: {error}", "warning")
            return
        if changed.work_folder != str(self._folder):
            self._tell("the changed batch file is not used: it names another work folder. Start anew", "warning")
            return
        if changed.schedule != self._batch.schedule:
            self._tell("the times changed")
        self._batch = changed

    def _tell(self, message: str, kind: EventKind = "run") -> None:
        self._listener(Event(kind=kind, stage="schedule", message=message))


def _written(path: Path) -> tuple[int, int] | None:
    """What changes where a file is written; None where it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _iso(time: dt.datetime | None) -> str | None:
    return None if time is None else time.astimezone(dt.UTC).isoformat(timespec="seconds")


def _time(text: str | None) -> dt.datetime | None:
    return None if text is None else dt.datetime.fromisoformat(text)
