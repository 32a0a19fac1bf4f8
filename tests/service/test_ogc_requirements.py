"""Requirements of OGC API - Processes 1.0 (OGC 18-062r2), one check each, by the last parts of their URIs."""

import base64
import json
from collections.abc import Callable

import finished_runs as runs
import jsonschema
import pytest
from html_pages import links_of
from live_service import POINTS
from openapi_spec_validator import OpenAPIV30SpecValidator
from webhook_store_contract import claim_next, settle

from service.driver.webhooks import Sender
from service.jobs import Fault, JobFailure, JobStatus, Subscriber
from service.outputs.kinds import ON_REQUEST
from service.routes.landing import CONFORMANCE
from service.settings import ServiceSettings

OGC = "http://www.opengis.net/def/rel/ogc/1.0/"
PROBLEM = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
NONE = "0" * 32
CHECKS: dict[str, Callable[[runs.Service], None]] = {}
"""The checks by requirement; the class of a requirement comes before the slash."""


def requirement(*names: str) -> Callable[[Callable[[runs.Service], None]], Callable[[runs.Service], None]]:
    """Adds a check to the table."""

    def add(check: Callable[[runs.Service], None]) -> Callable[[runs.Service], None]:
        for name in names:
            assert name not in CHECKS
            CHECKS[name] = check
        return check

    return add


SUBSCRIBER = {f"{name}_uri": f"https://8.8.8.8/{name}" for name in ("success", "in_progress", "failed")}
CONTEXT: dict[str, str] = {}
"""Ids that the checks use."""


@pytest.fixture(scope="module", autouse=True)
def context(service: runs.Service) -> None:
    """An upload, and jobs that are over."""
    sent = service.client.post("/uploads?filename=points.xyz", content=POINTS)
    assert sent.status_code == 201
    CONTEXT["upload"] = sent.json()["uploadID"]
    # before any job waits: a driver would claim that one first
    CONTEXT["finished"] = service.finished()
    CONTEXT["reported"] = service.finished(subscriber=Subscriber(**SUBSCRIBER, base="http://127.0.0.1"))
    reported = service.running(subscriber=Subscriber(**SUBSCRIBER))
    service.store.fail(reported, JobFailure(fault=Fault.INPUT, detail="tile.laz is empty"))
    CONTEXT["reported as failed"] = reported.job_id
    CONTEXT["raw"] = service.finished(response="raw", outputs=("report",))
    CONTEXT["failed"] = service.failed(JobFailure(fault=Fault.INPUT, detail="tile.laz is empty"))


def rels(document: dict) -> set[str]:
    return {link["rel"] for link in document["links"]}


def execute(service: runs.Service, tiles: object = None, headers: dict | None = None, **more: object):
    tile = {"href": f"/uploads/{CONTEXT['upload']}"} if tiles is None else tiles
    body = {"inputs": {"tiles": tile, "crs": "EPSG:28992", **more.pop("inputs", {})}, **more}  # type: ignore[dict-item]
    return service.client.post("/processes/reconstruct/execution", json=body, headers=headers)


def accepted(answer) -> dict:
    assert answer.status_code == 201, answer.text
    status = answer.json()
    assert answer.headers["location"].endswith(f"/jobs/{status['jobID']}")
    assert status["status"] == "accepted"
    return status


def problem(answer, status: int, kind: str) -> None:
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == PROBLEM + kind


# --- core: the service


@requirement("core/landingpage-op", "core/landingpage-success")
def landing_page(service: runs.Service) -> None:
    answer = service.client.get("/")
    assert answer.status_code == 200
    found = rels(answer.json())
    assert found & {"service-desc", "service-doc"}
    assert found >= {f"{OGC}conformance", f"{OGC}processes", f"{OGC}job-list"}
    for link in answer.json()["links"]:
        assert service.client.get(link["href"]).status_code == 200


@requirement("core/api-definition-op", "core/api-definition-success", "oas30/oas-definition-1", "oas30/completeness")
def api_definition(service: runs.Service) -> None:
    answer = service.client.get("/openapi.json")
    assert answer.status_code == 200
    assert list(OpenAPIV30SpecValidator(answer.json()).iter_errors()) == []
    for path in ("/", "/conformance", "/processes", "/processes/{processID}", "/jobs", "/jobs/{jobID}"):
        assert "get" in answer.json()["paths"][path]


@requirement("core/conformance-op", "core/conformance-success")
def conformance(service: runs.Service) -> None:
    declared = service.client.get("/conformance").json()["conformsTo"]
    assert declared[: len(CONFORMANCE)] == list(CONFORMANCE)
    assert {uri.rpartition("/")[2] for uri in CONFORMANCE} == {name.partition("/")[0] for name in CHECKS}


@requirement("core/http")
def http(service: runs.Service) -> None:
    answer = service.client.get("/conformance")
    assert answer.http_version == "HTTP/1.1"


# --- core: processes


@requirement("core/process-list", "core/process-list-success", "core/pl-links")
def process_list(service: runs.Service) -> None:
    answer = service.client.get("/processes")
    assert answer.status_code == 200
    assert "self" in rels(answer.json())
    for process in answer.json()["processes"]:
        assert {"id", "version"} <= set(process)


@requirement("core/pl-limit-definition", "core/pl-limit-response")
def process_limit(service: runs.Service) -> None:
    assert len(service.client.get("/processes?limit=1").json()["processes"]) == 1
    assert service.client.get("/processes?limit=0").status_code == 400
    assert service.client.get("/processes?limit=10000").status_code == 200
    assert service.client.get("/processes?limit=10001").status_code == 400


@requirement(
    "core/process",
    "core/process-success",
    "ogc-process-description/json-encoding",
    "ogc-process-description/inputs-def",
    "ogc-process-description/input-def",
    "ogc-process-description/outputs-def",
    "ogc-process-description/output-def",
)
def process(service: runs.Service) -> None:
    for entry in service.client.get("/processes").json()["processes"]:
        described = service.client.get(f"/processes/{entry['id']}").json()
        assert described["jobControlOptions"] == ["async-execute", "dismiss"]
        assert described["outputTransmission"] == ["reference"]
        for member in (*described["inputs"].values(), *described["outputs"].values()):
            assert {"title", "schema"} <= set(member)
            jsonschema.Draft202012Validator.check_schema(member["schema"])


@requirement("core/process-exception-no-such-process")
def no_such_process(service: runs.Service) -> None:
    problem(service.client.get("/processes/paint"), 404, "no-such-process")


# --- core: jobs


@requirement(
    "core/job-creation-op",
    "core/job-creation-request",
    "core/job-creation-default-execution-mode",
    "core/job-creation-auto-execution-mode",
    "core/job-creation-success-async",
    "core/job-creation-input-ref",
)
def job_creation(service: runs.Service) -> None:
    accepted(execute(service))
    preferred = execute(service, headers={"Prefer": "respond-async"})
    accepted(preferred)
    assert preferred.headers["preference-applied"] == "respond-async"


@requirement("core/job-creation-input-array")
def input_array(service: runs.Service) -> None:
    other = service.client.post("/uploads?filename=b.xyz", content=POINTS).json()["uploadID"]
    status = accepted(execute(service, [{"href": f"/uploads/{upload}"} for upload in (CONTEXT["upload"], other)]))
    assert len(service.store.get(status["jobID"]).request.tiles) == 2


@requirement(
    "core/job-creation-input-inline", "core/job-creation-input-inline-mixed", "core/job-creation-input-inline-object"
)
def inline_inputs(service: runs.Service) -> None:
    ring = [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": ring}}
    outlines = {"type": "FeatureCollection", "features": [feature]}
    inputs = {"title": "inline", "footprints": {"value": outlines}, "settings": {"value": {"classes": "ignore"}}}
    request = service.store.get(accepted(execute(service, inputs=inputs))["jobID"]).request
    assert (request.title, request.settings) == ("inline", {"classes": "ignore"})
    assert request.footprints is not None


@requirement("core/job-creation-input-inline-binary")
def inline_binary(service: runs.Service) -> None:
    value = {"value": base64.b64encode(POINTS).decode(), "encoding": "base64", "mediaType": "text/plain"}
    status = accepted(execute(service, value))
    (tile,) = service.store.get(status["jobID"]).request.tiles
    assert service.store.upload(tile.value).size_bytes == len(POINTS)


@requirement("core/job-creation-input-inline-bbox")
def inline_box(service: runs.Service) -> None:
    status = accepted(execute(service, inputs={"bbox": {"bbox": [0, 0, 9, 9], "crs": "EPSG:28992"}}))
    assert service.store.get(status["jobID"]).request.bbox == (0.0, 0.0, 9.0, 9.0)


@requirement("core/job-creation-input-validation")
def input_validation(service: runs.Service) -> None:
    before = len(service.client.get("/jobs?limit=1000").json()["jobs"])
    answer = execute(service, inputs={"bbox": [0, 0], "colour": 1})
    assert answer.status_code == 400
    assert len(answer.json()["errors"]) == 2
    assert len(service.client.get("/jobs?limit=1000").json()["jobs"]) == before


@requirement("core/job-creation-default-outputs")
def default_outputs(service: runs.Service) -> None:
    all_outputs = service.client.get("/processes/reconstruct").json()["outputs"]
    # an input says whether there are those on request
    default = [name for name in all_outputs if name not in ON_REQUEST]
    assert list(service.client.get(f"/jobs/{CONTEXT['finished']}/results").json()) == default


@requirement("core/job", "core/job-success")
def job(service: runs.Service) -> None:
    status = service.client.get(f"/jobs/{CONTEXT['finished']}").json()
    assert {"jobID", "status", "type"} <= set(status)
    assert (status["status"], status["type"], status["progress"]) == ("successful", "process", 100)
    assert f"{OGC}results" in rels(status)


@requirement("core/job-exception-no-such-job", "core/job-results-exception-no-such-job")
def no_such_job(service: runs.Service) -> None:
    for path in (f"/jobs/{NONE}", f"/jobs/{NONE}/results"):
        problem(service.client.get(path), 404, "no-such-job")


@requirement("core/job-results", "core/job-results-async-document")
def results(service: runs.Service) -> None:
    answer = service.client.get(f"/jobs/{CONTEXT['finished']}/results")
    assert answer.status_code == 200
    for output in answer.json().values():
        assert service.client.get(output["href"]).headers["content-type"].startswith(output["type"])


@requirement("core/job-results-async-raw-ref")
def raw_results(service: runs.Service) -> None:
    answer = service.client.get(f"/jobs/{CONTEXT['raw']}/results")
    assert (answer.status_code, answer.content) == (204, b"")
    assert 'title="report"' in answer.headers["link"]


@requirement("core/job-results-failed")
def failed_results(service: runs.Service) -> None:
    answer = service.client.get(f"/jobs/{CONTEXT['failed']}/results")
    assert answer.status_code == 422
    assert answer.json()["detail"] == "tile.laz is empty"


@requirement("core/job-results-exception-results-not-ready")
def results_not_ready(service: runs.Service) -> None:
    problem(service.client.get(f"/jobs/{accepted(execute(service))['jobID']}/results"), 404, "result-not-ready")


# --- json and html


@requirement("json/definition", "json/content")
def json_everywhere(service: runs.Service) -> None:
    for path in ("/", "/conformance", "/processes", "/processes/reconstruct", "/jobs"):
        assert service.client.get(path, headers={"Accept": "application/json"}).headers["content-type"] == (
            "application/json"
        )


@requirement("html/definition", "html/content")
def html_everywhere(service: runs.Service) -> None:
    for path in ("/conformance", "/processes", "/processes/reconstruct", "/jobs", f"/jobs/{CONTEXT['finished']}"):
        document = service.client.get(path, headers={"Accept": "application/json"}).json()
        page = service.client.get(path, headers={"Accept": "text/html"})
        assert page.headers["content-type"].startswith("text/html")
        assert {link["href"] for link in document.get("links", ())} <= set(links_of(page.text))
    assert service.client.get("/", headers={"Accept": "text/html"}).headers["content-type"].startswith("text/html")


# --- OpenAPI


@requirement("oas30/oas-impl", "oas30/exceptions-codes", "oas30/security")
def declared_answers(service: runs.Service) -> None:
    document = service.client.get("/openapi.json").json()
    for path, item in document["paths"].items():
        for operation in item.values():
            assert any(code.startswith("2") for code in operation["responses"]), path
            assert any(code.startswith("4") for code in operation["responses"]) or path in {"/healthz", "/readyz"}
    assert document["components"]["securitySchemes"]


# --- the list of jobs


@requirement("job-list/job-list-op", "job-list/job-list-success", "job-list/links")
def job_list(service: runs.Service) -> None:
    answer = service.client.get("/jobs")
    assert answer.status_code == 200
    assert "self" in rels(answer.json())


@requirement(
    "job-list/type-definition",
    "job-list/type-response",
    "job-list/processID-definition",
    "job-list/processid-response",
    "job-list/status-definition",
    "job-list/status-response",
)
def job_filters(service: runs.Service) -> None:
    accepted(execute(service))
    for status in (JobStatus.ACCEPTED, JobStatus.SUCCESSFUL):
        listed = service.client.get(f"/jobs?status={status}&type=process&processID=reconstruct,paint").json()["jobs"]
        assert {job["status"] for job in listed} == {status.value}
    assert service.client.get("/jobs?processID=paint").json()["jobs"] == []
    assert service.client.get("/jobs?status=lost").status_code == 400


@requirement(
    "job-list/datetime-definition",
    "job-list/datetime-response",
    "job-list/duration-definition",
    "job-list/duration-response",
)
def job_times(service: runs.Service) -> None:
    created = service.client.get(f"/jobs/{CONTEXT['finished']}").json()["created"]
    for interval in (created, f"../{created}", f"{created}/.."):
        listed = service.client.get("/jobs", params={"datetime": interval, "limit": 1000}).json()["jobs"]
        assert CONTEXT["finished"] in {job["jobID"] for job in listed}
    assert service.client.get("/jobs?datetime=1990-01-01T00:00:00Z").json()["jobs"] == []
    assert service.client.get("/jobs?minDuration=1000000").json()["jobs"] == []
    assert service.client.get("/jobs?maxDuration=1000000&status=successful").json()["jobs"]


@requirement("job-list/limit-definition", "job-list/limit-response")
def job_limit(service: runs.Service) -> None:
    page = service.client.get("/jobs?limit=1").json()
    assert len(page["jobs"]) == 1
    assert "next" in rels(page)
    assert service.client.get("/jobs?limit=0").status_code == 400


# --- callback


@requirement("callback/job-callback")
def callback(service: runs.Service) -> None:
    uris = {"successUri": SUBSCRIBER["success_uri"], "failedUri": SUBSCRIBER["failed_uri"]}
    assert accepted(execute(service, subscriber=uris))["request"]["subscriber"] == uris
    sent: list[tuple[str, dict]] = []

    def send(url: str, *, body: bytes, **_rest: object) -> tuple[int, None]:
        sent.append((url, json.loads(body)))
        return 200, None

    sender = Sender(service.store, service.folder, ServiceSettings(state=service.folder.root), name="d", send=send)
    while (parcel := claim_next(service.store)) is not None:
        settle(service.store, parcel, sender.attempt(parcel))
    results = service.client.get(f"/jobs/{CONTEXT['reported']}/results").json()
    assert [body for url, body in sent if url == SUBSCRIBER["success_uri"]] == [results]
    failed = [body for url, body in sent if url == SUBSCRIBER["failed_uri"]]
    assert [(body["jobID"], body["status"]) for body in failed] == [(CONTEXT["reported as failed"], "failed")]
    started = [body for url, body in sent if url == SUBSCRIBER["in_progress_uri"]]
    assert {body["status"] for body in started} == {"running"}
    assert {body["jobID"] for body in started} == {CONTEXT["reported"], CONTEXT["reported as failed"]}


# --- dismissal


@requirement("dismiss/job-dismiss-op", "dismiss/job-dismiss-success")
def dismissal(service: runs.Service) -> None:
    job_id = accepted(execute(service))["jobID"]
    answer = service.client.delete(f"/jobs/{job_id}")
    assert (answer.status_code, answer.json()["status"]) == (200, "dismissed")
    problem(service.client.delete(f"/jobs/{NONE}"), 404, "no-such-job")


@pytest.mark.parametrize("name", list(CHECKS))
def test_the_requirement_is_met(name: str, service: runs.Service) -> None:
    CHECKS[name](service)


def test_the_table_has_a_check_for_every_declared_class() -> None:
    assert {uri.rpartition("/")[2] for uri in CONFORMANCE} == {name.partition("/")[0] for name in CHECKS}
    assert len(CHECKS) > 50
