"""CityJSONSeq 2.0: a line of metadata, then one CityJSONFeature per building.

A building has one BuildingPart per solid and one BuildingInstallation per box on its roof. Other levels of detail are
further geometries of the same parts, each with its `lod`.
"""

from __future__ import annotations

import datetime as dt
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.export.obj import box_id, part_id
from pipeline.export.solid_geometry import SHAPE_COLUMNS, SURFACES, models_beside
from pipeline.export.stored_coordinates import SpatialReference, crs_coordinates, decimals, epsg_code
from pipeline.model import BuildingResult, FaceKind, FloatArray, Plane, Solid

VERSION = "2.0"
"""Version of CityJSON."""

_NOT_ATTRIBUTES = ("building_id", "geometry", *SHAPE_COLUMNS)


def cityjson_lines(
    rows: Sequence[tuple[BuildingResult, Mapping[str, Any]]],
    reference: SpatialReference,
    title: str,
    corner: Sequence[float] | None = None,
) -> Iterable[str]:
    """The lines of a CityJSONSeq file, in the units of the reference and, with an EPSG code, its referenceSystem.

    The format states no unit beside that code, so the reference is that of `one_unit`, and the rows are made with it.

    Vertices are integers: the transform's scale is 0.001 in metres (finer in other units, to keep 1 mm), its
    translation whole units at the lower corner of all solids. For lines that continue a file it is that file's, which
    is given as `corner`. The record of each building (`building_row`) becomes its attributes; buildings without a solid
    are features without geometry.
    """
    placed = [
        [crs_coordinates(solid.vertices, result.origin, reference) for solid in _solids(result)] for result, _ in rows
    ]
    corners = [xyz for solids in placed for xyz in solids]
    low = np.min([xyz.min(axis=0) for xyz in corners], axis=0) if corners else np.zeros(3)
    high = np.max([xyz.max(axis=0) for xyz in corners], axis=0) if corners else np.zeros(3)
    translate = whole_units(low if corner is None else corner)
    yield json_line(heading(title, reference, translate, (low, high) if corners else None))
    factor = np.array([10**d for d in decimals_of(reference)], dtype=np.int64)
    for (result, row), solids in zip(rows, placed, strict=True):
        integers = [
            np.round(xyz * factor).astype(np.int64) - np.array(translate, dtype=np.int64) * factor for xyz in solids
        ]
        yield json_line(_feature(result, row, integers))


def decimals_of(reference: SpatialReference) -> tuple[int, int, int]:
    """Decimals of easting, northing and elevation."""
    plan = decimals(reference.horizontal_unit_m)
    return plan, plan, decimals(reference.vertical_unit_m)


def whole_units(corner: Iterable[float]) -> list[int]:
    """The translation of a file: whole units at or below a corner."""
    return [math.floor(value) for value in corner]


def heading(
    title: str, reference: SpatialReference, translate: Sequence[int], extent: tuple[FloatArray, FloatArray] | None
) -> dict[str, Any]:
    """The first line of a CityJSONSeq file; `extent` are the lowest and highest coordinates, (3,) each."""
    metadata: dict[str, Any] = {"title": title}
    code = epsg_code(reference)
    if code is not None:
        metadata["referenceSystem"] = f"https://www.opengis.net/def/crs/EPSG/0/{code}"
    elif reference.horizontal_unit_m != 1.0:
        metadata["title"] = f"{title} (one unit is {reference.horizontal_unit_m:.12g} m)"
    if extent is not None:
        metadata["geographicalExtent"] = [float(v) for edge in extent for v in edge]
    return {
        "type": "CityJSON",
        "version": VERSION,
        "transform": {
            "scale": [float(f"1e-{d}") for d in decimals_of(reference)],
            "translate": [float(v) for v in translate],
        },
        "metadata": metadata,
        "CityObjects": {},
        "vertices": [],
    }


def lines_of(text: str) -> list[str]:
    r"""The lines of a CityJSONSeq file. Texts within may hold other separators of lines, such as U+2028.

    >>> lines_of('{"a": "one\u2028two"}\n{}\n') == ['{"a": "one\u2028two"}', "{}"]
    True
    """
    return [line for line in text.split("\n") if line]


def json_line(value: Mapping[str, Any]) -> str:
    """One line of JSON without spaces."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _solids(result: BuildingResult) -> list[Solid]:
    """The solids of all levels of detail, those of the record first, then boxes on the roof."""
    return [*result.solids, *(s for model in models_beside(result) for s in model.solids), *(result.boxes or ())]


def _feature(
    result: BuildingResult, row: Mapping[str, Any], vertices: Sequence[np.ndarray[Any, np.dtype[np.int64]]]
) -> dict[str, Any]:
    """The CityJSONFeature of one building; each solid has its own vertices, each part one solid per level of detail."""
    parts = [part_id(result, part) for part in range(len(result.solids))]
    building: dict[str, Any] = {"type": "Building", "attributes": _attributes(row)}
    boxes = [box_id(result, number) for number in range(len(result.boxes or ()))]
    if parts:
        building["children"] = [*parts, *boxes]
    objects: dict[str, Any] = {result.building_id: building}
    first = 0
    for name, solid in zip(parts, result.solids, strict=True):
        objects[name] = {
            "type": "BuildingPart",
            "parents": [result.building_id],
            "geometry": [_solid(solid, result.planes, result.lod, first)],
        }
        first += len(solid.vertices)
    for model in models_beside(result):
        planes = result.planes if model.lod >= "2" else ()
        for name, solid in zip(parts, model.solids, strict=True):
            objects[name]["geometry"].append(_solid(solid, planes, model.lod, first))
            first += len(solid.vertices)
    for name, solid in zip(boxes, result.boxes or (), strict=True):
        geometry = [_solid(solid, (), "2.2", first)]
        objects[name] = {"type": "BuildingInstallation", "parents": [result.building_id], "geometry": geometry}
        first += len(solid.vertices)
    return {
        "type": "CityJSONFeature",
        "id": result.building_id,
        "CityObjects": objects,
        "vertices": [xyz for array in vertices for xyz in array.tolist()],
    }


def _attributes(row: Mapping[str, Any]) -> dict[str, Any]:
    """The record as attributes: without geometry, id and unknown values, times as ISO 8601.

    The columns of the given footprint form an object, so their names cannot clash with ours.
    """
    attributes: dict[str, Any] = {}
    for name, value in row.items():
        if value is None or name in _NOT_ATTRIBUTES:
            continue
        if name == "source_attributes":
            attributes[name] = json.loads(value)
        else:
            attributes[name] = value.isoformat() if isinstance(value, dt.datetime) else value
    return attributes


def _solid(solid: Solid, planes: Sequence[Plane], lod: str, first: int) -> dict[str, Any]:
    """The geometry of one part: one semantic surface per roof plane, one each for walls, ground and undersides.

    Without planes, roof surfaces are level and have no `plane_id`.
    """
    surfaces: list[dict[str, Any]] = []
    index: dict[tuple[FaceKind, int], int] = {}
    values = []
    for face in solid.faces:
        key = (face.kind, face.plane if face.kind is FaceKind.ROOF else -1)
        if key not in index:
            index[key] = len(surfaces)
            surfaces.append(_surface(key[0], key[1], planes))
        values.append(index[key])
    return {
        "type": "Solid",
        "lod": lod,
        "boundaries": [[[[first + int(i) for i in ring] for ring in face.rings] for face in solid.faces]],
        "semantics": {"surfaces": surfaces, "values": [values]},
    }


def _surface(kind: FaceKind, plane_id: int, planes: Sequence[Plane]) -> dict[str, Any]:
    """A semantic surface; roof planes have slope and aspect as in the `planes` table."""
    surface: dict[str, Any] = {"type": SURFACES[kind]}
    if plane_id >= 0 and not planes:
        surface["slope_deg"] = surface["aspect_deg"] = 0.0
    elif plane_id >= 0:
        plane = planes[plane_id]
        surface["plane_id"] = plane_id
        surface["slope_deg"] = round(plane.slope_deg, 4)
        surface["aspect_deg"] = round(plane.aspect_deg, 4) % 360.0
    return surface
