"""The plane of each place of the plan: labels of all points, and samples where points are missing."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray

_MOST_SAMPLES = 1_000_000
"""Bounds the memory for points strewn over a wide area."""
_CONTINUATIONS = 12
"""Most rounds of `continue_crossings`: labels spread by one vertex per round, over gaps of a few."""
SAME_ROOF_M = 0.15
"""Planes that differ by less than this at a point are equally good for it: within the noise of points and planes."""


def fill_labels(xy_mm: IntArray, labels: LabelArray) -> LabelArray:
    """Labels in which every unlabelled point (-1) has taken the nearest labelled point's."""
    known = labels >= 0
    if known.all() or not known.any():
        return labels
    from pipeline.roof.nearest_points import nearest_points

    filled = labels.copy()
    index, _ = nearest_points(xy_mm[known], xy_mm[~known])
    filled[~known] = labels[known][index]
    return filled


@kernel
def _far_samples(
    xy: IntArray, low: IntArray, shape: tuple[int, int], pitch: int, gap_m: float, beside: int
) -> IntArray:
    """The samples (s, 2) of a lattice, row after row, farther than a gap from every point (n, 2).

    They lie within `beside` cells of a cell that holds a point, or anywhere with -1. The lattice has some rows and
    columns from its lower left corner on. Every other row is shifted by half a pitch: an equilateral lattice has no
    ties for the Delaunay triangulation.
    """
    rows, columns = shape
    near = np.zeros((rows, columns), np.bool_)
    holds, is_beside = np.zeros((rows, columns), np.bool_), np.full((rows, columns), beside < 0)
    reach = math.ceil(gap_m * 1e3)
    for i in range(len(xy)):
        x, y = xy[i, 0] - low[0], xy[i, 1] - low[1]
        r, c = y // pitch, x // pitch
        if beside >= 0 and not holds[r, c]:
            holds[r, c] = True
            is_beside[max(r - beside, 0) : r + beside + 1, max(c - beside, 0) : c + beside + 1] = True
        for r in range(max((y - reach) // pitch, 0), min((y + reach) // pitch + 1, rows)):
            shift = (r & 1) * (pitch // 2)
            dy = r * pitch - y
            for c in range(max((x - shift - reach) // pitch, 0), min((x - shift + reach) // pitch + 1, columns)):
                dx = c * pitch + shift - x
                near[r, c] |= math.sqrt(dx * dx + dy * dy) * 1e-3 <= gap_m
    samples = np.empty((is_beside.sum(), 2), np.int64)
    count = 0
    for r in range(rows):
        for c in range(columns):
            if is_beside[r, c] and not near[r, c]:
                samples[count, 0] = low[0] + c * pitch + (r & 1) * (pitch // 2)
                samples[count, 1] = low[1] + r * pitch
                count += 1
    return samples[:count].copy()


def empty_samples(
    xy_mm: IntArray, low: IntArray, high: IntArray, pitch_mm: int, gap_m: float, reach_mm: float = math.inf
) -> IntArray:
    """Lattice samples around and between the points, where no point is near.

    The lattice between the corners `low` and `high` starts at the lower left one, so it moves with the points. Samples
    are `pitch_mm` apart, more where it would give more than a million of them; those nearer to a point than `gap_m` are
    dropped, and those about `reach_mm` beyond any. Returns the samples, (s, 2) in millimetres.
    """
    while float((high - low).prod()) / pitch_mm**2 > _MOST_SAMPLES:
        pitch_mm *= 2
    columns, rows = (-(-(high - low) // pitch_mm) + 1).tolist()
    beside = math.ceil(reach_mm / pitch_mm) if math.isfinite(reach_mm) else -1
    samples: IntArray = _far_samples(np.ascontiguousarray(xy_mm), low, (rows, columns), pitch_mm, gap_m, beside)
    return samples


@kernel
def _pairs_that_cross(
    x: IntArray, y: IntArray, facets: LabelArray, labels: LabelArray, known: BoolArray, planes: FloatArray
) -> tuple[IntArray, LabelArray]:
    """Pairs of planes whose border between points is where they cross: keys low * k + high, -1 ridge, +1 valley."""
    k = len(planes)
    keys = np.empty(3 * len(facets), np.int64)
    votes = np.empty(3 * len(facets), np.int8)
    count = 0
    for t in range(len(facets)):
        for e in range(3):
            p = facets[t, e]
            q = facets[t, (e + 1) % 3]
            if not known[p] or not known[q] or labels[p] < 0 or labels[q] < 0 or labels[p] == labels[q]:
                continue
            if labels[p] > labels[q]:
                p, q = q, p
            low = labels[p]
            high = labels[q]
            da = (planes[low, 0] - planes[high, 0]) * 1e-3
            db = (planes[low, 1] - planes[high, 1]) * 1e-3
            dc = planes[low, 2] - planes[high, 2]
            at_p = da * x[p] + db * y[p] + dc
            at_q = da * x[q] + db * y[q] + dc
            keys[count] = np.int64(low) * k + high
            votes[count] = 0
            if at_p < 0.0 < at_q:
                votes[count] = -1
            elif at_q < 0.0 < at_p:
                votes[count] = 1
            count += 1
    order = ascending_order(keys[:count])
    pair_keys = np.empty(count, np.int64)
    kinds = np.empty(count, np.int32)
    n_pairs = 0
    i = 0
    while i < count:
        j = i
        ridge = 0
        valley = 0
        while j < count and keys[order[j]] == keys[order[i]]:
            if votes[order[j]] < 0:
                ridge += 1
            elif votes[order[j]] > 0:
                valley += 1
            j += 1
        pair_keys[n_pairs] = keys[order[i]]
        kinds[n_pairs] = 0
        if 5 * ridge >= 3 * (j - i):
            kinds[n_pairs] = -1
        elif 5 * valley >= 3 * (j - i):
            kinds[n_pairs] = 1
        n_pairs += 1
        i = j
    return pair_keys[:n_pairs], kinds[:n_pairs]


@kernel
def continue_crossings(
    x: IntArray, y: IntArray, facets: LabelArray, labels: LabelArray, known: BoolArray, planes: FloatArray
) -> LabelArray:
    """Labels (n,) in which borders of two planes that cross run straight, also across gaps in the points.

    A place without points, or with a point that no plane explains, has the label of the nearest labelled point; a ridge
    would leave its line there. The edges between the points of two planes show whether they meet in a ridge (the lower
    one is the roof) or a valley (the upper one); a vertex whose label contradicts this takes that of the neighbour.

    Parameters
    ----------
    x, y : (n,) int64
        Vertices of the TIN, points first, millimetres.
    facets : (m, 3) int32
        The TIN.
    labels : (n,) int32
        Planes; -1 outside.
    known : (n,) bool
        True for labels from the segmentation: they change only where both planes are equally good.
    planes : (k, 3) float64
        Coefficients in metres.
    """
    labels = labels.copy()
    k = len(planes)
    if k < 2:
        return labels
    pair_keys, kinds = _pairs_that_cross(x, y, facets, labels, known, planes)
    if not kinds.any():
        return labels
    for _ in range(_CONTINUATIONS):
        changed = False
        for t in range(len(facets)):
            for e in range(6):
                v = facets[t, e % 3]
                w = facets[t, (e + 1 + e // 3) % 3]
                a = labels[v]
                b = labels[w]
                if a < 0 or b < 0 or a == b:
                    continue
                key = np.int64(min(a, b)) * k + max(a, b)
                i = np.searchsorted(pair_keys, key)
                if i == len(pair_keys) or pair_keys[i] != key or kinds[i] == 0:
                    continue
                above = (planes[a, 0] - planes[b, 0]) * x[v] + (planes[a, 1] - planes[b, 1]) * y[v]
                above = above * 1e-3 + planes[a, 2] - planes[b, 2]
                if above * kinds[i] < 0.0 and (not known[v] or abs(above) < SAME_ROOF_M):
                    labels[v] = b
                    changed = True
        if not changed:
            break
    return labels
