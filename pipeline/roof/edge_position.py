"""Where the edge of a roof lies, from the points along it.

The outermost points of a sampled edge lie inside it. Edge and points are independent, so in strips square to the edge
the distance from the outermost point to the edge has the same distribution as the distance from any line within the
roof to the next point inwards. It follows from the distances V of successive points, as the age of a renewal process:
its mean is E[V^2] / (2 E[V]) (Cox 1962), half of V for regular points, all of V for random ones. The correction
therefore follows the density, the pattern and its direction at the edge itself.

The scanner sees the roof larger than it is, since a pulse that meets it with a part of its beam also gives a roof
point. Such a pulse has a further return from below, which identifies it: split pulses lie in a band along the edge, as
wide outside as inside. Their number, over the length of the edge and the density of the points, is the width of the
band; half of it is the reach of the mixed pulses, by which the edge is drawn back. Nothing is drawn back where the file
does not record the number of returns.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.geometry import bounds_of, nearest_distance
from pipeline.kernels.exact_sum import exact_sum
from pipeline.kernels.sorting import counting_sort, in_order, sort_few
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.lines import Run, off_piece

_STRIP_SPACINGS = 2.0
"""Width of a strip along the edge."""
_MARGIN_SPACINGS = 0.6
"""Left out at either end of the edge: corners are round in the raw outline, and at inner ones another wing begins."""
_DEPTH_SPACINGS = 6.0
"""How far into the roof the distances of points are taken."""
_REACH_SPACINGS = 1.5
"""How far outside the raw line points are looked for: the raw outline keeps within this of roof points."""
_GAP_SPACINGS = 2.5
"""A longer distance is a gap in the roof, not sampling."""
_PRIOR_COUNT = 8.0
_PRIOR_AGE = 0.75
"""Prior for few distances, in mean distances: between a lattice (0.5) and random points (1)."""
_LONGEST_REACH_M = 0.5
_BAND_SPACINGS = 0.25
"""Split pulses belong to an edge up to twice the longest reach within the visible roof, plus the error of the line."""
_PRIOR_SPLITS = 4.0
"""With this many expected split pulses an edge's own count weighs as much as that of the whole building."""
_STRAY_AGES = 4.0
"""A strip whose outermost point lies this many mean ways off the median strip does not belong to this edge."""


class _Cells(NamedTuple):
    """The fields of `EdgePoints` as kernels take them."""

    xy_mm: IntArray
    split: BoolArray
    starts: LabelArray
    low_x: int
    low_y: int
    columns: int
    rows: int
    side: int


class _Line(NamedTuple):
    """A line's point and direction, and the first and the last vertex of the border along it."""

    x: float
    y: float
    ux: float
    uy: float
    first: int
    last: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class EdgePoints:
    """Roof points in cells, to be found along lines."""

    xy_mm: IntArray
    """(n, 2) int64, cell after cell."""
    split: BoolArray
    """(n,) bool, True where the pulse went on to a lower return."""
    starts: LabelArray
    """(columns * rows + 1,) where each cell's points start, row after row."""
    low_mm: tuple[int, int]
    """Lower left corner of the first cell."""
    columns: int
    rows: int
    cell_mm: int
    """Side of a cell."""
    spacing_mm: float
    """Typical distance of neighbours."""
    nearest_mm: float
    """Median distance from the nearest point."""

    @classmethod
    def of(cls, xy_mm: IntArray, split: BoolArray, spacing_m: float, nearest_m: float | None = None) -> EdgePoints:
        """Sort at least one point (n, 2), in millimetres, into cells of some point spacings.

        `split` is True where the pulse went on to a lower return; all False where the file does not record it. The
        median distance from the nearest point is searched for unless it is known.
        """
        cell = max(1000, math.ceil(_DEPTH_SPACINGS * spacing_m * 1e3))
        low, high = bounds_of(np.ascontiguousarray(xy_mm, dtype=np.int64))
        columns, rows = ((high - low) // cell + 1).tolist()
        place = (xy_mm[:, 1] - low[1]) // cell * columns + (xy_mm[:, 0] - low[0]) // cell
        starts, order = counting_sort(place.astype(np.int32), columns * rows)
        return cls(
            xy_mm=xy_mm[order],
            split=split[order],
            starts=starts,
            low_mm=(int(low[0]), int(low[1])),
            columns=columns,
            rows=rows,
            cell_mm=cell,
            spacing_mm=spacing_m * 1e3,
            nearest_mm=nearest_distance(xy_mm.astype(np.float64)) if nearest_m is None else 1e3 * nearest_m,
        )

    @property
    def band_mm(self) -> float:
        """How far within a line split pulses belong to its edge."""
        return 2e3 * _LONGEST_REACH_M + _BAND_SPACINGS * self.spacing_mm


@kernel
def _along(
    cells: _Cells, line: _Line, ends: tuple[float, float], sides: tuple[float, float], strips: int, gap: float
) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
    """Points by a stretch of a line, `ends` along it, out to its right and its left, in strips of equal width.

    How far to the line's right they lie, which are split, the place of each strip's outermost one, and the distances of
    successive ones of a strip up to its first one longer than `gap`.
    """
    columns, starts, side = cells.columns, cells.starts, cells.side
    x0, y0, ux, uy = line.x, line.y, line.ux, line.uy
    first, last = ends
    out, depth = sides
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for t in (first, last):
        for d in (out, -depth):
            x, y = x0 + t * ux + d * uy, y0 + t * uy - d * ux
            low_x, low_y, high_x, high_y = min(low_x, x), min(low_y, y), max(high_x, x), max(high_y, y)
    first_row = max(0, math.floor((low_y - cells.low_y) / side))
    last_row = min(cells.rows - 1, math.floor((high_y - cells.low_y) / side))
    first_column = max(0, math.floor((low_x - cells.low_x) / side))
    last_column = min(columns - 1, math.floor((high_x - cells.low_x) / side))
    if first_column > last_column or first_row > last_row:
        return np.empty(0), np.empty(0, np.bool_), np.empty(0), np.empty(0)
    most = 0
    for row in range(first_row, last_row + 1):
        most += starts[row * columns + last_column + 1] - starts[row * columns + first_column]
    inward, is_split, strip = np.empty(most), np.empty(most, np.bool_), np.empty(most, np.int32)
    width = (last - first) / strips
    count = 0
    for row in range(first_row, last_row + 1):
        for i in range(starts[row * columns + first_column], starts[row * columns + last_column + 1]):
            x, y = cells.xy_mm[i, 0] - x0, cells.xy_mm[i, 1] - y0
            way, off = x * ux + y * uy, x * uy - y * ux
            if first <= way < last and -depth <= off <= out:
                inward[count], is_split[count] = -off, cells.split[i]
                strip[count] = min(int((way - first) / width), strips - 1)
                count += 1
    inward, is_split = inward[:count], is_split[:count]
    starts, members = counting_sort(strip[:count], strips)
    from_edge = inward[members]
    places, distances = np.empty(strips), np.empty(count)
    seen = found = 0
    for s in range(strips):
        begin, end = starts[s], starts[s + 1]
        if begin == end:
            continue
        sort_few(from_edge[begin:end])
        places[seen] = -from_edge[begin]
        seen += 1
        for k in range(begin + 1, end):
            distance = from_edge[k] - from_edge[k - 1]
            if distance > gap:
                break
            distances[found] = distance
            found += 1
    return -inward, is_split, places[:seen].copy(), distances[:found].copy()


def mixed_pulse_reach_mm(outline_mm: shapely.Geometry, points: EdgePoints) -> float:
    """How far beyond its edge a roof gives points, all around: millimetres, at most 500; 0 where no pulse is split.

    The outline runs around the roof points, near their edge.
    """
    if not points.split.any():
        return 0.0
    simple = shapely.simplify(outline_mm, 0.6 * points.spacing_mm, preserve_topology=True)
    xy, ring = shapely.get_coordinates(shapely.get_parts(simple.boundary), return_index=True)
    near, far, length = _splits_near(xy, ring, points.xy_mm, points.split, points.band_mm)
    count = float(near)
    if far:
        # chimneys and skylights split pulses too: as many per area along the edge as amid the roof
        middle_mm2 = shapely.buffer(simple, -points.band_mm).area
        usual = far / middle_mm2 if middle_mm2 > 0.0 else 0.0
        count -= usual * (simple.area - middle_mm2)
    reach: float = 0.5 * count * points.spacing_mm**2 / length if length > 0.0 else 0.0
    return min(max(reach, 0.0), 1e3 * _LONGEST_REACH_M)


@kernel
def _splits_near(
    rings: FloatArray, ring: IntArray, xy_mm: IntArray, split: BoolArray, band: float
) -> tuple[int, int, float]:
    """How many split points lie within a band by the rings, how many do not, and the length of the rings.

    Rings are closed, (v, 2) with the number of the ring of every vertex, (v,).
    """
    length, of_ring = 0.0, 0.0
    for v in range(1, len(rings)):
        if ring[v] != ring[v - 1]:
            length, of_ring = length + of_ring, 0.0
            continue
        dx, dy = rings[v, 0] - rings[v - 1, 0], rings[v, 1] - rings[v - 1, 1]
        of_ring += math.sqrt(dx * dx + dy * dy)
    near, far = 0, 0
    for i in range(len(xy_mm)):
        if not split[i]:
            continue
        is_near = False
        for v in range(1, len(rings)):
            if ring[v] != ring[v - 1]:
                continue
            x0, x1 = rings[v - 1, 0] - xy_mm[i, 0], rings[v, 0] - xy_mm[i, 0]
            y0, y1 = rings[v - 1, 1] - xy_mm[i, 1], rings[v, 1] - xy_mm[i, 1]
            if min(x0, x1) > band or max(x0, x1) < -band or min(y0, y1) > band or max(y0, y1) < -band:
                continue
            if off_piece(rings[v - 1], rings[v], xy_mm[i]) <= band:
                is_near = True
                break
        if is_near:
            near += 1
        else:
            far += 1
    return near, far, length + of_ring


def outward_shift_mm(border: FloatArray, run: Run, points: EdgePoints, reach_mm: float) -> float | None:
    """How far a line along the border of a roof must be moved to its right to lie on the edge.

    Parameters
    ----------
    border : (n, 2) float64
        Vertices of the raw ring, the roof on its left, millimetres.
    run : Run
        A stretch of it, its line in its final direction.
    points : EdgePoints
        The roof points.
    reach_mm : float
        Reach of the mixed pulses, over the whole building: an edge with few of them has this.

    Returns
    -------
    float or None
        Millimetres, negative inwards: the mean over the strips of the outermost point's place, plus the mean way from
        there to the edge, less the reach of the mixed pulses. None where the stretch is too short, or has too few
        points.
    """
    cells = _Cells(
        points.xy_mm, points.split, points.starts, *points.low_mm, points.columns, points.rows, points.cell_mm
    )
    line = _Line(run.x, run.y, math.cos(run.direction), math.sin(run.direction), run.first, run.last)
    shift: float = _outward_shift(cells, border, line, points.spacing_mm, points.band_mm, reach_mm)
    return None if math.isnan(shift) else shift


@kernel
def _outward_shift(cells: _Cells, border: FloatArray, line: _Line, spacing: float, band: float, reach: float) -> float:
    """The kernel of `outward_shift_mm`; nan for None."""
    a, b = border[line.first % len(border)], border[line.last % len(border)]
    one = (a[0] - line.x) * line.ux + (a[1] - line.y) * line.uy
    other = (b[0] - line.x) * line.ux + (b[1] - line.y) * line.uy
    first, last = min(one, other) + _MARGIN_SPACINGS * spacing, max(one, other) - _MARGIN_SPACINGS * spacing
    if last - first < _STRIP_SPACINGS * spacing:
        return np.nan
    strips = math.floor((last - first) / (_STRIP_SPACINGS * spacing))
    width = (last - first) / strips
    out, depth = _REACH_SPACINGS * spacing, max(_DEPTH_SPACINGS * spacing, 3.0 * band)
    off, split, places, distances = _along(cells, line, (first, last), (out, depth), strips, _GAP_SPACINGS * spacing)
    if len(off) < 3:
        return np.nan
    prior = spacing * spacing / width
    total = exact_sum(distances) + _PRIOR_COUNT * prior
    squares = exact_sum(distances * distances) + 2.0 * _PRIOR_AGE * _PRIOR_COUNT * prior * prior
    age = squares / (2.0 * total)
    middle = in_order(places)[len(places) // 2]
    near = places[np.abs(places - middle) <= max(_STRAY_AGES * age, spacing)]
    edge: float = exact_sum(near) / len(near) + age
    density = (len(distances) + _PRIOR_COUNT) / (total * width)
    return edge - _own_reach(off - edge, split, density * (last - first), band, reach)


@kernel
def _own_reach(off: FloatArray, split: BoolArray, points_a_mm: float, band_mm: float, reach_mm: float) -> float:
    """The reach of mixed pulses at one edge, from its split pulses and the reach of the whole building, millimetres."""
    if reach_mm <= 0.0:
        return 0.0
    near, near_split, within, within_split = 0, 0, 0, 0
    for k in range(len(off)):
        if abs(off[k]) <= band_mm:
            near, near_split = near + 1, near_split + split[k]
        elif off[k] < 0.0:
            within, within_split = within + 1, within_split + split[k]
    usual = within_split / max(1, within)
    count = max(0.0, near_split - usual * near)
    # gamma prior about the building's reach, as heavy as so many split pulses
    reach = (count + _PRIOR_SPLITS) / (2.0 * points_a_mm + _PRIOR_SPLITS / reach_mm)
    return min(reach, 1e3 * _LONGEST_REACH_M)
