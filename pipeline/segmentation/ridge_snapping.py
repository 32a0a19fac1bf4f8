"""Straight ridges: points near the line in which two roof planes meet (Shorter and Kasparis, end of section 3.3).

The paper moves the points near the intersection of two planes onto that line. A roof that is modelled from labels
wants the same in the domain of labels: the points near the line take the label of the side on which they lie, so the
border between two planes becomes exactly their intersection. Both forms are here.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import cosine_of_slope

_LEAST_GRADIENT = 0.02
"""Rise a metre by which two planes must part: about 1 degree; below it their intersection is anywhere."""
_LEAST_LINKS = 3
"""Neighbouring pairs of points, one on each plane, that make a border."""
_LEAST_AGREEMENT = 0.7
"""Share of the points along a border that must lie on their plane's own side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ridge:
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
    """The segments on which touching planes meet.

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

    Returns
    -------
    tuple of Ridge
        By rising plane indices. Planes that do not touch, are nearly parallel, or meet elsewhere than at their
        border (a step) give none.
    """
    links = _links(labels, neighbours)
    ridges = []
    for low, high, begin, end in _groups(links):
        ridge = _ridge(points, planes, labels, links[begin:end, 2:], low, high, distance_m, reach_m)
        if ridge is not None:
            ridges.append(ridge)
    return tuple(ridges)


def label_by_ridges(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    ridges: tuple[Ridge, ...],
    *,
    distance_m: float,
    reach_m: float,
) -> LabelArray:
    """Labels whose borders along the ridges are straight.

    A point within reach of a ridge that carries one of its two labels, and that both planes explain, takes the label
    of the side of the line on which it lies; of several ridges the nearest one decides. All others keep theirs.
    Parameters as for `find_ridges`.

    Returns
    -------
    (n,) int32
        New labels.
    """
    snapped = labels.copy()
    nearest_m = np.full(len(points), np.inf)
    for ridge in ridges:
        near, distance = _near(points, planes, labels, ridge, distance_m, reach_m)
        closer = np.abs(distance) < nearest_m[near]
        near, distance = near[closer], distance[closer]
        nearest_m[near] = np.abs(distance)
        low_side = distance > 0.0 if ridge.is_valley else distance < 0.0
        # On the line itself both are right: the label stays.
        snapped[near] = np.where(distance == 0.0, labels[near], np.where(low_side, ridge.plane_low, ridge.plane_high))
    return snapped


def snap_to_ridges(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    ridges: tuple[Ridge, ...],
    *,
    distance_m: float,
    reach_m: float,
) -> FloatArray:
    """The paper's own form: points moved onto their plane, and those near a ridge onto its line.

    Labelled points get the elevation of their plane. Points within reach of a ridge, of one of its two labels, that
    both planes explain, go to the foot of the perpendicular in plan, at the elevation where the planes meet; the
    nearest ridge wins. Unlabelled points stay. Parameters as for `find_ridges`.

    Returns
    -------
    (n, 3) float64
        Moved points, metres; the given array is not touched.
    """
    moved = points.copy()
    on_plane = np.flatnonzero(labels >= 0)
    coefficients = planes[labels[on_plane]]
    moved[on_plane, 2] = _elevation(coefficients, points[on_plane])
    nearest_m = np.full(len(points), np.inf)
    for ridge in ridges:
        near, distance = _near(points, planes, labels, ridge, distance_m, reach_m)
        closer = np.abs(distance) < nearest_m[near]
        near, distance = near[closer], distance[closer]
        nearest_m[near] = np.abs(distance)
        gradient = planes[ridge.plane_low] - planes[ridge.plane_high]
        steepness = math.hypot(gradient[0], gradient[1])
        moved[near, 0] = points[near, 0] - distance * gradient[0] / steepness
        moved[near, 1] = points[near, 1] - distance * gradient[1] / steepness
        moved[near, 2] = _elevation(planes[ridge.plane_low][None, :], moved[near])
    return moved


def _elevation(coefficients: FloatArray, points: FloatArray) -> FloatArray:
    """Elevation of planes at points, row by row."""
    return np.asarray(coefficients[:, 0] * points[:, 0] + coefficients[:, 1] * points[:, 1] + coefficients[:, 2])


def _links(labels: LabelArray, neighbours: LabelArray) -> IntArray:
    """Neighbouring points of different planes: rows (low label, high label, point, neighbour), sorted."""
    source = np.repeat(np.arange(len(labels)), neighbours.shape[1])
    target = neighbours.ravel().astype(np.int64)
    valid = target >= 0
    source, target = source[valid], target[valid]
    a, b = labels[source].astype(np.int64), labels[target].astype(np.int64)
    mixed = (a >= 0) & (b >= 0) & (a != b)
    source, target, a, b = source[mixed], target[mixed], a[mixed], b[mixed]
    rows = np.column_stack([np.minimum(a, b), np.maximum(a, b), source, target])
    return rows[np.lexsort((rows[:, 3], rows[:, 2], rows[:, 1], rows[:, 0]))]


def _groups(links: IntArray) -> list[tuple[int, int, int, int]]:
    """(low, high, begin, end) of the runs of links between the same two planes."""
    if len(links) == 0:
        return []
    change = np.flatnonzero((links[1:, :2] != links[:-1, :2]).any(axis=1)) + 1
    bounds = [0, *change.tolist(), len(links)]
    return [(int(links[s, 0]), int(links[s, 1]), s, e) for s, e in itertools.pairwise(bounds)]


def _ridge(
    points: FloatArray,
    planes: FloatArray,
    labels: LabelArray,
    links: IntArray,
    low: int,
    high: int,
    distance_m: float,
    reach_m: float,
) -> Ridge | None:
    """The ridge between two planes, or None where they do not meet along their border."""
    gradient = planes[low] - planes[high]
    steepness = math.hypot(gradient[0], gradient[1])
    if steepness < _LEAST_GRADIENT:
        return None
    border = np.unique(links)
    difference_m = _elevation(gradient[None, :], points[border])
    near = np.abs(difference_m) / steepness <= reach_m
    near &= _explained(points[border], planes[low], distance_m) | _explained(points[border], planes[high], distance_m)
    border, difference_m = border[near], difference_m[near]
    if len(border) < _LEAST_LINKS:
        return None
    is_low = labels[border] == low
    if is_low.all() or not is_low.any():
        return None
    # A point of the low-numbered plane lies where that plane is the upper one: a valley.
    above = difference_m > 0.0
    valley_votes = int(np.count_nonzero(above == is_low))
    is_valley = 2 * valley_votes > len(border)
    if max(valley_votes, len(border) - valley_votes) < _LEAST_AGREEMENT * len(border):
        return None
    along = np.array([-gradient[1], gradient[0]]) / steepness
    foot = -gradient[2] * gradient[:2] / steepness**2
    position = (points[border, 0] - foot[0]) * along[0] + (points[border, 1] - foot[1]) * along[1]
    start, end = foot + along * position.min(), foot + along * position.max()
    return Ridge(
        plane_low=low,
        plane_high=high,
        start=(float(start[0]), float(start[1])),
        end=(float(end[0]), float(end[1])),
        is_valley=is_valley,
    )


def _explained(points: FloatArray, plane: FloatArray, distance_m: float) -> BoolArray:
    """Points within a perpendicular distance of a plane."""
    vertical = points[:, 2] - _elevation(plane[None, :], points)
    return np.asarray(np.abs(vertical) * cosine_of_slope(plane[0], plane[1]) <= distance_m)


def _near(
    points: FloatArray, planes: FloatArray, labels: LabelArray, ridge: Ridge, distance_m: float, reach_m: float
) -> tuple[IntArray, FloatArray]:
    """Points of the two planes that lie near the ridge and that both explain, and their distance in plan from its line.

    The distance is positive where the low-numbered plane is the upper one.
    """
    gradient = planes[ridge.plane_low] - planes[ridge.plane_high]
    index = np.flatnonzero((labels == ridge.plane_low) | (labels == ridge.plane_high))
    distance = _elevation(gradient[None, :], points[index]) / math.hypot(gradient[0], gradient[1])
    near = np.abs(distance) <= reach_m
    index, distance = index[near], distance[near]
    start, end = np.array(ridge.start), np.array(ridge.end)
    length = math.hypot(*(end - start))
    if length > 0.0:
        along = (end - start) / length
        offset = points[index, :2] - start
        position = offset[:, 0] * along[0] + offset[:, 1] * along[1]
        inside = (position >= 0.0) & (position <= length)
        index, distance = index[inside], distance[inside]
    explained = _explained(points[index], planes[ridge.plane_low], distance_m)
    explained &= _explained(points[index], planes[ridge.plane_high], distance_m)
    return index[explained], distance[explained]
