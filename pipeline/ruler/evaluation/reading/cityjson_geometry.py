"""Geometries of CityJSON objects: which of a building's geometries count, and their faces with semantics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.model import FaceKind, FloatArray
from pipeline.ruler.evaluation.reading.raw import RawFace, RawPart, raw_part

KIND_OF_SURFACE: Mapping[str, FaceKind | None] = {
    "RoofSurface": FaceKind.ROOF,
    "WallSurface": FaceKind.WALL,
    "GroundSurface": FaceKind.GROUND,
    "ClosureSurface": FaceKind.WALL,
    "OuterCeilingSurface": FaceKind.GROUND,
    "OuterFloorSurface": None,
}
"""Kinds of semantic surfaces; the normal decides for an outer floor, which is a roof if nothing is above it."""

SURFACES = ("MultiSurface", "CompositeSurface")
SOLIDS = ("Solid", "MultiSolid", "CompositeSolid")
_MIN_MODEL_LOD = 1.0

Object = Mapping[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """The vertices of a file or feature."""

    vertices: FloatArray
    """(n, 3) float64, absolute metres."""
    units_m: FloatArray
    """(3,) float64, metres per unit of the coordinates."""
    templates: Sequence[Object] = ()
    """Geometries that instances place."""
    template_vertices: FloatArray = dataclasses.field(default_factory=lambda: np.empty((0, 3)))
    """(t, 3) float64, units of the coordinates, about no origin."""


def level(lod: object) -> float:
    """A level of detail as a number; -1 if it is not one.

    >>> level("2.2"), level(1), level(None)
    (2.2, 1.0, -1.0)
    """
    try:
        value = float(str(lod))
    except ValueError:
        return -1.0
    return value if math.isfinite(value) else -1.0


def resolved(geometry: Object, places: Places) -> Object:
    """The geometry itself, or the template of an instance."""
    if geometry["type"] != "GeometryInstance":
        return geometry
    return places.templates[_index(geometry["template"], len(places.templates), "template")]


def chosen(own: Sequence[Object], parts: Sequence[Sequence[Object]], places: Places) -> tuple[list[Object], str]:
    """The geometries that stand for a building, and their level of detail.

    Each object gives the geometries of its highest level, solids before surfaces. Those of the building itself count if
    no part has a higher level, those of the parts if the building does not. Both are empty without any geometry.
    """
    best_own, lod_own = _highest(own, places)
    of_parts = [_highest(part, places) for part in parts]
    lod_parts = max((lod for _, lod in of_parts), key=level, default="")
    taken: list[Object] = []
    if level(lod_own) >= level(lod_parts):
        taken.extend(best_own)
    if level(lod_parts) >= level(lod_own):
        modelled = level(lod_parts) >= _MIN_MODEL_LOD
        taken.extend(
            geometry
            for geometries, lod in of_parts
            if not modelled or level(lod) >= _MIN_MODEL_LOD
            for geometry in geometries
        )
    return taken, max(lod_own, lod_parts, key=level)


def _highest(geometries: Sequence[Object], places: Places) -> tuple[list[Object], str]:
    """Geometries of the highest level, solids before surfaces, and the level."""
    known = [(geometry, resolved(geometry, places)) for geometry in geometries]
    known = [pair for pair in known if pair[1]["type"] in (*SOLIDS, *SURFACES) and pair[1].get("boundaries")]
    if not known:
        return [], ""
    lod = max((str(template.get("lod", "")) for _, template in known), key=level)
    known = [pair for pair in known if level(pair[1].get("lod", "")) == level(lod)]
    solid = [geometry for geometry, template in known if template["type"] in SOLIDS]
    return solid or [geometry for geometry, _ in known], lod


def parts_of(geometry: Object, places: Places) -> Iterator[RawPart]:
    """The parts of one geometry: one per solid, or one of all its surfaces; without the inner shells of solids."""
    template = resolved(geometry, places)
    vertices = places.vertices if template is geometry else _placed(geometry, places)
    kind, boundaries = template["type"], template["boundaries"]
    semantics = template.get("semantics") or {}
    if not isinstance(semantics, Mapping):
        raise TypeError(f"semantics is a {type(semantics).__name__}, not an object")
    surfaces = [_kind_and_plane(surface) for surface in semantics.get("surfaces", ())]
    values = semantics.get("values")
    is_model = level(template.get("lod", "")) >= _MIN_MODEL_LOD
    if kind in SURFACES:
        yield raw_part(vertices, _faces(boundaries, values, surfaces, is_model), is_solid=False)
        return
    solids = [(boundaries, values)] if kind == "Solid" else [(b, _at(values, k)) for k, b in enumerate(boundaries)]
    for shells, shell_values in solids:
        if shells:
            yield raw_part(vertices, _faces(shells[0], _at(shell_values, 0), surfaces, is_model), is_solid=True)


def has_inner_shells(geometry: Object, places: Places) -> bool:
    """Whether a solid of the geometry has a cavity."""
    template = resolved(geometry, places)
    if template["type"] == "Solid":
        return len(template["boundaries"]) > 1
    return template["type"] in SOLIDS and any(len(shells) > 1 for shells in template["boundaries"])


def _index(value: Any, count: int, what: str) -> int:
    """A whole number from 0 to count - 1; ValueError if it is not."""
    if not isinstance(value, int) or not 0 <= value < count:
        raise ValueError(f"{what} {value!r} is not one of {count}")
    return value


def _at(values: Any, place: int) -> Any:
    """An entry of nested semantic values; None if a whole level is null."""
    return None if values is None else values[place]


def _kind_and_plane(surface: Object) -> tuple[FaceKind | None, int]:
    """The kind of a semantic surface, and the number of its roof plane; -1 without one."""
    kind = KIND_OF_SURFACE.get(str(surface["type"]))
    plane = surface.get("plane_id")
    return kind, plane if kind is FaceKind.ROOF and isinstance(plane, int) and plane >= 0 else -1


def _faces(
    shell: Sequence[Sequence[Sequence[int]]],
    values: Sequence[int | None] | None,
    surfaces: Sequence[tuple[FaceKind | None, int]],
    is_model: bool,
) -> list[RawFace]:
    """The faces of one shell; below LoD 1 all are footprints."""
    faces = []
    for number, rings in enumerate(shell):
        value = _at(values, number)
        kind, plane = (None, -1) if value is None else surfaces[_index(value, len(surfaces), "semantic surface")]
        faces.append(RawFace(tuple(tuple(ring) for ring in rings), kind if is_model else FaceKind.GROUND, plane))
    return faces


def _placed(instance: Object, places: Places) -> FloatArray:
    """The vertices of a template where an instance puts them, absolute metres."""
    anchor = places.vertices[_index(instance["boundaries"][0], len(places.vertices), "vertex")]
    matrix = np.array(instance["transformationMatrix"], np.float64).reshape(4, 4)
    turned = np.empty_like(places.template_vertices)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis in range(3):
            turned[:, axis] = matrix[axis, 3]
            for k in range(3):
                turned[:, axis] += matrix[axis, k] * places.template_vertices[:, k]
        placed: FloatArray = turned * places.units_m + anchor
    return placed
