"""A batch that runs at its times: every time is told once, no two runs meet, and nothing is forgotten at an end."""

from __future__ import annotations

import datetime as dt
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.batch import scheduled
from pipeline.batch.batch_file import Batch, ScheduleTable, read_batch
from pipeline.batch.scheduled import KEPT, Outcome, ScheduleState, keep_schedule, look, read_schedule
from pipeline.errors import RunError, SettingsError
from pipeline.runtime.events import Event
from pipeline.runtime.work_folder import held_lock, held_work, make_work

AT = dt.datetime(2026, 3, 1, 2, 0, tzinfo=dt.UTC)
HOUR = dt.timedelta(hours=1)
FILE = '[inputs]\npaths = ["tiles"]\n[output]\npath = "models"\n[schedule]\ncron = "0 * * * *"\n'


def told(state: ScheduleState) -> list[tuple[str, str | None, int]]:
    return [(entry.outcome.value, entry.slot, entry.slots) for entry in state.entries]


# --- what becomes of times


def test_a_time_that_comes_is_run_once() -> None:
    state, table = ScheduleState(decided_until=AT - HOUR / 2), ScheduleTable(cron="0 * * * *")
    state, due = look(state, table, AT + dt.timedelta(seconds=1), is_busy=False)
    assert due == AT
    assert look(state, table, AT + dt.timedelta(seconds=2), is_busy=False) == (
        ScheduleState(decided_until=AT + dt.timedelta(seconds=2)),
        None,
    )


def test_times_that_nobody_saw_are_missed_and_the_latest_is_run() -> None:
    state, due = look(
        ScheduleState(decided_until=AT - 5.5 * HOUR), ScheduleTable(cron="0 * * * *"), AT + HOUR / 2, is_busy=False
    )
    assert due == AT
    assert told(state) == [("missed", "2026-03-01T01:00:00+00:00", 5)]
    assert state.counts == {"missed": 5}


def test_none_is_run_late_where_that_is_not_wanted() -> None:
    table = ScheduleTable(cron="0 * * * *", missed="skip", grace_s=60.0)
    state, due = look(ScheduleState(decided_until=AT - HOUR / 2), table, AT + HOUR / 2, is_busy=False)
    assert due is None
    assert told(state) == [("missed", "2026-03-01T02:00:00+00:00", 1)]


def test_a_time_during_a_run_is_skipped_or_waits() -> None:
    state, due = look(ScheduleState(decided_until=AT - HOUR), ScheduleTable(cron="0 * * * *"), AT, is_busy=True)
    assert (due, told(state)) == (None, [("skipped", "2026-03-01T02:00:00+00:00", 1)])
    waits = ScheduleTable(cron="0 * * * *", overlap="wait")
    state, due = look(ScheduleState(decided_until=AT - HOUR), waits, AT, is_busy=True)
    assert (due, state.waiting, told(state)) == (None, AT, [])
    state, due = look(state, waits, AT + HOUR, is_busy=True)
    assert (state.waiting, told(state)) == (AT + HOUR, [("missed", "2026-03-01T02:00:00+00:00", 1)])
    state, due = look(state, waits, AT + 1.1 * HOUR, is_busy=False)
    assert (due, state.waiting) == (AT + HOUR, None)


def test_a_paused_schedule_misses_nothing_but_what_waited() -> None:
    paused = ScheduleTable(cron="0 * * * *", paused=True)
    state = ScheduleState(decided_until=AT - HOUR, waiting=AT - HOUR)
    state, due = look(state, paused, AT + 3 * HOUR, is_busy=False)
    assert (due, told(state)) == (None, [("missed", "2026-03-01T01:00:00+00:00", 1)])
    state, due = look(state, ScheduleTable(cron="0 * * * *"), AT + 3.5 * HOUR, is_busy=False)
    assert (due, len(state.entries)) == (None, 1)


def test_a_clock_that_is_put_back_brings_no_time_again() -> None:
    table = ScheduleTable(cron="0 * * * *")
    state, due = look(ScheduleState(decided_until=AT - HOUR), table, AT, is_busy=False)
    assert due == AT
    state, due = look(state, table, AT - HOUR, is_busy=False)
    assert (due, state.decided_until) == (None, AT)
    assert look(state, table, AT + HOUR / 60, is_busy=False)[1] is None


@pytest.mark.parametrize(
    ("zone", "day", "count"), [("Europe/Amsterdam", "2026-03-29", 1), ("Europe/Amsterdam", "2026-10-25", 1)]
)
def test_a_nightly_run_comes_once_on_the_days_that_shift_the_clock(zone: str, day: str, count: int) -> None:
    table = ScheduleTable(cron="30 2 * * *", time_zone=zone)
    now = dt.datetime.fromisoformat(f"{day}T00:00:00+01:00")
    state, due = ScheduleState(decided_until=now), []
    for _ in range(24 * 12):
        now += dt.timedelta(minutes=5)
        state, slot = look(state, table, now, is_busy=False)
        due += [slot] if slot else []
    assert (len(due), state.entries) == (count, ())


def test_what_is_remembered_is_bounded_and_survives_writing() -> None:
    state, table = ScheduleState(decided_until=AT, running=AT), ScheduleTable(cron="0 * * * *")
    for k in range(KEPT + 20):
        state, _ = look(state, table, AT + (k + 1) * HOUR, is_busy=True)
    assert (len(state.entries), state.counts) == (KEPT, {"skipped": KEPT + 20})
    assert ScheduleState.from_json(state.to_json()) == state
    with pytest.raises(ValueError, match="entries"):
        ScheduleState.from_json('{"decided_until": "2026-01-01T00:00:00+00:00", "waiting": null, "running": null}')


# --- the process


class FakeRun:
    """A run of which the test says when it is over."""

    def __init__(self) -> None:
        self.code: int | None = None
        self.signals: list[int] = []

    def poll(self) -> int | None:
        return self.code

    def send_signal(self, sig: int, /) -> None:
        self.signals.append(sig)
        self.code = 130

    def wait(self) -> int:
        assert self.code is not None
        return self.code


class Days(threading.Event):
    """A clock that goes on while the schedule sleeps, and does at each look what the test says."""

    def __init__(self, steps: list[Callable[[], None]]) -> None:
        super().__init__()
        self.time, self._steps = AT - HOUR / 2, steps
        self.runs: list[FakeRun] = []
        self.events: list[Event] = []

    def now(self) -> dt.datetime:
        return self.time

    def start(self, batch: Batch) -> FakeRun:
        assert batch.schedule.cron
        self.runs.append(FakeRun())
        return self.runs[-1]

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        assert 0.0 < timeout <= scheduled.LONGEST_SLEEP_S
        if not self._steps:
            self.set()
            return True
        self._steps.pop(0)()
        return False

    def go(self, path: Path) -> None:
        keep_schedule(path, self, self.events.append, self.start, self.now)

    def later(self, hours: float) -> None:
        self.time += hours * HOUR


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "city.toml"
    path.write_text(FILE)
    return path


def state_of(file: Path) -> ScheduleState:
    state = read_schedule(str(file.with_suffix(".work")))
    assert state is not None
    return state


def test_runs_follow_one_another_and_are_told_with_their_codes(file: Path) -> None:
    days = Days([])
    days._steps = [
        lambda: days.later(0.5),
        lambda: setattr(days.runs[0], "code", 0),
        lambda: days.later(1.0),
        lambda: setattr(days.runs[1], "code", 1),
        lambda: days.later(1.0),
        lambda: setattr(days.runs[2], "code", 4),
    ]
    days.go(file)
    assert [entry.outcome for entry in state_of(file).entries] == [
        Outcome.RAN,
        Outcome.INCOMPLETE,
        Outcome.FAILED,
    ]
    assert state_of(file).counts == {"ran": 1, "incomplete": 1, "failed": 1}
    kinds = Counter(event.kind for event in days.events)
    assert kinds == {"run": 4, "warning": 2}


def test_an_end_interrupts_the_run_and_the_next_start_goes_on(file: Path) -> None:
    days = Days([])
    days._steps = [lambda: days.later(0.5)]
    days.go(file)
    assert days.runs[0].signals == [signal.SIGINT]
    assert [entry.outcome for entry in state_of(file).entries] == [Outcome.INTERRUPTED]
    assert state_of(file).running == AT
    again = Days([])
    again.time = AT + HOUR / 4
    again._steps = [lambda: setattr(again.runs[0], "code", 0)]
    again.go(file)
    assert len(again.runs) == 1
    assert (state_of(file).running, state_of(file).counts) == (None, {"interrupted": 1, "ran": 1})


def test_a_run_by_hand_is_not_met(file: Path) -> None:
    days = Days([])
    days._steps = [lambda: days.later(0.5), lambda: days.later(1.0)]
    with held_work(str(file.with_suffix(".work"))):
        days.go(file)
    assert (days.runs, state_of(file).counts) == ([], {"skipped": 2})


def test_a_second_process_is_refused(file: Path) -> None:
    work = file.with_suffix(".work")
    make_work(work)
    with held_lock(work, scheduled.LOCK), pytest.raises(RunError, match="is at work already"):
        Days([]).go(file)


def test_changed_times_count_from_then_on_and_a_broken_file_changes_nothing(file: Path) -> None:
    def write(text: str) -> Callable[[], None]:
        def change() -> None:
            file.write_text(text)
            os.utime(file, ns=(days.time.microsecond, round(days.time.timestamp()) * 10**9))

        return change

    days = Days([])
    days._steps = [
        write(FILE.replace("0 *", "15 *")),
        lambda: days.later(0.5),
        write(FILE.replace("0 *", "77 *")),
        lambda: days.later(0.25),
        lambda: setattr(days.runs[0], "code", 0),
        write(FILE + "paused = true\n"),
        lambda: days.later(2.0),
    ]
    days.go(file)
    assert [entry.slot for entry in state_of(file).entries] == ["2026-03-01T02:15:00+00:00"]
    messages = [event.message for event in days.events if event.kind == "warning"]
    assert len(messages) == 1
    assert "its minute is '77'" in messages[0]


def test_a_batch_without_times_is_refused(file: Path) -> None:
    file.write_text(FILE.split("[schedule]", maxsplit=1)[0])
    with pytest.raises(SettingsError, match=r"\[schedule\] cron is missing"):
        Days([]).go(file)


def test_times_are_checked_with_the_file(file: Path) -> None:
    file.write_text(FILE + 'time_zone = "Europe/Amsterdm"\noverlap = "both"\n')
    with pytest.raises(SettingsError) as raised:
        read_batch(file)
    assert any("overlap is 'both': use one of skip, wait" in fault for fault in raised.value.faults)
    file.write_text(FILE + 'time_zone = "Europe/Amsterdm"\n')
    with pytest.raises(SettingsError, match=r"\[schedule\] time zone is 'Europe/Amsterdm'.*Europe/Amsterdam"):
        read_batch(file)


def test_what_is_remembered_and_damaged_is_named(file: Path) -> None:
    work = file.with_suffix(".work")
    make_work(work)
    (work / scheduled.NAME).write_text("{")
    with pytest.raises(RunError, match=r"schedule\.json cannot be read"):
        Days([]).go(file)
