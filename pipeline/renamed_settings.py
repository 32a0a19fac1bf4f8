"""Settings that have another name now."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

RENAMED: Mapping[str, str] = MappingProxyType(
    {
        "absorption_max_m": "max_absorption_m",
        "absorption_max_slope_deg": "max_absorption_slope_deg",
        "absorption_min_m": "min_absorption_m",
        "distance_max_m": "max_distance_m",
        "distance_min_m": "min_distance_m",
        "ground_gap_min_m": "min_ground_gap_m",
        "growing_max_m": "max_growing_m",
        "growing_min_m": "min_growing_m",
        "least_area_m2": "min_area_m2",
        "least_area_sparse_m2": "min_area_sparse_m2",
        "least_members": "min_members",
        "least_plane_share": "min_plane_share",
        "least_points": "min_points",
        "least_side_share": "min_side_share",
        "least_slope_deg": "min_slope_deg",
        "least_step_m": "min_step_m",
        "linkage_least_deg": "min_linkage_deg",
        "maximum_overshoot_m": "max_overshoot_m",
        "maximum_points": "max_points",
        "minimum_clearance_m": "min_clearance_m",
        "minimum_face_area_m2": "min_face_area_m2",
        "minimum_face_spacings2": "min_face_spacings2",
        "minimum_part_area_m2": "min_part_area_m2",
        "minimum_points": "min_points",
        "minimum_points_in_footprint": "min_points_in_footprint",
        "minimum_roof_height_m": "min_roof_height_m",
        "minimum_void_m2": "min_void_m2",
        "most_clusters": "max_clusters",
        "most_coarse_clusters": "max_coarse_clusters",
        "most_least_points": "max_min_points",
        "most_slope_deg": "max_slope_deg",
        "plane_distance_max_m": "max_plane_distance_m",
        "plane_distance_min_m": "min_plane_distance_m",
        "scaled_minimum": "scaled_min",
    }
)
"""Old names of settings and their new ones, for the message that rejects the old name."""
