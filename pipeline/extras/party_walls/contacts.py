"""Party walls: where walls of two buildings touch, and what is left of each wall.

The walls of all models are upright planes. Two of them touch where they face each other, are about parallel, and lie
within a small distance: then the part that both share is the intersection of their polygons in the plane between them.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon

from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings
from pipeline.model import BoolArray, FloatArray, IntArray

Shapes = npt.NDArray[np.object_]
"""(n,) shapely geometries."""

ROUNDED_M = 1e-6
"""Distances that differ by less are equal: coordinates are multiples of 1 mm, or of a part of a foot."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walls:
    """The wall faces of some buildings: (n,) each."""

    polygons: Shapes
    """Upright polygons in 3D, metres, counter-clockwise seen from outside."""
    building: npt.NDArray[np.str_]
    """The building."""
    part: IntArray
    """Number of the solid within its building."""
    face: IntArray
    """Number of the face within its building."""

    def __len__(self) -> int:
        """Number of walls."""
        return len(self.polygons)

    def with_others(self, others: Walls) -> Walls:
        """These walls, then others."""
        names = [field.name for field in dataclasses.fields(self)]
        return Walls(**{name: np.concatenate([getattr(self, name), getattr(others, name)]) for name in names})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contacts:
    """Where two walls touch: (k,) each, in the order of building, part and face of the first, then of the second."""

    first: IntArray
    """One wall; of two buildings that with the smaller id."""
    second: IntArray
    """The other wall."""
    polygons: Shapes
    """The shared part in 3D, metres, half-way between both, counter-clockwise seen from outside the first."""
    area_m2: FloatArray
    """Its area."""
    distance_m: FloatArray
    """Mean distance from the first to the second; negative where the buildings overlap."""
    angle_deg: FloatArray
    """Angle between the planes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WallAreas:
    """What is left of some walls, square metres: (n,) each."""

    whole_m2: FloatArray
    """Area of the wall."""
    shared_m2: FloatArray
    """Area in contact with other buildings, each part counted once."""
    inner_m2: FloatArray
    """Further area in contact with other solids of the same building."""


class _Planes:
    """The upright planes of walls: x . normal = offset about the first corner of each."""

    def __init__(self, polygons: Shapes) -> None:
        corners, of = shapely.get_coordinates(shapely.get_exterior_ring(polygons), include_z=True, return_index=True)
        begins = np.searchsorted(of, np.arange(len(polygons)))
        self.origin: FloatArray = corners[begins, :2] if len(polygons) else np.zeros((0, 2))
        local = corners - np.column_stack((self.origin, np.zeros(len(polygons))))[of]
        # Newell's normal, summed over the edges of each ring; the last corner repeats the first
        cross = np.cross(local[:-1], local[1:])[of[:-1] == of[1:]]
        edge_of = of[:-1][of[:-1] == of[1:]]
        sums = np.stack([np.bincount(edge_of, cross[:, axis], len(polygons)) for axis in (0, 1)], axis=1)
        length = np.hypot(sums[:, 0], sums[:, 1])
        self.normal: FloatArray = sums / np.where(length > 0.0, length, 1.0)[:, None]
        distance = np.sum(local[:, :2] * self.normal[of], axis=1)
        self.offset: FloatArray = np.bincount(of, distance, len(polygons)) / np.maximum(
            np.bincount(of, minlength=len(polygons)), 1
        )

    def along(self) -> FloatArray:
        """Unit vectors along the walls, to the left seen from inside: (n, 2)."""
        return _turned(self.normal)


def _turned(vectors: FloatArray) -> FloatArray:
    """Plan vectors, (n, 2), turned by 90 degrees to the left."""
    return np.column_stack((-vectors[:, 1], vectors[:, 0]))


def _flat(polygons: Shapes, origin: FloatArray, along: FloatArray) -> Shapes:
    """Upright polygons in 2D: distance along a direction from an origin, (n, 2) each, and elevation."""
    xyz, of = shapely.get_coordinates(polygons, include_z=True, return_index=True)
    s = np.sum((xyz[:, :2] - origin[of]) * along[of], axis=1)
    flat: Shapes = shapely.set_coordinates(shapely.force_2d(polygons), np.column_stack((s, xyz[:, 2])))
    bad = ~shapely.is_valid(flat)
    flat[bad] = shapely.make_valid(flat[bad])
    return flat


def contacts(walls: Walls, own: BoolArray, settings: PartyWallSettings) -> Contacts:
    """Where walls of different solids touch, if at least one of both is an `own` one, (n,) bool.

    Two walls with unit normals n and m face each other if n . m <= -cos(max_angle). In the plane half-way between
    them, upright along u, both are polygons over (s, z); their intersection is the contact. The distance d(s) between
    both planes is linear in s, so its mean is that at the centroid, and what is farther apart is cut off as a strip.
    """
    planes = _Planes(walls.polygons)
    first, second = _pairs(walls, planes, own, settings)
    normal = planes.normal[first] - planes.normal[second]
    normal /= np.hypot(normal[:, 0], normal[:, 1])[:, None]
    origin, along = planes.origin[first], _turned(normal)
    shared: Shapes = shapely.intersection(
        _flat(walls.polygons[first], origin, along), _flat(walls.polygons[second], origin, along)
    )
    shared = _areas_only(shared)
    ahead = [_ahead(planes, index, origin, along, normal) for index in (first, second)]
    gap = ahead[1] - ahead[0]
    shared = _areas_only(_within(shared, gap, settings.max_distance_m + ROUNDED_M))
    area = shapely.area(shared)
    kept = area >= max(settings.min_area_m2, ROUNDED_M)
    order = np.flatnonzero(kept)
    first, second, shared, gap = first[order], second[order], shared[order], gap[order]
    middle = ((ahead[0] + ahead[1]) / 2.0)[order]
    centroid = shapely.get_x(shapely.centroid(shared))
    cosine = -np.sum(planes.normal[first] * planes.normal[second], axis=1)
    return Contacts(
        first=first,
        second=second,
        polygons=_upright(shared, origin[order], along[order], normal[order], middle),
        area_m2=area[order],
        distance_m=gap[:, 0] + gap[:, 1] * centroid,
        angle_deg=np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))),
    )


def _pairs(walls: Walls, planes: _Planes, own: BoolArray, settings: PartyWallSettings) -> tuple[IntArray, IntArray]:
    """Pairs of walls of different solids that face each other and are near in plan, sorted; each pair once."""
    flat = shapely.bounds(_flat(walls.polygons, planes.origin, planes.along())).reshape(-1, 4)
    ends = [
        planes.origin + planes.normal * planes.offset[:, None] + planes.along() * flat[:, axis, None] for axis in (0, 2)
    ]
    traces = shapely.linestrings(np.stack(ends, axis=1))
    mine = np.flatnonzero(own)
    # the planes of two walls may turn towards each other between their traces' ends
    asked, found = shapely.STRtree(traces).query(
        traces[mine], predicate="dwithin", distance=settings.max_distance_m + ROUNDED_M
    )
    first, second = mine[asked], found
    rank = np.empty(len(walls), np.int64)
    rank[np.lexsort((walls.face, walls.part, walls.building))] = np.arange(len(walls))
    swapped = rank[first] > rank[second]
    first, second = np.where(swapped, second, first), np.where(swapped, first, second)
    facing = np.sum(planes.normal[first] * planes.normal[second], axis=1)
    apart = (walls.building[first] != walls.building[second]) | (walls.part[first] != walls.part[second])
    kept = apart & (facing <= -math.cos(math.radians(settings.max_angle_deg)) + 1e-12)
    first, second = first[kept], second[kept]
    _, once = np.unique(np.stack((rank[first], rank[second])), axis=1, return_index=True)
    return first[once], second[once]


def _ahead(planes: _Planes, index: IntArray, origin: FloatArray, along: FloatArray, normal: FloatArray) -> FloatArray:
    """How far some planes lie ahead of an origin along a normal, as c + k s of the distance s along: (n, 2) of c, k."""
    own = planes.normal[index]
    across = np.sum(own * normal, axis=1)
    offset = planes.offset[index] + np.sum(own * (planes.origin[index] - origin), axis=1)
    lines: FloatArray = np.column_stack((offset, -np.sum(own * along, axis=1))) / across[:, None]
    return lines


def _within(shared: Shapes, gap: FloatArray, limit_m: float) -> Shapes:
    """What of flat polygons lies where |c + k s| is at most a limit, by `gap` (n, 2) of c, k."""
    bounds = shapely.bounds(shared).reshape(-1, 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_ends = np.abs(gap[:, :1] + gap[:, 1:] * bounds[:, [0, 2]])
        roots = (np.array([-limit_m, limit_m]) - gap[:, :1]) / gap[:, 1:]
    clipped = np.array(shared)
    far = np.flatnonzero((at_ends > limit_m).any(axis=1))
    for k in far.tolist():
        if not np.isfinite(roots[k]).all():  # parallel, and too far everywhere
            clipped[k] = MultiPolygon()
            continue
        low, high = sorted(roots[k].tolist())
        _, bottom, _, top = bounds[k]
        clipped[k] = shapely.intersection(shared[k], shapely.box(low, bottom - 1.0, high, top + 1.0))
    return clipped


def _areas_only(shapes: Shapes) -> Shapes:
    """The polygons of shapes; empty ones of lines and points."""
    kinds = shapely.get_type_id(shapes)
    polygonal = np.isin(kinds, (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON))
    found = np.array(shapes)
    for k in np.flatnonzero(~polygonal).tolist():
        parts = shapely.get_parts(shapes[k])
        found[k] = MultiPolygon([part for part in parts if part.geom_type == "Polygon"])
    return found


def _upright(shared: Shapes, origin: FloatArray, along: FloatArray, normal: FloatArray, ahead: FloatArray) -> Shapes:
    """Flat polygons back in 3D, `ahead` of the origin by c + k s, (n, 2) of c, k."""
    ordered = shapely.orient_polygons(shapely.normalize(shared), exterior_cw=False)
    sz, of = shapely.get_coordinates(ordered, return_index=True)
    t = ahead[of, 0] + ahead[of, 1] * sz[:, 0]
    xy = origin[of] + sz[:, :1] * along[of] + t[:, None] * normal[of]
    upright: Shapes = shapely.set_coordinates(shapely.force_3d(ordered), np.column_stack((xy, sz[:, 1])))
    return upright


def wall_areas(walls: Walls, found: Contacts) -> WallAreas:
    """The area of each wall, and what of it touches another building, or another solid of its own."""
    planes = _Planes(walls.polygons)
    along, ahead = planes.along(), planes.origin + planes.normal * planes.offset[:, None]
    whole = shapely.area(_flat(walls.polygons, planes.origin, along))
    across = planes.normal[found.first] - planes.normal[found.second]
    shared, touched = np.zeros(len(walls)), np.zeros(len(walls))
    other = walls.building[found.first] != walls.building[found.second]
    wall = np.concatenate((found.first, found.second))
    contact = np.tile(np.arange(len(found.first)), 2)
    order = np.argsort(wall, kind="stable")
    begins = np.flatnonzero(np.diff(wall[order], prepend=-1))
    for some in np.split(order, begins[1:]) if len(order) else ():
        k, at = int(wall[some[0]]), contact[some]
        # a contact lies between both walls: each of its corners goes along its normal to this one
        turn = (across[at] @ along[k]) / (across[at] @ planes.normal[k])
        flat = _flat(found.polygons[at], np.tile(ahead[k], (len(at), 1)), along[k] - turn[:, None] * planes.normal[k])
        touched[k] = _united_m2(flat)
        shared[k] = _united_m2(flat[other[at]])
    touched, shared = np.minimum(touched, whole), np.minimum(shared, whole)
    return WallAreas(whole_m2=whole, shared_m2=shared, inner_m2=np.maximum(touched - shared, 0.0))


def _united_m2(shapes: Any) -> float:
    """Area of flat polygons together; overlaps count once."""
    return float(shapely.area(shapes[0] if len(shapes) == 1 else shapely.union_all(shapes)))
