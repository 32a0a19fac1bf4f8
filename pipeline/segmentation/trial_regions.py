"""Regions on trial: of all regions that flat seeds can grow, those that explain the most points.

Regions grow over nearest neighbours, with their plane fitted again on the way (Vosselman, Gorte, Sithole and Rabbani
2004: Recognising structure in laser scanner point clouds). There the first seed keeps what it reaches; here every
region first grows on trial, and the one with the greatest gain is taken. The gain of a
point is 1 - (distance / limit)^2, the complement of MSAC's cost (Torr and Zisserman 2000).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import (
    N_SUMS,
    add_point,
    best_fit_plane,
    cosine_of_slope,
    has_company,
    height_above,
    mean_square_residual,
)

FITTED_NEIGHBOURS = 6
"""Neighbours whose plane is a point's own: more of them reach over ridges where points are sparse."""
_FREEDOM = FITTED_NEIGHBOURS + 1 - 3  # points less the parameters of a plane
_LOWER_QUARTILE_CHI2 = 1.92256
"""Lower quartile of the chi-squared distribution with that freedom, 4."""
_TRIALS = 2
"""Trial regions that reach a point before it stops being a seed: fewer miss planes, more only take time."""
_REPEATED_POINTS = 64
"""Size at which a trial region is given up if nearly all of its points were reached that often."""
_REPEATED_SHARE = 0.9
"""That share: giving up earlier could lose regions, later only takes time."""
_COMPANY = 0.5
"""Share of a point's neighbours that must lie near the plane too, where its own plane says nothing."""
_FIRST_REFIT = 8.0
"""Points from which on a region has a plane of its own in place of its seed's."""
_REFIT_GROWTH = 1.3
"""A region is fitted again each time that it has grown by this factor."""


class Surroundings(NamedTuple):
    """Points with their neighbours, and the plane of each with these."""

    points: FloatArray
    """(n, 3) float64, metres."""
    neighbours: LabelArray
    """(n, k) int32, nearest neighbours of every point, the nearest first, -1 where there are fewer."""
    planes: FloatArray
    """(n, 3) float64, (a, b, c) of z = a x + b y + c."""
    variances: FloatArray
    """(n,) float64, sum of squared perpendicular residuals over the degrees of freedom, square metres; infinite where
    there is no plane."""
    order: IntArray
    """(n,) int64, the points by ascending variance."""
    cosines: FloatArray
    """(n,) float64, cosines of the slopes of the planes."""


@kernel
def local_planes(points: FloatArray, neighbours: LabelArray) -> Surroundings:
    """The plane of every point and its nearest neighbours.

    Arguments as in `Surroundings`.
    """
    n = len(points)
    planes = np.zeros((n, 3))
    variances, cosines = np.full(n, np.inf), np.empty(n)
    sums = np.empty(N_SUMS)
    for i in range(n):
        sums[:] = 0.0
        add_point(sums, points, i)
        for q in range(min(FITTED_NEIGHBOURS, neighbours.shape[1])):
            if neighbours[i, q] >= 0:
                add_point(sums, points, neighbours[i, q])
        a, b, c, fitted = best_fit_plane(sums)
        planes[i, 0] = a
        planes[i, 1] = b
        planes[i, 2] = c
        cosines[i] = cosine_of_slope(a, b)
        if fitted and sums[0] > 3.0:
            square = mean_square_residual(sums, a, b, c) * cosines[i] ** 2
            variances[i] = square * sums[0] / (sums[0] - 3.0)
    return Surroundings(points, neighbours, planes, variances, ascending_order(variances), cosines)


@kernel(inline="always")
def noise_of_local_planes(variances: FloatArray, order: IntArray) -> float:
    """Standard deviation of the noise, metres, from `local_planes`; 0 where there is no plane.

    From the lower quartile: neighbourhoods across edges and in trees are the upper part of the distribution.
    Arguments as in `Surroundings`.
    """
    known = 0
    for variance in variances:
        known += math.isfinite(variance)
    if known == 0:
        return 0.0
    return math.sqrt(variances[order[(known - 1) // 4]] * _FREEDOM / _LOWER_QUARTILE_CHI2)


class TrialLimits(NamedTuple):
    """Which regions are taken."""

    distance_m: float
    """Largest perpendicular distance of a point to the plane of the region that it joins."""
    min_normal_cosine: float
    """Least cosine between that plane and the point's own; 0: points need company instead."""
    fewest_points: int
    """Smaller regions are not taken."""
    min_cosine: float
    """Regions with a smaller cosine of their slope are not taken."""


_PLANES = 1 << 32
"""Numbers for the planes of a region, and the last of them for the region itself; a region is fitted a few times."""
_TAKEN = 1 << 62
"""More than any number."""


class _Trial(NamedTuple):
    """Memory of the trial regions, used again for each of them."""

    seen: IntArray
    """(n,) int64, number of the last plane that refused a point or of the last region that holds it, if later;
    `_TAKEN` for points with a label."""
    queue: LabelArray
    """(n,) int32, points of a region."""


@kernel
def _joins(surroundings: Surroundings, j: int, a: float, b: float, c: float, reach: float, least: float) -> bool:
    """Whether a point is near a plane and of its direction or, where that says nothing, in company there.

    `least` is the least cosine between the two directions over the cosine of the plane's slope; 0 asks for company.
    """
    points, local = surroundings.points, surroundings.planes
    if abs(height_above(points, j, a, b, c)) > reach:
        return False
    if least > 0.0:
        return bool((a * local[j, 0] + b * local[j, 1] + 1.0) * surroundings.cosines[j] >= least)
    return has_company(points, surroundings.neighbours, j, a, b, c, reach, _COMPANY)


@kernel
def _grow(
    surroundings: Surroundings,
    reached: LabelArray,
    seed: int,
    limits: TrialLimits,
    trial: _Trial,
    mark: int,
) -> tuple[int, float, float, float, float]:
    """A region from a seed over unlabelled points: how many, at the head of `trial.queue`; (a, b, c) of it; its gain.

    No points where it only repeats regions before it. A point that one plane refused is not asked again until the
    region has another one.
    """
    points, neighbours = surroundings.points, surroundings.neighbours
    distance_m, min_normal_cosine = limits.distance_m, limits.min_normal_cosine
    seen, queue = trial
    plane = mark * _PLANES
    region = plane + _PLANES - 1
    a, b, c = surroundings.planes[seed]
    sums = np.zeros(N_SUMS)
    queue[0] = seed
    seen[seed] = region
    held = 1
    at = 0
    repeated = 0
    refit = _FIRST_REFIT
    reach = distance_m / cosine_of_slope(a, b)
    least = min_normal_cosine / cosine_of_slope(a, b)
    while at < held:
        i = queue[at]
        at += 1
        add_point(sums, points, i)
        repeated += reached[i] >= _TRIALS
        if at == _REPEATED_POINTS and repeated >= _REPEATED_SHARE * at:
            return 0, a, b, c, 0.0
        if sums[0] >= refit:
            own_a, own_b, own_c, fitted = best_fit_plane(sums)
            if fitted:
                a, b, c = own_a, own_b, own_c
                reach = distance_m / cosine_of_slope(a, b)
                least = min_normal_cosine / cosine_of_slope(a, b)
                plane += 1
            refit = math.floor(_REFIT_GROWTH * sums[0]) + 1.0
        for q in range(neighbours.shape[1]):
            j = neighbours[i, q]
            if j < 0 or seen[j] >= plane:
                continue
            seen[j] = plane
            if _joins(surroundings, j, a, b, c, reach, least):
                seen[j] = region
                queue[held] = j
                held += 1
    a, b, c, fitted = best_fit_plane(sums)
    if not fitted:
        return 0, a, b, c, 0.0
    reach = distance_m / cosine_of_slope(a, b)
    kept = 0
    gain = 0.0
    for q in range(held):
        i = queue[q]
        ratio = height_above(points, i, a, b, c) / reach
        if abs(ratio) <= 1.0:
            queue[kept] = i
            kept += 1
            gain += 1.0 - ratio * ratio
    return kept, a, b, c, gain


@kernel
def take_regions(surroundings: Surroundings, labels: LabelArray, first_label: int, limits: TrialLimits) -> int:
    """Label regions among the unlabelled points (-1), the greatest gain first, in place; returns the last label plus 1.

    A gain can only fall as other regions take points, so the best trial region grows again and is taken if it is still
    the best: a lazy greedy choice. Points of little variance in `local_planes` are the first seeds.
    """
    neighbours = surroundings.neighbours
    distance_m, fewest_points = limits.distance_m, limits.fewest_points
    n = len(labels)
    seen, queue = np.where(labels >= 0, _TAKEN, -1), np.empty(n, np.int32)
    trial = _Trial(seen, queue)
    reached = np.zeros(n, np.int32)
    reached_again = np.zeros(n, np.int32)
    # the loss of every trial region and its seed, behind them that of none
    trials, held_trials = heap_push(heap_with_room(64), 0, 0.0, -1, 0), 1
    mark = 0
    for seed in surroundings.order:
        if surroundings.variances[seed] > 4.0 * distance_m * distance_m:
            break
        if labels[seed] >= 0 or reached[seed] >= _TRIALS:
            continue
        held, a, b, c, gain = _grow(surroundings, reached, seed, limits, trial, mark)
        reached[seed] += 1
        if held >= fewest_points:
            # points just beyond the limit would only grow the same region once more
            beside = 2.0 * distance_m / cosine_of_slope(a, b)
            region = (mark + 1) * _PLANES - 1
            for q in range(held):
                reached[queue[q]] += 1
                for s in range(neighbours.shape[1]):
                    j = neighbours[queue[q], s]
                    if j >= 0 and seen[j] < region and abs(height_above(surroundings.points, j, a, b, c)) <= beside:
                        seen[j] = region
                        reached[j] += 1
            if cosine_of_slope(a, b) >= limits.min_cosine:
                trials = heap_push(trials, held_trials, -gain, seed, 0)
                held_trials += 1
        mark += 1
    label = first_label
    while trials.keys[0] < 0.0:
        lost, seed = trials.keys[0], trials.ranks[0]
        heap_pop(trials, held_trials)
        held_trials -= 1
        if labels[seed] >= 0:
            continue
        held, a, b, _, gain = _grow(surroundings, reached_again, seed, limits, trial, mark)
        mark += 1
        if held < fewest_points or cosine_of_slope(a, b) < limits.min_cosine:
            continue
        if gain < -lost and -gain > trials.keys[0]:
            trials = heap_push(trials, held_trials, -gain, seed, 0)
            held_trials += 1
            continue
        for q in range(held):
            labels[queue[q]], seen[queue[q]] = label, _TAKEN
        label += 1
    return label
