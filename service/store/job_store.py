"""The store: every method is one transaction, committed when it returns."""

from __future__ import annotations

import builtins
import datetime as dt
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Self

from service.deliveries import Claim, Delivery, StoredAnswer
from service.jobs import (
    EndedAttempt,
    Job,
    JobEvent,
    JobFailure,
    JobRequest,
    JobStatus,
    LogLevel,
    LogLine,
    NewLogLine,
    Upload,
    Wishes,
)
from service.keys import Key
from service.store import (
    changes,
    claims,
    idempotency,
    keys,
    logs,
    queries,
    submissions,
    uploads,
)
from service.store.database import LOCK_SUBMISSIONS, WAIT_S, Database
from service.store.delivering import creating
from service.store.delivery_line import give_up_all
from service.store.queries import JobFilter
from service.store.schedule_store import ScheduleStore
from service.store.webhook_store import WebhookStore

_WATCH_WAIT_S = 0.2


class JobStore:
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
        self._database = Database(url, wait_s=wait_s)
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

    # --- the database

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

    def now(self) -> dt.datetime:
        """The database's clock, in UTC."""
        with self._database.read() as connection:
            return self._database.now(connection)

    # --- for clients

    def create(
        self,
        request: JobRequest,
        *,
        owner: str | None,
        priority: int = 0,
        max_queued: int,
        max_queued_per_key: int,
        delivery: Delivery[Job] | None = None,
    ) -> Job:
        """Submit a job; its row is committed when this returns.

        Parameters
        ----------
        request : JobRequest
            The job's request, already checked.
        owner : str or None
            The key that submits; None if keys are not used, then only the whole queue is limited.
        priority : int
            Higher runs first.
        max_queued, max_queued_per_key : int
            Maximum number of waiting jobs, in total and of this key; running jobs do not count.
        delivery : Delivery, optional
            What is written with the job: uploads, and the answer under the request's key.

        Raises
        ------
        QueueFullError
            Too many jobs wait.
        QuotaError
            The uploads are too large.
        KeyInUseError
            The key of the request has passed to another one.
        NoSuchUploadError
            The request names an upload that is gone.
        """
        with creating(self._database, delivery) as (connection, made):
            self._database.lock(connection, LOCK_SUBMISSIONS)
            submissions.check_queue(connection, owner, max_queued=max_queued, max_queued_per_key=max_queued_per_key)
            now = self._database.now(connection)
            job_id = submissions.insert(connection, request, owner=owner, priority=priority, now=now)
            return made(queries.get(connection, job_id, None))

    def get(self, job_id: str, *, owner: str | None = None) -> Job:
        """One job; with an owner only its own.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return queries.get(connection, job_id, owner)

    def existing(self, job_ids: Collection[str]) -> dict[str, Job]:
        """Those of some jobs that exist, by id."""
        with self._database.read() as connection:
            return queries.existing(connection, job_ids)

    def list(self, criteria: JobFilter) -> list[Job]:
        """The jobs that fit, newest first."""
        with self._database.read() as connection:
            return queries.listed(connection, criteria, self._database.now(connection))

    def matching(self, criteria: JobFilter) -> int:
        """Number of the jobs that fit, on all pages."""
        with self._database.read() as connection:
            return queries.matching(connection, criteria, self._database.now(connection))

    def dismiss(self, job_id: str, *, owner: str | None = None) -> Job:
        """Stop a job. A waiting job is dismissed at once; the driver of a running job is asked to stop.

        A job that is over stays as it is. A running job whose driver is lost is dismissed at once.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key.
        """
        with self._database.write() as connection:
            submissions.dismiss(connection, job_id, owner, self._database.now(connection))
            return queries.get(connection, job_id, owner)

    def keep(self, job_id: str, *, keep: bool, owner: str | None = None) -> Job:
        """Keep a job, whatever its age and size, or no longer.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key than `owner`.
        """
        with self._database.write() as connection:
            found = queries.get(connection, job_id, owner)
            submissions.keep(connection, found.job_id, keep=keep)
            return queries.get(connection, job_id, owner)

    def watch(self, job_id: str) -> None:
        """Note that a client reads the buildings that a running job has so far.

        It waits for locks of others only a moment: reading must not wait for writing.
        """
        with self._database.write(wait_s=_WATCH_WAIT_S) as connection:
            submissions.watch(connection, job_id, self._database.now(connection))

    def finished(self) -> builtins.list[tuple[str, dt.datetime]]:
        """Ids and ends of the jobs that are over and not kept, oldest first."""
        with self._database.read() as connection:
            return queries.finished(connection)

    def remove(self, job_id: str) -> None:
        """Delete a job that is over, with its events; the caller removes its folder.

        Raises
        ------
        NoSuchJobError
            It does not exist.
        ResultNotReadyError
            It is not over.
        """
        with self._database.write() as connection:
            submissions.remove(connection, job_id)

    def events(self, job_id: str, after: int = 0, limit: int = 500) -> builtins.list[JobEvent]:
        """A job's events with a higher number than `after`, in order; none for a job that does not exist."""
        with self._database.read() as connection:
            return queries.events(connection, job_id, after, limit)

    def log(
        self,
        job_id: str,
        *,
        after: int = 0,
        before: int | None = None,
        level: LogLevel = LogLevel.INFO,
        limit: int = 100,
    ) -> builtins.list[LogLine]:
        """Lines of a job's log, in order: the newest, or the first ones after a number; none without such a job.

        Parameters
        ----------
        job_id : str
            The job.
        after : int
            Only lines with a higher number.
        before : int, optional
            Only lines with a lower number.
        level : LogLevel
            Only lines that are as serious, or more.
        limit : int
            Maximum number of lines.
        """
        with self._database.read() as connection:
            return logs.listed(connection, job_id, after=after, before=before, level=level, limit=limit)

    def counts(self) -> dict[JobStatus, int]:
        """Jobs by status; every status is there."""
        with self._database.read() as connection:
            return queries.counts(connection)

    def attempts(self, job_ids: Sequence[str]) -> dict[str, tuple[JobStatus, int]]:
        """Status and number of the latest attempt, of those jobs that exist."""
        with self._database.read() as connection:
            return queries.attempts(connection, job_ids)

    # --- for drivers

    def claim(self, driver: str, *, lease_s: float, max_attempts: int) -> Job | None:
        """Claim the first job in the queue: highest priority, then oldest.

        Before that, jobs whose lease has ended go back into the queue, fail if they were lost `max_attempts` times,
        or are dismissed if that was requested.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        lease_s : float
            Seconds for which the job is held, unless it is renewed.
        max_attempts : int
            Number of losses after which a job fails.

        Returns
        -------
        Job or None
            The job as it is now held; None if no job waits.
        """
        # most checks find nothing: they take no lock
        with self._database.read() as connection:
            if not claims.work_waits(connection, self._database.now(connection)):
                return None
        with self._database.write() as connection:
            now = self._database.now(connection)
            claims.sweep(connection, now=now, max_attempts=max_attempts)
            job_id = claims.take_first(connection, driver, now=now, lease_s=lease_s)
            return None if job_id is None else queries.get(connection, job_id, None)

    def give_up(self, driver: str, *, max_attempts: int) -> builtins.list[str]:
        """Take back the jobs of a driver that is known to be dead, before their leases end; returns their ids.

        They go back into the queue, fail if they were lost `max_attempts` times, or are dismissed if that was
        requested. Webhooks that it was sending are sent again.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            give_up_all(connection, driver)
            return claims.give_up_all(connection, driver, now=now, max_attempts=max_attempts)

    def renew(self, job: Job, *, lease_s: float, due_s: float = math.inf) -> bool:
        """Hold a job for `lease_s` seconds from now; True if it must be dismissed.

        It counts as stalled if it is not renewed with a later `due_s`, seconds from now.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            due_at = None if math.isinf(due_s) else now + dt.timedelta(seconds=due_s)
            return claims.renew(connection, job, until=now + dt.timedelta(seconds=lease_s), due_at=due_at)

    def still_held(self, job: Job) -> Wishes:
        """What clients want from a job that is held; only reads, and takes no lock.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.read() as connection:
            row = changes.held_row(connection, job)
            return Wishes(dismissal=bool(row.dismiss_requested), watched_at=row.watched_at)

    def record(self, job: Job, events: Sequence[JobEvent], lines: Sequence[NewLogLine] = ()) -> None:
        """Append events and lines of the log; progress, stage and message of the job follow the events.

        The store gives numbers and times.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            row = changes.lock_held(connection, job)
            now = self._database.now(connection)
            changes.append(connection, row, events, now)
            logs.append(connection, row, lines, now, attempt=job.attempt)

    def succeed(self, job: Job, *, message: str, summary: Mapping[str, Any]) -> None:
        """End a job with success.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.SUCCESSFUL, message=message, summary=dict(summary), progress=100)

    def fail(self, job: Job, failure: JobFailure) -> None:
        """End a job with a failure.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.FAILED, message=failure.detail, **claims.failed_values(failure))

    def dismissed(self, job: Job) -> None:
        """End a job whose dismissal was requested: its driver has stopped.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.DISMISSED, message="dismissed")

    def release(self, job: Job, *, lost: bool, message: str = "", retry_after_s: float = 0.0) -> None:
        """Put a job back into the queue; if its dismissal was requested, it ends instead.

        Parameters
        ----------
        job : Job
            As it was claimed.
        lost : bool
            Whether the attempt counts as lost.
        message : str
            The reason, for the client.
        retry_after_s : float
            Seconds during which it cannot be claimed.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            later = now + dt.timedelta(seconds=retry_after_s) if retry_after_s > 0.0 else None
            claims.release(connection, job, now=now, lost=lost, message=message, not_before=later)

    def end_attempt(self, job: Job, ended: EndedAttempt, *, max_attempts: int, kept_days: float) -> None:
        """Put a job back into the queue whose attempt's process ended, or end it after too many of them.

        Parameters
        ----------
        job : Job
            As it was claimed.
        ended : EndedAttempt
            What happened.
        max_attempts : int
            Number of attempts in a row that may end by themselves in one stage.
        kept_days : float
            Days for which the inputs of a job that failed so are kept.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            claims.end_attempt(connection, job, ended, now=now, max_attempts=max_attempts, kept_days=kept_days)

    def stalled(self) -> builtins.list[str]:
        """Ids of the running jobs that make no progress."""
        with self._database.read() as connection:
            return claims.stalled(connection, self._database.now(connection))

    def _finish(self, job: Job, status: JobStatus, *, message: str, **values: Any) -> None:
        with self._database.write() as connection:
            now = self._database.now(connection)
            claims.finish(connection, job, status, now=now, message=message, **values)

    # --- uploads

    def add_upload(self, upload: Upload) -> None:
        """Store the record of an upload; its file is already in place."""
        self.add_uploads(Delivery(uploads=(upload,)))

    def add_uploads(self, delivery: Delivery[None]) -> None:
        """Store the records of uploads, and the answer under the request's key.

        Raises
        ------
        QuotaError
            They are too large.
        KeyInUseError
            The key of the request has passed to another one.
        """
        with creating(self._database, delivery) as (_, made):
            made(None)

    def stored_bytes(self, owner: str | None) -> int:
        """Bytes of all uploads of a key, or of all that belong to none."""
        with self._database.read() as connection:
            return uploads.stored_bytes(connection, owner)

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        """One upload; with an owner only its own.

        Raises
        ------
        NoSuchUploadError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return uploads.get(connection, upload_id, owner)

    def list_uploads(self, *, owner: str | None = None, limit: int, offset: int = 0) -> builtins.list[Upload]:
        """Uploads, newest first; with an owner only its own."""
        with self._database.read() as connection:
            return uploads.listed(connection, owner, limit, offset)

    def remove_upload(self, upload_id: str) -> None:
        """Delete an upload; the caller removes its file afterwards. One that does not exist is ignored.

        Raises
        ------
        UploadInUseError
            Jobs that wait or run, or schedules, need it.
        """
        with self._database.write() as connection:
            uploads.remove(connection, upload_id)

    def expired_uploads(self, now: dt.datetime) -> builtins.list[Upload]:
        """Uploads whose time is over and that no waiting or running job and no schedule needs."""
        with self._database.read() as connection:
            return uploads.expired(connection, now)

    def upload_ids(self) -> set[str]:
        """Ids of all uploads."""
        with self._database.read() as connection:
            return uploads.known(connection)

    # --- requests with a key of their own

    def answer_to(self, owner: str, key: str) -> StoredAnswer | None:
        """The answer that is kept under a client's key; None if there is none."""
        with self._database.read() as connection:
            return idempotency.find(connection, owner, key, self._database.now(connection))

    def claim_key(self, claim: Claim) -> StoredAnswer | None:
        """Claim a client's key for a request; the answer if one is kept under it, otherwise None.

        Raises
        ------
        KeyInUseError
            Another request holds the key.
        """
        with self._database.write() as connection:
            return idempotency.claim(connection, claim, self._database.now(connection))

    def renew_claim(self, claim: Claim) -> None:
        """Hold a claim for some more time; one that has passed to another request is left alone."""
        with self._database.write() as connection:
            idempotency.renew(connection, claim, self._database.now(connection))

    def drop_claim(self, claim: Claim) -> None:
        """Free the key of a request that made nothing."""
        with self._database.write() as connection:
            idempotency.drop(connection, claim)

    def forget_answers(self) -> int:
        """Delete the kept answers whose time is over; their number."""
        with self._database.write() as connection:
            return idempotency.forget(connection, self._database.now(connection))

    # --- keys

    def add_key(self, key: Key) -> None:
        """Store a key."""
        with self._database.write() as connection:
            keys.add(connection, key)

    def key_by_digest(self, digest: str) -> Key | None:
        """The key with this digest, new or old, even if it is refused; None if there is none."""
        with self._database.read() as connection:
            return keys.by_digest(connection, digest)

    def keys(self) -> builtins.list[Key]:
        """All keys, also revoked ones, oldest first."""
        with self._database.read() as connection:
            return keys.every(connection)

    def rotate_key(self, key: Key) -> None:
        """Store the new secret of a key."""
        with self._database.write() as connection:
            keys.rotate(connection, key)

    def revoke_key(self, key_id: str) -> None:
        """Revoke a key; one that does not exist is ignored."""
        with self._database.write() as connection:
            keys.revoke(connection, key_id, self._database.now(connection))

    def has_keys(self) -> bool:
        """Whether there is a key that is neither revoked nor expired."""
        with self._database.read() as connection:
            return keys.any_valid(connection, self._database.now(connection))
