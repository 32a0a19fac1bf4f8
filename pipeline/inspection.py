"""Facts about a tile without reconstruction: header, classes, returns, rough estimates."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.io.area_of_use import Location
from pipeline.io.source import ReadOptions, Source, SourceInfo, open_source
from pipeline.model import FloatArray, IntArray, PointCloud
from pipeline.runtime.engine import engine_of, workers_that_fit
from pipeline.runtime.expected import expected
from pipeline.runtime.forecast import Forecast, forecast
from pipeline.runtime.monitoring.measurement import cores, memory_bytes
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_plan import Plan, make_plan
from pipeline.runtime.stages.ingested import without_roofs
from pipeline.settings import RunSettings
from pipeline.terrain.flight_passes import NO_SLICES, passes_of, slices_of, united_slices
from pipeline.terrain.strip_moves import moves_of, offsets_of, strips_warning, surfaces_warning
from pipeline.terrain.survey_strips import SQUARE_MM, compared_strips
from pipeline.terrain.terrain_settings import StripSettings
from pipeline.tiling import MM

RAISED_M = 2.5
"""Cells this far above the lowest surroundings count as raised."""
SURROUNDINGS_M = 40.0
"""Side of the square of the lowest surroundings: wider than most buildings."""
MIN_AREA_M2 = 10.0
"""Smaller groups of raised cells are not counted."""
_COMPARED_POINTS = 2_000_000
"""Points, about, among which flight strips are compared: 60 MB."""
MAX_CELLS = 4_000_000
"""Bounds the raster's memory: a larger tile gets coarser cells."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inspection:
    """Facts about a tile after one streamed read."""

    info: SourceInfo
    """Facts of the header."""
    warnings: tuple[str, ...]
    """What is odd but usable, of the header and of the points."""
    location: Location | None
    """The place on Earth; None if unknown."""
    used_points: int
    """Points that a run would use."""
    dropped: dict[str, int]
    """Points that a run would leave out, by cause."""
    classes: dict[int, int]
    """Used points by class: the file's own codes, or ASPRS codes if the settings say what the file's codes mean."""
    returns: dict[int, int]
    """Used points by the number of returns of their pulse."""
    extent_m: tuple[float, float]
    """Width and depth of the used points; bounds in a header may be wider."""
    elevation_m: tuple[float, float]
    """Lowest and highest used point."""
    occupied_area_m2: float
    """Area of the raster cells that hold a point."""
    density_per_m2: float
    """Used points per square metre of that area; gaps do not lower it, unlike the figure of the header."""
    raised_objects: int
    """Groups of raised cells: buildings and trees; touching houses count as one."""
    cell_m: float
    """Side of the raster's cells."""
    estimated_buildings: int
    """Buildings as in a sample, or as many as such an area often has."""
    estimated_seconds: tuple[float, float]
    """Least and most wall time of `reconstruct` on this machine."""
    estimated_from_sample: bool
    """Whether a sample of the run was measured; short runs are estimated by rates alone."""
    estimated_gib: float
    """Peak memory of all its processes together."""

    def rows(self) -> list[tuple[str, str]]:
        """The facts as pairs of name and value, for people."""
        info, reference = self.info, self.info.reference
        assumed = " (assumed: the file states none; --vertical-unit sets it)" if reference.vertical_unit_assumed else ""
        width, depth = self.extent_m
        kept_out = ", ".join(f"{n} {cause.replace('_', ' ')}" for cause, n in self.dropped.items() if n)
        pulses = ", ".join(f"{n}: {100.0 * k / self.used_points:.0f} %" for n, k in self.returns.items())
        basis = "as in a sample" if self.estimated_from_sample else "as many as such an area often has"
        least, most = self.estimated_seconds
        acquired = "unknown"
        if info.acquired_from is not None and info.acquired_to is not None:
            acquired = f"{info.acquired_from:%Y-%m-%d} to {info.acquired_to:%Y-%m-%d}"
        return [
            ("format", f"{info.format}, {info.file_size / 1e6:.1f} MB"),
            (
                "points",
                f"{self.used_points} used of {info.point_count}" + (f" (left out: {kept_out})" if kept_out else ""),
            ),
            ("CRS", reference.name if reference.epsg is None else f"{reference.name} (EPSG:{reference.epsg})"),
            ("place", "unknown" if self.location is None else str(self.location)),
            (
                "units",
                f"horizontal {reference.horizontal_unit_m:g} m, vertical {reference.vertical_unit_m:g} m{assumed}",
            ),
            ("extent", f"{width:.1f} x {depth:.1f} m" if self.used_points else "unknown"),
            (
                "elevation",
                f"{self.elevation_m[0]:.2f} to {self.elevation_m[1]:.2f} m" if self.used_points else "unknown",
            ),
            ("density", f"{self.density_per_m2:.2f} points/m2 where there are points"),
            ("returns a pulse", pulses),
            ("acquired", acquired),
            (
                "raised objects",
                f"{self.raised_objects} higher than {RAISED_M:g} m (trees too; touching houses are one)",
            ),
            ("estimated buildings", f"{self.estimated_buildings}, {basis}"),
            ("estimated time", f"{least:.0f} to {most:.0f} s on this machine"),
            ("estimated memory", f"{self.estimated_gib:.1f} GiB for all processes"),
        ]


def inspect(
    path: str | Path,
    options: ReadOptions | None,
    on_progress: Callable[[int, int], None],
    settings: RunSettings | None = None,
) -> Inspection:
    """Read a tile once, streamed, and describe its content as a run with some settings sees it, by default the usual.

    `on_progress` is called with points read and points promised. Raises InputError if the file or its points cannot be
    read.
    """
    settings = settings or RunSettings()
    options = dataclasses.replace(options or ReadOptions(), class_table=settings.class_codes.table)
    source = open_source(path, options)
    raster = _Raster(source.info)
    classes = np.zeros(256, dtype=np.int64)
    returns = np.zeros(256, dtype=np.int64)
    used, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
    strips = _Strips(source.info.point_count)
    for cloud in source.chunks():
        classes += np.bincount(cloud.classification, minlength=256)
        returns += np.bincount(cloud.return_count, minlength=256)
        raster.add(cloud.xyz)
        strips.add(cloud)
        used += len(cloud)
        low, high = np.minimum(low, cloud.xyz.min(axis=0)), np.maximum(high, cloud.xyz.max(axis=0))
        on_progress(used, source.info.point_count)
    plan = make_plan([str(path)], options, settings)
    run = _forecast(path, options, plan, settings)
    found = _inspection(source, raster, classes, returns, (low, high), run, settings)
    return dataclasses.replace(found, warnings=found.warnings + strips.warnings(settings.scene.strips))


def _forecast(path: str | Path, options: ReadOptions, plan: Plan, settings: RunSettings) -> Forecast:
    """The forecast of a run."""
    request = RunRequest(
        inputs=(str(path),), out="", crs=options.crs, vertical_unit=options.vertical_unit, settings=settings
    )
    at = workers_that_fit(cores(), memory_bytes(), plan.window_bytes)
    engine, workers = engine_of(Resources(), expected_cpu_s=sum(expected(plan).cpu_s().values()), at=at)
    return forecast(request, plan, [str(path)], engine=engine, workers=workers)


def _inspection(
    source: Source,
    raster: _Raster,
    classes: np.ndarray[tuple[int], np.dtype[np.int64]],
    returns: np.ndarray[tuple[int], np.dtype[np.int64]],
    bounds_m: tuple[FloatArray, FloatArray],
    run: Forecast,
    settings: RunSettings,
) -> Inspection:
    low, high = bounds_m
    area, used = raster.occupied_area_m2(), int(classes.sum())
    return Inspection(
        info=source.info,
        warnings=(*_about_use(source, classes, settings), *source.warnings, *_outside(source.info)),
        location=source.info.location,
        used_points=used,
        dropped=source.dropped,
        classes={int(k): int(classes[k]) for k in np.flatnonzero(classes)},
        returns={int(k): int(returns[k]) for k in np.flatnonzero(returns)},
        extent_m=(float(high[0] - low[0]), float(high[1] - low[1])),
        elevation_m=(float(low[2]), float(high[2])),
        occupied_area_m2=area,
        density_per_m2=used / area if area > 0.0 else math.nan,
        raised_objects=raster.raised_objects(),
        cell_m=raster.cell_m,
        estimated_buildings=run.work.buildings,
        estimated_seconds=run.range_s,
        estimated_from_sample=run.sampled,
        estimated_gib=run.memory_bytes / 2**30,
    )


def _about_use(
    source: Source, classes: np.ndarray[tuple[int], np.dtype[np.int64]], settings: RunSettings
) -> tuple[str, ...]:
    """A warning about a tile of which a run would use no point, or find no building for its classes."""
    found = {code: int(classes[code]) for code in np.flatnonzero(classes).tolist()}
    if not found:
        causes = ", ".join(f"{count} {cause}" for cause, count in source.dropped.items() if count)
        return (f"a run would use none of its points ({causes})",)
    return tuple(filter(None, [without_roofs(found, trust=settings.general.classes == "trust")]))


def _outside(info: SourceInfo) -> tuple[str, ...]:
    """A warning about a tile that a run refuses for its place."""
    location = info.location
    if location is None or not location.is_far_outside:
        return ()
    return (f"{location.problem}. {location.fix}",)


class _Strips:
    """The points of some squares in which flight strips are compared; of all, where these are few."""

    def __init__(self, points: int) -> None:
        self._every = math.ceil(math.sqrt(max(1, points) / _COMPARED_POINTS))
        self._parts: list[tuple[IntArray, ...]] = []
        self._slices = NO_SLICES

    def add(self, cloud: PointCloud) -> None:
        """Keep the points of the squares."""
        xyz_mm = np.rint(cloud.xyz * MM).astype(np.int64)
        column, row = xyz_mm[:, 0] // SQUARE_MM, xyz_mm[:, 1] // SQUARE_MM
        kept = (column % self._every == 0) & (row % self._every == 0)
        self._slices = united_slices([self._slices, slices_of(cloud.source_id, cloud.gps_time)])
        columns = (*xyz_mm.T, cloud.return_number, cloud.return_count, cloud.source_id, cloud.gps_time)
        self._parts.append(tuple(np.ascontiguousarray(values[kept]) for values in columns))

    def warnings(self, settings: StripSettings) -> tuple[str, ...]:
        """Warnings if strips do not fit."""
        if not self._parts:
            return ()
        columns = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        x, y, z, number, returns, source, time = columns
        rows = compared_strips((x, y, z), (number, returns), source, time, None, passes_of(self._slices))
        differ = rows, self._slices
        apart = offsets_of(*differ, settings)
        named = strips_warning(apart, moves_of(*differ, settings)) if apart else ""
        return tuple(filter(None, (named, surfaces_warning(*differ, settings))))


class _Raster:
    """Lowest and highest point of every cell, over the header's bounds."""

    def __init__(self, info: SourceInfo) -> None:
        x0, y0, _, x1, y1, _ = info.bounds_m
        area = max((x1 - x0) * (y1 - y0), 1.0)
        self.cell_m = max(1.0, math.sqrt(area / MAX_CELLS))
        self._x0, self._y0 = x0, y0
        self._columns = int((x1 - x0) / self.cell_m) + 1
        self._rows = int((y1 - y0) / self.cell_m) + 1
        self._low = np.full(self._rows * self._columns, np.inf)
        self._high = np.full(self._rows * self._columns, -np.inf)

    def add(self, xyz: FloatArray) -> None:
        """Count points in; those outside the header's bounds go to the nearest cell."""
        column = np.clip(((xyz[:, 0] - self._x0) / self.cell_m).astype(np.int64), 0, self._columns - 1)
        row = np.clip(((xyz[:, 1] - self._y0) / self.cell_m).astype(np.int64), 0, self._rows - 1)
        cell = row * self._columns + column
        np.minimum.at(self._low, cell, xyz[:, 2])
        np.maximum.at(self._high, cell, xyz[:, 2])

    def occupied_area_m2(self) -> float:
        """Area of the cells that hold a point."""
        return float(np.count_nonzero(np.isfinite(self._low))) * self.cell_m**2

    def raised_objects(self) -> int:
        """Groups of cells that stand above the lowest surroundings."""
        from scipy import ndimage

        low = self._low.reshape(self._rows, self._columns)
        high = self._high.reshape(self._rows, self._columns)
        # A single point far below the ground must not sink its surroundings.
        typical = ndimage.percentile_filter(low, 20, size=5, mode="nearest")
        floor = np.where(low < typical - 3.0, typical, low)
        side = 2 * round(0.5 * SURROUNDINGS_M / self.cell_m) + 1
        ground = ndimage.maximum_filter(
            ndimage.minimum_filter(floor, size=side, mode="nearest"), size=side, mode="nearest"
        )
        raised = np.isfinite(high) & (high - ground > RAISED_M)
        labels, n = ndimage.label(ndimage.binary_opening(raised, np.ones((2, 2))))
        if n == 0:
            return 0
        areas = np.bincount(labels.ravel())[1:] * self.cell_m**2
        return int(np.count_nonzero(areas >= MIN_AREA_M2))
