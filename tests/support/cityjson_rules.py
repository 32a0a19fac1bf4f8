"""The rules of CityJSON 2.0 for what this program writes, as a JSON schema and as checks that no schema can state."""

from collections.abc import Sequence
from typing import Any

import jsonschema

Schema = dict[str, Any]


def _array(items: Schema, least: int = 0, most: int | None = None) -> Schema:
    return {"type": "array", "items": items, "minItems": least} | ({} if most is None else {"maxItems": most})


def _object(optional: dict[str, Schema] | None = None, **required: Schema) -> Schema:
    """An object of these members and no others."""
    members = required | (optional or {})
    return {"type": "object", "required": list(required), "properties": members, "additionalProperties": False}


_TEXT, _NUMBER, _INTEGER = ({"type": name} for name in ("string", "number", "integer"))
_NUMBERS = _array(_NUMBER, 3, 3)
_RINGS = _array(_array({"type": "integer", "minimum": 0}, 3), 1)
_SURFACES = ["RoofSurface", "WallSurface", "GroundSurface", "OuterCeilingSurface", "ClosureSurface"]
_SURFACE = _object(type={"enum": _SURFACES}) | {"additionalProperties": True}
_SOLID = _object(
    type={"const": "Solid"},
    lod=_TEXT | {"pattern": r"^[0-3](\.[0-3])?$"},
    boundaries=_array(_array(_RINGS, 4), 1),
    semantics=_object(surfaces=_array(_SURFACE), values=_array(_array(_INTEGER))),
)
_BUILDING = _object({"attributes": {"type": "object"}, "children": _array(_TEXT, 1)}, type={"const": "Building"})
_PART = _object(
    type={"enum": ["BuildingPart", "BuildingInstallation"]}, parents=_array(_TEXT, 1, 1), geometry=_array(_SOLID, 1)
)
_TRIANGLE = _array(_array({"type": "integer", "minimum": 0}, 3, 3), 1, 1)
_TRIANGLES = _object(
    type={"const": "CompositeSurface"}, lod=_TEXT | {"pattern": r"^[0-3](\.[0-3])?$"}, boundaries=_array(_TRIANGLE, 1)
)
_RELIEF = _object({"attributes": {"type": "object"}}, type={"const": "TINRelief"}, geometry=_array(_TRIANGLES, 1))
_METADATA = {
    "type": "object",
    "properties": {
        "title": _TEXT,
        "referenceSystem": _TEXT | {"pattern": r"^https://www\.opengis\.net/def/crs/[A-Z]+/\d+/\d+$"},
        "geographicalExtent": _array(_NUMBER, 6, 6),
    },
}
FIRST_LINE = _object(
    {"metadata": _METADATA},
    type={"const": "CityJSON"},
    version={"const": "2.0"},
    transform=_object(scale=_NUMBERS, translate=_NUMBERS),
    CityObjects={"const": {}},
    vertices={"const": []},
)
FEATURE = _object(
    type={"const": "CityJSONFeature"},
    id=_TEXT,
    CityObjects={"type": "object", "additionalProperties": {"oneOf": [_BUILDING, _PART, _RELIEF]}},
    vertices=_array(_array(_INTEGER, 3, 3)),
)


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
            if entry["type"] == "TINRelief":
                used.update(index for (ring,) in solid["boundaries"] for index in ring)
                found += [f"{name}: {face} has no area" for (face,) in solid["boundaries"] if len(set(face)) < 3]
                continue
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
