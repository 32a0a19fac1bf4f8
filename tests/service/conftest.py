"""A service in this process, on a state folder of its own."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import finished_runs as runs
import httpx
import pytest
from client_site import Site
from driver_bench import bench  # noqa: F401 - a fixture
from live_service import POINTS
from migrated import with_tables
from starlette.testclient import TestClient

from pipeline.backoff import Backoff
from service.app import create_app
from service.jobs import InputReference, Job, JobRequest
from service.keys import Scope, new_key
from service.settings import ServiceSettings
from service.store import JobStore

OWN_URL = "http://127.0.0.1:8000"
"""What the tests call the service; a foreign name is refused."""


class LocalService:
    """A service, its store, and what tests do with them again and again."""

    def __init__(self, client: TestClient, store: JobStore, settings: ServiceSettings) -> None:
        self.client = client
        self.store = store
        self.settings = settings

    def upload(self, **headers: str) -> str:
        """The id of an upload."""
        answer = self.client.post("/uploads?filename=points.xyz", content=POINTS, headers=headers)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["uploadID"])

    def waiting(self, owner: str | None = None, **request: Any) -> Job:
        """A job in the line."""
        asked = JobRequest(tiles=(InputReference(kind="path", value="/srv/tile.laz"),), **request)
        return self.store.create(asked, owner=owner)

    def running(self, owner: str | None = None) -> Job:
        """A job that a driver holds."""
        self.waiting(owner)
        job = self.store.claim("a driver", lease_s=3600.0, max_attempts=3)
        assert job is not None
        return job

    def request_of(self, answer: httpx.Response) -> JobRequest:
        """The request of the job that an answer has made."""
        assert answer.status_code == 201, answer.text
        return self.store.get(answer.json()["jobID"]).request

    def key(self, scope: Scope) -> dict[str, str]:
        """A new key, as the header that sends it."""
        key, secret = new_key(f"a key to {scope}", scope, now=self.store.now())
        self.store.add_key(key)
        return {"Authorization": f"Bearer {secret}"}


Starting = Callable[..., LocalService]


@pytest.fixture
def starting(tmp_path: Path) -> Iterator[Starting]:
    """Starts services with the settings that are given."""
    with contextlib.ExitStack() as stack:

        def start(**options: Any) -> LocalService:
            settings = ServiceSettings(**{"state": tmp_path / "state", **options})
            store = stack.enter_context(JobStore(with_tables(settings.database)))
            app = create_app(settings, store)
            client = TestClient(app, OWN_URL, raise_server_exceptions=False, root_path=settings.root_path)
            return LocalService(stack.enter_context(client), store, settings)

        yield start


@pytest.fixture
def local_service(starting: Starting) -> LocalService:
    """A service on loopback, without keys."""
    return starting()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """A service behind a gate, for clients that are programs; its pauses are short."""
    monkeypatch.setattr("service.client.client_retries.BACKOFF", Backoff(first_s=0.01, longest_s=15.0))
    with Site.opened(tmp_path) as opened:
        yield opened


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[runs.Service]:
    """A service without keys that holds finished runs as jobs."""
    with runs.service(tmp_path_factory.mktemp("state")) as found:
        yield found


@pytest.fixture(scope="module")
def client(service: runs.Service) -> TestClient:
    """A client of it."""
    return service.client
