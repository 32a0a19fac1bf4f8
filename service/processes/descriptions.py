"""What the processes take, described: JSON schemas with units, ranges and the limits of this service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.io.crs import UNITS_M
from service import catalogue
from service.drafts import ENDINGS, LONGEST_CRS, LONGEST_TEXT
from service.outputs import OutputKind
from service.settings import ServiceSettings

MESHES = ("building", "tile", "glb", "none")
"""What meshes a job writes."""

PRIORITY = 10
"""Largest priority; its negative is the least."""

MAX_METHODS = 8
"""Most methods of one comparison."""


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


def reconstruct_inputs(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    """The inputs of `reconstruct`."""
    known = catalogue.load()
    chosen = {
        "method": _input(
            "Method",
            "The method that models the buildings.",
            {"type": "string", "enum": list(known.methods), "default": known.default("method")},
        ),
        "preset": _input(
            "Preset",
            "Where the method's settings start: those that measured better (robust), or those that keep to its paper "
            "(faithful).",
            {"type": "string", "enum": list(known.presets), "default": known.default("preset")},
        ),
        "lods": _input(
            "Levels of detail",
            "LoD1.2 (blocks), LoD1.3 (level parts), LoD2.2 (roof faces), or several; records tell the finest.",
            {"type": "string", "enum": list(known.lods), "default": known.default("lods")},
        ),
    }
    return _inputs(settings, known, chosen)


def compare_inputs(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    """The inputs of `compare`: those of `reconstruct` with `methods` in the place of `method`, `preset` and `lods`."""
    known = catalogue.load()
    several = {
        "type": "array",
        "items": {"type": "string", "enum": list(known.variants())},
        "minItems": 2,
        "maxItems": MAX_METHODS,
        "uniqueItems": True,
    }
    told = "What is run on the same candidates, each METHOD or METHOD:PRESET; without a preset robust is meant."
    return _inputs(settings, known, {"methods": _input("Methods", told, several, (1, 1))})


def _inputs(
    settings: ServiceSettings, known: catalogue.Catalogue, methods: Mapping[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
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
            f"Building outlines to be modelled, as GeoJSON, GeoPackage or GeoParquet. {_given_by()}",
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
        **methods,
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
            "One OBJ file a building (building) or a tile (tile), one GLB file a tile (glb), or none.",
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


def outputs(kinds: Mapping[str, OutputKind]) -> dict[str, dict[str, Any]]:
    """Descriptions of outputs."""
    return {
        name: {"title": kind.title, "description": kind.description, "schema": dict(kind.schema)}
        for name, kind in kinds.items()
    }
