"""Dimensions of a delivered model in local metres: eave, ridge, percentiles of roof elevation, roof area, volume."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from pipeline.model import FaceKind, FloatArray, Solid

FLAT_BELOW_DEG = 7.0
"""Roof planes below this slope count as flat (Hofmann, Maas and Streilein 2003): all their outer edges are eaves."""
EAVE_WITHIN_DEG = 45.0
"""An outer edge is an eave where it faces the plane's aspect within this angle; else it is a rake or a high edge."""
_FLAT, _FACING = math.tan(math.radians(FLAT_BELOW_DEG)), math.cos(math.radians(EAVE_WITHIN_DEG))
_MAX_AT_ONCE = 2_000
"""Levels times triangles up to which the areas below all levels at once take less time than a bisection."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dimensions:
    """Dimensions of one building's solids; elevations are local metres."""

    eave_z_m: float
    """Median elevation of the eave edges, each roof face weighing its area."""
    ridge_z_m: float
    """Highest roof point."""
    roof_z_m: tuple[float, float, float, float]
    """Lowest roof point, 50th and 70th percentile of roof elevation over plan area, highest roof point."""
    roof_area_m2: float
    """True (slanted) area of all roof faces."""
    volume_m3: float
    """Sum of the solids' volumes."""


def area_vector(vertices: FloatArray, rings: Sequence[Sequence[int]]) -> FloatArray:
    """Area vector of a planar face: along its normal, as long as its area (Newell), shape (3,), square metres."""
    return np.array(_area_vector(vertices.tolist(), rings))


def _area_vector(corners: Sequence[Sequence[float]], rings: Sequence[Sequence[int]]) -> tuple[float, float, float]:
    """The same of numbers: a face has few corners, and numpy takes longer to begin than they take."""
    anchor_x, anchor_y, anchor_z = corners[rings[0][0]]
    total_x = total_y = total_z = 0.0
    for ring in rings:
        ring_x = ring_y = ring_z = 0.0
        x, y, z = corners[ring[0]]
        x, y, z = x - anchor_x, y - anchor_y, z - anchor_z
        for index in (*ring[1:], ring[0]):
            next_x, next_y, next_z = corners[index]
            next_x, next_y, next_z = next_x - anchor_x, next_y - anchor_y, next_z - anchor_z
            ring_x += y * next_z - z * next_y
            ring_y += z * next_x - x * next_z
            ring_z += x * next_y - y * next_x
            x, y, z = next_x, next_y, next_z
        total_x, total_y, total_z = total_x + ring_x, total_y + ring_y, total_z + ring_z
    return 0.5 * total_x, 0.5 * total_y, 0.5 * total_z


def volume(solid: Solid) -> float:
    """Volume of a closed, outward oriented solid, cubic metres (divergence theorem)."""
    return _volume(_measured(solid))


@dataclasses.dataclass(frozen=True)
class _Measured:
    """A solid with what several figures are made of: numbers in lists, since its faces have few corners."""

    solid: Solid
    corners: list[list[float]]
    """Its vertices."""
    vectors: list[tuple[float, float, float]]
    """The area vectors of its faces, in their order."""


def _measured(solid: Solid) -> _Measured:
    """A solid, its faces measured once for all figures."""
    corners = solid.vertices.tolist()
    return _Measured(solid, corners, [_area_vector(corners, face.rings) for face in solid.faces])


def _volume(measured: _Measured) -> float:
    """The volume of a measured solid."""
    total = 0.0
    for face, (normal_x, normal_y, normal_z) in zip(measured.solid.faces, measured.vectors, strict=True):
        x, y, z = measured.corners[face.rings[0][0]]
        total += x * normal_x + y * normal_y + z * normal_z
    return total / 3.0


def weighted_median(values: Sequence[float], weights: Sequence[float]) -> float:
    """The smallest value at which the running weight reaches half of the whole; nan of nothing.

    >>> weighted_median([3.0, 1.0, 2.0], [1.0, 1.0, 5.0])
    2.0
    """
    if not values:
        return math.nan
    order = sorted(range(len(values)), key=lambda i: (values[i], i))
    half, running = 0.5 * sum(weights[i] for i in order), 0.0
    for i in order:
        running += weights[i]
        if running >= half:
            return values[i]
    return values[order[-1]]


def _outer_edges(solid: Solid) -> set[tuple[int, int]]:
    """Directed edges of the walls that stand on the ground."""
    ground = {
        edge for face in solid.faces if face.kind is FaceKind.GROUND for ring in face.rings for edge in _edges(ring)
    }
    outer = set()
    for face in solid.faces:
        if face.kind is not FaceKind.WALL:
            continue
        edges = [edge for ring in face.rings for edge in _edges(ring)]
        if any((b, a) in ground for a, b in edges):
            outer.update(edges)
    return outer


def _edges(ring: Sequence[int]) -> list[tuple[int, int]]:
    """The directed edges of a ring."""
    return list(zip(ring, (*ring[1:], ring[0]), strict=True))


def _is_eave(step_x: float, step_y: float, normal: tuple[float, float, float]) -> bool:
    """Whether a roof face's outer edge is its low side; the step runs counter-clockwise seen from above."""
    tilt = math.hypot(normal[0], normal[1])
    if tilt <= _FLAT * abs(normal[2]):
        return True
    along = step_y * normal[0] - step_x * normal[1]
    return along >= _FACING * math.hypot(step_x, step_y) * tilt


def _eave_elevation(measured: Sequence[_Measured]) -> float:
    """Median elevation of the eave edges: the low outer edges of the roof faces; nan where there are none.

    An edge counts at its middle; a face's weight is its plan area, shared among its eaves by length.
    """
    values: list[float] = []
    weights: list[float] = []
    for each in measured:
        outer, corners = _outer_edges(each.solid), each.corners
        for face, normal in zip(each.solid.faces, each.vectors, strict=True):
            if face.kind is not FaceKind.ROOF:
                continue
            middles, lengths = [], []
            for a, b in (edge for ring in face.rings for edge in _edges(ring) if edge[::-1] in outer):
                (from_x, from_y, from_z), (to_x, to_y, to_z) = corners[a], corners[b]
                if _is_eave(to_x - from_x, to_y - from_y, normal):
                    middles.append(0.5 * (from_z + to_z))
                    lengths.append(math.hypot(to_x - from_x, to_y - from_y))
            total = sum(lengths)
            values.extend(middles)
            weights.extend(abs(normal[2]) * length / total for length in lengths)
    return weighted_median(values, weights)


def _roof_triangles(solids: Sequence[Solid]) -> tuple[FloatArray, FloatArray]:
    """Sorted elevations (t, 3) and signed plan areas (t,) of fans over the roof faces; signs cancel outside a face."""
    corners: list[list[float]] = []
    areas: list[float] = []
    for solid in solids:
        xyz = solid.vertices.tolist()
        for face in solid.faces:
            if face.kind is not FaceKind.ROOF:
                continue
            for ring in face.rings:
                apex_x, apex_y, apex_z = xyz[ring[0]]
                for first, second in itertools.pairwise(ring[1:]):
                    (one_x, one_y, one_z), (two_x, two_y, two_z) = xyz[first], xyz[second]
                    one_x, one_y, two_x, two_y = one_x - apex_x, one_y - apex_y, two_x - apex_x, two_y - apex_y
                    areas.append(0.5 * (one_x * two_y - one_y * two_x))
                    corners.append(sorted((apex_z, one_z, two_z)))
    if not corners:
        return np.empty((0, 3)), np.empty(0)
    return np.array(corners), np.array(areas)


def _area_below(level: FloatArray, corner_z: FloatArray, area: FloatArray) -> FloatArray:
    """Plan area of the roof at or below each level, shape (k,)."""
    z = level[:, None]
    low, middle, high = corner_z[:, 0], corner_z[:, 1], corner_z[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        rising = (z - low) ** 2 / ((middle - low) * (high - low))
        falling = 1.0 - (high - z) ** 2 / ((high - middle) * (high - low))
    share = np.where(z >= high, 1.0, np.where(z < low, 0.0, np.where(z < middle, rising, falling)))
    below: FloatArray = np.sum(share * area, axis=1)
    return below


def roof_percentiles(solids: Sequence[Solid], shares: Sequence[float]) -> tuple[float, ...]:
    """Elevations below which the given shares of the roof's plan area lie; nan without a roof.

    Between two neighbouring vertex elevations the area below a level is a quadratic of the level, so each percentile
    is solved exactly, without a raster.
    """
    corner_z, area = _roof_triangles(solids)
    if len(area) == 0:
        return tuple(math.nan for _ in shares)
    levels = np.unique(corner_z)
    if len(levels) * len(area) <= _MAX_AT_ONCE:
        below = _area_below(levels, corner_z, area).tolist().__getitem__
    else:
        # a block has thousands of levels and of triangles, and their product is not needed
        def below(index: int) -> float:
            return float(_area_below(levels[index : index + 1], corner_z, area)[0])

    total = below(len(levels) - 1)
    found = []
    for share in shares:
        target = share * total
        upper = bisect.bisect_left(range(len(levels)), target - 1e-9 * total, key=below)
        if upper == 0 or total <= 0.0:
            found.append(float(levels[min(upper, len(levels) - 1)]))
            continue
        found.append(_within(target, float(levels[upper - 1]), float(levels[upper]), corner_z, area))
    return tuple(found)


def _within(target: float, low: float, high: float, corner_z: FloatArray, area: FloatArray) -> float:
    """The level between two neighbouring vertex elevations where the area below reaches the target.

    The area may jump at `high`, where a level face begins; then `high` is the answer for targets within the jump.
    """
    samples = np.array([low, low + (high - low) / 3.0, low + 2.0 * (high - low) / 3.0])
    first, second, third = (float(v) for v in _area_below(samples, corner_z, area))
    # The parabola through t = 0, 1, 2 thirds of the way.
    curve = 0.5 * (third - 2.0 * second + first)
    slope = second - first - curve
    missing = target - first
    if 9.0 * curve + 3.0 * slope < missing:
        return high
    root = math.sqrt(max(0.0, slope * slope + 4.0 * curve * missing))
    if slope + root <= 0.0:
        return low
    # The stable form of the root: no difference of near numbers.
    thirds = 2.0 * missing / (slope + root)
    return low + (high - low) * min(max(thirds / 3.0, 0.0), 1.0)


def dimensions(solids: Sequence[Solid]) -> Dimensions:
    """Measure the delivered solids of one building; all nan and zero areas without a roof.

    Where no outer edge is an eave (a roof that only leans on others), the lowest roof point stands for the eave.
    """
    roof_z: list[float] = []
    roof_area = 0.0
    measured = [_measured(solid) for solid in solids]
    for each in measured:
        for face, (x, y, z) in zip(each.solid.faces, each.vectors, strict=True):
            if face.kind is FaceKind.ROOF:
                roof_z.extend(each.corners[index][2] for ring in face.rings for index in ring)
                roof_area += math.sqrt(x**2 + y**2 + z**2)
    lowest, highest = (min(roof_z), max(roof_z)) if roof_z else (math.nan, math.nan)
    eave = _eave_elevation(measured)
    median, seventieth = roof_percentiles(solids, (0.5, 0.7))
    return Dimensions(
        eave_z_m=lowest if math.isnan(eave) else eave,
        ridge_z_m=highest,
        roof_z_m=(lowest, median, seventieth, highest),
        roof_area_m2=roof_area,
        volume_m3=sum(_volume(each) for each in measured),
    )
