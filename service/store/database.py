"""The database: connections, transactions, clock, migrations; its faults as `StoreError`."""

from __future__ import annotations

import contextlib
import datetime as dt
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa
from sqlalchemy import event, exc
from sqlalchemy.engine import URL, Connection, Engine

from service import migrations
from service.disk import Ballast, Disk
from service.errors import StartUpError, StoreBusyError, StoreError, StoreFullError, StoreNewerError
from service.files import folder_fault, keep_private, make_private_file
from service.store.deadline import CURRENT

_EPOCH = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_EPOCH_JULIAN = 2440587.5
_WRITES = "gablework_writes"
_AFTER = "gablework_after"
_POOL_SIZE = 10
WAIT_S = 30.0
"""Seconds that a transaction waits for locks, and for a connection, if its store is given no other number."""
_ANSWER_S = 10.0
"""Seconds for PostgreSQL's answer to a statement that waits for no lock; the socket gets five more."""
_RETRY_S = 0.01
_LOOK_S = 1.0
"""Seconds for which readers trust that no newer version has migrated the database; a transaction that writes looks."""
_REVISION = sa.text("SELECT version_num FROM alembic_version")
_LOCK_MIGRATIONS = 0x6761626C01
LOCK_SUBMISSIONS = 0x6761626C02
LOCK_SECRETS = 0x6761626C03
"""Numbers of PostgreSQL's advisory locks."""
# PostgreSQL: connection, resources, operator, system, no database, authorisation, idle in transaction, no table
_PASSING = ("08", "53", "57", "58", "3D", "28", "25P03", "42P01", "SQLITE_NOTADB", "SQLITE_CORRUPT")
# a lock that is not available, a statement that was ended by its time limit
_BUSY = ("55P03", "57014", "SQLITE_BUSY", "SQLITE_LOCKED")
_FULL = ("53100", "SQLITE_FULL")
_IO = ("SQLITE_IOERR", "SQLITE_CANTOPEN")
"""SQLite's codes for a file that cannot be written; a full disk is one of the causes."""
_LEFT_BYTES = 1 << 20
"""Free bytes below which a disk counts as full: SQLite's log and its index grow by less at a time."""


class Database:
    """Connections to one database; safe to share between threads.

    Parameters
    ----------
    url : str
        `sqlite:///PATH` or `postgresql+pg8000://…`.
    wait_s : float
        Seconds that a transaction waits for locks and for a connection. A request waits no longer
        than its `RequestDeadline`.

    Raises
    ------
    StartUpError
        The URL cannot be understood, or names a database that is not supported.
    """

    def __init__(self, url: str, *, wait_s: float = WAIT_S) -> None:
        self._url = _parsed(url)
        self._wait_s = wait_s
        self.is_sqlite = self._url.get_backend_name() == "sqlite"
        make = _sqlite_engine if self.is_sqlite else _postgresql_engine
        self.engine = make(self._url, wait_s)
        self._is_migrated = False
        self._looked_s = 0.0
        # SQLite's own wait is a sleep of growing length; threads of one process queue here in order
        self._one_writer = threading.Lock() if self.is_sqlite else None

    @property
    def public_name(self) -> str:
        """The name of the database in messages to clients: without folder, user and password."""
        if self.is_sqlite:
            return f"the SQLite database {Path(self._url.database or '').name}"
        return f"the PostgreSQL database {self._url.database or ''} at {self._url.host or 'a local socket'}"

    @property
    def path(self) -> Path | None:
        """The file of a SQLite database; None for another."""
        return Path(self._url.database or "").absolute() if self.is_sqlite else None

    @contextlib.contextmanager
    def closing(self) -> Iterator[Self]:
        """Close the connections at the end."""
        try:
            yield self
        finally:
            self.engine.dispose()

    @property
    def folder(self) -> Path:
        """The folder of a SQLite database."""
        return Path(self._url.database or "").absolute().parent

    def fill_ballast(self, reserve_bytes: int) -> None:
        """Set room aside for a SQLite database, if the reserve of the disk stays free.

        Raises
        ------
        StoreError
            Its folder cannot be written.
        """
        if self.is_sqlite:
            with self._faults_in_our_words():
                ballast = Ballast(self.folder)
                ballast.fill(reserve_bytes)
                if ballast.path.exists():
                    keep_private(ballast.path)

    @contextlib.contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that only reads.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        with self._faults_in_our_words(), self.engine.begin() as connection:
            if time.monotonic() - self._looked_s > _LOOK_S:
                self._check_not_migrated_since(connection)
            yield connection

    @contextlib.contextmanager
    def read_steadily(self) -> Iterator[Connection]:
        """A long transaction that only reads and sees the database as it is at its beginning.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        with self._faults_in_our_words(), self.engine.connect() as connection:
            if self.is_sqlite:
                # its readers see one state anyway
                with connection.begin():
                    yield connection
                return
            with connection.execution_options(isolation_level="REPEATABLE READ").begin():
                connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
                connection.exec_driver_sql("SET LOCAL idle_in_transaction_session_timeout = 0")
                yield connection

    @contextlib.contextmanager
    def write(self, *, wait_s: float | None = None) -> Iterator[Connection]:
        """A transaction that may write; committed at its end, rolled back on an exception.

        Parameters
        ----------
        wait_s : float, optional
            Maximum seconds for locks; by default the current `RequestDeadline`, or that of the database.

        Raises
        ------
        StoreBusyError
            Others hold the locks, or the caller no longer waits.
        StoreFullError
            The disk is full.
        StoreError
            The database does not answer.
        """
        deadline = CURRENT.get()
        if wait_s is None:
            wait_s = self._wait_s if deadline is None else deadline.left_s()
        until_s = time.monotonic() + wait_s
        after: list[Callable[[], None]] = []
        with self._faults_in_our_words(), self._alone(wait_s), self.engine.connect() as connection:
            left_ms = max(1, round(1e3 * (until_s - time.monotonic())))
            connection.execution_options(**{_WRITES: left_ms, _AFTER: after})
            with connection.begin():
                if not self.is_sqlite:
                    _limit(connection, left_ms)
                self._check_not_migrated_since(connection)
                yield connection
                if deadline is not None:
                    deadline.commit()
        for action in after:
            action()

    @contextlib.contextmanager
    def _alone(self, wait_s: float) -> Iterator[None]:
        """Hold the place of the one writer of SQLite in this process."""
        if self._one_writer is None:
            yield
            return
        if not self._one_writer.acquire(timeout=wait_s):
            raise StoreBusyError(f"{self.public_name} is busy: other threads write for more than {wait_s:g} s")
        try:
            yield
        finally:
            self._one_writer.release()

    def migrate(self) -> None:
        """Migrate the tables to this version; several processes may do so at once.

        Raises
        ------
        StartUpError
            The place of a SQLite database cannot be used.
        StoreError
            The database does not answer, or is of a newer version.
        """
        if self.is_sqlite and self._url.database is not None:
            with self._faults_in_our_words():
                path = Path(self._url.database)
                _check_place(path)
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                make_private_file(path)
                # SQLite makes them with the mode of the database
                for beside in (path.with_name(path.name + ending) for ending in ("-wal", "-shm")):
                    if beside.exists():
                        keep_private(beside)
        # another process may be migrating: that takes as long as it takes
        with self.write(wait_s=WAIT_S) as connection:
            lock(connection, _LOCK_MIGRATIONS)
            found = migrations.current(connection)
            self._check_not_newer(found)
            if found != migrations.head():
                migrations.upgrade(connection)
        self._is_migrated = True

    def check(self, *, any_known: bool = False) -> None:
        """Check that the database answers and has the tables of this version.

        With `any_known` the tables of an earlier version are accepted, too.

        Raises
        ------
        StoreError
            It does not answer, or has other tables.
        """
        if self.is_sqlite and not Path(self._url.database or "").is_file():
            raise StoreError(f"{self.public_name} does not exist: start the service once, it makes the database")
        with self.read() as connection:
            found = migrations.current(connection)
        self._check_not_newer(found)
        if found != migrations.head() and not (any_known and found is not None):
            raise StoreError(
                f"{self.public_name} has the tables of revision {found or 'none'}, this version needs "
                f"{migrations.head()}: start the service or a driver once, they migrate it"
            )

    def now(self, connection: Connection) -> dt.datetime:
        """The database's clock, in UTC; to the millisecond on SQLite.

        Not the start of the transaction: after a wait for a lock it is the time after the wait.
        """
        if self.is_sqlite:
            days = connection.execute(sa.select(sa.func.julianday("now"))).scalar_one()
            return _EPOCH + dt.timedelta(milliseconds=round((days - _EPOCH_JULIAN) * 86_400_000))
        now: dt.datetime = connection.execute(sa.select(sa.func.clock_timestamp())).scalar_one()
        return now.astimezone(dt.UTC)

    def _check_not_migrated_since(self, connection: Connection) -> None:
        """Refuse a database that a newer version migrated while this process ran: this one may misread it.

        Raises
        ------
        StoreNewerError
            It did.
        """
        if self._is_migrated:
            found = connection.execute(_REVISION).scalar()
            if found != migrations.head():
                self._check_not_newer(found)
            self._looked_s = time.monotonic()

    def _check_not_newer(self, found: str | None) -> None:
        if found is not None and found not in migrations.known():
            raise StoreNewerError(
                f"{self.public_name} is of a newer version of gablework (revision {found}, this version knows "
                f"{migrations.head()}): update this one, or restore a backup that was made before the update"
            )

    @contextlib.contextmanager
    def _faults_in_our_words(self) -> Iterator[None]:
        """Raise faults of the database as `StoreError`, our own as they are."""
        try:
            yield
        except exc.TimeoutError as error:
            raise StoreBusyError(f"{self.public_name} is busy: no connection is free") from error
        except exc.DBAPIError as error:
            fault = self._fault(error)
            if fault is None:
                raise
            raise fault from error
        except OSError as error:
            raise StoreError(f"{self.public_name} does not answer: {_cause(error)}") from error

    def _fault(self, error: exc.DBAPIError) -> StoreError | None:
        """The fault of a database that may pass; None for a fault of the statement."""
        code, cause = _code(error), _cause(error)
        if code.startswith(_FULL) or (code.startswith(_IO) and Disk(self.folder).free_bytes < _LEFT_BYTES):
            freed = ""
            if self.is_sqlite and Ballast(self.folder).release():
                freed = "; the room that was set aside for it is free now"
            return StoreFullError(f"the disk of {self.public_name} is full: {cause}{freed}")
        if code.startswith(_BUSY):
            return StoreBusyError(f"{self.public_name} is busy: {cause}")
        passes = error.connection_invalidated or code.startswith(_PASSING)
        if passes or isinstance(error, exc.OperationalError | exc.InterfaceError):
            return StoreError(f"{self.public_name} does not answer: {cause}")
        return None


class StorePart:
    """A part of the store: each method is a transaction, and may raise `StoreError` if the database does not answer.

    Parameters
    ----------
    database : Database
        The store's own.
    """

    def __init__(self, database: Database) -> None:
        self._database = database


def lock(connection: Connection, number: int) -> None:
    """Hold a lock until the transaction ends; a writer of SQLite is alone anyway."""
    if connection.dialect.name != "sqlite":
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(number)))


def after_commit(connection: Connection, action: Callable[[], None]) -> None:
    """Call something once the transaction of `Database.write` is committed; not if it is rolled back."""
    connection.get_execution_options()[_AFTER].append(action)


def _parsed(url: str) -> URL:
    try:
        parsed = sa.make_url(url)
    except exc.ArgumentError as error:
        raise StartUpError(
            "the database URL cannot be understood: use sqlite:////path/to/file.db or "
            "postgresql+pg8000://user:password@host/database"
        ) from error
    backend = parsed.get_backend_name()
    if backend in {"postgresql", "postgres"}:
        return parsed.set(drivername="postgresql+pg8000")
    if backend != "sqlite":
        raise StartUpError(f"databases of kind {backend!r} are not supported: use sqlite or postgresql")
    if parsed.database in {None, "", ":memory:"} or "mode=memory" in str(parsed):
        raise StartUpError("a SQLite database in memory is lost with its process: name a file, sqlite:////path/file.db")
    return parsed


def _check_place(path: Path) -> None:
    """Refuse a place at which no SQLite database can be."""
    fault = f"{path} is a folder" if path.is_dir() else folder_fault(path.parent)
    if fault is not None:
        raise StartUpError(
            f"the SQLite database cannot be {path}: {fault}. Name a file in a folder that can be written"
        )


def _limit(connection: Connection, left_ms: int) -> None:
    """Let PostgreSQL end the statements of a transaction that wait too long."""
    limits = [sa.func.set_config(name, str(left_ms), True) for name in ("lock_timeout", "statement_timeout")]
    connection.execute(sa.select(*limits))


def _sqlite_engine(url: URL, wait_s: float) -> Engine:
    wait_ms = round(1e3 * wait_s)
    engine = sa.create_engine(
        url, pool_size=_POOL_SIZE, max_overflow=0, pool_timeout=wait_s, connect_args={"timeout": wait_s}
    )

    @event.listens_for(engine, "connect")
    def connected(connection: Any, record: Any) -> None:
        del record
        # the driver would begin transactions late, and never for reads; `begun` begins them
        connection.isolation_level = None
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA busy_timeout = {wait_ms}")
        cursor.execute("PRAGMA foreign_keys = ON")
        # a job whose request was answered with 201 survives a power cut
        cursor.execute("PRAGMA synchronous = FULL")
        _use_wal(cursor)
        cursor.close()

    @event.listens_for(engine, "begin")
    def begun(connection: Connection) -> None:
        # a transaction that reads first and writes later would fail if another wrote in between
        left_ms = connection.get_execution_options().get(_WRITES)
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {left_ms or wait_ms}")
        connection.exec_driver_sql("BEGIN" if left_ms is None else "BEGIN IMMEDIATE")

    return engine


def _use_wal(cursor: sqlite3.Cursor) -> None:
    """Switch a new database to a write-ahead log.

    If two connections switch at the same time, each holds the lock that the other waits for. SQLite then refuses one of
    them at once, whatever its time-out. A moment later that one finds the switch done.
    """
    until = time.monotonic() + WAIT_S
    while cursor.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        try:
            cursor.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > until:
                raise
            time.sleep(_RETRY_S)


def _postgresql_engine(url: URL, wait_s: float) -> Engine:
    answer_s = max(wait_s, _ANSWER_S)
    try:
        engine = sa.create_engine(
            url,
            pool_size=_POOL_SIZE,
            max_overflow=0,
            pool_timeout=wait_s,
            pool_pre_ping=True,
            pool_recycle=1800,
            connect_args={"timeout": answer_s + 5.0, "application_name": "gablework"},
        )
    except ImportError as error:
        raise StartUpError("PostgreSQL needs the driver pg8000: install gablework[postgres]") from error

    @event.listens_for(engine, "connect")
    def connected(connection: Any, record: Any) -> None:
        del record
        cursor = connection.cursor()
        # a client that vanished must lose its locks, and a statement must end before the socket's time-out
        cursor.execute(f"SET idle_in_transaction_session_timeout = '{round(WAIT_S)}s'")
        cursor.execute(f"SET statement_timeout = {round(1e3 * answer_s)}")
        cursor.execute(f"SET lock_timeout = {round(1e3 * wait_s)}")
        cursor.close()
        connection.commit()

    return engine


def _code(error: exc.DBAPIError) -> str:
    """PostgreSQL's SQLSTATE or the name of SQLite's fault; empty if there is none."""
    if isinstance(error.orig, sqlite3.Error):
        return getattr(error.orig, "sqlite_errorname", "")
    details = error.orig.args[0] if error.orig is not None and error.orig.args else None
    return str(details.get("C", "")) if isinstance(details, dict) else ""


def _cause(error: Exception) -> str:
    """The message of the database driver, without the statement and its values."""
    cause = error.orig if isinstance(error, exc.DBAPIError) and error.orig is not None else error
    details = cause.args[0] if cause.args else None
    return str(details.get("M", details)) if isinstance(details, dict) else str(cause)
