"""Schedules as clients send and get them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator

from pipeline.errors import SettingsError
from pipeline.schedule import Cron
from service.errors import RequestError, within
from service.schedules import OUTCOMES
from service.wire import patterns
from service.wire.base import Answer, Link, OneOf, Request, Time, ZonedTime, optional_members
from service.wire.execute import Execute
from service.wire.faults import FaultsError
from service.wire.inputs import Text

LONGEST_GRACE_S = 30 * 86_400
"""A month; a client that accepts a later start wants to run every slot."""

ProcessId = Literal["reconstruct", "compare", "classify", "echo"]
Missed = Annotated[
    Literal["run-latest", "skip"],
    Field(
        description="What happens to slots that no driver saw in time: the latest one is run, or none. All others are "
        "recorded as missed."
    ),
]
Overlap = Annotated[
    Literal["skip", "wait"],
    Field(
        description="What happens to a slot that comes while a job of the schedule is under way: it is skipped, or it "
        "waits until that job is over or a later slot replaces it."
    ),
]
Grace = Annotated[
    float,
    Field(
        ge=0,
        le=LONGEST_GRACE_S,
        allow_inf_nan=False,
        description="Seconds that a slot may be late and still be in time.",
    ),
]


def _cron(make: Callable[[str], Cron]) -> AfterValidator:
    """Checks a part of a cron, with its own faults."""

    def check(text: str) -> str:
        try:
            make(text)
        except SettingsError as error:
            raise FaultsError(error.faults) from error
        return text

    return AfterValidator(check)


Expression = Annotated[
    str,
    Field(
        max_length=200,
        description="Minute, hour, day of the month, month, day of the week, as in Debian's cron; or @hourly, @daily, "
        "@weekly, @monthly, @yearly.",
        json_schema_extra=patterns.stated(patterns.CRON),
    ),
    _cron(lambda text: Cron(text, "UTC")),
]
TimeZone = Annotated[
    str,
    Field(description="Name of a time zone in the IANA database.", json_schema_extra=patterns.stated(patterns.ZONE)),
    _cron(lambda text: Cron("* * * * *", text)),
]


def _changes(schema: dict[str, Any]) -> None:
    """Describe a change: at least one member, and no defaults."""
    optional_members(schema)
    for found in schema["properties"].values():
        found.pop("default", None)
    schema["minProperties"] = 1


def _not_given() -> Any:
    """The default of a word that a change need not give: an empty one, which no client can send."""
    return Field(default_factory=str)


class SchedulePatch(Request):
    """A change of a schedule: members that are not given stay."""

    model_config = ConfigDict(json_schema_extra=_changes)

    HINTS: ClassVar[Mapping[str, str]] = {
        "cron": "give five fields, such as '30 2 * * *'",
        "execute": "give the request, as for the process's execution",
    }

    title: Text | None = Field(
        None,
        description="Also the title of its jobs that have none; null for none.",
        json_schema_extra={"nullable": True},
    )
    cron: Expression = Field(default_factory=str)
    timeZone: TimeZone = "UTC"
    missed: Missed = "run-latest"
    graceSeconds: Grace = 300.0
    overlap: Overlap = "skip"
    processID: ProcessId = _not_given()
    execute: Execute = Field(default_factory=lambda: Execute())  # noqa: PLW0108 - mypy wants it
    paused: bool = Field(False, description="Whether the schedule is paused: no slot runs.")

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """The change, if there is one."""
        if given == {}:
            raise FaultsError([f"nothing is given: give the members to change, of {', '.join(cls.model_fields)}"])
        return given

    @field_validator("execute")
    @classmethod
    def _usable(cls, execute: Execute, info: ValidationInfo) -> Execute:
        """Checks the inputs as those of a job that is submitted now; the route knows the process that stays."""
        if "processID" in info.data:
            likely = "compare" if "methods" in execute.inputs else "reconstruct"
            try:
                execute.draft(info.data["processID"] or likely)
            except RequestError as error:
                raise FaultsError(within("execute", error.faults)) from error
        return execute


class ScheduleRequest(SchedulePatch):
    """A new schedule."""

    model_config = ConfigDict(json_schema_extra=optional_members)

    cron: Expression
    processID: ProcessId = "reconstruct"
    execute: Execute

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """The schedule as it was sent."""
        return given


class ScheduleRun(Answer):
    """The outcome of a slot or of a run by hand."""

    number: int = Field(ge=1, description="Counts up within the schedule.")
    trigger: Literal["clock", "hand"]
    outcome: Annotated[str, OneOf(*OUTCOMES)]
    slot: Time | None = Field(None, description="When it was due; the last one if several were missed together.")
    firstSlot: Time | None = Field(None, description="The first one if several were missed together.")
    slots: int = Field(ge=1, description="Number of slots.")
    moreSlots: bool | None = Field(None, description="Whether there are more slots than were counted.")
    jobID: str | None = Field(None, description="The job that was made, or the one that was under way.")
    at: Time = Field(description="When this was decided.")
    message: str
    links: list[Link]


class ScheduleRunList(Answer):
    """A page of runs."""

    runs: list[ScheduleRun]
    links: list[Link]


class Schedule(Answer):
    """A schedule."""

    scheduleID: str
    version: int = Field(ge=1, description="Counts the client's changes; the ETag.")
    title: str | None = None
    state: Literal["active", "paused"]
    cron: str
    timeZone: str
    missed: Missed
    graceSeconds: Grace
    overlap: Overlap
    processID: str
    execute: Execute | None = None
    created: Time
    updated: Time
    nextTimes: list[ZonedTime] = Field(
        description="The next times, with the offset that the zone has then; empty while it is paused."
    )
    waiting: Time | None = Field(None, description="The slot that waits for a job to end.")
    lastRun: ScheduleRun | None = None
    counts: dict[str, Annotated[int, Field(ge=0)]] = Field(
        description="Slots and runs by hand since the schedule was made: submitted, skipped, missed, failed."
    )
    links: list[Link]


class ScheduleList(Answer):
    """A page of schedules."""

    schedules: list[Schedule]
    links: list[Link]
