"""Given footprints in integer millimetres: cleaned, with simpler forms, and the points inside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.geometry import corners_of_rings
from pipeline.model import FloatArray, IntArray, Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.snapped_rings import on_grid

_REPEATED_MM = 10.0
"""Vertices this near to the one before repeat it: below the accuracy of any footprint."""


_STRAIGHT_MM = 1.5
"""Vertices this near to the line through their neighbours are not corners."""


_ROUND_MM = (5.0, 20.0)
"""How far simpler forms of an outline with many short edges deviate from it; measured in docs/methods/solids.md."""


def footprint_in_mm(footprint: Polygon | MultiPolygon) -> MultiPolygon:
    """A given footprint in integer millimetres, valid, without repeated vertices; it is in local metres, 2D or 3D.

    Raises BuildingError `no_footprint` where nothing with an area is left.
    """
    scaled = shapely.transform(footprint, lambda xy: xy * 1e3)
    if not scaled.is_valid:
        scaled = shapely.make_valid(scaled, method="structure", keep_collapsed=False)
    parts = polygons_of(scaled)
    snapped = on_grid(parts[0]) if len(parts) == 1 else shapely.set_precision(scaled, 1.0)
    straight = shapely.simplify(snapped, _STRAIGHT_MM, preserve_topology=True)
    cleaned = polygons_of(straight)
    if cleaned and _has_repeated(cleaned, _REPEATED_MM):
        cleaned = [thinned for polygon in cleaned for thinned in without_repeated(polygon, _REPEATED_MM)]
    thinned_all = MultiPolygon(cleaned)
    if not thinned_all.is_valid:
        thinned_all = MultiPolygon(polygons_of(snapped))
    if thinned_all.is_empty:
        raise BuildingError(Reason.NO_FOOTPRINT, f"the given footprint has an area of {footprint.area:g} m2")
    return thinned_all


def _has_repeated(polygons: list[Polygon], distance_mm: float) -> bool:
    """Whether a vertex is within a distance of the one before it."""
    xy, ring, _ = corners_of_rings(polygons)
    return bool(_repeats(xy, ring, distance_mm))


@kernel
def _repeats(xy: FloatArray, ring: IntArray, distance: float) -> bool:
    """Whether a corner (n, 2) is within a distance of the one before it in its ring."""
    for i in range(1, len(xy)):
        x, y = xy[i, 0] - xy[i - 1, 0], xy[i, 1] - xy[i - 1, 1]
        if ring[i] == ring[i - 1] and x * x + y * y <= distance * distance:
            return True
    return False


def without_repeated(polygon: Polygon, distance_mm: float) -> list[Polygon]:
    """The polygon without repeated vertices and vanishing holes; an empty list where it vanishes itself."""
    paths, number = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)
    thinned = shapely.remove_repeated_points(shapely.linestrings(paths, indices=number), distance_mm)
    rings = [shapely.get_coordinates(line) for line in thinned]
    if len(rings[0]) < 4:
        return []
    return [Polygon(rings[0], [ring for ring in rings[1:] if len(ring) >= 4])]


def simpler_outlines(outline_mm: MultiPolygon) -> Iterator[MultiPolygon]:
    """Outlines of fewer vertices: without those within 5 mm of the line between others, then within 20 mm.

    The corners of a sloping roof over a round tower, drawn with edges of a decimetre, rise and fall by less than the
    rounding of heights to 1 mm: triangles of such corners point anywhere. With fewer corners they do not. The vertices
    left between two chords move outward until these enclose the area of the arc between them.

    All outlines are valid, in integer millimetres; one with as many vertices as the one before is not yielded.
    """
    count = shapely.get_num_coordinates(outline_mm)
    oriented = shapely.orient_polygons(outline_mm)
    for tolerance_mm in _ROUND_MM:
        simple = shapely.simplify(oriented, tolerance_mm, preserve_topology=True)
        fewer = shapely.get_num_coordinates(simple)
        if fewer == count:
            continue
        count = fewer
        widened = [
            Polygon(*_rings_of_area(before, after))
            for before, after in zip(polygons_of(oriented), polygons_of(simple), strict=True)
        ]
        for shape in (MultiPolygon(widened), simple):
            if shape.is_valid:
                yield shape
                break


def _rings_of_area(before: Polygon, after: Polygon) -> tuple[FloatArray, list[FloatArray]]:
    """Rings of a simplified polygon that enclose the areas of the ones before."""
    rings = [
        _of_same_area(*(shapely.get_coordinates(ring)[:-1] for ring in pair))
        for pair in zip(shapely.get_rings(before).tolist(), shapely.get_rings(after).tolist(), strict=True)
    ]
    return rings[0], rings[1:]


def _of_same_area(ring: FloatArray, kept: FloatArray) -> FloatArray:
    """Some vertices of a ring, moved outward (to its right) or inward by the areas that their edges cut off.

    Vertices between two edges of the ring itself stay, and so do those at its corners of 90 degrees and more; those of
    one arc move by the same distance.
    """
    number = {xy: k for k, xy in enumerate(map(tuple, ring.tolist()))}
    first = [number[xy] for xy in map(tuple, kept.tolist())]
    n, m = len(ring), len(kept)
    cut_off = np.zeros(m)
    for k in range(m):
        steps = (first[(k + 1) % m] - first[k]) % n
        x, y = (ring[[(first[k] + s) % n for s in range(steps + 1)]] - ring[first[k]]).T
        cut_off[k] = 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) if steps > 1 else 0.0
    edges = np.roll(kept, -1, axis=0) - kept
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    outward = np.column_stack((edges[:, 1], -edges[:, 0])) / lengths[:, None]
    into = np.roll(outward, 1, axis=0)
    cosine = (into * outward).sum(axis=1)
    is_free = (cut_off != 0.0) & (np.roll(cut_off, 1) != 0.0) & (cosine > 0.0)
    if not is_free.any():
        return kept
    moved = kept.copy()
    # an arc: the edges from one vertex that stays to the next, all of them where none does
    stays = np.flatnonzero(~is_free).tolist() or [0]
    for begin, end in zip(stays, [*stays[1:], stays[0] + m], strict=True):
        arc = np.arange(begin, end) % m
        free = arc[is_free[arc]]
        if len(free):
            reach = 0.5 * (lengths[free] + lengths[free - 1]).sum()
            by = float(cut_off[arc].sum()) / float(reach)
            moved[free] += by * ((into + outward) / (1.0 + cosine)[:, None])[free]
    return np.rint(moved)


def in_footprint(footprint_mm: MultiPolygon, xy_mm: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Mask of the points inside or on the border."""
    shapely.prepare(footprint_mm)
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = shapely.intersects_xy(footprint_mm, xy_mm[:, 0], xy_mm[:, 1])
    return inside
