"""Neighbourhoods and spacings of points, and what rings enclose: geometry that all stages share."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray

# -------------------------------------------------------------------------------------------------- neighbourhoods


@kernel
def grid_shape(points: FloatArray, cell_size_m: float) -> tuple[float, float, float, int, int]:
    """Lower left corner, cell size and shape of a grid; cells grow until there are few more of them than points."""
    x_min = points[0, 0]
    y_min = points[0, 1]
    x_max = x_min
    y_max = y_min
    for i in range(1, len(points)):
        x_min = min(x_min, points[i, 0])
        x_max = max(x_max, points[i, 0])
        y_min = min(y_min, points[i, 1])
        y_max = max(y_max, points[i, 1])
    while (math.floor((x_max - x_min) / cell_size_m) + 1.0) * (
        math.floor((y_max - y_min) / cell_size_m) + 1.0
    ) > 4.0 * len(points) + 64.0:
        cell_size_m *= 1.5
    columns = int((x_max - x_min) / cell_size_m) + 1
    rows = int((y_max - y_min) / cell_size_m) + 1
    return x_min, y_min, cell_size_m, columns, rows


@kernel
def sorted_into_grid(
    points: FloatArray, x_min: float, y_min: float, cell_size_m: float, columns: int, rows: int
) -> tuple[LabelArray, LabelArray]:
    """Points by cell, ascending within one: where each cell starts (columns * rows + 1), and the indices."""
    cell = np.empty(len(points), np.int32)
    for i in range(len(points)):
        cell[i] = int((points[i, 1] - y_min) / cell_size_m) * columns + int((points[i, 0] - x_min) / cell_size_m)
    return counting_sort(cell, columns * rows)


_POINTS_PER_CELL = 0.65
"""Changes the speed only: eight neighbours are then mostly found in the cells of the first two rings."""
_FIRST_RINGS = 2


@kernel
def _cell_for_few(points: FloatArray) -> float:
    """Size of cells that hold few points each, metres."""
    n = max(len(points), 1)
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for i in range(len(points)):
        low_x, low_y = min(low_x, points[i, 0]), min(low_y, points[i, 1])
        high_x, high_y = max(high_x, points[i, 0]), max(high_y, points[i, 1])
    width, depth = max(high_x - low_x, 0.0), max(high_y - low_y, 0.0)
    return max(math.sqrt(_POINTS_PER_CELL * width * depth / n), max(width, depth) / n, 1e-3)


@kernel(inline="always")
def _keep_least(least: FloatArray, square: float) -> None:
    """Sort a value into the ascending `least` (k,), whose last one drops out; without branches, for speed."""
    for m in range(len(least)):
        other = least[m]
        before = square < other
        least[m] = square if before else other
        square = other if before else square


@kernel(inline="always")
def _name_nearest(least: FloatArray, held: FloatArray, holder: LabelArray, nearest: LabelArray) -> None:
    """Write the points of the squares in `least` (k,), ascending, to `nearest`, of equal ones the lower index first.

    `nearest` (k,) is -1 before. `holder` has the point of each square in `held`; both are overwritten.
    """
    k = len(nearest)
    ranked = 0
    for c in range(len(held)):
        held[ranked], holder[ranked] = held[c], holder[c]
        ranked += held[c] <= least[k - 1]
    for c in range(ranked):
        square, j = held[c], holder[c]
        rank = 0
        for m in range(k):
            rank += least[m] < square
        while rank < k and least[rank] == square:
            other = nearest[rank]
            if other < 0 or j < other:
                nearest[rank], j = j, other
            if other < 0:
                break
            rank += 1


@kernel
def _nearest_neighbours(
    points: FloatArray, k: int, wanted_cell_size_m: float, named: bool
) -> tuple[LabelArray, FloatArray]:
    """Kernel: neighbours (n, k) as in `nearest_neighbours`, and squared distances (n, k), infinite without a neighbour.

    A cell size of 0 means few points per cell; if neighbours need not be `named` they are all -1.
    """
    n, dimensions = points.shape
    neighbours = np.full((n, k), -1, np.int32)
    squares = np.full((n, k), np.inf)
    if n == 0 or k == 0:
        return neighbours, squares
    size = wanted_cell_size_m if wanted_cell_size_m > 0.0 else _cell_for_few(points)
    x_min, y_min, size, columns, rows = grid_shape(points, size)
    start, members = sorted_into_grid(points, x_min, y_min, size, columns, rows)
    sorted_x, sorted_y, sorted_z = points[members, 0], points[members, 1], np.zeros(n)
    if dimensions == 3:
        sorted_z = points[members, 2]
    least = np.empty(k)
    held = np.empty(n)
    holder = np.empty(n, np.int32)
    for s in range(n):
        px, py, pz = sorted_x[s], sorted_y[s], sorted_z[s]
        column = int((px - x_min) / size)
        row = int((py - y_min) / size)
        inset_x = min(px - x_min - column * size, x_min + (column + 1) * size - px)
        inset_y = min(py - y_min - row * size, y_min + (row + 1) * size - py)
        inset = min(inset_x, inset_y)
        # first the k least squares alone, without branches: where a square ranks cannot be foretold
        least[:] = np.inf
        count = 0
        # the cell and two rings around it at once, then ring by ring: cells side by side hold a run of sorted points
        ring = _FIRST_RINGS
        while True:
            for step in range(2 * ring + 1):
                r = row + ((step + 1) // 2 if step % 2 == 1 else -(step // 2))
                if r < 0 or r >= rows:
                    continue
                whole = ring == _FIRST_RINGS or step >= 2 * ring - 1
                for side in range(1 if whole else 2):
                    low = max(column - ring, 0) if whole or side == 0 else column + ring
                    high = min(column + ring, columns - 1) if whole or side == 1 else column - ring
                    if low > high:
                        continue
                    for q in range(start[r * columns + low], start[r * columns + high + 1]):
                        dx, dy, dz = sorted_x[q] - px, sorted_y[q] - py, sorted_z[q] - pz
                        square = dx * dx + dy * dy + dz * dz
                        if square > least[k - 1] or q == s:
                            continue
                        held[count] = square
                        holder[count] = members[q]
                        count += 1
                        _keep_least(least, square)
            # whatever is not yet seen lies beyond the rings' outer border; a hair less allows for rounding
            reach = (inset + ring * size) * (1.0 - 1e-9) - 1e-9
            if reach > 0.0 and least[k - 1] < reach * reach:
                break
            ring += 1
            if ring > max(columns, rows):
                break
        for m in range(k):
            squares[members[s], m] = least[m]
        if not named:
            continue
        _name_nearest(least, held[:count], holder, neighbours[members[s]])
    return neighbours, squares


def nearest_neighbours(points: FloatArray, k: int, cell_size_m: float | None = None) -> LabelArray:
    """The k nearest other points of every point, exactly: (n, k) int32.

    Nearest first, of equal distances the lower index first; -1 where there are fewer other points. A point is not its
    own neighbour, another one at the same position is. Distances are in plan for points (n, 2), in space for (n, 3),
    metres. The cell of the search grid only changes the speed; by default it holds under one point. Raises ValueError
    if the shape is wrong, k is negative or the cell size is not positive.

    Examples
    --------
    >>> nearest_neighbours(np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]]), 2)
    array([[1, 2],
           [0, 2],
           [1, 0]], dtype=int32)
    """
    return _nearest_neighbours(*_checked_search(points, k, cell_size_m), True)[0]


def _checked_search(points: FloatArray, k: int, cell_size_m: float | None) -> tuple[FloatArray, int, float]:
    """The arguments of a neighbour search, validated; a cell size of 0 where none is given."""
    if points.ndim != 2 or points.shape[1] not in {2, 3}:
        raise ValueError(f"points has shape {points.shape}, not (n, 2) or (n, 3)")
    if k < 0:
        raise ValueError(f"k is {k}: use 0 or more")
    points = np.ascontiguousarray(points, dtype=np.float64)
    if cell_size_m is None:
        cell_size_m = 0.0
    elif not cell_size_m > 0.0:
        raise ValueError(f"cell_size_m is {cell_size_m}: use a positive size")
    return points, k, cell_size_m


_SPACING_NEIGHBOURS = 8  # one ring of neighbours on a lattice
_LOWEST = -(2**63)
"""Below all elevations in mm."""
_UNEVEN = 1.3
"""Ratio of the spacings over the area and over the points that shows several densities; with one it is below 1.25."""


def point_spacing_m(points: FloatArray) -> float:
    """Typical spacing of points in plan: 1 / sqrt(density) where most of them lie; nan for fewer than two points.

    The median over all points of the distance to the eighth neighbour, scaled by what it is among points strewn at
    random: robust against borders, gaps, and the short steps along a scan line. On a square lattice it gives 0.9 of the
    spacing.
    """
    return _spacings(_plan(points))[0]


def spacing_over_area_m(points: FloatArray) -> float:
    """Spacing of points in plan that holds over most of their area; nan for fewer than two points.

    Where two strips overlap on a part of a roof, most points lie there, but not most of the roof. A point represents an
    area that grows with the squared distance to its eighth neighbour; the median over the area is taken if it is more
    than 1.3 times that over the points, else `point_spacing_m`: with one density they differ by less than a quarter,
    borders included (measured on simulated and real roofs of 1 to 30 points per m2).
    """
    usual, over_area, _ = _spacings(_plan(points))
    return over_area if over_area > _UNEVEN * usual else usual


def median_of(values: FloatArray | IntArray) -> float:
    """The median of at least one number: `numpy.median` takes several times longer for a few hundred."""
    middle = [(len(values) - 1) // 2, len(values) // 2]
    return 0.5 * float(np.partition(values, middle)[middle].sum())


def nearest_distance(points: FloatArray) -> float:
    """Median distance in plan of points, at least one, from the nearest other one; infinite for a single one."""
    return _spacings(_plan(points))[2]


def _plan(points: FloatArray) -> bytes:
    """Positions in plan, (n, 2) float64."""
    return np.ascontiguousarray(points[:, :2], dtype=np.float64).tobytes()


@functools.lru_cache(maxsize=1)
def _spacings(plan: bytes) -> tuple[float, float, float]:
    """1 / sqrt(density) of `_plan`, by medians over the points and over their area; nan for fewer than two points.

    With the median distance from the nearest one. Cached: one search serves all three, and the points of a roof are
    mostly all that see the sky, whose spacing is asked for next.
    """
    points = np.frombuffer(plan).reshape(-1, 2).copy()
    n = len(points)
    k = min(_SPACING_NEIGHBOURS, n - 1)
    if k < 1:
        return math.nan, math.nan, math.inf
    found = _nearest_neighbours(points, k, 0.0, False)[1]
    nearest = math.sqrt(median_of(found[:, 0]))
    squares = np.sort(found[:, k - 1])
    median = 0.5 * float(squares[(n - 1) // 2] + squares[n // 2])
    covered = np.cumsum(squares)
    middle = float(squares[min(int(np.searchsorted(covered, 0.5 * covered[-1])), n - 1)])
    # pi density r_k^2 is Gamma(k) distributed; its median is k - 1/3 within 2 % for k >= 1; weighted with itself a
    # Gamma(k) variate is Gamma(k + 1) distributed
    return math.sqrt(median * math.pi / (k - 1.0 / 3.0)), math.sqrt(middle * math.pi / (k + 2.0 / 3.0)), nearest


@kernel
def _covered(xyz_mm: IntArray, points: FloatArray, radius_mm: int, height_mm: int) -> BoolArray:
    """Whether a point has another one more than `height_mm` above it within the radius in plan."""
    n = len(points)
    covered = np.zeros(n, np.bool_)
    x_min, y_min, size, columns, rows = grid_shape(points, radius_mm / 1000.0 + 0.001)
    start, members = sorted_into_grid(points, x_min, y_min, size, columns, rows)
    top = np.full(columns * rows, _LOWEST)
    for c in range(columns * rows):
        for q in range(start[c], start[c + 1]):
            top[c] = max(top[c], xyz_mm[members[q], 2])
    for i in range(n):
        column = int((points[i, 0] - x_min) / size)
        row = int((points[i, 1] - y_min) / size)
        limit = xyz_mm[i, 2] + height_mm
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                if covered[i] or top[r * columns + c] <= limit:
                    continue
                for q in range(start[r * columns + c], start[r * columns + c + 1]):
                    j = members[q]
                    if xyz_mm[j, 2] > limit:
                        dx = xyz_mm[j, 0] - xyz_mm[i, 0]
                        dy = xyz_mm[j, 1] - xyz_mm[i, 1]
                        if dx * dx + dy * dy <= radius_mm * radius_mm:
                            covered[i] = True
                            break
    return covered


def top_visible(points: FloatArray, radius_m: float = 0.5, height_m: float = 1.1) -> BoolArray:
    """Which points (n, 3) see the sky: no other one is more than 1.1 m higher within 0.5 m in plan.

    Points and limits are compared on whole millimetres, so that limits are met exactly.
    """
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    xyz_mm = np.rint(points * 1000.0).astype(np.int64)
    return ~_covered(
        xyz_mm, np.ascontiguousarray(points, dtype=np.float64), round(radius_m * 1000), round(height_m * 1000)
    )


@kernel
def _surrounded(places_mm: IntArray, xyz_mm: IntArray, points: FloatArray, radius_mm: int, height_mm: int) -> BoolArray:
    """Whether the points more than `height_mm` above each place within the radius lie on no one side of it."""
    surrounded = np.zeros(len(places_mm), np.bool_)
    x_min, y_min, size, columns, rows = grid_shape(points, radius_mm / 1000.0 + 0.001)
    start, members = sorted_into_grid(points, x_min, y_min, size, columns, rows)
    dx, dy = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    for i in range(len(places_mm)):
        column = math.floor((places_mm[i, 0] * 1e-3 - x_min) / size)
        row = math.floor((places_mm[i, 1] * 1e-3 - y_min) / size)
        m = 0
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for q in range(start[r * columns + c], start[r * columns + c + 1]):
                    j = members[q]
                    dx[m], dy[m] = xyz_mm[j, 0] - places_mm[i, 0], xyz_mm[j, 1] - places_mm[i, 1]
                    is_near = 0 < dx[m] * dx[m] + dy[m] * dy[m] <= radius_mm * radius_mm
                    if is_near and xyz_mm[j, 2] > places_mm[i, 2] + height_mm:
                        m += 1
        # all are on one side if one of them has none to its left
        surrounded[i] = m > 0
        for s in range(m):
            t = 0
            while t < m and dx[s] * dy[t] - dy[s] * dx[t] <= 0:
                t += 1
            if t == m:
                surrounded[i] = False
                break
    return surrounded


def surrounded(places: FloatArray, points: FloatArray, radius_m: float = 0.5, height_m: float = 1.1) -> BoolArray:
    """Which places (m, 3) lie within points (n, 3), at least one, that are more than 1.1 m higher and within 0.5 m.

    These points are all around such a place: no line through it has all of them on one side. Places and limits are
    compared on whole millimetres.
    """
    return _surrounded(
        np.rint(places * 1000.0).astype(np.int64),
        np.rint(points * 1000.0).astype(np.int64),
        np.ascontiguousarray(points, dtype=np.float64),
        round(radius_m * 1000),
        round(height_m * 1000),
    )


# ---------------------------------------------------------------------------------------------------------- polygons


def corners_of_rings(polygons: Sequence[Polygon | MultiPolygon]) -> tuple[FloatArray, IntArray, IntArray]:
    """Corners (n, 2) of all rings, which are closed, outer ones first; the ring of each; the polygon of each ring."""
    shapes = np.array(polygons, object)
    if all(isinstance(polygon, Polygon) for polygon in polygons) and not shapely.get_num_interior_rings(shapes).any():
        xy, ring = shapely.get_coordinates(shapes, return_index=True)
        return xy, ring, np.arange(len(shapes))
    parts, owner = shapely.get_parts(shapes, return_index=True)
    rings, part = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    return xy, ring, owner[part]


@kernel
def bounds_of(xy: IntArray) -> tuple[IntArray, IntArray]:
    """The lowest and the highest x and y of at least one point (n, 2): two arrays (2,).

    numpy takes many times longer along the first axis of such an array.
    """
    x0, y0 = xy[0, 0], xy[0, 1]
    x1, y1 = x0, y0
    for i in range(1, len(xy)):
        x0, x1 = min(x0, xy[i, 0]), max(x1, xy[i, 0])
        y0, y1 = min(y0, xy[i, 1]), max(y1, xy[i, 1])
    return np.array([x0, y0]), np.array([x1, y1])
