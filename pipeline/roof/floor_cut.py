"""Cuts roof faces that leave the permitted range of heights, each along a level line.

The sloping part keeps its plane, the part beyond the line becomes level, and the neighbours get the ends of the cut, so
the faces still share their borders.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import shapely

from pipeline.model import Plane
from pipeline.roof.partition import RoofPartition

_NEAR_MM = 5.0
"""A cut that would end nearer to a corner than this ends there; numerical guard."""

Corner = tuple[int, int]
Ring = list[Corner]


def cut_at_levels(
    partition: RoofPartition, planes: Sequence[Plane], levels_m: Mapping[int, float], *, above: bool, undivided: bool
) -> tuple[RoofPartition, list[Plane]]:
    """Cut faces, by number, at an elevation, and make what lies above it, or else below it, level there.

    Returns the partition and the planes; the level ones come last, one for each elevation. A face whose cut does not
    divide it into polygons becomes level as a whole if `undivided`, else it stays.
    """
    faces = [_rings(polygon) for polygon in partition.polygons]
    cut = {k: _ends_of_cut(faces[k], planes[int(partition.labels[k])], z) for k, z in levels_m.items()}
    heights = sorted({round(z, 3) for z in levels_m.values()})
    number = {z: len(planes) + k for k, z in enumerate(heights)}
    inserted: dict[tuple[Corner, Corner], set[Corner]] = {}
    for ends in cut.values():
        for (a, b), corner in ends.items():
            inserted.setdefault((a, b), set()).add(corner)
            inserted.setdefault((b, a), set()).add(corner)
    polygons: list[shapely.Polygon] = []
    labels: list[int] = []
    for k, (rings, label) in enumerate(zip(faces, partition.labels.tolist(), strict=True)):
        longer = [_with_corners(ring, inserted) for ring in rings]
        pieces = [shapely.Polygon(longer[0], longer[1:])]
        if k in cut:
            pieces = _pieces(pieces[0], longer, _along_cut(cut[k].values(), planes[label]))
        for piece in pieces:
            is_level = k in cut and undivided
            if len(pieces) > 1:
                is_level = bool(_height_m(planes[label], _inner(piece)) > levels_m[k]) == above
            polygons.append(piece)
            labels.append(number[round(levels_m[k], 3)] if is_level else label)
    level = [Plane(a=0.0, b=0.0, c=z, n_points=0, rmse_m=0.0) for z in heights]
    return RoofPartition(polygons=tuple(polygons), labels=np.array(labels, np.int32)), [*planes, *level]


def _rings(polygon: shapely.Polygon) -> list[Ring]:
    """The corners of the outline and of the holes, without the closing one."""
    rings = [polygon.exterior, *polygon.interiors]
    return [[(round(x), round(y)) for x, y in shapely.get_coordinates(ring)[:-1].tolist()] for ring in rings]


def _height_m(plane: Plane, at: tuple[float, float]) -> float:
    return plane.a * (at[0] * 1e-3) + plane.b * (at[1] * 1e-3) + plane.c


def _ends_of_cut(rings: list[Ring], plane: Plane, floor_z_m: float) -> dict[tuple[Corner, Corner], Corner]:
    """By edge of a face, the corner where it crosses the floor: a new one, or an end of the edge if that is near."""
    ends: dict[tuple[Corner, Corner], Corner] = {}
    for ring in rings:
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
            above_a, above_b = (_height_m(plane, corner) - floor_z_m for corner in (a, b))
            if (above_a < 0.0) == (above_b < 0.0):
                continue
            share = above_a / (above_a - above_b)
            length = math.dist(a, b)
            if share * length < _NEAR_MM:
                ends[a, b] = a
            elif (1.0 - share) * length < _NEAR_MM:
                ends[a, b] = b
            else:
                ends[a, b] = round(a[0] + share * (b[0] - a[0])), round(a[1] + share * (b[1] - a[1]))
    return ends


def _with_corners(ring: Ring, inserted: dict[tuple[Corner, Corner], set[Corner]]) -> Ring:
    """The ring with the new corners of its edges, in their order."""
    longer: Ring = []
    for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
        between = inserted.get((a, b), set()) - {a, b}
        longer += [a, *sorted(between, key=lambda corner: math.dist(a, corner))]
    return longer


def _along_cut(ends: Iterable[Corner], plane: Plane) -> list[Corner]:
    """The distinct ends of a cut in the order in which they lie on it: a level line of the plane."""
    return sorted(set(ends), key=lambda corner: plane.a * corner[1] - plane.b * corner[0])


def _pieces(whole: shapely.Polygon, rings: list[Ring], ends: list[Corner]) -> list[shapely.Polygon]:
    """The parts of a face on both sides of its cut; the face itself where the cut does not divide it."""
    sides = [edge for ring in rings for edge in zip(ring, ring[1:] + ring[:1], strict=True)]
    known = {frozenset(side) for side in sides}
    across = [
        edge
        for edge in pairwise(ends)
        if frozenset(edge) not in known and whole.contains(shapely.Point(np.mean(edge, axis=0)))
    ]
    pieces = shapely.polygonize([shapely.LineString(line) for line in (*sides, *across)]).geoms
    inside = [piece for piece in map(shapely.normalize, pieces) if whole.contains(shapely.Point(_inner(piece)))]
    inside.sort(key=lambda piece: tuple(piece.bounds))
    if len(inside) != len(across) + 1 or abs(sum(piece.area for piece in inside) - whole.area) > 1.0:
        return [whole]
    return inside


def _inner(polygon: shapely.Polygon) -> tuple[float, float]:
    """A place inside a polygon."""
    point = shapely.point_on_surface(polygon)
    return point.x, point.y
