"""Classification: plan, ingest, ground, split and join as in a run, then a class for every point, in file order."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from uuid import uuid4

from pipeline.errors import InputError, RunError, SettingsError
from pipeline.extras.classify.label import LabelTask, SitesNear, label, neighbourhood
from pipeline.extras.classify.raster_files import RasterLattice
from pipeline.extras.classify.rasters import (
    RASTERS,
    MosaicTask,
    RasterTask,
    default_cell,
    draw_tile,
    with_neighbours,
    write_mosaic,
)
from pipeline.extras.classify.write_classified import (
    ClassifiedFile,
    ClassifiedTask,
    check_writable,
    output_name,
    write_classified,
)
from pipeline.extras.footprints.given_footprints import footprints_of_run
from pipeline.io import is_url, shown
from pipeline.options import InputFiles, InputOptions, values_of
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.expected import expected
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.monitoring.measurement import peak_of_process
from pipeline.runtime.monitoring.progress import Listener, Progress, ignore, never
from pipeline.runtime.request import RunRequest, plan_inputs
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_context import RunContext, run_context
from pipeline.runtime.scratch.abandoned import locked_folder, remove_abandoned
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Place, key_of, whole
from pipeline.runtime.scratch.work_folder import locked_work
from pipeline.runtime.stages.ground_stage import find_ground
from pipeline.runtime.stages.ingest import part_of
from pipeline.runtime.stages.ingested import Ingested, classes_in_use
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.read_inputs import read_inputs
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import split
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

_SCRATCH = "scratch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifyRequest(InputFiles, InputOptions):
    """What to classify, and how."""

    inputs: tuple[str, ...]
    """Files, folders or patterns."""
    out: str
    """The folder to write; other files in it stay."""
    only_files: bool = False
    """Whether every input is a point cloud; folders, patterns and tile indexes are then refused."""
    settings: RunSettings = dataclasses.field(default_factory=RunSettings)
    """All settings; those of methods have no effect."""
    rasters: bool = False
    """Also write rasters of terrain, surface and height."""
    raster_cell: float | None = None
    """Side of their cells in units of the CRS; None for half a metre."""
    resources: Resources = dataclasses.field(default_factory=Resources)
    """What the command runs with; scratch lies in `out`, and no other work folder is used."""
    overwrite: bool = False
    """Replace files of the same names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifySummary:
    """What was written."""

    out: str
    """The folder."""
    files: tuple[ClassifiedFile, ...]
    """One per input, in the order of their names."""
    rasters: tuple[str, ...]
    """Paths of the rasters."""
    classes: dict[int, int]
    """Points by class in all files."""
    buildings: int
    """Candidates whose points are building."""
    timings_s: dict[str, float]
    """Wall-clock seconds by stage."""
    peak_memory_bytes: dict[str, int]
    """Largest resident size by process."""
    warnings: tuple[str, ...]
    """What was odd but usable."""


def classify(
    request: ClassifyRequest,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> ClassifySummary:
    """Classify the points of all inputs and write each as LAZ 1.4.

    `on_event`, `executor` and `cancelled` are those of `pipeline.runtime.run.run`.

    Raises
    ------
    InputError
        An input cannot be used, or cannot be written again without loss.
    SettingsError
        Settings are out of range.
    RunError
        A file cannot be written, or exists already.
    RunCancelledError
        `cancelled` ended it; complete files stay.
    ClusterError
        The scheduler does not answer or was lost.
    """
    if request.raster_cell is not None and not request.rasters:
        raise SettingsError(
            [f"raster_cell is {request.raster_cell:g} where no rasters are asked for: give --rasters too"]
        )
    began = time.perf_counter()
    progress = Progress(on_event)
    progress.tell("run", "plan", f"classify into {request.out}")
    run_request = RunRequest(
        inputs=request.inputs,
        only_files=request.only_files,
        out=request.out,
        settings=request.settings,
        resources=request.resources,
        **values_of(InputOptions, request),
    )
    plan, paths = plan_inputs(run_request, progress, cancelled, executor)
    for path in paths:
        if is_url(path):
            raise InputError(shown(path), "classify reads files of this machine only", "Fetch it first")
    for info in plan.sources:
        check_writable(info)
    footprints = footprints_of_run(request.footprints, plan, request.settings.footprints, request.footprints_layer)
    for warning in () if footprints is None else footprints.warnings:
        progress.warn("plan", warning)
    unit_m = plan.reference.horizontal_unit_m
    cell = default_cell(unit_m) if request.raster_cell is None else request.raster_cell
    RasterLattice.over(_bounds_of_boxes([info.bounds_m for info in plan.sources]), cell, unit_m)  # refused early
    out = _checked_folder(request, paths)
    for name in remove_abandoned(out / _SCRATCH):
        progress.warn("plan", f"removed {out / _SCRATCH / name}: an earlier command was cut off and left it")
    progress.timings["plan"] = time.perf_counter() - began
    with run_context(
        plan,
        progress,
        request.resources,
        locked_work(str(out / _SCRATCH)) if request.resources.resume else _scratch(out),
        lambda: dataclasses.replace(expected(plan, 0), models=False),
        loads=loads_of("classify", footprints=footprints is not None),
        executor=executor,
        cancelled=cancelled,
    ) as context:
        inputs = read_inputs(context, request.settings, paths, footprints)
        ingested = inputs.ingested
        ground = find_ground(context, request.settings, inputs.cells)
        splits = split(context, request.settings, ingested, ground, footprints)
        roof = request.settings.building.roof
        joined = join(context, request.settings.scene, roof, splits, footprints, outlines=False)
        tiles = sorted(splits.places)
        # everything that the stages below read: an attempt that resumes repeats none of their tasks
        seen = key_of([found.parts for found in ingested], splits.keys, joined.keys, request.settings)
        _label_all(context, request.settings, tiles, joined, ingested, given=footprints is not None, seen=seen)
        files = _write_all(context, paths, ingested, out, seen)
        rasters = _draw_all(context, tiles, ingested, cell, out, seen) if request.rasters else []
    return _summary(progress, out, files, rasters, joined.candidates, began)


@contextlib.contextmanager
def _scratch(out: Path) -> Iterator[Scratch]:
    """Scratch in a folder of its own, since several commands may write into the same place."""
    with locked_folder(out / _SCRATCH) as folder:
        yield Scratch(str(folder))


def _summary(
    progress: Progress, out: Path, files: Sequence[ClassifiedFile], rasters: Sequence[str], buildings: int, began: float
) -> ClassifySummary:
    """What was written; warns of what was odd in the files."""
    classes: Counter[int] = Counter()
    for file in files:
        classes.update(file.classes)
        for warning in file.warnings:
            progress.warn("write", f"{file.source}: {warning}")
    driver, peak_bytes = peak_of_process()
    progress.peaks[driver] = peak_bytes
    progress.timings["total"] = time.perf_counter() - began
    progress.tell("finished", "", f"{sum(classes.values())} points in {progress.timings['total']:.1f} s")
    return ClassifySummary(
        out=str(out),
        files=tuple(files),
        rasters=tuple(rasters),
        classes={code: classes[code] for code in sorted(classes)},
        buildings=buildings,
        timings_s=progress.timings,
        peak_memory_bytes=progress.peaks,
        warnings=tuple(progress.warnings),
    )


def _label_all(
    context: RunContext,
    settings: RunSettings,
    tiles: Sequence[Tile],
    joined: Joined,
    ingested: Sequence[Ingested],
    *,
    given: bool,
    seen: str,
) -> None:
    """The classes of all tiles' points, in scratch; buildings may be `given` by footprints."""
    grid = context.plan.grid
    classes, _ = classes_in_use(ingested, trust=settings.general.classes == "trust")
    sites = SitesNear.of(joined)
    tasks = {
        Place("classify", tile.key, key_of(seen, tile, given)): LabelTask(
            tile=tile,
            grid=grid,
            settings=settings.scene,
            classes=classes,
            given=given or classes.building,
            scratch=context.scratch,
            buildings=sites.groups_in(near),
            rejected=sites.rejected_in(near),
        )
        for tile in tiles
        for near in [tuple(grid.tiles_over(neighbourhood(tile, grid, settings.scene)))]
    }
    context.map_stored("classify", label, tasks, whole)


def _write_all(
    context: RunContext, paths: Sequence[str], ingested: Sequence[Ingested], out: Path, seen: str
) -> list[ClassifiedFile]:
    """All files, in the inputs' order."""
    tasks = {
        Place("write", part_of(path), key_of(seen, path, str(out))): ClassifiedTask(
            parts=found.parts,
            path=path,
            used=sum(found.points_by_tile.values()),
            name=output_name(path),
            out=str(out),
            options=context.plan.options,
            grid=context.plan.grid,
            scratch=context.scratch,
        )
        for path, found in zip(paths, ingested, strict=True)
    }
    return sorted(context.map_stored("write", write_classified, tasks, whole).values(), key=lambda file: file.source)


def _draw_all(
    context: RunContext,
    tiles: Sequence[Tile],
    ingested: Sequence[Ingested],
    cell: float,
    out: Path,
    seen: str,
) -> list[str]:
    """All rasters, each one mosaic of the tiles; their paths."""
    reference = context.plan.reference
    boxes = [tuple(v / MM for v in found.bounds_mm) for found in ingested if found.bounds_mm is not None]
    lattice = RasterLattice.over(_bounds_of_boxes(boxes), cell, reference.horizontal_unit_m)
    drawn = with_neighbours(set(tiles))
    tasks = {
        Place("rasters", tile.key, key_of(seen, tile, lattice)): RasterTask(
            tile=tile,
            grid=context.plan.grid,
            lattice=lattice,
            scratch=context.scratch,
            vertical_unit_m=reference.vertical_unit_m,
        )
        for tile in drawn
    }
    context.map_stored("rasters", draw_tile, tasks, whole)
    mosaics = {
        Place("mosaics", name, key_of(seen, lattice, str(out))): MosaicTask(
            name=name, tiles=tuple(drawn), lattice=lattice, scratch=context.scratch, out=str(out), reference=reference
        )
        for name in RASTERS
    }
    return sorted(context.map_stored("mosaics", write_mosaic, mosaics, whole).values())


def _bounds_of_boxes(boxes: Sequence[tuple[float, ...]]) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max around boxes of x, y, z minimum, then maximum."""
    return (
        min(box[0] for box in boxes),
        min(box[1] for box in boxes),
        max(box[3] for box in boxes),
        max(box[4] for box in boxes),
    )


def _checked_folder(request: ClassifyRequest, paths: Sequence[str]) -> Path:
    """The folder of the outcome, checked against all that would be written, and made."""
    if "://" in request.out:
        raise RunError(f"{request.out} is no local path: this version writes local folders only")
    out = Path(request.out).resolve()
    sources: dict[str, str] = {}
    for path in paths:
        name = output_name(path)
        if name in sources:
            raise RunError(f"{sources[name]} and {path} would both be written as {name}: classify them apart")
        sources[name] = path
        if (out / name).resolve() == Path(path).resolve():
            raise RunError(f"{path} would be replaced by its own outcome: give another --out")
    names = [*sources, *(f"{name}.tif" for name in RASTERS if request.rasters)]
    odd = [name for name in names if (out / name).is_dir()]
    odd.extend(name for name in (_SCRATCH,) if (out / name).exists() and not (out / name).is_dir())
    if odd:
        raise RunError(f"{out / odd[0]} stands in the way: remove it, or give another --out")
    there = [name for name in names if (out / name).exists()]
    if there and not request.overwrite:
        raise RunError(f"{out} holds {there[0]} already: give another --out, or --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / f".{uuid4().hex}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise RunError(f"{out} cannot be written: {error.strerror or error}. Give another --out") from error
    return out
