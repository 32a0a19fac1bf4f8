"""Undecided vertices on roofs: parts that class 6 leaves out, recognised by their surroundings.

A producer's class 6 may lack an overlapping strip (class 12), or points that an editor or a filter left undecided
(class 1). A vertex without a class belongs to the roof if it lies in one plane with building vertices around it. Planes
are drawn in the windows that judge planarity (`terrain.vegetation`), and look no farther: a wide part that class 6
leaves out is judged as a surface of its own, and joins the building along its seam (`terrain.candidates`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.model import BoolArray, FloatArray, IntArray, KindArray
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.facets import OnRoof
from pipeline.terrain.reach import PLANARITY_SCALES
from pipeline.terrain.terrain_settings import VegetationSettings

_LEAST_SHARE = 0.25
"""Share of building vertices in a window from which on they say what its plane is. Not a setting: it lies far from both
a roof with single stray codes, and a crown that touches an eave."""
_FEWEST = 3
"""Building vertices that draw a plane."""
_RESIDUALS = 2.0
"""Farthest from the plane of the others that a vertex on it lies, in the largest standard deviation of a window."""


class _Windows(NamedTuple):
    """The windows of one scale, mm."""

    radius: float
    min_points: int
    roughness: float
    """Largest standard deviation of a plane, across it."""
    same: float
    """Farthest from the plane of the others that a vertex on it lies."""
    level: float
    """Vertices farther above or below do not count."""
    reach: float
    """Farthest from the plane of the building vertices around it that a vertex beside it lies."""


@kernel(inline="always")
def _add(sums: FloatArray, x: float, y: float, z: float) -> None:
    """Add a place to sums (10,): of 1, x, y, z, xx, xy, yy, xz, yz, zz. Whole numbers far below 2^53 add up exactly."""
    sums[0] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += y * y
    sums[7] += x * z
    sums[8] += y * z
    sums[9] += z * z


@kernel
def _plane_at_middle(s: FloatArray) -> tuple[float, float]:
    """Elevation at x = y = 0 of the plane of some places, and their standard deviation across it, from their sums."""
    n = s[0]
    mx, my, mz = s[1] / n, s[2] / n, s[3] / n
    xx, xy, yy = s[4] / n - mx * mx, s[5] / n - mx * my, s[6] / n - my * my
    xz, yz, zz = s[7] / n - mx * mz, s[8] / n - my * mz, s[9] / n - mz * mz
    a, b = solve_plane_moments(xx, xy, yy, xz, yz)
    across = max(0.0, zz - a * xz - b * yz) / (1.0 + a * a + b * b)
    return mz - a * mx - b * my, math.sqrt(across)


@kernel(inline="always")
def _lies_on(all_sums: FloatArray, building: FloatArray, windows: _Windows) -> bool:
    """Whether the vertex at the middle lies on the plane of the others in a window, of which building is a part."""
    others, known = all_sums[0] - 1.0, building[0]
    if others < windows.min_points - 1 or known < _FEWEST or known < _LEAST_SHARE * others:
        return False
    # the vertex itself, at 0, adds to no sum but the number
    all_sums[0] = others
    level, across = _plane_at_middle(all_sums)
    return across <= windows.roughness and abs(level) <= windows.same


@kernel
def _judge(
    places: tuple[IntArray, IntArray, IntArray],
    building: BoolArray,
    used: BoolArray,
    wanted: BoolArray,
    windows: _Windows,
    verdict: KindArray,
) -> None:
    """Fill the wanted entries of `verdict` (n,) that are still -1, where a window of this scale holds enough vertices.

    `places` are x, y and z in mm, (n,) each; `used` are the vertices that count, `building` those of class 6.
    """
    x, y, z = places
    reach_mm = math.ceil(1.8 * windows.radius)
    start, members, column0, row0, columns, rows = points_by_cell(x, y, used, reach_mm)
    limit = windows.radius * windows.radius
    shift, diagonal = 0.8 * windows.radius, 0.566 * windows.radius
    shift_x = np.array([0.0, shift, diagonal, 0.0, -diagonal, -shift, -diagonal, 0.0, diagonal])
    shift_y = np.array([0.0, 0.0, diagonal, shift, diagonal, 0.0, -diagonal, -shift, -diagonal])
    sums, known = np.zeros((9, 10)), np.zeros((9, 10))
    for i in range(x.size):
        if not wanted[i] or verdict[i] >= 0:
            continue
        sums[:], known[:] = 0.0, 0.0
        corners = np.zeros(4, np.bool_)
        c, r = x[i] // reach_mm - column0, y[i] // reach_mm - row0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for m in range(start[rr * columns + max(c - 1, 0)], start[rr * columns + min(c + 1, columns - 1) + 1]):
                j = members[m]
                dx, dy, dz = float(x[j] - x[i]), float(y[j] - y[i]), float(z[j] - z[i])
                if abs(dz) > windows.level:
                    continue
                for w in range(9):
                    if (dx - shift_x[w]) ** 2 + (dy - shift_y[w]) ** 2 <= limit:
                        _add(sums[w], dx, dy, dz)
                        if building[j]:
                            _add(known[w], dx, dy, dz)
                            corners[2 * int(dx > 0.0) + int(dy > 0.0)] |= w == 0
        if sums[0, 0] < windows.min_points:
            continue
        verdict[i] = OnRoof.NO
        for w in range(9):
            if _lies_on(sums[w], known[w], windows):
                verdict[i] = OnRoof.YES
                break
        if verdict[i] == OnRoof.NO and corners.all() and known[0, 0] >= windows.min_points:
            level, _ = _plane_at_middle(known[0])
            if abs(level) <= windows.reach:
                verdict[i] = OnRoof.BESIDE


def undecided_on_roofs(
    places_mm: tuple[IntArray, IntArray, IntArray],
    building: BoolArray,
    used: BoolArray,
    wanted: BoolArray,
    settings: VegetationSettings,
    reach_m: float,
) -> KindArray:
    """`OnRoof` of each wanted vertex, (v,) int8; NO for all others.

    Parameters
    ----------
    places_mm : three arrays (v,) int64
        x, y and z of a scene's vertices.
    building, used, wanted : (v,) bool
        Vertices of class 6; those that stand above the ground and may be roof by their class; those to be judged.
    settings : VegetationSettings
        The windows: around the vertex and eight shifted ones, doubled up to twice until they hold enough vertices.
    reach_m : float
        Farthest from a roof that a vertex lies beside it.
    """
    verdict = np.where(wanted, np.int8(-1), np.int8(OnRoof.NO))
    for scale in range(PLANARITY_SCALES):
        windows = _Windows(
            radius=1000.0 * settings.radius_m * 2**scale,
            min_points=settings.min_neighbours,
            roughness=1000.0 * settings.roughness_m * 1.5**scale,
            same=1000.0 * _RESIDUALS * settings.roughness_m,
            level=1000.0 * settings.level_m,
            reach=1000.0 * reach_m,
        )
        _judge(places_mm, building, used, wanted, windows, verdict)
    return np.maximum(verdict, np.int8(OnRoof.NO))
