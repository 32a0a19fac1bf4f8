"""From rough clusters of points to roof planes: the end that Fuzzy SART and the robust form of k-means have in common.

Best-fit planes, merging and assignment anew; then once more with clusters that grow among the points that no plane
explains; at last straight ridges (Shorter and Kasparis, section 3.3).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.model import FloatArray, LabelArray
from pipeline.parameters import parameter
from pipeline.segmentation.leftover_planes import cluster_leftovers
from pipeline.segmentation.plane_refinement import PlaneRefinementSettings, refine_planes
from pipeline.segmentation.ridge_snapping import find_ridges, label_by_ridges

_MIN_DISTANCE_M = 1e-3
"""The grid of the points: no distance to a plane is less, also where settings and noise are 0."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinementSettings(PlaneRefinementSettings):
    """Settings of the common end; those of its stages are among them."""

    min_plane_distance_m: float = parameter(
        0.15, "Least distance up to which a point belongs to a plane.", unit="m", minimum=0.0, maximum=10.0
    )
    max_plane_distance_m: float = parameter(0.30, "Largest such distance.", unit="m", minimum=0.0, maximum=10.0)
    noise_factor: float = parameter(
        3.0,
        "Distances that follow the noise are this many standard deviations of it, within their bounds.",
        minimum=0.0,
        maximum=100.0,
    )
    neighbours: int = parameter(
        9, "Nearest points whose planes a point chooses among.", unit="points", minimum=3, maximum=64
    )
    leftover_rounds: int = parameter(
        2,
        "Rounds of refinement with clusters that grow among the points no plane explains; 0 for none (as the papers).",
        unit="rounds",
        minimum=0,
        maximum=50,
    )
    ridge_reach_spacings: float = parameter(
        1.5, "Distance in plan up to which points are near a ridge, in mean point spacings.", minimum=0.0, maximum=10.0
    )

    def cross_faults(self) -> list[str]:
        """The distance must be a range."""
        return [*super().cross_faults(), *self.range_faults("plane_distance")]

    def range_faults(self, name: str) -> list[str]:
        """What is wrong with a pair of bounds, `name` without its ending."""
        low, high = getattr(self, f"min_{name}_m"), getattr(self, f"max_{name}_m")
        return [f"min_{name}_m is {low:g}: use at most max_{name}_m, {high:g}"] if low > high else []

    def plane_distance_m(self, sigma_m: float) -> float:
        """Distance of a point from its plane for a noise; 1 mm, the grid of the points, is the least."""
        bounded = min(max(self.noise_factor * sigma_m, self.min_plane_distance_m), self.max_plane_distance_m)
        return max(bounded, _MIN_DISTANCE_M)


def planes_of_clusters(
    points: FloatArray,
    neighbours: LabelArray,
    rough: LabelArray,
    *,
    spacing_m: float,
    distance_m: float,
    settings: RefinementSettings,
) -> tuple[FloatArray, LabelArray]:
    """Roof planes of rough clusters, and the plane of every point.

    Parameters
    ----------
    points : (n, 3) float64
        Points that are visible from above, original elevations, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    rough : (n,) int32
        Cluster of every point, -1 for none.
    spacing_m : float
        Mean point spacing in plan.
    distance_m : float
        Up to which a point belongs to a plane: `settings.plane_distance_m` of the noise.
    settings : RefinementSettings
        All else.

    Returns
    -------
    planes : (k, 3) float64
        (a, b, c); every one has points.
    labels : (n,) int32
        Plane of every point, -1 for none.

    Raises
    ------
    BuildingError
        Reason ``too_complex`` beyond ``refinement_work_limit``.
    """
    fewest_points = settings.fewest_points(spacing_m)
    planes, labels = refine_planes(
        points, neighbours, rough, distance_m=distance_m, fewest_points=fewest_points, settings=settings
    )
    rough = cluster_leftovers(points, neighbours, labels, distance_m, fewest_points)
    if settings.leftover_rounds > 0 and (rough != labels).any():
        again = dataclasses.replace(settings, rounds=settings.leftover_rounds)
        planes, labels = refine_planes(
            points, neighbours, rough, distance_m=distance_m, fewest_points=fewest_points, settings=again
        )
    reach_m = settings.ridge_reach_spacings * spacing_m
    ridges = find_ridges(points, planes, labels, neighbours, distance_m=distance_m, reach_m=reach_m)
    labels = label_by_ridges(points, planes, labels, ridges, distance_m=distance_m, reach_m=reach_m)
    # a sliver along a ridge can lose all its points to the two sides: it is no plane any more
    kept = np.unique(labels[labels >= 0])
    return planes[kept], np.where(labels >= 0, np.searchsorted(kept, labels), -1).astype(np.int32)
