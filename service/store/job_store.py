"""The store: every method is one transaction, committed when it returns."""

from __future__ import annotations

from typing import Self

from service.store.claims import JobLeases
from service.store.database import WAIT_S, Database
from service.store.idempotency import AnswerTable
from service.store.keys import KeyTable
from service.store.schedule_store import ScheduleStore
from service.store.submissions import JobSubmissions
from service.store.uploads import UploadTable
from service.store.webhook_store import WebhookStore


class JobStore(JobSubmissions, JobLeases, UploadTable, AnswerTable, KeyTable):
    """Jobs, events, uploads, schedules and keys; one per process, safe to share between its threads.

    Every method is a transaction of its own and may raise `StoreError` when the database does not answer.
    The time is always the database's: machines whose clocks differ agree on leases.

    Parameters
    ----------
    url : str
        SQLAlchemy's URL of a SQLite file or a PostgreSQL database. Nothing is opened yet.
    wait_s : float
        Seconds that a transaction waits for the locks of others.

    Raises
    ------
    StartUpError
        The URL cannot be understood, or names a database that is not supported.
    """

    def __init__(self, url: str, *, wait_s: float = WAIT_S) -> None:
        super().__init__(Database(url, wait_s=wait_s))
        self.schedules = ScheduleStore(self._database)
        """Schedules and the history of their slots."""
        self.webhooks = WebhookStore(self._database)
        """Receivers of news, and the news that are sent to them."""

    def __enter__(self) -> Self:
        """For `with`: closes the connections at the end."""
        return self

    def __exit__(self, *raised: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Close the connections; the store opens new ones when it is used again."""
        self._database.engine.dispose()

    def migrate(self) -> None:
        """Make the tables, or bring them to this version; several processes may do so at once.

        Raises
        ------
        StoreError
            The database does not answer, or is of a newer version.
        """
        self._database.migrate()

    def check(self) -> None:
        """Whether the database answers and has this version's tables.

        Raises
        ------
        StoreError
            It does not answer, or has other tables.
        """
        self._database.check()

    def fill_ballast(self, reserve_bytes: int) -> None:
        """Set room aside for a SQLite database, if the reserve stays free; it is used when the disk is full."""
        self._database.fill_ballast(reserve_bytes)
