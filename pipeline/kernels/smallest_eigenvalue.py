"""The smallest eigenvalue of a symmetric matrix of three rows: the variance of points across their plane."""

from __future__ import annotations

import math

from pipeline.compiler import kernel


@kernel
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
