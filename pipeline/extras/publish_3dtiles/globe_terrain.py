"""The terrain of a tile on the globe, as the content of 3D Tiles: triangles with the floors of buildings cut out.

Positions are 32-bit floats about a place on the ellipsoid: within a kilometre they keep a tenth of a millimetre, so
neighbouring files meet, and the terrain meets the floors of the buildings as near as these are rounded.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.export.glb import material
from pipeline.export.glb_arrays import add_triangles, add_vertices, gltf_axes
from pipeline.export.glb_container import QUANTIZATION, VERTICES, GlbFile
from pipeline.extras.publish_3dtiles.globe_glb import Geodesy
from pipeline.model import FloatArray, LabelArray

NAME = "Terrain"
"""Name of the material."""
COLOUR = (0.32, 0.35, 0.22)
"""Its colour in linear RGB."""


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
    normals = np.zeros((len(metres), 4), "|i1")  # each at a multiple of four bytes
    normals[:, :3] = np.rint(_normals(metres, terrain.triangles) * 127.0)
    file = GlbFile()
    position = add_vertices(file, metres.astype("<f4"), "VEC3", bounded=True)
    view = file.view(normals.tobytes(), byteStride=4, target=VERTICES)
    normal = file.accessor(view, componentType=5120, normalized=True, count=len(metres), type="VEC3")
    primitive = {
        "attributes": {"POSITION": position, "NORMAL": normal},
        "indices": add_triangles(file, terrain.triangles),
        "material": 0,
    }
    return file.content(
        [{"mesh": 0}], [{"primitives": [primitive]}], materials=[material(NAME, COLOUR)], used=[QUANTIZATION]
    )


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
