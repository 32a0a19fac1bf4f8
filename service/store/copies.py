"""Copies of the whole database: to a SQLite file beside a running service, and from such a file into a new database."""

from __future__ import annotations

import contextlib
import datetime as dt
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import StoreError
from service.files import make_private_file
from service.jobs import JobStatus
from service.store.changes import move
from service.store.database import Database
from service.store.tables import JOBS, METADATA

GAP = 1_000_000
"""Numbers of events that a restored job leaves out: its clients may have seen some that the copy does not have."""
_ROWS = 1000
"""Rows that are held at once."""


def copy_database(database: Database, path: Path) -> None:
    """Copy a database into a new SQLite file, as it is at one moment; others may write meanwhile.

    A SQLite database is copied whatever its revision. A PostgreSQL database must have this version's tables.

    Raises
    ------
    StoreError
        The database does not answer, has other tables, or its copy is damaged.
    """
    database.check(any_known=database.is_sqlite)
    make_private_file(path)
    if database.path is None:
        with Database(f"sqlite:///{path}").closing() as target:
            target.migrate()
            with database.read_steadily() as source, target.write() as connection:
                _copy_rows(source, connection)
    else:
        _copy_file(database.path, path)
    # one file: nothing beside it that could be left behind when it is moved
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise StoreError(f"the copy of {database.public_name} is damaged: {found}")


def load_database(path: Path, database: Database) -> None:
    """Copy all rows of a SQLite file with this version's tables into another database, whose tables are empty.

    Raises
    ------
    StoreError
        A database does not answer; nothing is copied then.
    """
    with Database(f"sqlite:///{path}").closing() as source, source.read() as rows, database.write() as connection:
        _copy_rows(rows, connection)


def is_empty(database: Database) -> bool:
    """Whether no table has a row."""
    with database.read() as connection:
        return all(connection.execute(sa.select(table).limit(1)).first() is None for table in METADATA.sorted_tables)


def free_running(connection: Connection, now: dt.datetime, made_at: dt.datetime) -> int:
    """Give all running jobs back to the queue, since no driver of a restored service holds them; returns their number.

    Such an attempt does not count as lost. A job whose dismissal was requested is dismissed. The numbers of the events
    of unfinished jobs go on above those that clients may have seen after the copy was made.
    """
    unfinished = JOBS.c.status.in_([JobStatus.ACCEPTED.value, JobStatus.RUNNING.value])
    connection.execute(sa.update(JOBS).where(unfinished).values(last_event=JOBS.c.last_event + GAP))
    rows = connection.execute(sa.select(JOBS).where(JOBS.c.status == JobStatus.RUNNING.value)).all()
    day = made_at.isoformat(sep=" ", timespec="seconds")
    for row in rows:
        if row.dismiss_requested:
            move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed")
        else:
            words = f"the service was restored from its backup of {day}; the job waits for a driver"
            move(connection, row, JobStatus.ACCEPTED, now=now, message=words)
    return len(rows)


def _copy_file(source: Path, target: Path) -> None:
    """Copy a SQLite database, as it is at one moment."""
    try:
        with (
            contextlib.closing(sqlite3.connect(f"{source.as_uri()}?mode=rw", uri=True)) as old,
            contextlib.closing(sqlite3.connect(target)) as new,
        ):
            old.backup(new)
    except sqlite3.Error as error:
        raise StoreError(f"{source} cannot be copied to {target}: {error}") from error


def _copy_rows(source: Connection, target: Connection) -> None:
    for table in METADATA.sorted_tables:
        found = source.execution_options(yield_per=_ROWS).execute(sa.select(table))
        for some in found.partitions():
            rows: list[Mapping[str, Any]] = [row._asdict() for row in some]
            target.execute(sa.insert(table), rows)
