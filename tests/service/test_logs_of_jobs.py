"""Logs of jobs: what a driver and a run say, how much is kept, and how it is read."""

import datetime as dt
import re
from collections.abc import Callable
from typing import Any

import finished_runs as runs
import pytest
from driver_bench import Bench

from pipeline import __version__
from pipeline.errors import ClusterError, UnreadableInputError
from pipeline.runtime.monitoring.progress import Event
from service.driver import job_log
from service.driver.job_log import AttemptLog
from service.driver.job_progress import WORDS
from service.errors import StoreError
from service.jobs import Fault, Job, JobFailure, LogLevel, NewLogLine
from service.keys import Scope
from service.routes.log import plain
from service.store import JobStore, logs


def lines_of(bench: Bench, job: Job) -> list[str]:
    return [plain(line).partition(" ")[2] for line in bench.store.log(job.job_id, limit=1000)]


def sends(*events: Event) -> Callable[[Any, Callable[[Event], None], Callable[[], bool]], None]:
    """A step of a scripted run that sends these events."""

    def step(_request: Any, tell: Callable[[Event], None], _cancelled: Any) -> None:
        for event in events:
            tell(event)

    return step


# --- what is logged


def test_the_log_of_a_job_tells_stages_warnings_failures_and_the_end(bench: Bench) -> None:
    facts: dict[str, str | float] = {"building": "b", "tile": "t"}
    bench.script.steps.append(
        sends(
            Event(kind="stage", stage="reconstruct", total=2),
            Event(
                kind="detail",
                stage="reconstruct",
                message="modelled again in a fresh process: killed by signal 11",
                facts=facts,
            ),
            Event(
                kind="detail",
                stage="reconstruct",
                message=f"failed: crashed: see {bench.folder.root}/jobs/a/run.json",
                facts={**facts, "reason": "crashed", "seconds": 1.5},
            ),
            Event(kind="progress", stage="reconstruct", done=2, total=2, failed=1),
        )
    )
    job = bench.done()
    lines = [re.sub(r"seconds [0-9.]+(e-[0-9]+)?", "seconds S", line) for line in lines_of(bench, job)]
    assert lines == [
        "INFO accepted: waits for a driver",
        "INFO attempt 1: running: runs",
        "INFO attempt 1, inputs: inputs are prepared",
        f"INFO attempt 1, inputs: gablework {__version__} on tile 0.laz, 1 points",
        "INFO attempt 1, inputs: done [seconds S]",
        "INFO attempt 1, plan: the run is planned",
        "WARNING attempt 1, split: tile 0.laz: odd, see run.json",
        "INFO attempt 1, plan: done [seconds S]",
        "INFO attempt 1, reconstruct: buildings are modelled",
        "WARNING attempt 1, reconstruct: modelled again in a fresh process: killed by signal 11 [building b, tile t]",
        "WARNING attempt 1, reconstruct: failed: crashed: see run.json [building b, tile t, reason crashed, seconds S]",
        "INFO attempt 1, reconstruct: done [seconds S, done 2, total 2, failed 1]",
        "INFO attempt 1, outputs: outputs are assembled",
        "INFO attempt 1, outputs: done [seconds S, done 1, total 1, failed 0]",
        f"INFO attempt 1: successful: {job.message}",
    ]


def test_details_are_no_events_of_the_job(bench: Bench) -> None:
    bench.script.steps.append(sends(Event(kind="detail", stage="reconstruct", message="failed: crashed")))
    job = bench.done()
    assert all("crashed" not in event.message for event in bench.store.events(job.job_id))
    assert any("crashed" in line for line in lines_of(bench, job))


def test_an_attempt_that_is_lost_is_told_with_its_reason_and_the_next_one_goes_on(bench: Bench) -> None:
    bench.script.raises(ClusterError("the scheduler tcp://10.0.0.7:8786 was lost"))
    job = bench.submit()
    bench.driver()
    bench.over(job)
    lines = lines_of(bench, job)
    (failed,) = [line for line in lines if "the attempt failed" in line]
    assert re.fullmatch(r"WARNING attempt 1: the attempt failed: ClusterError \(reference [0-9a-f]{8}\)", failed)
    (again,) = [line for line in lines if line.startswith("WARNING attempt 1: accepted")]
    assert "the scheduler was lost; tried again in" in again
    assert "INFO attempt 2: running: attempt 2 runs" in lines
    assert not any("10.0.0.7" in line for line in lines)


def test_a_failure_is_an_error_and_an_unexpected_one_shows_no_message(bench: Bench) -> None:
    bench.script.raises(RuntimeError("password=secret in /srv/a/b"))
    job = bench.submit()
    bench.driver()
    bench.over(job)
    found = bench.store.log(job.job_id, level=LogLevel.ERROR)
    assert [line.message.partition(" (reference")[0] for line in found] == [
        "failed: an unexpected fault of the service, RuntimeError"
    ]
    assert not any("secret" in line or "/srv" in line for line in lines_of(bench, job))


def test_a_bad_input_is_told_by_its_name(bench: Bench) -> None:
    def step(request: Any, _tell: Any, _cancelled: Any) -> None:
        raise UnreadableInputError(request.inputs[0], "no points", "send another file")

    bench.script.steps.append(step)
    job = bench.submit()
    bench.driver()
    bench.over(job)
    assert lines_of(bench, job)[-1] == "ERROR attempt 1: failed: tile 0.laz: no points. send another file"


def test_lines_wait_while_the_database_does_not_answer(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    record, refused = JobStore.record, []

    def refuses_first(store: JobStore, *given: Any) -> None:
        if not refused:
            refused.append(given)
            raise StoreError("down")
        record(store, *given)

    monkeypatch.setattr(JobStore, "record", refuses_first)
    job = bench.done()
    assert refused
    lines = lines_of(bench, job)
    assert lines.count("INFO attempt 1, inputs: inputs are prepared") == 1
    assert lines[-1].startswith("INFO attempt 1: successful")


# --- how much is kept


def test_details_beyond_a_limit_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_log, "MAX_DETAILS", 2)
    log = AttemptLog(str, WORDS, clock=lambda: 0.0)
    log.hear(Event(kind="stage", stage="reconstruct"))
    for number in range(5):
        log.hear(Event(kind="detail", stage="reconstruct", message=f"building {number}"))
    log.end_stage()
    assert [line.message for _, line in log.take()] == [
        "buildings are modelled",
        "building 0",
        "building 1",
        "3 more lines about single buildings or tasks are left out: see the records",
        "done",
    ]
    assert log.take() == []


def test_the_newest_lines_are_kept_and_long_ones_are_cut(local_service: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MAX_LINES", 5)
    job = local_service.running()
    for number in range(4):
        said = [NewLogLine(message=f"{number} {k}") for k in range(2)]
        local_service.store.record(job, [], [*said, NewLogLine(message="x" * 5000)])
    found = local_service.store.log(job.job_id)
    assert [line.message[:4] for line in found] == ["2 1", "xxxx", "3 0", "3 1", "xxxx"]
    assert found[-1].number == 14
    assert len(found[-1].message) == logs.MAX_LETTERS


def test_a_line_has_the_time_at_which_it_happened(local_service: Any) -> None:
    job = local_service.running()
    local_service.store.record(job, [], [NewLogLine(message="early", age_s=3600.0), NewLogLine(message="now")])
    early, now = local_service.store.log(job.job_id)[-2:]
    assert now.at - early.at == dt.timedelta(hours=1)


def test_a_log_goes_with_its_job(local_service: Any) -> None:
    job = local_service.running()
    local_service.store.fail(job, JobFailure(fault=Fault.INPUT, detail="no CRS"))
    assert local_service.store.log(job.job_id)
    local_service.store.remove(job.job_id)
    assert local_service.store.log(job.job_id) == []
    assert local_service.client.get(f"/jobs/{job.job_id}/log").status_code == 404


# --- how it is read


def test_a_client_gets_the_newest_lines_first_then_older_ones_and_follows(local_service: Any) -> None:
    job = local_service.running()
    local_service.store.record(job, [], [NewLogLine(message=str(number)) for number in range(3, 11)])
    links = local_service.client.get(f"/jobs/{job.job_id}").json()["links"]
    (place,) = [link["href"] for link in links if link["rel"].endswith("/log")]
    answer = local_service.client.get(f"{place}?limit=4")
    assert answer.headers["cache-control"] == "no-store"
    page = answer.json()
    assert [line["number"] for line in page["lines"]] == [7, 8, 9, 10]
    leads = {link["rel"]: link["href"] for link in page["links"]}
    older = local_service.client.get(leads["prev"]).json()
    assert [line["number"] for line in older["lines"]] == [3, 4, 5, 6]
    oldest = local_service.client.get({link["rel"]: link["href"] for link in older["links"]}["prev"]).json()
    assert [line["message"] for line in oldest["lines"]] == ["accepted: waits for a driver", "running: runs"]
    assert "prev" not in {link["rel"] for link in oldest["links"]}
    nothing = local_service.client.get(leads["next"]).json()
    assert nothing["lines"] == []
    local_service.store.record(job, [], [NewLogLine(message="more")])
    (more,) = local_service.client.get({link["rel"]: link["href"] for link in nothing["links"]}["next"]).json()["lines"]
    assert (more["number"], more["message"], more["attempt"]) == (11, "more", 1)
    between = local_service.client.get(f"{place}?after=3&before=7&limit=2").json()["lines"]
    assert [line["number"] for line in between] == [4, 5]


def test_levels_select_what_is_serious(local_service: Any) -> None:
    job = local_service.running()
    said = [NewLogLine(level=level, message=level.value) for level in LogLevel]
    local_service.store.record(job, [], said)
    place = f"/jobs/{job.job_id}/log"
    for level, expected in (("warning", ["warning", "error"]), ("error", ["error"])):
        page = local_service.client.get(f"{place}?level={level}").json()
        assert [line["message"] for line in page["lines"]] == expected
        assert all(f"level={level}" in link["href"] for link in page["links"])
    runs.problem(local_service.client.get(f"{place}?level=debug"), 400, "invalid-request")


@pytest.mark.parametrize("wanted", [{"params": {"f": "text"}}, {"headers": {"Accept": "text/plain"}}])
def test_plain_lines_are_one_each_with_links_in_a_header(local_service: Any, wanted: Any) -> None:
    job = local_service.running()
    local_service.store.record(job, [], [NewLogLine(message="two\nlines", facts={"done": 3})])
    answer = local_service.client.get(f"/jobs/{job.job_id}/log", **wanted)
    assert answer.headers["content-type"].startswith("text/plain")
    assert [line.partition(" ")[2] for line in answer.text.splitlines()] == [
        "INFO accepted: waits for a driver",
        "INFO attempt 1: running: runs",
        "INFO attempt 1: two lines [done 3]",
    ]
    assert set(answer.links) == {"self", "next"}
    assert answer.links["next"]["url"].endswith("after=3")


def test_a_log_is_only_for_those_who_may_see_the_job(starting: Any) -> None:
    service = starting()
    mine, other = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    upload = service.upload(**mine)
    asked = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}]}}
    made = service.client.post("/processes/reconstruct/execution", json=asked, headers=mine)
    place = f"/jobs/{made.json()['jobID']}/log"
    assert service.client.get(place, headers=mine).status_code == 200
    assert service.client.get(place, headers=other).status_code == 404
    assert service.client.get(place).status_code == 401
