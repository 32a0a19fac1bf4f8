"""What a stored schedule does at the clock: the same tests for a batch's file, SQLite and PostgreSQL."""

import contextlib
import datetime as dt
from collections.abc import Mapping
from typing import Any, Protocol

import pytest

from pipeline.schedule import (
    Cron,
    Entry,
    Missed,
    Outcome,
    Overlap,
    Rules,
    ScheduleBook,
    ScheduleState,
    enter,
    look,
    miss_passed,
    miss_waiting,
    time_zone,
)

MINUTE, HOUR, DAY = dt.timedelta(minutes=1), dt.timedelta(hours=1), dt.timedelta(days=1)
NOON = dt.datetime(2030, 6, 1, 12, tzinfo=dt.UTC)


class StoredSchedule(Protocol):
    """A schedule in storage; it begins at `NOON`."""

    done: Outcome
    """The outcome of a run."""
    max_kept: int
    """Entries that are kept."""

    def run(self, book: Any, slot: dt.datetime, now: dt.datetime) -> None:
        """Enter a run."""

    def opened(self) -> contextlib.AbstractContextManager[ScheduleBook]:
        """Read its book; a transaction where the storage has them."""

    def entries(self) -> list[Entry]:
        """Its history as stored, in order of the entries."""

    def counts(self) -> Mapping[Any, int]:
        """Slots by outcome, without those that are zero."""


def rules(cron: str = "@hourly", zone: str = "UTC", **values: Any) -> Rules:
    return Rules(cron=Cron(cron, zone), **values)


def look_at(
    schedule: StoredSchedule, now: dt.datetime, asked: Rules | None = None, *, is_busy: bool = False
) -> dt.datetime | None:
    """Look at the clock; run what is due."""
    with schedule.opened() as book:
        under_way = "a run" if is_busy else None
        due = enter(book, look(book.state, asked or rules(), now, under_way=under_way, has_run=book.has_run))
        if due is not None:
            schedule.run(book, due, now)
        book.save()
    return due


def state_of(schedule: StoredSchedule) -> ScheduleState:
    with schedule.opened() as book:
        return book.state


def history(schedule: StoredSchedule) -> list[tuple[Outcome, dt.datetime | None, int]]:
    return [(entry.outcome, entry.slot, entry.slots) for entry in schedule.entries()]


class ScheduleContract:
    """Each storage brings its `schedule`."""

    @pytest.fixture
    def schedule(self) -> StoredSchedule:
        raise NotImplementedError

    def test_a_slot_is_run_at_its_time_and_once(self, schedule: StoredSchedule) -> None:
        assert look_at(schedule, NOON + HOUR - MINUTE) is None
        assert look_at(schedule, NOON + HOUR) == NOON + HOUR
        assert look_at(schedule, NOON + HOUR) is None
        assert look_at(schedule, NOON + HOUR + MINUTE) is None
        assert history(schedule) == [(schedule.done, NOON + HOUR, 1)]
        assert state_of(schedule) == ScheduleState(decided_until=NOON + HOUR + MINUTE)

    def test_slots_that_passed_unseen_are_missed_together_and_the_latest_is_run(self, schedule: StoredSchedule) -> None:
        now = NOON + 30 * HOUR + 20 * MINUTE
        assert look_at(schedule, now) == NOON + 30 * HOUR
        missed, ran = schedule.entries()
        assert (missed.outcome, missed.first_slot, missed.slot) == (Outcome.MISSED, NOON + HOUR, NOON + 29 * HOUR)
        assert (missed.slots, missed.is_counted, missed.at) == (29, True, now)
        assert "from 2030-06-01T13:00:00Z to 2030-06-02T18:20:00Z: only the latest" in missed.message
        assert (ran.slot, ran.first_slot, schedule.counts()) == (NOON + 30 * HOUR, None, {"missed": 29, ran.outcome: 1})

    def test_no_slot_is_run_later_than_the_grace_if_late_ones_are_skipped(self, schedule: StoredSchedule) -> None:
        strict = rules(missed=Missed.SKIP, grace_s=600.0)
        assert look_at(schedule, NOON + 3 * HOUR + 10 * MINUTE, strict) == NOON + 3 * HOUR
        assert look_at(schedule, NOON + 5 * HOUR + 11 * MINUTE, strict) is None
        late = schedule.entries()[-1]
        assert (late.first_slot, late.slot, late.slots) == (NOON + 4 * HOUR, NOON + 5 * HOUR, 2)
        assert "seen later than 600 s" in late.message
        assert look_at(schedule, NOON + 6 * HOUR + 11 * MINUTE, strict) is None
        assert schedule.entries()[-1].first_slot is None
        assert schedule.counts()["missed"] == 5

    def test_a_slot_during_a_run_is_skipped(self, schedule: StoredSchedule) -> None:
        assert look_at(schedule, NOON + HOUR, is_busy=True) is None
        assert history(schedule) == [(Outcome.SKIPPED, NOON + HOUR, 1)]
        assert schedule.entries()[0].message == "a run was still under way"

    def test_a_slot_that_waits_is_run_after_the_run_and_a_later_one_replaces_it(self, schedule: StoredSchedule) -> None:
        waiting = rules(overlap=Overlap.WAIT)
        assert look_at(schedule, NOON + HOUR, waiting, is_busy=True) is None
        assert look_at(schedule, NOON + HOUR + MINUTE, waiting, is_busy=True) is None
        assert (history(schedule), schedule.counts()) == ([(Outcome.WAITING, NOON + HOUR, 1)], {})
        assert look_at(schedule, NOON + 2 * HOUR, waiting, is_busy=True) is None
        assert state_of(schedule).waiting == NOON + 2 * HOUR
        # not at its next time: as soon as the run is over
        assert look_at(schedule, NOON + 2 * HOUR + MINUTE, waiting) == NOON + 2 * HOUR
        assert look_at(schedule, NOON + 2 * HOUR + 2 * MINUTE, waiting) is None
        assert history(schedule) == [(Outcome.MISSED, NOON + HOUR, 1), (schedule.done, NOON + 2 * HOUR, 1)]
        assert state_of(schedule).waiting is None
        assert schedule.counts() == {"missed": 1, schedule.done: 1}

    def test_a_paused_schedule_misses_only_the_slot_that_waited(self, schedule: StoredSchedule) -> None:
        look_at(schedule, NOON + HOUR, rules(overlap=Overlap.WAIT), is_busy=True)
        assert look_at(schedule, NOON + 3 * HOUR, rules(is_paused=True)) is None
        (missed,) = schedule.entries()
        assert (missed.outcome, missed.slot) == (Outcome.MISSED, NOON + HOUR)
        assert "paused" in missed.message
        assert look_at(schedule, NOON + 3.5 * HOUR) is None
        assert (len(schedule.entries()), schedule.counts()) == (1, {"missed": 1})

    def test_a_clock_that_is_corrected_brings_no_slot_again_and_is_no_news(self, schedule: StoredSchedule) -> None:
        look_at(schedule, NOON + HOUR)
        for now in (NOON + HOUR - 9 * MINUTE, NOON + HOUR, NOON + HOUR + MINUTE):
            assert look_at(schedule, now) is None
        assert look_at(schedule, NOON + HOUR - 5 * MINUTE, rules(is_paused=True)) is None
        assert state_of(schedule).decided_until == NOON + HOUR + MINUTE
        assert len(schedule.entries()) == 1

    def test_a_clock_that_is_put_back_is_noted_and_the_next_slot_of_the_present_is_run(
        self, schedule: StoredSchedule
    ) -> None:
        assert look_at(schedule, NOON + 10 * DAY) == NOON + 10 * DAY
        back = NOON + 2 * HOUR + MINUTE
        assert look_at(schedule, back) is None
        note = schedule.entries()[-1]
        assert (note.outcome, note.slot, note.at) == (Outcome.MISSED, back, back)
        assert "put back from 2030-06-11T12:00:00Z or later to 2030-06-01T14:01:00Z" in note.message
        assert state_of(schedule).decided_until == back
        # said once, and an hourly schedule runs within the hour
        assert look_at(schedule, back + MINUTE) is None
        assert [entry.message for entry in schedule.entries()].count(note.message) == 1
        slots = [look_at(schedule, NOON + hours * HOUR) for hours in range(3, 10 * 24 + 3)]
        expected = [NOON + hours * HOUR for hours in range(3, 10 * 24 + 3)]
        # the one that had its run when the clock was ahead is not run again
        assert slots == [None if slot == NOON + 10 * DAY else slot for slot in expected]
        (again,) = (entry for entry in schedule.entries() if entry.outcome is Outcome.SKIPPED)
        assert (again.slot, again.message) == (NOON + 10 * DAY, "it had its run before the clock was put back")

    def test_a_slot_that_had_its_run_does_not_wait_for_another(self, schedule: StoredSchedule) -> None:
        look_at(schedule, NOON + DAY)
        look_at(schedule, NOON + HOUR / 2)
        waiting = rules(overlap=Overlap.WAIT)
        assert look_at(schedule, NOON + DAY + MINUTE, waiting, is_busy=True) is None
        assert state_of(schedule).waiting is None
        assert look_at(schedule, NOON + DAY + 2 * MINUTE, waiting) is None

    def test_a_clock_that_is_put_back_does_not_matter_to_a_paused_schedule(self, schedule: StoredSchedule) -> None:
        look_at(schedule, NOON + 10 * DAY, rules(is_paused=True))
        assert look_at(schedule, NOON + 5 * DAY, rules(is_paused=True)) is None
        assert (state_of(schedule).decided_until, schedule.entries()) == (NOON + 5 * DAY, [])

    def test_a_clock_that_goes_to_and_fro_has_a_bounded_history(self, schedule: StoredSchedule) -> None:
        for _ in range(3):
            look_at(schedule, NOON + DAY)
            look_at(schedule, NOON)
        outcomes = [entry.outcome for entry in schedule.entries()]
        assert outcomes.count(schedule.done) == 1
        assert sum("put back" in entry.message for entry in schedule.entries()) == 3 + 2

    @pytest.mark.parametrize(
        ("day", "local"),
        [("2031-03-29", ["29 02:30", "30 03:00", "31 02:30"]), ("2031-10-25", ["25 02:30", "26 02:30", "27 02:30"])],
    )
    def test_a_nightly_run_comes_once_where_clocks_are_shifted(
        self, schedule: StoredSchedule, day: str, local: list[str]
    ) -> None:
        start = dt.datetime.fromisoformat(f"{day}T00:00:00+00:00")
        nightly = rules("30 2 * * *", "Europe/Amsterdam")
        look_at(schedule, start, rules(is_paused=True))
        with schedule.opened() as book:
            looks = (start + minutes * MINUTE for minutes in range(0, 3 * 24 * 60, 10))
            found = [enter(book, look(book.state, nightly, now, under_way=None)) for now in looks]
            book.save()
        zone = time_zone("Europe/Amsterdam")
        assert [f"{slot.astimezone(zone):%d %H:%M}" for slot in found if slot is not None] == local
        assert schedule.entries() == []

    def test_years_without_a_look_are_one_entry(self, schedule: StoredSchedule) -> None:
        now = NOON + 800 * DAY
        assert look_at(schedule, now, rules("* * * * *")) == now
        missed, _ = schedule.entries()
        assert (missed.first_slot, missed.slot) == (NOON + MINUTE, now - MINUTE)
        assert (missed.slots, missed.is_counted) == (10_000, False)

    def test_slots_of_times_that_are_given_up_are_missed(self, schedule: StoredSchedule) -> None:
        look_at(schedule, NOON + HOUR, rules(overlap=Overlap.WAIT), is_busy=True)
        now = NOON + 3.5 * HOUR
        with schedule.opened() as book:
            enter(book, miss_passed(book.state, rules(), now, "changed"))
            assert book.state == ScheduleState(decided_until=now, waiting=NOON + HOUR)
            enter(book, miss_passed(book.state, rules(), now, "changed"))
            enter(book, miss_passed(book.state, rules(is_paused=True), now + DAY, "changed"))
            enter(book, miss_waiting(book.state, now, "no longer needed"))
            enter(book, miss_waiting(book.state, now, "no longer needed"))
            book.save()
        found = {(entry.outcome, entry.slot, entry.slots, entry.message) for entry in schedule.entries()}
        assert found == {
            (Outcome.MISSED, NOON + HOUR, 1, "no longer needed"),
            (Outcome.MISSED, NOON + 3 * HOUR, 2, "changed"),
        }
        assert state_of(schedule) == ScheduleState(decided_until=now + DAY)

    def test_the_history_is_bounded_and_the_counts_continue(self, schedule: StoredSchedule) -> None:
        number = schedule.max_kept + 20
        with schedule.opened() as book:
            for k in range(number):
                enter(book, look(book.state, rules(), NOON + (k + 1) * HOUR, under_way="a run"))
            book.save()
        assert len(schedule.entries()) == schedule.max_kept
        assert schedule.entries()[-1].slot == NOON + number * HOUR
        assert schedule.counts() == {"skipped": number}

    def test_what_is_not_saved_leaves_no_trace(self, schedule: StoredSchedule) -> None:
        with contextlib.suppress(ZeroDivisionError), schedule.opened() as book:
            enter(book, look(book.state, rules(), NOON + 3 * HOUR, under_way="a run"))
            raise ZeroDivisionError
        assert (schedule.entries(), schedule.counts()) == ([], {})
        assert state_of(schedule) == ScheduleState(decided_until=NOON)
