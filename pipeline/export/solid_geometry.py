"""Solids as columns of a table: one MultiPolygon Z a building, a polygon a face, and what each face is.

Readers of GeoParquet know no solids: PolyhedralSurface is none of the types of GeoParquet 1.1, and GEOS (shapely,
geopandas) cannot read it. A MultiPolygon Z of the boundary's faces reaches all of them. Its polygons are oriented as
the solid's faces, outward, and so bound the same solid again; in plan it is no valid polygon, since walls are upright.
"""

from __future__ import annotations

import struct
from typing import Any

from pipeline.export.coordinates import SpatialReference, crs_coordinates
from pipeline.model import BuildingResult, FaceKind

SOLID_COLUMNS = ("solid", "solid_parts", "solid_surfaces", "solid_planes")
"""The columns that tell a building's solids."""
SURFACES = {FaceKind.ROOF: "RoofSurface", FaceKind.WALL: "WallSurface", FaceKind.GROUND: "GroundSurface"}
"""CityGML's names of the kinds of faces."""

_LITTLE_ENDIAN = 1
_POLYGON_Z, _MULTIPOLYGON_Z = 1003, 1006
_HEAD, _COUNT = struct.Struct("<BII"), struct.Struct("<I")
_CORNER_BYTES = 24


def solid_columns(result: BuildingResult, reference: SpatialReference) -> dict[str, Any]:
    """The solids of a building as `SOLID_COLUMNS`; None in each where it has no model.

    `solid` is ISO WKB in CRS units: the faces of all parts, part by part. The other three are lists with one value a
    polygon: the number of the part, the semantic surface, and the `plane_id` of a roof plane (-1 on walls and ground).
    """
    if not result.solids:
        return dict.fromkeys(SOLID_COLUMNS)
    parts: list[int] = []
    surfaces: list[str] = []
    planes: list[int] = []
    wkb: list[bytes] = []
    for part, solid in enumerate(result.solids):
        xyz = crs_coordinates(solid.vertices, result.origin, reference).astype("<f8").tobytes()
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
    return dict(zip(SOLID_COLUMNS, (head + b"".join(wkb), parts, surfaces, planes), strict=True))
