"""The rules of CityJSON 2.0 for what this program writes, as a JSON schema and as checks that no schema can state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jsonschema

_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
_INDEX_RING = {"type": "array", "items": {"type": "integer", "minimum": 0}, "minItems": 3}
_SURFACE = {
    "type": "object",
    "required": ["type"],
    "properties": {"type": {"enum": ["RoofSurface", "WallSurface", "GroundSurface"]}},
}
_SOLID = {
    "type": "object",
    "required": ["type", "lod", "boundaries", "semantics"],
    "additionalProperties": False,
    "properties": {
        "type": {"const": "Solid"},
        "lod": {"type": "string", "pattern": r"^[0-3](\.[0-3])?$"},
        "boundaries": {
            "type": "array",
            "minItems": 1,
            "items": {"type": "array", "minItems": 4, "items": {"type": "array", "minItems": 1, "items": _INDEX_RING}},
        },
        "semantics": {
            "type": "object",
            "required": ["surfaces", "values"],
            "additionalProperties": False,
            "properties": {
                "surfaces": {"type": "array", "items": _SURFACE},
                "values": {"type": "array", "items": {"type": "array", "items": {"type": "integer"}}},
            },
        },
    },
}
_BUILDING = {
    "type": "object",
    "required": ["type"],
    "properties": {
        "type": {"const": "Building"},
        "attributes": {"type": "object"},
        "children": {"type": "array", "items": {"type": "string"}, "minItems": 1},
    },
    "additionalProperties": False,
}
_PART = {
    "type": "object",
    "required": ["type", "parents", "geometry"],
    "properties": {
        "type": {"const": "BuildingPart"},
        "parents": {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 1},
        "geometry": {"type": "array", "items": _SOLID, "minItems": 1},
    },
    "additionalProperties": False,
}
FIRST_LINE = {
    "type": "object",
    "required": ["type", "version", "transform", "CityObjects", "vertices"],
    "properties": {
        "type": {"const": "CityJSON"},
        "version": {"const": "2.0"},
        "transform": {
            "type": "object",
            "required": ["scale", "translate"],
            "additionalProperties": False,
            "properties": {"scale": _NUMBERS, "translate": _NUMBERS},
        },
        "metadata": {
            "type": "object",
            "properties": {
                "title": {"type": "string"},
                "referenceSystem": {
                    "type": "string",
                    "pattern": r"^https://www\.opengis\.net/def/crs/[A-Z]+/\d+/\d+$",
                },
                "geographicalExtent": {"type": "array", "items": {"type": "number"}, "minItems": 6, "maxItems": 6},
            },
        },
        "CityObjects": {"const": {}},
        "vertices": {"const": []},
    },
    "additionalProperties": False,
}
FEATURE = {
    "type": "object",
    "required": ["type", "id", "CityObjects", "vertices"],
    "properties": {
        "type": {"const": "CityJSONFeature"},
        "id": {"type": "string"},
        "CityObjects": {"type": "object", "additionalProperties": {"oneOf": [_BUILDING, _PART]}},
        "vertices": {
            "type": "array",
            "items": {"type": "array", "items": {"type": "integer"}, "minItems": 3, "maxItems": 3},
        },
    },
    "additionalProperties": False,
}


def faults(lines: Sequence[dict[str, Any]]) -> list[str]:
    """What is wrong with the objects of a CityJSONSeq file; empty where nothing is."""
    found = []
    for number, line in enumerate(lines):
        schema = FIRST_LINE if number == 0 else FEATURE
        found += [
            f"line {number}: {error.message[:200]}" for error in jsonschema.Draft7Validator(schema).iter_errors(line)
        ]
        if number and not found:
            found += [f"line {number}: {fault}" for fault in _feature_faults(line)]
    return found


def _feature_faults(feature: dict[str, Any]) -> list[str]:
    """Families that do not fit, indices out of range, vertices without use, semantics of another shape."""
    objects, used, found = feature["CityObjects"], set(), []
    if feature["id"] not in objects:
        found.append("the feature's id names none of its objects")
    for name, entry in objects.items():
        found += [f"{name}: no child {child}" for child in entry.get("children", ()) if child not in objects]
        for parent in entry.get("parents", ()):
            if name not in objects.get(parent, {}).get("children", ()):
                found.append(f"{name}: its parent {parent} does not know it")
        for solid in entry.get("geometry", ()):
            shells, values = solid["boundaries"], solid["semantics"]["values"]
            if [len(shell) for shell in shells] != [len(shell) for shell in values]:
                found.append(f"{name}: not one semantic value a surface")
            if {value for shell in values for value in shell} != set(range(len(solid["semantics"]["surfaces"]))):
                found.append(f"{name}: a semantic surface without use, or a value without one")
            rings = [ring for shell in shells for surface in shell for ring in surface]
            found += [f"{name}: a ring comes back to a vertex" for ring in rings if len(set(ring)) < len(ring)]
            used.update(index for ring in rings for index in ring)
    if used != set(range(len(feature["vertices"]))):
        found.append("a vertex without use, or an index without vertex")
    return found
