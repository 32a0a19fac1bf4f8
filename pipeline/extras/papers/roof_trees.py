"""The decision trees from clusters of facets to a roof type (Hofmann et al. 2003, sections 3.3 and 4.2)."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.extras.papers.clustering_settings import RoofTreeSettings
from pipeline.model import BoolArray, FloatArray, RoofType


@dataclasses.dataclass(frozen=True, kw_only=True)
class TreeVerdict:
    """Answer of a tree for a roof."""

    roof_type: RoofType
    """`none` where no cluster is left, `unknown` where the tree has no answer."""
    pairs: tuple[tuple[int, int], ...] = ()
    """Clusters that make a gable with one another, best pair first."""


def plausible_slopes(centres: FloatArray, min_deg: float, max_deg: float) -> BoolArray:
    """Clusters whose mean slope may be a roof's (section 3.3): (k,) bool."""
    return np.asarray((centres[:, 0] >= min_deg) & (centres[:, 0] <= max_deg))


def classify_2d(centres: FloatArray, settings: RoofTreeSettings) -> TreeVerdict:
    """The tree of section 3.3, of the mean slopes and orientations of the clusters left, degrees, in `centres` (k, 3).

    No cluster: none. One: pent. Two with opposite orientations: a gable. More: each pair of opposite orientations and
    similar slopes is a gable, and several gables are a combination. The O-distance plays no part.

    Examples
    --------
    >>> classify_2d(np.array([[30.0, 80.0, 2.0], [35.0, 255.0, 3.0]]), RoofTreeSettings()).roof_type.value
    'gable'
    """
    if len(centres) == 0:
        return TreeVerdict(roof_type=RoofType.NONE)
    if len(centres) == 1:
        flat = bool(centres[0, 0] < settings.flat_below_deg)
        return TreeVerdict(roof_type=RoofType.FLAT if flat else RoofType.PENT)
    # the two faces of a single gable need not be alike (section 2); among several clusters pairs are of similar slope
    pairs = opposite_pairs(centres, settings, 90.0 if len(centres) == 2 else settings.similar_slope_deg)
    kinds = {0: RoofType.UNKNOWN, 1: RoofType.GABLE}
    return TreeVerdict(roof_type=kinds.get(len(pairs), RoofType.COMBINATION), pairs=pairs)


def classify_3d(centres: FloatArray, settings: RoofTreeSettings) -> TreeVerdict:
    """The tree of section 4.2: as that of 3.3, but a pent roof is the one cluster above the origin.

    `centres` (k, 3) are mean slope and orientation in degrees and O-distance in metres of the clusters left.

    Examples
    --------
    >>> roof_and_slope_below = np.array([[30.0, 80.0, 4.0], [10.0, 150.0, -1.0]])
    >>> classify_3d(roof_and_slope_below, RoofTreeSettings()).roof_type.value
    'pent'
    >>> classify_3d(roof_and_slope_below[1:], RoofTreeSettings()).roof_type.value
    'unknown'
    """
    if len(centres) == 0:
        return TreeVerdict(roof_type=RoofType.NONE)
    above = centres[centres[:, 2] > 0.0]
    if len(above) == 1 and (len(centres) == 1 or settings.pent_beside == "below_origin"):
        return classify_2d(above, settings)
    if len(centres) == 1:
        return TreeVerdict(roof_type=RoofType.UNKNOWN)
    return classify_2d(centres, settings)


def opposite_pairs(
    centres: FloatArray, settings: RoofTreeSettings, similar_slope_deg: float
) -> tuple[tuple[int, int], ...]:
    """Pairs of clusters with orientations about 180 degrees apart and similar slopes, each cluster in one at most.

    The pair nearest to 180 degrees first, then the one of more similar slopes, then the lower indices.
    """
    found = []
    for a in range(len(centres)):
        for b in range(a + 1, len(centres)):
            off = abs((float(centres[a, 1] - centres[b, 1]) % 360.0) - 180.0)
            difference = abs(float(centres[a, 0] - centres[b, 0]))
            if off <= settings.opposite_tolerance_deg and difference <= similar_slope_deg:
                found.append((off, difference, a, b))
    pairs: list[tuple[int, int]] = []
    taken: set[int] = set()
    for _, _, a, b in sorted(found):
        if a not in taken and b not in taken:
            pairs.append((a, b))
            taken |= {a, b}
    return tuple(pairs)
