"""The API against its own OpenAPI document: generated requests, valid and not, and every answer held against it.

CI runs some hundred on each kind of database; `GABLEWORK_OPENAPI_CASES=10000 .venv/bin/python -m pytest -m slow
tests/service/openapi -s` runs more.
"""

import base64
import contextlib
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

import finished_runs
import hypothesis
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given
from live_service import POINTS
from processes import postgres_server  # noqa: F401 - a fixture
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import negative_data_rejection, positive_data_acceptance

from pipeline.schedule import Cron
from service.schedules import Definition
from service.webhooks import EventType

schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

CASES = int(os.environ.get("GABLEWORK_OPENAPI_CASES", "250"))
"""Requests to be generated for each kind of database, at least."""

EXCLUDED = [positive_data_acceptance]
"""Whether an upload is there or a host is allowed, a schema cannot say: such a request is valid and yet refused.
`MEANING` is the check instead."""

MEANING = re.compile(
    # what is there, and what fits to it
    r"there is no upload|is not a property that can be used here|crs is .*: use one of http|this job ran one|"
    r"query outputs names|the job has no output|job \S+ is (accepted|running)|only native is possible|has the ETag|"
    r"the Idempotency-Key was used for another|the CRS of the tiles is unknown|which is not known|give execute, too|"
    # what a process takes: its description has the schema
    r"^execute: |^\w+ is missing|is not an (in|out)put|^(settings|subscriber|crs)(:| is)|which is for 3D Tiles|"
    # numbers and words that fit together
    r"use an end that is not before|use a day that exists|lies (north|east) of|longitudes reach|no vertical axis|"
    r"with a positive width and depth|or a property of its queryables|a range goes up|this date never occurs|"
    r"query filter|"
    # the names and the content of files, and one of several parameters
    r"the file has no name|the file's name is|the digest is|Digest differ|the body is not a form|"
    r"Upload-Metadata has no filename|sha256 in Upload-Metadata|write a name, a space|"
    r"Upload-Metadata has .* twice"
)
"""Why a request may be refused that is valid by its schema. Other reasons are rules that the schema does not state."""
CONTENT = {"unusable-input", "outside-area-of-use"}
"""Refusals of a file that was read."""


@pytest.fixture(scope="module", params=["SQLite", "PostgreSQL"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[finished_runs.Service]:
    url = None
    if request.param == "PostgreSQL":
        url = request.getfixturevalue("postgres_server").create_database(with_tables=True)
    with finished_runs.service(tmp_path_factory.mktemp("state"), url) as running:
        yield running


class Ids:
    """Ids that exist, for every second request: else nearly all answers would be that there is no such thing."""

    def __init__(self, service: finished_runs.Service) -> None:
        self._service = service
        alone = service.finished()
        self._finished = itertools.cycle([alone, service.compared()])
        page = service.client.get(f"/jobs/{alone}/buildings").json()
        self._buildings = itertools.cycle([feature["id"] for feature in page["features"]])
        self._collections = itertools.cycle([f"{alone}.{table}" for table in ("buildings", "planes", "rejected")])
        self._outputs = itertools.cycle(["buildings", "report", "cityjson", "meshes", "page", "summary", "archive"])
        self._processes = itertools.cycle(["reconstruct", "compare", "classify"])
        self._methods = itertools.cycle(finished_runs.LABELS)
        self._turn = itertools.count()
        sent = service.client.post("/uploads?filename=points.xyz", content=POINTS)
        assert sent.status_code == 201, sent.text
        self._upload = sent.json()["uploadID"]
        name = base64.b64encode(b"points.xyz").decode()
        self._tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "5", "Upload-Metadata": f"filename {name}"}
        self._schedules = itertools.cycle([self._schedule() for _ in range(3)])
        self._webhooks = itertools.cycle([self._webhook() for _ in range(3)])
        self._waiting()
        listed = service.client.get("/webhooks/deliveries").json()["deliveries"]
        self._deliveries = itertools.cycle([one["deliveryID"] for one in listed])

    def _schedule(self) -> str:
        asked = finished_runs.JobRequest(tiles=(finished_runs.InputReference(kind="upload", value=self._upload),))
        definition = Definition(cron=Cron("30 2 * * *", "Europe/Amsterdam"), request=asked)
        return self._service.store.schedules.create(definition, owner=None, most=10**6).schedule_id

    def _unfinished(self) -> str:
        made = self._service.client.post("/uploads/tus", headers=self._tus)
        if made.status_code == 429:
            return self._upload
        assert made.status_code == 201, made.text
        return str(made.headers["location"].rpartition("/")[2])

    def _webhook(self) -> str:
        events = [EventType.ACCEPTED]
        # there is no driver here that would send
        made, _ = self._service.store.webhooks.create("https://8.8.8.8/", events=events, base="http://127.0.0.1")
        return made.endpoint_id

    def _execute(self) -> dict[str, Any]:
        return {"inputs": {"tiles": [{"href": f"/uploads/{self._upload}"}], "crs": "EPSG:28992"}}

    def _waiting(self) -> str:
        tile = finished_runs.InputReference(kind="path", value="/srv/tile.laz")
        request = finished_runs.JobRequest(tiles=(tile,))
        return self._service.store.create(request, owner=None).job_id

    def put_into(self, case: Any, mode: GenerationMode) -> None:
        parameters = case.path_parameters or {}
        if next(self._turn) % 2 and not (case.path.startswith("/uploads/tus") and mode is GenerationMode.NEGATIVE):
            return
        process = next(self._processes)
        if case.path.endswith("/execution") and mode is GenerationMode.POSITIVE:
            case.body = self._execute()
            if process == "compare":
                case.body["inputs"]["methods"] = ["fuzzy-sart", "fuzzy-sart:faithful"]
        if case.path.startswith("/schedules") and mode is GenerationMode.POSITIVE and isinstance(case.body, dict):
            # what a schema cannot say of the words that were made up, and what a client would send
            fitting = {"cron": "*/5 * * * *", "timeZone": "America/New_York", "execute": self._execute()}
            is_new = case.path == "/schedules"
            case.body |= {name: value for name, value in fitting.items() if is_new or name in case.body}
            if case.body.get("processID") == "compare":
                del case.body["processID"]
        if "scheduleID" in parameters:
            parameters["scheduleID"] = self._schedule() if case.method == "DELETE" else next(self._schedules)
        if "webhookID" in parameters:
            parameters["webhookID"] = self._webhook() if case.method == "DELETE" else next(self._webhooks)
        if "deliveryID" in parameters:
            parameters["deliveryID"] = next(self._deliveries)
        is_webhook = case.path.startswith("/webhooks") and mode is GenerationMode.POSITIVE
        if is_webhook and isinstance(case.body, dict) and "url" in case.body:
            case.body["url"] = "https://8.8.8.8/hook"
        if "processID" in parameters:
            parameters["processID"] = process
        if mode is GenerationMode.POSITIVE and "method" in (case.query or {}):
            case.query["method"] = next(self._methods)
        if "jobID" in parameters:
            parameters["jobID"] = self._waiting() if case.method == "DELETE" else next(self._finished)
        if case.path.startswith("/uploads/tus"):
            fitting = self._tus if mode is GenerationMode.POSITIVE else {"Tus-Resumable": "1.0.0"}
            case.headers = {**(case.headers or {}), **fitting}
        if "uploadID" in parameters and case.path.startswith("/uploads/tus"):
            parameters["uploadID"] = self._unfinished()
        elif "uploadID" in parameters and case.method == "GET":
            parameters["uploadID"] = self._upload
        if "buildingID" in parameters:
            parameters["buildingID"] = next(self._buildings)
        if "collectionID" in parameters:
            parameters["collectionID"] = next(self._collections)
        if "featureID" in parameters:
            parameters["featureID"] = next(self._buildings)
        if "outputID" in parameters:
            parameters["outputID"] = next(self._outputs)


def unstated(response: Any) -> list[str]:
    """The reasons of a refusal that the schema could have stated."""
    if not response.content:  # the answer to HEAD
        return []
    body = response.json()
    if body["type"].rpartition(":")[2] in CONTENT:
        return []
    return [fault for fault in body.get("errors") or [body["detail"]] if not MEANING.search(fault)]


class Interrogation:
    """What was asked, what came back, and what was wrong with it."""

    def __init__(self, ids: Ids) -> None:
        self._ids = ids
        self.answers = Counter[int]()
        self.failures: dict[str, str] = {}

    def ask(self, operation: Any, mode: GenerationMode, most: int) -> None:
        """Generate requests of one operation."""
        label = f"{operation.method.upper()} {operation.path}"

        @given(case=operation.as_strategy(generation_mode=mode))
        @hypothesis.settings(
            max_examples=most,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        def one(case: Any) -> None:
            self._ids.put_into(case, mode)
            response = case.call(base_url="http://127.0.0.1:8000")
            self.answers[response.status_code] += 1
            if mode is GenerationMode.POSITIVE and response.status_code in {400, 412, 415, 422}:
                for fault in unstated(response):
                    asked = f"{case.query} {case.headers} {case.body!r}"[:1500]
                    self.failures.setdefault(f"{label} {fault[:60]}", f"{label} is valid and refused: {fault}\n{asked}")
            # tus demands 412 of a request without its version, which the check does not know as a refusal
            excluded = [*EXCLUDED, *([negative_data_rejection] if response.status_code == 412 else [])]
            try:
                case.validate_response(response, excluded_checks=excluded)
            except BaseExceptionGroup as group:
                for fault in group.exceptions:
                    self.failures.setdefault(f"{label}: {type(fault).__name__} {str(fault)[:160]}", str(group))
            except AssertionError as fault:
                self.failures.setdefault(f"{label}: {type(fault).__name__} {str(fault)[:160]}", str(fault))

        one()


@pytest.mark.slow
def test_generated_requests_meet_no_fault_and_every_answer_fits_the_document(service: finished_runs.Service) -> None:
    schema = schemathesis.openapi.from_asgi("/openapi.json", service.client.app, headers={"host": "127.0.0.1"})
    operations = [found.ok() for found in schema.get_all_operations()]
    # an operation that takes nothing has a case or two
    variable = [operation for operation in operations if len(operation.query) + len(operation.path_parameters)]
    most = -(-CASES // (2 * len(variable)))
    asked = Interrogation(Ids(service))
    for operation in operations:
        asked.ask(operation, GenerationMode.POSITIVE, most)
        # where nothing can be wrong, as with an id that is any text, there are no wrong requests
        with contextlib.suppress(hypothesis.errors.Unsatisfiable):
            asked.ask(operation, GenerationMode.NEGATIVE, most)
    for operation in itertools.cycle(variable):
        if sum(asked.answers.values()) >= CASES:
            break
        asked.ask(operation, GenerationMode.POSITIVE, most)
    answers = sorted(asked.answers.items())
    print(f"\n{sum(asked.answers.values())} requests over {len(operations)} operations; answers by status: {answers}")
    assert not asked.failures, "\n\n".join(asked.failures.values())
    assert {200, 201, 204, 400, 404} <= set(asked.answers), "the requests did not reach the paths"
