"""Rows to records and back."""

from __future__ import annotations

import dataclasses
from typing import Any

import sqlalchemy as sa

from service.jobs import Fault, Job, JobEvent, JobFailure, JobRequest, JobStatus, LogLevel, LogLine, Upload
from service.keys import Key, Scope
from service.webhooks import Delivery, DeliveryState, Endpoint, EventType


def storable(text: str, limit: int | None = None) -> str:
    """Text that both databases accept: no NUL, no lone surrogates, not longer than the column.

    >>> storable("abc", 2)
    'ab'
    """
    clean = text.replace("\0", "\ufffd").encode("utf-8", "replace").decode("utf-8")
    return clean if limit is None else clean[:limit]


def job_of(row: sa.Row[Any]) -> Job:
    """A row of `jobs`."""
    return Job(
        job_id=row.job_id,
        owner=row.owner,
        request=JobRequest.from_dict(row.request),
        status=JobStatus(row.status),
        priority=row.priority,
        message=row.message,
        progress=row.progress,
        stage=row.stage,
        created_at=row.created_at,
        started_at=row.started_at,
        finished_at=row.finished_at,
        updated_at=row.updated_at,
        dismiss_requested=row.dismiss_requested,
        attempt=row.attempt,
        lost_attempts=row.lost_attempts,
        own_ends=row.own_ends,
        own_end_stage=row.own_end_stage,
        other_ends=row.other_ends,
        lease_owner=row.lease_owner,
        lease_until=row.lease_until,
        failure=None if row.fault is None else JobFailure(fault=Fault(row.fault), detail=row.fault_detail or ""),
        summary=row.summary,
        schedule_id=row.schedule_id,
        keep=row.keep,
        watched_at=row.watched_at,
        traceparent=row.traceparent,
    )


def event_of(row: sa.Row[Any]) -> JobEvent:
    """A row of `job_events`."""
    return JobEvent(
        sequence=row.sequence,
        at=row.at,
        kind=row.kind,
        status=None if row.status is None else JobStatus(row.status),
        stage=row.stage,
        done=row.done,
        total=row.total,
        progress=row.progress,
        message=row.message,
    )


def log_line_of(row: sa.Row[Any]) -> LogLine:
    """A row of `job_log`."""
    return LogLine(
        number=row.number,
        at=row.at,
        level=LogLevel(row.level),
        attempt=row.attempt,
        stage=row.stage,
        message=row.message,
        facts=row.facts or {},
    )


def upload_of(row: sa.Row[Any]) -> Upload:
    """A row of `uploads`."""
    return Upload(**row._asdict())


def key_of(row: sa.Row[Any]) -> Key:
    """A row of `keys`."""
    return Key(**row._asdict() | {"scopes": frozenset(Scope(scope) for scope in row.scopes)})


def endpoint_of(row: sa.Row[Any]) -> Endpoint:
    """A row of `webhooks`."""
    values = {field.name: getattr(row, field.name) for field in dataclasses.fields(Endpoint)}
    return Endpoint(**values | {"events": tuple(EventType(word) for word in row.events)})


def delivery_of(row: sa.Row[Any]) -> Delivery:
    """A row of `webhook_deliveries`, without the log of its attempts."""
    values = {field.name: getattr(row, field.name) for field in dataclasses.fields(Delivery) if field.name != "log"}
    return Delivery(**values | {"event": EventType(row.event), "state": DeliveryState(row.state)})
