"""Databases that have their tables already: making them revision by revision takes longer than most tests.

The revisions themselves are run by the tests of the store that begin with an empty database, by `live_service`, and by
every service that runs as a process.
"""

import contextlib
import datetime as dt
import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from alembic import command

from service import migrations
from service.jobs import JobRequest
from service.store import JobStore


@functools.cache
def _template() -> bytes:
    """A SQLite database with all tables and nothing in them, made once a process."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "service.db")
        with JobStore(f"sqlite:///{path}") as store:
            store.migrate()
        return path.read_bytes()


def with_tables(url: str) -> str:
    """The URL of a SQLite database, which is there with its tables then; one that is there already stays as it is."""
    path = Path(url.removeprefix("sqlite:///"))
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_template())
    return url


@contextlib.contextmanager
def at_revision(store: JobStore, revision: str) -> Iterator[sa.Connection]:
    """An empty database with the tables of an earlier version."""
    if store._database.path is not None:
        store._database.path.parent.mkdir(parents=True, exist_ok=True)
    with store._database.write() as connection:
        config = migrations._config()
        config.attributes["connection"] = connection
        command.upgrade(config, revision)
        yield connection


def add_row(connection: sa.Connection, table: str, **values: Any) -> None:
    """Insert a row as an earlier version did."""
    found = sa.Table(table, sa.MetaData(), autoload_with=connection)
    connection.execute(sa.insert(found).values(**values))


def add_old_job(connection: sa.Connection, request: JobRequest, **values: Any) -> str:
    """A job that waits, as the first version wrote it; its id."""
    job_id, at = "a" * 32, dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
    known = {"job_id": job_id, "process_id": "reconstruct", "status": "accepted", "priority": 0}
    known |= {"request": request.as_dict(), "message": "waits", "progress": 0, "stage": "", "lost_attempts": 0}
    known |= {"created_at": at, "updated_at": at, "dismiss_requested": False, "attempt": 0, "last_event": 1}
    add_row(connection, "jobs", **known | values)
    return job_id
