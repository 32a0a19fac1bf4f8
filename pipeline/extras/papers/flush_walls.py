"""Walls in one plane become one wall: the gable end of a primitive is a pentagon, not two quadrilaterals."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.model import FaceKind, FloatArray, Solid, SolidFace
from pipeline.roof.solid import SolidPart

_FLUSH_M = 1.5e-3
"""Largest distance of a corner from the line of its neighbours: rounding to 1 mm moves a point on it as far."""

Ring = tuple[int, ...]


def unite_flush_walls(part: SolidPart, limit_mm: MultiPolygon | None = None) -> SolidPart:
    """Unite neighbouring outer walls of a closed solid that lie in one plane, and drop the floor's corner between them.

    The same object comes back where no two walls are flush, or where the part would leave a limit.
    """
    solid = part.solid
    faces = list(solid.faces)
    dropped: set[int] = set()
    for ring in next(face for face in faces if face.kind is FaceKind.GROUND).rings:
        for corner in ring:
            left = [v for v in ring if v not in dropped]
            if len(left) > 3 and _is_flush(solid.vertices, left, corner) and _unite_at(faces, corner):
                dropped.add(corner)
    if not dropped:
        return part
    united = _without(part, faces, dropped)
    floor_mm = shapely.transform(united.footprint, lambda xy: np.rint(xy * 1e3))
    return united if limit_mm is None or shapely.covers(limit_mm, floor_mm) else part


def _is_flush(vertices: FloatArray, ring: list[int], corner: int) -> bool:
    """Whether a floor's corner lies between its neighbours on their line."""
    k = ring.index(corner)
    (xa, ya), (x, y), (xb, yb) = vertices[[ring[k - 1], corner, ring[(k + 1) % len(ring)]], :2].tolist()
    length = math.hypot(xb - xa, yb - ya)
    off = abs((xb - xa) * (y - ya) - (yb - ya) * (x - xa))
    between = (x - xa) * (xb - xa) + (y - ya) * (yb - ya)
    return bool(off <= _FLUSH_M * length and 0.0 < between < length * length)


def _unite_at(faces: list[SolidFace], corner: int) -> bool:
    """Replace the two walls that meet over a corner by one; False where they have no single edge in common there."""
    walls = [k for k, face in enumerate(faces) if face.kind is FaceKind.WALL and corner in face.rings[0]]
    if len(walls) != 2:
        return False
    first, second = (_starting_at(faces[k].rings[0], corner) for k in walls)
    # one wall comes down the common edge to the corner, the other goes up from it
    down, up = (first, second) if first[-1] == second[1] else (second, first)
    if down[-1] != up[1]:
        return False
    united = down[1:] + up[2:]
    faces[walls[0]] = dataclasses.replace(faces[walls[0]], rings=(united,))
    del faces[walls[1]]
    return True


def _starting_at(ring: Ring, vertex: int) -> Ring:
    k = ring.index(vertex)
    return ring[k:] + ring[:k]


def _without(part: SolidPart, faces: list[SolidFace], dropped: set[int]) -> SolidPart:
    """The part without some vertices of its floor."""
    vertices = part.solid.vertices
    kept = [v for v in range(len(vertices)) if v not in dropped]
    number = {v: k for k, v in enumerate(kept)}
    renumbered = tuple(
        dataclasses.replace(face, rings=tuple(tuple(number[v] for v in ring if v in number) for ring in face.rings))
        for face in faces
    )
    floor = next(face for face in renumbered if face.kind is FaceKind.GROUND)
    plan: FloatArray = np.ascontiguousarray(vertices[kept, :2])
    rings = [plan[list(ring[::-1])] for ring in floor.rings]
    return SolidPart(
        solid=Solid(vertices=vertices[kept], faces=renumbered),
        faces=part.faces,
        footprint=shapely.Polygon(rings[0], rings[1:]),
    )
