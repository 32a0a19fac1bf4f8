"""Backups of a service: a copy of its database and of the files that the copy names, made while the service runs.

A backup is a folder like the state folder, with the mark `backup.json` beside. A further backup into the same folder
copies only what is new. The database comes last: an interrupted backup leaves the one before it whole.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import fcntl
import os
import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.errors import RunError
from service.errors import StartUpError, StoreError
from service.files import SO_FAR, StateFolder, folder_fault, make_private_file
from service.jobs import JobStatus
from service.store.changes import move
from service.store.database import Database
from service.store.tables import JOBS, METADATA

DATABASE = "service.db"
"""Name of the copy of the database."""
MARK = "backup.json"
"""Name of the file that marks the folder of a backup."""
GAP = 1_000_000
"""Numbers of events that a restored job leaves out: its clients may have seen some that the copy does not have."""
_PARTIAL = ".partial-"
_NEW = ".new.db"
_ROWS = 1000
"""Rows that are held at once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report:
    """The content of a backup."""

    jobs: dict[str, int]
    """Number of jobs by status."""
    uploads: int
    """Number of finished uploads."""
    missing: tuple[str, ...]
    """Folders that the database names and that were not there to be copied."""

    @property
    def sentence(self) -> str:
        """The content in one sentence."""
        jobs = ", ".join(f"{count} {status}" for status, count in sorted(self.jobs.items())) or "none"
        return f"jobs: {jobs}; uploads: {self.uploads}"


def back_up(database_url: str, folder: StateFolder, target: Path) -> Report:
    """Copy the database and all files that it names, while the service runs.

    Files of jobs that are not over are left out: such a job runs again. So are unfinished uploads.

    Raises
    ------
    StartUpError
        The target cannot hold a backup.
    StoreError
        The database does not answer, or cannot be copied.
    RunError
        The backup cannot be written; an earlier one in the folder is still whole.
    """
    _check_target(folder, target)
    with _disk_faults(f"the backup in {target}"), _alone(target), Database(database_url).closing() as database:
        new, missing = target / _NEW, set[str]()
        StateFolder(target).make()
        while True:
            new.unlink(missing_ok=True)
            _copy_database(database, new)
            named = _named(new)
            absent = {name for name in named if not _is_copied(name, folder.root, target)}
            # what vanished was removed from the database before: a newer copy does not name it
            if absent <= missing:
                break
            missing |= absent
        report = _report(new, named, absent)
        # everything is on the disk before the database names it
        os.sync()
        new.replace(target / DATABASE)
        for name in _stored(target) - set(named):
            shutil.rmtree(target / name, ignore_errors=True)
        for path in (target / "jobs").iterdir():
            with contextlib.suppress(OSError):
                path.rmdir()
    return report


def restore(source: Path, folder: StateFolder, database_url: str) -> tuple[Report, int]:
    """Make a service from a backup. It must not run yet, and its database must be new.

    Parameters
    ----------
    source : Path
        The folder of the backup, which is only read.
    folder : StateFolder
        The state folder, empty or absent; what an interrupted restore left there is used.
    database_url : str
        SQLAlchemy's URL of the database, SQLite or PostgreSQL: absent, or without any rows.

    Returns
    -------
    tuple of Report and int
        The content of the backup; how many of its jobs were running and now wait again.

    Raises
    ------
    StartUpError
        The source is not a whole backup, or there is a service already.
    StoreError
        The database does not answer, or the backup is of a newer version.
    RunError
        The state folder cannot be written.
    """
    if not (source / MARK).is_file() or not (source / DATABASE).is_file():
        raise StartUpError(f"{source} is not a whole backup: `gablework backup` leaves {MARK} and {DATABASE} there")
    with _disk_faults(f"the state folder {folder.root}"), Database(database_url).closing() as database:
        _check_is_new(database, folder, source)
        folder.make()
        new = folder.root / _NEW
        for path in (new, *(new.with_name(new.name + ending) for ending in ("-wal", "-shm"))):
            path.unlink(missing_ok=True)
        make_private_file(new)
        shutil.copyfile(source / DATABASE, new)
        with Database(f"sqlite:///{new}").closing() as copy:
            copy.migrate()
            with copy.write() as connection:
                freed = _free_running(connection, copy.now(connection))
        named = _named(source / DATABASE)
        absent = [name for name in named if not _is_copied(name, source, folder.root)]
        report = _report(source / DATABASE, named, absent)
        os.sync()
        if database.path is None:
            with Database(f"sqlite:///{new}").closing() as copy, copy.read() as rows, database.write() as connection:
                _copy_rows(rows, connection)
            new.unlink()
        else:
            database.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            shutil.move(new, database.path)
    return report, freed


# --- the database


def _copy_database(database: Database, path: Path) -> None:
    """Copy a database into a new SQLite file, as it is at one moment; others may write meanwhile.

    A SQLite database is copied whatever its revision. A PostgreSQL database must have this version's tables.

    Raises
    ------
    StoreError
        The database does not answer, has other tables, or is damaged.
    """
    database.check(any_known=database.is_sqlite)
    make_private_file(path)
    if database.path is None:
        with Database(f"sqlite:///{path}").closing() as target:
            target.migrate()
            with database.read_steadily() as source, target.write() as connection:
                _copy_rows(source, connection)
        # one file: nothing beside it that could be left behind when it is moved
        with contextlib.closing(sqlite3.connect(path)) as copy:
            copy.execute("PRAGMA journal_mode = DELETE")
        return
    try:
        with contextlib.closing(sqlite3.connect(f"{database.path.as_uri()}?mode=rw", uri=True)) as source:
            source.execute("VACUUM INTO ?", (str(path),))
    except sqlite3.Error as error:
        raise StoreError(f"{database.path} cannot be copied to {path}: {error}") from error


def _copy_rows(source: Connection, target: Connection) -> None:
    for table in METADATA.sorted_tables:
        found = source.execution_options(yield_per=_ROWS).execute(sa.select(table))
        for rows in found.partitions():
            target.execute(sa.insert(table), [row._asdict() for row in rows])


def _free_running(connection: Connection, now: dt.datetime) -> int:
    """Give all running jobs back to the queue, since no driver of a restored service holds them; returns their number.

    Such an attempt does not count as lost. A job whose dismissal was requested is dismissed. The numbers of the events
    of unfinished jobs go on above those that clients may have seen after the copy was made.
    """
    unfinished = JOBS.c.status.in_([JobStatus.ACCEPTED.value, JobStatus.RUNNING.value])
    connection.execute(sa.update(JOBS).where(unfinished).values(last_event=JOBS.c.last_event + GAP))
    rows = connection.execute(sa.select(JOBS).where(JOBS.c.status == JobStatus.RUNNING.value)).all()
    for row in rows:
        if row.dismiss_requested:
            move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed")
        else:
            words = "the service was restored from a backup; the job waits for a driver"
            move(connection, row, JobStatus.ACCEPTED, now=now, message=words)
    return len(rows)


def _rows(database: Path, query: str) -> list[Any]:
    """The rows of a query to a SQLite file of any revision, which is only read."""
    with contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


def _named(database: Path) -> list[str]:
    """The folders that a database names: results of successful jobs, and finished uploads."""
    jobs = _rows(database, "SELECT job_id, attempt FROM jobs WHERE status = 'successful'")
    uploads = _rows(database, "SELECT upload_id FROM uploads")
    return [*(f"jobs/{job}/attempt-{number}" for job, number in jobs), *(f"uploads/{one}" for (one,) in uploads)]


def _report(database: Path, named: list[str], missing: Iterable[str]) -> Report:
    return Report(
        jobs=dict(_rows(database, "SELECT status, count(*) FROM jobs GROUP BY status")),
        uploads=sum(name.startswith("uploads/") for name in named),
        missing=tuple(sorted(missing)),
    )


# --- the files


def _is_copied(name: str, source_root: Path, target_root: Path) -> bool:
    """Copy what is new in a folder whose files no longer change; False without such a folder.

    The buildings that a job had so far are left out: they are not results, and the janitor may remove them now.
    """
    source = source_root / name

    def left_out(place: str, _names: list[str]) -> list[str]:
        return [SO_FAR] if name.startswith("jobs/") and Path(place) == source else []

    try:
        shutil.copytree(source, target_root / name, ignore=left_out, copy_function=_copy_if_new, dirs_exist_ok=True)
    except (FileNotFoundError, shutil.Error):
        if source.is_dir():
            raise
        return False
    return True


def _copy_if_new(source: str, target: str) -> None:
    """Copy a file whole or not at all, unless one of the same size and time is there."""
    old, new = Path(target), Path(source).stat()
    if not old.exists() or (old.stat().st_size, old.stat().st_mtime_ns) != (new.st_size, new.st_mtime_ns):
        partial = old.with_name(f"{_PARTIAL}{old.name}")
        shutil.copy2(source, partial)
        partial.replace(old)


def _stored(root: Path) -> set[str]:
    """The folders that a backup or a state folder holds, as a database names them."""
    return {str(path.relative_to(root)) for pattern in ("jobs/*/*", "uploads/*") for path in root.glob(pattern)}


# --- the folders


def _check_target(folder: StateFolder, target: Path) -> None:
    """Refuse a folder that holds something else, or that lies in the state folder."""
    root, place = folder.root.resolve(), target.resolve()
    if place == root or root in place.parents or place in root.parents:
        raise StartUpError(f"the backup would go to {target}, and the state folder is {folder.root}: keep them apart")
    if not folder.root.is_dir():
        fault = "is not a folder" if folder.root.exists() else "does not exist"
        raise StartUpError(f"the state folder {folder.root} {fault}: give that of the service with --state")
    target_fault = folder_fault(target)
    if target_fault is not None:
        raise StartUpError(f"the backup cannot go to {target}: {target_fault}. Name another folder with --to")
    if target.is_dir() and not (target / MARK).exists() and any(target.iterdir()):
        raise StartUpError(f"{target} holds other files, and no backup: name an empty folder, or one of a backup")


@contextlib.contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Mark the folder, and keep other backups out of it."""
    target.mkdir(mode=0o700, parents=True, exist_ok=True)
    with (target / MARK).open("a") as mark:
        try:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StartUpError(f"another backup goes to {target}: wait until it has ended") from None
        yield


def _check_is_new(database: Database, folder: StateFolder, source: Path) -> None:
    """Refuse to restore over a service, or into something that cannot be a folder."""
    fault = folder_fault(folder.root)
    if fault is not None:
        raise StartUpError(f"the service cannot be restored into {folder.root}: {fault}. Name another one with --state")
    if database.path is not None and database.path.exists():
        raise StartUpError(
            f"there is a database {database.path}: restore into a new state folder, or move this one away"
        )
    if database.path is None:
        database.migrate()
        with database.read() as connection:
            if any(connection.execute(sa.select(table).limit(1)).first() for table in METADATA.sorted_tables):
                raise StartUpError("the database holds a service already: make an empty one for the restored service")
    foreign = sorted(_stored(folder.root) - _stored(source))
    if foreign:
        raise StartUpError(
            f"{folder.root} has {len(foreign)} folders that the backup does not have, such as {foreign[0]}: restore "
            "into an empty folder"
        )


@contextlib.contextmanager
def _disk_faults(what: str) -> Iterator[None]:
    """Raise faults of the disk as RunError."""
    try:
        yield
    except shutil.Error as error:
        first = error.args[0][0]
        raise RunError(f"{what} cannot be completed: {first[2]} ({len(error.args[0])} files)") from error
    except OSError as error:
        raise RunError(f"{what} cannot be completed: {error}") from error
