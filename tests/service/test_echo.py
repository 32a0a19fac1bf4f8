"""The process `echo`: for tests of clients and networks."""

import pytest
from driver_bench import Bench
from finished_runs import faults_of

from service.fetching import JobFiles
from service.jobs import JobStatus

PLACE = "/processes/echo/execution"


def no_inputs(*_: object, **__: object) -> JobFiles:
    return JobFiles(tiles=[])


def test_it_takes_a_message_and_no_tile(local_service) -> None:
    described = local_service.client.get("/processes/echo").json()
    assert set(described["inputs"]) == {"message", "delay", "title", "priority"}
    assert set(described["outputs"]) == {"echo"}
    answer = local_service.client.post(PLACE, json={"inputs": {"message": "hello", "delay": 2}})
    request = local_service.request_of(answer)
    assert (request.process_id, request.tiles, request.echo) == ("echo", (), {"message": "hello", "delay": 2.0})
    again = local_service.client.post(PLACE, json=answer.json()["request"])
    assert local_service.request_of(again) == request


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        ({}, "message is missing"),
        ({"message": "a", "delay": 61}, "delay is 61"),
        ({"message": "a", "tiles": [{"href": "/a.laz"}]}, '"tiles" is not an input'),
        ({"message": 7}, "message is 7"),
    ],
)
def test_its_faults_are_reported(local_service, inputs: dict, words: str) -> None:
    assert words in faults_of(local_service.client.post(PLACE, json={"inputs": inputs}))


def test_a_driver_answers_with_the_message(bench: Bench) -> None:
    bench.tools |= {"gather": no_inputs}
    job = bench.submit({"process_id": "echo", "echo": {"message": "héllo", "delay": 0.01}})
    bench.driver()
    assert bench.over(job).status is JobStatus.SUCCESSFUL
    written = bench.folder.outputs(job.job_id, 1) / "echo.json"
    assert written.read_text(encoding="utf-8") == '{"message": "héllo"}'


def test_a_dismissal_ends_the_delay(bench: Bench) -> None:
    bench.tools |= {"gather": no_inputs}
    job = bench.submit({"process_id": "echo", "echo": {"message": "a", "delay": 3600.0}})
    bench.driver()
    bench.becomes(job, JobStatus.RUNNING)
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED
