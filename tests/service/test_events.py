"""Events of a job, as a stream that can be taken up again and as a list."""

import datetime as dt
import json
import threading
from collections.abc import Iterator

from finished_runs import problem

from service.jobs import JobEvent, JobStatus
from service.keys import Scope, digest_of
from service.routes import events as events_routes


def event(kind: str, **values: object) -> JobEvent:
    return JobEvent(sequence=0, at=dt.datetime.now(tz=dt.UTC), kind=kind, **values)


def parsed(text: str) -> Iterator[dict]:
    """Events of a stream: comments and the time to come again are no events."""
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith((":", "retry")))
        if "data" in fields:
            reported = json.loads(fields["data"])
            assert fields["event"] == reported["kind"]
            assert fields["id"] == str(reported["id"])
            yield reported


def finished(service) -> str:
    job = service.running()
    service.store.record(job, [event("stage", stage="split", progress=10), event("warning", message="two\nlines")])
    service.store.succeed(job, message="done", summary={})
    return job.job_id


def streamed(service, job_id: str, **headers: str):
    """The answer to a request for a job's stream."""
    return service.client.get(f"/jobs/{job_id}/events", headers={"Accept": "text/event-stream", **headers})


def test_the_stream_of_a_finished_job_says_all_and_ends(local_service) -> None:
    answer = streamed(local_service, finished(local_service))
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert answer.text.startswith("retry: ")
    reported = list(parsed(answer.text))
    assert [entry["kind"] for entry in reported] == ["status", "status", "stage", "warning", "status"]
    assert [entry.get("status") for entry in reported] == ["accepted", "running", None, None, "successful"]
    assert reported[3]["message"] == "two\nlines"
    assert [entry["id"] for entry in reported] == sorted({entry["id"] for entry in reported})


def test_a_broken_stream_goes_on_where_it_broke(local_service) -> None:
    job_id = finished(local_service)
    whole = list(parsed(streamed(local_service, job_id).text))
    rest = streamed(local_service, job_id, **{"Last-Event-ID": str(whole[1]["id"])})
    assert list(parsed(rest.text)) == whole[2:]


def test_a_client_with_all_events_of_a_finished_job_gets_204(local_service) -> None:
    answer = streamed(local_service, finished(local_service), **{"Last-Event-ID": "999"})
    assert answer.status_code == 204


def test_an_odd_last_event_id_counts_for_nothing(local_service) -> None:
    job_id = finished(local_service)
    for odd in ("x", "-1", "1e3", ""):
        answer = streamed(local_service, job_id, **{"Last-Event-ID": odd})
        assert len(list(parsed(answer.text))) == 5


def test_a_stream_follows_a_job_that_runs_until_it_is_over(starting) -> None:
    service = starting(poll_s=0.01)
    job = service.running()

    def drive() -> None:
        for number in range(20):
            service.store.record(job, [event("warning", message=f"number {number}", progress=number)])
        service.store.succeed(job, message="done", summary={})

    driver = threading.Thread(target=drive)
    driver.start()
    reported = list(parsed(streamed(service, job.job_id).text))
    driver.join(60.0)
    assert [entry["message"] for entry in reported if entry["kind"] == "warning"] == [f"number {n}" for n in range(20)]
    assert reported[-1]["status"] == JobStatus.SUCCESSFUL


def test_a_stream_without_events_shows_that_it_lives_and_ends_when_the_job_is_gone(starting, monkeypatch) -> None:
    monkeypatch.setattr(events_routes, "KEEP_ALIVE_S", 0.0)
    service = starting(poll_s=0.01)
    job = service.running()
    service.store.dismiss(job.job_id)
    asked = threading.Event()
    original = service.store.get

    def get(job_id: str, **options: object):
        if asked.is_set() and original(job_id).status is JobStatus.RUNNING:
            service.store.dismissed(job)
            service.store.remove(job_id)
        asked.set()
        return original(job_id, **options)

    monkeypatch.setattr(service.store, "get", get)
    answer = streamed(service, job.job_id)
    assert [entry.get("status") for entry in parsed(answer.text)] == ["accepted", "running"]


def test_pollers_get_a_list_and_where_to_go_on(local_service) -> None:
    job_id = finished(local_service)
    page = local_service.client.get(f"/jobs/{job_id}/events?limit=2").json()
    assert [entry["status"] for entry in page["events"]] == ["accepted", "running"]
    following = next(link["href"] for link in page["links"] if link["rel"] == "next")
    assert [entry["kind"] for entry in local_service.client.get(following).json()["events"]] == ["stage", "warning"]
    assert local_service.client.get(f"/jobs/{job_id}/events?after=999").json()["events"] == []


def test_more_streams_than_allowed_are_refused_and_counted_down_again(starting) -> None:
    service = starting(max_event_streams=1)
    job_id = finished(service)
    streams = service.client.app.state.streams
    streams.open(None, 1, 1)
    refused = streamed(service, job_id)
    assert refused.status_code == 429
    assert int(refused.headers["retry-after"]) >= 1
    streams.close(None)
    for _ in range(3):
        assert streamed(service, job_id).status_code == 200
    assert streams.count == 0


def test_one_key_does_not_take_the_streams_of_all(starting) -> None:
    service = starting(max_event_streams=3, max_event_streams_per_key=1)
    mine, others = service.key(Scope.ADMIN), service.key(Scope.ADMIN)
    job_id, streams = finished(service), service.client.app.state.streams
    streams.open(owner_of(service, mine), 3, 1)
    refused = streamed(service, job_id, **mine)
    assert "1 event streams of this key are open" in problem(refused, 429, "too-many-requests")
    assert int(refused.headers["retry-after"]) >= 1
    assert streamed(service, job_id, **others).status_code == 200
    streams.close(owner_of(service, mine))
    assert streamed(service, job_id, **mine).status_code == 200
    assert streams.count == 0


def owner_of(service, header: dict[str, str]) -> str:
    """The id of a key."""
    key = service.store.key_by_digest(digest_of(header["Authorization"].removeprefix("Bearer ")))
    return key.key_id


def test_a_process_that_ends_ends_its_streams(starting) -> None:
    service = starting(poll_s=0.01)
    job = service.running()
    service.client.app.state.streams.closing = True
    answer = streamed(service, job.job_id)
    assert answer.status_code == 200
    assert list(parsed(answer.text)) == []
