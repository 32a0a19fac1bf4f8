"""Traces of the service: requests, jobs over their attempts, webhooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from driver_bench import Bench
from traced import Spans, id_of, parent_of, spans, trace_of

from pipeline.backoff import Backoff
from pipeline.errors import ClusterError
from pipeline.runtime.monitoring import tracing
from pipeline.runtime.monitoring.tracing import Parent
from service.errors import StoreError
from service.jobs import Job, JobStatus
from service.store import JobStore
from service.traces import of_job

if TYPE_CHECKING:
    from conftest import Starting

__all__ = ["spans"]

CLIENT = Parent(trace_id=0xABC, span_id=0xDEF, is_sampled=True)


def test_a_request_continues_the_trace_of_its_client_and_its_job_belongs_to_it(
    spans: Spans, starting: Starting
) -> None:
    service = starting()
    headers = {"traceparent": CLIENT.traceparent}
    answer = service.client.post("/processes/echo/execution", json={"inputs": {"message": "a"}}, headers=headers)
    job = service.store.get(answer.json()["jobID"])
    request = spans.one("POST /processes/{processID}/execution")
    assert (trace_of(request), parent_of(request)) == (CLIENT.trace_id, CLIENT.span_id)
    assert Parent.of(job.traceparent) == Parent(CLIENT.trace_id, id_of(request), is_sampled=True)
    assert request.attributes is not None
    assert request.attributes["http.response.status_code"] == 201
    service.client.get(f"/jobs/{job.job_id}")
    # names have no ids, and a client without a trace begins one
    assert parent_of(spans.one("GET /jobs/{jobID}")) is None
    service.client.get("/readyz")
    assert not spans.named("GET /readyz")


def test_a_request_that_is_not_traced_makes_a_job_that_is_not(starting: Starting) -> None:
    service = starting()
    headers = {"traceparent": CLIENT.traceparent}
    answer = service.client.post("/processes/echo/execution", json={"inputs": {"message": "a"}}, headers=headers)
    assert service.store.get(answer.json()["jobID"]).traceparent is None


def test_all_attempts_lie_below_one_span_of_the_job(
    spans: Spans, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.driver.attempt_records.LOST_CLUSTER", Backoff(first_s=0.01))
    with tracing.span("POST /jobs", parent=CLIENT):
        job = bench.submit()
    bench.script.raises(ClusterError("the scheduler is lost"))
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 2)
    bench.end()
    whole, first, second = spans.one("job"), *spans.named("attempt")
    assert parent_of(whole) == id_of(spans.one("POST /jobs"))
    assert parent_of(first) == parent_of(second) == id_of(whole)
    assert {trace_of(one) for one in (whole, first, second)} == {CLIENT.trace_id}
    assert first.status.description == "ClusterError"
    assert second.status.is_unset
    assert whole.attributes is not None
    assert (whole.attributes["gablework.attempts"], whole.attributes["gablework.status"]) == (2, "successful")
    assert {parent_of(one) for one in spans.named("stage inputs")} == {id_of(first), id_of(second)}
    assert parent_of(spans.one("stage outputs")) == id_of(second)


def ending(spans: Spans) -> dict[str, object]:
    """What the one span of a job says about its end."""
    facts = spans.one("job").attributes
    assert facts is not None
    return {name: facts[f"gablework.{name}"] for name in ("job_id", "status", "attempts")}


def test_a_job_that_is_dismissed_while_it_waits_has_a_span(spans: Spans, starting: Starting) -> None:
    service = starting()
    answer = service.client.post("/processes/echo/execution", json={"inputs": {"message": "a"}})
    job = service.store.get(answer.json()["jobID"])
    assert service.client.delete(f"/jobs/{job.job_id}").json()["status"] == "dismissed"
    assert ending(spans) == {"job_id": job.job_id, "status": "dismissed", "attempts": 0}
    assert parent_of(spans.one("job")) == id_of(spans.one("POST /processes/{processID}/execution"))
    # its removal ends nothing
    service.client.delete(f"/jobs/{job.job_id}").raise_for_status()
    assert len(spans.named("job")) == 1


def test_a_job_whose_drivers_were_lost_too_often_has_a_span_that_failed(spans: Spans, bench: Bench) -> None:
    job = bench.submit()
    bench.store.claim("first", lease_s=10.0, max_attempts=2)
    bench.end_leases()
    assert bench.store.claim("second", lease_s=10.0, max_attempts=2) is not None
    assert not spans.named("job")
    bench.end_leases()
    assert bench.store.claim("third", lease_s=10.0, max_attempts=2) is None
    assert ending(spans) == {"job_id": job.job_id, "status": "failed", "attempts": 2}
    assert spans.one("job").status.description == "failed"


def test_a_job_of_a_driver_that_died_for_the_last_time_has_a_span(spans: Spans, bench: Bench) -> None:
    job = bench.submit()
    bench.store.claim("first", lease_s=10.0, max_attempts=1)
    assert bench.store.give_up("first", max_attempts=1) == [job.job_id]
    assert ending(spans) == {"job_id": job.job_id, "status": "failed", "attempts": 1}


@pytest.mark.parametrize("way", ["lease over", "given back", "given up"])
def test_a_job_that_is_dismissed_when_its_driver_is_lost_has_a_span(spans: Spans, bench: Bench, way: str) -> None:
    bench.submit()
    job = bench.store.claim("first", lease_s=10.0, max_attempts=3)
    assert job is not None
    if way == "lease over":
        bench.end_leases()
    bench.store.dismiss(job.job_id)
    if way == "given back":
        bench.store.release(job, lost=False)
    elif way == "given up":
        bench.store.give_up("first", max_attempts=3)
    assert ending(spans) == {"job_id": job.job_id, "status": "dismissed", "attempts": 1}


@pytest.mark.parametrize("step", ["succeed", "fail"])
def test_a_job_has_one_span_if_the_answer_to_its_last_write_was_lost(
    spans: Spans, bench: Bench, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    monkeypatch.setattr("service.driver.attempt_records.DATABASE", Backoff(first_s=0.01))
    committed, lost = getattr(JobStore, step), []

    def then_silence(store: JobStore, *arguments: object, **options: object) -> None:
        with monkeypatch.context() as patch:
            if not lost:
                # the process never gets to what follows a commit
                patch.setattr("service.traces.job_ended", lambda *_: None)
            committed(store, *arguments, **options)
        if not lost:
            lost.append(step)
            raise StoreError("the database does not answer")

    monkeypatch.setattr(JobStore, step, then_silence)
    job = bench.done(*([] if step == "succeed" else [ValueError("a fault")]))
    bench.end()
    assert lost == [step]
    assert ending(spans) == {"job_id": job.job_id, "status": job.status.value, "attempts": 1}


def test_an_end_that_is_not_committed_has_no_span(spans: Spans, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    job = bench.submit()

    def broken(*_arguments: object) -> Job:
        raise StoreError("the database does not answer")

    with monkeypatch.context() as patch:
        patch.setattr("service.store.submissions.get", broken)
        with pytest.raises(StoreError):
            bench.store.dismiss(job.job_id)
    assert bench.store.get(job.job_id).status is JobStatus.ACCEPTED
    assert not spans.named("job")


def test_a_job_without_a_request_begins_a_trace_that_its_id_names(spans: Spans, bench: Bench) -> None:
    job = bench.done()
    bench.end()
    whole = spans.one("job")
    assert trace_of(whole) == int(job.job_id, 16)
    assert parent_of(whole) is None
    assert of_job(job) == Parent(trace_of(whole), id_of(whole), is_sampled=True)
