"""Matches given lines with a building: the lines near it, the edges that they move, and the lines that faces follow."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import BoolArray, FloatArray, Guide, GuideKind, IntArray
from pipeline.roof.arrangement.guide_lines import MAX_TURN, line_through
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Run, corners, fitted_run

OF_OUTLINES = frozenset({GuideKind.EAVE, GuideKind.ANY})
"""Kinds that may move lines of the outline. Eaves may also part faces: those of a higher part over a lower one."""
_STEPS = frozenset({GuideKind.EAVE, GuideKind.STEP})
_MIN_PIECE_M = 0.5
"""Shorter pieces are not looked at: the ends of lines that lie beside a building."""
_MOST_PIECES = 100
"""Most pieces within one roof, the longest ones: the faces may be arranged once for each."""
_ON_EDGE_M = 0.1
"""A guide is followed where an edge is this near: chords pass through vertices within 6 cm."""
_FOLLOWED_SHARE = 0.5
"""Share of a guide's length on a building that has to be on edges."""
_BEYOND_M = 0.15
"""A roof point this far beyond an eave speaks against it; nearer ones are pulses that met it with a part of their beam.
Chosen on development scenes."""


class GuideError(Exception):
    """A step that needs guides failed. It is not a fault of the building, which is modelled without them."""


@contextlib.contextmanager
def guide_steps() -> Iterator[None]:
    """Turn the faults of a form within into a GuideError, so that no other form is tried with these guides."""
    try:
        yield
    except (BuildingError, shapely.errors.GEOSException) as error:
        raise GuideError(str(error)) from error


def pieces_of(lines: Iterable[LineString]) -> FloatArray:
    """The straight pieces of lines, (g, 4) x0, y0, x1, y1; those shorter than half a metre are left out."""
    found = [np.empty((0, 4))]
    for line in lines:
        xy = shapely.get_coordinates(line)
        pieces = np.hstack((xy[:-1], xy[1:]))
        lengths = np.hypot(pieces[:, 2] - pieces[:, 0], pieces[:, 3] - pieces[:, 1])
        found.append(pieces[lengths >= _MIN_PIECE_M])
    return np.concatenate(found)


def lines_within(guides: Iterable[Guide], area: shapely.Geometry) -> list[list[LineString]]:
    """The parts of each guide in an area, in its frame; an empty list for one that has less than half a metre there."""
    found = []
    for guide in guides:
        inside = shapely.get_parts(shapely.line_merge(shapely.intersection(guide.line, area))).tolist()
        lines = [part for part in inside if isinstance(part, LineString) and part.length >= _MIN_PIECE_M]
        found.append(lines)
    return found


def inner_pieces(guides: Sequence[Guide], outline_mm: MultiPolygon) -> tuple[FloatArray, BoolArray]:
    """The straight pieces (g, 4) of guides within an outline, local metres; what runs along the outline is left out.

    Of more than 100 the longest ones. Also returns which of them are known as steps, (g,): eaves over a lower part are.
    """
    outline = shapely.transform(outline_mm, lambda xy: xy * 1e-3)
    inside = shapely.difference(outline, shapely.buffer(outline.boundary, _ON_EDGE_M))
    found = [pieces_of(lines) for lines in lines_within(guides, inside)]
    may_step = [np.full(len(pieces), guide.kind in _STEPS) for guide, pieces in zip(guides, found, strict=True)]
    pieces, steps = np.concatenate([np.empty((0, 4)), *found]), np.concatenate([np.empty(0, np.bool_), *may_step])
    lengths_mm = np.rint(1e3 * np.hypot(pieces[:, 2] - pieces[:, 0], pieces[:, 3] - pieces[:, 1]))
    longest = np.sort(np.argsort(-lengths_mm, kind="stable")[:_MOST_PIECES])
    return pieces[longest], steps[longest]


def guided_outline(
    outline_mm: MultiPolygon, guides: Iterable[Guide], xy_mm: IntArray, distance_m: float
) -> MultiPolygon:
    """An outline with its edges moved onto guides of eaves, integer millimetres.

    An edge takes the place of a guide if its ends lie within `distance_m` of the guide's line, if it turns from it by
    10 deg at most, and if the guide runs beside half of it. An edge stays if the guide would cut off any of the
    roof points `xy_mm` (n, 2); the outline stays if it would not be valid.
    """
    pieces = 1e3 * pieces_of(guide.line for guide in guides if guide.kind in OF_OUTLINES)
    if len(pieces) == 0:
        return outline_mm
    polygons = []
    for polygon in shapely.orient_polygons(outline_mm).geoms:
        rings = [
            _guided_ring(shapely.get_coordinates(ring)[:-1], pieces, xy_mm, 1e3 * distance_m)
            for ring in (polygon.exterior, *polygon.interiors)
        ]
        polygons.append(Polygon(rings[0], rings[1:]))
    moved = MultiPolygon(polygons)
    if not moved.is_valid:
        return outline_mm
    found = MultiPolygon(polygons_of(shapely.set_precision(moved, 1.0)))
    return found if found.is_valid and len(found.geoms) == len(outline_mm.geoms) else outline_mm


def _guided_ring(ring: FloatArray, pieces: FloatArray, xy_mm: IntArray, distance_mm: float) -> FloatArray:
    """A ring (n, 2), not closed, inside to its left, with its edges on the pieces (g, 4) that take their place."""
    n = len(ring)
    runs = [fitted_run(ring, i, i + 1) for i in range(n)]
    taken = [_guide_of(ring[i], ring[(i + 1) % n], pieces, xy_mm, distance_mm) for i in range(n)]
    if max(taken) < 0:
        return ring
    # the short steps between edges that lie on one guide now
    for i in range(n):
        around = taken[i - 1], taken[(i + 1) % n]
        if taken[i] < 0 and around[0] == around[1] >= 0 and runs[i].length <= 2.0 * distance_mm:
            taken[i] = around[0]
    first = next((i for i in range(n) if taken[i] < 0 or taken[i] != taken[i - 1]), 0)
    united: list[Run] = []
    before = -1
    for i in (k % n for k in range(first, first + n)):
        k = taken[i]
        if k >= 0 and k == before:
            united[-1].last += 1
            continue
        run = runs[i]
        if k >= 0:
            x0, y0, x1, y1 = pieces[k].tolist()
            direction = math.atan2(y1 - y0, x1 - x0)
            if math.cos(direction - run.direction) < 0.0:
                direction += math.pi
            run = Run(first=run.first, last=run.last, x=x0, y=y0, direction=direction, length=run.length, exact=True)
        united.append(run)
        before = k
    if len(united) < 3:
        return ring
    drawn = np.rint(corners(ring, united, 3.0 * distance_mm, closed=True))
    kept = (drawn != np.roll(drawn, 1, axis=0)).any(axis=1)
    return drawn[kept] if np.count_nonzero(kept) >= 3 else ring


def _guide_of(start: FloatArray, end: FloatArray, pieces: FloatArray, xy_mm: IntArray, distance_mm: float) -> int:
    """The piece that takes the place of an edge from start to end, inside to its left, millimetres; -1 for none."""
    best, nearest = -1, distance_mm
    length = math.dist(start, end)
    for k in range(len(pieces)):
        nx, ny, offset, whole = line_through(pieces[k])
        off = np.array([nx * x + ny * y + offset for x, y in (start, end)])
        along = np.array([ny * (x - pieces[k, 0]) - nx * (y - pieces[k, 1]) for x, y in (start, end)])
        low, high = float(along.min()), float(along.max())
        away = float(np.abs(off).max())
        if abs(float(off[1] - off[0])) > MAX_TURN * length or away > nearest:
            continue
        if min(high, whole) - max(low, 0.0) < 0.5 * length:
            continue
        # outwards of the edge, which has the inside to its left
        outwards = -1.0 if along[1] > along[0] else 1.0
        beside = ny * (xy_mm[:, 0] - pieces[k, 0]) - nx * (xy_mm[:, 1] - pieces[k, 1])
        beyond = outwards * (nx * xy_mm[:, 0] + ny * xy_mm[:, 1] + offset)
        reach = outwards * off.mean()
        cut = (beside >= low) & (beside <= high) & (beyond > _BEYOND_M * 1e3) & (beyond <= reach)
        if not cut.any():
            best, nearest = k, away
    return best


def followed(guides: Sequence[Guide], faces: Sequence[Polygon], distance_m: float) -> tuple[int, int] | None:
    """How many guides the edges of roof faces follow, and how many others run over them; None without guides or faces.

    A guide concerns the faces with the part of it that lies within `distance_m` of them.
    """
    if not guides or not faces:
        return None
    area = shapely.buffer(shapely.union_all([shapely.force_2d(face) for face in faces]), distance_m)
    edges = shapely.buffer(shapely.union_all([shapely.force_2d(face).boundary for face in faces]), _ON_EDGE_M)
    counts = [0, 0]
    for lines in lines_within(guides, area):
        if lines:
            whole = math.fsum(line.length for line in lines)
            on_edges = math.fsum(float(shapely.intersection(line, edges).length) for line in lines)
            counts[on_edges < _FOLLOWED_SHARE * whole] += 1
    return counts[0], counts[1]
