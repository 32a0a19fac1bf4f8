"""Coarse clusters of facets in a grid of boxes of slope, orientation and O-distance (Hofmann et al. 2003, section 4.1).

Boxes that hold many points grow together over their neighbours in slope and orientation, never in O-distance. A second
grid is shifted by half a box in O-distance, so that each point is assigned twice and no roof is lost on the border
between two layers; what both grids find is merged.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import ParameterBoxSettings
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray, Reason

_ROWS = 1 << 12
"""More than there can be rows of slope or columns of orientation."""


def coarse_clusters(parameters: FloatArray, settings: ParameterBoxSettings) -> tuple[LabelArray, ...]:
    """Groups of neighbouring dense boxes: the facets of each cluster, ascending; clusters may overlap.

    `parameters` (m, 3) are slope and orientation in degrees and O-distance in metres. Clusters are ordered by the
    layer, slope and orientation of their first box. Raises BuildingError ``too_complex`` beyond
    ``max_coarse_clusters``.
    """
    if len(parameters) == 0:
        return ()
    first = _dense_groups(parameters, 0.0, settings)
    second = _dense_groups(parameters, 0.5, settings)
    n_first, n_second = int(first.max()) + 1, int(second.max()) + 1
    if n_first + n_second > settings.max_coarse_clusters:
        raise BuildingError(
            Reason.TOO_COMPLEX,
            f"{n_first + n_second} coarse clusters of {len(parameters)} facets, "
            f"max_coarse_clusters is {settings.max_coarse_clusters}",
        )
    cluster_of_group = _merge_doubles(first, second, n_first, n_second, settings.double_share)
    n_clusters = int(cluster_of_group.max(initial=-1)) + 1
    # a facet without a group takes the last entry
    in_first = np.append(cluster_of_group[:n_first], -1)[first]
    in_second = np.append(cluster_of_group[n_first:], -1)[second]
    return tuple(np.flatnonzero((in_first == k) | (in_second == k)).astype(np.int32) for k in range(n_clusters))


def _dense_groups(parameters: FloatArray, shift: float, settings: ParameterBoxSettings) -> LabelArray:
    """The group of every facet in one grid, shifted by a part of a box in O-distance; -1 in none."""
    columns = max(3, round(360.0 / settings.box_orientation_deg))
    row = np.floor(parameters[:, 0] / settings.box_slope_deg).astype(np.int64)
    column = np.minimum(np.floor(parameters[:, 1] * columns / 360.0).astype(np.int64), columns - 1)
    layer = np.floor(parameters[:, 2] / settings.box_o_distance_m + shift).astype(np.int64)
    key = ((layer - layer.min()) * _ROWS + row + 1) * _ROWS + column
    boxes, box_of_facet, counts = np.unique(key, return_inverse=True, return_counts=True)
    # single standing boxes above average are groups as well: the threshold is never below the average
    # one box that holds all facets (a roof without any noise) is not to be measured by itself
    mean = float(counts.mean()) if len(counts) > 1 else 0.0
    dense = counts > max(mean, settings.dense_box_facets)
    return np.asarray(_grow(boxes, dense, columns)[box_of_facet])


@kernel
def _grow(boxes: IntArray, dense: BoolArray, columns: int) -> LabelArray:
    """Region growing over the eight neighbours in slope and orientation; -1 for boxes that are not dense."""
    group = np.full(boxes.size, -1, np.int32)
    stack = np.empty(boxes.size, np.int64)
    count = 0
    for seed in range(boxes.size):
        if not dense[seed] or group[seed] >= 0:
            continue
        group[seed] = count
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            box = boxes[stack[top]]
            column = box % _ROWS
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    wanted = box - column + dr * _ROWS + (column + dc) % columns
                    at = np.searchsorted(boxes, wanted)
                    if at < boxes.size and boxes[at] == wanted and dense[at] and group[at] < 0:
                        group[at] = count
                        stack[top] = at
                        top += 1
        count += 1
    return group


def _merge_doubles(first: LabelArray, second: LabelArray, n_first: int, n_second: int, share: float) -> LabelArray:
    """The cluster of every group, those of the second grid after those of the first: doubles are one."""
    both = (first >= 0) & (second >= 0)
    pairs, shared = np.unique(first[both].astype(np.int64) * (n_second + 1) + second[both], return_counts=True)
    sizes = np.concatenate(
        [np.bincount(first[first >= 0], minlength=n_first), np.bincount(second[second >= 0], minlength=n_second)]
    )
    cluster = np.arange(n_first + n_second, dtype=np.int32)
    for pair, count in zip(pairs.tolist(), shared.tolist(), strict=True):
        a, b = pair // (n_second + 1), n_first + pair % (n_second + 1)
        if count > share * min(sizes[a], sizes[b]):
            one, other = sorted((int(cluster[a]), int(cluster[b])))
            cluster[cluster == other] = one
    return np.unique(cluster, return_inverse=True)[1].astype(np.int32)
