"""Roof planes whose thresholds follow the noise and the density of the points.

A dense cloud is first averaged to nodes, so that the noise is small compared with their distance. Regions grow from
flat seeds, and the ones that explain the most are taken (`trial_regions`). Touching planes become one if an F-test
finds no difference between them, and every point takes the nearby plane that most of its neighbours take. The remaining
points are searched once more, for dormers and other superstructures.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import nearest_neighbours
from pipeline.kernels.sorting import in_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums, cosine_of_slope, mean_square_residual
from pipeline.segmentation.plane_settings import MIN_PLANE_POINTS, AdaptivePlaneSettings
from pipeline.segmentation.point_votes import (
    dissolve_redundant,
    distance_to_plane,
    touching_pairs,
    vote_among_neighbours,
)
from pipeline.segmentation.trial_regions import (
    FITTED_NEIGHBOURS,
    TrialLimits,
    local_planes,
    noise_of_local_planes,
    take_regions,
)

_DENSE_SPACING_M = 0.3
"""Closer points are averaged to nodes: the noise between such neighbours hides the slope, and nodes are fewer."""
_NODE_CELL_M = 0.5
"""Cell of the nodes: a whole number of them fills a metre, so that they do not move with an origin in whole metres."""
_NEIGHBOURS = 8
"""Nearest points over which regions grow and votes are taken."""
_GROWING_SHARE = 0.5
"""Regions grow within this share of the largest distance: the whole of it bridges gentle ridges."""
_NORMALS_SPACING_M = 0.7
"""Spacing up to which (about 2 points/m2) a point's own plane says anything about the plane that it lies on."""
_SLOPE_ERROR = 0.12
"""Standard deviation of a point's own slope up to which it says so."""
_F_LIMIT = 3.78
"""F(3, infinity) at 99 %."""
_MERGE_TOLERANCE_M = 0.05
"""Planes whose union moves the smaller by less, root mean square, are one whatever the F-test says."""
_VOTE_WEIGHT = 0.03
"""Share of the largest squared distance that a neighbour's vote outweighs."""
_VOTING_PASSES = 3
"""Passes of voting; labels hardly change later."""
_PLANE_COST = 5.0
"""Points that would be unexplained without a plane for it to stay."""
_ROW_SPACINGS, _ROW_M = 1.5, 0.6
"""Largest extent of one row of points in plan. In sparse points a whole slope may have only a few rows."""
_ROUNDS = 2
"""Rounds of regression, merging and assignment: labels hardly change later."""
_WAVES = 8.0
"""Planes of one size from which on they may be the waves of fewer: of an undulating roof, or of strips that differ."""
_MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectedPlanes:
    """Planes, and the plane of every point."""

    coefficients: FloatArray
    """(k, 3) float64, (a, b, c) of z = a x + b y + c, in the order of their first points; each has points."""
    labels: LabelArray
    """(n,) int32, index of the plane of every point; -1 for none."""


def detect_planes(points: FloatArray, spacing_m: float, settings: AdaptivePlaneSettings) -> DetectedPlanes:
    """Find the roof planes of one building; none where points are too few, or flat nowhere.

    Parameters
    ----------
    points : (n, 3) float64
        Points that see the sky, metres about an origin in whole metres near them, in canonical order.
    spacing_m : float
        Typical spacing in plan, from `geometry.point_spacing_m`; nan or 0 counts as too few points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if len(points) < MIN_PLANE_POINTS or not spacing_m > 0.0:
        return DetectedPlanes(coefficients=np.zeros((0, 3)), labels=np.full(len(points), -1, np.int32))
    row_m = min(_ROW_SPACINGS * spacing_m, _ROW_M)
    if spacing_m < _DENSE_SPACING_M:
        from pipeline.segmentation.mean_nodes import mean_nodes

        nodes, node_of = mean_nodes(points, _NODE_CELL_M, settings.max_distance_m)
        spacing_m, row_m = _NODE_CELL_M, 0.0  # one row of nodes may be a slope
    else:
        nodes, node_of = points, np.arange(len(points), dtype=np.int32)
    limits = _Limits(
        noises=settings.noises,
        min_distance_m=settings.min_distance_m,
        max_distance_m=settings.max_distance_m,
        fewest_points=settings.fewest_points(spacing_m),
        min_cosine=math.cos(math.radians(settings.max_slope_deg)),
        normal_cosine=math.cos(math.radians(settings.normal_angle_deg)),
        row_m=row_m,
    )
    neighbours = nearest_neighbours(nodes, _NEIGHBOURS)
    coefficients, labels = _detect(points, nodes, node_of, neighbours, spacing_m, limits)
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    if sizes.sum() ** 2 > _WAVES * (sizes * sizes).sum():
        # neighbours on a wave say the same: their number proves no plane where half as many planes take the points
        wider = limits._replace(min_distance_m=settings.max_distance_m)
        fewer, taken = _detect(points, nodes, node_of, neighbours, spacing_m, wider)
        if 2 * len(fewer) <= len(coefficients) and (taken >= 0).sum() >= sizes.sum():
            coefficients, labels = fewer, taken
    return DetectedPlanes(coefficients=coefficients, labels=labels)


class _Limits(NamedTuple):
    """`AdaptivePlaneSettings` at a density of points."""

    noises: float
    min_distance_m: float
    max_distance_m: float
    fewest_points: int
    min_cosine: float
    """Least cosine of a plane's slope."""
    normal_cosine: float
    """Least cosine between a plane and a point's own."""
    row_m: float
    """Extent in plan up to which points are one row."""


@kernel
def _f_ratio(sums: FloatArray, i: int, j: int, sigma_m: float) -> float:
    """F of two planes against one for all their points; -1 where they differ too little to matter.

    F = ((SSE_one - SSE_two) / 3) / (SSE_two / (n - 6)); the variance in the denominator is at least that of the noise.
    """
    both = sums[i] + sums[j]
    a, b, c, fitted = best_fit_plane(both)
    if not fitted:
        return np.inf
    square_cosine = cosine_of_slope(a, b) ** 2
    apart = 0.0
    for k in (i, j):
        own_a, own_b, own_c, _ = best_fit_plane(sums[k])
        apart += mean_square_residual(sums[k], own_a, own_b, own_c) * sums[k, 0] * square_cosine
    added = mean_square_residual(both, a, b, c) * both[0] * square_cosine - apart
    if added <= _MERGE_TOLERANCE_M**2 * min(sums[i, 0], sums[j, 0]):
        return -1.0
    variance = max(sigma_m * sigma_m, apart / max(both[0] - 6.0, 1.0))
    return added / (3.0 * variance) if variance > 0.0 else np.inf


@kernel
def merge_by_f_test(sums: FloatArray, pairs: IntArray, sigma_m: float) -> LabelArray:
    """Merge planes that an F-test does not distinguish, the least different first; (m,) int32, what each is part of.

    Parameters
    ----------
    sums : (m, 10) float64
        From `plane_regression.cluster_sums`; changed.
    pairs : (p,) int64
        Codes low * m + high of planes that touch, ascending.
    sigma_m : float
        Standard deviation of the noise.
    """
    n = len(sums)
    root = np.arange(n).astype(np.int32)
    first = pairs // max(n, 1)
    second = pairs % max(n, 1)
    ratios = np.empty(pairs.size)
    for p in range(pairs.size):
        ratios[p] = _f_ratio(sums, first[p], second[p], sigma_m)
    while pairs.size > 0:
        best = np.argmin(ratios)
        if ratios[best] >= _F_LIMIT:
            break
        kept = min(first[best], second[best])
        gone = max(first[best], second[best])
        for k in range(sums.shape[1]):
            sums[kept, k] += sums[gone, k]
        for k in range(n):
            if root[k] == gone:
                root[k] = kept
        for p in range(pairs.size):
            if first[p] == gone:
                first[p] = kept
            if second[p] == gone:
                second[p] = kept
            if first[p] == second[p]:
                ratios[p] = np.inf
            elif first[p] == kept or second[p] == kept:
                ratios[p] = _f_ratio(sums, first[p], second[p], sigma_m)
    return root


@kernel
def _fitted(
    points: FloatArray, labels: LabelArray, count: int, fewest_points: int, min_cosine: float
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Planes of the labels, which of them a roof can have, and their sums."""
    sums = cluster_sums(points, labels, count)
    planes = np.zeros((count, 3))
    usable = np.zeros(count, np.bool_)
    for k in range(count):
        a, b, c, fitted = best_fit_plane(sums[k])
        planes[k, 0], planes[k, 1], planes[k, 2] = a, b, c
        usable[k] = fitted and sums[k, 0] >= fewest_points and cosine_of_slope(a, b) >= min_cosine
    return planes, usable, sums


@kernel
def _settled(
    points: FloatArray,
    neighbours: LabelArray,
    labels: LabelArray,
    count: int,
    distance_m: float,
    sigma_m: float,
    limits: _Limits,
) -> LabelArray:
    """Labels after rounds of regression, merging and assignment."""
    fewest_points, min_cosine = limits.fewest_points, limits.min_cosine
    for _ in range(_ROUNDS):
        _, usable, sums = _fitted(points, labels, count, fewest_points, min_cosine)
        root = merge_by_f_test(sums, touching_pairs(neighbours, labels, usable), sigma_m)
        for i in range(labels.size):
            if labels[i] >= 0:
                labels[i] = root[labels[i]] if usable[labels[i]] else -1
        planes, usable, _ = _fitted(points, labels, count, fewest_points, min_cosine)
        dissolve_redundant(points, neighbours, labels, planes, usable, distance_m, _PLANE_COST, limits.row_m)
        labels = vote_among_neighbours(
            points, neighbours, labels, planes, usable, distance_m, _VOTE_WEIGHT, _VOTING_PASSES
        )
    return labels


@kernel
def _labels_of_points(
    points: FloatArray,
    node_of: LabelArray,
    neighbours: LabelArray,
    labels: LabelArray,
    planes: FloatArray,
    distance_m: float,
) -> LabelArray:
    """Every point chooses among the planes of its node and of the nodes around by distance and votes, as nodes do."""
    width = neighbours.shape[1]
    chosen = np.full(len(points), -1, np.int32)
    kind = np.empty(width + 1, np.int32)
    votes = np.empty(width + 1, np.int32)
    for i in range(len(points)):
        kinds = 0
        for q in range(-1, width):
            j = node_of[i] if q < 0 else neighbours[node_of[i], q]
            if j < 0 or labels[j] < 0:
                continue
            at = 0
            while at < kinds and kind[at] != labels[j]:
                at += 1
            if at == kinds:
                kind[at] = labels[j]
                votes[at] = 0
                kinds += 1
            votes[at] += 1
        least = 1.0
        for s in range(kinds):
            ratio = distance_to_plane(points, i, planes, kind[s]) / distance_m
            cost = ratio * ratio - _VOTE_WEIGHT * votes[s]
            if ratio <= 1.0 and (cost < least or (cost == least and kind[s] < chosen[i])):
                least = cost
                chosen[i] = kind[s]
    return chosen


@kernel
def noise_about(points: FloatArray, labels: LabelArray, planes: FloatArray) -> float:
    """1.4826 times the median absolute distance of the points to their planes; nan where no point has one."""
    distances = np.empty(len(points))
    known = 0
    for i in range(len(points)):
        if labels[i] >= 0:
            distances[known] = distance_to_plane(points, i, planes, labels[i])
            known += 1
    if known == 0:
        return np.nan
    ordered = in_order(distances[:known])
    return float(_MAD_TO_SIGMA * 0.5 * (ordered[(known - 1) // 2] + ordered[known // 2]))


@kernel
def _numbered(points: FloatArray, labels: LabelArray, planes: FloatArray, min_cosine: float) -> FloatArray:
    """Number the planes by their first point, in place, and fit those that have points to them."""
    number = np.full(len(planes), -1, np.int32)
    old = np.empty(len(planes), np.int32)
    count = 0
    for i in range(labels.size):
        k = labels[i]
        if k >= 0:
            if number[k] < 0:
                number[k] = count
                old[count] = k
                count += 1
            labels[i] = number[k]
    sums = cluster_sums(points, labels, count)
    final = np.empty((count, 3))
    for k in range(count):
        a, b, c, fitted = best_fit_plane(sums[k])
        final[k] = planes[old[k]]
        if fitted and cosine_of_slope(a, b) >= min_cosine:
            final[k, 0], final[k, 1], final[k, 2] = a, b, c
    return final


@kernel
def _detect(
    points: FloatArray,
    nodes: FloatArray,
    node_of: LabelArray,
    neighbours: LabelArray,
    spacing_m: float,
    limits: _Limits,
) -> tuple[FloatArray, LabelArray]:
    """Kernel of `detect_planes`: planes, labels of the points."""
    noises, min_distance_m, max_distance_m, fewest_points, min_cosine, normal_cosine, _ = limits
    surroundings = local_planes(nodes, neighbours)
    sigma_m = noise_of_local_planes(surroundings.variances, surroundings.order)
    distance_m = min(max(noises * sigma_m, min_distance_m), max_distance_m)
    # of a plane through m points spread evenly over a disc the slope has the error 2 sigma sqrt(pi) / (spacing m)
    slope_error = 2.0 * math.sqrt(math.pi) * sigma_m / (spacing_m * (FITTED_NEIGHBOURS + 1.0))
    has_direction = slope_error < _SLOPE_ERROR and spacing_m < _NORMALS_SPACING_M

    labels = np.full(len(nodes), -1, np.int32)
    count = 0
    for pass_ in range(2):  # the roof; then what is left over
        reach_m = distance_m if pass_ > 0 else _GROWING_SHARE * distance_m
        min_normal_cosine = normal_cosine if has_direction and pass_ == 0 else 0.0
        before = count
        trial_limits = TrialLimits(reach_m, min_normal_cosine, fewest_points, min_cosine)
        count = take_regions(surroundings, labels, before, trial_limits)
        if count > before:
            labels = _settled(nodes, neighbours, labels, count, distance_m, sigma_m, limits)
    planes, usable, _ = _fitted(nodes, labels, count, fewest_points, min_cosine)
    for i in range(labels.size):
        if labels[i] >= 0 and not usable[labels[i]]:
            labels[i] = -1
    if len(nodes) < len(points):
        sigma_m = noise_about(points, labels[node_of], planes)
        distance_m = min(max(noises * sigma_m, min_distance_m), max_distance_m)
        labels = _labels_of_points(points, node_of, neighbours, labels, planes, distance_m)
    return _numbered(points, labels, planes, min_cosine), labels
