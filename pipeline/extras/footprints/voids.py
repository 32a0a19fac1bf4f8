"""Places inside a given outline without a roof point nearby: courtyards that the outline lacks, demolished parts.

A place farther than the void distance from every roof point starts a void; it extends to where points begin.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.roof.arrangement.raster_labels import Raster, raster_cells
from pipeline.roof.footprint import polygons_of
from pipeline.roof.roof_settings import RoofSettings

_PITCH_M = 0.5
"""Cells of the raster on which voids are found: an eighth of the usual void distance."""
_JOG = 1.2
"""Cells, or point spacings: smaller jogs of a void's border come from the raster or the sampling."""


@kernel
def _distances(points: FloatArray, raster: Raster, gap_m: float, far_m: float) -> FloatArray:
    """Distance of every cell to the nearest point, (n,), at most `far_m`; below `gap_m` not necessarily the least."""
    west, south, pitch_m, columns, rows = raster.west, raster.south, raster.cell_m, raster.columns, raster.rows
    # points by cells, as linked lists
    first = np.full(rows * columns, -1, np.int32)
    following = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        c, r = math.floor((points[i, 0] - west) / pitch_m), math.floor((points[i, 1] - south) / pitch_m)
        if 0 <= c < columns and 0 <= r < rows:
            following[i] = first[r * columns + c]
            first[r * columns + c] = i
    nearest = np.full(len(raster.place), far_m)
    reach = math.ceil(far_m / pitch_m)
    for i in range(len(nearest)):
        r, c = raster.place[i] // columns, raster.place[i] % columns
        x, y = west + (c + 0.5) * pitch_m, south + (r + 0.5) * pitch_m
        for ring in range(reach + 1):
            if (ring - 0.5) * pitch_m >= nearest[i] or nearest[i] <= gap_m:
                break
            for rr in range(max(r - ring, 0), min(r + ring + 1, rows)):
                step = 1 if abs(rr - r) == ring else max(2 * ring, 1)
                for cc in range(c - ring, c + ring + 1, step):
                    if cc < 0 or cc >= columns:
                        continue
                    p = first[rr * columns + cc]
                    while p >= 0:
                        nearest[i] = min(nearest[i], math.hypot(points[p, 0] - x, points[p, 1] - y))
                        p = following[p]
    return nearest


@kernel
def empty_cells(
    points: FloatArray, edges: FloatArray, pitch_m: float, gap_m: float, far_m: float
) -> tuple[FloatArray, LabelArray]:
    """Centres of the cells in voids, (v, 2) metres, and the void of each, (v,), among points (n, 2) in edges (e, 4).

    A void consists of connected cells farther than `gap_m` from every point, at least one of them farther than `far_m`.
    """
    west, south, east, north = edges[0, 0], edges[0, 1], edges[0, 0], edges[0, 1]
    for e in range(len(edges)):
        west, south = min(west, edges[e, 0]), min(south, edges[e, 1])
        east, north = max(east, edges[e, 0]), max(north, edges[e, 1])
    columns = int((east - west) / pitch_m) + 1
    rows = int((north - south) / pitch_m) + 1
    raster = raster_cells(edges, west, south, pitch_m, columns, rows)
    nearest = _distances(points, raster, gap_m, far_m)
    place = raster.place
    void = np.full(len(place), -1, np.int32)
    queue = np.empty(len(place), np.int32)
    count = 0
    for seed in range(len(place)):
        if void[seed] >= 0 or nearest[seed] < far_m:
            continue
        void[seed] = count
        queue[0] = seed
        head, tail = 0, 1
        while head < tail:
            r, c = place[queue[head]] // columns, place[queue[head]] % columns
            head += 1
            for step in range(4):
                rr, cc = r + (step == 0) - (step == 1), c + (step == 2) - (step == 3)
                if rr < 0 or cc < 0 or rr >= rows or cc >= columns:
                    continue
                j = raster.number[rr * columns + cc]
                if j >= 0 and void[j] < 0 and nearest[j] > gap_m:
                    void[j] = count
                    queue[tail] = j
                    tail += 1
        count += 1
    chosen = np.flatnonzero(void >= 0)
    centres = np.empty((len(chosen), 2))
    for i in range(len(chosen)):
        centres[i, 0] = west + (place[chosen[i]] % columns + 0.5) * pitch_m
        centres[i, 1] = south + (place[chosen[i]] // columns + 0.5) * pitch_m
    return centres, void[chosen]


def without_voids(
    outline_mm: MultiPolygon, points: FloatArray, spacing_m: float, settings: RoofSettings
) -> MultiPolygon:
    """An outline in valid integer millimetres without the places that are not roof.

    Roof points (n, 3) of the same frame are in metres. The same object comes back if it has no void, or where
    nothing would be left.
    """
    far_m = max(settings.void_distance_m, 2.0 * settings.gap_spacings * spacing_m)
    gap_m = settings.gap_spacings * spacing_m
    # a building narrower than that has no room for a void
    if min(np.ptp(shapely.get_coordinates(outline_mm), axis=0)) * 1e-3 < far_m:
        return outline_mm
    edges, cos, sin = framed_edges(outline_mm)
    turned = turned_about_origin(points[:, :2], cos, -sin)
    pitch_m = max(_PITCH_M, 0.5 * gap_m)
    reach_m = max(gap_m, pitch_m)
    centres, numbers = empty_cells(turned, edges, pitch_m, reach_m, far_m)
    if len(centres) == 0:
        return outline_mm
    half = 0.5 * pitch_m
    cells = shapely.box(centres[:, 0] - half, centres[:, 1] - half, centres[:, 0] + half, centres[:, 1] + half)
    voids = []
    for k in range(int(numbers.max()) + 1):
        # the cells' centres keep the gap from the points, their union half a cell less; narrow bays go
        void = _widened(shapely.union_all(cells[numbers == k]), reach_m - half + pitch_m)
        void = _widened(_widened(void, -2.0 * pitch_m), pitch_m)
        voids.append(shapely.simplify(void, _JOG * max(pitch_m, spacing_m)))
    drawn = [
        shapely.transform(piece, lambda xy: np.rint(turned_about_origin(xy, cos, sin) * 1e3))
        for piece in polygons_of(shapely.union_all(voids))
        if piece.area >= settings.min_void_m2
    ]
    if not drawn:
        return outline_mm
    left = polygons_of(shapely.difference(outline_mm, shapely.union_all(drawn), grid_size=1.0))
    large = [piece for piece in left if piece.area * 1e-6 >= settings.min_part_area_m2]
    return MultiPolygon(large) if large else outline_mm


def framed_edges(outline_mm: MultiPolygon) -> tuple[FloatArray, float, float]:
    """The edges of an outline, (e, 4) metres, turned such that the longest one runs along x; its cosine and sine.

    Walls around courtyards, and ridges, are parallel to the others.
    """
    xy, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(outline_mm)), return_index=True)
    edges = np.hstack((xy[:-1], xy[1:]))[ring[:-1] == ring[1:]] * 1e-3
    steps = edges[:, 2:] - edges[:, :2]
    along = steps[np.argmax(np.hypot(steps[:, 0], steps[:, 1]))]
    length = math.hypot(along[0], along[1])
    cos, sin = float(along[0]) / length, float(along[1]) / length
    return turned_about_origin(edges.reshape(-1, 2), cos, -sin).reshape(-1, 4), cos, sin


def turned_about_origin(xy: FloatArray, cos: float, sin: float) -> FloatArray:
    """Places turned left about the origin; written out, since a matrix product differs between machines."""
    return np.column_stack((xy[:, 0] * cos - xy[:, 1] * sin, xy[:, 0] * sin + xy[:, 1] * cos))


def _widened(area: shapely.Geometry, distance_m: float) -> shapely.Geometry:
    """An area with straight corners kept."""
    return shapely.buffer(area, distance_m, join_style="mitre")
