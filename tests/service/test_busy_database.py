"""A database that others hold locked: requests are refused within seconds, and what was refused is never made."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from finished_runs import problem
from live_service import DEADLINE_S, POINTS, raw_request, serving, settings_in
from processes import wait_for

from service.errors import StoreBusyError
from service.settings import ServiceSettings
from service.store import JobFilter, JobStore, RequestDeadline

WAIT_S = 1.0
EXECUTE = {"inputs": {"tiles": [{"href": "/uploads/ID"}], "crs": "EPSG:28992"}}


@contextlib.contextmanager
def locked(settings: ServiceSettings) -> Iterator[sqlite3.Connection]:
    """Another process writes."""
    other = sqlite3.connect(settings.state / "service.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    try:
        yield other
    finally:
        other.close()


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> ServiceSettings:
    return settings_in(tmp_path_factory.mktemp("busy"), database_wait_s=WAIT_S)


@pytest.fixture(scope="module")
def url(settings: ServiceSettings) -> Iterator[str]:
    with serving(settings) as found:
        yield found


@pytest.fixture(scope="module")
def upload(url: str) -> str:
    answer = httpx.post(f"{url}/uploads?filename=a.xyz", content=POINTS, timeout=DEADLINE_S)
    return str(answer.json()["uploadID"])


def things(store: JobStore) -> tuple[int, int]:
    return len(store.list(JobFilter(limit=1000))), len(store.upload_ids())


def test_every_request_is_answered_in_time_and_none_makes_anything_later(
    url: str, settings: ServiceSettings, upload: str
) -> None:
    asked = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992"}}

    def post(number: int) -> httpx.Response:
        if number % 2:
            return httpx.post(f"{url}/processes/reconstruct/execution", json=asked, timeout=DEADLINE_S)
        return httpx.post(f"{url}/uploads?filename=a.xyz", content=POINTS, timeout=DEADLINE_S)

    with JobStore(settings.database) as store:
        before = things(store)
        with locked(settings), ThreadPoolExecutor(60) as crew:
            # with the lock held all the time, an answer can only come from the time limit
            answers = list(crew.map(post, range(60)))
            # readers do not wait
            assert httpx.get(f"{url}/jobs", timeout=DEADLINE_S).status_code == 200
        for answer in answers:
            problem(answer, 503, "database-busy")
            assert int(answer.headers["Retry-After"]) > 0
        assert things(store) == before
        # a write after all of theirs: had one of them waited on, it would be there
        assert post(0).status_code == 201
        assert things(store) == (before[0], before[1] + 1)


@pytest.mark.parametrize("method", ["DELETE", "POST"])
def test_changes_are_refused_in_time(url: str, settings: ServiceSettings, upload: str, method: str) -> None:
    path = f"/uploads/{upload}" if method == "DELETE" else "/jobs"
    with locked(settings):
        files: Any = None if method == "DELETE" else {"tile": ("a.xyz", POINTS)}
        problem(httpx.request(method, f"{url}{path}", files=files, timeout=DEADLINE_S), 503, "database-busy")
    assert httpx.get(f"{url}/uploads/{upload}", timeout=DEADLINE_S).status_code == 200


def test_a_client_that_gives_up_while_the_database_is_locked_makes_nothing(tmp_path: Path) -> None:
    # the lock ends long before the time of the request does
    settings = settings_in(tmp_path, database_wait_s=30.0)
    waits, abandoned = threading.Event(), threading.Event()

    class Watched(RequestDeadline):
        def left_s(self) -> float:
            waits.set()
            return super().left_s()

        def abandon(self) -> bool:
            found = super().abandon()
            abandoned.set()
            return found

    with pytest.MonkeyPatch.context() as patch, serving(settings) as url, JobStore(settings.database) as store:
        patch.setattr("service.routes.writing.RequestDeadline", Watched)
        with locked(settings):
            with raw_request(url, "POST /uploads?filename=a.xyz", POINTS, Content_Length=str(len(POINTS))):
                assert waits.wait(DEADLINE_S)
            assert abandoned.wait(DEADLINE_S)
        wait_for(lambda: not list((settings.state / "uploads").iterdir()), "an empty folder")
        assert store.upload_ids() == set()


def test_threads_of_one_process_wait_no_longer_than_asked(tmp_path: Path) -> None:
    with JobStore(f"sqlite:///{tmp_path / 'a.db'}", wait_s=0.5) as store:
        store.migrate()
        with store._database.write(), ThreadPoolExecutor(4) as crew:
            for waiting in [crew.submit(store.forget_answers) for _ in range(4)]:
                with pytest.raises(StoreBusyError):
                    waiting.result(DEADLINE_S)
        assert store.forget_answers() == 0


def test_what_was_abandoned_before_the_commit_is_not_written_and_what_was_not_cannot_be_abandoned(
    starting: Any,
) -> None:
    store = starting().store
    deadline = RequestDeadline(DEADLINE_S)

    def write() -> None:
        with deadline, store._database.write() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = 'x'")
            assert deadline.abandon()

    with pytest.raises(StoreBusyError):
        write()
    store.check()
    second = RequestDeadline(DEADLINE_S)
    with second:
        store.forget_answers()
    assert not second.abandon()
    used_up = RequestDeadline(0.0)
    time.sleep(0.001)
    with used_up, pytest.raises(StoreBusyError):
        store.forget_answers()
