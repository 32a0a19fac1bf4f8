"""The processes of OGC API - Processes: one row per process. Their inputs and outputs are in `service.wire.execute`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

from pipeline import __version__
from service.drafts import Draft
from service.errors import NoSuchProcessError
from service.settings import ServiceSettings
from service.wire.base import RELATIONS, link
from service.wire.execute import INPUTS, KINDS, Execute
from service.wire.faults import shortened
from service.wire.inputs import FILES
from service.wire.processes import InputDescription, OutputDescription, ProcessSummary
from service.wire.processes import Process as ProcessDescription


@dataclasses.dataclass(frozen=True, kw_only=True)
class Process:
    """A process."""

    process_id: str
    title: str
    description: str
    keywords: tuple[str, ...]

    def summary(self, base: str) -> ProcessSummary:
        """The entry in the list of processes."""
        place = f"{base}/processes/{self.process_id}"
        return ProcessSummary(
            id=self.process_id,
            title=self.title,
            description=self.description,
            version=__version__,
            keywords=list(self.keywords),
            jobControlOptions=["async-execute", "dismiss"],
            outputTransmission=["reference"],
            links=[
                link(place, "self", "Description of the process"),
                link(f"{place}/execution", f"{RELATIONS}execute", "Start a job"),
            ],
        )

    def describe(self, base: str, settings: ServiceSettings) -> ProcessDescription:
        """The description, with the limits of this service."""
        kinds = KINDS[self.process_id].items()
        return ProcessDescription(
            **dict(self.summary(base)),
            inputs=self._inputs(settings.max_inputs),
            outputs={
                name: OutputDescription(title=kind.title, description=kind.description, schema=kind.schema)
                for name, kind in kinds
            },
        )

    def _inputs(self, max_inputs: int) -> dict[str, InputDescription]:
        """The inputs, from the model that parses them."""
        model = INPUTS[self.process_id]
        schema = model.model_json_schema()
        described = {}
        for name, field in model.model_fields.items():
            found = schema["properties"][name]
            description = found.pop("description")
            described[name] = InputDescription(
                title=field.title,
                description=description,
                schema=found["items"] if name == "tiles" else found,
                minOccurs=int(field.is_required()),
                maxOccurs=max_inputs if name == "tiles" else 1,
                valuePassing=["byValue", "byReference"] if name in FILES else ["byValue"],
            )
        return described

    def draft(self, execute: Execute, settings: ServiceSettings) -> Draft:
        """The draft of a job; raises as `Execute.draft`."""
        return execute.draft(self.process_id, settings.max_inputs)


PROCESSES: Mapping[str, Process] = MappingProxyType(
    {
        process.process_id: process
        for process in (
            Process(
                process_id="reconstruct",
                title="Reconstruct buildings",
                description="Valid LoD2 building models from raw airborne LiDAR tiles. Classes and footprints are not "
                "needed; both are used when given.",
                keywords=("lidar", "point cloud", "building", "LoD2", "3D city model"),
            ),
            Process(
                process_id="compare",
                title="Compare methods",
                description="Several methods on the same candidates: a page with pictures side by side, a table of "
                "every building by every method, and the results of each method as those of a reconstruction.",
                keywords=("lidar", "point cloud", "building", "LoD2", "comparison of methods"),
            ),
            Process(
                process_id="classify",
                title="Classify points",
                description="Every point as ground, building or vegetation, written back as LAZ, and rasters of the "
                "terrain, of the surface, and of the height above ground.",
                keywords=("lidar", "point cloud", "classification", "terrain model", "surface model"),
            ),
            Process(
                process_id="echo",
                title="Echo",
                description="A job that answers with its message after a delay: for tests of clients and networks.",
                keywords=("test",),
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
