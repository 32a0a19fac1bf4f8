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
    """MX_zdiff: elevation difference of the two vertices of a facet that lie farthest apart in elevation.

    Parameters
    ----------
    z_m : (n,) float64
        Elevation of the vertices, metres.
    facets : (m, 3) int
        Vertex indices.

    Returns
    -------
    (m,) float64
        Metres, at least 0.
    """
    corners = z_m[facets]
    return np.asarray(corners.max(axis=1) - corners.min(axis=1), dtype=np.float64)


def facet_z_highest(z_m: FloatArray, facets: LabelArray) -> FloatArray:
    """Z_mx: elevation of the highest vertex of every facet, (m,) float64 in metres; see `facet_z_difference`."""
    return np.asarray(z_m[facets].max(axis=1), dtype=np.float64)


def z_avg(z_highest_m: FloatArray, is_wall: BoolArray) -> float:
    """Z_avg: mean of Z_mx over the wall facets; a sum of whole millimetres, in any order of the facets.

    Parameters
    ----------
    z_highest_m : (m,) float64
        As `facet_z_highest` gives it.
    is_wall : (m,) bool
        True for wall facets.

    Returns
    -------
    float
        Metres; minus infinity without walls: then every facet passes the rule.
    """
    count = int(np.count_nonzero(is_wall))
    if count == 0:
        return float("-inf")
    total_mm = int(np.rint(z_highest_m[is_wall] * 1000.0).astype(np.int64).sum())
    return total_mm / count / 1000.0


def facets_above_z_avg(z_m: FloatArray, facets: LabelArray, *, wall_height_m: float = 2.0) -> BoolArray:
    """Which facets can be roof by the printed rule.

    Parameters
    ----------
    z_m : (n,) float64
        Elevation of the vertices, metres.
    facets : (m, 3) int
        Vertex indices.
    wall_height_m : float
        Elevation difference from which a facet is a wall.

    Returns
    -------
    (m,) bool
        True if the facet is not a wall and its centre (mean of its vertices) lies above Z_avg; all facets without
        walls.
    """
    is_wall = facet_z_difference(z_m, facets) >= wall_height_m
    threshold_m = z_avg(facet_z_highest(z_m, facets), is_wall)
    centre_z_m = z_m[facets].sum(axis=1) / 3.0
    return np.asarray(~is_wall & (centre_z_m > threshold_m))
