"""Straight ridges: points near the line in which two roof planes meet (Shorter and Kasparis, end of section 3.3).

The paper moves the points near the intersection of two planes onto that line. Here, where a roof is modelled from
labels, the points near the line take the label of the side on which they lie: the border between two planes becomes
exactly their intersection.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.segmentation.point_votes import distance_to_plane

_MIN_GRADIENT = 0.02
"""Rise a metre by which two planes must part: about 1 degree; below it their intersection is anywhere."""
_MIN_BORDER_POINTS = 3
"""Points beside the other plane that make a border."""
_MIN_AGREEMENT = 0.7
"""Share of the points along a border that must lie on their plane's own side."""


class Ridge(NamedTuple):
    """Where two planes meet: a ridge, a hip or a valley, as a segment in plan."""

    plane_low: int
    """The smaller of the two indices."""
    plane_high: int
    """The larger one."""
    start: tuple[float, float]
    """One end in plan, metres."""
    end: tuple[float, float]
    """The other end."""
    is_valley: bool
    """True where the roof is the upper of the two planes, False where it is the lower one (ridge, hip)."""


def find_ridges(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    neighbours: LabelArray,
    *,
    distance_m: float,
    reach_m: float,
) -> tuple[Ridge, ...]:
    """The segments on which touching planes meet, by rising plane indices.

    Planes that do not touch, are nearly parallel, or meet elsewhere than at their border (a step) give none.

    Parameters
    ----------
    points : (n, 3) float64
        Metres.
    planes : (k, 3) float64
        (a, b, c) of z = a x + b y + c.
    labels : (n,) int32
        Plane of every point, -1 for none.
    neighbours : (n, q) int32
        Nearest neighbours of every point, -1 where there are fewer.
    distance_m : float
        A point is explained by a plane up to this perpendicular distance.
    reach_m : float
        Distance in plan from the line up to which points count as near.
    """
    segments = _segments(
        np.ascontiguousarray(points), planes, labels, np.ascontiguousarray(neighbours), distance_m, reach_m
    )
    return tuple(
        Ridge(plane_low=int(low), plane_high=int(high), start=(x0, y0), end=(x1, y1), is_valley=valley > 0.0)
        for low, high, x0, y0, x1, y1, valley in segments.tolist()
    )


def label_by_ridges(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    ridges: tuple[Ridge, ...],
    *,
    distance_m: float,
    reach_m: float,
) -> LabelArray:
    """Labels (n,) int32 whose borders along the ridges are straight; parameters as for `find_ridges`.

    A point within reach of a ridge that carries one of its two labels, and that both planes explain, takes the label of
    the side of the line on which it lies; of several ridges the nearest one decides. All others keep theirs.
    """
    snapped = labels.copy()
    nearest_m = np.full(len(points), np.inf)
    members = _members(labels, len(planes))
    for ridge in ridges:
        near, distance = _near(points, planes, members, ridge, distance_m, reach_m)
        closer = np.abs(distance) < nearest_m[near]
        near, distance = near[closer], distance[closer]
        nearest_m[near] = np.abs(distance)
        low_side = distance > 0.0 if ridge.is_valley else distance < 0.0
        # On the line itself both are right: the label stays.
        snapped[near] = np.where(distance == 0.0, labels[near], np.where(low_side, ridge.plane_low, ridge.plane_high))
    return snapped


def _members(labels: LabelArray, n_planes: int) -> tuple[IntArray, IntArray]:
    """Points by plane: where those of each begin, (n_planes + 1,), and their indices, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.searchsorted(labels[order], np.arange(n_planes + 1)), order


def _near(
    points: FloatArray,
    planes: FloatArray,
    members: tuple[IntArray, IntArray],
    ridge: Ridge,
    distance_m: float,
    reach_m: float,
) -> tuple[IntArray, FloatArray]:
    """Points of the two planes that lie near the ridge and that both explain, and their distance in plan from its line.

    The distance is positive where the low-numbered plane is the upper one.
    """
    begin, order = members
    low, high = ridge.plane_low, ridge.plane_high
    index = np.concatenate([order[begin[low] : begin[low + 1]], order[begin[high] : begin[high + 1]]])
    return _near_segment(points, planes, index, ridge, distance_m, reach_m)


@kernel
def _near_segment(
    points: FloatArray,
    planes: FloatArray,
    index: IntArray,
    ridge: Ridge,
    distance_m: float,
    reach_m: float,
) -> tuple[IntArray, FloatArray]:
    """The kernel of `_near` over the points of an index."""
    low, high = ridge.plane_low, ridge.plane_high
    (start_x, start_y), (end_x, end_y) = ridge.start, ridge.end
    gradient_x = planes[low, 0] - planes[high, 0]
    gradient_y = planes[low, 1] - planes[high, 1]
    steepness = math.hypot(gradient_x, gradient_y)
    length = math.hypot(end_x - start_x, end_y - start_y)
    near = np.empty(index.size, np.int64)
    distance = np.empty(index.size)
    count = 0
    for i in index:
        offset = _difference(points, i, planes, low, high) / steepness
        if abs(offset) > reach_m:
            continue
        along = (points[i, 0] - start_x) * (end_x - start_x) + (points[i, 1] - start_y) * (end_y - start_y)
        if along < 0.0 or along > length * length:
            continue
        if max(distance_to_plane(points, i, planes, low), distance_to_plane(points, i, planes, high)) > distance_m:
            continue
        near[count] = i
        distance[count] = offset
        count += 1
    return near[:count].copy(), distance[:count].copy()


@kernel
def _difference(points: FloatArray, i: int, planes: FloatArray, low: int, high: int) -> float:
    """Elevation of the low-numbered plane above the other at a point; its zero is the line of intersection."""
    return float(
        (planes[low, 0] - planes[high, 0]) * points[i, 0]
        + (planes[low, 1] - planes[high, 1]) * points[i, 1]
        + (planes[low, 2] - planes[high, 2])
    )


@kernel
def _segments(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    neighbours: LabelArray,
    distance_m: float,
    reach_m: float,
) -> FloatArray:
    """Rows (low, high, start x, y, end x, y, valley or not) of the ridges of all touching planes."""
    n = labels.size
    n_planes = planes.shape[0]
    border = _borders(labels, neighbours, n_planes)
    rows = np.empty((border.size, 7))
    count = 0
    begin = 0
    while begin < border.size:
        pair = border[begin] // n
        end = begin
        while end < border.size and border[end] // n == pair:
            end += 1
        if _segment(points, planes, labels, border[begin:end] % n, pair, distance_m, reach_m, rows[count]):
            count += 1
        begin = end
    return rows[:count].copy()


@kernel
def _borders(labels: LabelArray, neighbours: LabelArray, n_planes: int) -> IntArray:
    """Codes (low plane * planes + high plane) * points + point of the points beside another plane, ascending, once."""
    n = labels.size
    count = 0
    codes = np.empty(64, np.int64)
    for i in range(n):
        for q in range(neighbours.shape[1]):
            j = neighbours[i, q]
            if j < 0 or labels[i] < 0 or labels[j] < 0 or labels[i] == labels[j]:
                continue
            if count + 2 > codes.size:
                codes = np.concatenate((codes, np.empty(codes.size, np.int64)))
            pair = np.int64(min(labels[i], labels[j])) * n_planes + max(labels[i], labels[j])
            codes[count] = pair * n + i
            codes[count + 1] = pair * n + j
            count += 2
    return np.unique(codes[:count])


@kernel
def _segment(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    border: IntArray,
    pair: int,
    distance_m: float,
    reach_m: float,
    row: FloatArray,
) -> bool:
    """Fill the row of the ridge between the planes of a code low * planes + high; False where they have none."""
    low, high = pair // len(planes), pair % len(planes)
    gradient_x = planes[low, 0] - planes[high, 0]
    gradient_y = planes[low, 1] - planes[high, 1]
    steepness = math.hypot(gradient_x, gradient_y)
    if steepness < _MIN_GRADIENT:
        return False
    offset = (planes[low, 2] - planes[high, 2]) / (steepness * steepness)
    count = 0
    count_low = 0
    valley_votes = 0
    first = np.inf
    last = -np.inf
    for i in border:
        difference_m = _difference(points, i, planes, low, high)
        if abs(difference_m) > reach_m * steepness:
            continue
        if min(distance_to_plane(points, i, planes, low), distance_to_plane(points, i, planes, high)) > distance_m:
            continue
        count += 1
        is_low = labels[i] == low
        count_low += is_low
        # A point of the low-numbered plane lies where that plane is the upper one: a valley.
        valley_votes += (difference_m > 0.0) == is_low
        position = (points[i, 1] * gradient_x - points[i, 0] * gradient_y) / steepness
        first = min(first, position)
        last = max(last, position)
    agreeing = max(valley_votes, count - valley_votes)
    if count < _MIN_BORDER_POINTS or count_low in {0, count} or agreeing < _MIN_AGREEMENT * count:
        return False
    row[0] = low
    row[1] = high
    for entry, position in ((2, first), (4, last)):
        row[entry] = -offset * gradient_x - position * gradient_y / steepness
        row[entry + 1] = -offset * gradient_y + position * gradient_x / steepness
    row[6] = 1.0 if 2 * valley_votes > count else 0.0
    return True
