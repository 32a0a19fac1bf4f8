"""A batch that runs at its times: no two runs overlap, and an end forgets nothing."""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import os
import shutil
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from schedule_contract import HOUR, NOON, ScheduleContract, StoredSchedule

from pipeline.batch import schedule_file, schedule_process
from pipeline.batch.batch_file import Batch, read_batch
from pipeline.batch.schedule_file import MAX_KEPT, NAME, FileBook, ScheduleRecord, read_schedule
from pipeline.batch.schedule_process import LOCK, RUN_LOCK, Ending, keep_schedule
from pipeline.errors import RunError, SettingsError
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.scratch.work_folder import locked_file, locked_work, make_work
from pipeline.schedule import Entry, Outcome, ScheduleState

AT = dt.datetime(2026, 3, 1, 2, 0, tzinfo=dt.UTC)
FILE = '[inputs]\npaths = ["tiles"]\n[output]\npath = "models"\n[schedule]\ncron = "0 * * * *"\n'


class InFile:
    """A schedule in a work folder, for the contract that all storages of schedules meet."""

    done, max_kept = Outcome.RAN, MAX_KEPT

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @contextlib.contextmanager
    def opened(self) -> Iterator[FileBook]:
        yield FileBook(self._folder, NOON)

    def run(self, book: FileBook, slot: dt.datetime, now: dt.datetime) -> None:
        book.add(Entry(outcome=self.done, slot=slot, at=now))

    def entries(self) -> list[Entry]:
        return list(FileBook(self._folder, NOON).record.entries)

    def counts(self) -> Mapping[str, int]:
        return FileBook(self._folder, NOON).record.counts


class TestScheduleInAFile(ScheduleContract):
    """All of the contract, on a file."""

    @pytest.fixture
    def schedule(self, tmp_path: Path) -> StoredSchedule:
        return InFile(tmp_path)


def test_a_file_of_an_earlier_version_is_read_and_continued(tmp_path: Path) -> None:
    """That version had no `first_slot`, and no entry for a slot that waits."""
    entry = {"slots": 1, "is_counted": True, "started_at": None, "exit_code": None, "message": ""}
    missed = entry | {"outcome": "missed", "slot": "2030-06-01T12:00:00+00:00", "at": "2030-06-01T14:00:05+00:00"}
    written = {
        "decided_until": "2030-06-01T14:00:05+00:00",
        "waiting": "2030-06-01T14:00:00+00:00",
        "running": "2030-06-01T13:00:00+00:00",
        "times": "0 * * * * UTC",
        "counts": {"missed": 1},
        "entries": [missed],
    }
    (tmp_path / NAME).write_text(json.dumps(written))
    book = FileBook(tmp_path, NOON)
    assert book.state == ScheduleState(decided_until=NOON + dt.timedelta(hours=2, seconds=5), waiting=NOON + 2 * HOUR)
    assert (book.record.running, book.record.entries[0].slot) == (NOON + HOUR, NOON)
    assert book.record.as_dict() == written | {"entries": [missed | {"first_slot": None}]}
    book.add(Entry(outcome=Outcome.MISSED, slot=NOON + 2 * HOUR, at=NOON + 2 * HOUR))
    book.save()
    assert FileBook(tmp_path, NOON).record == book.record


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        ({"running": "2026-03-01T02:00:00"}, "time zone"),
        ({"counts": 7}, "not iterable"),
        ({"entries": [{"outcome": "lost"}]}, "'lost'"),
        ({"entries": None}, "not iterable"),
        ({"decided_until": None}, "decided_until"),
    ],
)
def test_a_damaged_file_is_named(file: Path, damage: dict[str, object], reason: str) -> None:
    work = file.with_suffix(".work")
    make_work(work)
    written = ScheduleRecord(state=ScheduleState(decided_until=AT)).as_dict()
    (work / NAME).write_text(json.dumps(written | damage))
    with pytest.raises(RunError, match=rf"schedule\.json cannot be read: .*{reason}.*Remove it to begin anew"):
        gone(file)


# --- the process


class FakeRun:
    """A run of which the test says when it is over."""

    def __init__(self) -> None:
        self.code: int | None = None
        self.ends_with = 130
        self.signals: list[int] = []

    def poll(self) -> int | None:
        return self.code

    def send_signal(self, sig: int, /) -> None:
        self.signals.append(sig)
        self.code = self.ends_with

    def wait(self) -> int:
        assert self.code is not None
        return self.code


class Days(Ending):
    """A clock that goes on while the schedule sleeps, and does at each look what the test says."""

    def __init__(self, steps: Sequence[Step] = (), at: dt.datetime = AT - HOUR / 2) -> None:
        super().__init__()
        self.time, self._steps = at, list(steps)
        self.runs: list[FakeRun] = []
        self.events: list[Event] = []

    def now(self) -> dt.datetime:
        return self.time

    def start(self, batch: Batch) -> FakeRun:
        assert batch.schedule.cron
        self.runs.append(FakeRun())
        return self.runs[-1]

    def wait(self, seconds: float) -> None:
        assert 0.0 < seconds <= schedule_process.LONGEST_SLEEP_S
        if self._steps:
            self._steps.pop(0)(self)
        else:
            self.set()

    def go(self, path: Path) -> None:
        keep_schedule(path, self, self.events.append, self.start, self.now)

    def later(self, hours: float) -> None:
        self.time += hours * HOUR


Step = Callable[[Days], Any]


def passes(hours: float) -> Step:
    return lambda days: days.later(hours)


def ends(code: int) -> Step:
    """The latest run ends by itself."""
    return lambda days: setattr(days.runs[-1], "code", code)


def write(file: Path, text: str) -> Step:
    """Change the batch file at the clock's time."""

    def change(days: Days) -> None:
        file.write_text(text)
        os.utime(file, ns=(0, round(days.time.timestamp()) * 10**9))

    return change


def gone(file: Path, *steps: Step, at: dt.datetime = AT - HOUR / 2, kind: type[Days] = Days) -> Days:
    """The days after these steps and the end of the process."""
    days = kind(steps, at)
    days.go(file)
    return days


LATER = AT + HOUR / 4


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "city.toml"
    path.write_text(FILE)
    return path


def record_of(file: Path) -> ScheduleRecord:
    state = read_schedule(str(file.with_suffix(".work")))
    assert state is not None
    return state


def test_runs_follow_one_another_and_are_recorded_with_their_codes(file: Path) -> None:
    days = gone(file, passes(0.5), ends(0), passes(1.0), ends(1), passes(1.0), ends(4))
    outcomes = [entry.outcome for entry in record_of(file).entries]
    assert outcomes == [Outcome.RAN, Outcome.INCOMPLETE, Outcome.FAILED]
    assert record_of(file).counts == {"ran": 1, "incomplete": 1, "failed": 1}
    kinds = Counter(event.kind for event in days.events)
    assert kinds == {"run": 4, "warning": 2}


def test_an_end_interrupts_the_run_and_the_next_start_goes_on(file: Path) -> None:
    days = gone(file, passes(0.5))
    assert days.runs[0].signals == [signal.SIGINT]
    assert [entry.outcome for entry in record_of(file).entries] == [Outcome.INTERRUPTED]
    assert record_of(file).running == AT
    again = gone(file, ends(0), at=LATER)
    assert len(again.runs) == 1
    assert (record_of(file).running, record_of(file).counts) == (None, {"interrupted": 1, "ran": 1})


def test_a_run_by_hand_is_not_overlapped(file: Path) -> None:
    with locked_work(str(file.with_suffix(".work"))):
        days = gone(file, passes(0.5), passes(1.0))
    assert (days.runs, record_of(file).counts) == ([], {"skipped": 2})


def test_a_second_process_is_refused(file: Path) -> None:
    work = file.with_suffix(".work")
    make_work(work)
    with locked_file(work, LOCK), pytest.raises(RunError, match="is at work already"):
        gone(file)


def test_times_before_a_change_are_decided_by_the_old_ones_later_ones_by_the_new(file: Path) -> None:
    os.utime(file, ns=(0, 0))
    changed = write(file, FILE.replace("0 *", "58 *"))
    paused = write(file, FILE.replace("0 *", "50 *") + "paused = true\n")
    # the first change is at 01:57
    gone(file, passes(0.45), changed, passes(0.1), ends(0), passes(1.0), ends(0), paused, passes(2.0))
    slots = [entry.slot for entry in record_of(file).entries]
    assert slots == [AT - HOUR / 30, AT + HOUR * 29 / 30]


def test_a_time_that_was_overslept_counts_by_what_the_file_said_then(file: Path) -> None:
    os.utime(file, ns=(0, 0))

    def overslept(days: Days) -> None:
        days.later(0.75)  # from 01:30 to 02:15, and the file is written then
        write(file, FILE.replace("0 *", "10 *"))(days)

    gone(file, overslept, ends(0))
    assert [entry.slot for entry in record_of(file).entries] == [AT]


def test_other_times_of_a_schedule_that_was_down_count_from_its_start_on(file: Path) -> None:
    gone(file)
    file.write_text(FILE.replace("0 *", "45 *"))
    days = gone(file, at=AT)
    assert (days.runs, record_of(file).entries) == ([], ())


def test_a_broken_file_runs_nothing_and_fails_every_slot_until_it_is_fixed(file: Path) -> None:
    wrong = write(file, FILE.replace("0 *", "77 *"))
    elsewhere = write(file, FILE + '[work]\npath = "elsewhere"\n')
    gone(file, wrong, passes(0.5), elsewhere, passes(1.0), write(file, FILE), passes(1.0), ends(0))
    assert [(entry.outcome, entry.slot) for entry in record_of(file).entries] == [
        (Outcome.FAILED, AT),
        (Outcome.FAILED, AT + HOUR),
        (Outcome.RAN, AT + 2 * HOUR),
    ]
    assert "its minute is '77'" in record_of(file).entries[0].message
    assert "[work] path is another folder" in record_of(file).entries[1].message


def test_a_paused_schedule_goes_on_with_a_run_that_was_cut_off_only_when_it_is_resumed(file: Path) -> None:
    gone(file, passes(0.5))
    file.write_text(FILE + "paused = true\n")
    paused = gone(file)
    assert (paused.runs, record_of(file).running) == ([], AT)
    file.write_text(FILE)
    again = gone(file, ends(0), at=LATER)
    assert (len(again.runs), record_of(file).running) == (1, None)


@pytest.mark.parametrize(("code", "goes_on"), [(0, False), (1, True), (4, True), (130, True), (-15, True), (143, True)])
def test_only_a_run_that_is_whole_is_not_gone_on_with(file: Path, code: int, goes_on: bool) -> None:
    gone(file, passes(0.5), lambda days: setattr(days.runs[0], "ends_with", code))
    assert (record_of(file).running is not None) is goes_on


def test_a_full_disk_starts_nothing_and_ends_nothing(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = schedule_file.LocalStorage.put

    def full(self: object, key: str, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    def puts_by(put: Any) -> Step:
        return lambda _: monkeypatch.setattr(schedule_file.LocalStorage, "put", put)

    days = gone(file, puts_by(full), passes(0.5), passes(0.1), puts_by(real), ends(0))
    assert [(entry.outcome, entry.slot) for entry in record_of(file).entries] == [(Outcome.RAN, AT)]
    assert any("cannot be written, so no run is started" in event.message for event in days.events)


def test_a_run_that_cannot_be_started_is_recorded(file: Path) -> None:
    class Poor(Days):
        def start(self, batch: Batch) -> FakeRun:
            assert batch.schedule.cron
            raise OSError(12, "Cannot allocate memory")

    gone(file, passes(0.5), kind=Poor)
    (entry,) = record_of(file).entries
    assert (entry.outcome, "Cannot allocate memory" in entry.message) == (Outcome.FAILED, True)


def test_a_run_that_outlived_the_process_before_is_waited_for(file: Path) -> None:
    gone(file, passes(0.5))
    with locked_file(file.with_suffix(".work"), RUN_LOCK):
        again = gone(file, at=LATER)
    assert (again.runs, record_of(file).running) == ([], AT)


def test_a_run_that_does_not_end_is_killed_by_a_second_request(file: Path) -> None:
    class Deaf(FakeRun):
        def send_signal(self, sig: int, /) -> None:
            self.signals.append(sig)
            self.code = -sig if sig == signal.SIGKILL else None

    class Hasty(Days):
        def start(self, batch: Batch) -> FakeRun:
            assert batch.schedule.cron
            self.runs.append(Deaf())
            return self.runs[-1]

    days = gone(file, passes(0.5), Days.set, lambda _: None, kind=Hasty)
    assert days.runs[0].signals == [signal.SIGINT, signal.SIGKILL]
    assert record_of(file).running == AT


def test_a_work_folder_that_is_removed_is_made_and_held_again(file: Path) -> None:
    work = file.with_suffix(".work")

    def second(_: Days) -> None:
        with pytest.raises(RunError, match="is at work already"), locked_file(work, LOCK):
            pass

    gone(file, lambda _: shutil.rmtree(work), passes(0.5), second, ends(0))
    assert record_of(file).counts == {"ran": 1}
    with locked_work(str(work)):
        pass  # a run of the batch takes it for a work folder


def test_a_time_that_waited_is_missed_if_the_times_changed_meanwhile(file: Path) -> None:
    file.write_text(FILE + 'overlap = "wait"\n')
    with locked_work(str(file.with_suffix(".work"))):
        gone(file, passes(0.5))
    assert record_of(file).state.waiting == AT
    file.write_text(FILE.replace("0 *", "45 *"))
    again = gone(file, at=LATER)
    assert (again.runs, record_of(file).state.waiting, record_of(file).counts) == ([], None, {"missed": 1})


def test_a_time_that_comes_while_a_broken_file_keeps_a_run_from_going_on_is_not_an_overlap(file: Path) -> None:
    gone(file, passes(0.5))
    outlived = contextlib.ExitStack()
    outlived.enter_context(locked_file(file.with_suffix(".work"), RUN_LOCK))
    wrong = write(file, FILE.replace("0 *", "77 *"))
    again = gone(file, wrong, lambda _: outlived.close(), passes(1.0), at=LATER)
    assert (again.runs, record_of(file).running) == ([], AT)
    assert record_of(file).counts == {"interrupted": 1, "failed": 1}


def test_an_end_is_noticed_during_a_wait() -> None:
    ending = Ending()
    before = signal.signal(signal.SIGUSR1, lambda *_: ending.set())
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        ending.wait(3600.0)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert ending.is_set()


def test_a_batch_without_times_is_refused(file: Path) -> None:
    file.write_text(FILE.split("[schedule]", maxsplit=1)[0])
    with pytest.raises(SettingsError, match=r"\[schedule\] cron is missing"):
        gone(file)


def test_times_are_checked_with_the_file(file: Path) -> None:
    file.write_text(FILE + 'time_zone = "Europe/Amsterdm"\noverlap = "both"\n')
    with pytest.raises(SettingsError) as raised:
        read_batch(file)
    assert any("overlap is 'both': use one of skip, wait" in fault for fault in raised.value.faults)
    file.write_text(FILE + 'time_zone = "Europe/Amsterdm"\n')
    with pytest.raises(SettingsError, match=r"\[schedule\] time zone is 'Europe/Amsterdm'.*Europe/Amsterdam"):
        read_batch(file)
