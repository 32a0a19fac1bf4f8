"""Which buildings of two epochs belong together: by the overlap of their footprints in plan.

Pairs that share enough of the smaller footprint are edges of a graph; its connected groups are compared. One building
can become several (split), several one (merged), or both. A group whose sides have little area in common is dissolved:
its old buildings are gone and its new ones are new.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.epochs.epoch import Epoch
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.evaluation.building_matching import overlapping, summed

ROWS_PER_PART = 20_000
"""Buildings of one epoch whose geometry is in memory at once, about."""


class Pairs(NamedTuple):
    """Pairs of footprints that share area: rows of the earlier epoch, ascending, rows of the later one, that area."""

    old: IntArray
    new: IntArray
    common_m2: FloatArray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Groups:
    """Buildings that belong together; every building is in exactly one group."""

    of_old: IntArray
    """(o,) int64, the group of each building of the earlier epoch."""
    of_new: IntArray
    """(n,) int64, the group of each building of the later one."""
    count: int
    """Number of groups; they are numbered from 0."""
    common_m2: FloatArray
    """(count,) float64, area that their two sides share."""
    pairs: Pairs
    """All pairs, also those between two groups."""


def parts_of(xy: FloatArray, most: int = ROWS_PER_PART) -> Iterator[IntArray]:
    """Split places (n, 2) into compact parts of at most `most`, by halving at the median of the longer side.

    Yields the indices of each part, ascending. The parts depend on the places alone, not on their order. Coinciding
    places stay together, whatever their number. Places that are nan come last.
    """
    known = np.isfinite(xy).all(axis=1)
    stack = [np.flatnonzero(known)]
    while stack:
        part = stack.pop()
        if len(part) == 0:
            continue
        span = np.ptp(xy[part], axis=0)
        axis = int(span[1] > span[0])
        middle = float(np.median(xy[part, axis]))
        low = xy[part, axis] < middle
        if not low.any():  # more than half of them are at the low end
            low = xy[part, axis] <= middle
        if len(part) <= most or span[axis] == 0.0:
            yield part
            continue
        stack += [part[~low], part[low]]
    if not known.all():
        yield np.flatnonzero(~known)


def middles(boxes: FloatArray) -> FloatArray:
    """Middles (n, 2) of boxes (n, 4)."""
    return (boxes[:, :2] + boxes[:, 2:]) / 2.0


def meeting(boxes: FloatArray, around: FloatArray) -> BoolArray:
    """Which boxes (n, 4) meet one box (4,)."""
    found: BoolArray = (
        (boxes[:, 0] <= around[2])
        & (boxes[:, 2] >= around[0])
        & (boxes[:, 1] <= around[3])
        & (boxes[:, 3] >= around[1])
    )
    return found


def around(boxes: FloatArray) -> FloatArray:
    """The box (4,) around boxes (n, 4), n at least 1."""
    return np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])


def all_pairs(old: Epoch, new: Epoch) -> tuple[Pairs, FloatArray, FloatArray]:
    """All pairs of buildings that share area, and the areas of all footprints, 0 without geometry.

    Geometry is read part by part; a pair is found with the part of its earlier building.
    """
    old_m2, new_m2 = np.zeros(len(old)), np.zeros(len(new))
    found = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    for part in parts_of(middles(old.boxes)):
        if not np.isfinite(old.boxes[part]).all():
            continue
        near = np.flatnonzero(meeting(new.boxes, around(old.boxes[part])))
        first, second = old.buildings(part, ("geometry",)), new.buildings(near, ("geometry",))
        old_m2[first.rows] = shapely.area(first.footprints)
        shared = overlapping(first.footprints, second.footprints)
        new_m2[second.rows] = shapely.area(second.footprints)
        found.append((first.rows[shared.first], second.rows[shared.second], shared.common_m2))
    unseen = np.flatnonzero((new_m2 == 0.0) & np.isfinite(new.boxes).all(axis=1))
    for part in parts_of(middles(new.boxes[unseen])):
        alone = new.buildings(unseen[part], ("geometry",))
        new_m2[alone.rows] = shapely.area(alone.footprints)
    a, b, common = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((b, a))
    return Pairs(old=a[order], new=b[order], common_m2=common[order]), old_m2, new_m2


def grouped(pairs: Pairs, old_m2: FloatArray, new_m2: FloatArray, settings: DiffSettings) -> Groups:
    """Buildings that belong together; `old_m2` (o,) and `new_m2` (n,) are the areas of all footprints."""
    smaller = np.minimum(old_m2[pairs.old], new_m2[pairs.new])
    kept = pairs.common_m2 >= settings.min_overlap_share * smaller
    count, labels = _components(pairs, kept, len(old_m2), len(new_m2))
    common = summed(labels[pairs.old[kept]], pairs.common_m2[kept], count)
    areas = np.bincount(labels, weights=np.concatenate([old_m2, new_m2]), minlength=count)
    iou = np.divide(common, areas - common, out=np.zeros(count), where=areas > common)
    dissolved = (common > 0.0) & (iou < settings.min_iou)
    if dissolved.any():
        kept &= ~dissolved[labels[pairs.old]]
        count, labels = _components(pairs, kept, len(old_m2), len(new_m2))
        common = summed(labels[pairs.old[kept]], pairs.common_m2[kept], count)
    return Groups(
        of_old=labels[: len(old_m2)], of_new=labels[len(old_m2) :], count=count, common_m2=common, pairs=pairs
    )


def _components(pairs: Pairs, kept: BoolArray, n_old: int, n_new: int) -> tuple[int, IntArray]:
    """Connected groups of the graph of the kept pairs, a number each; buildings of the later epoch come second."""
    size = n_old + n_new
    if size == 0:
        return 0, np.empty(0, np.int64)
    edges = (np.ones(int(kept.sum()), np.int8), (pairs.old[kept], n_old + pairs.new[kept]))
    count, labels = connected_components(coo_array(edges, shape=(size, size)), directed=False)
    return int(count), labels.astype(np.int64)
