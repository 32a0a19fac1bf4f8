"""Measured points against the models: the vertical distance to the top surface over the reference footprints.

Every roof point inside a reference footprint counts, whatever the footprints of the models are. A point without a roof
above or below it is a miss, so a smaller footprint cannot buy a better score. The top surface is the highest roof face
of all models together. Top-visible points have no other roof point of the same building more than 1.1 m higher within
0.5 m in plan: points on facades and under overhangs are left out.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.geometry import top_visible
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.quality.residuals import TopSurface
from pipeline.ruler.evaluation.bootstrap import Statistic, quantile, ratio, root_mean, share
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.subsets import Subset, measured, measured_median

TOLERANCE_M = 0.2
"""Vertical distance that still counts as right."""
ROUNDING_M = 0.001
"""Models are rounded to 1 mm: narrower gaps between faces are closed."""
VISIBLE_RADIUS_M = 0.5
"""Within this distance in plan a higher point hides a lower one."""
EDGES_M: FloatArray = np.concatenate(
    (np.arange(200) * 0.005, 1.0 + np.arange(80) * 0.05, 5.0 + np.arange(90) * 0.5, [50.0, 1e5])
)
"""Borders of the bins of |residual|: 5 mm up to 1 m, 50 mm up to 5 m, 0.5 m up to 50 m, and all beyond."""

_BEYOND_M = 10.0
"""Roofs farther from all reference buildings are left out of the index."""
_COLUMNS = ("n_points", "n_covered", "n_within")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tally:
    """Sums over vertical distances at places of a roof."""

    n_points: int
    """Places, measured points or those of a lattice."""
    n_covered: int
    """Places that a roof of the models covers."""
    n_within: int
    """Covered places within 0.2 m."""
    sum_m: float
    """Sum of the distances of the covered ones."""
    sum_squares_m2: float
    """Sum of their squares."""
    histogram: npt.NDArray[np.int32]
    """(bins,) int32, the covered ones by |distance| over `EDGES_M` of the module."""

    @property
    def rmse_m(self) -> float:
        """Root mean square of the covered places; nan without any."""
        return math.sqrt(self.sum_squares_m2 / self.n_covered) if self.n_covered else math.nan

    @property
    def bias_m(self) -> float:
        """Mean of the covered places; nan without any."""
        return self.sum_m / self.n_covered if self.n_covered else math.nan

    @property
    def share_within(self) -> float:
        """Share of all places within 0.2 m; uncovered is a miss; nan without places."""
        return self.n_within / self.n_points if self.n_points else math.nan

    @property
    def coverage(self) -> float:
        """Share of all places that a roof covers; nan without places."""
        return self.n_covered / self.n_points if self.n_points else math.nan


class ResidualTally(Tally):
    """Sums over the residuals of roof points: point minus roof, positive if the points are above the roof."""

    @property
    def median_m(self) -> float:
        """Median of |residual| of the covered points, to a bin; nan without any."""
        return self._quantile(0.5)

    @property
    def p95_m(self) -> float:
        """95th percentile of the same."""
        return self._quantile(0.95)

    def _quantile(self, share: float) -> float:
        return float(quantile("h", EDGES_M, share)({"h": self.histogram[None].astype(np.float64)})[0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingResiduals:
    """The residuals of one reference building."""

    building: int
    """Index into the reference's buildings."""
    building_id: str
    """Its name."""
    all_points: ResidualTally
    """All roof points inside the footprint."""
    top_visible: ResidualTally
    """Top-visible points."""
    counts: bool = True
    """False if it touches the edge of the data: it need not be found. Outlines of the raster count all the same: in a
    dense town they are connected, and the blocks that are cut have most of the points."""


def top_surface_of(models: Sequence[RoofModel], *, near: Sequence[RoofModel] | None = None) -> TopSurface:
    """The highest roof face of all models at any place, if given `near` the bounds of some footprints.

    One model at a wrong place in the world would make the index of all others coarse.
    """
    surfaces = [surface for model in models for surface in model.surfaces]
    polygons = [surface.polygon for surface in surfaces]
    if near is not None:
        west, south, east, north = shapely.total_bounds([building.footprint for building in near])
        reach = shapely.box(west - _BEYOND_M, south - _BEYOND_M, east + _BEYOND_M, north + _BEYOND_M)
        shapely.prepare(reach)
        kept = np.flatnonzero(shapely.intersects(reach, polygons)).tolist()
        surfaces = [surfaces[k] for k in kept]
        whole = shapely.contains(reach, [surface.polygon for surface in surfaces])
        polygons = [
            surface.polygon if is_whole else _area_within(surface.polygon, reach)
            for surface, is_whole in zip(surfaces, whole.tolist(), strict=True)
        ]
    return TopSurface(
        polygons,
        np.array([surface.coefficients for surface in surfaces]).reshape(-1, 3),
        np.array([surface.origin for surface in surfaces]).reshape(-1, 3),
        tolerance_m=ROUNDING_M,
    )


def _area_within(polygon: Polygon, reach: Polygon) -> Polygon | MultiPolygon:
    """The part of a polygon within reach, without lines and points."""
    pieces = shapely.get_parts(shapely.intersection(shapely.make_valid(polygon), reach)).tolist()
    return MultiPolygon([piece for piece in pieces if isinstance(piece, Polygon)])


def point_residuals(points: ReferencePoints, surface: TopSurface) -> tuple[IntArray, FloatArray]:
    """Places of the roof points in a tile, (k,), and their residuals, (k,) m: point minus roof; nan without a roof."""
    index = np.flatnonzero(points.is_roof & (points.building >= 0))
    x, y, z = points.xyz[index].T
    residual: FloatArray = z - surface.elevation(x, y)
    return index, residual


def building_residuals(models: Sequence[RoofModel], reference: Reference) -> list[BuildingResiduals]:
    """The residuals of every reference building: one pass over the points, one tile in memory.

    Buildings in several tiles add up. All tiles near a point decide whether it is top-visible, if the reference knows
    the bounds of the tiles.
    """
    surface = top_surface_of(models, near=reference.buildings)
    everything, visible = _Tallies(len(reference.buildings)), _Tallies(len(reference.buildings))
    seam = _Seam(reference.bounds)
    for number, points in enumerate(reference.points()):
        index, residual = point_residuals(points, surface)
        xyz, building = points.xyz[index], points.building[index]
        everything.add(building, residual)
        judged = seam.judged_here(number, xyz, building, residual)
        sees_sky = _top_visible_by_building(xyz, building) & judged
        visible.add(building[sees_sky], residual[sees_sky])
    xyz, building, residual, judged = seam.points()
    sees_sky = _top_visible_by_building(xyz, building) & judged
    visible.add(building[sees_sky], residual[sees_sky])
    return [
        BuildingResiduals(
            building=number,
            building_id=model.building_id,
            all_points=everything.tally(number),
            top_visible=visible.tally(number),
            counts=reference.outlines == "raster" or not model.touches_data_edge,
        )
        for number, model in enumerate(reference.buildings)
    ]


def _top_visible_by_building(xyz: FloatArray, building: LabelArray) -> BoolArray:
    """Which points are top-visible among those of their own building."""
    order = np.argsort(building, kind="stable")
    borders = [*np.flatnonzero(np.diff(building[order], prepend=-2)).tolist(), len(order)]
    seen = np.zeros(len(xyz), np.bool_)
    for start, stop in itertools.pairwise(borders):
        own = order[start:stop]
        seen[own] = top_visible(xyz[own], radius_m=VISIBLE_RADIUS_M)
    return seen


class _Seam:
    """Roof points near other tiles, which are judged at the end together with their neighbours there."""

    def __init__(self, bounds: Sequence[tuple[float, float, float, float]]) -> None:
        self._bounds = bounds
        self._kept: list[tuple[FloatArray, LabelArray, FloatArray, BoolArray]] = []

    def judged_here(self, number: int, xyz: FloatArray, building: LabelArray, residual: FloatArray) -> BoolArray:
        """Which points of a tile have no neighbours in other tiles; keeps the others for the end."""
        here = np.ones(len(xyz), np.bool_)
        near = np.zeros(len(xyz), np.bool_)
        own = self._bounds[number] if self._bounds else (0.0, 0.0, 0.0, 0.0)
        reach = 2 * VISIBLE_RADIUS_M
        for other, (x0, y0, x1, y1) in enumerate(self._bounds):
            apart = x0 - reach > own[2] or x1 + reach < own[0] or y0 - reach > own[3] or y1 + reach < own[1]
            if other == number or apart:
                continue
            away = np.maximum(np.maximum(x0 - xyz[:, 0], xyz[:, 0] - x1), np.maximum(y0 - xyz[:, 1], xyz[:, 1] - y1))
            here &= away > VISIBLE_RADIUS_M
            near |= away <= reach
        if near.any():
            self._kept.append((xyz[near], building[near], residual[near], ~here[near]))
        return here

    def points(self) -> tuple[FloatArray, LabelArray, FloatArray, BoolArray]:
        """Coordinates, buildings, residuals of the kept points, and which of them are still to be judged."""
        empty = (np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros(0), np.zeros(0, np.bool_))
        kept = [empty, *self._kept]
        xyz, building, residual, judged = (np.concatenate(column) for column in zip(*kept, strict=True))
        return xyz, building, residual, judged


class _Tallies:
    """Sums of all buildings."""

    def __init__(self, n: int) -> None:
        self._counts = np.zeros((n, len(_COLUMNS)), np.int64)
        self._sums = np.zeros((n, 2))
        self._histogram = np.zeros((n, len(EDGES_M) - 1), np.int32)

    def add(self, building: LabelArray, residual: FloatArray) -> None:
        """Count points with a building."""
        _tally(building, residual, EDGES_M, TOLERANCE_M, self._counts, self._sums, self._histogram)

    def tally(self, number: int) -> ResidualTally:
        """The sums of one building."""
        n_points, n_covered, n_within = self._counts[number].tolist()
        total, squares = self._sums[number].tolist()
        return ResidualTally(
            n_points=n_points,
            n_covered=n_covered,
            n_within=n_within,
            sum_m=total,
            sum_squares_m2=squares,
            histogram=self._histogram[number],
        )


@kernel
def _tally(
    building: LabelArray,
    residual: FloatArray,
    edges: FloatArray,
    tolerance: float,
    counts: IntArray,
    sums: FloatArray,
    histogram: LabelArray,
) -> None:
    """Add residuals (n,) in metres to counts (b, 3), sums (b, 2) and histogram (b, bins) of their buildings."""
    for i in range(len(building)):
        b = building[i]
        counts[b, 0] += 1
        r = residual[i]
        if math.isnan(r):
            continue
        counts[b, 1] += 1
        size = abs(r)
        if size <= tolerance:
            counts[b, 2] += 1
        sums[b, 0] += r
        sums[b, 1] += r * r
        low, high = 0, len(edges) - 1
        while high - low > 1:
            middle = (low + high) // 2
            if edges[middle] <= size:
                low = middle
            else:
                high = middle
        histogram[b, low] += 1


# ---------------------------------------------------------------------------------------------------------- measures


_ROOF_POINTS = "roof points inside the reference footprints"
_HIDDEN = "without another one of the same building more than 1.1 m higher within 0.5 m in plan"
_SUFFIXES = {"": ("", _ROOF_POINTS), "_top_visible": (", top-visible points", f"{_ROOF_POINTS} {_HIDDEN}")}
_FORMULAS = (
    ("within_0_2m", "points within 0.2 m", "share", Better.HIGHER, "count(abs(dz) <= 0.2 m) / count(P)"),
    ("coverage", "points with a roof", "share", Better.HIGHER, "count(covered) / count(P)"),
    ("rmse", "RMSE", "m", Better.LOWER, "sqrt(sum(dz^2) / count(covered))"),
    ("median", "median distance", "m", Better.LOWER, "median of abs(dz) over the covered points"),
    ("p95", "95th percentile", "m", Better.LOWER, "95th percentile of abs(dz) over the covered points"),
    ("bias", "mean distance", "m", Better.ZERO, "sum(dz) / count(covered)"),
    ("building_rmse", "RMSE of a building, median", "m", Better.LOWER, "median over the buildings of their RMSE"),
)
_MEANING = "dz: elevation of a point less that of the highest roof face of all models there; covered: there is one"

DEFINITIONS = (
    *(
        defined(
            f"residuals.{name}{suffix}", f"{label}{suffix_label}", f"{formula}; P: {points}; {_MEANING}", better, unit
        )
        for suffix, (suffix_label, points) in _SUFFIXES.items()
        for name, label, unit, better, formula in _FORMULAS
    ),
    defined(
        "residuals.below_roof",
        "points on facades and below roofs",
        f"1 - count(top-visible points) / count(P); P: {_ROOF_POINTS}; top-visible: {_HIDDEN}",
        Better.NEITHER,
        "share",
    ),
)
"""The measures."""


def residual_measures(rows: Sequence[BuildingResiduals], subset: Subset) -> list[Measure]:
    """The figures of a subset, buildings as units of the bootstrap; empty without points."""
    if not any(row.all_points.n_points for row in rows):
        return []
    counted = [row for row in rows if (row.counts if subset.elsewhere else subset.buildings[row.building])]
    found: list[Measure] = []
    for suffix in _SUFFIXES:
        tallies = [row.top_visible if suffix else row.all_points for row in counted]
        columns: dict[str, FloatArray] = {
            name: np.array([getattr(tally, name) for tally in tallies], np.float64)
            for name in (*_COLUMNS, "sum_m", "sum_squares_m2")
        }
        n_points, n_covered = columns["n_points"].sum(), columns["n_covered"].sum()
        histogram = np.array([tally.histogram for tally in tallies], np.float64).reshape(-1, len(EDGES_M) - 1)
        figures: tuple[tuple[str, dict[str, FloatArray], Statistic, float], ...] = (
            ("within_0_2m", columns, share("n_within", "n_points"), n_points),
            ("coverage", columns, share("n_covered", "n_points"), n_points),
            ("rmse", columns, root_mean("sum_squares_m2", "n_covered"), n_covered),
            ("median", {"h": histogram}, quantile("h", EDGES_M, 0.5), n_covered),
            ("p95", {"h": histogram}, quantile("h", EDGES_M, 0.95), n_covered),
            ("bias", columns, ratio("sum_m", "n_covered"), n_covered),
        )
        found += [
            measured(f"residuals.{name}{suffix}", used, statistic, n=n, subset=subset)
            for name, used, statistic, n in figures
        ]
        rmse = np.array([tally.rmse_m for tally in tallies if tally.n_covered])
        found.append(measured_median(f"residuals.building_rmse{suffix}", rmse, subset))
    everything = np.array([row.all_points.n_points for row in counted], np.float64)
    below = {"n_points": everything, "n_below": everything - [row.top_visible.n_points for row in counted]}
    statistic = share("n_below", "n_points")
    found.append(measured("residuals.below_roof", below, statistic, n=everything.sum(), subset=subset))
    return found
