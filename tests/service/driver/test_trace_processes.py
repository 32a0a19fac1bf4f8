"""The trace of a real job: from the request through driver and workers to its building and its webhook."""

import json
import re
from pathlib import Path

import httpx
import pytest
from processes import Programs, program
from trace_receiver import collecting
from webhook_receiver import receiving

pytestmark = pytest.mark.slow

DEADLINE_S = 300.0
CLIENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
"""The span of the client, in a trace of its own."""


def test_a_trace_leads_from_the_request_to_the_building(programs: Programs, tmp_path: Path, tile: Path) -> None:
    with collecting() as collector, receiving() as receiver:
        environment = {
            "GABLEWORK_STATE": str(tmp_path / "state"),
            "GABLEWORK_WORKERS": "1",
            "GABLEWORK_POLL_S": "0.1",
            "GABLEWORK_WEBHOOK_HOSTS": json.dumps([receiver.origin]),
            "GABLEWORK_TRACE_BUILDING_S": "0",
            "OPENBLAS_NUM_THREADS": "1",
            "OTEL_EXPORTER_OTLP_ENDPOINT": collector.url,
            "OTEL_BSP_SCHEDULE_DELAY": "200",
            "OTEL_SERVICE_NAME": "gablework-under-test",
        }
        served = programs.start("serve", [str(program("gablework")), "serve", "--json", "--port", "0"], env=environment)
        found = served.wait_for(lambda: re.search(r'"url": *"([^"]+)"', served.text), "its URL")
        with httpx.Client(base_url=found[1], timeout=60.0, headers={"traceparent": CLIENT}) as client:
            client.post("/webhooks", json={"url": receiver.url, "events": ["job.successful"]}).raise_for_status()
            answer = client.post("/jobs", files={"tile": (tile.name, tile.read_bytes())})
            assert answer.status_code == 201, answer.text
            job = answer.json()["jobID"]

            def is_over() -> bool:
                status = client.get(f"/jobs/{job}").json()["status"]
                assert status in {"accepted", "running", "successful"}, status
                return status == "successful"

            served.wait_for(is_over, "the end of the job", DEADLINE_S)
            served.wait_for(lambda: collector.named("job") and collector.named("webhook"), "the last spans")
            client.get("/healthz")
        assert served.stop() == 0

    ours = [span for span in collector.spans if span.trace == CLIENT.split("-")[1]]
    assert {span.facts["service.name"] for span in ours} == {"gablework-under-test"}
    (building,) = collector.named("building")
    assert building.facts["gablework.status"] == "ok"
    assert collector.above(building) == ["tile", "stage reconstruct", "attempt", "job", "POST /jobs"]
    assert building.trace == CLIENT.split("-")[1]
    (request,) = collector.named("POST /jobs")
    assert (request.parent, request.facts["http.response.status_code"]) == (CLIENT.split("-")[2], 201)
    stages = {span.name for span in ours if span.name.startswith("stage ")}
    assert {
        "stage inputs",
        "stage ingest",
        "stage split",
        "stage reconstruct",
        "stage publish",
        "stage outputs",
    } <= stages
    (split,) = [span for span in collector.named("tile") if collector.above(span)[0] == "stage split"]
    assert split.facts["gablework.tile"]
    # a worker ran it, not the driver that made the span
    (attempt,) = collector.named("attempt")
    assert not attempt.facts["gablework.driver"].startswith(split.facts["gablework.process"].replace(":", "-"))
    (whole,) = collector.named("job", job_id=job, status="successful")
    assert whole.began_ns <= attempt.began_ns <= building.began_ns <= building.ended_ns <= attempt.ended_ns
    (upload,) = collector.named("upload")
    assert collector.above(upload) == ["POST /jobs"]
    assert upload.facts["gablework.size_bytes"] == tile.stat().st_size
    # the receiver continues the trace
    (webhook,) = collector.named("webhook")
    assert collector.above(webhook) == ["job", "POST /jobs"]
    (message,) = receiver.accepted
    assert message.headers["traceparent"] == f"00-{webhook.trace}-{webhook.id}-01"
    assert not any(span.failed for span in ours)
    assert not [span for span in collector.spans if "healthz" in span.name]
