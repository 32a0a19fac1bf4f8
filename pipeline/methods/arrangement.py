"""Arrangement: planes by noise and density, the plan cut by their lines, faces of least cost.

The recipe of METHOD `arrangement`: planes grow with thresholds that follow the noise and the density of the points
(`segmentation.adaptive_planes`); where roof faces meet is decided over the plan as a whole: ridges, hips, valleys and
steps cut the outline into cells, a minimum cut gives each cell its plane (`roof.arrangement`).
"""

from __future__ import annotations

from pipeline.geometry import point_spacing_m
from pipeline.model import PreparedCloud, Segmentation
from pipeline.prepared_cloud import require_visible
from pipeline.segmentation.adaptive_planes import detect_planes
from pipeline.segmentation.plane_regression import describe_planes
from pipeline.segmentation.plane_settings import AdaptivePlaneSettings


def segment(cloud: PreparedCloud, settings: AdaptivePlaneSettings) -> Segmentation:
    """Find the roof planes of one building; none where the points are nowhere flat.

    Points that a higher point of the building hides take no part and keep the label -1, as do points that no plane
    explains. Raises BuildingError ``too_few_points`` below the fewest points of a plane.
    """
    require_visible(cloud, cloud.visible, settings.min_points, f"min_points is {settings.min_points}")
    roof = cloud.points[cloud.visible]
    found = detect_planes(roof, point_spacing_m(roof), settings)
    return cloud.segmentation(describe_planes(roof, found.coefficients, found.labels), cloud.visible, found.labels)
