"""Which model face matches which true face, and groups of true faces that count as one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.building_matching import (
    MIN_SHARE,
    Geometries,
    Overlaps,
    one_to_one,
    overlapping,
    sound_polygons,
    summed,
)
from pipeline.ruler.evaluation.models import RoofModel

MAX_NORMAL_ANGLE_DEG = 10.0
"""Largest angle between the normals of a face and its match."""
MAX_OFFSET_M = 0.3
"""Largest mean distance between a face and its match, across the true plane."""
_ROUNDING = 1e-6
"""Numerical guard, metres and degrees: exactly the limit is still within it."""
_ROUNDING_SHARE = 1e-9
"""Numerical guard for comparisons of shares."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planes:
    """Plan polygons with their planes, z = height + a (x - x0) + b (y - y0). All of length n."""

    owner: IntArray
    """(n,) int64, index of the building or model."""
    polygon: Geometries
    """(n,) valid polygons."""
    plan_m2: FloatArray
    """(n,) area in plan."""
    rise: FloatArray
    """(n, 2): a, b."""
    place: FloatArray
    """(n, 3): x0, y0, height."""

    @property
    def area_m2(self) -> FloatArray:
        """(n,) area in the plane."""
        return self.plan_m2 / self.upward

    @property
    def upward(self) -> FloatArray:
        """(n,) cosine of the slope: the unit normal's vertical component."""
        upward: FloatArray = 1.0 / np.sqrt(1.0 + np.square(self.rise).sum(axis=1))
        return upward

    @property
    def slope_deg(self) -> FloatArray:
        """(n,) 0 is horizontal."""
        return np.degrees(np.arctan(np.hypot(self.rise[:, 0], self.rise[:, 1])))

    def normals(self) -> FloatArray:
        """(n, 3) unit normals, upwards."""
        normals: FloatArray = np.column_stack([-self.rise, np.ones(len(self.rise))]) * self.upward[:, None]
        return normals

    def elevation(self, index: IntArray, places: FloatArray) -> FloatArray:
        """Elevation (k,) of the planes of an index (k,) at places (k, 2)."""
        above: FloatArray = ((places - self.place[index, :2]) * self.rise[index]).sum(axis=1)
        elevation: FloatArray = self.place[index, 2] + above
        return elevation


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compared:
    """Pairs of a true face and a model face that overlap. All of length p."""

    overlaps: Overlaps
    """First the true face, second the model face."""
    share_true: FloatArray
    """(p,) common area as share of the true face, in plan."""
    share_model: FloatArray
    """(p,) common area as share of the model face, in plan."""
    angle_deg: FloatArray
    """(p,) between the normals."""
    offset_m: FloatArray
    """(p,) model minus true plane, mean over the common area, across the true plane."""
    fits: BoolArray
    """(p,) whether overlap, angle and offset are within the limits."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaceMatch:
    """The matches of faces. A unit is a true face alone, or a group of them."""

    true: Planes
    """(n) true faces."""
    made: Planes
    """(m) model faces."""
    pairs: Compared
    """Single faces against model faces."""
    pair_of: IntArray
    """(n,) the pair by which a true face was matched itself; -1 for none."""
    unit: IntArray
    """(n,) the unit of each true face, 0 to u - 1 in the order of their first faces."""
    pieces: IntArray
    """(u,) number of faces in each unit."""
    found: BoolArray
    """(u,) whether it was found."""
    wholes: Compared
    """Unions of groups that their pieces alone did not find, against model faces; first is the unit."""
    whole_of: IntArray
    """(u,) the pair of `wholes` by which a group was found; -1 for none."""
    matched_unit: IntArray
    """(m,) the unit that a model face matches, itself or a piece of it; -1 for none."""


def flattened(buildings: Sequence[RoofModel]) -> Planes:
    """All roof faces of some buildings, one after the other."""
    surfaces = [surface for building in buildings for surface in building.surfaces]
    counts = [len(building.surfaces) for building in buildings]
    polygon = sound_polygons([surface.polygon for surface in surfaces])
    coefficients = np.array([surface.coefficients for surface in surfaces], np.float64).reshape(-1, 3)
    origin = np.array([surface.origin for surface in surfaces], np.float64).reshape(-1, 3)
    return Planes(
        owner=np.repeat(np.arange(len(buildings)), counts),
        polygon=polygon,
        plan_m2=shapely.area(polygon),
        rise=coefficients[:, :2],
        place=np.column_stack([origin[:, :2], origin[:, 2] + coefficients[:, 2]]),
    )


def compared(true: Planes, made: Planes) -> Compared:
    """All pairs that overlap, with their figures."""
    overlaps = overlapping(true.polygon, made.polygon)
    t, m = overlaps.first, overlaps.second
    normals, others = true.normals()[t], made.normals()[m]
    sine = np.linalg.norm(np.cross(normals, others), axis=1)
    angle = np.degrees(np.arctan2(sine, (normals * others).sum(axis=1)))
    offset = (made.elevation(m, overlaps.middle) - true.elevation(t, overlaps.middle)) * true.upward[t]
    share_true, share_model = overlaps.common_m2 / true.plan_m2[t], overlaps.common_m2 / made.plan_m2[m]
    fits = (
        (np.minimum(share_true, share_model) >= MIN_SHARE - _ROUNDING_SHARE)
        & (angle <= MAX_NORMAL_ANGLE_DEG + _ROUNDING)
        & (np.abs(offset) <= MAX_OFFSET_M + _ROUNDING)
    )
    return Compared(
        overlaps=overlaps,
        share_true=np.minimum(share_true, 1.0),
        share_model=np.minimum(share_model, 1.0),
        angle_deg=angle,
        offset_m=offset,
        fits=fits,
    )


def match_faces(models: Sequence[RoofModel], reference: Sequence[RoofModel]) -> FaceMatch:
    """Match all faces of all models to all true faces, one to one, the largest common area first.

    Single faces and pieces of groups are matched first. A group is found if its matched pieces have at least half of
    its area, or if a model face that is free, or matches one of its pieces, matches its union and mean plane.
    """
    true, made = flattened(reference), flattened(models)
    unit = _units(reference)
    units = int(unit.max()) + 1 if len(unit) else 0
    pieces = np.bincount(unit, minlength=units)
    pairs = compared(true, made)
    kept = _best(pairs, pairs.fits)
    pair_of, matched_unit = np.full(len(unit), -1, np.int64), np.full(len(made.owner), -1, np.int64)
    pair_of[pairs.overlaps.first[kept]] = kept
    matched_unit[pairs.overlaps.second[kept]] = unit[pairs.overlaps.first[kept]]

    area = summed(unit, true.area_m2, units)
    held = summed(unit, np.where(pair_of >= 0, true.area_m2, 0.0), units)
    found = (held > 0.0) & (held >= (MIN_SHARE - _ROUNDING_SHARE) * area)

    groups = np.flatnonzero((pieces > 1) & ~found)
    wholes = compared(_unions(true, unit, groups), made)
    by_unit = dataclasses.replace(wholes.overlaps, first=groups[wholes.overlaps.first])
    wholes = dataclasses.replace(wholes, overlaps=by_unit)
    taken = matched_unit[by_unit.second]
    kept = _best(wholes, wholes.fits & ((taken < 0) | (taken == by_unit.first)))
    whole_of = np.full(units, -1, np.int64)
    whole_of[by_unit.first[kept]] = kept
    found[by_unit.first[kept]] = True
    matched_unit[by_unit.second[kept]] = by_unit.first[kept]
    return FaceMatch(
        true=true,
        made=made,
        pairs=pairs,
        pair_of=pair_of,
        unit=unit,
        pieces=pieces,
        found=found,
        wholes=wholes,
        whole_of=whole_of,
        matched_unit=matched_unit,
    )


def _best(pairs: Compared, allowed: BoolArray) -> IntArray:
    """The allowed pairs that hold one to one, by index."""
    index = np.flatnonzero(allowed)
    overlaps = pairs.overlaps
    return index[one_to_one(overlaps.first[index], overlaps.second[index], overlaps.common_m2[index])]


def _units(buildings: Sequence[RoofModel]) -> IntArray:
    """The unit of every face: surfaces of one building with one group >= 0 share it."""
    numbers: dict[tuple[int, int, int], int] = {}
    units = []
    for owner, building in enumerate(buildings):
        for place, surface in enumerate(building.surfaces):
            key = (owner, surface.group, -1) if surface.group >= 0 else (owner, -1, place)
            units.append(numbers.setdefault(key, len(numbers)))
    return np.array(units, np.int64)


def _unions(true: Planes, unit: IntArray, groups: IntArray) -> Planes:
    """Groups as one face each: their union, with the mean of elevation and rise over their plan.

    The mean of the rises weighted by plan area is the direction of the normals' mean weighted by area in the plane.
    """
    order = np.argsort(unit, kind="stable")
    start, end = (np.searchsorted(unit[order], groups, side) for side in ("left", "right"))
    members = [order[a:b] for a, b in zip(start.tolist(), end.tolist(), strict=True)]
    polygon = sound_polygons([shapely.union_all(true.polygon[index]) for index in members])
    rise, place = np.zeros((len(groups), 2)), np.zeros((len(groups), 3))
    for k, index in enumerate(members):
        weights = true.plan_m2[index] / true.plan_m2[index].sum()
        centroids = shapely.get_coordinates(shapely.centroid(true.polygon[index]))
        rise[k] = weights @ true.rise[index]
        place[k, :2] = weights @ centroids
        place[k, 2] = weights @ true.elevation(index, centroids)
    return Planes(
        owner=true.owner[np.array([index[0] for index in members], np.int64)],
        polygon=polygon,
        plan_m2=shapely.area(polygon),
        rise=rise,
        place=place,
    )
