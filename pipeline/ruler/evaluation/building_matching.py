"""Footprints of models and of the reference: which overlap, and which model stands for which building.

A building is found if the footprint of a model overlaps it with an intersection over union (IoU) of at least one half,
one to one, best first (Rutzinger, Rottensteiner and Pfeifer 2009).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference

MIN_IOU = 0.5
"""Least overlap of a found building: two models cannot both reach it."""
MIN_SHARE = 0.5
"""Least share of a footprint or face that lies on another one."""
EDGE_M = 5.0
"""A model farther inside the extent of the reference is not cut by the edge of the data, whatever it claims."""
_MIN_M2 = 1e-6
"""Numerical guard: smaller overlaps are none."""
_ROUNDING = 1e-9
"""Numerical guard for comparisons of shares."""
_PAIRS_PER_BLOCK = 65_536

Geometries = npt.NDArray[Any]
"""Array of shapely geometries."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Overlaps:
    """Pairs of polygons that share some area, ordered by the first and then the second index. All of length p."""

    first: IntArray
    """(p,) int64, index into the first set."""
    second: IntArray
    """(p,) int64, index into the second set."""
    common_m2: FloatArray
    """(p,) float64, common area in plan, over 1e-6 m2."""
    middle: FloatArray
    """(p, 2) float64, centroid of the common area."""

    def swapped(self) -> Overlaps:
        """The same pairs the other way round."""
        order = np.lexsort((self.first, self.second))
        return Overlaps(
            first=self.second[order],
            second=self.first[order],
            common_m2=self.common_m2[order],
            middle=self.middle[order],
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Matching:
    """Reference buildings r = 0.. and models m = 0.. by their footprints."""

    overlaps: Overlaps
    """All pairs that share area: first is the reference building, second the model."""
    reference_m2: FloatArray
    """(r,) float64, footprint areas."""
    model_m2: FloatArray
    """(m,) float64, footprint areas."""
    model_of: IntArray
    """(r,) int64, the model that stands for it (IoU >= 0.5, one to one); -1 if it was not found."""
    iou: FloatArray
    """(r,) float64, IoU with that model; 0 if it was not found."""
    reference_of: IntArray
    """(m,) int64, the reference building that it stands for; -1 for none."""
    share_on_reference: FloatArray
    """(m,) float64, share of the model's footprint that stands on reference buildings."""
    share_in_extent: FloatArray
    """(m,) float64, share of it where the reference is complete."""
    mostly_on: IntArray
    """(m,) int64, the reference building with the largest common area; -1 for none."""


def sound_polygons(polygons: Sequence[shapely.Geometry]) -> Geometries:
    """The polygons as an array; invalid ones are repaired to the area that they enclose."""
    array = np.empty(len(polygons), dtype=object)
    array[:] = polygons
    bad = ~shapely.is_valid(array)
    if bad.any():
        array[bad] = shapely.make_valid(array[bad], method="structure", keep_collapsed=False)
    return array


def overlapping(first: Geometries, second: Geometries) -> Overlaps:
    """All pairs of two arrays of valid (multi)polygons, from `sound_polygons`, that share area."""
    if len(first) == 0 or len(second) == 0:
        none = np.zeros(0, np.int64)
        return Overlaps(first=none, second=none, common_m2=np.zeros(0), middle=np.zeros((0, 2)))
    a, b = shapely.STRtree(second).query(first)
    bounds_a, bounds_b = shapely.bounds(first), shapely.bounds(second)
    low, high = np.maximum(bounds_a[a, :2], bounds_b[b, :2]), np.minimum(bounds_a[a, 2:], bounds_b[b, 2:])
    near = np.all(high > low, axis=1)
    a, b = a[near], b[near]
    order = np.lexsort((b, a))
    a, b = a[order].astype(np.int64), b[order].astype(np.int64)
    common, middle = np.zeros(len(a)), np.zeros((len(a), 2))
    for start in range(0, len(a), _PAIRS_PER_BLOCK):
        block = slice(start, start + _PAIRS_PER_BLOCK)
        shared = shapely.intersection(first[a[block]], second[b[block]])
        common[block] = shapely.area(shared)
        real = np.flatnonzero(common[block] > _MIN_M2)
        middle[start + real] = shapely.get_coordinates(shapely.centroid(shared[real]))
    some = common > _MIN_M2
    return Overlaps(first=a[some], second=b[some], common_m2=common[some], middle=middle[some])


def summed(index: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Sums of values (n,) by an index (n,) in 0 to count - 1: (count,)."""
    sums: FloatArray = np.bincount(index, weights=values, minlength=count).astype(np.float64)
    return sums


def one_to_one(first: IntArray, second: IntArray, weight: FloatArray) -> BoolArray:
    """Which of some pairs hold when each index may be taken once, the largest weight first.

    Equal weights go by the first index, then by the second. Plan areas that do not overlap within either set compete
    only if they share exactly half, so the order rarely matters. If models overlap each other, it makes a face count
    once.
    """
    kept = np.zeros(len(first), np.bool_)
    taken_first: set[int] = set()
    taken_second: set[int] = set()
    for k in np.lexsort((second, first, -weight)).tolist():
        a, b = int(first[k]), int(second[k])
        if a not in taken_first and b not in taken_second:
            kept[k] = True
            taken_first.add(a)
            taken_second.add(b)
    return kept


def match_footprints(models: Sequence[RoofModel], reference: Reference) -> Matching:
    """Match the footprints of models to those of a reference; ties in IoU go to the smaller index."""
    made = sound_polygons([model.footprint for model in models])
    true = sound_polygons([building.footprint for building in reference.buildings])
    model_m2, reference_m2 = shapely.area(made), shapely.area(true)
    pairs = overlapping(true, made)
    iou = pairs.common_m2 / (reference_m2[pairs.first] + model_m2[pairs.second] - pairs.common_m2)
    enough = np.flatnonzero(iou >= MIN_IOU - _ROUNDING)
    kept = enough[one_to_one(pairs.first[enough], pairs.second[enough], iou[enough])]
    model_of, reference_of = np.full(len(true), -1, np.int64), np.full(len(made), -1, np.int64)
    best = np.zeros(len(true))
    model_of[pairs.first[kept]] = pairs.second[kept]
    reference_of[pairs.second[kept]] = pairs.first[kept]
    best[pairs.first[kept]] = np.minimum(iou[kept], 1.0)
    return Matching(
        overlaps=pairs,
        reference_m2=reference_m2,
        model_m2=model_m2,
        model_of=model_of,
        iou=best,
        reference_of=reference_of,
        share_on_reference=share_covered(made, true, pairs),
        share_in_extent=share_in_extent(made, reference.extent),
        mostly_on=mostly_on(len(made), pairs),
    )


def share_covered(polygons: Geometries, cover: Geometries, pairs: Overlaps) -> FloatArray:
    """Share of the plan area of each polygon, (n,), that a set of others covers; `pairs` name the cover first."""
    areas = shapely.area(polygons)
    common = summed(pairs.second, pairs.common_m2, len(polygons))
    times = np.bincount(pairs.second, minlength=len(polygons))
    several = np.flatnonzero(times > 1)  # here the cover may overlap itself and count twice
    if len(several):
        order = np.argsort(pairs.second, kind="stable")
        start, end = (np.searchsorted(pairs.second[order], several, side) for side in ("left", "right"))
        for k, a, b in zip(several.tolist(), start.tolist(), end.tolist(), strict=True):
            together = shapely.union_all(cover[pairs.first[order[a:b]]])
            common[k] = shapely.area(shapely.intersection(polygons[k], together))
    share: FloatArray = np.minimum(np.divide(common, areas, out=np.zeros(len(polygons)), where=areas > 0.0), 1.0)
    return share


def share_in_extent(polygons: Geometries, extent: shapely.Geometry | None) -> FloatArray:
    """Share of the plan area of each polygon, (n,), inside an extent; 0 without one."""
    if extent is None or len(polygons) == 0:
        return np.zeros(len(polygons))
    areas = shapely.area(polygons)
    shapely.prepare(extent)
    share = np.where(shapely.covers(extent, polygons), 1.0, 0.0)
    border = np.flatnonzero((share == 0.0) & shapely.intersects(extent, polygons) & (areas > 0.0))
    share[border] = shapely.area(shapely.intersection(polygons[border], extent)) / areas[border]
    return share


def mostly_on(count: int, pairs: Overlaps) -> IntArray:
    """For each of `count` second polygons the first one with the largest common area, (count,); -1 for none."""
    found = np.full(count, -1, np.int64)
    order = np.lexsort((-pairs.first, pairs.common_m2))  # ascending: the largest area, then the smallest index, last
    found[pairs.second[order]] = pairs.first[order]
    return found


def where_judged(
    polygons: Geometries, cover: Geometries, pairs: Overlaps, extent: shapely.Geometry | None
) -> BoolArray:
    """Which polygons, (n,), of a model stand where the reference has information.

    At least half of such a polygon lies on reference buildings or in the extent, or it covers at least half of a
    reference building: a polygon that is so large that most of it lies beyond the extent is still judged. `pairs` name
    the buildings first.
    """
    known = np.maximum(share_covered(polygons, cover, pairs), share_in_extent(polygons, extent))
    judged: BoolArray = known >= MIN_SHARE - _ROUNDING
    covering = pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * shapely.area(cover)[pairs.first]
    judged[pairs.second[covering]] = True
    return judged


def excused_models(models: Sequence[RoofModel], reference: Reference) -> BoolArray:
    """Which models, (m,), are excused by the edge of the data where they stand on no reference building.

    These are models across the border of the extent, and models at most 5 m inside that claim to touch the edge.
    For a model on a reference building, the reference alone decides whether it is cut: a model must not choose whether
    it is judged.
    """
    claims = np.array([model.touches_data_edge for model in models], np.bool_)
    if reference.extent is None or len(claims) == 0:
        return claims
    made = sound_polygons([model.footprint for model in models])
    inside = reference.extent.buffer(-EDGE_M, join_style="mitre")
    for area in (reference.extent, inside):
        shapely.prepare(area)
    excused: BoolArray = ~shapely.covers(reference.extent, made) | (claims & ~shapely.contains(inside, made))
    return excused
