r"""Jobs: frozen records, a status, and which transition is allowed. No SQL, no HTTP; time is an argument.

```
             claim                 succeed
 accepted ----------> running ---------------> successful
   |  ^                 | | \                       |
   |  |  release, lost  | |  \ fail, or lost        | remove
   |  +-----------------+ |   \ too often           v
   |                      |    +------------> failed --> (gone)
   |  dismiss             | dismiss
   +----------------------+------------> dismissed ------> (gone)
```

A driver holds a running job by a *lease*: its name, the attempt's number, and the time until which it counts. All that
a driver writes is conditional on the lease, so a driver that was thought dead cannot finish a job twice.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import sys
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Literal

from pipeline.options import ModelOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class QueueLimits:
    """How many jobs may wait; running ones do not count."""

    max_queued: int = sys.maxsize
    """All jobs."""
    max_queued_per_key: int = sys.maxsize
    """Jobs of one key."""


UNLIMITED = QueueLimits()


class JobStatus(StrEnum):
    """Status of a job, in the words of OGC API - Processes."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    SUCCESSFUL = "successful"
    FAILED = "failed"
    DISMISSED = "dismissed"

    @property
    def is_over(self) -> bool:
        """Whether nothing more happens."""
        return self in {JobStatus.SUCCESSFUL, JobStatus.FAILED, JobStatus.DISMISSED}


class LogLevel(StrEnum):
    """How serious a line of a log is, in ascending order."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Fault(StrEnum):
    """Kind of failure of a job; decides the HTTP status of its results."""

    INPUT = "input"
    """An input cannot be used; the client must change it."""
    SETTINGS = "settings"
    """Settings are out of range; the client must change them."""
    REFUSED = "refused"
    """An input is not allowed or too large."""
    CLUSTER = "cluster"
    """There is no cluster, or it was lost repeatedly."""
    LOST = "lost"
    """Drivers died repeatedly during the job."""
    STALLED = "stalled"
    """Its attempts stood still, or ended by themselves, again and again."""
    NO_SPACE = "no-space"
    """The disk had no room for it, repeatedly."""
    INTERNAL = "internal"
    """A fault of the service."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputReference:
    """Location of an input."""

    kind: Literal["upload", "path", "url"]
    """Kind of location."""
    value: str
    """The upload's id, the absolute path, or the URL."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Subscriber:
    """Where a client wants to get news of its job: the subscriber of OGC API - Processes."""

    success_uri: str | None = None
    """Gets the results document."""
    in_progress_uri: str | None = None
    """Gets the status when the job starts, and its progress."""
    failed_uri: str | None = None
    """Gets the status if the job fails or is dismissed."""
    base: str = ""
    """The service's own URL as the client knows it, for links."""

    @property
    def uris(self) -> list[str]:
        """All that are given, each once."""
        given = (self.success_uri, self.in_progress_uri, self.failed_uri)
        return list(dict.fromkeys(uri for uri in given if uri is not None))


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobRequest(ModelOptions):
    """The job's request, validated at submission."""

    process_id: str = "reconstruct"
    """The process."""
    tiles: tuple[InputReference, ...]
    """Point clouds."""
    footprints: InputReference | None = None
    """A vector file of building outlines."""
    guides: InputReference | None = None
    """A vector file of lines of roofs; not for `classify`."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings that differ from the defaults, as in a settings file; includes `method`, `preset` and `classes`."""
    methods: tuple[str, ...] = ()
    """Methods of a comparison, each METHOD or METHOD:PRESET; empty for other processes."""
    echo: Mapping[str, Any] | None = None
    """Message and delay in seconds; only for `echo`, which has no tiles."""
    raster_cell: float | None = None
    """Side of the cells of rasters in the CRS's units; None for the default. Only for `classify`."""
    publish: tuple[str, ...] = ()
    """Further formats of the results, words of `service.outputs.kinds.FORMATS`. Only for `reconstruct`."""
    geoid_height: float | None = None
    """Metres of the geoid above the ellipsoid, added to the elevations of 3D Tiles."""
    outputs: tuple[str, ...] | None = None
    """Ids of the wanted outputs; None for all."""
    response: str = "document"
    """document or raw: whether the results are listed in a document or in Link headers."""
    title: str | None = None
    """The user's title."""
    subscriber: Subscriber | None = None
    """Where to send news of the job."""

    @property
    def has_buildings(self) -> bool:
        """Whether its results have buildings."""
        return self.process_id in {"reconstruct", "compare"}

    @property
    def upload_ids(self) -> list[str]:
        """Ids of the uploads among its inputs, each once, in order."""
        references = [*self.tiles, *(one for one in (self.footprints, self.guides) if one is not None)]
        return sorted({reference.value for reference in references if reference.kind == "upload"})

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> JobRequest:
        """The inverse of `as_dict`.

        >>> request = JobRequest(tiles=(InputReference(kind="upload", value="u1"),), bbox=(0.0, 0.0, 1.0, 1.0))
        >>> JobRequest.from_dict(request.as_dict()) == request
        True
        """
        values = dict(stored)
        values["tiles"] = tuple(InputReference(**tile) for tile in stored["tiles"])
        for name in ("footprints", "guides"):
            if stored.get(name) is not None:
                values[name] = InputReference(**stored[name])
        if stored.get("subscriber") is not None:
            values["subscriber"] = Subscriber(**stored["subscriber"])
        for name in ("bbox", "outputs", "methods", "publish"):
            if stored.get(name) is not None:
                values[name] = tuple(stored[name])
        return cls(**values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobFailure:
    """Why a job failed."""

    fault: Fault
    """Kind of cause."""
    detail: str
    """One or more sentences that name the value and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A job as it is stored."""

    job_id: str
    """32 hexadecimal digits, random: it cannot be guessed."""
    owner: str | None
    """Id of the key that submitted it; None if keys are not used."""
    request: JobRequest
    """Its request."""
    status: JobStatus
    priority: int = 0
    """Higher runs first."""
    message: str = ""
    """One sentence about the progress or the outcome."""
    progress: int = 0
    """0 to 100; never falls within an attempt."""
    stage: str = ""
    """The stage of the run."""
    created_at: dt.datetime
    """With a time zone, like all times here."""
    started_at: dt.datetime | None = None
    """When the first driver claimed it."""
    finished_at: dt.datetime | None = None
    updated_at: dt.datetime
    dismiss_requested: bool = False
    """Whether the driver of a running job must stop."""
    attempt: int = 0
    """Number of claims; names the folder of the attempt."""
    lost_attempts: int = 0
    """Attempts whose driver or cluster was lost; too many of them end the job."""
    own_ends: int = 0
    """Attempts in a row that stood still, or ended by themselves, at stage `own_end_stage`; too many end the job."""
    own_end_stage: str = ""
    """The stage of the last of them."""
    other_ends: int = 0
    """Attempts whose process was killed from outside, or ended in another stage than the one before."""
    lease_owner: str | None = None
    """Name of the driver that holds it."""
    lease_until: dt.datetime | None = None
    """Time at which the claim ends."""
    failure: JobFailure | None = None
    """Why it failed."""
    summary: Mapping[str, Any] | None = None
    """Counts, digest and timings of the run, once successful."""
    schedule_id: str | None = None
    """The schedule that made it; it may be removed by now."""
    keep: bool = False
    """Whether it is kept, whatever its age and size."""
    traceparent: str | None = None
    """The span of the request that made it, as the header of that name; None without traces."""
    watched_at: dt.datetime | None = None
    """When a client last read the buildings that it had so far; not written every time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EndedAttempt:
    """An attempt whose process ended, or was ended, before the attempt."""

    stage: str
    """The stage that ran."""
    detail: str
    """What happened, in words that follow the name of the attempt."""
    is_own: bool
    """Whether the attempt itself is the cause; False if it was killed from outside."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wishes:
    """What clients want from the driver of a running job."""

    dismissal: bool
    """It must stop."""
    watched_at: dt.datetime | None
    """As in `Job`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobEvent:
    """An event of a job, for the event stream."""

    sequence: int
    """Counts up within the job, from 1; the id of the server-sent event."""
    at: dt.datetime
    kind: str
    """status (accepted, running, ...), stage, progress, warning or waiting."""
    status: JobStatus | None = None
    """The new status; only for kind `status`."""
    stage: str = ""
    done: int = 0
    total: int = 0
    progress: int = 0
    """0 to 100 over the whole job."""
    message: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewLogLine:
    """A line for the log of a job, before the store numbers it."""

    level: LogLevel = LogLevel.INFO
    stage: str = ""
    """The stage of the run; empty if there is none."""
    message: str
    """One or more sentences, without paths of the machine."""
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """tile, building, reason, seconds, done, total, failed: plain JSON values."""
    age_s: float = 0.0
    """Seconds since it happened."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogLine:
    """A line of the log of a job."""

    number: int
    """Counts up within the job, from 1."""
    at: dt.datetime
    level: LogLevel
    attempt: int
    """The attempt; 0 before the first one."""
    stage: str
    message: str
    facts: Mapping[str, Any]
    """As in `NewLogLine`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Upload:
    """A file that a client sent."""

    upload_id: str
    """32 hexadecimal digits, random."""
    owner: str | None
    """Id of the key that sent it."""
    filename: str
    """Last part of the client's name, cleaned; decides the format by its ending."""
    size_bytes: int
    sha256: str
    """Hexadecimal."""
    created_at: dt.datetime
    expires_at: dt.datetime
    preflight: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Facts from the header: format, CRS, points, bounds, density, warnings."""
