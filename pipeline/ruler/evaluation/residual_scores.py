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
from pipeline.ruler.evaluation.subsets import Subset, measured, measured_all, measured_median

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


class Tallies:
    """Sums over vertical distances at places of roofs: measured points, or those of a lattice; one row per building."""

    def __init__(self, buildings: int, edges_m: FloatArray) -> None:
        self.edges_m = edges_m
        """(bins + 1,) borders of the bins of the histogram."""
        self.counts: IntArray = np.zeros((buildings, 3), np.int64)
        """Places; those that a roof of the models covers; covered ones within the tolerance."""
        self.sums: FloatArray = np.zeros((buildings, 2))
        """Sum of the distances of the covered ones, and of their squares."""
        self.histogram: LabelArray = np.zeros((buildings, len(edges_m) - 1), np.int32)
        """The covered ones by |distance|."""

    def columns(self) -> dict[str, FloatArray]:
        """All sums by name, (buildings,) each."""
        n_points, n_covered, n_within = self.counts.T.astype(np.float64)
        return {
            "n_points": n_points,
            "n_covered": n_covered,
            "n_within": n_within,
            "sum_m": self.sums[:, 0],
            "sum_squares_m2": self.sums[:, 1],
        }

    def figure(self, statistic: Statistic) -> FloatArray:
        """A figure of each building, (buildings,); nan where it is undefined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return statistic({**self.columns(), "histogram": self.histogram.astype(np.float64)})

    def quantile(self, share: float) -> Statistic:
        """A quantile of |distance| over the covered places, to a bin."""
        return quantile("histogram", self.edges_m, share)


RMSE = root_mean("sum_squares_m2", "n_covered")
"""Root mean square of the covered places."""
BIAS = ratio("sum_m", "n_covered")
"""Mean of the covered places."""
WITHIN = share("n_within", "n_points")
"""Share of all places within the tolerance; uncovered is a miss."""
COVERAGE = share("n_covered", "n_points")
"""Share of all places that a roof covers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Residuals:
    """The residuals of roof points by reference building: point minus roof, positive if the points are above it."""

    all_points: Tallies
    """All roof points inside the footprint."""
    top_visible: Tallies
    counts: BoolArray
    """(buildings,) bool, False if it touches the edge of the data: it need not be found. Outlines of the raster count
    all the same: in a dense town they are connected, and the blocks that are cut have most of the points."""


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


def building_residuals(models: Sequence[RoofModel], reference: Reference) -> Residuals:
    """The residuals of every reference building: one pass over the points, one tile in memory.

    Buildings in several tiles add up. All tiles near a point decide whether it is top-visible, if the reference knows
    the bounds of the tiles.
    """
    surface = top_surface_of(models, near=reference.buildings)
    everything, visible = (Tallies(len(reference.buildings), EDGES_M) for _ in range(2))
    seam = _Seam(reference.bounds)

    def add(tallies: Tallies, building: LabelArray, residual: FloatArray) -> None:
        _tally(building, residual, EDGES_M, TOLERANCE_M, tallies.counts, tallies.sums, tallies.histogram)

    for number, points in enumerate(reference.points()):
        index, residual = point_residuals(points, surface)
        xyz, building = points.xyz[index], points.building[index]
        add(everything, building, residual)
        judged = seam.judged_here(number, xyz, building, residual)
        sees_sky = _top_visible_by_building(xyz, building) & judged
        add(visible, building[sees_sky], residual[sees_sky])
    xyz, building, residual, judged = seam.points()
    sees_sky = _top_visible_by_building(xyz, building) & judged
    add(visible, building[sees_sky], residual[sees_sky])
    cut = np.array([model.touches_data_edge for model in reference.buildings], np.bool_)
    return Residuals(all_points=everything, top_visible=visible, counts=~cut | (reference.outlines == "raster"))


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


def residual_measures(rows: Residuals | None, subset: Subset) -> list[Measure]:
    """The figures of a subset, buildings as units of the bootstrap; empty without points."""
    if rows is None or not rows.all_points.counts[:, 0].any():
        return []
    counted = rows.counts if subset.elsewhere else subset.buildings
    found: list[Measure] = []
    for suffix in _SUFFIXES:
        tallies = rows.top_visible if suffix else rows.all_points
        columns: dict[str, FloatArray] = {name: column[counted] for name, column in tallies.columns().items()}
        columns["histogram"] = tallies.histogram[counted].astype(np.float64)
        n_points, n_covered = columns["n_points"].sum(), columns["n_covered"].sum()
        figures = (
            ("within_0_2m", WITHIN, n_points),
            ("coverage", COVERAGE, n_points),
            ("rmse", RMSE, n_covered),
            ("median", tallies.quantile(0.5), n_covered),
            ("p95", tallies.quantile(0.95), n_covered),
            ("bias", BIAS, n_covered),
        )
        found += measured_all(columns, subset, ((f"residuals.{name}{suffix}", of, n) for name, of, n in figures))
        rmse = tallies.figure(RMSE)[counted]
        found.append(measured_median(f"residuals.building_rmse{suffix}", rmse[np.isfinite(rmse)], subset))
    everything, visible = (one.counts[counted, 0].astype(np.float64) for one in (rows.all_points, rows.top_visible))
    below = {"n_points": everything, "n_below": everything - visible}
    statistic = share("n_below", "n_points")
    found.append(measured("residuals.below_roof", below, statistic, n=everything.sum(), subset=subset))
    return found
