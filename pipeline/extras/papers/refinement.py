"""From rough clusters of points to roof planes: the last steps of Fuzzy SART and of the robust form of k-means.

Best-fit planes, merging and reassignment; then once more with clusters that grow among the points that no plane
explains; at last straight ridges (Shorter and Kasparis, section 3.3).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.extras.papers.leftover_planes import cluster_leftovers
from pipeline.extras.papers.ridge_snapping import find_ridges, label_by_ridges
from pipeline.model import FloatArray, LabelArray
from pipeline.segmentation.plane_refinement import refine_planes
from pipeline.segmentation.refinement_settings import PlaneRefinementSettings


def planes_of_clusters(
    points: FloatArray,
    neighbours: LabelArray,
    rough: LabelArray,
    *,
    spacing_m: float,
    distance_m: float,
    settings: PlaneRefinementSettings,
) -> tuple[FloatArray, LabelArray]:
    """Roof planes (a, b, c) of rough clusters, (k, 3), each with points, and the plane of every point, (n,) int32.

    Parameters
    ----------
    points : (n, 3) float64
        Points that are visible from above, original elevations, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    rough : (n,) int32
        Cluster of every point, -1 for none, as in the result.
    spacing_m : float
        Mean point spacing in plan.
    distance_m : float
        Up to which a point belongs to a plane: `settings.plane_distance_m` of the noise.

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
    # a sliver along a ridge can lose all its points to the two sides and is then dropped
    kept = np.unique(labels[labels >= 0])
    return planes[kept], np.where(labels >= 0, np.searchsorted(kept, labels), -1).astype(np.int32)
