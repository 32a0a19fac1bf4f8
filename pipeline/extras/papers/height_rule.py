"""The Z_avg height rule of one building, as it is printed (Shorter and Kasparis, section 3.1).

Facets whose elevation difference reaches a threshold are walls; Z_avg is the mean of their highest vertices; a facet
can be roof only if its centre lies above Z_avg. The printed rule loses parts of a flat noisy roof, because roof facets
scatter about the mean of the wall tops, and it fails on slopes and for towers among houses. It serves the literal
recipe on a single building.
"""

from __future__ import annotations

import numpy as np

from pipeline.model import BoolArray, FloatArray, LabelArray


def facet_z_difference(z_m: FloatArray, facets: LabelArray) -> FloatArray:
    """MX_zdiff, (m,) metres: elevation difference of the highest and the lowest vertex of every facet."""
    corners = z_m[facets]
    return np.asarray(corners.max(axis=1) - corners.min(axis=1), dtype=np.float64)


def facet_z_highest(z_m: FloatArray, facets: LabelArray) -> FloatArray:
    """Z_mx: elevation of the highest vertex of every facet, (m,) float64 in metres; see `facet_z_difference`."""
    return np.asarray(z_m[facets].max(axis=1), dtype=np.float64)


def z_avg(z_highest_m: FloatArray, is_wall: BoolArray) -> float:
    """Z_avg: mean of Z_mx over the wall facets; a sum of whole millimetres, in any order of the facets.

    Z_mx (m,) are those of `facet_z_highest`, in metres. Minus infinity without walls: then every facet passes the rule.
    """
    count = int(np.count_nonzero(is_wall))
    if count == 0:
        return float("-inf")
    total_mm = int(np.rint(z_highest_m[is_wall] * 1000.0).astype(np.int64).sum())
    return total_mm / count / 1000.0


def facets_above_z_avg(z_m: FloatArray, facets: LabelArray, *, wall_height_m: float = 2.0) -> BoolArray:
    """Which facets (m, 3) over vertices at elevations (n,), metres, can be roof by the printed rule.

    A facet can if it is not a wall and its centre (mean of its vertices) lies above Z_avg; without walls all can. A
    wall has an elevation difference of `wall_height_m` or more.
    """
    is_wall = facet_z_difference(z_m, facets) >= wall_height_m
    threshold_m = z_avg(facet_z_highest(z_m, facets), is_wall)
    centre_z_m = z_m[facets].sum(axis=1) / 3.0
    return np.asarray(~is_wall & (centre_z_m > threshold_m))
