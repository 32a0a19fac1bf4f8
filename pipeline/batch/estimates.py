"""Estimates a batch run before anything runs: tiles, points, memory, time, disk, and reasons why it cannot work.

Points and areas come from the headers of all inputs. Times and the number of buildings come from a sample of the run,
or from measured rates alone where it is short (`pipeline.runtime.forecast`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pipeline.batch.batch_file import Batch
from pipeline.batch.batch_keys import as_keys, errors_with_keys
from pipeline.batch.remaining_time import duration
from pipeline.errors import EmptyInputError, InputError, RunError
from pipeline.extras.footprints.given_footprints import footprints_of_run
from pipeline.io import shown
from pipeline.runtime.cluster.dask_executor import memory_of_workers
from pipeline.runtime.cluster.performance_report import PerformanceReport
from pipeline.runtime.engine import Engine, engine_of
from pipeline.runtime.expected import RATES, expected
from pipeline.runtime.forecast import WORTH_S, forecast
from pipeline.runtime.monitoring.measurement import cores, memory_bytes
from pipeline.runtime.monitoring.progress import Progress, ignore
from pipeline.runtime.request import plan_inputs
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_directory import check_out
from pipeline.runtime.run_plan import Plan, check_memory
from pipeline.runtime.scratch.folder import POINT
from pipeline.runtime.scratch.work_folder import refuse_foreign
from pipeline.tiling import MM

# Constants of the estimate, measured; they decide nothing in a run, so they are not settings.
_RESULT_BYTES = 12_000
"""Bytes per building in a run directory, with meshes; 7 to 12 kB measured."""
_POINT_BYTES = 25.0
"""Bytes per point in a run directory with points; 24 are its attributes."""
_KEPT_BYTES = 12_000
"""Bytes per building in the work folder."""
_SPLIT_SHARE = 1.0
"""Points of buildings over all points, at most; they are stored a second time."""
_TERRAIN_BYTES = 6.0
"""Bytes per square metre of terrain: elevation, presence of points, an apron."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """The estimate of a run."""

    files: int
    """Number of inputs."""
    points: int
    """Points by the headers; for a window, the share of its area in their bounds."""
    tiles: int
    """Tiles of the lattice that the bounds of the inputs touch."""
    tile_size_m: float
    """Side of a tile."""
    buildings: int
    """Expected buildings."""
    buildings_from: str
    """Source of that number, in words."""
    workers: int
    """Processes on this machine, or the workers that the scheduler has now."""
    worker_bytes: int
    """Expected peak memory of the largest process."""
    worker_most_bytes: int
    """Memory that a worker may need for the largest task of the plan."""
    memory_bytes: int
    """Expected peak memory of all processes together."""
    worker_limit_bytes: int | None
    """Memory limit of a worker; None if there is none, or no worker to ask."""
    stage_s: Mapping[str, float]
    """Wall seconds by stage."""
    sampled: bool
    """Whether a sample of the run was measured for the times."""
    seconds: tuple[float, float]
    """Least and most seconds in total."""
    work_bytes: int
    """Size of the work folder."""
    work_free_bytes: int | None
    """Free space there; None if unknown."""
    out_bytes: int
    """Size of the results."""
    out_free_bytes: int | None
    """Free space there; None if unknown."""
    warnings: tuple[str, ...]
    """Oddities that do not prevent a run."""
    refusals: tuple[str, ...]
    """Reasons why it cannot work, each with the fix; a run does not begin if there is one."""


def estimate(batch: Batch, worth_s: float = WORTH_S, known: tuple[int, int] = (0, 0)) -> Estimate:
    """Estimate a batch run.

    Parameters
    ----------
    worth_s : float
        Wall seconds by the rates from which on a sample is run.
    known : tuple of int
        Buildings and points of an earlier run of the batch: if the points are as many now, nothing is sampled.

    Raises
    ------
    InputError, SettingsError
        An input cannot be used.
    ClusterError
        The scheduler does not answer.
    """
    with errors_with_keys():
        return _estimated(batch, worth_s, known)


def _estimated(batch: Batch, worth_s: float, known: tuple[int, int]) -> Estimate:
    request = batch.request()
    progress = Progress(ignore)
    plan, paths = plan_inputs(request, progress)
    work = expected(plan)
    if not work.tiles:
        raise EmptyInputError(
            shown(paths[0]), f"all {len(paths)} inputs lie off --bbox and --aoi", "Check them, and their CRS"
        )
    buildings, known_from = None, None
    given = footprints_of_run(request.footprints, plan, request.settings.footprints, request.footprints_layer)
    if given is not None:
        buildings, known_from = len(given.polygons), "the given footprints"
        work = dataclasses.replace(work, buildings=buildings)
    elif known[0] and known[1] == work.points:
        buildings, known_from, worth_s = known[0], "as many as in the run before", math.inf
    resources = request.resources
    # the run chooses its engine by the rates
    engine, workers, limit = _workers(resources, sum(work.cpu_s().values()))
    refusals = [*places_refused(batch), *_memory_refused(plan, limit)]
    if refusals:
        worth_s = math.inf  # nothing will run
    found = forecast(request, plan, paths, engine=engine, workers=workers, buildings=buildings, worth_s=worth_s)
    work, buildings = found.work, found.work.buildings
    side = plan.grid.size_mm / MM
    work_bytes = int(
        work.points * POINT.itemsize * (1.0 + _SPLIT_SHARE)
        + work.tiles * side * side * _TERRAIN_BYTES
        + buildings * _KEPT_BYTES
    )
    out_bytes = buildings * _RESULT_BYTES + (round(work.points * _POINT_BYTES) if batch.output.points else 0)
    work_free, out_free = _free(batch.work_folder), _free(batch.out)
    most_bytes = int(RATES.process_gib * 2**30) + plan.window_bytes
    refusals += _disk_refused(batch, work_bytes, work_free, out_bytes, out_free)
    warnings = list(progress.warnings)
    if resources.scheduler is not None and workers == 0:
        warnings.append(f"the scheduler {resources.scheduler} has no worker now: the run would wait for one")
    warnings += _warnings_of_workers(found.cold_s, limit, plan.window_bytes, most_bytes)
    return Estimate(
        files=len(paths),
        points=work.points,
        tiles=work.tiles,
        tile_size_m=side,
        buildings=buildings,
        buildings_from=known_from or ("as in a sample" if found.sampled else "as many as such an area often has"),
        workers=workers,
        worker_bytes=found.process_bytes,
        worker_most_bytes=most_bytes,
        memory_bytes=found.memory_bytes,
        worker_limit_bytes=limit,
        stage_s=found.stage_s,
        sampled=found.sampled,
        seconds=found.range_s,
        work_bytes=work_bytes,
        work_free_bytes=work_free,
        out_bytes=out_bytes,
        out_free_bytes=out_free,
        warnings=tuple(as_keys(text) for text in warnings),
        refusals=tuple(refusals),
    )


def _workers(resources: Resources, expected_cpu_s: float) -> tuple[Engine, int, int | None]:
    """The engine, its number of workers, and their memory limit if there is one."""
    engine, processes = engine_of(resources, expected_cpu_s=expected_cpu_s, at=cores())
    if engine == "local":
        return engine, processes, memory_bytes()
    embedded = processes if engine == "cluster" else 0
    return engine, *memory_of_workers(workers=embedded, scheduler=resources.scheduler, tls=resources.tls)


def _warnings_of_workers(cold_s: float, limit: int | None, window_bytes: int, most_bytes: int) -> list[str]:
    warnings = []
    if cold_s:
        warnings.append(
            "numba kernels are not compiled on this machine yet: this run compiles them, which may take "
            f"{duration(cold_s)} on top; gablework warm-up does it ahead"
        )
    if limit is not None and window_bytes <= limit < most_bytes:
        warnings.append(
            f"a worker may need up to {most_bytes / 2**30:.1f} GiB, its limit is {limit / 2**30:.1f}: if workers are "
            "ended for it, set a smaller tile_size_m, or give them more memory"
        )
    return warnings


def _free(folder: str) -> int | None:
    """Free bytes on the disk of a folder that may not exist yet; None for an object store."""
    if "://" in folder:
        return None
    try:
        return shutil.disk_usage(_existing(folder)).free
    except OSError:
        return None


def _existing(folder: str) -> Path:
    """The folder, or the nearest one above it that exists."""
    there = Path(folder)
    while not there.exists():
        there = there.parent
    return there


def _disk(folder: str) -> int:
    """The file system of a folder that may not exist yet."""
    return _existing(folder).stat().st_dev


def places_refused(batch: Batch) -> list[str]:
    """Reasons why the folders of a batch cannot be written; nothing is made."""
    work, out = Path(batch.work_folder).resolve(), batch.out
    if "://" not in out and (work.is_relative_to(Path(out).resolve()) or Path(out).resolve().is_relative_to(work)):
        return [f"the work folder {work} and the results {out} lie in one another: give another [work] path"]
    checks: list[Callable[[], object]] = [
        lambda: check_out(out, overwrite=batch.output.overwrite, work=str(work)),
        lambda: refuse_foreign(str(work)),
    ]
    if page := batch.cluster.performance_report:
        checks.append(lambda: PerformanceReport(batch.whole(page)))
    refusals = []
    for check in checks:
        try:
            check()
        except RunError as error:
            refusals.append(as_keys(str(error)))
    return refusals


def _memory_refused(plan: Plan, limit: int | None) -> list[str]:
    try:
        check_memory(plan, limit)
    except InputError as error:
        return [str(error)]
    return []


def _disk_refused(
    batch: Batch, work_bytes: int, work_free: int | None, out_bytes: int, out_free: int | None
) -> list[str]:
    """Reasons why the files do not fit on a disk; files of an earlier run count as free."""
    if all(free is None or work_bytes + out_bytes <= free for free in (work_free, out_free)):
        return []
    work_bytes = max(0, work_bytes - _taken(batch.work_folder))
    out_bytes = 0 if out_free is None else max(0, out_bytes - _taken(batch.out))
    refusals = []
    if work_free is not None and work_bytes > work_free:
        refusals.append(
            f"the work folder {batch.work_folder} needs about {work_bytes / 1e9:.1f} GB more, {work_free / 1e9:.1f} GB "
            "are free: give [work] path on another disk, or free space"
        )
    if out_free is not None and out_bytes > out_free:
        refusals.append(
            f"the results in {batch.out} need about {out_bytes / 1e9:.1f} GB more, {out_free / 1e9:.1f} GB are free: "
            "give another [output] path, or free space"
        )
    is_one_disk = out_free is not None and _disk(batch.work_folder) == _disk(batch.out)
    if not refusals and is_one_disk and work_free is not None and work_bytes + out_bytes > work_free:
        refusals.append(
            f"the work folder {batch.work_folder} and the results in {batch.out} need about "
            f"{(work_bytes + out_bytes) / 1e9:.1f} GB more of one disk, {work_free / 1e9:.1f} GB are free: "
            "give [work] path on another disk, or free space"
        )
    return refusals


def _taken(folder: str) -> int:
    """Bytes of the files in a folder; other processes may write and remove some meanwhile."""
    found = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                found += Path(place, name).lstat().st_size
    return found


class BatchRefusedError(RunError):
    """A batch run cannot work as planned."""


def refuse(refusals: Sequence[str]) -> None:
    """Raise BatchRefusedError, which names everything that cannot work."""
    if refusals:
        raise BatchRefusedError("; ".join(refusals))
