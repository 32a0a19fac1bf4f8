"""Changes of a job: its status with an event, or events alone. Within a transaction."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from functools import partial
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service import traces
from service.errors import LeaseLostError
from service.files import is_id
from service.jobs import Job, JobEvent, JobStatus, LogLevel, NewLogLine
from service.store import logs
from service.store.database import after_commit
from service.store.outbox import announce
from service.store.policies import duration_ms
from service.store.records import job_of, storable
from service.store.tables import EVENTS, JOBS
from service.webhooks import EVENT_OF, EventType

MAX_KEPT = 1000
"""Events kept per job, in addition to its status events and the latest progress of each stage."""
_LASTING = ("status", "progress")


def lock_job(connection: Connection, job_id: str) -> sa.Row[Any] | None:
    """A job's row, locked until the transaction ends; None if there is no such job."""
    return _row(connection, job_id, locked=True)


def lock_held(connection: Connection, held: Job) -> sa.Row[Any]:
    """The row of a job that a driver holds, locked.

    Raises
    ------
    LeaseLostError
        The job is over, gone, or held by another driver or for another attempt.
    """
    return held_row(connection, held, locked=True)


def held_row(connection: Connection, held: Job, *, locked: bool = False) -> sa.Row[Any]:
    """The row of a job that a driver holds.

    Raises
    ------
    LeaseLostError
        The job is over, gone, or held by another driver or for another attempt.
    """
    row = _row(connection, held.job_id, locked=locked)
    if row is None:
        raise LeaseLostError(f"job {held.job_id} is gone")
    if row.status != JobStatus.RUNNING or row.lease_owner != held.lease_owner or row.attempt != held.attempt:
        by = f", held by {row.lease_owner}" if row.lease_owner else ""
        raise LeaseLostError(
            f"job {held.job_id}: {held.lease_owner} held attempt {held.attempt}; "
            f"the job is {row.status} at attempt {row.attempt}{by}"
        )
    return row


def _row(connection: Connection, job_id: str, *, locked: bool) -> sa.Row[Any] | None:
    if not is_id(job_id):
        return None
    one = sa.select(JOBS).where(JOBS.c.job_id == job_id)
    return connection.execute(one.with_for_update() if locked else one).one_or_none()


def move(
    connection: Connection, row: sa.Row[Any], status: JobStatus, *, now: dt.datetime, message: str, **values: Any
) -> None:
    """Change the status of a locked job, with an event and its webhooks; the end of a job makes its span."""
    message = storable(message)
    ends: dict[str, Any] = {}
    if status is not JobStatus.RUNNING:
        ends = {"lease_owner": None, "lease_until": None}
    if status.is_over:
        ends |= {"finished_at": now, "duration_ms": duration_ms(job_of(row), now), "dismiss_requested": False}
        after_commit(connection, partial(traces.job_ended, job_of(row), status))
    changed = {"status": status.value, "message": message, "updated_at": now, "last_event": row.last_event + 1}
    one = JOBS.c.job_id == row.job_id
    connection.execute(sa.update(JOBS).where(one).values(**changed, **ends, **values))
    note_status(connection, connection.execute(sa.select(JOBS).where(one)).one(), now, _level(row, status))


def note_status(connection: Connection, row: sa.Row[Any], now: dt.datetime, level: LogLevel = LogLevel.INFO) -> None:
    """Write the status that a job has by now as an event, a line of its log, and news for webhooks."""
    columns = ("job_id", "status", "stage", "progress", "message")
    event = {"sequence": row.last_event, "at": now, "kind": "status", "done": 0, "total": 0}
    connection.execute(sa.insert(EVENTS).values(**event, **{name: getattr(row, name) for name in columns}))
    line = NewLogLine(level=level, message=f"{row.status}: {row.message}")
    logs.append(connection, row, [line], now, attempt=row.attempt)
    announce(connection, row, EVENT_OF[JobStatus(row.status)], now)


def _level(row: sa.Row[Any], status: JobStatus) -> LogLevel:
    """How serious a change of status is: a job that goes back to the queue met something."""
    if status is JobStatus.FAILED:
        return LogLevel.ERROR
    is_back = status is JobStatus.ACCEPTED and row.status == JobStatus.RUNNING.value
    return LogLevel.WARNING if is_back else LogLevel.INFO


def append(connection: Connection, row: sa.Row[Any], events: Sequence[JobEvent], now: dt.datetime) -> None:
    """Add events to a locked job. The store gives the numbers and the time; progress never decreases.

    A job keeps all changes of status, the latest progress of each stage, and the last `MAX_KEPT` of its other events:
    they stay few however long it runs. A number is never used twice.
    """
    if not events:
        return
    progress, stage, message = row.progress, row.stage, row.message
    rows = []
    for sequence, event in enumerate(events, start=row.last_event + 1):
        progress = max(progress, min(event.progress, 100))
        stage = storable(event.stage, 64) or stage
        message = storable(event.message) or message
        rows.append(
            {
                "job_id": row.job_id,
                "sequence": sequence,
                "at": now,
                "kind": event.kind,
                "status": None if event.status is None else event.status.value,
                "stage": storable(event.stage, 64),
                "done": event.done,
                "total": event.total,
                "progress": progress,
                "message": storable(event.message),
            }
        )
    latest = {item["stage"]: item["sequence"] for item in rows if item["kind"] == "progress"}
    of_job = EVENTS.c.job_id == row.job_id
    if latest:
        connection.execute(
            sa.delete(EVENTS).where(of_job, EVENTS.c.kind == "progress", EVENTS.c.stage.in_(list(latest)))
        )
    kept = [item for item in rows if item["kind"] != "progress" or latest[item["stage"]] == item["sequence"]]
    connection.execute(sa.insert(EVENTS), kept)
    if any(item["kind"] not in _LASTING for item in kept):
        _forget_oldest(connection, row.job_id)
    connection.execute(
        sa.update(JOBS)
        .where(JOBS.c.job_id == row.job_id)
        .values(
            progress=progress, stage=stage, message=message, updated_at=now, last_event=row.last_event + len(events)
        )
    )
    announce(connection, row, EventType.PROGRESS, now)


def _forget_oldest(connection: Connection, job_id: str) -> None:
    others = sa.and_(EVENTS.c.job_id == job_id, EVENTS.c.kind.not_in(_LASTING))
    newest_first = sa.select(EVENTS.c.sequence).where(others).order_by(EVENTS.c.sequence.desc())
    forgotten = connection.execute(newest_first.offset(MAX_KEPT).limit(1)).scalar_one_or_none()
    if forgotten is not None:
        connection.execute(sa.delete(EVENTS).where(others, EVENTS.c.sequence <= forgotten))
