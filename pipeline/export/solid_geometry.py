"""Solids as columns of a table: one MultiPolygon Z per building, one polygon per face, and the kind of each face.

GeoParquet 1.1 has no PolyhedralSurface, and GEOS (shapely, geopandas) cannot read it. Every reader understands a
MultiPolygon Z of the boundary's faces. Its polygons are oriented like the solid's faces, outward, and so bound the
same solid; in plan it is not a valid polygon, since walls are upright.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from pipeline.export.stored_coordinates import SpatialReference, crs_coordinates
from pipeline.model import BuildingResult, FaceKind, LodModel, Solid

OVERHANGS = "2.3"
"""The level of detail with overhangs, beside the record's model."""
COARSER_LODS = ("1.2", "1.3", "2.0")
"""Levels of detail that have columns and files of their own where a finer one is modelled too."""


def lod_suffix(lod: str) -> str:
    """What ends the names of columns and files of a coarser level of detail.

    >>> lod_suffix("1.3")
    'lod13'
    """
    return f"lod{lod.replace('.', '')}"


_COARSER_COLUMNS = {
    lod: tuple(f"solid_{lod_suffix(lod)}{end}" for end in ("", "_parts", "_surfaces")) for lod in COARSER_LODS
}
OVERHANG_COLUMNS = tuple(f"solid_{lod_suffix(OVERHANGS)}{end}" for end in ("", "_parts", "_surfaces", "_planes"))
"""The columns of the solids with overhangs."""

SOLIDS = ("solid", *(names[0] for names in _COARSER_COLUMNS.values()), OVERHANG_COLUMNS[0], "boxes")
"""The columns of geometry among `SOLID_COLUMNS`."""
SOLID_COLUMNS = (
    "solid",
    "solid_parts",
    "solid_surfaces",
    "solid_planes",
    *(name for names in _COARSER_COLUMNS.values() for name in names),
    *OVERHANG_COLUMNS,
    "boxes",
)
"""The columns that tell a building's solids."""
WALL_OUTLINE = "wall_outline"
"""The column of the walls beneath a footprint at the eaves."""
SHAPE_COLUMNS = (*SOLID_COLUMNS, WALL_OUTLINE)
"""The columns that hold a building's shape beside its footprint."""
SURFACES = {
    FaceKind.ROOF: "RoofSurface",
    FaceKind.WALL: "WallSurface",
    FaceKind.GROUND: "GroundSurface",
    FaceKind.CEILING: "OuterCeilingSurface",
    FaceKind.CLOSURE: "ClosureSurface",
}
"""CityGML's names of the kinds of faces."""

_LITTLE_ENDIAN = 1
_POLYGON_Z, _MULTIPOLYGON_Z = 1003, 1006
_HEAD, _COUNT = struct.Struct("<BII"), struct.Struct("<I")
_CORNER_BYTES = 24


def solid_columns(result: BuildingResult, reference: SpatialReference) -> dict[str, Any]:
    """The solids of a building as `SOLID_COLUMNS`; None in each where it has no such model.

    `solid` is ISO WKB in CRS units: the faces of all parts, part by part. The other three are lists with one value a
    polygon: the number of the part, the semantic surface, and the `plane_id` of a roof plane (-1 on walls and ground).
    `solid_lod12` and `solid_lod13` tell coarser models beside the record's own in the same way, but for the planes:
    level parts are none of the table `planes`. `solid_lod23` has the planes of the record.
    """
    columns: dict[str, Any] = dict.fromkeys(SOLID_COLUMNS)
    if result.solids:
        columns.update(zip(SOLID_COLUMNS, _columns_of(result.solids, result.origin, reference), strict=False))
    for model in result.coarser:
        columns.update(
            zip(_COARSER_COLUMNS[model.lod], _columns_of(model.solids, result.origin, reference), strict=False)
        )
    if result.overhangs is not None and result.overhangs.solids:
        values = _columns_of(result.overhangs.solids, result.origin, reference)
        columns.update(zip(OVERHANG_COLUMNS, values, strict=True))
    if result.boxes:
        columns["boxes"] = _columns_of(result.boxes, result.origin, reference)[0]
    return columns


def model_at(result: BuildingResult, lod: str | None) -> LodModel | None:
    """The finest model of a building that is not finer than `lod`; its own model for None; None if there is none.

    A building that fell back to a block has that at every level.
    """
    if not result.solids:
        return None
    own = LodModel(lod=result.lod, planes=result.planes, solids=result.solids)
    if lod is None:
        return own
    known = [model for model in (own, *models_beside(result)) if model.lod <= lod]
    return max(known, key=lambda model: model.lod, default=None)


def models_beside(result: BuildingResult) -> tuple[LodModel, ...]:
    """The models of a building beside that of its record: with overhangs, then the coarser ones, the finest first."""
    overhangs = result.overhangs.solids if result.overhangs is not None else ()
    finer = (LodModel(lod=OVERHANGS, planes=result.planes, solids=overhangs),) if overhangs else ()
    return (*finer, *result.coarser)


def _columns_of(
    solids: Sequence[Solid], origin: tuple[float, float, float], reference: SpatialReference
) -> tuple[bytes, list[int], list[str], list[int]]:
    """Solids as the values of the columns."""
    parts: list[int] = []
    surfaces: list[str] = []
    planes: list[int] = []
    wkb: list[bytes] = []
    for part, solid in enumerate(solids):
        xyz = crs_coordinates(solid.vertices, origin, reference).astype("<f8").tobytes()
        corners = [xyz[start : start + _CORNER_BYTES] for start in range(0, len(xyz), _CORNER_BYTES)]
        for face in solid.faces:
            parts.append(part)
            surfaces.append(SURFACES[face.kind])
            planes.append(face.plane if face.kind is FaceKind.ROOF else -1)
            wkb.append(_HEAD.pack(_LITTLE_ENDIAN, _POLYGON_Z, len(face.rings)))
            for ring in face.rings:
                wkb.append(_COUNT.pack(len(ring) + 1))
                wkb.extend(corners[i] for i in ring)
                wkb.append(corners[ring[0]])
    head = _HEAD.pack(_LITTLE_ENDIAN, _MULTIPOLYGON_Z, len(parts))
    return head + b"".join(wkb), parts, surfaces, planes
