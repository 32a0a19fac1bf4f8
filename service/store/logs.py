"""Logs of jobs: their lines, and how many are kept. Within a transaction."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import NewLogLine
from service.store.records import storable
from service.store.tables import JOBS, LOG_LINES

MAX_LINES = 2000
"""Lines kept per job: the newest."""
MAX_LETTERS = 1000
"""Letters of a line's message, and of each of its facts; the rest is cut off."""


def append(
    connection: Connection, row: sa.Row[Any], lines: Sequence[NewLogLine], now: dt.datetime, *, attempt: int
) -> None:
    """Add lines to the log of a locked job, as it was read in this transaction and not given lines since."""
    if not lines:
        return
    last = row.last_log_line + len(lines)
    connection.execute(
        sa.insert(LOG_LINES),
        [
            {
                "job_id": row.job_id,
                "number": number,
                "at": now - dt.timedelta(seconds=line.age_s),
                "level": line.level.value,
                "attempt": attempt,
                "stage": storable(line.stage, 64),
                "message": _cut(line.message),
                "facts": {n: _cut(v) if isinstance(v, str) else v for n, v in line.facts.items()} or None,
            }
            for number, line in enumerate(lines, start=row.last_log_line + 1)
        ],
    )
    connection.execute(sa.update(JOBS).where(JOBS.c.job_id == row.job_id).values(last_log_line=last))
    if last > MAX_LINES:
        old = sa.and_(LOG_LINES.c.job_id == row.job_id, LOG_LINES.c.number <= last - MAX_LINES)
        connection.execute(sa.delete(LOG_LINES).where(old))


def _cut(text: str) -> str:
    clean = storable(text)
    return clean if len(clean) <= MAX_LETTERS else f"{clean[: MAX_LETTERS - 1]}…"
