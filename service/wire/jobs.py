"""Jobs: their status, list, events, and the form that sends tiles and starts one."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, WithJsonSchema, create_model

from pipeline.options import Option, served
from service.outputs.kinds import FORMATS
from service.run_settings import VARIANTS
from service.wire import patterns
from service.wire.base import Answer, Link, OneOf, Request, Time
from service.wire.execute import Execute
from service.wire.inputs import Text, type_of
from service.wire.problems import Problem
from service.wire.queries import entry_of

Progress = Annotated[int, Field(ge=0, le=100)]
Status = Literal["accepted", "running", "successful", "failed", "dismissed"]


class StatusInfo(Answer):
    """Status of a job: statusInfo of OGC API - Processes 1.0, with the members of the 2.0 draft."""

    jobID: str
    id: str
    processID: str
    type: Literal["process"]
    processingEntityType: Literal["ogc-api-processes"] | None = None
    status: Status
    title: str | None = None
    message: str | None = None
    stage: str | None = None
    progress: Progress
    created: Time
    started: Time | None = None
    finished: Time | None = None
    updated: Time
    priority: int | None = None
    scheduleID: str | None = Field(None, description="The schedule that made the job; it may be gone.")
    attempt: int | None = None
    keep: bool = Field(False, description="Whether the job is kept, whatever its age and size.")
    summary: dict[str, Any] | None = None
    exception: Problem | None = None
    request: Execute | None = None
    links: list[Link]


class JobChanges(Request):
    """What can be changed about a job."""

    keep: bool = Field(description="Whether the job is kept, whatever its age and size.")


class JobList(Answer):
    """A page of jobs."""

    jobs: list[StatusInfo]
    numberMatched: int = Field(ge=0, description="Number of jobs on all pages.")
    links: list[Link]


class Event(Answer):
    """Something that happened to a job."""

    id: int
    at: Time
    kind: Annotated[str, OneOf("status", "stage", "progress", "warning", "waiting")]
    status: Status | None = None
    stage: str
    done: int
    total: int
    progress: Progress
    message: str


class EventList(Answer):
    """A page of events."""

    events: list[Event]
    links: list[Link]


class JobLogLine(Answer):
    """A line of the log of a job."""

    number: int = Field(ge=1, description="Counts up within the job.")
    at: Time
    level: Annotated[str, OneOf("info", "warning", "error")]
    attempt: int = Field(ge=0, description="0 before the first one.")
    stage: str
    message: str
    facts: dict[str, Any] = Field(description="For example tile, building, reason, seconds, done, total, failed.")


class JobLog(Answer):
    """A page of the log of a job."""

    lines: list[JobLogLine]
    links: list[Link]


class ServerSentEvent(Answer):
    """One event of the stream."""

    event: str | None = Field(None, description="The event's kind.")
    data: str | None = Field(None, description="The event, as JSON.")
    id: str | None = Field(None, description="The event's id, for Last-Event-ID.")
    retry: int | None = Field(None, ge=0, description="Milliseconds until a client reconnects.")


File = Annotated[bytes, WithJsonSchema({"type": "string", "format": "binary"})]


class FormOfFiles(Answer):
    """Fields of the form. They become the inputs of a process."""

    model_config = ConfigDict(extra="forbid")

    tile: Annotated[
        list[File], Field(min_length=1, description="Point clouds. A field without a file name contains an href.")
    ]
    footprints: File | None = Field(None, description="Building outlines, as a file or an href.")
    guides: File | None = Field(None, description="Lines of roofs, as a file or an href.")
    methods: list[Annotated[str, entry_of(VARIANTS)]] | None = Field(
        None,
        description="Makes the job a comparison of these, each METHOD or METHOD:PRESET, instead of method and preset: "
        "the field several times, or with commas.",
    )
    settings: str | None = Field(None, description="JSON.")
    publish: list[Annotated[str, entry_of(FORMATS)]] | None = Field(
        None, description="Further formats of the models: the field several times, or with commas."
    )
    geoidHeight: float | None = Field(
        None, ge=-200.0, le=200.0, description="Metres of the geoid above the ellipsoid, for 3D Tiles."
    )
    title: Text | None = None
    priority: int | None = Field(None, ge=-10, le=10)
    subscriber: str | None = Field(None, description="JSON, as in a process's execution.")
    outputs: str | None = Field(None, description="Ids of the wanted outputs, with commas between them.")


def _field(option: Option) -> tuple[Any, Any]:
    """An option as a field of the form, where a rectangle is a text."""
    if option.name == "bbox":
        return str | None, Field(
            None,
            description="x_min,y_min,x_max,y_max in the tiles' CRS.",
            json_schema_extra=patterns.stated(patterns.WINDOW),
        )
    return type_of(option) | None, Field(None, description=option.meta["doc"])


JobForm: type[Answer] = create_model(
    "JobForm",
    __base__=FormOfFiles,
    __doc__=FormOfFiles.__doc__,
    **{one.input: _field(one) for one in served()},  # type: ignore[call-overload]
)
"""The form with the options of all processes."""
