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
    canopy_m: float = parameter(
        1.0, "Earlier returns this far above the surface of last returns are canopy.", unit="m", minimum=0.3, maximum=5
    )

    @property
    def support_m(self) -> float:
        """How far the judgement looks: the shifted windows of the widest scale."""
        return 2.0 * self.radius_m * 2.0 ** (_SCALES - 1)


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
def _planar(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    wanted: BoolArray,
    radius_mm: int,
    min_points: int,
    roughness_mm: float,
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
    column0, row0 = x_mm.min() // cell, y_mm.min() // cell
    columns, rows = x_mm.max() // cell - column0 + 1, y_mm.max() // cell - row0 + 1
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        start[(y_mm[i] // cell - row0) * columns + x_mm[i] // cell - column0 + 1] += 1
    for k in range(columns * rows):
        start[k + 1] += start[k]
    position = start[:-1].copy()
    members = np.empty(n, np.int64)
    for i in range(n):
        k = (y_mm[i] // cell - row0) * columns + x_mm[i] // cell - column0
        members[position[k]] = i
        position[k] += 1
    sums = np.empty((9, 10), np.int64)
    for i in range(n):
        if out[i] >= 0 or not wanted[i]:
            continue
        c, r = x_mm[i] // cell - column0, y_mm[i] // cell - row0
        sums[:] = 0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                for m in range(start[rr * columns + cc], start[rr * columns + cc + 1]):
                    j = members[m]
                    dx, dy, dz = x_mm[j] - x_mm[i], y_mm[j] - y_mm[i], z_mm[j] - z_mm[i]
                    for w in range(9):
                        ex, ey = dx - shift_x[w], dy - shift_y[w]
                        if ex * ex + ey * ey > limit:
                            continue
                        s = sums[w]
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
        if sums[0, 0] < min_points:
            continue
        best = 1e30
        for w in range(9):
            s = sums[w]
            count = s[0]
            if count < min_points:
                continue
            mx, my, mz = s[1] / count, s[2] / count, s[3] / count
            eigenvalue = smallest_eigenvalue(
                s[4] / count - mx * mx,
                s[5] / count - mx * my,
                s[6] / count - mx * mz,
                s[7] / count - my * my,
                s[8] / count - my * mz,
                s[9] / count - mz * mz,
            )
            best = min(best, eigenvalue)
        out[i] = 1 if best <= roughness_mm * roughness_mm else 0


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
        The vertices to be judged; all are neighbours.
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
            verdict,
        )
    return verdict
