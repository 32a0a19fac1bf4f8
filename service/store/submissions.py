"""The operations of clients on jobs: submit, dismiss, keep, remove."""

from __future__ import annotations

import datetime as dt
import uuid
from collections.abc import Sequence

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.runtime.monitoring import tracing
from service.deliveries import Delivery
from service.errors import NoSuchUploadError, QueueFullError, ResultNotReadyError
from service.jobs import UNLIMITED, Job, JobRequest, JobStatus, QueueLimits
from service.store.changes import lock_job, move, note_status
from service.store.database import LOCK_SUBMISSIONS, lock
from service.store.policies import lease_expired
from service.store.queries import JobQueries, get, no_such_job, seen_by
from service.store.records import job_of, storable
from service.store.tables import EVENTS, JOB_UPLOADS, JOBS, LOG_LINES, UPLOADS
from service.store.uploads import creating

_WATCH_WAIT_S = 0.2


class JobSubmissions(JobQueries):
    """What clients do with jobs."""

    def create(
        self,
        request: JobRequest,
        *,
        owner: str | None,
        priority: int = 0,
        limits: QueueLimits = UNLIMITED,
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
        limits : QueueLimits
            How many jobs may wait.
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
            check_queue(connection, owner, limits)
            now = self._database.now(connection)
            job_id = insert(connection, request, owner=owner, priority=priority, now=now)
            return made(get(connection, job_id, None))

    def dismiss(self, job_id: str, *, owner: str | None = None) -> Job:
        """Stop a job. A waiting job is dismissed at once; the driver of a running job is asked to stop.

        A job that is over stays as it is. A running job whose driver is lost is dismissed at once.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            row = lock_job(connection, job_id)
            job = seen_by(owner, None if row is None else job_of(row), job_id)
            assert row is not None
            if job.status is JobStatus.ACCEPTED:
                move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed before it ran")
            elif lease_expired(job, now):
                move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed; its driver was lost")
            elif job.status is JobStatus.RUNNING and not job.dismiss_requested:
                asked = {"dismiss_requested": True, "message": "is being stopped", "updated_at": now}
                connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(**asked))
            return get(connection, job_id, owner)

    def keep(self, job_id: str, *, keep: bool, owner: str | None = None) -> Job:
        """Keep a job, whatever its age and size, or no longer.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key than `owner`.
        """
        with self._database.write() as connection:
            get(connection, job_id, owner)
            connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(keep=keep))
            return get(connection, job_id, owner)

    def watch(self, job_id: str) -> None:
        """Note that a client reads the buildings that a running job has so far.

        It waits for locks of others only a moment: reading must not wait for writing.
        """
        with self._database.write(wait_s=_WATCH_WAIT_S) as connection:
            now = self._database.now(connection)
            connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(watched_at=now))

    def remove(self, job_id: str) -> None:
        """Delete a job that is over, with its events and its log; the caller removes its folder.

        Raises
        ------
        NoSuchJobError
            It does not exist.
        ResultNotReadyError
            It is not over.
        """
        with self._database.write() as connection:
            row = lock_job(connection, job_id)
            if row is None:
                raise no_such_job(job_id)
            if not JobStatus(row.status).is_over:
                raise ResultNotReadyError(f"job {job_id} is {row.status}: dismiss it first, then it can be removed")
            for table in (EVENTS, LOG_LINES, JOB_UPLOADS, JOBS):
                connection.execute(sa.delete(table).where(table.c.job_id == job_id))


def check_queue(connection: Connection, owner: str | None, limits: QueueLimits) -> None:
    """Refuse if too many jobs wait; no other process makes one until the transaction ends.

    Without keys only the total counts.

    Raises
    ------
    QueueFullError
        The queue, or this key's part of it, is full.
    """
    lock(connection, LOCK_SUBMISSIONS)
    waiting = sa.select(sa.func.count()).select_from(JOBS).where(JOBS.c.status == JobStatus.ACCEPTED.value)
    total = connection.execute(waiting).scalar_one()
    if total >= limits.max_queued:
        raise QueueFullError(f"{total} jobs wait, the limit is {limits.max_queued}: submit again when some are done")
    if owner is None:
        return
    own = connection.execute(waiting.where(JOBS.c.owner == owner)).scalar_one()
    if own >= limits.max_queued_per_key:
        raise QueueFullError(
            f"{own} jobs of this key wait, the limit is {limits.max_queued_per_key}: submit again when some are done"
        )


def insert(
    connection: Connection,
    request: JobRequest,
    *,
    owner: str | None,
    priority: int,
    now: dt.datetime,
    schedule_id: str | None = None,
) -> str:
    """Store a new job; its id.

    Raises
    ------
    NoSuchUploadError
        It names an upload that is gone.
    """
    job_id = uuid.uuid4().hex
    connection.execute(
        sa.insert(JOBS).values(
            job_id=job_id,
            owner=owner,
            process_id=storable(request.process_id, 64),
            request=request.as_dict(),
            status=JobStatus.ACCEPTED.value,
            priority=priority,
            message="waits for a driver",
            progress=0,
            stage="",
            created_at=now,
            updated_at=now,
            dismiss_requested=False,
            attempt=0,
            lost_attempts=0,
            last_event=1,
            schedule_id=schedule_id,
            traceparent=None if (submitted := tracing.current()) is None else submitted.traceparent,
        )
    )
    needed = request.upload_ids
    hold_uploads(connection, needed)
    if needed:
        connection.execute(sa.insert(JOB_UPLOADS), [{"job_id": job_id, "upload_id": name} for name in needed])
    note_status(connection, connection.execute(sa.select(JOBS).where(JOBS.c.job_id == job_id)).one(), now)
    return job_id


def hold_uploads(connection: Connection, needed: Sequence[str]) -> None:
    """Keep uploads until the commit; a removal checks afterwards whether a job needs them.

    Raises
    ------
    NoSuchUploadError
        One of them is gone.
    """
    if not needed:
        return
    stored = sa.select(UPLOADS.c.upload_id).where(UPLOADS.c.upload_id.in_([storable(name) for name in needed]))
    found = set(connection.execute(stored.with_for_update(read=True)).scalars())
    missing = [name for name in needed if name not in found]
    if missing:
        raise NoSuchUploadError(f"there is no upload {missing[0]!r} (any more): send the file again")
