"""Rows to records and back."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import sqlalchemy as sa
from pydantic import TypeAdapter

from service.jobs import Fault, Job, JobEvent, JobFailure, JobRequest, LogLine, Upload
from service.keys import Key
from service.webhooks import Delivery, Endpoint

Record = TypeVar("Record")


def storable(text: str, limit: int | None = None) -> str:
    """Text that both databases accept: no NUL, no lone surrogates, not longer than the column.

    >>> storable("abc", 2)
    'ab'
    """
    clean = text.replace("\0", "\ufffd").encode("utf-8", "replace").decode("utf-8")
    return clean if limit is None else clean[:limit]


def from_row(kind: Callable[..., Record], row: sa.Row[Any], **values: Any) -> Record:
    """A record by the columns of its row that have the names of its fields; some have other values."""
    found: Record = _adapter(kind).validate_python(row._asdict() | values)
    return found


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def job_of(row: sa.Row[Any]) -> Job:
    """A row of `jobs`."""
    failure = None if row.fault is None else JobFailure(fault=Fault(row.fault), detail=row.fault_detail or "")
    return from_row(Job, row, request=JobRequest.from_dict(row.request), failure=failure)


def event_of(row: sa.Row[Any]) -> JobEvent:
    """A row of `job_events`."""
    return from_row(JobEvent, row)


def log_line_of(row: sa.Row[Any]) -> LogLine:
    """A row of `job_log`."""
    return from_row(LogLine, row, facts=row.facts or {})


def upload_of(row: sa.Row[Any]) -> Upload:
    """A row of `uploads`."""
    return from_row(Upload, row)


def key_of(row: sa.Row[Any]) -> Key:
    """A row of `keys`."""
    return from_row(Key, row)


def endpoint_of(row: sa.Row[Any]) -> Endpoint:
    """A row of `webhooks`."""
    return from_row(Endpoint, row)


def delivery_of(row: sa.Row[Any]) -> Delivery:
    """A row of `webhook_deliveries`, without the log of its attempts."""
    return from_row(Delivery, row)
