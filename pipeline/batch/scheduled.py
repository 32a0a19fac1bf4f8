"""The process that runs a batch at its times.

When a time is due, and what becomes of it, is told by `pipeline.schedule`; every run is a process of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from pipeline.batch.batch_file import Batch, read_batch
from pipeline.batch.schedule_state import NAME, Entry, Outcome, ScheduleState, iso, look, missed, read_schedule
from pipeline.errors import RunError, SettingsError
from pipeline.io import LocalStorage
from pipeline.runtime.monitoring.events import Event, EventKind, Listener, ignore
from pipeline.runtime.scratch.work_folder import held_lock, is_at_work, is_held, make_work, take_lock
from pipeline.schedule import Cron

LOCK, RUN_LOCK = "schedule.lock", "run.lock"
"""Files there that are held by whoever keeps the schedule, and by the run that it started."""
LONGEST_SLEEP_S = 30.0
"""The clock may be put forward, the batch file may change, a run by hand may end: it is looked after that long."""
_RUN_LOOK_S = 2.0
"""While a run is under way it is looked so often whether it is over."""
_END_LOOK_S = 0.2
"""The same of a run that was interrupted."""
_BEHIND_S = 0.05
"""A time is looked for a little after it, so that it has passed."""


_BY_CODE = {
    0: Outcome.RAN,
    1: Outcome.INCOMPLETE,
    **dict.fromkeys((130, 143, -signal.SIGINT, -signal.SIGTERM), Outcome.INTERRUPTED),
}
"""Exit codes of `gablework batch run`; all others failed."""


class Run(Protocol):
    """A run that was started."""

    def poll(self) -> int | None:
        """Its exit code; None while it is under way."""

    def send_signal(self, sig: int, /) -> None:
        """Have it end."""

    def wait(self) -> int:
        """Its exit code, when it is over."""


def start_run(batch: Batch, words: Sequence[str] = ()) -> Run:
    """Start a run as a process of its own.

    It is in a group of its own, so that an interrupt from the keyboard reaches it by us alone, and holds `RUN_LOCK`
    from its first moment on: whoever keeps the schedule after us knows of a run that outlived us. What it prints at
    its end is told by the report and the status.

    Parameters
    ----------
    batch : Batch
        What is run.
    words : sequence of str
        Further options of the command.
    """
    command = [sys.executable, "-m", "pipeline.cli", "batch", "run", str(batch.path), *words]
    lock = os.open(Path(batch.work_folder, RUN_LOCK), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        take_lock(lock)
        return subprocess.Popen(command, process_group=0, pass_fds=(lock,), stdout=subprocess.DEVNULL)  # noqa: S603
    finally:
        os.close(lock)


class Ending:
    """Tells that a schedule is to end; may be set by a signal's handler, also while somebody sleeps by it."""

    def __init__(self) -> None:
        self._times = 0
        self._reads, self._writes = os.pipe()
        for end in (self._reads, self._writes):
            os.set_blocking(end, False)

    def set(self) -> None:
        """End it; once more where that takes too long."""
        self._times += 1
        with contextlib.suppress(BlockingIOError):
            os.write(self._writes, b".")

    def is_set(self) -> bool:
        """Whether it is to end."""
        return self._times > 0

    def is_urgent(self) -> bool:
        """Whether that was said more than once."""
        return self._times > 1

    def wait(self, seconds: float) -> None:
        """Sleep until it is said that it is to end, or to end at once."""
        select.select([self._reads], [], [], seconds)
        with contextlib.suppress(BlockingIOError):
            os.read(self._reads, 1024)


def keep_schedule(
    path: str | Path,
    ending: Ending,
    on_event: Listener = ignore,
    start: Callable[[Batch], Run] = start_run,
    now: Callable[[], dt.datetime] = lambda: dt.datetime.now(tz=dt.UTC),
) -> None:
    """Run a batch at its times until it is to end.

    The run that is under way then is interrupted and waited for; where the end is asked for once more, it is killed.

    The batch file is read again before every look at the clock. Changed times count from the change on; while the
    file has faults nothing is run, and each time that passes is told as failed.

    Parameters
    ----------
    path : str or Path
        The batch file, with a table `[schedule]`.
    ending : Ending
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
        try:
            while not ending.is_set():
                keeper.step()
                ending.wait(keeper.sleep_s())
        finally:
            keeper.interrupt(ending)


def _scheduled(path: str | Path, folder: Path | None = None) -> Batch:
    """A batch that has times, and the work folder that it had."""
    batch = read_batch(path)
    if not batch.schedule.cron:
        raise SettingsError([f'[schedule] cron is missing in {path}: say when, such as cron = "30 2 * * *"'])
    if folder is not None and batch.work_folder != str(folder):
        raise SettingsError([f"[work] path is another folder than {folder}: start the schedule anew"])
    return batch


class _Keeper:
    """Looks at the clock for one batch."""

    def __init__(
        self, *, batch: Batch, listener: Listener, start: Callable[[Batch], Run], now: Callable[[], dt.datetime]
    ) -> None:
        self._batch, self._listener, self._start, self._now = batch, listener, start, now
        self._folder = Path(batch.work_folder)
        self._written = _written(batch.path)
        self._refused = ""
        self._run: Run | None = None
        self._began = ""
        self._state = ScheduleState(decided_until=now())
        self._on_disk: ScheduleState | None = None
        self._lock = contextlib.ExitStack()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the schedule, so that no other process runs it, too."""
        with self._lock:
            self._hold()
            state = self._state = read_schedule(str(self._folder)) or self._state
            if state.times not in {"", self._times}:  # changed while nobody looked: they count from now on
                if state.waiting is not None:
                    state = state.with_entry(missed(state.waiting, self._now(), "the times changed while it waited"))
                state = dataclasses.replace(state, decided_until=self._now(), waiting=None)
            self._put(dataclasses.replace(state, times=self._times))
            if self._batch.schedule.paused:
                self._tell("the schedule is paused")
            yield

    def _hold(self) -> None:
        """Hold the work folder's lock of schedules; the folder is made where it is not there."""
        self._lock.close()
        make_work(self._folder)
        self._lock.enter_context(held_lock(self._folder, LOCK))

    @property
    def _times(self) -> str:
        return f"{self._batch.schedule.cron} {self._batch.schedule.time_zone}"

    def step(self) -> None:
        """Look at the clock once."""
        now, state = self._now(), self._ended(self._state)
        before, written_at = self._batch.schedule, self._reread()
        table = self._batch.schedule
        is_busy = self._run is not None or is_at_work(str(self._folder)) or is_held(str(self._folder), RUN_LOCK)
        # what was cut off together with the process that kept the schedule goes first
        cut = None if is_busy or table.paused or self._refused else state.running
        is_taken, slot = is_busy or cut is not None, None
        if written_at is not None:
            # what passed before the file was written is decided by what it said then
            until = min(now, max(written_at, state.decided_until))
            state, slot = look(state, before, until, is_busy=is_taken)
        state, later = look(state, table, now, is_busy=is_taken or slot is not None)
        slot = slot or later
        if slot is not None and self._refused:
            state, slot = state.with_entry(self._failed(slot, f"the batch file is refused: {self._refused}")), None
        due = cut or slot
        state = dataclasses.replace(state, running=due or state.running, times=self._times)
        # a run that is not written down would be forgotten if we were killed; it is tried again at the next look
        if self._put(state) and due is not None:
            self._begin(due)

    def _begin(self, due: dt.datetime) -> None:
        self._began = str(iso(self._now()))
        self._tell(f"the run of {iso(due)} begins")
        try:
            self._run = self._start(self._batch)
        except OSError as error:
            entry = self._failed(due, f"it could not be started: {error}")
            self._put(dataclasses.replace(self._state.with_entry(entry), running=None))

    def _failed(self, slot: dt.datetime, message: str) -> Entry:
        return Entry(outcome=Outcome.FAILED, slot=iso(slot), at=str(iso(self._now())), message=message)

    def sleep_s(self) -> float:
        """How long nothing needs to be looked at."""
        longest = _RUN_LOOK_S if self._run is not None else LONGEST_SLEEP_S
        table = self._batch.schedule
        if table.paused:
            return longest
        now = self._now()
        left = (Cron(table.cron, table.time_zone).next_time(now) - now).total_seconds()
        return min(longest, max(left, 0.0) + _BEHIND_S)

    def interrupt(self, ending: Ending) -> None:
        """End the run that is under way; it goes on when the schedule is started again."""
        if self._run is not None:
            self._run.send_signal(signal.SIGINT)
            self._tell("the run is interrupted; one signal more kills it")
            while self._run.poll() is None and not ending.is_urgent():
                ending.wait(_END_LOOK_S)
            if self._run.poll() is None:
                self._run.send_signal(signal.SIGKILL)
                self._tell("the run is killed", "warning")
            self._run.wait()
            due, state = self._state.running, self._ended(self._state)
            # only what is known to be whole is not to be gone on with
            is_whole = state.entries[-1].outcome is Outcome.RAN
            self._put(dataclasses.replace(state, running=None if is_whole else due))

    def _ended(self, state: ScheduleState) -> ScheduleState:
        """With what became of the run, where it is over."""
        code = None if self._run is None else self._run.poll()
        if code is None:
            return state
        self._run = None
        outcome = _BY_CODE.get(code, Outcome.FAILED)
        entry = Entry(
            outcome=outcome,
            slot=iso(state.running),
            at=str(iso(self._now())),
            started_at=self._began,
            exit_code=code,
            message="" if outcome is Outcome.RAN else f"its exit code was {code}",
        )
        return dataclasses.replace(state.with_entry(entry), running=None)

    def _put(self, state: ScheduleState) -> bool:
        """Keep what is to be remembered, and tell what is new of it; whether it is written down.

        Up to when all times are decided is no news as long as none has passed, so it alone is not written.
        """
        before, self._state = self._state, state
        known = set(before.entries)
        for entry in state.entries:
            if entry not in known:
                many = "" if entry.slots == 1 else f" and {entry.slots - 1} before it"
                told = f"{entry.slot}{many}: {entry.outcome.value}"
                kind: EventKind = "run" if entry.outcome is Outcome.RAN else "warning"
                self._tell(f"{told}, {entry.message}" if entry.message else told, kind)
        last, paused = self._on_disk, self._batch.schedule.paused
        if last is not None and not paused and dataclasses.replace(state, decided_until=last.decided_until) == last:
            return True
        try:
            if not is_held(str(self._folder), LOCK):  # somebody removed the work folder
                self._hold()
            LocalStorage(root=self._folder).put(NAME, state.to_json().encode())
        except (OSError, RunError) as error:
            self._tell(f"{NAME} cannot be written, so no run is started: {error}", "warning")
            return False
        self._on_disk = state
        return True

    def _reread(self) -> dt.datetime | None:
        """Take the batch file's changes; when it was written, where it has any."""
        written = _written(self._batch.path)
        if written == self._written:
            return None
        self._written = written
        try:
            changed = _scheduled(self._batch.path, self._folder)
        except SettingsError as error:
            self._refused = str(error)
            self._tell(f"nothing is run as long as the batch file is refused: {error}", "warning")
            return None
        self._refused = ""
        if changed.schedule != self._batch.schedule:
            self._tell("the times changed")
        self._batch = changed
        return None if written is None else dt.datetime.fromtimestamp(written[0] / 1e9, tz=dt.UTC)

    def _tell(self, message: str, kind: EventKind = "run") -> None:
        self._listener(Event(kind=kind, stage="schedule", message=message))


def _written(path: Path) -> tuple[int, int] | None:
    """What changes where a file is written; None where it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
