"""Rows to records and back."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import sqlalchemy as sa
from pydantic import TypeAdapter
from sqlalchemy.engine import Connection

from service.files import is_id
from service.jobs import Fault, Job, JobFailure, JobRequest, LogLine

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


def row_by_id(connection: Connection, table: sa.Table, name: str, *, locked: bool = False) -> sa.Row[Any] | None:
    """The row with an id of ours, with `locked` until the transaction ends; None if there is none."""
    if not is_id(name):
        return None
    (column,) = table.primary_key.columns
    one = sa.select(table).where(column == name)
    return connection.execute(one.with_for_update() if locked else one).one_or_none()


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def job_of(row: sa.Row[Any]) -> Job:
    """A row of `jobs`."""
    failure = None if row.fault is None else JobFailure(fault=Fault(row.fault), detail=row.fault_detail or "")
    return from_row(Job, row, request=JobRequest.from_dict(row.request), failure=failure)


def log_line_of(row: sa.Row[Any]) -> LogLine:
    """A row of `job_log`."""
    return from_row(LogLine, row, facts=row.facts or {})
