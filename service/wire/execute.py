"""The request that starts a job: inputs of a process and the wanted outputs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, ValidationError

from service.drafts import Draft
from service.errors import RequestError
from service.jobs import Subscriber
from service.outputs import CLASSIFICATION_OUTPUTS, COMPARISON_OUTPUTS, ECHO_OUTPUTS, OUTPUTS, OutputKind
from service.wire.base import Request, at_most, optional_members
from service.wire.faults import FaultsError, sentences, shortened
from service.wire.inputs import ClassifyInputs, CompareInputs, EchoInputs, JobInputs, ReconstructInputs
from service.wire.webhooks import ReceiverUrl

INPUTS: Mapping[str, type[JobInputs]] = {
    "reconstruct": ReconstructInputs,
    "compare": CompareInputs,
    "classify": ClassifyInputs,
    "echo": EchoInputs,
}
"""The inputs of every process."""

KINDS: Mapping[str, Mapping[str, OutputKind]] = {
    "reconstruct": OUTPUTS,
    "compare": COMPARISON_OUTPUTS,
    "classify": CLASSIFICATION_OUTPUTS,
    "echo": ECHO_OUTPUTS,
}
"""The outputs of every process."""

MAX_OUTPUTS = 100
"""Most outputs that a request may name; no process has as many."""

EXAMPLE = {
    "inputs": {
        "tiles": [{"href": "/uploads/0123456789abcdef0123456789abcdef"}],
        "crs": "EPSG:28992",
        "settings": {"candidates": {"min_area_m2": 15.0}},
    },
    "outputs": {"buildings": {}, "cityjson": {}},
}


RETRY_EXAMPLES: dict[str, Any] = {
    "as before": {"value": {}},
    "with another method": {
        "value": {"inputs": {"method": "kmeans", "settings": {"candidates": {"min_area_m2": 15.0}}}}
    },
}


class OutputFormat(Request):
    """The wanted format of an output; each output has one."""

    mediaType: str | None = None


class WantedOutput(Request):
    """How an output is wanted."""

    format: OutputFormat = Field(default_factory=OutputFormat)
    transmissionMode: Literal["value", "reference"] = Field(
        default="reference", description="Outputs are files: only by reference."
    )

    def faults(self, name: str, kind: OutputKind) -> list[str]:
        """What this process does not offer."""
        faults = []
        if self.transmissionMode != "reference":
            faults.append(f'outputs.{name}.transmissionMode is "value": use "reference", since outputs are files')
        if self.format.mediaType not in {None, kind.media_type}:
            given = shortened(self.format.mediaType)
            faults.append(f'outputs.{name}.format.mediaType is {given}: use "{kind.media_type}"')
        return faults


def wanted(names: Iterable[str]) -> dict[str, WantedOutput]:
    """Outputs of these names, each in its only format."""
    return {name: WantedOutput() for name in names}


def _one_at_least(schema: dict[str, Any]) -> None:
    optional_members(schema)
    schema["minProperties"] = 1


class SubscriberUris(Request):
    """Where to send news of the job; the page on webhooks shows bodies and signatures."""

    model_config = ConfigDict(json_schema_extra=_one_at_least)

    successUri: ReceiverUrl | None = Field(None, description="Gets the results document when the job succeeds.")
    inProgressUri: ReceiverUrl | None = Field(
        None, description="Gets the job's status when it starts, and its progress at most every 10 s."
    )
    failedUri: ReceiverUrl | None = Field(None, description="Gets the job's status when it fails or is dismissed.")

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """The URIs, if there are any."""
        if given == {}:
            raise FaultsError([f"subscriber is empty: give one of {', '.join(cls.model_fields)}"])
        return given


class Retry(Request):
    """What differs from the request of the job that is tried again."""

    inputs: dict[str, Any] = Field(
        default_factory=dict,
        description="Inputs that replace those of the job; null takes one away. Tables of `settings` are merged: "
        "settings that are not named stay, null takes one away.",
    )
    outputs: Annotated[dict[str, WantedOutput], at_most(MAX_OUTPUTS)] | None = Field(
        default=None, description="The wanted outputs; those of the job if it is left out."
    )

    def applied_to(self, before: Execute) -> Execute:
        """The request of the new job."""
        changes = dict(self.inputs)
        settings = changes.get("settings", {})
        if isinstance(settings, Mapping):
            # an input such as `method` replaces the setting of this name
            kept = {name: value for name, value in before.inputs.get("settings", {}).items() if name not in changes}
            changes["settings"] = _merged_tables(kept, settings) or None
        inputs = _merged(before.inputs, changes)
        outputs = before.outputs if self.outputs is None else self.outputs
        return Execute(inputs=inputs, outputs=outputs, response=before.response, subscriber=before.subscriber)


def _merged(before: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Members with changes; a change to null takes a member away."""
    return {name: value for name, value in {**before, **changes}.items() if value is not None}


def _merged_tables(before: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with changes, table by table."""
    tables = {
        name: _merged(before.get(name, {}), value) or None if isinstance(value, Mapping) else value
        for name, value in changes.items()
    }
    return _merged(before, tables)


class Execute(Request):
    """A request for a job."""

    HINTS: ClassVar[Mapping[str, str]] = {
        name: "it is an input, put it into inputs" for model in INPUTS.values() for name in model.model_fields
    }

    inputs: dict[str, Any] = Field(
        default_factory=dict,
        description="By the names that the process's description lists; each a value, a reference `{href}`, a value "
        "with a media type `{value, encoding, mediaType}`, or a list of these.",
    )
    outputs: Annotated[dict[str, WantedOutput], at_most(MAX_OUTPUTS)] | None = Field(
        default=None, description="The wanted outputs; all if it is left out."
    )
    mode: Literal["async", "auto"] = Field(default="async", description="Jobs run asynchronously.")
    response: Literal["raw", "document"] = Field(
        default="document",
        description="The answer to `/jobs/{jobID}/results`: a document that lists the outputs, or no content and one "
        "Link header per output.",
    )
    subscriber: SubscriberUris | None = Field(default=None, description="Where to send news of the job.")

    def draft(self, process_id: str, max_inputs: int | None = None) -> Draft:
        """The draft of a job of a process with at most `max_inputs` point clouds.

        Raises
        ------
        RequestError
            Naming every fault of inputs and outputs.
        """
        tiles = self.inputs.get("tiles")
        if max_inputs is not None and isinstance(tiles, list) and len(tiles) > max_inputs:
            raise RequestError([f"tiles has {len(tiles)} entries: use at most {max_inputs}"])
        faults: list[str] = []
        kinds, outputs, inputs = KINDS[process_id], None, None
        try:
            inputs = INPUTS[process_id].model_validate(self.inputs)
        except ValidationError as error:
            faults += sentences(error.errors(include_url=False))
        if self.outputs is not None:
            unknown = [name for name in self.outputs if name not in kinds]
            faults += [f"{shortened(name)} is not an output: use {', '.join(kinds)}" for name in unknown]
            outputs = tuple(name for name in kinds if name in self.outputs)
            faults += [fault for name in outputs for fault in self.outputs[name].faults(name, kinds[name])]
        if inputs is None or faults:
            raise RequestError(faults)
        draft = inputs.draft(process_id, outputs)
        values = {**draft.values, "response": self.response, "subscriber": self._subscriber()}
        return dataclasses.replace(draft, values=values)

    def _subscriber(self) -> Subscriber | None:
        given = self.subscriber
        if given is None:
            return None
        return Subscriber(success_uri=given.successUri, in_progress_uri=given.inProgressUri, failed_uri=given.failedUri)
