"""The clock of the schedules in drivers with a scripted run in place of the science."""

import datetime as dt
import logging
from collections import Counter
from typing import Any

import pytest
from driver_bench import Bench
from processes import wait_for
from schedule_contract import DAY, HOUR
from schedule_store_contract import jobs_of, make, runs_of

from pipeline.schedule import Outcome, Overlap
from service.errors import StoreError
from service.jobs import Job, JobStatus
from service.schedules import Schedule, Trigger
from service.store.schedule_store import ScheduleStore


def due(bench: Bench, hours: int = 1, **values: Any) -> Schedule:
    """A schedule of every hour, of which so many have passed undecided."""
    full_hour = bench.store.now().replace(minute=0, second=0, microsecond=0)
    return make(bench.store, at=full_hour - hours * HOUR, **values)


def first_job(bench: Bench, schedule: Schedule) -> Job:
    return wait_for(lambda: jobs_of(bench.store, schedule), "a job of the schedule")[0]


def test_a_driver_makes_the_job_that_is_due_and_runs_it(bench: Bench) -> None:
    schedule = due(bench, title="by the hour")
    bench.driver()
    done = bench.over(first_job(bench, schedule))
    assert (done.status, done.request.title) == (JobStatus.SUCCESSFUL, "by the hour")
    assert done.schedule_id == schedule.schedule_id
    assert [run.outcome for run in runs_of(bench.store, schedule)] == [Outcome.SUBMITTED]


def test_two_drivers_make_one_job_of_each_slot(bench: Bench) -> None:
    schedules = [due(bench) for _ in range(8)]
    bench.driver()
    bench.driver()
    for schedule in schedules:
        assert bench.over(first_job(bench, schedule)).status is JobStatus.SUCCESSFUL
    counts = [Counter(run.outcome for run in runs_of(bench.store, schedule)) for schedule in schedules]
    assert counts == [Counter({Outcome.SUBMITTED: 1})] * 8
    assert bench.script.runs == 8


def test_a_slot_that_waits_is_run_when_the_drivers_job_is_over(bench: Bench) -> None:
    schedule = due(bench, overlap=Overlap.WAIT)
    bench.script.waits()
    job = bench.store.schedules.run_now(schedule.schedule_id)
    bench.driver()
    bench.becomes(job, JobStatus.RUNNING)

    def waiting() -> list[dt.datetime | None]:
        return [run.slot for run in runs_of(bench.store, schedule) if run.outcome is Outcome.WAITING]

    (slot,) = wait_for(waiting, "a slot that waits")
    bench.script.go_on.set()
    bench.over(job)
    wait_for(lambda: len(jobs_of(bench.store, schedule)) == 2, "the job that waited")
    latest = runs_of(bench.store, schedule)[0]
    assert (latest.outcome, latest.slot, latest.trigger) == (Outcome.SUBMITTED, slot, Trigger.CLOCK)


def test_a_clock_that_was_put_back_by_days_is_reported_and_the_schedule_goes_on(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """The database's clock was ten days ahead when the schedule was looked at last."""
    schedule = make(bench.store, at=bench.store.now() + 10 * DAY)
    with caplog.at_level(logging.INFO, logger="gablework.driver"):
        bench.driver()
        wait_for(lambda: runs_of(bench.store, schedule), "an entry of the history")
        wait_for(lambda: "slots up to" in caplog.text, "a line in the log")
    (entry,) = runs_of(bench.store, schedule)
    assert "the clock was put back from" in entry.message
    assert [r.levelno for r in caplog.records if "the clock was put back" in r.getMessage()] == [logging.WARNING]
    after = bench.store.schedules.get(schedule.schedule_id)
    assert after.next_at is not None
    assert after.decided_until < after.next_at < bench.store.now() + 2 * HOUR


def test_missed_slots_are_warned_of_in_the_log(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="gablework.driver"):
        schedule = due(bench, hours=5)
        bench.driver()
        bench.over(first_job(bench, schedule))
        wait_for(lambda: any("submitted" in record.getMessage() for record in caplog.records), "a line in the log")
    lines = [(record.levelno, record.getMessage()) for record in caplog.records if "slots up to" in record.getMessage()]
    assert [level for level, _ in lines] == [logging.WARNING, logging.INFO]
    assert "4 slots" in lines[0][1]
    assert schedule.schedule_id in lines[0][1]


@pytest.mark.parametrize("fault", [StoreError("the database is away"), ZeroDivisionError("a fault of ours")])
def test_the_clock_outlives_a_fault(bench: Bench, fault: Exception) -> None:
    faults = [fault]
    tick = ScheduleStore.tick

    def failing(self: ScheduleStore, **options: Any) -> Any:
        if faults:
            raise faults.pop()
        return tick(self, **options)

    bench.patch.setattr(ScheduleStore, "tick", failing)
    schedule = due(bench)
    bench.driver()
    assert bench.over(first_job(bench, schedule)).status is JobStatus.SUCCESSFUL
    assert faults == []


def test_a_driver_that_ends_decides_nothing_more(bench: Bench) -> None:
    bench.driver()
    bench.over(bench.submit())
    bench.end()
    schedule = due(bench)
    assert runs_of(bench.store, schedule) == []
    assert jobs_of(bench.store, schedule) == []
