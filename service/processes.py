"""The processes that the service offers: what they take and give, and how what a client sends becomes a request.

One row a process in `PROCESSES`; an unknown name lists the valid ones. All faults of a request are told at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from pipeline import __version__
from pipeline.io.crs import UNITS_M
from service import catalogue
from service.drafts import ENDINGS, LONGEST_CRS, LONGEST_TEXT, Draft, Inputs, shortened
from service.errors import NoSuchProcessError, RequestError
from service.outputs import OUTPUTS
from service.settings import ServiceSettings

MESHES = ("building", "tile", "none")
"""How OBJ files are cut."""

PRIORITY = 10
"""Largest priority; its negative is the least."""


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
    outputs: Callable[[], dict[str, dict[str, Any]]]
    """Descriptions of the outputs."""
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
        return {**self.summary(base), "inputs": self.inputs(settings), "outputs": self.outputs()}


# --- reconstruct: what it takes --------------------------------------------------------------------------------------


def _given_by() -> str:
    return (
        "By reference (href): an upload of this service, a path below one of its input folders, or a URL at one of its "
        "allowed hosts. By value: base64, within the limit of a request's size."
    )


def _input(title: str, description: str, schema: dict[str, Any], occurs: tuple[int, int] = (0, 1)) -> dict[str, Any]:
    return {
        "title": title,
        "description": description,
        "schema": schema,
        "minOccurs": occurs[0],
        "maxOccurs": occurs[1],
        "valuePassing": ["byValue", "byReference"],
    }


def _file(media_types: Sequence[str]) -> dict[str, Any]:
    return {
        "oneOf": [
            {"type": "string", "contentEncoding": "base64", "contentMediaType": media_type}
            for media_type in media_types
        ]
    }


def _reconstruct_inputs(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    known = catalogue.load()
    text = {"type": "string", "maxLength": LONGEST_TEXT}
    box = {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4}
    outlines = {"type": "object", "format": "geojson-feature-collection", "contentMediaType": "application/geo+json"}
    bbox = {
        "oneOf": [
            box,
            {
                "type": "object",
                "format": "ogc-bbox",
                "required": ["bbox", "crs"],
                "properties": {"bbox": box, "crs": {"type": "string"}},
            },
        ]
    }
    described = {
        "tiles": _input("Tiles", f"Point clouds. {_given_by()}", _file(tuple(ENDINGS)), (1, settings.max_inputs)),
        "footprints": _input(
            "Footprints",
            f"Building outlines to be modelled, as GeoJSON or GeoPackage. {_given_by()}",
            {
                "oneOf": [
                    outlines,
                    *_file(("application/geopackage+sqlite3", "application/vnd.apache.parquet"))["oneOf"],
                ]
            },
        ),
        "crs": _input(
            "CRS",
            "Coordinate reference system of the tiles, where their header has none or a wrong one: EPSG code or WKT.",
            {"type": "string", "maxLength": LONGEST_CRS, "examples": ["EPSG:28992"]},
        ),
        "verticalUnit": _input(
            "Vertical unit",
            "Unit of elevations, where the header has none or a wrong one.",
            {"type": "string", "enum": list(UNITS_M)},
        ),
        "bbox": _input(
            "Rectangle",
            "Only this rectangle: x_min, y_min, x_max, y_max in the tiles' CRS and its units.",
            bbox,
        ),
        "method": _input(
            "Method",
            "The method that models the buildings.",
            {"type": "string", "enum": list(known.methods), "default": known.default("method")},
        ),
        "classes": _input(
            "Classes",
            "What the file's own classes are worth.",
            {"type": "string", "enum": list(known.classes), "default": known.default("classes")},
        ),
        "settings": _input(
            "Settings", "What differs from the defaults, as the tables of a settings file.", known.schema()
        ),
        "meshes": _input(
            "Meshes",
            "One OBJ file a building, one a tile, or none.",
            {"type": "string", "enum": list(MESHES), "default": MESHES[0]},
        ),
        "licence": _input("Licence", "Licence of the source data; goes into the results.", text),
        "title": _input("Title", "Your own words for the job.", text),
        "priority": _input(
            "Priority",
            "Higher goes first; more than 0 needs a key with the scope admin, where keys are used.",
            {"type": "integer", "minimum": -PRIORITY, "maximum": PRIORITY, "default": 0},
        ),
    }
    for name in set(described) - {"tiles", "footprints"}:
        described[name]["valuePassing"] = ["byValue"]
    return described


def _reconstruct_outputs() -> dict[str, dict[str, Any]]:
    return {
        name: {"title": kind.title, "description": kind.description, "schema": dict(kind.schema)}
        for name, kind in OUTPUTS.items()
    }


def _draft_reconstruct(given: Mapping[str, Any], outputs: Sequence[str] | None, settings: ServiceSettings) -> Draft:
    """A draft of a reconstruction.

    Raises
    ------
    RequestError
        Naming every fault.
    """
    known = catalogue.load()
    inputs = Inputs(given)
    inputs.unknown(tuple(_reconstruct_inputs(settings)))
    tiles = inputs.files("tiles", settings.max_inputs, inputs.tile)
    if given.get("tiles") in (None, []):
        inputs.faults.append("tiles is missing: give one point cloud or more")
    outlines = inputs.files("footprints", 1, inputs.outlines)
    crs = inputs.crs("crs")
    chosen = inputs.settings("settings")
    for name, words in (("method", known.methods), ("classes", known.classes)):
        word = inputs.word(name, words)
        if word is not None and chosen.get(name, word) != word:
            inputs.faults.append(f"{name} is {word} and settings.{name} is {shortened(chosen[name])}: give one of them")
        elif word is not None:
            chosen[name] = word
    wanted = None
    if outputs is not None:
        unknown = [name for name in outputs if name not in OUTPUTS]
        inputs.faults.extend(f"{shortened(name)} is no output: use {', '.join(OUTPUTS)}" for name in unknown)
        wanted = tuple(name for name in OUTPUTS if name in outputs)
    values = {
        "crs": crs,
        "vertical_unit": inputs.word("verticalUnit", tuple(UNITS_M)),
        "bbox": inputs.bbox("bbox", crs),
        "settings": chosen,
        "meshes": inputs.word("meshes", MESHES) or MESHES[0],
        "licence": inputs.text("licence"),
        "outputs": wanted,
        "title": inputs.text("title"),
    }
    priority = inputs.integer("priority", -PRIORITY, PRIORITY)
    if inputs.faults:
        raise RequestError(inputs.faults)
    footprints = outlines[0] if outlines else None
    return Draft(tiles=tiles, footprints=footprints, priority=priority, values=values)


# --- the table -------------------------------------------------------------------------------------------------------

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
                inputs=_reconstruct_inputs,
                outputs=_reconstruct_outputs,
                draft=_draft_reconstruct,
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
