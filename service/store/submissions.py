"""The operations of clients on jobs: submit, dismiss, remove. Within a transaction."""

from __future__ import annotations

import datetime as dt
import uuid
from collections.abc import Sequence

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.runtime.monitoring import tracing
from service.errors import NoSuchUploadError, QueueFullError, ResultNotReadyError
from service.jobs import JobRequest, JobStatus, NewLogLine
from service.store import logs
from service.store.changes import lock_job, move
from service.store.outbox import announce
from service.store.policies import lease_expired
from service.store.queries import no_such_job
from service.store.records import job_of, storable
from service.store.tables import EVENTS, JOB_UPLOADS, JOBS, LOG_LINES, UPLOADS
from service.webhooks import EventType


def check_queue(connection: Connection, owner: str | None, *, max_queued: int, max_queued_per_key: int) -> None:
    """Refuse if too many jobs wait. Without keys only the total counts.

    Raises
    ------
    QueueFullError
        The queue, or this key's part of it, is full.
    """
    waiting = sa.select(sa.func.count()).select_from(JOBS).where(JOBS.c.status == JobStatus.ACCEPTED.value)
    total = connection.execute(waiting).scalar_one()
    if total >= max_queued:
        raise QueueFullError(f"{total} jobs wait, the limit is {max_queued}: submit again when some are done")
    if owner is None:
        return
    own = connection.execute(waiting.where(JOBS.c.owner == owner)).scalar_one()
    if own >= max_queued_per_key:
        raise QueueFullError(
            f"{own} jobs of this key wait, the limit is {max_queued_per_key}: submit again when some are done"
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
    connection.execute(
        sa.insert(EVENTS).values(
            job_id=job_id,
            sequence=1,
            at=now,
            kind="status",
            status=JobStatus.ACCEPTED.value,
            stage="",
            done=0,
            total=0,
            progress=0,
            message="waits for a driver",
        )
    )
    needed = request.upload_ids
    hold_uploads(connection, needed)
    if needed:
        connection.execute(sa.insert(JOB_UPLOADS), [{"job_id": job_id, "upload_id": name} for name in needed])
    made = connection.execute(sa.select(JOBS).where(JOBS.c.job_id == job_id)).one()
    logs.append(connection, made, [NewLogLine(message="accepted: waits for a driver")], now, attempt=0)
    announce(connection, made, EventType.ACCEPTED, now)
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


def dismiss(connection: Connection, job_id: str, owner: str | None, now: dt.datetime) -> None:
    """Dismiss a waiting job, or ask the driver of a running one to stop; a job that is over stays as it is.

    Raises
    ------
    NoSuchJobError
        It does not exist, or belongs to another key.
    """
    row = lock_job(connection, job_id)
    if row is None or (owner is not None and row.owner != owner):
        raise no_such_job(job_id)
    job = job_of(row)
    if job.status is JobStatus.ACCEPTED:
        move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed before it ran")
    elif lease_expired(job, now):
        move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed; its driver was lost")
    elif job.status is JobStatus.RUNNING and not job.dismiss_requested:
        asked = {"dismiss_requested": True, "message": "is being stopped", "updated_at": now}
        connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(**asked))


def keep(connection: Connection, job_id: str, *, keep: bool) -> None:
    """Keep a job, or no longer."""
    connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(keep=keep))


def watch(connection: Connection, job_id: str, now: dt.datetime) -> None:
    """Note that a client reads what a job has so far."""
    connection.execute(sa.update(JOBS).where(JOBS.c.job_id == job_id).values(watched_at=now))


def remove(connection: Connection, job_id: str) -> None:
    """Delete a job that is over, with its events and its log.

    Raises
    ------
    NoSuchJobError
        It does not exist.
    ResultNotReadyError
        It is not over.
    """
    row = lock_job(connection, job_id)
    if row is None:
        raise no_such_job(job_id)
    if not JobStatus(row.status).is_over:
        raise ResultNotReadyError(f"job {job_id} is {row.status}: dismiss it first, then it can be removed")
    for table in (EVENTS, LOG_LINES, JOB_UPLOADS, JOBS):
        connection.execute(sa.delete(table).where(table.c.job_id == job_id))
