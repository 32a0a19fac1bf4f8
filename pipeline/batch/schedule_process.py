"""The process that runs a batch at its times.

`pipeline.schedule` decides what is due and what becomes of it. Each run is a process of its own.
"""

from __future__ import annotations

import contextlib
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
from pipeline.batch.schedule_file import NAME, BatchEntry, FileBook, iso
from pipeline.errors import RunError, SettingsError
from pipeline.runtime.monitoring.progress import Event, EventKind, Listener, ignore
from pipeline.runtime.scratch.work_folder import is_at_work, is_locked, locked_file, make_work, take_lock
from pipeline.schedule import Entry, Look, Outcome, Rules, ScheduleState, enter, look, miss_waiting

LOCK, RUN_LOCK = "schedule.lock", "run.lock"
"""Files in the work folder, locked by the schedule's process and by the run that it started."""
LONGEST_SLEEP_S = 30.0
"""Longest time between two looks: the clock may be put forward, the batch file may change, a manual run may end."""
_RUN_LOOK_S = 2.0
"""Seconds between two looks at a run that is under way."""
_END_LOOK_S = 0.2
"""Seconds between two looks at a run that was interrupted."""
_BEHIND_S = 0.05
"""Seconds that a look comes after a slot, which has then passed for certain."""
_BY_CODE = {
    0: Outcome.RAN,
    1: Outcome.INCOMPLETE,
    **dict.fromkeys((130, 143, -signal.SIGINT, -signal.SIGTERM), Outcome.INTERRUPTED),
}
"""Outcomes by exit code of `gablework batch run`; other codes mean that it failed."""


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

    It has its own process group: an interrupt from the keyboard reaches it only through us. It holds `RUN_LOCK` from
    its first moment on: a later process of the schedule notices a run that outlived us. Its output is dropped, since
    the report and the status say the same.
    """
    command = [sys.executable, "-m", "pipeline.cli", "batch", "run", str(batch.path), *words]
    lock = os.open(Path(batch.work_folder, RUN_LOCK), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        take_lock(lock)
        return subprocess.Popen(command, process_group=0, pass_fds=(lock,), stdout=subprocess.DEVNULL)  # noqa: S603
    finally:
        os.close(lock)


class Ending:
    """A request to end the schedule. A signal handler may set it, also during `wait`."""

    def __init__(self) -> None:
        self._times = 0
        self._reads, self._writes = os.pipe()
        for end in (self._reads, self._writes):
            os.set_blocking(end, False)

    def set(self) -> None:
        """Request the end; a second time if it takes too long."""
        self._times += 1
        with contextlib.suppress(BlockingIOError):
            os.write(self._writes, b".")

    def is_set(self) -> bool:
        """Whether the end was requested."""
        return self._times > 0

    def is_urgent(self) -> bool:
        """Whether it was requested more than once."""
        return self._times > 1

    def wait(self, seconds: float) -> None:
        """Sleep until the end is requested, or the seconds are over."""
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
    """Run a batch on its schedule until the end is requested.

    The run that is under way then is interrupted and waited for; a second request kills it.

    The batch file is read again before every look at the clock. Changed times count from the change on. While the
    file has faults nothing is run, and each slot that passes fails.

    Parameters
    ----------
    path : str or Path
        The batch file, with a table `[schedule]`.
    ending : Ending
        Ends it when set.
    on_event : callable
        Gets an `Event` for each entry of the history.

    Raises
    ------
    SettingsError
        The batch file has faults, or no times.
    RunError
        Another process runs this schedule, or the work folder cannot be used.
    """
    scheduler = _Scheduler(batch=_scheduled(path), listener=on_event, start=start, now=now)
    with scheduler.held():
        try:
            while not ending.is_set():
                scheduler.step()
                ending.wait(scheduler.sleep_s())
        finally:
            scheduler.interrupt(ending)


def _scheduled(path: str | Path, folder: Path | None = None) -> Batch:
    """Read a batch that must have times, and the same work folder as before."""
    batch = read_batch(path)
    if not batch.schedule.cron:
        raise SettingsError([f'[schedule] cron is missing in {path}: say when, such as cron = "30 2 * * *"'])
    if folder is not None and batch.work_folder != str(folder):
        raise SettingsError([f"[work] path is another folder than {folder}: start the schedule anew"])
    return batch


class _Scheduler:
    """Looks at the clock for one batch."""

    def __init__(
        self, *, batch: Batch, listener: Listener, start: Callable[[Batch], Run], now: Callable[[], dt.datetime]
    ) -> None:
        self._batch, self._listener, self._start, self._now = batch, listener, start, now
        self._folder = Path(batch.work_folder)
        self._written = _written(batch.path)
        self._refused = ""
        self._run: Run | None = None
        self._began: dt.datetime | None = None
        self._lock = contextlib.ExitStack()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the schedule, which excludes other processes from running it."""
        with self._lock:
            self._hold()
            now = self._now()
            self._book = FileBook(self._folder, now)
            if self._book.record.times not in {"", self._times}:
                # changed while no process ran: the new times count from now on
                self._enter(miss_waiting(self._book.state, now, "the times changed while it waited"))
                self._book.state = ScheduleState(decided_until=now)
            self._book.change(times=self._times)
            self._save()
            if self._rules.is_paused:
                self._report("the schedule is paused")
            yield

    def _hold(self) -> None:
        """Hold the work folder's lock for schedules. The folder is made if it does not exist."""
        self._lock.close()
        make_work(self._folder)
        self._lock.enter_context(locked_file(self._folder, LOCK))

    @property
    def _rules(self) -> Rules:
        return self._batch.schedule.rules

    @property
    def _times(self) -> str:
        return f"{self._batch.schedule.cron} {self._batch.schedule.time_zone}"

    def step(self) -> None:
        """Look at the clock once."""
        now, book = self._now(), self._book
        self._note_end(now)
        before, written_at = self._rules, self._reread()
        rules = self._rules
        is_busy = self._run is not None or is_at_work(str(self._folder)) or is_locked(str(self._folder), RUN_LOCK)
        # a run that was cut off together with the schedule's process goes first
        cut = None if is_busy or rules.is_paused or self._refused else book.record.running
        under_way, slot = "a run" if is_busy or cut is not None else None, None
        if written_at is not None:
            # slots before the change of the file are decided by the old rules
            until = min(now, max(written_at, book.state.decided_until))
            slot = self._enter(look(book.state, before, until, under_way=under_way, has_run=book.has_run))
        under_way = under_way if slot is None else "a run"
        slot = self._enter(look(book.state, rules, now, under_way=under_way, has_run=book.has_run)) or slot
        if slot is not None and self._refused:
            self._fail(slot, now, f"the batch file is refused: {self._refused}")
            slot = None
        due = cut or slot
        book.change(running=due or book.record.running, times=self._times)
        # without a record of it the run would be forgotten if we were killed; the next look tries again
        if self._save() and due is not None:
            self._begin(due)

    def _begin(self, due: dt.datetime) -> None:
        self._began = self._now()
        self._report(f"the run of {iso(due)} begins")
        try:
            self._run = self._start(self._batch)
        except OSError as error:
            self._fail(due, self._now(), f"it could not be started: {error}")
            self._book.change(running=None)
            self._save()

    def _enter(self, found: Look) -> dt.datetime | None:
        """Enter a look's result and report it; the slot to run now."""
        for entry in found.entries:
            self._report_entry(entry)
        return enter(self._book, found)

    def _fail(self, slot: dt.datetime, now: dt.datetime, message: str) -> None:
        self._add(BatchEntry(outcome=Outcome.FAILED, slot=slot, at=now, message=message))

    def _add(self, entry: BatchEntry) -> None:
        self._book.add(entry)
        self._report_entry(entry)

    def sleep_s(self) -> float:
        """Seconds until the next look."""
        longest = _RUN_LOOK_S if self._run is not None else LONGEST_SLEEP_S
        rules = self._rules
        if rules.is_paused:
            return longest
        now = self._now()
        left = (rules.cron.next_time(now) - now).total_seconds()
        return min(longest, max(left, 0.0) + _BEHIND_S)

    def interrupt(self, ending: Ending) -> None:
        """End the run that is under way; it continues when the schedule is started again."""
        if self._run is not None:
            self._run.send_signal(signal.SIGINT)
            self._report("the run is interrupted; one signal more kills it")
            while self._run.poll() is None and not ending.is_urgent():
                ending.wait(_END_LOOK_S)
            if self._run.poll() is None:
                self._run.send_signal(signal.SIGKILL)
                self._report("the run is killed", "warning")
            self._run.wait()
            due = self._book.record.running
            self._note_end(self._now())
            # only a run that is complete does not continue
            is_complete = self._book.record.entries[-1].outcome is Outcome.RAN
            self._book.change(running=None if is_complete else due)
            self._save()

    def _note_end(self, now: dt.datetime) -> None:
        """Enter what became of the run, if it is over."""
        code = None if self._run is None else self._run.poll()
        if code is None:
            return
        self._run = None
        outcome = _BY_CODE.get(code, Outcome.FAILED)
        self._add(
            BatchEntry(
                outcome=outcome,
                slot=self._book.record.running,
                at=now,
                started_at=self._began,
                exit_code=code,
                message="" if outcome is Outcome.RAN else f"its exit code was {code}",
            )
        )
        self._book.change(running=None)

    def _save(self) -> bool:
        """Write the book if it changed; whether the file is up to date."""
        if not self._rules.is_paused and not self._book.is_changed:
            return True
        try:
            if not is_locked(str(self._folder), LOCK):  # the work folder was removed
                self._hold()
            self._book.save()
        except (OSError, RunError) as error:
            self._report(f"{NAME} cannot be written, so no run is started: {error}", "warning")
            return False
        return True

    def _reread(self) -> dt.datetime | None:
        """Read the batch file again if it changed; the time of the change, or None."""
        written = _written(self._batch.path)
        if written == self._written:
            return None
        self._written = written
        try:
            changed = _scheduled(self._batch.path, self._folder)
        except SettingsError as error:
            self._refused = str(error)
            self._report(f"nothing is run as long as the batch file is refused: {error}", "warning")
            return None
        self._refused = ""
        if changed.schedule != self._batch.schedule:
            self._report("the times changed")
        self._batch = changed
        return None if written is None else dt.datetime.fromtimestamp(written[0] / 1e9, tz=dt.UTC)

    def _report_entry(self, entry: Entry) -> None:
        many = "" if entry.slots == 1 else f" and {entry.slots - 1} before it"
        reason = entry.message and f", {entry.message}"
        is_fine = entry.outcome in {Outcome.RAN, Outcome.WAITING}
        self._report(f"{iso(entry.slot)}{many}: {entry.outcome}{reason}", "run" if is_fine else "warning")

    def _report(self, message: str, kind: EventKind = "run") -> None:
        self._listener(Event(kind=kind, stage="schedule", message=message))


def _written(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, which change when it is written; None if it does not exist."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
