"""Reading jobs, their events and their logs."""

from __future__ import annotations

import builtins
import dataclasses
import datetime as dt
import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import NoSuchJobError
from service.files import is_id
from service.jobs import Job, JobEvent, JobStatus, LogLevel, LogLine
from service.store.database import StorePart
from service.store.records import from_row, job_of, log_line_of, storable
from service.store.tables import EVENTS, JOBS, LOG_LINES

_ASKED_AT_ONCE = 512
_LAST = 2**31 - 1
"""Largest number in an integer column."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobFilter:
    """Which jobs to list; the filters of OGC API - Processes."""

    owner: str | None = None
    """Only this key's jobs; None for the jobs of all keys."""
    statuses: Collection[JobStatus] = ()
    """Only these; empty for all."""
    process_ids: Collection[str] = ()
    """Only these; empty for all."""
    schedule_id: str | None = None
    """Only jobs of this schedule."""
    words: Collection[str] = ()
    """Only jobs with each of these in title, id or process; case does not matter."""
    created_from: dt.datetime | None = None
    """Created at this time or later; with a time zone."""
    created_to: dt.datetime | None = None
    """Created at this time or earlier; with a time zone."""
    min_duration_s: float | None = None
    """Ran for so many seconds or longer; a running job counts up to now, one that never ran does not count."""
    max_duration_s: float | None = None
    """Ran for at most so many seconds; counted in the same way."""
    limit: int = 100
    """Maximum number of jobs to list."""
    offset: int = 0
    """Number of jobs to skip."""


class JobQueries(StorePart):
    """What is read of jobs."""

    def now(self) -> dt.datetime:
        """The database's clock, in UTC."""
        with self._database.read() as connection:
            return self._database.now(connection)

    def get(self, job_id: str, *, owner: str | None = None) -> Job:
        """One job; with an owner only its own.

        Raises
        ------
        NoSuchJobError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return get(connection, job_id, owner)

    def existing(self, job_ids: Collection[str]) -> dict[str, Job]:
        """Those of some jobs that exist, by id."""
        with self._database.read() as connection:
            return _existing(connection, job_ids)

    def list(self, criteria: JobFilter) -> builtins.list[Job]:
        """The jobs that fit, newest first."""
        with self._database.read() as connection:
            chosen = sa.select(JOBS).where(*_conditions(criteria, self._database.now(connection)))
            ordered = chosen.order_by(JOBS.c.created_at.desc(), JOBS.c.job_id.desc())
            return [job_of(row) for row in connection.execute(ordered.limit(criteria.limit).offset(criteria.offset))]

    def matching(self, criteria: JobFilter) -> int:
        """Number of the jobs that fit, on all pages."""
        with self._database.read() as connection:
            conditions = _conditions(criteria, self._database.now(connection))
            chosen = sa.select(sa.func.count()).select_from(JOBS).where(*conditions)
            return int(connection.execute(chosen).scalar_one())

    def finished(self) -> builtins.list[tuple[str, dt.datetime]]:
        """Ids and ends of the jobs that are over and not kept, oldest first."""
        over = [status.value for status in JobStatus if status.is_over]
        wanted = sa.select(JOBS.c.job_id, JOBS.c.finished_at).where(
            JOBS.c.status.in_(over), JOBS.c.keep.is_(sa.false()), JOBS.c.finished_at.is_not(None)
        )
        with self._database.read() as connection:
            found = connection.execute(wanted.order_by(JOBS.c.finished_at, JOBS.c.job_id))
            return [(row.job_id, row.finished_at) for row in found]

    def events(self, job_id: str, after: int = 0, limit: int = 500) -> builtins.list[JobEvent]:
        """A job's events with a higher number than `after`, in order; none for a job that does not exist."""
        if not is_id(job_id):
            return []
        later = sa.select(EVENTS).where(EVENTS.c.job_id == job_id, EVENTS.c.sequence > max(0, min(after, _LAST)))
        with self._database.read() as connection:
            found = connection.execute(later.order_by(EVENTS.c.sequence).limit(limit))
            return [from_row(JobEvent, row) for row in found]

    def log(
        self,
        job_id: str,
        *,
        after: int = 0,
        before: int | None = None,
        level: LogLevel = LogLevel.INFO,
        limit: int = 100,
    ) -> builtins.list[LogLine]:
        """Lines of a job's log in their order; none without such a job.

        Parameters
        ----------
        job_id : str
            The job.
        after : int
            Only lines with a higher number; 0 for all.
        before : int, optional
            Only lines with a lower number.
        level : LogLevel
            Only lines that are as serious as this one, or more.
        limit : int
            Maximum number of lines: the newest ones, unless `after` is given, then the first ones after it.
        """
        if not is_id(job_id):
            return []
        levels = builtins.list(LogLevel)
        wanted = [LOG_LINES.c.job_id == job_id, LOG_LINES.c.level.in_([w.value for w in levels[levels.index(level) :]])]
        if after:
            wanted.append(LOG_LINES.c.number > min(after, _LAST))
        if before is not None:
            wanted.append(LOG_LINES.c.number < min(before, _LAST))
        order = LOG_LINES.c.number.asc() if after else LOG_LINES.c.number.desc()
        with self._database.read() as connection:
            chosen = sa.select(LOG_LINES).where(*wanted).order_by(order).limit(limit)
            found = [log_line_of(row) for row in connection.execute(chosen)]
        return found if after else found[::-1]

    def counts(self) -> dict[JobStatus, int]:
        """Jobs by status; every status is there."""
        grouped = sa.select(JOBS.c.status, sa.func.count()).group_by(JOBS.c.status)
        with self._database.read() as connection:
            found: dict[Any, int] = {JobStatus(status): count for status, count in connection.execute(grouped)}
        return {status: found.get(status, 0) for status in JobStatus}

    def attempts(self, job_ids: Sequence[str]) -> dict[str, tuple[JobStatus, int]]:
        """Status and number of the latest attempt, of those jobs that exist."""
        found: dict[str, tuple[JobStatus, int]] = {}
        with self._database.read() as connection:
            for some in _in_portions(job_ids):
                wanted = sa.select(JOBS.c.job_id, JOBS.c.status, JOBS.c.attempt).where(JOBS.c.job_id.in_(some))
                found |= {row.job_id: (JobStatus(row.status), row.attempt) for row in connection.execute(wanted)}
        return found


def no_such_job(job_id: str) -> NoSuchJobError:
    """The error that names the job."""
    return NoSuchJobError(f"there is no job {job_id[:64]!r}")


def get(connection: Connection, job_id: str, owner: str | None) -> Job:
    """One job. Within a transaction.

    Raises
    ------
    NoSuchJobError
        It does not exist, or belongs to another key.
    """
    return seen_by(owner, _existing(connection, [job_id]).get(job_id), job_id)


def seen_by(owner: str | None, job: Job | None, job_id: str) -> Job:
    """A job, if there is one and the owner may see it; None as owner sees all.

    Raises
    ------
    NoSuchJobError
        Otherwise.
    """
    if job is None or (owner is not None and job.owner != owner):
        raise no_such_job(job_id)
    return job


def _existing(connection: Connection, job_ids: Collection[str]) -> dict[str, Job]:
    found: dict[str, Job] = {}
    for some in _in_portions(job_ids):
        rows = connection.execute(sa.select(JOBS).where(JOBS.c.job_id.in_(some)))
        found |= {row.job_id: job_of(row) for row in rows}
    return found


def _in_portions(job_ids: Iterable[str]) -> Iterator[list[str]]:
    """Those that are ids, as many at a time as a statement may name.

    The last is repeated up to the next power of two: connections keep the statements, and there are few of them then.
    """
    asked = iter([job_id for job_id in job_ids if is_id(job_id)])
    while some := list(itertools.islice(asked, _ASKED_AT_ONCE)):
        length = 1 << (len(some) - 1).bit_length()
        yield some + some[-1:] * (length - len(some))


def _conditions(criteria: JobFilter, now: dt.datetime) -> list[sa.ColumnElement[bool]]:
    """The filters as SQL; `now` ends the duration of jobs that run."""
    found: list[sa.ColumnElement[bool]] = []
    if criteria.owner is not None:
        found.append(JOBS.c.owner == criteria.owner)
    if criteria.statuses:
        found.append(JOBS.c.status.in_([JobStatus(status).value for status in criteria.statuses]))
    if criteria.process_ids:
        found.append(JOBS.c.process_id.in_([storable(name) for name in criteria.process_ids]))
    if criteria.schedule_id is not None:
        found.append(JOBS.c.schedule_id == storable(criteria.schedule_id))
    texts = (JOBS.c.request["title"].as_string(), JOBS.c.job_id, JOBS.c.process_id)
    words = [storable(word) for word in criteria.words]
    found += [sa.or_(*(text.icontains(word, autoescape=True) for text in texts)) for word in words]
    if criteria.created_from is not None:
        found.append(JOBS.c.created_at >= criteria.created_from)
    if criteria.created_to is not None:
        found.append(JOBS.c.created_at <= criteria.created_to)
    runs = sa.and_(JOBS.c.finished_at.is_(None), JOBS.c.started_at.is_not(None))
    if criteria.min_duration_s is not None:
        started = JOBS.c.started_at <= _before(now, criteria.min_duration_s)
        found.append(sa.or_(JOBS.c.duration_ms >= _milliseconds(criteria.min_duration_s), sa.and_(runs, started)))
    if criteria.max_duration_s is not None:
        started = JOBS.c.started_at >= _before(now, criteria.max_duration_s)
        found.append(sa.or_(JOBS.c.duration_ms <= _milliseconds(criteria.max_duration_s), sa.and_(runs, started)))
    return found


_LONGEST_S = 1e9


def _before(now: dt.datetime, seconds: float) -> dt.datetime:
    """The time so many seconds ago, limited to a lifetime."""
    return now - dt.timedelta(seconds=max(min(seconds, _LONGEST_S), -_LONGEST_S))


def _milliseconds(seconds: float) -> int:
    return round(max(min(seconds, _LONGEST_S), -_LONGEST_S) * 1000)
