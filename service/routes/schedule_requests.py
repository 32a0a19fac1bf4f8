"""What a client says of a schedule, read strictly: every fault is told, not only the first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from pipeline.errors import SettingsError
from pipeline.schedule import Cron, Missed, Overlap
from service.drafts import Draft, Inputs, shortened
from service.errors import RequestError
from service.jobs import JobRequest
from service.processes import PROCESSES, process_named
from service.routes.processes import execute_parts
from service.schedules import Definition
from service.settings import ServiceSettings

Value = TypeVar("Value")
Policy = TypeVar("Policy", Missed, Overlap)

LONGEST_GRACE_S = 30 * 86_400.0
"""A month: who wants to be later than that wants every slot to be run."""

FIELDS = ("title", "cron", "timeZone", "processID", "execute", "missed", "graceSeconds", "overlap", "paused")
"""Members of a schedule that a client may give."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What was read; the files of its request may not be stored yet."""

    values: Mapping[str, Any]
    """Fields of the `Definition` but for the request and its priority."""
    draft: Draft | None
    """The request; None where a change leaves it as it is."""

    def definition(self, request: JobRequest, priority: int) -> Definition:
        """The definition, once the request is known."""
        return Definition(request=request, priority=priority, **self.values)


def read_plan(given: Mapping[str, Any], before: Definition | None, settings: ServiceSettings) -> Plan:
    """A new schedule, or a change of one.

    Parameters
    ----------
    given : mapping
        What the client sent.
    before : Definition or None
        What is to be changed: what is not given stays. None for a new schedule.
    settings : ServiceSettings
        Limits of requests.

    Raises
    ------
    RequestError
        Naming every fault.
    """
    members = _Members(given)
    if before is not None and not given:
        members.faults.append(f"nothing is given: give what is to be changed, of {', '.join(FIELDS)}")
    values = {
        "title": members.title(None if before is None else before.title),
        "cron": members.cron(None if before is None else before.cron),
        "missed": members.word("missed", Missed, Definition.missed if before is None else before.missed),
        "grace_s": members.seconds("graceSeconds", Definition.grace_s if before is None else before.grace_s),
        "overlap": members.word("overlap", Overlap, Definition.overlap if before is None else before.overlap),
        "is_paused": members.flag("paused", default=False if before is None else before.is_paused),
    }
    draft = members.draft(None if before is None else before.request.process_id, settings)
    if members.faults:
        raise RequestError(members.faults)
    return Plan(values=values, draft=draft)


class _Members:
    """Members of one document, read one by one; collects the faults. Null is a value only where it is told so."""

    def __init__(self, given: Mapping[str, Any]) -> None:
        self._given = given
        self.faults = [
            f"{shortened(name)} is no member: use {', '.join(FIELDS)}" for name in given if name not in FIELDS
        ]

    def title(self, before: str | None) -> str | None:
        if "title" not in self._given:
            return before
        value = self._given["title"]
        if value is not None and not isinstance(value, str):
            return self._fault("title", "use a text, or null for none", before)
        inputs = Inputs({"title": value})
        found = inputs.text("title")
        self.faults += inputs.faults
        return found

    def cron(self, before: Cron | None) -> Cron | None:
        """Expression and time zone belong together."""
        if before is None and "cron" not in self._given:
            self.faults.append("cron is missing: give five fields, such as '30 2 * * *'")
        expression = self._text("cron", "* * * * *" if before is None else before.expression)
        zone = self._text("timeZone", "UTC" if before is None else before.time_zone)
        if "cron" not in self._given and "timeZone" not in self._given and before is not None:
            return before
        try:
            return Cron(expression, zone)
        except SettingsError as error:
            self.faults += error.faults
            return before

    def word(self, name: str, kind: type[Policy], default: Policy) -> Policy:
        if name not in self._given:
            return default
        words = [str(word) for word in kind]
        if self._given[name] not in words:
            return self._fault(name, f"use one of {', '.join(words)}", default)
        return kind(self._given[name])

    def seconds(self, name: str, default: float) -> float:
        value = self._given.get(name, default)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not (0 <= value <= LONGEST_GRACE_S) or not math.isfinite(value):
            return self._fault(name, f"use seconds from 0 to {LONGEST_GRACE_S:g}", default)
        return float(value)

    def flag(self, name: str, *, default: bool) -> bool:
        value = self._given.get(name, default)
        return value if isinstance(value, bool) else self._fault(name, "use true or false", default)

    def draft(self, process_before: str | None, settings: ServiceSettings) -> Draft | None:
        """The request of its jobs, read as that of a job that is submitted now."""
        process_id = self._given.get("processID", process_before or "reconstruct")
        if not isinstance(process_id, str) or process_id not in PROCESSES:
            return self._fault("processID", f"use one of {', '.join(PROCESSES)}", None)
        if "execute" not in self._given:
            if process_before is None:
                self.faults.append("execute is missing: give the request, as for the process's execution")
            elif process_id != process_before:
                self._fault("processID", f"the schedule is of {process_before}: give execute, too", None)
            return None
        body = self._given["execute"]
        if not isinstance(body, dict):
            return self._fault("execute", "use an object with inputs and outputs", None)
        try:
            inputs, outputs = execute_parts(body)
            return process_named(process_id).draft(inputs, outputs, settings)
        except RequestError as error:
            self.faults += [f"execute: {fault}" for fault in error.faults]
            return None

    def _text(self, name: str, default: str) -> str:
        value = self._given.get(name, default)
        return value if isinstance(value, str) else self._fault(name, "use a text", default)

    def _fault(self, name: str, fix: str, instead: Value) -> Value:
        self.faults.append(f"{name} is {shortened(self._given[name])}: {fix}")
        return instead
