"""Evidence for vegetation: how planar the surroundings of a vertex are, and how much canopy hangs above it.

Roofs are locally planar; crowns are not, and pulses reach through them. Both measures look a fixed
distance and use integer sums, so they are the same in every tile.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numba import njit

from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.parameters import Parameters, parameter
from pipeline.terrain.binning import points_by_cell

_SCALES = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class VegetationSettings(Parameters):
    """How local planarity is measured."""

    radius_m: float = parameter(
        1.0,
        "Radius of the windows that judge planarity; doubled up to twice where they hold too few points.",
        unit="m",
        minimum=0.3,
        maximum=5.0,
    )
    min_neighbours: int = parameter(6, "Fewest points in a window for a judgement.", minimum=4, maximum=50)
    roughness_m: float = parameter(
        0.1,
        "Largest orthogonal standard deviation of a planar window; half as much again at each doubling.",
        unit="m",
        minimum=0.02,
        maximum=1.0,
    )
    level_m: float = parameter(
        2.0,
        "Points this far above or below a vertex lie across a wall and do not judge it.",
        unit="m",
        minimum=0.5,
        maximum=20.0,
    )
    company_m: float = parameter(
        2.0,
        "Radius of the sphere around a vertex whose verdicts say together whether it is roof or crown.",
        unit="m",
        minimum=0.5,
        maximum=5.0,
    )
    crown_share: float = parameter(
        0.5, "Share of rough vertices in that sphere above which a vertex belongs to a crown.", minimum=0.1, maximum=1.0
    )
    pierced_share: float = parameter(
        0.1,
        "Share of vertices from pulses of several returns in that sphere, above which it may be a crown's.",
        minimum=0.0,
        maximum=1.0,
    )
    canopy_m: float = parameter(
        1.0, "Earlier returns this far above the surface of last returns are canopy.", unit="m", minimum=0.3, maximum=5
    )

    @property
    def support_m(self) -> float:
        """How far the judgement looks: the shifted windows of the widest scale, around the vertices of a sphere."""
        return 2.0 * self.radius_m * 2.0 ** (_SCALES - 1) + self.company_m


@njit(cache=True, nogil=True)
def smallest_eigenvalue(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """Smallest eigenvalue of a symmetric 3 x 3 matrix (trigonometric form, Smith 1961)."""
    q = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    p2 = (xx - q) ** 2 + (yy - q) ** 2 + (zz - q) ** 2 + 2.0 * off
    if p2 <= 1e-30:
        return q
    p = math.sqrt(p2 / 6.0)
    a, b, c = (xx - q) / p, (yy - q) / p, (zz - q) / p
    d, e, f = xy / p, xz / p, yz / p
    half_det = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2.0
    half_det = min(1.0, max(-1.0, half_det))
    return max(0.0, q + 2.0 * p * math.cos(math.acos(half_det) / 3.0 + 2.0 * math.pi / 3.0))


@njit(cache=True, nogil=True)
def _add_moments(s: IntArray, dx: int, dy: int, dz: int) -> None:
    """Count one neighbour: its number and its moments of first and second order."""
    s[0] += 1
    s[1] += dx
    s[2] += dy
    s[3] += dz
    s[4] += dx * dx
    s[5] += dx * dy
    s[6] += dx * dz
    s[7] += dy * dy
    s[8] += dy * dz
    s[9] += dz * dz


@njit(cache=True, nogil=True)
def _spread_mm2(s: IntArray) -> float:
    """Variance of the counted neighbours across the plane that fits them best."""
    count = s[0]
    mx, my, mz = s[1] / count, s[2] / count, s[3] / count
    return smallest_eigenvalue(
        s[4] / count - mx * mx,
        s[5] / count - mx * my,
        s[6] / count - mx * mz,
        s[7] / count - my * my,
        s[8] / count - my * mz,
        s[9] / count - mz * mz,
    )


@njit(cache=True, nogil=True)
def _planar(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    wanted: BoolArray,
    radius_mm: int,
    min_points: int,
    roughness_mm: float,
    level_mm: int,
    out: KindArray,
) -> None:
    """Kernel for one scale: fills the wanted entries of out that are still -1 with 1 (planar) or 0 (rough)."""
    n = x_mm.size
    if n == 0:
        return
    shift = 4 * radius_mm // 5
    diagonal = 566 * radius_mm // 1000
    shift_x = np.array([0, shift, diagonal, 0, -diagonal, -shift, -diagonal, 0, diagonal])
    shift_y = np.array([0, 0, diagonal, shift, diagonal, 0, -diagonal, -shift, -diagonal])
    limit = radius_mm * radius_mm
    cell = 2 * radius_mm
    start, members, column0, row0, columns, rows = points_by_cell(x_mm, y_mm, np.ones(n, np.bool_), cell)
    # copies in the order of the cells: three neighbouring cells of a row are one run of memory
    px, py, pz = x_mm[members], y_mm[members], z_mm[members]
    sums = np.empty((9, 10), np.int64)
    planar_mm2 = roughness_mm * roughness_mm
    for i in range(n):
        if out[i] >= 0 or not wanted[i]:
            continue
        c, r = x_mm[i] // cell - column0, y_mm[i] // cell - row0
        west, east = max(c - 1, 0), min(c + 1, columns - 1)
        # the window in the middle alone first: where it is planar the eight others cannot change the verdict
        s = sums[0]
        s[:] = 0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for m in range(start[rr * columns + west], start[rr * columns + east + 1]):
                dx, dy, dz = px[m] - x_mm[i], py[m] - y_mm[i], pz[m] - z_mm[i]
                if dx * dx + dy * dy <= limit and abs(dz) <= level_mm:
                    _add_moments(s, dx, dy, dz)
        if s[0] < min_points:
            continue
        if _spread_mm2(s) <= planar_mm2:
            out[i] = 1
            continue
        sums[1:] = 0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for m in range(start[rr * columns + west], start[rr * columns + east + 1]):
                dx, dy, dz = px[m] - x_mm[i], py[m] - y_mm[i], pz[m] - z_mm[i]
                if dx * dx + dy * dy > 4 * limit or abs(dz) > level_mm:  # beyond all windows
                    continue
                for w in range(1, 9):
                    ex, ey = dx - shift_x[w], dy - shift_y[w]
                    if ex * ex + ey * ey <= limit:
                        _add_moments(sums[w], dx, dy, dz)
        out[i] = 0
        for w in range(1, 9):
            if sums[w, 0] >= min_points and _spread_mm2(sums[w]) <= planar_mm2:
                out[i] = 1
                break


def planarity(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, wanted: BoolArray, settings: VegetationSettings
) -> KindArray:
    """Whether the surroundings of each vertex are planar.

    A vertex is judged by the most planar of nine windows: one around it and eight shifted by 0.8 of
    the radius, as edge-preserving filters do (Nagao and Matsuyama 1979), since every point near a
    ridge or an eave has a planar side.

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Thinned points in millimetres.
    wanted : (n,) bool
        The vertices to be judged; all within `level_m` in elevation are neighbours.
    settings : VegetationSettings
        Radius and the largest roughness.

    Returns
    -------
    (n,) int8
        1 planar, 0 rough, -1 where it was not wanted or there are too few neighbours to tell.
    """
    verdict = np.full(len(x_mm), -1, np.int8)
    for scale in range(_SCALES):
        _planar(
            x_mm,
            y_mm,
            z_mm,
            wanted,
            round(settings.radius_m * 1000) * 2**scale,
            settings.min_neighbours,
            settings.roughness_m * 1000.0 * 1.5**scale,
            round(settings.level_m * 1000),
            verdict,
        )
    return verdict


@njit(cache=True, nogil=True)
def _crowns(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    planar: KindArray,
    several: BoolArray,
    radius_mm: int,
    crown_share: float,
    pierced_share: float,
) -> BoolArray:
    """Kernel of `crowns`."""
    n = x_mm.size
    out = np.zeros(n, np.bool_)
    limit = radius_mm * radius_mm
    if n == 0:
        return out
    start, members, column0, row0, columns, rows = points_by_cell(x_mm, y_mm, np.ones(n, np.bool_), radius_mm)
    for i in range(n):
        if planar[i] < 0:
            continue
        c, r = x_mm[i] // radius_mm - column0, y_mm[i] // radius_mm - row0
        west, east = max(c - 1, 0), min(c + 1, columns - 1)
        judged, rough, pierced = 0, 0, 0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for m in range(start[rr * columns + west], start[rr * columns + east + 1]):
                j = members[m]
                if planar[j] < 0:
                    continue
                dx, dy, dz = x_mm[j] - x_mm[i], y_mm[j] - y_mm[i], z_mm[j] - z_mm[i]
                if dx * dx + dy * dy + dz * dz <= limit:
                    judged += 1
                    rough += planar[j] == 0
                    pierced += several[j]
        out[i] = rough > crown_share * judged and pierced > pierced_share * judged
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

    A chimney on a roof is rough and stays with the roof; a flat patch in a crown is planar and stays with the crown;
    and a crown that leans on a roof is cut from it. The sphere counts neighbours on the vertex's own level alone.
    Rough roofs with superstructures return most pulses once, crowns do not. Where a file knows single returns only,
    nothing is a crown, and whole surfaces are judged by their shape alone.

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Thinned points in millimetres.
    planar : (n,) int8
        Verdicts of `planarity`.
    several : (n,) bool
        The vertex comes from a pulse of several returns.
    settings : VegetationSettings
        `company_m`, `crown_share` and `pierced_share`.

    Returns
    -------
    (n,) bool
        False where there was no verdict.
    """
    radius_mm = round(settings.company_m * 1000)
    mask: BoolArray = _crowns(
        x_mm, y_mm, z_mm, planar, several, radius_mm, settings.crown_share, settings.pierced_share
    )
    return mask
