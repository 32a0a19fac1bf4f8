"""The points of a candidate as all later steps take them: in whole millimetres, those that see the sky marked."""

from __future__ import annotations

import numpy as np

from pipeline.errors import BuildingError
from pipeline.geometry import top_visible
from pipeline.model import Candidate, IntArray, PreparedCloud, Reason
from pipeline.tin.delaunay import unique_xy

SHADING_RADIUS_M, SHADING_HEIGHT_M = 0.5, 1.1
"""A point with another this much higher within this distance in plan is hidden: a facade, a return from below the roof.
A definition that methods, solids and the ruler share."""


def prepare_cloud(candidate: Candidate, max_points: int | None = None) -> PreparedCloud:
    """Prepare the points of a candidate; without any the cloud is empty.

    Raises BuildingError ``too_complex`` for more points than `max_points`, ValueError where a coordinate is not finite.
    """
    if not np.isfinite(candidate.points).all():
        raise ValueError("a point of the candidate has a coordinate that is not finite")
    if max_points is not None and len(candidate.points) > max_points:
        raise BuildingError(Reason.TOO_COMPLEX, f"{len(candidate.points)} points, more than max_points = {max_points}")
    in_mm = np.rint(candidate.points * 1000.0).astype(np.int64)
    shift_m = in_mm.min(axis=0) // 1000 if len(in_mm) else np.zeros(3, np.int64)
    in_mm -= shift_m * 1000
    points = in_mm / 1000.0
    visible = np.flatnonzero(top_visible(points, SHADING_RADIUS_M, SHADING_HEIGHT_M))
    highest, _ = unique_xy(in_mm[visible, :2], in_mm[visible, 2])
    return PreparedCloud(
        candidate=candidate,
        shift_m=shift_m.astype(np.float64),
        points_mm=in_mm,
        points=points,
        visible=visible,
        highest=visible[highest],
    )


def require_visible(cloud: PreparedCloud, index: IntArray, fewest: int, rule: str) -> None:
    """Raise ``too_few_points`` where `index` holds fewer points of a cloud than a rule, "min_points is 6", asks for."""
    if len(index) < fewest:
        found = f"{len(index)} of {len(cloud.points)} points are visible from above"
        raise BuildingError(Reason.TOO_FEW_POINTS, f"{found}, {rule}")
