"""Which slots have passed, and what becomes of them."""

import datetime as dt
import itertools

from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.schedule import (
    Cron,
    Missed,
    Outcome,
    Overlap,
    PassedSlots,
    Rules,
    ScheduleState,
    look,
    passed_slots,
    time_zone,
)
from pipeline.schedule.slots import MAX_COUNTED

HOURLY = Cron("@hourly", "Europe/Amsterdam")
NIGHTLY = Cron("30 2 * * *", "Europe/Amsterdam")
NOON = dt.datetime(2026, 1, 1, 12, tzinfo=dt.UTC)
HOUR = dt.timedelta(hours=1)
MOMENT = dt.timedelta(milliseconds=1)


# --- which have passed


def test_a_slot_has_passed_from_its_own_time_on() -> None:
    assert passed_slots(HOURLY, NOON, NOON + HOUR - MOMENT) is None
    assert passed_slots(HOURLY, NOON, NOON + HOUR) == PassedSlots(latest=NOON + HOUR)
    # what was decided is not decided again
    assert passed_slots(HOURLY, NOON + HOUR, NOON + HOUR) is None


def test_a_clock_that_is_put_back_brings_nothing_again() -> None:
    assert passed_slots(HOURLY, NOON, NOON - 10 * HOUR) is None


@given(steps=st.lists(st.integers(1, 7000), min_size=1, max_size=30), autumn=st.booleans())
@settings(max_examples=examples(60), deadline=None)
def test_however_often_it_is_looked_each_slot_is_counted_once(steps: list[int], autumn: bool) -> None:
    start = dt.datetime(2026, 10, 24, 20, tzinfo=dt.UTC) if autumn else dt.datetime(2026, 3, 28, 20, tzinfo=dt.UTC)
    cron = Cron("*/20 * * * *", "Europe/Amsterdam")
    looks = [start + dt.timedelta(seconds=s) for s in itertools.accumulate(steps, initial=0)]
    found = [passed_slots(cron, one, other) for one, other in itertools.pairwise(looks)]
    counted = sum(1 + one.earlier for one in found if one is not None)
    all_times = itertools.takewhile(lambda at: at.astimezone(dt.UTC) <= looks[-1], cron.times(start))
    assert counted == len(list(all_times))
    latest = [one.latest for one in found if one is not None]
    assert len({at.astimezone(dt.UTC) for at in latest}) == len(latest)


def test_a_long_stretch_is_known_by_its_ends_and_not_counted_through() -> None:
    every = Cron("* * * * *", "Europe/Amsterdam")
    now = NOON + dt.timedelta(days=400)
    found = passed_slots(every, NOON, now)
    assert found is not None
    assert (found.first, found.latest, found.before_latest) == (
        NOON + dt.timedelta(minutes=1),
        now,
        now - dt.timedelta(minutes=1),
    )
    assert (found.earlier, found.is_counted) == (MAX_COUNTED, False)


def test_a_long_stretch_may_end_long_before_now() -> None:
    # every minute of January, looked at in December
    found = passed_slots(Cron("* * * 1 *", "UTC"), NOON, dt.datetime(2026, 12, 1, tzinfo=dt.UTC))
    assert found is not None
    assert found.latest == dt.datetime(2026, 1, 31, 23, 59, tzinfo=dt.UTC)
    assert not found.is_counted


# --- what becomes of them


def test_how_late_a_slot_is_goes_by_time_and_not_by_the_wall() -> None:
    # 02:30 in summer time, seen at 02:34 on the wall: an hour later, in winter time
    before = ScheduleState(decided_until=dt.datetime(2026, 10, 24, 12, tzinfo=dt.UTC))
    now = dt.datetime(2026, 10, 25, 2, 34, tzinfo=time_zone("Europe/Amsterdam"), fold=1)
    found = look(before, Rules(cron=NIGHTLY, missed=Missed.SKIP), now, under_way=None)
    assert [entry.outcome for entry in found.entries] == [Outcome.MISSED]


@given(
    late_s=st.none() | st.integers(0, 600),
    waiting=st.booleans(),
    is_busy=st.booleans(),
    missed=st.sampled_from(Missed),
    overlap=st.sampled_from(Overlap),
)
def test_nothing_runs_beside_a_run_and_no_slot_is_lost(
    late_s: int | None, waiting: bool, is_busy: bool, missed: Missed, overlap: Overlap
) -> None:
    old, slot = NOON - HOUR if waiting else None, None if late_s is None else NOON + HOUR
    now = NOON + HOUR / 2 if late_s is None else NOON + HOUR + dt.timedelta(seconds=late_s)
    rules = Rules(cron=HOURLY, missed=missed, overlap=overlap)
    before = ScheduleState(decided_until=NOON, waiting=old)
    found = look(before, rules, now, under_way="a run" if is_busy else None)
    assert not (is_busy and found.due is not None)
    decided = [entry.slot for entry in found.entries if entry.outcome is not Outcome.WAITING]
    fates = sorted(at for at in (*decided, found.due, found.state.waiting) if at is not None)
    assert fates == sorted(at for at in (slot, old) if at is not None)


def test_policies_have_the_names_that_documents_use() -> None:
    assert [list(Missed), list(Overlap)] == [["run-latest", "skip"], ["skip", "wait"]]
