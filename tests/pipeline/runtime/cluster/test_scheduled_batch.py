"""`gablework batch schedule` as a process: ended, killed, started again, and no run is lost or made twice at a time."""

import datetime as dt
import os
import signal
from pathlib import Path

import pytest
from batch_faults import BatchRun
from processes import Program, Programs, program

from pipeline.batch.schedule_file import FileBook, ScheduleRecord, read_schedule
from pipeline.batch.schedule_process import RUN_LOCK
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.scratch.work_folder import is_locked, make_work

pytestmark = pytest.mark.slow

SLOT = dt.datetime(2026, 3, 1, 2, 0, tzinfo=dt.UTC)


@pytest.fixture
def run(tmp_path: Path, programs: Programs) -> BatchRun:
    """A batch with a time whose run was cut off: it is due at once, whatever the clock says."""
    tiles = simulate("suburb", tmp_path / "scene", 3, size_m=(90.0, 90.0), density_per_m2=3.0).laz
    run = BatchRun(programs, tmp_path / "run", tiles)
    month = (dt.datetime.now(dt.UTC).month + 5) % 12 + 1
    run.file.write_text(f'{run.file.read_text()}[schedule]\ncron = "0 0 1 {month} *"\n')
    make_work(run.file.with_suffix(".work"))
    book = FileBook(run.file.with_suffix(".work"), dt.datetime.now(dt.UTC))
    book.change(running=SLOT)
    book.save()
    return run


def scheduled(run: BatchRun, programs: Programs) -> Program:
    command = [str(program("gablework")), "batch", "schedule", str(run.file), "--json"]
    return programs.start("schedule", command, env=run.environment)


def record(run: BatchRun) -> ScheduleRecord:
    found = read_schedule(str(run.file.with_suffix(".work")))
    assert found is not None
    return found


def test_an_ended_schedule_interrupts_its_run_and_the_next_one_goes_on(run: BatchRun, programs: Programs) -> None:
    run.gates.close("reconstruct")
    first = scheduled(run, programs)
    run.held(first, "reconstruct")
    os.kill(first.pid, signal.SIGTERM)
    first.wait_for_text("the run is interrupted")
    run.gates.open()
    assert first.ended() == 0, first.tail()
    assert (record(run).counts, record(run).running) == ({"interrupted": 1}, SLOT)
    assert run.status()["state"] == "interrupted"
    second = scheduled(run, programs)
    second.wait_for(lambda: record(run).counts.get("ran"), "the run's end")
    os.kill(second.pid, signal.SIGTERM)
    assert second.ended() == 0, second.tail()
    assert (record(run).counts, record(run).running) == ({"interrupted": 1, "ran": 1}, None)
    assert run.status()["state"] == "finished"
    assert '"counts": {' in second.text


def test_a_run_that_outlives_a_killed_schedule_is_not_met_by_another(run: BatchRun, programs: Programs) -> None:
    run.gates.close("reconstruct")
    first = scheduled(run, programs)
    pid = run.held(first, "reconstruct")
    first.kill()
    work = str(run.file.with_suffix(".work"))
    assert is_locked(work, RUN_LOCK)
    second = scheduled(run, programs)
    second.wait_for(lambda: is_locked(work, "schedule.lock"), "the schedule")
    os.kill(pid, 0)  # the task of the first run is still there, and the gates are closed
    assert record(run).counts == {}
    run.gates.open()
    second.wait_for(lambda: record(run).counts, "the outcome of the run")
    os.kill(second.pid, signal.SIGTERM)
    assert second.ended() == 0, second.tail()
    assert record(run).counts == {"ran": 1}
    assert run.status()["state"] == "finished"
