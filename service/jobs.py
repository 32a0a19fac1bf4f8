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
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Literal


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


class Fault(StrEnum):
    """What kind of cause a job failed for; decides the HTTP status of its results."""

    INPUT = "input"
    """An input cannot be used: the client's business."""
    SETTINGS = "settings"
    """Settings are out of range: the client's business."""
    REFUSED = "refused"
    """An input is not allowed or too large."""
    CLUSTER = "cluster"
    """No cluster, or it was lost again and again."""
    LOST = "lost"
    """Drivers died over the job again and again."""
    INTERNAL = "internal"
    """A fault of ours."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputReference:
    """Where an input lies."""

    kind: Literal["upload", "path", "url"]
    """How it was given."""
    value: str
    """The upload's id, the absolute path, or the URL."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobRequest:
    """What a job is to do; validated when it was submitted."""

    process_id: str = "reconstruct"
    """The process."""
    tiles: tuple[InputReference, ...]
    """Point clouds."""
    footprints: InputReference | None = None
    """A vector file of outlines."""
    crs: str | None = None
    """Stands above the headers' CRS."""
    vertical_unit: str | None = None
    """Stands above the headers' vertical unit."""
    bbox: tuple[float, float, float, float] | None = None
    """x_min, y_min, x_max, y_max in the CRS's units."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What differs from the defaults, as the tables of a settings file; `method`, `preset` and `classes` included."""
    methods: tuple[str, ...] = ()
    """What a comparison runs, each METHOD or METHOD:PRESET; empty of other processes."""
    meshes: str = "building"
    """One OBJ a building, one a tile, or none."""
    licence: str | None = None
    """Licence of the source data."""
    outputs: tuple[str, ...] | None = None
    """Ids of the outputs that are wanted; None for all."""
    title: str | None = None
    """The user's words."""

    @property
    def upload_ids(self) -> list[str]:
        """Ids of the uploads among its inputs, each once, in order."""
        references = [*self.tiles, *([] if self.footprints is None else [self.footprints])]
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
        if stored.get("footprints") is not None:
            values["footprints"] = InputReference(**stored["footprints"])
        for name in ("bbox", "outputs", "methods"):
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
    """Id of the key that submitted it; None where keys are not used."""
    request: JobRequest
    """What is to be done."""
    status: JobStatus
    priority: int = 0
    """Higher goes first."""
    message: str = ""
    """One sentence on what happens or what came out."""
    progress: int = 0
    """0 to 100; never falls within an attempt."""
    stage: str = ""
    """The stage of the run."""
    created_at: dt.datetime
    """With a time zone, as all times here."""
    started_at: dt.datetime | None = None
    """When the first driver claimed it."""
    finished_at: dt.datetime | None = None
    updated_at: dt.datetime
    dismiss_requested: bool = False
    """A running job's driver is to stop."""
    attempt: int = 0
    """Times it was claimed; names the folder of the attempt."""
    lost_attempts: int = 0
    """Attempts whose driver or cluster was lost; what counts towards giving up."""
    lease_owner: str | None = None
    """Name of the driver that holds it."""
    lease_until: dt.datetime | None = None
    """Until when the claim counts."""
    failure: JobFailure | None = None
    """Why it failed."""
    summary: Mapping[str, Any] | None = None
    """Counts, digest and timings of the run, once successful."""
    schedule_id: str | None = None
    """The schedule that it came of; it may be gone by now."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobEvent:
    """One thing that happened to a job, for the event stream."""

    sequence: int
    """Counts up within the job, from 1; the id of the server-sent event."""
    at: dt.datetime
    kind: str
    """status (accepted, running, ...), stage, progress, warning or waiting."""
    status: JobStatus | None = None
    """The status that the job came to; only of kind `status`."""
    stage: str = ""
    done: int = 0
    total: int = 0
    progress: int = 0
    """0 to 100 over the whole job."""
    message: str = ""


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
