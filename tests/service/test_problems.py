"""Errors as problem documents, and what stands before the routes."""

import pytest
from sqlalchemy import exc as sql

from pipeline.errors import EmptyInputError, SettingsError
from service import errors
from service.guard import DATA_POLICY
from service.jobs import Fault, JobFailure
from service.problems import FAILURES, INTERNAL, KINDS, JobFailedError, answer_error, kind_of
from service.routes import polling

FIELDS = {"type", "title", "status", "detail", "instance"}


def subclasses(kind: type) -> set[type]:
    return {kind}.union(*(subclasses(found) for found in kind.__subclasses__()))


def test_every_error_of_the_service_that_a_client_can_meet_is_a_kind_of_its_own() -> None:
    unseen = {errors.ServiceError, errors.LimitError, errors.LeaseLostError, errors.StartUpError, JobFailedError}
    # between the processes of a driver
    unseen |= {errors.AttemptEndedError, errors.NoProcessError, errors.UnexpectedError}
    untold = {kind for kind in subclasses(errors.ServiceError) if kind.__module__.startswith("service.")} - unseen
    assert {kind.__name__ for kind in untold if kind not in KINDS} == set()


def test_types_are_different_for_different_problems() -> None:
    reported: dict[str, set[tuple[int, str]]] = {}
    for kind in (*KINDS.values(), *FAILURES.values(), INTERNAL):
        reported.setdefault(kind.type_uri, set()).add((kind.status, kind.title))
    assert all(len(words) == 1 for words in reported.values())


def test_every_cause_of_a_failed_job_has_its_answer() -> None:
    assert set(FAILURES) == set(Fault)
    clients = {Fault.INPUT, Fault.SETTINGS, Fault.REFUSED}
    for fault, kind in FAILURES.items():
        assert (kind.status < 500) == (fault in clients)
        failure = JobFailure(fault=fault, detail="tile.laz is empty")
        assert kind_of(JobFailedError(failure)) is kind


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (errors.NoSuchJobError("x"), 404),
        (errors.TooLargeError("x"), 413),
        (errors.QueueFullError("x"), 429),
        (errors.UnauthorizedError("x"), 401),
        (errors.ForbiddenError("x"), 403),
        (EmptyInputError("tile.laz", "no points", "Get it again"), 422),
        (SettingsError(["a", "b"]), 400),
        (errors.StoreError("x"), 503),
        (sql.OperationalError("select", {}, Exception("host=db.internal")), 503),
        (ZeroDivisionError("x"), 500),
    ],
)
def test_an_error_has_its_status(error: Exception, status: int) -> None:
    assert answer_error(error, "/here").status_code == status


def test_internal_details_are_not_reported() -> None:
    for error in (ZeroDivisionError("secret"), sql.OperationalError("secret", {}, Exception("secret"))):
        assert b"secret" not in answer_error(error, "/here").body


def test_an_answer_to_try_again_says_when() -> None:
    assert answer_error(errors.TooManyRequestsError("x", 2.4), "/").headers["retry-after"] == "3"
    assert int(answer_error(errors.StoreError("x"), "/").headers["retry-after"]) > 0
    assert answer_error(errors.UnauthorizedError("x"), "/").headers["www-authenticate"].startswith("Bearer")


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("PUT", "/jobs", 405),
        ("PATCH", "/", 405),
        ("GET", "/jobs?limit=x", 400),
        ("GET", "/jobs/", 404),
        ("GET", "/processes/%2e%2e", 404),
        ("TRACE", "/jobs", 405),
    ],
)
def test_the_frameworks_own_errors_are_problem_documents_too(
    local_service, method: str, path: str, status: int
) -> None:
    answer = local_service.client.request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert set(answer.json()) >= FIELDS
    assert answer.json()["status"] == status


def test_a_fault_of_ours_is_a_problem_document_without_a_trace(local_service, monkeypatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise RuntimeError("at /srv/secret")

    monkeypatch.setattr(polling, "status_info", break_down)
    answer = local_service.client.get(f"/jobs/{local_service.waiting().job_id}")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert "secret" not in answer.text


def test_the_answer_to_a_request_without_a_key_says_how_to_send_one(local_service) -> None:
    from service.keys import Scope

    local_service.key(Scope.READ)
    for header in ({}, {"Authorization": "Bearer gw_wrong"}, {"Authorization": "Basic eDp5"}):
        answer = local_service.client.get("/jobs", headers=header)
        assert answer.status_code == 401
        assert answer.headers["www-authenticate"].startswith("Bearer")
        assert "gw_wrong" not in answer.text


def test_open_pages_need_no_key(local_service) -> None:
    from service.keys import Scope

    local_service.key(Scope.READ)
    for path in ("/", "/conformance", "/processes", "/processes/reconstruct", "/healthz", "/readyz", "/openapi.json"):
        assert local_service.client.get(path).status_code == 200, path
    for path in ("/jobs", "/uploads", "/metrics", f"/jobs/{'0' * 32}", f"/jobs/{'0' * 32}/events?f=json"):
        assert local_service.client.get(path).status_code == 401, path


def test_the_answer_to_too_many_requests_says_when_to_try_again(starting) -> None:
    client = starting(rate_limit="3/minute").client
    answers = [client.get(path) for path in ("/jobs", "/conformance", "/processes", "/jobs")]
    assert [answer.status_code for answer in answers] == [200, 200, 200, 429]
    assert 1 <= int(answers[3].headers["retry-after"]) <= 60
    assert client.get("/healthz").status_code == 200


# --- the guard


@pytest.mark.parametrize("reported", [True, False])
def test_a_body_that_is_too_large_is_refused_whether_it_says_so_or_not(starting, reported: bool) -> None:
    client = starting(max_body_bytes=1000).client
    content = b'{"inputs": {"title": "' + b"x" * 5000 + b'"}}'
    body = content if reported else iter([content[:600], content[600:]])
    answer = client.post("/processes/reconstruct/execution", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 413
    assert answer.headers["content-type"] == "application/problem+json"
    assert "1000 bytes" in answer.json()["detail"]


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "", "localhost@evil", "[::2]"]
)
def test_a_foreign_host_name_does_not_reach_a_service_on_loopback(local_service, host: str) -> None:
    answer = local_service.client.get("/jobs", headers={"Host": host})
    assert answer.status_code == 403
    assert answer.json()["type"].endswith("foreign-origin")


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost", "LOCALHOST:1", "[::1]:8000"])
def test_names_of_this_machine_reach_it(local_service, host: str) -> None:
    assert local_service.client.get("/jobs", headers={"Host": host}).status_code == 200


def test_the_host_of_the_public_url_reaches_it_too(starting) -> None:
    client = starting(public_url="https://models.example.org").client
    assert client.get("/jobs", headers={"Host": "models.example.org"}).status_code == 200
    assert client.get("/jobs", headers={"Host": "other.example.org"}).status_code == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:9999"},
        {"Origin": "https://127.0.0.1:8000"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_another_site_can_change_nothing(local_service, headers: dict[str, str]) -> None:
    job = local_service.waiting()
    form = {"tile": ("a.xyz", b"1 2 3\n")}
    for answer in (
        local_service.client.post("/jobs", files=form, headers=headers),
        local_service.client.post("/uploads?filename=a.xyz", content=b"1 2 3\n", headers=headers),
        local_service.client.post("/processes/reconstruct/execution", json={"inputs": {}}, headers=headers),
        local_service.client.delete(f"/jobs/{job.job_id}", headers=headers),
    ):
        assert answer.status_code == 403
        assert answer.json()["type"].endswith("foreign-origin")
        assert "access-control-allow-origin" not in answer.headers
    assert not local_service.store.get(job.job_id).status.is_over


def test_the_services_own_page_can(local_service) -> None:
    own = {"Origin": "http://127.0.0.1:8000", "Sec-Fetch-Site": "same-origin"}
    job = local_service.waiting()
    assert local_service.client.delete(f"/jobs/{job.job_id}", headers=own).json()["status"] == "dismissed"


def test_browsers_run_nothing_of_what_is_no_page(local_service) -> None:
    for path in ("/jobs", "/nothing", "/openapi.json"):
        headers = local_service.client.get(path).headers
        assert headers["content-security-policy"] == DATA_POLICY
        assert headers["x-content-type-options"] == "nosniff"


def test_a_path_prefix_of_a_proxy_does_not_widen_what_is_streamed(starting) -> None:
    client = starting(root_path="/gable", max_body_bytes=10).client
    json_type = {"Content-Type": "application/json"}
    assert client.post("/processes/reconstruct/execution", content=b"x" * 50, headers=json_type).status_code == 413
    assert client.post("/jobs", content=b"x" * 50, headers=json_type).status_code == 400
    assert client.get("/").json()["links"][0]["href"].endswith("/gable/")
