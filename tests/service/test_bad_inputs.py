"""Bad input of more than 150 kinds: each is refused with a reason that names a fix, and leaves nothing behind."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import pytest
from bad_inputs import UPLOAD, BadRequest, bad_files, bad_requests
from live_service import las_bytes
from starlette.testclient import TestClient

from service.app import create_app
from service.settings import ServiceSettings
from service.store import JobStore

FILES = bad_files()
REQUESTS = bad_requests()


class Service(NamedTuple):
    """A client, and the folder that holds all that the service keeps."""

    client: TestClient
    state: Path


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with small limits, whose address is its own."""
    settings = ServiceSettings(state=tmp_path_factory.mktemp("state"), max_upload_bytes=4 << 20)
    with JobStore(settings.database) as store:
        store.migrate()
        app = create_app(settings, store)
        with TestClient(app, "http://127.0.0.1:8000", raise_server_exceptions=False) as client:
            yield Service(client, settings.state)


@pytest.fixture(scope="module")
def upload_id(service: Service) -> str:
    """The id of a good upload."""
    answer = service.client.post("/uploads?filename=good.laz", content=las_bytes())
    return str(answer.json()["uploadID"])


def state_of(service: Service) -> tuple[list[str], dict[str, int]]:
    """All files of the state folder except the database's, and the number of rows of every table."""
    folder = service.state
    files = sorted(str(path) for path in folder.rglob("*") if path.is_file() and "service.db" not in path.name)
    with sqlite3.connect(f"file:{folder / 'service.db'}?mode=ro", uri=True) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        rows = {name: database.execute(f'SELECT count(*) FROM "{name}"').fetchone()[0] for name in tables}
    database.close()
    return files, rows


def assert_refused(answer: httpx.Response) -> None:
    """It is refused, with a sentence that says more than the status."""
    assert 400 <= answer.status_code < 500, f"{answer.status_code}: {answer.text[:500]}"
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == answer.status_code
    assert len(problem["detail"]) > 15, problem
    assert "/tmp" not in problem["detail"], "the path of a file on the server"


def test_there_are_more_than_150_kinds() -> None:
    assert len(FILES) + len(REQUESTS) > 150


@pytest.mark.parametrize("kind", FILES)
def test_a_bad_file_is_refused_when_it_is_sent_or_by_the_job(kind: str, service: Service) -> None:
    client, (name, content) = service.client, FILES[kind]
    before = state_of(service)
    answer = client.post("/uploads", params={"filename": name}, content=content)
    if answer.status_code == 201:
        # what a job's other inputs may still mend is kept, and the answer says so
        sent = answer.json()
        assert sent["preflight"]["problems"]
        asked = {"inputs": {"tiles": [{"href": f"/uploads/{sent['uploadID']}"}]}}
        assert_refused(client.post("/processes/reconstruct/execution", json=asked))
        assert client.delete(f"/uploads/{sent['uploadID']}").status_code == 204
    else:
        assert_refused(answer)
    assert state_of(service) == before


@pytest.mark.parametrize("kind", REQUESTS)
def test_a_bad_request_is_refused_and_leaves_nothing(kind: str, service: Service, upload_id: str) -> None:
    request: BadRequest = REQUESTS[kind]
    before = state_of(service)
    content = None if request.content is None else request.content.replace(UPLOAD.encode(), upload_id.encode())
    answer = service.client.request(request.method, request.path, headers=request.headers, content=content)
    assert_refused(answer)
    assert state_of(service) == before
