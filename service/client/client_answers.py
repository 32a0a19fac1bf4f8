"""What the service answers, as far as the client reads it: frozen data. Unknown members are kept in `document`.

The service's own models (`service.wire`) check requests and describe answers; they load the engine, which a client does
not need. A test compares the two.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

Status = Literal["accepted", "running", "successful", "failed", "dismissed"]

OVER = frozenset({"successful", "failed", "dismissed"})
"""Statuses of jobs that are over."""


def _time(text: str | None) -> dt.datetime | None:
    return None if text is None else dt.datetime.fromisoformat(text)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """Why something was refused or failed: a problem document (RFC 9457)."""

    status: int
    """The status of the answer; of a failed job, that of its results."""
    kind: str = ""
    """The last word of the kind's URI, such as `too-large`; empty without one."""
    title: str = ""
    """The same for every problem of the kind."""
    detail: str = ""
    """The value and the fix."""
    errors: tuple[str, ...] = ()
    """Every fault, if there can be several."""
    job_id: str | None = None
    """The job that is under way; only of `schedule-busy`."""

    @classmethod
    def of(cls, document: Mapping[str, Any], status: int) -> Self:
        """From its document; `status` counts if that has none.

        >>> Problem.of({"type": "urn:gablework:problem:too-large", "detail": "too many bytes"}, 413).kind
        'too-large'
        """
        kind = str(document.get("type", "")).rpartition("/")[2].rpartition(":")[2]
        return cls(
            status=int(document.get("status", status)),
            kind="" if kind == "blank" else kind,
            title=str(document.get("title", "")),
            detail=str(document.get("detail", "")),
            errors=tuple(map(str, document.get("errors") or ())),
            job_id=document.get("jobID"),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A job at the time of the answer."""

    id: str
    """32 hexadecimal digits."""
    process: str
    """reconstruct, compare, classify or echo."""
    status: Status
    progress: int
    """0 to 100."""
    message: str
    """One sentence about the progress or the outcome."""
    stage: str | None
    title: str | None
    created: dt.datetime
    started: dt.datetime | None
    finished: dt.datetime | None
    updated: dt.datetime
    attempt: int
    """Number of times that a driver has begun it."""
    keep: bool
    """Whether it is kept, whatever its age and size."""
    schedule_id: str | None
    """The schedule that made it."""
    summary: Mapping[str, Any]
    """Counts, digest and timings of a job that succeeded; empty before."""
    problem: Problem | None
    """Why it failed."""
    document: Mapping[str, Any] = dataclasses.field(repr=False, compare=False)
    """All that the service has answered."""

    @property
    def is_over(self) -> bool:
        """Whether it will not change any more."""
        return self.status in OVER

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """From its statusInfo."""
        created, updated = _time(document["created"]), _time(document["updated"])
        assert created is not None
        assert updated is not None
        exception = document.get("exception")
        return cls(
            id=document["jobID"],
            process=document["processID"],
            status=document["status"],
            progress=document["progress"],
            message=document.get("message", ""),
            stage=document.get("stage"),
            title=document.get("title"),
            created=created,
            started=_time(document.get("started")),
            finished=_time(document.get("finished")),
            updated=updated,
            attempt=document.get("attempt", 0),
            keep=document.get("keep", False),
            schedule_id=document.get("scheduleID"),
            summary=document.get("summary") or {},
            problem=None if exception is None else Problem.of(exception, 500),
            document=document,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened to a job."""

    id: int
    """Counts up within the job."""
    at: dt.datetime
    kind: str
    """status, stage, progress, warning or waiting."""
    status: Status | None
    """The new status; only of the kind `status`."""
    stage: str
    done: int
    """Finished units of the stage."""
    total: int
    """Units of the stage; 0 if unknown."""
    progress: int
    """0 to 100 over the whole job."""
    message: str

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """From its document."""
        at = _time(document["at"])
        assert at is not None
        return cls(
            id=document["id"],
            at=at,
            kind=document["kind"],
            status=document.get("status"),
            stage=document.get("stage", ""),
            done=document.get("done", 0),
            total=document.get("total", 0),
            progress=document.get("progress", 0),
            message=document.get("message", ""),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Output:
    """An output of a job that succeeded."""

    id: str
    """buildings, planes, report, …"""
    media_type: str
    title: str
    size_bytes: int
    sha256: str
    """Hexadecimal."""

    @classmethod
    def of(cls, output_id: str, document: Mapping[str, Any]) -> Self:
        """From its entry in the results."""
        return cls(
            id=output_id,
            media_type=document["type"],
            title=document["title"],
            size_bytes=document["bytes"],
            sha256=document["sha256"],
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FetchedFile:
    """An output that is now a file here."""

    output: Output
    path: Path
    is_new: bool
    """Whether it was fetched now; otherwise it was here already."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Submitted:
    """A job, and whether the call has made it."""

    job: Job
    is_new: bool
    """False if an equal call had made it before."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Transfer:
    """How far an upload or a download is."""

    name: str
    """The file's name."""
    done_bytes: int
    total_bytes: int
