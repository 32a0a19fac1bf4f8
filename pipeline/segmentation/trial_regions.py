"""Regions on trial: of all regions that flat seeds can grow, those that explain the most points.

Regions grow over nearest neighbours, with their plane fitted again on the way (Vosselman, Gorte, Sithole and Rabbani
2004: Recognising structure in laser scanner point clouds). There a seed that was looked at first keeps what it
reaches; here every region first grows on trial, and the one with the greatest gain is taken. A gain is the sum over a
region's points of 1 - (distance / limit)^2, the complement of MSAC's cost (Torr and Zisserman 2000).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import (
    N_SUMS,
    add_point,
    best_fit_plane,
    cosine_of_slope,
    mean_square_residual,
)

FITTED_NEIGHBOURS = 6
"""Neighbours whose plane is a point's own: more of them reach over ridges where points are sparse."""
_FREEDOM = FITTED_NEIGHBOURS + 1 - 3
_LOWER_QUARTILE_CHI2 = 1.92256
"""Lower quartile of the chi-squared distribution with that freedom, 4."""
_TRIALS = 2
"""Trial regions that reach a point before it is no seed any more: fewer miss planes, more only take time."""
_REPEATED_POINTS = 64
"""Size at which a trial region is given up if nearly all of its points were reached that often."""
_REPEATED_SHARE = 0.9
_COMPANY = 0.5
"""Share of a point's neighbours that must lie near the plane too, where its own plane tells nothing."""
_FIRST_REFIT = 8.0
"""Points from which on a region has a plane of its own and no more its seed's."""
_REFIT_GROWTH = 1.3
"""A region is fitted again each time that it has grown by this factor."""


@kernel
def local_planes(points: FloatArray, neighbours: LabelArray) -> tuple[FloatArray, FloatArray]:
    """The plane of every point and its nearest neighbours.

    Parameters
    ----------
    points : (n, 3) float64
        Metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, the nearest first, -1 where there are fewer.

    Returns
    -------
    planes : (n, 3) float64
        (a, b, c) of z = a x + b y + c.
    variances : (n,) float64
        Sum of squared perpendicular residuals over the degrees of freedom, square metres; infinite where there is no
        plane.
    """
    n = len(points)
    planes = np.zeros((n, 3))
    variances = np.full(n, np.inf)
    for i in range(n):
        sums = np.zeros(N_SUMS)
        add_point(sums, points, i)
        for q in range(min(FITTED_NEIGHBOURS, neighbours.shape[1])):
            if neighbours[i, q] >= 0:
                add_point(sums, points, neighbours[i, q])
        a, b, c, fitted = best_fit_plane(sums)
        planes[i, 0] = a
        planes[i, 1] = b
        planes[i, 2] = c
        if fitted and sums[0] > 3.0:
            square = mean_square_residual(sums, a, b, c) * cosine_of_slope(a, b) ** 2
            variances[i] = square * sums[0] / (sums[0] - 3.0)
    return planes, variances


@kernel(inline="always")
def noise_of_local_planes(variances: FloatArray, order: IntArray) -> float:
    """Standard deviation of the noise, metres, from what `local_planes` tells; 0 where there is no plane.

    From the lower quartile: neighbourhoods across edges and in trees are the upper part of the distribution.

    Parameters
    ----------
    variances : (n,) float64
        From `local_planes`.
    order : (n,) int64
        The points by ascending variance.
    """
    known = 0
    for variance in variances:
        known += math.isfinite(variance)
    if known == 0:
        return 0.0
    return math.sqrt(variances[order[(known - 1) // 4]] * _FREEDOM / _LOWER_QUARTILE_CHI2)


@kernel
def _height(points: FloatArray, i: int, a: float, b: float, c: float) -> float:
    """Height of a point above a plane."""
    return float(points[i, 2] - a * points[i, 0] - b * points[i, 1] - c)


@kernel
def _joins(
    points: FloatArray,
    neighbours: LabelArray,
    local: FloatArray,
    cosines: FloatArray,
    j: int,
    a: float,
    b: float,
    c: float,
    reach: float,
    least: float,
) -> bool:
    """Whether a point is near a plane and of its direction or, where that says nothing, in company there.

    `least` is the least cosine between the two directions over the cosine of the plane's slope; 0 asks for company.
    """
    if abs(_height(points, j, a, b, c)) > reach:
        return False
    if least > 0.0:
        return bool((a * local[j, 0] + b * local[j, 1] + 1.0) * cosines[j] >= least)
    known = 0
    near = 0
    for other in neighbours[j]:
        if other >= 0:
            known += 1
            near += abs(_height(points, other, a, b, c)) <= reach
    return near >= _COMPANY * known


@kernel
def _grow(
    points: FloatArray,
    neighbours: LabelArray,
    local: FloatArray,
    cosines: FloatArray,
    labels: LabelArray,
    reached: LabelArray,
    seed: int,
    distance_m: float,
    min_normal_cosine: float,
    asked: LabelArray,
    mark: int,
    refused: LabelArray,
    queue: LabelArray,
) -> tuple[int, float, float, float, float]:
    """A region from a seed over unlabelled points: how many, at the head of `queue`; (a, b, c) of it; its gain.

    None at all where it only repeats regions before it. A point that one plane refused is not asked again until there
    is another one: `refused` has the number of that plane, its last entry how many there were.
    """
    n = len(points)
    a, b, c = local[seed, 0], local[seed, 1], local[seed, 2]
    sums = np.zeros(N_SUMS)
    queue[0] = seed
    asked[seed] = mark
    held = 1
    at = 0
    repeated = 0
    refit = _FIRST_REFIT
    reach = distance_m / cosine_of_slope(a, b)
    least = min_normal_cosine / cosine_of_slope(a, b)
    refused[n] += 1
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
                refused[n] += 1
            refit = math.floor(_REFIT_GROWTH * sums[0]) + 1.0
        for j in neighbours[i]:
            if j < 0 or labels[j] >= 0 or asked[j] == mark or refused[j] == refused[n]:
                continue
            if _joins(points, neighbours, local, cosines, j, a, b, c, reach, least):
                asked[j] = mark
                queue[held] = j
                held += 1
            else:
                refused[j] = refused[n]
    a, b, c, fitted = best_fit_plane(sums)
    if not fitted:
        return 0, a, b, c, 0.0
    reach = distance_m / cosine_of_slope(a, b)
    kept = 0
    gain = 0.0
    for q in range(held):
        i = queue[q]
        ratio = _height(points, i, a, b, c) / reach
        if abs(ratio) <= 1.0:
            queue[kept] = i
            kept += 1
            gain += 1.0 - ratio * ratio
    return kept, a, b, c, gain


@kernel
def take_regions(
    points: FloatArray,
    neighbours: LabelArray,
    local: FloatArray,
    variances: FloatArray,
    order: IntArray,
    labels: LabelArray,
    first_label: int,
    distance_m: float,
    min_normal_cosine: float,
    fewest_points: int,
    min_cosine: float,
) -> int:
    """Label regions among the unlabelled points, the greatest gain first, in place.

    A gain can only fall as other regions take points, so the best trial region grows anew and is taken if it is still
    the best: a lazy greedy choice.

    Parameters
    ----------
    points : (n, 3) float64
        Metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    local, variances : (n, 3) and (n,) float64
        From `local_planes`.
    order : (n,) int64
        The points by ascending variance: those of little variance are the first seeds.
    labels : (n,) int32
        -1 for none; changed.
    first_label : int
        Of the first region.
    distance_m : float
        Largest perpendicular distance of a point to the plane of the region that it joins.
    min_normal_cosine : float
        Least cosine between that plane and the point's own; 0: points need company instead.
    fewest_points : int
        Smaller regions are not taken.
    min_cosine : float
        Regions with a smaller cosine of their slope are not taken.

    Returns
    -------
    int
        One more than the last label.
    """
    n = len(points)
    cosines = np.empty(n)
    for i in range(n):
        cosines[i] = cosine_of_slope(local[i, 0], local[i, 1])
    asked = np.full(n, -1, np.int32)
    refused = np.zeros(n + 1, np.int32)
    queue = np.empty(n, np.int32)
    reached = np.zeros(n, np.int32)
    anew = np.zeros(n, np.int32)
    # the loss of every trial region and its seed, behind them that of none
    trials, held_trials = heap_push(heap_with_room(64), 0, 0.0, -1, 0), 1
    mark = 0
    for seed in order:
        if variances[seed] > 4.0 * distance_m * distance_m:
            break
        if labels[seed] >= 0 or reached[seed] >= _TRIALS:
            continue
        held, a, b, c, gain = _grow(
            points, neighbours, local, cosines, labels, reached, seed, distance_m, min_normal_cosine, asked, mark,
            refused, queue,
        )  # fmt: skip
        reached[seed] += 1
        if held >= fewest_points:
            # points just beyond the limit would only grow the same region once more
            beside = 2.0 * distance_m / cosine_of_slope(a, b)
            for q in range(held):
                reached[queue[q]] += 1
                for j in neighbours[queue[q]]:
                    if j >= 0 and asked[j] != mark and abs(_height(points, j, a, b, c)) <= beside:
                        asked[j] = mark
                        reached[j] += 1
            if cosine_of_slope(a, b) >= min_cosine:
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
        held, a, b, _, gain = _grow(
            points, neighbours, local, cosines, labels, anew, seed, distance_m, min_normal_cosine, asked, mark,
            refused, queue,
        )  # fmt: skip
        mark += 1
        if held < fewest_points or cosine_of_slope(a, b) < min_cosine:
            continue
        if gain < -lost and -gain > trials.keys[0]:
            trials = heap_push(trials, held_trials, -gain, seed, 0)
            held_trials += 1
            continue
        for q in range(held):
            labels[queue[q]] = label
        label += 1
    return label
