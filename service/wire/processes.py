"""The processes and their descriptions."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.wire.base import Answer, Link


class ProcessSummary(Answer):
    """A process in a list."""

    id: str
    version: str
    title: str | None = None
    description: str | None = None
    keywords: list[str] | None = None
    jobControlOptions: list[Literal["sync-execute", "async-execute", "dismiss"]] | None = None
    outputTransmission: list[Literal["value", "reference"]] | None = None
    links: list[Link] | None = None


class ProcessList(Answer):
    """A page of processes."""

    processes: list[ProcessSummary]
    links: list[Link]


class OutputDescription(Answer):
    """An output."""

    title: str | None = None
    description: str | None = None
    schema_: dict[str, Any] = Field(alias="schema")


class InputDescription(OutputDescription):
    """An input."""

    minOccurs: int | None = None
    maxOccurs: int | Literal["unbounded"] | None = None
    valuePassing: list[Literal["byValue", "byReference"]] | None = None


class Process(ProcessSummary):
    """A process with its inputs and outputs."""

    inputs: dict[str, InputDescription]
    outputs: dict[str, OutputDescription]
