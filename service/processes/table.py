"""The table of the processes; one row a process, and an unknown name lists the valid ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from pipeline import __version__
from service.drafts import Draft, shortened
from service.errors import NoSuchProcessError
from service.outputs import COMPARISON_OUTPUTS, OUTPUTS, OutputKind
from service.processes.descriptions import compare_inputs, outputs, reconstruct_inputs
from service.processes.reading import draft_compare, draft_reconstruct
from service.settings import ServiceSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Process:
    """A process of OGC API - Processes."""

    process_id: str
    title: str
    description: str
    version: str
    keywords: tuple[str, ...]
    inputs: Callable[[ServiceSettings], dict[str, dict[str, Any]]]
    """Descriptions of the inputs, which know the service's limits."""
    kinds: Mapping[str, OutputKind]
    """The outputs by their ids."""
    draft: Callable[[Mapping[str, Any], Sequence[str] | None, ServiceSettings], Draft]
    """From inputs and the wanted outputs to a draft; RequestError with all faults."""

    def summary(self, base: str) -> dict[str, Any]:
        """What the list of processes tells."""
        place = f"{base}/processes/{self.process_id}"
        execute = "http://www.opengis.net/def/rel/ogc/1.0/execute"
        return {
            "id": self.process_id,
            "title": self.title,
            "description": self.description,
            "version": self.version,
            "keywords": list(self.keywords),
            "jobControlOptions": ["async-execute", "dismiss"],
            "outputTransmission": ["reference"],
            "links": [
                {"href": place, "rel": "self", "type": "application/json", "title": "Description of the process"},
                {"href": f"{place}/execution", "rel": execute, "type": "application/json", "title": "Start a job"},
            ],
        }

    def describe(self, base: str, settings: ServiceSettings) -> dict[str, Any]:
        """The process's description."""
        return {**self.summary(base), "inputs": self.inputs(settings), "outputs": outputs(self.kinds)}


PROCESSES: Mapping[str, Process] = MappingProxyType(
    {
        process.process_id: process
        for process in (
            Process(
                process_id="reconstruct",
                title="Reconstruct buildings",
                description="Valid LoD2 building models from raw airborne LiDAR tiles. Classes and footprints are not "
                "needed; both are used when given.",
                version=__version__,
                keywords=("lidar", "point cloud", "building", "LoD2", "3D city model"),
                inputs=reconstruct_inputs,
                kinds=OUTPUTS,
                draft=draft_reconstruct,
            ),
            Process(
                process_id="compare",
                title="Compare methods",
                description="Several methods on the same candidates: a page with pictures side by side, a table of "
                "every building by every method, and the results of each method as of a reconstruction.",
                version=__version__,
                keywords=("lidar", "point cloud", "building", "LoD2", "comparison of methods"),
                inputs=compare_inputs,
                kinds=COMPARISON_OUTPUTS,
                draft=draft_compare,
            ),
        )
    }
)
"""All processes by id."""


def process_named(process_id: str) -> Process:
    """The process of an id.

    Raises
    ------
    NoSuchProcessError
        Naming all processes.
    """
    if process_id not in PROCESSES:
        raise NoSuchProcessError(f"There is no process {shortened(process_id)}: use {', '.join(PROCESSES)}")
    return PROCESSES[process_id]
