"""A sample of a run: true runs over small windows of its inputs, which measure machine and data at once.

A child process reads a window and runs all stages over it, serially, while others do the same with other windows, as
many at once as the run will have processes. The measured seconds of a stage over those that the rates predict are its
pace: on this machine, at its present load, on these points. Nothing of it is stored, since the next data, the next
method and the next load are different.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import GableworkError, RunError
from pipeline.io import ReadOptions, Source, SourceInfo, SpatialReference, is_url, open_source, shown
from pipeline.io.file_facts import Share
from pipeline.io.temporary import temporary_folder
from pipeline.model import PointCloud
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.expected import RATES, Expected, around_km2, block_km2, filled_cells
from pipeline.runtime.isolation.child_pool import preload
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.monitoring.progress import Watch, ignore
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.run_plan import Plan, wanted_bounds_m
from pipeline.terrain.terrain_settings import ClassCodeSettings
from pipeline.tiling import MM, TileGrid

# Constants of the estimate, measured; they decide nothing in a run, so they are not settings.
_WINDOW_S = 1.0
"""CPU seconds of a window, by the rates."""
_SHARE = 0.15
"""Share of a run's CPU time that its sample may take, by the rates."""
_LEAST = 2
"""Least windows: one alone says little."""
_MOST_PER_HAND = 5
"""Windows per process: more of them would make the sample longer and not much better."""
_SIDES_M = (60.0, 600.0)
"""Least and greatest side of a window."""
_SAMPLE_S = 8.0
"""Windows that have not begun after this wall time are left out, except one for each process."""
_READ_POINTS = 1_000_000
"""Points of a larger file that are read for a window."""
_MOST_POINTS = 500_000
"""Points of a window that is not made smaller."""
_THIN = 0.7
"""A window that is thinner than the file by this factor lacks the other flight lines: then more of the file is read."""
_READ_S = 4.0
"""Reading ends after this time; what was read until then is the sample."""
_INGEST = 1.35
"""Seconds of ingest per second of reading: points also go into the buckets of tiles. 1.2 to 1.5 measured."""
_RUN_S = 20.0
"""A window that takes longer counts for nothing."""
_CHUNK_POINTS = 250_000
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_CUT_M = 10.0
"""Width of a building as far as the borders of windows are concerned: parts of buildings count as buildings."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SampleTask:
    """A window of an input."""

    request: RunRequest
    """The run that is sampled."""
    path: str
    """The input."""
    options: ReadOptions
    """How it is read."""
    share: Share | None
    """The share that is read; None for all of it."""
    at: float
    """The place of the window's middle among the points that are read, from 0 to 1."""
    side_m: float
    """Side of the window."""
    density_per_m2: float
    """Points per square metre of the file."""
    grid: TileGrid
    """The lattice of the run."""
    until_s: float = math.inf
    """The window is left out if it has not begun at this time, in seconds since 1970."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sampled:
    """What was measured over a window; nothing where it holds no building or its run failed."""

    points: int = 0
    """Points of the window."""
    area_km2: float = 0.0
    """Its area."""
    candidates: int = 0
    """Candidates in it, cut ones among them."""
    buildings: float = 0.0
    """The same without what the window's borders add."""
    filled: float | None = None
    """Share of the file's tiles that hold points; None where not all of it was read."""
    stage_s: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Seconds by stage."""


def sampled(
    work: Expected,
    request: RunRequest,
    plan: Plan,
    paths: Sequence[str],
    *,
    hands: int,
    buildings: int | None = None,
    executor: Executor | None = None,
) -> Expected | None:
    """The work of a run with the pace and the number of buildings of a sample; None if nothing could be sampled.

    Kernels must be compiled. Raises InputError if an input cannot be read.

    Parameters
    ----------
    work : Expected
        The work by the rates.
    request, plan, paths
        The run, its plan and its inputs.
    hands : int
        Processes that the run will have.
    buildings : int, optional
        Number of buildings if it is known.
    executor : Executor, optional
        Runs the windows; by default child processes.
    """
    tasks = sample_tasks(work, request, plan, paths, hands)
    if not tasks:
        return None
    if executor is None:
        settings = request.settings.general
        preload(loads_of("reconstruct", footprints=request.footprints is not None, method=settings.method))
        executor = LocalExecutor(hands)
    try:
        found = [measured.result for measured in executor.map("sample", sample_window, tasks, Watch())]
    except RunError:  # a building ended its process, twice
        return None
    return scaled(work, found, buildings)


def sample_tasks(work: Expected, request: RunRequest, plan: Plan, paths: Sequence[str], hands: int) -> list[SampleTask]:
    """Windows spread over the inputs; none of files elsewhere, which would have to be fetched."""
    inputs = {shown(path): path for path in paths if not is_url(path)}
    used = [info for info in plan.sources if work.points_by_file.get(info.path) and info.path in inputs]
    if not used:
        return []
    each = round(_SHARE * sum(work.cpu_s().values()) / _WINDOW_S / hands)
    # a window more than there are processes takes as long as one for each of them
    wanted = hands * min(max(each, -(-_LEAST // hands)), _MOST_PER_HAND)
    side_m = window_side_m(plan.density_per_m2)
    late_s = time.time() + _SAMPLE_S
    # multiples of the golden ratio are spread evenly, however many of the windows there will be time for
    places = [(0.5 + k * _GOLDEN) % 1.0 for k in range(wanted)]
    tasks = []
    for k, place in enumerate(places):
        at = place * len(used) % 1.0
        info = used[int(place * len(used))]
        options, share = plan.options, None
        if info.format == "copc":
            options = dataclasses.replace(options, bbox=_box_at(info, plan, at, side_m))
        elif info.is_divisible and plan.options.window is None and info.point_count > 1.5 * _READ_POINTS:
            of = info.point_count // _READ_POINTS + 1
            share, at = Share(number=int(at * of), of=of), 0.5
        task = SampleTask(
            request=request,
            path=inputs[info.path],
            options=options,
            share=share,
            at=at,
            side_m=side_m,
            density_per_m2=info.density_per_m2,
            grid=plan.grid,
            until_s=late_s if k >= hands else math.inf,
        )
        tasks.append(task)
    return tasks


def window_side_m(density_per_m2: float) -> float:
    """Side of a window that takes a second by the rates.

    >>> [round(window_side_m(density)) for density in (0.3, 5.0, 14.0, 1000.0)]
    [211, 175, 138, 60]
    """
    points = density_per_m2 * 1e6
    buildings = round(min(RATES.buildings_per_km2, points / RATES.points_per_building))
    work = _work_of(round(points), 1.0, buildings)
    return min(max(1000.0 * math.sqrt(_WINDOW_S / sum(work.cpu_s().values())), _SIDES_M[0]), _SIDES_M[1])


def _work_of(points: int, area_km2: float, buildings: int) -> Expected:
    """The work of a window by the rates."""
    held_km2 = area_km2 * filled_cells(points, area_km2)
    seen_km2 = block_km2(held_km2, around_km2(1000.0 * math.sqrt(area_km2)))
    return Expected(
        points_by_file={"": points}, tiles=1, seen_points=points, buildings=buildings, ground_km2=(seen_km2,)
    )


def _box_at(info: SourceInfo, plan: Plan, at: float, side_m: float) -> tuple[float, float, float, float]:
    """A window of a COPC file, in the units of its CRS: only its nodes there are read."""
    bounds = wanted_bounds_m(info, plan.options)
    assert bounds is not None
    unit = info.reference.horizontal_unit_m
    x = bounds[0] + at * (bounds[2] - bounds[0])
    y = bounds[1] + (at * 100.0) % 1.0 * (bounds[3] - bounds[1])
    half = side_m / 2.0
    return (x - half) / unit, (y - half) / unit, (x + half) / unit, (y + half) / unit


def sample_window(task: SampleTask, clock: Callable[[], float] | None = None) -> Sampled:
    """Read a window and run over it, by a clock in seconds; raises InputError if the file cannot be read."""
    clock = clock or time.perf_counter
    if time.time() > task.until_s:
        return Sampled()
    source = open_source(task.path, task.options)
    seen = _seen(task, source, clock)
    if seen is None:
        return Sampled()
    points, side_m = seen.points, seen.side_m
    with temporary_folder() as folder:
        path = folder / "window.ply"
        _write(path, points, source.info.reference)
        settings = task.request.settings
        x, y, _ = points.xyz.min(axis=0).tolist()
        general = dataclasses.replace(settings.general, tile_size_m=side_m, halo_m=0.0, lattice_x_m=x, lattice_y_m=y)
        request = dataclasses.replace(
            task.request,
            inputs=(str(path),),
            out=str(folder / "out"),
            settings=dataclasses.replace(settings, general=general, class_codes=ClassCodeSettings()),
            resources=SERIAL,
            overrides=None,
            aoi=None,
            bbox=None,
            crs=source.info.reference.wkt,
            vertical_unit=None,  # the CRS states it
        )
        deadline = clock() + _RUN_S
        try:
            summary = run(request, ignore, cancelled=lambda: clock() > deadline)
        except GableworkError:  # such as no usable point, or points on one line
            return Sampled()
    stage_s = dict(summary.timings_s)
    # the window itself was read from another file
    stage_s["ingest"] = _INGEST * seen.read_s * len(points) / seen.read_points
    candidates = summary.counts["candidates"]
    width_m, depth_m, _ = np.ptp(points.xyz, axis=0).tolist()
    return Sampled(
        points=len(points),
        area_km2=width_m * depth_m / 1e6,
        candidates=candidates,
        buildings=candidates / (1.0 + _CUT_M / side_m) ** 2,
        filled=seen.filled,
        stage_s=stage_s,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Seen:
    """The points of a window, and what reading them took."""

    points: PointCloud
    side_m: float
    read_points: int
    read_s: float
    filled: float | None


def _seen(task: SampleTask, source: Source, clock: Callable[[], float]) -> _Seen | None:
    """Read a window: from its share, or from the whole file if the share lacks flight lines; None without points."""
    for share in (task.share, None):
        began = clock()
        clouds: list[PointCloud] = []
        for cloud in source.chunks(_CHUNK_POINTS, share):
            clouds.append(cloud)
            if clock() - began > _READ_S:
                break
        read_s, read_points = clock() - began, source.findings.n_read
        if not clouds:
            return None
        points, side_m = _cut(clouds, task.at, task.side_m)
        if share is None or len(points) > _THIN * task.density_per_m2 * side_m**2:
            break
    filled = _filled(clouds, task.grid) if read_points == source.info.point_count else None
    return _Seen(points=points, side_m=side_m, read_points=read_points, read_s=read_s, filled=filled)


def _filled(clouds: Sequence[PointCloud], grid: TileGrid) -> float:
    """Share of the tiles over some points that hold any."""
    tiles = [
        grid.columns_rows(*(np.rint(cloud.xyz[:, axis] * MM).astype(np.int64) for axis in (0, 1))) for cloud in clouds
    ]
    held = np.unique(np.concatenate([np.column_stack(pair) for pair in tiles]), axis=0)
    return len(held) / float(np.prod(np.ptp(held, axis=0) + 1))


def _cut(clouds: Sequence[PointCloud], at: float, side_m: float) -> tuple[PointCloud, float]:
    """The points in a square around one of them, and its side: a smaller one where there are far more points."""
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    # the whole window lies within the data, if it can
    half = np.minimum(side_m, high - low) / 2.0
    middle = np.clip(xyz[int(at * len(xyz)), :2], low + half, high - half)
    far = np.abs(xyz[:, :2] - middle).max(axis=1)
    while side_m > _SIDES_M[0] / 2.0 and np.count_nonzero(far < side_m / 2.0) > _MOST_POINTS:
        side_m /= 2.0
    inside = far < side_m / 2.0
    starts = np.cumsum([0, *map(len, clouds)])
    parts = [cloud.take(inside[start : start + len(cloud)]) for cloud, start in zip(clouds, starts, strict=False)]
    names = [field.name for field in dataclasses.fields(PointCloud)]
    return PointCloud(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}), side_m


def _write(path: Path, points: PointCloud, reference: SpatialReference) -> None:
    """Write points as PLY, in the units of their CRS; in metres if it is unknown, since PLY states no units."""
    if reference.wkt is None:
        reference = SpatialReference()
    units = (reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m)
    columns: dict[str, npt.NDArray[Any]] = {name: points.xyz[:, k] / units[k] for k, name in enumerate("xyz")}
    columns |= {"return_number": points.return_number, "number_of_returns": points.return_count}
    columns |= {"classification": points.classification, "gps_time": points.gps_time}
    columns |= {"point_source_id": points.source_id}
    kinds = {"float64": "double", "uint8": "uchar", "uint16": "ushort"}
    lines = [f"property {kinds[column.dtype.name]} {name}" for name, column in columns.items()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *lines, "end_header", ""]
    records = np.empty(len(points), [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        records[name] = column
    path.write_bytes("\n".join(header).encode() + records.tobytes())


def scaled(work: Expected, found: Sequence[Sampled], buildings: int | None = None) -> Expected | None:
    """The work of a run by what was measured over some windows of it; None if they hold nothing.

    Each stage has its own pace: a scene of many small buildings or of rough ground does not cost what others cost.
    `buildings` is their number if it is known.
    """
    points = sum(window.points for window in found)
    if not points:
        return None
    by_rates: dict[str, float] = defaultdict(float)
    measured: dict[str, float] = defaultdict(float)
    for window in found:
        # the pace of the buildings is that of each candidate, cut or whole
        part = dataclasses.replace(_work_of(window.points, window.area_km2, window.candidates), octree=work.octree)
        for stage, seconds in part.cpu_s().items():
            by_rates[stage] += seconds
        for stage, seconds in window.stage_s.items():
            measured[stage] += seconds
    # both are measured as one stage
    by_rates["outline"] += by_rates["units"]
    if buildings is None:
        buildings = round(sum(window.buildings for window in found) * work.points / points)
    pace = {stage: measured[stage] / seconds for stage, seconds in by_rates.items() if seconds > 0.0}
    pace["units"] = pace["outline"]
    filled = [window.filled for window in found if window.filled is not None]
    share = sum(filled) / len(filled) if filled else 1.0
    return dataclasses.replace(
        work,
        buildings=buildings,
        tiles=max(1, round(share * work.tiles)),
        ground_km2=tuple(share * area for area in work.ground_km2),
        pace=pace,
    )
