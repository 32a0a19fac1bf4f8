"""From the rough clusters of a TIN to the roof planes of its points (Shorter and Kasparis, section 3.3).

Each round fits planes to the clusters on the *original* elevations, merges clusters of one plane, reassigns points to
the planes around them, and absorbs outliers. The paper describes these steps without their thresholds, which are
settings here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.model import BoolArray, FloatArray, LabelArray, Reason
from pipeline.segmentation.plane_merge import merge_planes, parallel_pairs_in_reach
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums, cosine_of_slope
from pipeline.segmentation.point_votes import (
    dissolve_redundant,
    distance_to_plane,
    touching_pairs,
    vote_among_neighbours,
)
from pipeline.segmentation.refinement_settings import PlaneRefinementSettings

_MIN_SEED_POINTS = 4
"""In the first round a cluster may still be small: its points have not been assigned by planes yet."""


def refine_planes(
    points: FloatArray,
    neighbours: LabelArray,
    labels: LabelArray,
    *,
    distance_m: float,
    fewest_points: int,
    settings: PlaneRefinementSettings,
) -> tuple[FloatArray, LabelArray]:
    """Turn rough clusters into planes, and give every point the plane that explains it.

    Parameters
    ----------
    points : (n, 3) float64
        Roof points with their original elevation, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    labels : (n,) int32
        Rough cluster of every point, -1 for none.
    distance_m : float
        Largest perpendicular distance of a point to its plane.
    fewest_points : int
        Planes of fewer points are dropped.

    Returns
    -------
    planes : (k, 3) float64
        (a, b, c) of z = a x + b y + c, ordered by their first point; empty where no cluster has a plane.
    labels : (n,) int32
        Plane of every point, -1 where no plane near it explains it.

    Raises
    ------
    BuildingError
        Reason ``too_complex`` beyond ``refinement_work_limit``.
    """
    n_clusters = int(labels.max()) + 1 if len(labels) else 0
    if n_clusters == 0:
        return np.zeros((0, 3)), np.full(len(labels), -1, np.int32)
    planes, refined, work = _refine(
        np.ascontiguousarray(points),
        np.ascontiguousarray(neighbours, dtype=np.int32),
        labels.astype(np.int32),
        n_clusters,
        _Rules(
            distance_m=distance_m,
            fewest_points=fewest_points,
            rounds=settings.rounds,
            voting_passes=settings.voting_passes,
            vote_weight=settings.vote_weight,
            all_planes=settings.assignment == "all_planes",
            min_cosine=math.cos(math.radians(settings.max_slope_deg)),
            outlier_factor=settings.outlier_factor,
            merge_residual_m=settings.merge_residual_m,
            merge_angle_deg=settings.merge_angle_deg,
            small_cluster_points=settings.small_cluster_points,
            merge_reach_m=settings.merge_reach_m,
            plane_cost=settings.plane_cost,
            work_limit=settings.refinement_work_limit,
        ),
    )
    if work > settings.refinement_work_limit:
        raise BuildingError(
            Reason.TOO_COMPLEX,
            f"the refinement stood at {work} comparisons for {n_clusters} clusters of {len(points)} points, "
            f"refinement_work_limit is {settings.refinement_work_limit}",
        )
    return planes, refined


class _Rules(NamedTuple):
    """`PlaneRefinementSettings` at a density of points."""

    distance_m: float
    fewest_points: int
    rounds: int
    voting_passes: int
    vote_weight: float
    all_planes: bool
    min_cosine: float
    outlier_factor: float
    merge_residual_m: float
    merge_angle_deg: float
    small_cluster_points: int
    merge_reach_m: float
    plane_cost: float
    work_limit: int


@kernel
def _refine(
    points: FloatArray, neighbours: LabelArray, labels: LabelArray, n_clusters: int, rules: _Rules
) -> tuple[FloatArray, LabelArray, int]:
    """Planes, labels and work; incomplete once the work passes the limit."""
    planes = np.zeros((n_clusters, 3))
    usable = np.zeros(n_clusters, np.bool_)
    parallel_cosine = math.cos(math.radians(rules.merge_angle_deg))
    work = 0
    for round_ in range(rules.rounds):
        fewest = rules.fewest_points if round_ > 0 else min(rules.fewest_points, _MIN_SEED_POINTS)
        sums = cluster_sums(points, labels, n_clusters)
        _fit_all(sums, planes, usable, fewest, rules.min_cosine)
        _drop_outliers(points, labels, planes, usable, rules.outlier_factor * rules.distance_m)
        sums = cluster_sums(points, labels, n_clusters)
        _fit_all(sums, planes, usable, min(fewest, _MIN_SEED_POINTS), rules.min_cosine)
        pairs = touching_pairs(neighbours, labels, usable)
        if rules.merge_reach_m > 0.0:
            settled = usable & (sums[:, 0] >= rules.fewest_points)
            distant, looks = parallel_pairs_in_reach(
                points, labels, planes, settled, rules.merge_reach_m, parallel_cosine, rules.work_limit
            )
            work += looks
            pairs = np.unique(np.concatenate((pairs, distant)))
        root, comparisons = merge_planes(
            sums,
            planes,
            pairs,
            rules.merge_residual_m,
            rules.merge_angle_deg,
            rules.small_cluster_points,
            rules.work_limit,
        )
        work += comparisons
        for i in range(labels.size):
            if labels[i] >= 0:
                labels[i] = root[labels[i]]
        for k in range(n_clusters):
            usable[k] = usable[k] and root[k] == k
        if rules.all_planes:
            work += labels.size * int(usable.sum())
        if work > rules.work_limit:
            return planes, labels, work
        if rules.all_planes:
            labels = nearest_plane(points, planes, usable, rules.distance_m)
        else:
            if round_ > 0:
                dissolve_redundant(points, neighbours, labels, planes, usable, rules.distance_m, rules.plane_cost, 0.0)
            labels = vote_among_neighbours(
                points, neighbours, labels, planes, usable, rules.distance_m, rules.vote_weight, rules.voting_passes
            )
    sums = cluster_sums(points, labels, n_clusters)
    _fit_all(sums, planes, usable, rules.fewest_points, rules.min_cosine)
    if not rules.all_planes:
        dissolve_redundant(points, neighbours, labels, planes, usable, rules.distance_m, rules.plane_cost, 0.0)
        labels = vote_among_neighbours(
            points, neighbours, labels, planes, usable, rules.distance_m, rules.vote_weight, rules.voting_passes
        )
    planes, labels = _renumber(points, labels, planes, usable)
    return planes, labels, work


@kernel
def _fit_all(sums: FloatArray, planes: FloatArray, usable: BoolArray, fewest: int, min_cosine: float) -> None:
    """Best-fit plane of every cluster, in place; usable where it has points enough and is not too steep."""
    for k in range(sums.shape[0]):
        a, b, c, fitted = best_fit_plane(sums[k])
        planes[k, 0] = a
        planes[k, 1] = b
        planes[k, 2] = c
        usable[k] = fitted and sums[k, 0] >= fewest and cosine_of_slope(a, b) >= min_cosine


@kernel
def _drop_outliers(
    points: FloatArray, labels: LabelArray, planes: FloatArray, usable: BoolArray, limit_m: float
) -> None:
    """Take the label from points that are far from their plane or have none, in place."""
    for i in range(labels.size):
        k = labels[i]
        if k >= 0 and (not usable[k] or distance_to_plane(points, i, planes, k) > limit_m):
            labels[i] = -1


@kernel
def _renumber(
    points: FloatArray, labels: LabelArray, planes: FloatArray, usable: BoolArray
) -> tuple[FloatArray, LabelArray]:
    """Usable planes fitted to their final points, numbered by their first point."""
    number = np.full(usable.size, -1, np.int32)
    count = 0
    for i in range(labels.size):
        k = labels[i]
        if k >= 0 and not usable[k]:
            labels[i] = -1
        elif k >= 0:
            if number[k] < 0:
                number[k] = count
                count += 1
            labels[i] = number[k]
    sums = cluster_sums(points, labels, count)
    fitted = np.zeros((count, 3))
    for k in range(usable.size):
        m = number[k]
        if m < 0:
            continue
        a, b, c, good = best_fit_plane(sums[m])
        fitted[m, 0] = a if good else planes[k, 0]
        fitted[m, 1] = b if good else planes[k, 1]
        fitted[m, 2] = c if good else planes[k, 2]
    return fitted, labels


@kernel
def nearest_plane(points: FloatArray, planes: FloatArray, usable: BoolArray, distance_m: float) -> LabelArray:
    """The nearest of all planes within the distance: the paper's merging of points with planes.

    Returns (n,) int32, -1 for none; parameters as for `vote_among_neighbours`.
    """
    labels = np.full(points.shape[0], -1, np.int32)
    for i in range(points.shape[0]):
        least = distance_m
        for k in range(usable.size):
            if not usable[k]:
                continue
            distance = distance_to_plane(points, i, planes, k)
            if distance < least or (distance == least and labels[i] < 0):
                least = distance
                labels[i] = k
    return labels
