"""The terrain of a tile on the globe, as the content of 3D Tiles: triangles with the floors of buildings cut out.

Positions are 32-bit floats about a place on the ellipsoid: within a kilometre they keep a tenth of a millimetre, so
neighbouring files meet, and the terrain meets the floors of the buildings as near as these are rounded.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pipeline.export.glb import gltf_axes, material
from pipeline.export.glb_container import INDICES, QUANTIZATION, VERSION, VERTICES, container
from pipeline.extras.publish_3dtiles.globe_glb import Geodesy
from pipeline.model import FloatArray, LabelArray

NAME = "Terrain"
"""Name of the material."""
COLOUR = (0.32, 0.35, 0.22)
"""Its colour in linear RGB."""
_MOST_SHORT = 65_535
"""Most vertices that numbers of 16 bits can name; the largest number restarts a primitive."""
_BYTE, _UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT = 5120, 5123, 5125, 5126


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedTerrain:
    """The terrain of a tile on the globe."""

    geocentric: FloatArray
    """(v, 3) vertices in EPSG:4978."""
    triangles: LabelArray
    """(t, 3) counter-clockwise seen from above."""
    region: FloatArray
    """(2, 3) smallest and largest longitude, latitude (degrees), ellipsoidal height (m)."""


def placed_terrain(vertices_m: FloatArray, triangles: LabelArray, geodesy: Geodesy) -> PlacedTerrain:
    """Terrain over vertices (v, 3) in metres of the CRS, on the globe; ValueError if a vertex has no place there."""
    geodetic, geocentric = geodesy(vertices_m)
    if not np.isfinite(geocentric).all():
        worst = vertices_m[~np.isfinite(geocentric).all(axis=1)][0]
        raise ValueError(f"the place {worst[0]:.0f} m east, {worst[1]:.0f} m north has no longitude and latitude")
    region = np.vstack((geodetic.min(axis=0), geodetic.max(axis=0)))
    return PlacedTerrain(geocentric=geocentric, triangles=triangles, region=region)


def terrain_glb(terrain: PlacedTerrain, matrix: FloatArray) -> bytes:
    """A GLB file about the axes of `matrix`, (4, 4) to EPSG:4978; the same terrain gives the same bytes."""
    turn, origin = matrix[:3, :3], matrix[:3, 3]
    metres = gltf_axes((terrain.geocentric - origin) @ turn)
    positions = metres.astype("<f4")
    normals = np.zeros((len(metres), 4), "|i1")  # each at a multiple of four bytes
    normals[:, :3] = np.rint(_normals(metres, terrain.triangles) * 127.0)
    is_short = len(metres) <= _MOST_SHORT
    index = terrain.triangles.astype("<u2" if is_short else "<u4")
    pieces = [positions.tobytes(), normals.tobytes(), index.tobytes()]
    starts = np.cumsum([0, *map(len, pieces)]).tolist()
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(piece)}
        for start, piece in zip(starts, pieces, strict=False)
    ]
    views[0] |= {"byteStride": 12, "target": VERTICES}
    views[1] |= {"byteStride": 4, "target": VERTICES}
    views[2] |= {"target": INDICES}
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors = [
        {"bufferView": 0, "componentType": _FLOAT, "count": len(metres), "type": "VEC3", **bounds},
        {"bufferView": 1, "componentType": _BYTE, "normalized": True, "count": len(metres), "type": "VEC3"},
        {
            "bufferView": 2,
            "componentType": _UNSIGNED_SHORT if is_short else _UNSIGNED_INT,
            "count": index.size,
            "type": "SCALAR",
        },
    ]
    document = {
        "asset": {"version": VERSION, "generator": "gablework"},
        "extensionsUsed": [QUANTIZATION],
        "extensionsRequired": [QUANTIZATION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}]}],
        "materials": [material(NAME, COLOUR)],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    return container(document, pieces)


def _normals(metres: FloatArray, triangles: LabelArray) -> FloatArray:
    """Unit normals (v, 3) of the vertices: the mean of the triangles around, by their areas. Up where there is none."""
    a, b, c = (metres[triangles[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)
    found = np.zeros_like(metres)
    for corner in range(3):
        np.add.at(found, triangles[:, corner], areas)
    lengths = np.linalg.norm(found, axis=1)
    found[lengths == 0.0] = 0.0, 1.0, 0.0
    return found / np.where(lengths == 0.0, 1.0, lengths)[:, None]
