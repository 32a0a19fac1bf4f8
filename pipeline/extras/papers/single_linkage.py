"""Clusters of facets in slope and orientation by single linkage (Hofmann et al. 2003, sections 3.1 and 3.2).

A cluster grows from a point to all neighbours nearer than a distance, and on from those: the connected components of
the graph of near pairs, so the seeds do not matter. While one cluster holds most of all points the distance shrinks.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import SingleLinkageSettings
from pipeline.kernels.sorting import counting_sort
from pipeline.kernels.union_find import numbered_sets, root_of, unite
from pipeline.model import FloatArray, LabelArray, Reason


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkedClusters:
    """Clusters found by single linkage."""

    labels: LabelArray
    """(m,) int32, cluster of every facet, numbered by their first facet; -1 in clusters that are too small."""
    distance_deg: float
    """The distance that was used in the end."""


def cluster_by_linkage(
    slope_deg: FloatArray, orientation_deg: FloatArray, settings: SingleLinkageSettings
) -> LinkedClusters:
    """Clusters of facets in slope and orientation by the paper's rules; none where none has members enough.

    Slopes (m,) are 0 to 90, orientations (m,) 0 to 360 degrees. Raises BuildingError ``too_complex`` beyond
    ``linkage_work_limit``.
    """
    distance = settings.linkage_start_deg
    work = 0
    while True:
        labels, comparisons = link(slope_deg, orientation_deg, distance, settings.linkage_work_limit - work)
        work += comparisons
        if work > settings.linkage_work_limit:
            raise BuildingError(
                Reason.TOO_COMPLEX,
                f"single linkage stood at {work} comparisons for {len(labels)} facets, "
                f"linkage_work_limit is {settings.linkage_work_limit}",
            )
        counts = np.bincount(labels, minlength=1)
        smaller = distance * settings.linkage_factor
        if counts.max() <= settings.largest_cluster_share * len(labels) or distance <= settings.min_linkage_deg:
            break
        distance = max(smaller, settings.min_linkage_deg)
    number = np.full(len(counts), -1, np.int32)
    large = counts >= settings.min_members
    number[large] = np.arange(int(large.sum()), dtype=np.int32)
    return LinkedClusters(labels=number[labels], distance_deg=distance)


def link(
    slope_deg: FloatArray, orientation_deg: FloatArray, distance_deg: float, work_limit: int = 10**15
) -> tuple[LabelArray, int]:
    """Connected components of the facets nearer to one another than a distance; orientation wraps at 360.

    Angles (m,) are in degrees, the distance is at most 90. Returns the component of every facet, (m,) int32, numbered
    by its first facet, and the comparisons of facets; the labels are incomplete where these pass the limit.
    """
    return _link(
        np.ascontiguousarray(slope_deg, dtype=np.float64),
        np.ascontiguousarray(orientation_deg, dtype=np.float64),
        float(distance_deg),
        work_limit,
    )


@kernel
def _link(slope: FloatArray, orientation: FloatArray, distance: float, work_limit: int) -> tuple[LabelArray, int]:
    """Kernel: union-find over a grid whose cells are so small that all points of one are linked."""
    n = slope.size
    parent = np.arange(n)
    # the orientation's cells divide the circle; a hair smaller than the diagonal allows
    columns = math.ceil(360.0 / (distance / math.sqrt(2.0) * (1.0 - 1e-9)))
    width = 360.0 / columns
    rows = int(90.0 / width) + 1
    cell = np.empty(n, np.int32)
    for i in range(n):
        column = min(int(orientation[i] / width), columns - 1)
        cell[i] = min(int(slope[i] / width), rows - 1) * columns + column
    start, order = counting_sort(cell, rows * columns)
    for c in range(rows * columns):
        for q in range(start[c] + 1, start[c + 1]):
            unite(parent, order[start[c]], order[q])
    reach = math.ceil(distance / width)
    work = 0
    for c in range(rows * columns):
        if start[c] == start[c + 1]:
            continue
        row = c // columns
        column = c % columns
        for dr in range(reach + 1):
            if row + dr >= rows:
                break
            for dc in range(-reach if dr > 0 else 1, reach + 1):
                other = (row + dr) * columns + (column + dc) % columns
                if start[other] == start[other + 1] or other == c:
                    continue
                if root_of(parent, order[start[c]]) == root_of(parent, order[start[other]]):
                    continue
                joined, comparisons = _near(slope, orientation, order, start, c, other, distance, work_limit - work)
                work += comparisons
                if joined:
                    unite(parent, order[start[c]], order[start[other]])
                if work > work_limit:
                    return numbered_sets(parent)[0], work
    return numbered_sets(parent)[0], work


@kernel
def _near(
    slope: FloatArray,
    orientation: FloatArray,
    order: LabelArray,
    start: LabelArray,
    a: int,
    b: int,
    distance: float,
    work_limit: int,
) -> tuple[bool, int]:
    """Whether two cells hold points that are linked, and the comparisons; beyond the limit it ends with no answer."""
    work = 0
    for p in range(start[a], start[a + 1]):
        i = order[p]
        for q in range(start[b], start[b + 1]):
            j = order[q]
            work += 1
            turn = abs(orientation[i] - orientation[j])
            turn = min(turn, 360.0 - turn)
            steeper = slope[i] - slope[j]
            if turn * turn + steeper * steeper <= distance * distance:
                return True, work
        if work > work_limit:
            break
    return False, work
