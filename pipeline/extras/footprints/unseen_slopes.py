"""The side of a roof that no pulse reached: it continues what the seen side and the footprint suggest.

A strip of the survey may end on a ridge, or a wall may hide the far side of a house. In a given footprint such a place
has no point at all, neither of the roof nor of the ground. A seen slope that rises into it continues to the middle
between its eave and the far edge, and falls from there at the same pitch. Slopes that pass along the place, as at a
hip, continue as well. The roof there is the lowest of them. Its points take part in all further steps as if they had
been seen, and no figure of fit counts them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.extras.footprints.voids import empty_cells, framed_edges, turned_about_origin
from pipeline.model import BoolArray, FloatArray, LabelArray, Plane
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.unsupported_faces import ON_PLANE_M, REACH_SPACINGS

# Not settings: they say what a slope, its eave and a ridge are, in terms of the points.
_FAR_SPACINGS, _FAR_M = 3.0, 1.5
"""Some place of an unseen side is farther than this from all points: chimneys and puddles leave smaller gaps."""
_SLOPED = math.tan(math.radians(7.0))
"""Rise over run of a slope: what falls less is flat, as in `flat_below_deg`."""
_FEWEST = 5
"""Points of a plane beside the place: two more than a plane has parameters."""
_BESIDE_SHARE = 0.1
"""A plane with fewer of the points beside the place does not go on."""
_FITTING_SHARE = 0.6
"""Share of the points beside the place that lie on the planes that go on: else the roof is not one of them."""
_SEEN_SHARE = 0.5
"""Share of the way from eave to ridge that has to be seen: less does not show how high the ridge is."""
_GROUND_SHARE = 0.1
"""Share of the place where other points lie, from which it is a yard, or a roof that is missing."""
_CELL_M = 1.0
"""Side of the cells in which other points were looked for."""
_MOST_CELLS = 20_000
"""Larger places are filled more coarsely."""
_LARGEST_CELLS = 2_000_000
"""Cells of the box around a footprint up to which unseen places are looked for: its parts may lie kilometres apart."""
_SECTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Where the footprint is cut across, as shares of a place's width; the median counts."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Framed:
    """A roof, turned such that the longest edge of its outline runs along x."""

    points: FloatArray
    """(n, 3) metres."""
    labels: LabelArray
    """(n,) plane of each, -1 for none."""
    planes: FloatArray
    """(k, 3) a, b, c."""
    edges: FloatArray
    """(e, 4) of the footprint, metres."""
    pitch_m: float
    """Side of the cells of unseen places."""
    spacing_m: float
    """Typical distance of neighbouring points."""


def with_unseen_slopes(
    roof: RoofPoints, planes: tuple[Plane, ...], elsewhere: FloatArray, settings: RoofSettings
) -> tuple[RoofPoints, tuple[Plane, ...]]:
    """Add points on the unseen sides of a roof in a given footprint, and the planes of these sides.

    `elsewhere` (m, 3), local metres, are the centres of the cells of 1 m wholly in the footprint that hold points, but
    none of the building. The new planes follow the given ones; without an unseen side the same objects come back.
    """
    if roof.footprint_mm is None or len(planes) == 0:
        return roof, planes
    edges, cos, sin = framed_edges(roof.footprint_mm)
    far_m = max(_FAR_M, _FAR_SPACINGS * roof.spacing_m)
    area_m2 = roof.footprint_mm.area * 1e-6
    turned = turned_about_origin(roof.points[:, :2], cos, -sin)
    pitch_m = max(roof.spacing_m, math.sqrt(area_m2 / _MOST_CELLS))
    gap_m = max(REACH_SPACINGS * roof.spacing_m, pitch_m)
    if float(np.prod(np.ptp(edges.reshape(-1, 2), axis=0))) > _LARGEST_CELLS * pitch_m**2:
        return roof, planes
    centres, numbers = empty_cells(turned, edges, pitch_m, gap_m, far_m)
    if len(centres) == 0:
        return roof, planes
    coefficients = np.array([plane.coefficients for plane in planes])
    coefficients[:, :2] = turned_about_origin(coefficients[:, :2], cos, -sin)
    framed = _Framed(
        points=np.column_stack((turned, roof.points[:, 2])),
        labels=roof.labels,
        planes=coefficients,
        edges=edges,
        pitch_m=pitch_m,
        spacing_m=roof.spacing_m,
    )
    other = turned_about_origin(elsewhere[:, :2], cos, -sin)
    xyz, label, extended = [], [], list(planes)
    for k in range(int(numbers.max()) + 1):
        cells = centres[numbers == k]
        if len(cells) * pitch_m**2 < settings.min_void_m2 or _is_seen(cells, pitch_m, other):
            continue
        added = _continued(framed, cells)
        if added is None:
            continue
        surface, sides = added
        used = [side for side in sides if side < len(planes)]
        fresh = [_turned_plane(surface[i], cos, sin) for i in range(len(sides)) if sides[i] >= len(planes)]
        number = np.array([*used, *range(len(extended), len(extended) + len(fresh))], np.int32)
        extended += fresh
        places = _filled(framed, cells)
        z, lowest = _lowest(surface, places)
        xyz.append(np.column_stack((turned_about_origin(places, cos, sin), z)))
        label.append(number[lowest])
    if not xyz:
        return roof, planes
    return _with_points(roof, np.concatenate(xyz), np.concatenate(label)), tuple(extended)


def with_support_of_seen(partition: RoofPartition, planes: Sequence[Plane], roof: RoofPoints) -> list[Plane]:
    """The planes of a partition with the number and residuals of the points that were seen, without the added ones."""
    seen = roof.index >= 0
    if seen.all():
        return list(planes)
    points, (x_mm, y_mm) = roof.points[seen], roof.xy_mm[seen].T
    residuals: dict[int, list[float]] = {}
    for polygon, label in zip(partition.polygons, partition.labels.tolist(), strict=True):
        shapely.prepare(polygon)
        x, y, z = points[shapely.intersects_xy(polygon, x_mm, y_mm)].T
        plane = planes[label]
        off = z - plane.a * x - plane.b * y - plane.c
        residuals.setdefault(label, []).extend(off[np.abs(off) <= ON_PLANE_M].tolist())
    counted = list(planes)
    for label, off in residuals.items():
        rmse_m = math.sqrt(math.fsum(r * r for r in off) / len(off)) if off else 0.0
        counted[label] = dataclasses.replace(planes[label], n_points=len(off), rmse_m=rmse_m)
    return counted


def _is_seen(cells: FloatArray, pitch_m: float, elsewhere: FloatArray) -> bool:
    """Whether other points lie in an unseen place: on the ground of a yard, or where a roof is missing."""
    if len(elsewhere) == 0:
        return False
    places = {(math.floor(x / pitch_m), math.floor(y / pitch_m)) for x, y in (cells - cells[0]).tolist()}
    at = np.floor((elsewhere - cells[0]) / pitch_m + 0.5).astype(np.int64).tolist()
    inside = sum((column, row) in places for column, row in at)
    return inside * _CELL_M**2 >= _GROUND_SHARE * len(cells) * pitch_m**2


def _continued(framed: _Framed, cells: FloatArray) -> tuple[FloatArray, list[int]] | None:
    """The planes (p, 3) whose lowest is the roof over an unseen place, and their numbers, beyond the last for new ones.

    None where no seen slope rises into the place, or where the planes do not explain the points beside it.
    """
    beside, rises = _beside(framed, cells)
    points, labels = framed.points[beside], framed.labels[beside]
    chosen, rising = [], []
    for k in range(len(framed.planes)):
        own = labels == k
        is_sloped = math.hypot(*framed.planes[k, :2].tolist()) >= _SLOPED
        if is_sloped and own.sum() >= max(_FEWEST, _BESIDE_SHARE * len(labels)):
            chosen.append(k)
            if rises[own].mean() > 0.5:
                rising.append(k)
    surface = [framed.planes[k] for k in chosen]
    numbers = list(chosen)
    for k in rising:
        ridge = _ridge(framed, cells, k)
        if ridge is None:
            return None
        a, b, c = framed.planes[k].tolist()
        surface.append(np.array((-a, -b, c + 2.0 * ridge * math.hypot(a, b))))
        numbers.append(len(framed.planes))
    if not rising:
        return None
    planes = np.array(surface)
    z, _ = _lowest(planes, points)
    fits = np.abs(points[:, 2] - z) <= ON_PLANE_M
    return (planes, numbers) if fits.mean() >= _FITTING_SHARE else None


def _filled(framed: _Framed, cells: FloatArray) -> FloatArray:
    """The cells of a place and those around it that lie in the footprint, farther than a spacing from all points.

    Points then end on both sides of a ridge as usual.
    """
    pitch_m, corner = framed.pitch_m, cells.min(axis=0)
    reach = math.ceil(REACH_SPACINGS * framed.spacing_m / pitch_m)
    columns, rows = np.rint((cells - corner) / pitch_m).astype(np.int64).T + reach + 1
    inside = np.zeros((columns.max() + reach + 2, rows.max() + reach + 2), np.bool_)
    inside[columns, rows] = True
    around = np.argwhere(_grown(inside, reach) & ~inside)
    xy = corner + (around - reach - 1) * pitch_m
    xy = xy[_in_edges(xy, framed.edges)]
    near = framed.points[:, :2]
    low, high = xy.min(axis=0, initial=np.inf) - pitch_m, xy.max(axis=0, initial=-np.inf) + pitch_m
    near = near[((near >= low) & (near <= high)).all(axis=1)]
    free = [bool((np.hypot(*(near - place).T) > framed.spacing_m).all()) for place in xy]
    return np.concatenate((cells, xy[np.array(free, np.bool_)]))


def _in_edges(xy: FloatArray, edges: FloatArray) -> BoolArray:
    """Which places (n, 2) lie in rings with these edges (e, 4)."""
    inside = np.zeros(len(xy), np.bool_)
    x, y = xy.T
    for x0, y0, x1, y1 in edges.tolist():
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return inside


def _beside(framed: _Framed, cells: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Which points (n,) lie beside a place; and for those (m,) whether their plane rises into it."""
    pitch_m, corner = framed.pitch_m, cells.min(axis=0)
    reach = math.ceil(REACH_SPACINGS * framed.spacing_m / pitch_m) + 1
    margin = 2 * reach + 1
    shape = tuple((np.rint(np.ptp(cells, axis=0) / pitch_m).astype(int) + 2 * margin + 1).tolist())
    inside = np.zeros(shape, np.bool_)
    column, row = np.rint((cells - corner) / pitch_m).astype(np.int64).T + margin
    inside[column, row] = True
    near = _grown(inside, reach)

    def among(xy: FloatArray, mask: BoolArray) -> BoolArray:
        at = np.rint((xy - corner) / pitch_m).astype(np.int64) + margin
        known = ((at >= 0) & (at < shape)).all(axis=1)
        found = np.zeros(len(xy), np.bool_)
        found[known] = mask[at[known, 0], at[known, 1]]
        return found

    xy = framed.points[:, :2]
    beside = among(xy, near)
    slopes = np.zeros((len(xy), 2))
    known = framed.labels >= 0
    slopes[known] = framed.planes[framed.labels[known], :2]
    steepness = np.hypot(slopes[:, 0], slopes[:, 1])
    up = slopes / np.maximum(steepness, 1e-9)[:, None]
    return beside, among(xy[beside] + up[beside] * (reach * pitch_m), _grown(inside, 1))


def _grown(mask: BoolArray, cells: int) -> BoolArray:
    """A mask grown by so many cells in both directions; its margin is wider."""
    grown = mask.copy()
    for _ in range(cells):
        wide = grown.copy()
        wide[1:] |= grown[:-1]
        wide[:-1] |= grown[1:]
        grown = wide.copy()
        grown[:, 1:] |= wide[:, :-1]
        grown[:, :-1] |= wide[:, 1:]
    return grown


def _ridge(framed: _Framed, cells: FloatArray, k: int) -> float | None:
    """How far up its slope a plane meets its mirror image: half-way between its eave and the far edge of the footprint.

    None where its points show otherwise, or too little of it.
    """
    a, b, _ = framed.planes[k].tolist()
    steepness = math.hypot(a, b)
    up = np.array((a, b)) / steepness
    along, across = _seen_from(cells, up)
    ends = _seen_from(framed.edges.reshape(-1, 2), up)
    starts, stops = (axis.reshape(-1, 2) for axis in ends)
    order = np.argsort(across, kind="stable")
    low, high = [], []
    for share in _SECTIONS:
        at = float(across[order[int(share * (len(order) - 1))]])
        level = along[np.abs(across - at) <= framed.pitch_m]
        crossed = (stops[:, 0] < at) != (stops[:, 1] < at)
        (s0, s1), (t0, t1) = stops[crossed].T, starts[crossed].T
        crossings = np.sort(t0 + (at - s0) / (s1 - s0) * (t1 - t0))
        middle = float(np.median(level))
        n_before = int(np.searchsorted(crossings, middle))
        if n_before % 2 == 1 and n_before < len(crossings):
            low.append(float(crossings[n_before - 1]))
            high.append(float(crossings[n_before]))
    own_along, own_across = _seen_from(framed.points[framed.labels == k], up)
    width = (float(across.min()) - framed.pitch_m, float(across.max()) + framed.pitch_m)
    seen = own_along[(own_across >= width[0]) & (own_across <= width[1])]
    if not low or len(seen) == 0:
        return None
    slack = REACH_SPACINGS * framed.spacing_m
    eave = max(float(np.median(low)), float(seen.min()) - slack)
    ridge = 0.5 * (eave + float(np.median(high)))
    last = float(seen.max())
    if last > ridge + slack or last - eave < _SEEN_SHARE * (ridge - eave):
        return None
    return ridge


def _seen_from(xy: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (n, 2 or 3) along a direction and to its left, metres."""
    return xy[:, 0] * up[0] + xy[:, 1] * up[1], xy[:, 1] * up[0] - xy[:, 0] * up[1]


def _lowest(planes: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height of the lowest of some planes (p, 3) over places (n, 2 or 3), and which one it is."""
    z = planes[:, :1] * places[:, 0] + planes[:, 1:2] * places[:, 1] + planes[:, 2:]
    lowest = np.argmin(z, axis=0)
    return z[lowest, np.arange(len(places))], lowest


def _turned_plane(plane: FloatArray, cos: float, sin: float) -> Plane:
    """A plane of the turned frame in local metres; no point supports it."""
    (a, b), c = turned_about_origin(plane[None, :2], cos, sin)[0].tolist(), float(plane[2])
    return Plane(a=a, b=b, c=c, n_points=0, rmse_m=0.0)


def _with_points(roof: RoofPoints, xyz: FloatArray, labels: LabelArray) -> RoofPoints:
    """The roof points and others, which are in no cloud, in their order; of several at one place the first counts."""
    xy_mm = np.rint(xyz[:, :2] * 1e3).astype(np.int64)
    together = np.concatenate((roof.xy_mm, xy_mm))
    _, order = np.unique(together, axis=0, return_index=True)
    n = len(xyz)
    return dataclasses.replace(
        roof,
        points=np.take(np.concatenate((roof.points, np.column_stack((xy_mm * 1e-3, xyz[:, 2])))), order, axis=0),
        xy_mm=np.take(together, order, axis=0),
        index=np.concatenate((roof.index, np.full(n, -1)))[order],
        labels=np.concatenate((roof.labels, labels.astype(np.int32)))[order],
        split=np.concatenate((roof.split, np.zeros(n, np.bool_)))[order],
    )
