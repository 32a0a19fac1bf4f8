"""Shared by the recipes that triangulate a building: the extent of a TIN, and the terrain beside the building."""

from __future__ import annotations

import math

import numpy as np

from pipeline.errors import BuildingError
from pipeline.extras.papers.surrounding_ground import far_from
from pipeline.model import FloatArray, PreparedCloud, Reason
from pipeline.tin.predicates import MAX_EXTENT_MM

MAX_EXTENT_M = MAX_EXTENT_MM / 1000.0 - 10.0
"""The TIN's limit, less its margins."""


def check_extent(points: FloatArray) -> None:
    """Raise BuildingError ``too_complex`` if points (n, 3) extend over more than `MAX_EXTENT_M`."""
    extent_m = float(np.ptp(points[:, :2], axis=0).max())
    if extent_m > MAX_EXTENT_M:
        raise BuildingError(
            Reason.TOO_COMPLEX, f"the candidate extends over {extent_m:.0f} m, a TIN over at most {MAX_EXTENT_M:.0f} m"
        )


def ground_around(cloud: PreparedCloud, roof: FloatArray, gap_m: float, reach_m: float = math.inf) -> FloatArray:
    """Samples of the terrain beside the building and in its courtyards, (k, 3) metres, in their order.

    They and the roof points (n, 3), at least one, are about the origin of the cloud. Samples nearer in plan to a roof
    point than `gap_m` are beneath the roof, and left out; so are those farther than `reach_m` from every roof point.
    """
    moved = (np.rint(cloud.candidate.ground * 1000.0) - cloud.shift_m * 1000.0) / 1000.0
    beside = far_from(moved, roof, gap_m)
    if math.isfinite(reach_m):
        beside &= ~far_from(moved, roof, reach_m) if reach_m > gap_m else False
    return np.asarray(moved[beside])
