"""Arrangement: planes by noise and density, the plan cut by their lines, faces of least cost.

The recipe of METHOD `arrangement`: planes grow with thresholds that follow the noise and the density of the points
(`segmentation.adaptive_planes`); where roof faces meet is decided over the plan as a whole: ridges, hips, valleys and
steps cut the outline into cells, a minimum cut gives each cell its plane (`roof.arrangement`).
"""

from __future__ import annotations

import numpy as np

from pipeline.errors import BuildingError
from pipeline.geometry import point_spacing_m, top_visible
from pipeline.methods.local_frame import local_metres, plane_over_origin
from pipeline.model import Candidate, Reason, Segmentation
from pipeline.segmentation.adaptive_planes import detect_planes
from pipeline.segmentation.plane_refinement import describe_planes
from pipeline.segmentation.plane_settings import AdaptivePlaneSettings


def segment(candidate: Candidate, settings: AdaptivePlaneSettings) -> Segmentation:
    """Find the roof planes of one building.

    Points that a higher point of the building hides take no part and keep the label -1, as do points that no plane
    explains.

    Parameters
    ----------
    candidate : Candidate
        Its points.
    settings : AdaptivePlaneSettings
        Thresholds.

    Returns
    -------
    Segmentation
        Without planes where the points are nowhere flat.

    Raises
    ------
    BuildingError
        Reason ``too_few_points`` below the fewest points of a plane.
    """
    points, shift = local_metres(candidate.points)
    visible = np.flatnonzero(top_visible(points))
    roof = points[visible]
    if len(roof) < settings.min_points:
        raise BuildingError(
            Reason.TOO_FEW_POINTS,
            f"{len(roof)} of {len(points)} points are visible from above, min_points is {settings.min_points}",
        )
    found = detect_planes(roof, point_spacing_m(roof), settings)
    labels = np.full(len(points), -1, np.int32)
    labels[visible] = found.labels
    described = describe_planes(points, found.coefficients, labels)
    return Segmentation(planes=tuple(plane_over_origin(plane, shift) for plane in described), labels=labels)
