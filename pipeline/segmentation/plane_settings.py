"""Settings of the steps that find planes in points. No kernels here: settings are read without them."""

from __future__ import annotations

import math

from pipeline.parameters import Parameters, parameter

MIN_PLANE_POINTS = 5
"""Fewest points of any plane of `adaptive_planes`: a plane has three parameters, so four points often fit by chance."""


class AdaptivePlaneSettings(Parameters):
    """Settings of the detection."""

    noises: float = parameter(
        3.0,
        "Distance up to which a point belongs to a plane, in standard deviations of the noise.",
        minimum=0.5,
        maximum=20.0,
    )
    min_distance_m: float = parameter(
        0.15,
        "Least such distance: tiles, gutters and sag keep a roof from being plane to less.",
        unit="m",
        minimum=0.001,
        maximum=10.0,
    )
    max_distance_m: float = parameter(0.35, "Largest such distance.", unit="m", minimum=0.001, maximum=10.0)
    min_area_m2: float = parameter(
        1.3, "Least area of a plane in plan where points are dense.", unit="m2", minimum=0.0, maximum=1e4
    )
    min_area_sparse_m2: float = parameter(
        10.0,
        "Largest area that is required of a plane, however sparse the points.",
        unit="m2",
        minimum=0.0,
        maximum=1e4,
    )
    min_points: int = parameter(
        6, "Fewest points of a plane where the larger area holds as many.", unit="points", minimum=5, maximum=10_000
    )
    max_slope_deg: float = parameter(
        75.0, "Planes steeper than this are not roof.", unit="deg", minimum=1.0, maximum=89.0
    )
    normal_angle_deg: float = parameter(
        30.0,
        "Largest angle between a plane and the plane of a point's neighbours, where points are dense and clean enough.",
        unit="deg",
        minimum=1.0,
        maximum=89.0,
    )

    def cross_faults(self) -> list[str]:
        """Bounds must be ranges."""
        return [
            *super().cross_faults(),
            *self.range_faults("min_distance_m", "max_distance_m"),
            *self.range_faults("min_area_m2", "min_area_sparse_m2"),
        ]

    def fewest_points(self, spacing_m: float) -> int:
        """Fewest points of a plane for a spacing.

        Examples
        --------
        >>> [AdaptivePlaneSettings().fewest_points(spacing_m) for spacing_m in (0.25, 0.7, 1.0, 1.6)]
        [21, 6, 6, 5]
        """
        cell_m2 = spacing_m * spacing_m
        asked = max(self.min_area_m2 / cell_m2, min(self.min_points, self.min_area_sparse_m2 / cell_m2))
        return max(MIN_PLANE_POINTS, math.ceil(asked))
