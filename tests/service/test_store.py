"""The store on SQLite."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from copy_contract import CopyContract
from delivery_contract import DeliveryContract
from migrated import with_tables
from schedule_store_contract import ScheduleStoreContract
from store_contract import StoreContract, claim, submit
from webhook_store_contract import WebhookStoreContract

from service.errors import StartUpError, StoreError
from service.store import JobStore, database


class OnSqlite:
    """A database in a file."""

    @pytest.fixture
    def url(self, tmp_path: Path, request: pytest.FixtureRequest) -> str:
        url = f"sqlite:///{tmp_path / 'some % folder' / 'service.db'}"
        return with_tables(url) if "store" in request.fixturenames else url


class TestJobsOnSqlite(OnSqlite, StoreContract):
    """All of the contract of jobs, on a file."""


class TestCopiesOnSqlite(OnSqlite, CopyContract):
    """All of the contract of copies, on a file."""


class TestSchedulesOnSqlite(OnSqlite, ScheduleStoreContract):
    """All of the contract of schedules, on a file."""


class TestDeliveriesOnSqlite(OnSqlite, DeliveryContract):
    """All of the contract of deliveries, on a file."""


class TestWebhooksOnSqlite(OnSqlite, WebhookStoreContract):
    """All of the contract of webhooks, on a file."""


class OnceRefused:
    """A cursor on a database that another connection switches to a log at the same time."""

    def __init__(self, code: int) -> None:
        self.code = code
        self.mode = "delete"

    def execute(self, words: str) -> OnceRefused:
        if "=" in words:
            self.mode = "wal"
            error = sqlite3.OperationalError("refused")
            error.sqlite_errorcode = self.code
            raise error
        return self

    def fetchone(self) -> tuple[str]:
        return (self.mode,)


def test_connections_that_open_a_new_database_together_all_get_in() -> None:
    database._use_wal(OnceRefused(sqlite3.SQLITE_BUSY))
    with pytest.raises(sqlite3.OperationalError, match="refused"):
        database._use_wal(OnceRefused(sqlite3.SQLITE_READONLY))


def test_a_killed_writer_leaves_no_lock_and_no_half_a_job(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.db'}"
    with JobStore(url) as store:
        store.migrate()
        submit(store)
        other = sqlite3.connect(tmp_path / "a.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        other.execute("DELETE FROM jobs")
        # what a process holds goes with it
        other.close()
        assert claim(store).attempt == 1


def test_readers_do_not_wait_for_a_writer(tmp_path: Path) -> None:
    with JobStore(f"sqlite:///{tmp_path / 'a.db'}") as store:
        store.migrate()
        job = submit(store)
        other = sqlite3.connect(tmp_path / "a.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        other.execute("DELETE FROM job_events")
        assert store.get(job.job_id) == job
        assert len(store.events(job.job_id)) == 1
        other.close()


def test_a_file_that_is_not_a_database_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.db").write_bytes(b"no database at all" * 100)
    with JobStore(f"sqlite:///{tmp_path / 'a.db'}") as store, pytest.raises(StoreError, match=r"a\.db.*not a database"):
        store.migrate()


def test_messages_name_no_folder_of_the_machine(tmp_path: Path) -> None:
    with JobStore(f"sqlite:///{tmp_path / 'a.db'}") as store, pytest.raises(StoreError) as raised:
        store.check()
    assert str(tmp_path) not in str(raised.value)


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:///:memory:", "mysql://a/b", "nonsense", "sqlite:///"])
def test_a_database_that_cannot_serve_is_refused(url: str) -> None:
    with pytest.raises(StartUpError):
        JobStore(url)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    place = tmp_path / "file" / "a.db"
    with (
        JobStore(f"sqlite:///{place}") as store,
        pytest.raises(StartUpError, match=rf"cannot be {place}: .* not a folder"),
    ):
        store.migrate()
