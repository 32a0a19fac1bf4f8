"""Which slots have passed, and what becomes of them."""

import datetime as dt
import itertools

from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.schedule import Cron, Decision, Missed, Overlap, PassedSlots, Rules, decide, passed_slots, time_zone
from pipeline.schedule.slots import MAX_COUNTED

HOURLY = Cron("@hourly", "Europe/Amsterdam")
NIGHTLY = Cron("30 2 * * *", "Europe/Amsterdam")
NOON = dt.datetime(2026, 1, 1, 12, tzinfo=dt.UTC)
HOUR = dt.timedelta(hours=1)
GRACE = dt.timedelta(seconds=Rules.grace_s)
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


def decided(passed: PassedSlots | None, **options: object) -> Decision:
    values = {"waiting": None, "is_busy": False, "now": NOON} | options
    policies = {name: values.pop(name) for name in ("missed", "overlap") if name in values}
    return decide(passed, Rules(cron=HOURLY, **policies), **values)  # type: ignore[arg-type]


def test_a_slot_that_is_seen_in_time_is_run() -> None:
    for missed in Missed:
        assert decided(PassedSlots(latest=NOON - GRACE), missed=missed) == Decision(run=NOON - GRACE)


def test_a_slot_that_is_seen_late_is_run_once_or_missed() -> None:
    late = PassedSlots(latest=NOON - GRACE - MOMENT, earlier=3)
    assert decided(late) == Decision(run=late.latest)
    assert decided(late, missed=Missed.SKIP) == Decision(late=late.latest)


def test_how_late_it_is_goes_by_time_and_not_by_the_wall() -> None:
    # 02:30 in summer time, seen at 02:34 on the wall: an hour later, in winter time
    zone = time_zone("Europe/Amsterdam")
    slot = NIGHTLY.next_time(dt.datetime(2026, 10, 24, 12, tzinfo=dt.UTC))
    now = dt.datetime(2026, 10, 25, 2, 34, tzinfo=zone, fold=1)
    assert decided(PassedSlots(latest=slot), now=now, missed=Missed.SKIP).late == slot


def test_a_slot_that_comes_while_a_run_is_under_way_is_skipped_or_waits() -> None:
    now = PassedSlots(latest=NOON)
    assert decided(now, is_busy=True) == Decision(skipped=NOON)
    assert decided(now, is_busy=True, overlap=Overlap.WAIT) == Decision(waits=NOON)


def test_a_slot_that_waits_is_run_when_the_run_is_over_however_late() -> None:
    waiting = NOON - 10 * HOUR
    for missed in Missed:
        options = {"waiting": waiting, "overlap": Overlap.WAIT, "missed": missed}
        assert decided(None, is_busy=True, **options) == Decision(waits=waiting)
        assert decided(None, **options) == Decision(run=waiting)


def test_a_later_slot_takes_the_place_of_the_one_that_waits() -> None:
    options = {"waiting": NOON - HOUR, "overlap": Overlap.WAIT}
    assert decided(PassedSlots(latest=NOON), **options) == Decision(run=NOON, replaced=NOON - HOUR)
    assert decided(PassedSlots(latest=NOON), is_busy=True, **options) == Decision(waits=NOON, replaced=NOON - HOUR)


@given(
    latest=st.none() | st.integers(0, 600),
    waiting=st.none() | st.integers(601, 900),
    is_busy=st.booleans(),
    missed=st.sampled_from(Missed),
    overlap=st.sampled_from(Overlap),
)
def test_nothing_runs_beside_a_run_and_no_slot_is_lost(
    latest: int | None, waiting: int | None, is_busy: bool, missed: Missed, overlap: Overlap
) -> None:
    slot = None if latest is None else NOON - dt.timedelta(seconds=latest)
    old = None if waiting is None else NOON - dt.timedelta(seconds=waiting)
    passed = None if slot is None else PassedSlots(latest=slot)
    found = decided(passed, waiting=old, is_busy=is_busy, missed=missed, overlap=overlap)
    assert not (is_busy and found.run is not None)
    fates = [found.run, found.waits, found.skipped, found.replaced, found.late]
    decided_slots = sorted(at for at in fates if at is not None)
    assert decided_slots == sorted(at for at in (slot, old) if at is not None)


def test_policies_have_the_names_that_documents_use() -> None:
    assert [list(Missed), list(Overlap)] == [["run-latest", "skip"], ["skip", "wait"]]
