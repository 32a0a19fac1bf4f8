"""Evidence for vegetation: the planarity of a vertex's surroundings, and crowns among its neighbours.

Roofs are locally planar; crowns are not, and pulses reach through them. Both measures look a fixed distance and use
integer sums: they are the same in every tile.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, KindArray, LabelArray
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.reach import PLANARITY_SCALES
from pipeline.terrain.terrain_settings import VegetationSettings

_COUNT = 2**20 - 1
"""Three counts of up to a million share one whole number."""


@kernel
def _cells(x_mm: IntArray, y_mm: IntArray, side_mm: int) -> tuple[LabelArray, int]:
    """The square cell of each of some points, (2, n) its column and row from the lowest on; and the most of them."""
    low_x, low_y, side = x_mm.min() // side_mm * side_mm, y_mm.min() // side_mm * side_mm, float(side_mm)
    cells = np.empty((2, x_mm.size), np.int32)
    for i in range(x_mm.size):
        # quotients of whole numbers below 2^52 are exact when rounded down, and floats are divided several at a time
        cells[0, i], cells[1, i] = np.int32((x_mm[i] - low_x) / side), np.int32((y_mm[i] - low_y) / side)
    return cells, cells.max()


@kernel
def _around_wanted(cells: LabelArray, last: int, doublings: int, wanted: BoolArray, verdict: KindArray) -> IntArray:
    """Points that lie at most two doubled cells from the cell of a wanted point without a verdict."""
    side = (last >> doublings) + 1
    marked = np.zeros((side, side), np.bool_)
    for i in range(wanted.size):
        if wanted[i] and verdict[i] < 0:
            marked[cells[1, i] >> doublings, cells[0, i] >> doublings] = True
    near = np.zeros((side, side), np.bool_)
    for r in range(side):
        for c in range(side):
            if marked[r, c]:
                near[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3] = True
    found = np.empty(wanted.size, np.int64)
    count = 0
    for i in range(wanted.size):
        found[count] = i
        count += near[cells[1, i] >> doublings, cells[0, i] >> doublings]
    return found[:count].copy()


@kernel
def _in_order(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, members: LabelArray, corner_mm: tuple[int, int]
) -> FloatArray:
    """Some points in an order, (3, m), their x and y from a corner on."""
    points = np.empty((3, members.size))
    for k in range(members.size):
        i = members[k]
        points[0, k], points[1, k], points[2, k] = x_mm[i] - corner_mm[0], y_mm[i] - corner_mm[1], z_mm[i]
    return points


@kernel
def _block_around(
    points: FloatArray, start: LabelArray, cell: tuple[int, int], shape: tuple[int, int], block: FloatArray
) -> tuple[FloatArray, int]:
    """The points (3, n) of a cell and the eight around it, in `block` or a larger array; and their number."""
    (r, c), (rows, columns) = cell, shape
    west, east = max(c - 1, 0), min(c + 1, columns - 1)
    count = 0
    for rr in range(max(r - 1, 0), min(r + 2, rows)):
        low, high = start[rr * columns + west], start[rr * columns + east + 1]
        if count + high - low > block.shape[1]:
            larger = np.empty((3, 2 * (count + high - low)))
            larger[:, :count] = block[:, :count]
            block = larger
        for k in range(3):
            for m in range(high - low):
                block[k, count + m] = points[k, low + m]
        count += high - low
    return block, count


@kernel
def _on_level(
    z_mm: IntArray,
    start: LabelArray,
    shape: tuple[int, int],
    at: tuple[float, float],
    reach: float,
    range_mm: tuple[int, int],
    out: IntArray,
) -> tuple[IntArray, int]:
    """Which points lie in a range of elevations and in cells that a circle touches, and their number.

    They are in `out` or a larger array. The place `at` and the radius `reach` are in cells. Unsigned numbers: what is
    below the range is a great number above it, and no index is looked at for its sign.
    """
    (rows, columns), (low_mm, high_mm) = shape, range_mm
    thickness = np.uint64(high_mm - low_mm)
    found = np.uint64(0)
    for r in range(max(int(at[1] - reach), 0), min(int(at[1] + reach) + 1, rows)):
        aside = max(r - at[1], at[1] - (r + 1), 0.0)
        half = math.sqrt(max(reach * reach - aside * aside, 0.0))
        west, east = max(int(at[0] - half), 0), min(int(at[0] + half), columns - 1)
        low, high = np.uint64(start[r * columns + west]), np.uint64(start[r * columns + east + 1])
        if found + high - low > out.size:
            larger = np.empty(2 * (found + high - low), np.int64)
            larger[:found] = out[:found]
            out = larger
        for k in range(low, high):
            # the next one takes the place of one that is too far: no branch to predict
            out[found] = k
            found += np.uint64(np.uint64(z_mm[k] - low_mm) <= thickness)
    return out, int(found)


@kernel
def _in_circle(
    points: FloatArray, chosen: IntArray, count: int, at: tuple[float, float, float], limit: float, out: FloatArray
) -> tuple[FloatArray, int]:
    """Those of the chosen points (3, n) in a circle, relative to its middle, in `out` or a larger array; their number.

    Points out of all reach follow up to a multiple of eight: loops over so many need no rest.
    """
    if count + 8 > out.shape[1]:
        out = np.empty((3, 2 * (count + 8)))
    px, py, pz = points[0], points[1], points[2]
    near_x, near_y, near_z = out[0], out[1], out[2]
    found = np.uint64(0)
    for m in range(count):
        k = np.uint64(chosen[m])
        dx, dy = px[k] - at[0], py[k] - at[1]
        near_x[found], near_y[found], near_z[found] = dx, dy, pz[k] - at[2]
        found += np.uint64(dx * dx + dy * dy <= limit)
    last = (int(found) + 7) // 8 * 8
    out[:, found:last] = 1e9
    return out, last


@kernel(fastmath={"reassoc"})
def _shared_moments(
    near: FloatArray, count: int, first: tuple[float, float], second: tuple[float, float], limit: float
) -> tuple[float, float, tuple[float, float, float, float, float, float, float, float, float, float]]:
    """The numbers of points in each of two circles, and the moments, as by `_moments`, of those in both at once."""
    px, py, pz = near[0], near[1], near[2]
    of_first, of_second = 0.0, 0.0
    n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        dx, dy, dz = px[k], py[k], pz[k]
        ex, ey = dx - first[0], dy - first[1]
        fx, fy = dx - second[0], dy - second[1]
        in_first = 1.0 if ex * ex + ey * ey <= limit else 0.0
        in_second = 1.0 if fx * fx + fy * fy <= limit else 0.0
        of_first += in_first
        of_second += in_second
        inside = in_first * in_second
        x, y, z = inside * dx, inside * dy, inside * dz
        n += inside
        sx += x
        sy += y
        sz += z
        xx += x * dx
        xy += x * dy
        xz += x * dz
        yy += y * dy
        yz += y * dz
        zz += z * dz
    return of_first, of_second, (n, sx, sy, sz, xx, xy, xz, yy, yz, zz)


@kernel(fastmath={"reassoc"})
def _moments(
    block: FloatArray,
    count: int,
    at: tuple[float, float, float],
    limit: float,
    level: float,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Number, and moments of first and second order about a place, of the points of a block in a circle around it.

    All are whole numbers far below 2^53: no order of summing changes them, so it is left to the compiler.
    """
    px, py, pz = block[0], block[1], block[2]
    n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        dx, dy, dz = px[k] - at[0], py[k] - at[1], pz[k] - at[2]
        inside = 1.0 if (dx * dx + dy * dy <= limit) & (abs(dz) <= level) else 0.0
        x, y, z = inside * dx, inside * dy, inside * dz
        n += inside
        sx += x
        sy += y
        sz += z
        xx += x * dx
        xy += x * dy
        xz += x * dz
        yy += y * dy
        yz += y * dz
        zz += z * dz
    return n, sx, sy, sz, xx, xy, xz, yy, yz, zz


@kernel
def _is_planar(
    s: tuple[float, float, float, float, float, float, float, float, float, float], limit_mm2: float
) -> bool:
    """Whether the variance of the counted points across the plane that fits them best is at most a limit.

    That variance is the smallest eigenvalue of their covariances. It is above the limit if these, less the limit on the
    diagonal, are positive definite: all three leading minors are positive (Sylvester's criterion).
    """
    count = s[0]
    mx, my, mz = s[1] / count, s[2] / count, s[3] / count
    xx, xy, xz = s[4] / count - mx * mx - limit_mm2, s[5] / count - mx * my, s[6] / count - mx * mz
    yy, yz, zz = s[7] / count - my * my - limit_mm2, s[8] / count - my * mz, s[9] / count - mz * mz - limit_mm2
    minor = xx * yy - xy * xy
    return not (xx > 0.0 and minor > 0.0 and minor * zz + 2.0 * xy * xz * yz - xx * yz * yz - yy * xz * xz > 0.0)


class _Windows(NamedTuple):
    """The windows of one scale."""

    radius_mm: int
    min_points: int
    roughness_mm: float
    """Largest orthogonal standard deviation of a planar window."""
    smooth_mm: float
    """The same of a smooth one."""
    level_mm: int
    """Points farther above or below a vertex do not count."""


@kernel
def _planar(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, wanted: BoolArray, windows: _Windows, out: KindArray
) -> None:
    """Kernel for one scale: fills the wanted entries of out that are still -1 with the verdicts of `planarity`."""
    radius_mm, min_points, roughness_mm, smooth_mm, level_mm = windows
    n = x_mm.size
    if n == 0:
        return
    shift = 4.0 * radius_mm // 5.0
    diagonal = 566.0 * radius_mm // 1000.0
    shift_x = np.array([shift, diagonal, 0.0, -diagonal, -shift, -diagonal, 0.0, diagonal])
    shift_y = np.array([0.0, diagonal, shift, diagonal, 0.0, -diagonal, -shift, -diagonal])
    limit = float(radius_mm * radius_mm)
    # cells as wide as the radius: the window in the middle reaches one of them far, the shifted ones two. Rows of
    # cells run along y, as the vertices come in the order of x: neighbours in space are then near in memory
    start, members, column0, row0, columns, rows = points_by_cell(y_mm, x_mm, np.ones(n, np.bool_), radius_mm)
    # copies in the order of the cells: neighbouring cells of a row are one run of memory
    points = _in_order(x_mm, y_mm, z_mm, members, (row0 * radius_mm, column0 * radius_mm))
    z = points[2].astype(np.int64)
    block, level, near = np.empty((3, 256)), np.empty(1024, np.int64), np.empty((3, 256))
    planar_mm2, smooth_mm2 = roughness_mm * roughness_mm, smooth_mm * smooth_mm
    widest_mm2 = max(planar_mm2, smooth_mm2)
    for cell in range(rows * columns):
        place = (cell // columns, cell % columns)
        count = -1
        for m in range(start[cell], start[cell + 1]):
            i = members[m]
            if out[i] >= 0 or not wanted[i]:
                continue
            if count < 0:
                block, count = _block_around(points, start, place, (rows, columns), block)
            at = (points[0, m], points[1, m], points[2, m])
            # the window in the middle first: where it is planar the eight others cannot change the verdict
            s = _moments(block, count, at, limit, level_mm)
            if s[0] < min_points:
                continue
            if _is_planar(s, widest_mm2):
                out[i] = 2 if _is_planar(s, smooth_mm2) else 1
                continue
            out[i] = 0
            in_cells, on_level = (at[1] / radius_mm, at[0] / radius_mm), (z[m] - level_mm, z[m] + level_mm)
            level, most = _on_level(z, start, (rows, columns), in_cells, 1.81, on_level, level)
            near, found = _in_circle(points, level, most, at, 3.25 * limit, near)
            for w in range(0, 8, 2):
                one, other = (shift_x[w], shift_y[w]), (shift_x[w + 1], shift_y[w + 1])
                in_one, in_other, s = _shared_moments(near, found, one, other, limit)
                # more points only add to the squared distances from any plane: where the points that two windows share
                # have too much for either, both are rough; the margin is far wider than any rounding
                bound_mm2 = 1.001 * planar_mm2 * max(in_one, in_other) / max(s[0], 1.0) + 1.0
                if max(in_one, in_other) < min_points or (s[0] > 3 and not _is_planar(s, bound_mm2)):
                    continue
                for inside, place_mm in ((in_one, one), (in_other, other)):
                    if inside >= min_points:
                        _, _, s = _shared_moments(near, found, place_mm, place_mm, limit)
                        out[i] = max(out[i], _is_planar(s, planar_mm2))
                if out[i] > 0:
                    break


def planarity(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    wanted: BoolArray,
    settings: VegetationSettings,
    roughness_m: float | None = None,
) -> KindArray:
    """How planar the surroundings of each wanted vertex are; `roughness_m` replaces that of the settings.

    2 smooth, 1 planar, 0 rough, -1 not wanted or few neighbours. Only the window in the middle can be smooth.
    A vertex is judged by the most planar of nine windows: one around it and eight shifted by 0.8 of the radius, as
    edge-preserving filters do (Nagao and Matsuyama 1979), since every point near a ridge or an eave has a planar side.
    Vertices are thinned points in millimetres; all within `level_m` in elevation are neighbours.
    """
    verdict = np.full(len(x_mm), -1, np.int8)
    if not wanted.any():
        return verdict
    least_m = settings.roughness_m if roughness_m is None else roughness_m
    radius_mm = round(settings.radius_m * 1000)
    cells, last = _cells(x_mm, y_mm, radius_mm)
    for scale in range(PLANARITY_SCALES):
        windows = _Windows(
            radius_mm=radius_mm * 2**scale,
            min_points=settings.min_neighbours,
            roughness_mm=least_m * 1000.0 * 1.5**scale,
            smooth_mm=settings.smooth_m * 1000.0 * 1.5**scale,
            level_mm=round(settings.level_m * 1000),
        )
        near = _around_wanted(cells, last, scale, wanted, verdict)
        found = verdict[near]
        _planar(x_mm[near], y_mm[near], z_mm[near], wanted[near], windows, found)
        verdict[near] = found
    return verdict


@kernel
def _crowns(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    planar: KindArray,
    several: BoolArray,
    radius_mm: int,
    min_judged: int,
    shares: tuple[float, float],
) -> BoolArray:
    """Kernel of `crowns`."""
    n = x_mm.size
    out = np.zeros(n, np.bool_)
    if n == 0:
        return out
    limit = float(radius_mm * radius_mm)
    start, members, _, _, columns, rows = points_by_cell(y_mm, x_mm, planar >= 0, -(-radius_mm // 2))
    points = _in_order(x_mm, y_mm, z_mm, members, (x_mm.min(), y_mm.min()))
    # one number for all three counts: of the judged, of the rough among them, and of the pierced
    marks = 1 + ((planar[members] == 0).astype(np.int64) << 20) + (several[members].astype(np.int64) << 40)
    sums = np.zeros((rows + 1, columns + 1), np.int64)
    for r in range(rows):
        for c in range(columns):
            own = marks[start[r * columns + c] : start[r * columns + c + 1]].sum()
            sums[r + 1, c + 1] = sums[r + 1, c] + sums[r, c + 1] - sums[r, c] + own
    widest = 2 << (PLANARITY_SCALES - 1)
    for cell in range(rows * columns):
        r, c = cell // columns, cell % columns
        south, north = max(r - widest, 0), min(r + widest + 1, rows)
        west, east = max(c - widest, 0), min(c + widest + 1, columns)
        around = sums[north, east] - sums[south, east] - sums[north, west] + sums[south, west]
        # no crown is where nothing is rough, or nothing pierced, as far as the widest sphere looks
        if (around >> 20) & _COUNT == 0 or around >> 40 == 0:
            continue
        for m in range(start[cell], start[cell + 1]):
            x, y, z = points[0, m], points[1, m], points[2, m]
            counts, reach, farthest = 0, 2, limit
            for _ in range(PLANARITY_SCALES):
                counts = 0
                west, east = max(c - reach, 0), min(c + reach, columns - 1)
                for rr in range(max(r - reach, 0), min(r + reach + 1, rows)):
                    for k in range(start[rr * columns + west], start[rr * columns + east + 1]):
                        dx, dy, dz = points[0, k] - x, points[1, k] - y, points[2, k] - z
                        counts += marks[k] if dx * dx + dy * dy + dz * dz <= farthest else 0
                if counts & _COUNT >= min_judged:
                    break
                reach, farthest = 2 * reach, 4.0 * farthest
            judged, rough, pierced = counts & _COUNT, (counts >> 20) & _COUNT, counts >> 40
            out[members[m]] = rough > shares[0] * judged and pierced > shares[1] * judged
    return out


def crowns(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    planar: KindArray,
    several: BoolArray,
    settings: VegetationSettings,
) -> BoolArray:
    """Which vertices belong to crowns: most of the judged vertices near them in space are rough, and some are pierced.

    A chimney is rough and stays with its roof; a flat patch in a crown is planar and stays with the crown; a crown that
    leans on a roof is cut from it. The sphere counts only neighbours on the level of the vertex, and doubles up to
    twice until it holds `min_neighbours` judged ones: two or three vertices of a sparse survey show no crown. Rough
    roofs with superstructures return most pulses once, crowns do not. In a file of single returns nothing is a crown,
    and whole surfaces are judged by their shape alone.

    Vertices are thinned points in millimetres, `planar` their verdicts by `planarity`; without one a vertex is not in a
    crown. `several` marks those from a pulse of several returns.
    """
    radius_mm = round(settings.company_m * 1000)
    shares = (settings.crown_share, settings.pierced_share)
    mask: BoolArray = _crowns(x_mm, y_mm, z_mm, planar, several, radius_mm, settings.min_neighbours, shares)
    return mask
