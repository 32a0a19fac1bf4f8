"""The points of a candidate as all later steps take them: in whole millimetres, those that see the sky marked."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.geometry import top_visible
from pipeline.model import Candidate, FloatArray, IntArray, PreparedCloud, Reason
from pipeline.tin.delaunay import unique_xy_ranked

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
    in_mm, points, shift_m = _about_corner(candidate.points)
    visible = np.flatnonzero(top_visible(points, SHADING_RADIUS_M, SHADING_HEIGHT_M))
    highest = visible
    seen_mm = in_mm.take(visible, axis=0)
    if not _ascend(seen_mm):  # they mostly do: points are in canonical order
        kept, _, rank = unique_xy_ranked(seen_mm[:, :2], seen_mm[:, 2])
        highest = visible[kept[np.argsort(rank)]]
    return PreparedCloud(
        candidate=candidate,
        shift_m=shift_m,
        points_mm=in_mm,
        points=points,
        visible=visible,
        highest=highest,
    )


@kernel
def _about_corner(points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points (n, 3) about a corner (3,) in whole metres below all, in whole mm and in metres; the corner, metres."""
    in_mm = np.empty(points.shape, np.int64)
    for i in range(len(points)):
        for k in range(3):
            in_mm[i, k] = int(np.rint(points[i, k] * 1000.0))
    shift = np.zeros(3)
    for k in range(3):
        if len(points) > 0:
            corner = in_mm[:, k].min() // 1000
            in_mm[:, k] -= corner * 1000
            shift[k] = corner
    return in_mm, in_mm / 1000.0, shift


@kernel
def _ascend(xyz_mm: IntArray) -> bool:
    """Whether points (n, 3) ascend by x, then by y, so that no two are at one position in plan."""
    for i in range(1, len(xyz_mm)):
        step = xyz_mm[i, 0] - xyz_mm[i - 1, 0]
        if step < 0 or (step == 0 and xyz_mm[i, 1] <= xyz_mm[i - 1, 1]):
            return False
    return True


def require_visible(cloud: PreparedCloud, index: IntArray, fewest: int, rule: str) -> None:
    """Raise ``too_few_points`` where `index` holds fewer points of a cloud than a rule, "min_points is 6", asks for."""
    if len(index) < fewest:
        found = f"{len(index)} of {len(cloud.points)} points are visible from above"
        raise BuildingError(Reason.TOO_FEW_POINTS, f"{found}, {rule}")
