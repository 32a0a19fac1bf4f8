"""Classification: plan, ingest, split and join as of a run, then a class for every point, written in file order."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from uuid import uuid4

from pipeline.errors import InputError, RunError, SettingsError
from pipeline.export.raster import RasterLattice
from pipeline.io import SpatialReference, is_url, shown
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.cluster.tls import TlsFiles
from pipeline.runtime.engine import executor_for
from pipeline.runtime.expected import expected
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.monitoring.events import Listener, Watch, ignore, never
from pipeline.runtime.monitoring.measurement import peak_of_process
from pipeline.runtime.plan import check_memory
from pipeline.runtime.run import RunRequest, calling_off, plan_inputs
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import held_folder, remove_abandoned
from pipeline.runtime.stages.ingest import Ingested, part_of
from pipeline.runtime.stages.join import Joined, PointRange
from pipeline.runtime.stages.label import LabelTask, label, neighbourhood
from pipeline.runtime.stages.progress import Progress
from pipeline.runtime.stages.rasters import (
    RASTERS,
    MosaicTask,
    RasterTask,
    default_cell,
    draw_tile,
    with_neighbours,
    write_mosaic,
)
from pipeline.runtime.stages.stages import Stages, classes_in_use, given_footprints
from pipeline.runtime.stages.write_classified import (
    ClassifiedFile,
    ClassifiedTask,
    check_writable,
    output_name,
    write_classified,
)
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

_SCRATCH = "scratch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifyRequest:
    """What is to be done."""

    inputs: tuple[str, ...]
    """Files, folders or patterns."""
    out: str
    """The folder to write; what else is in it stays."""
    settings: RunSettings = dataclasses.field(default_factory=RunSettings)
    """All settings; those of methods do not matter."""
    footprints: str | None = None
    """A vector file of building outlines: then only what lies inside them is building."""
    crs: str | None = None
    """Stands above the headers' CRS, and is written."""
    vertical_unit: str | None = None
    """Stands above the headers' vertical unit."""
    rasters: bool = False
    """Write terrain, surface and height too."""
    raster_cell: float | None = None
    """Side of their cells in units of the CRS; None for half a metre."""
    workers: int | None = None
    """Processes of the embedded cluster; 0 runs serially in this process, None leaves it to the estimate."""
    scheduler: str | None = None
    """Address of a Dask scheduler that takes the place of the embedded cluster."""
    tls: TlsFiles | None = None
    """Certificates for the cluster's traffic; by default those of the environment."""
    overwrite: bool = False
    """Replace files of the same names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifySummary:
    """What was written."""

    out: str
    """The folder."""
    files: tuple[ClassifiedFile, ...]
    """One an input, in the order of their names."""
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

    Parameters
    ----------
    request : ClassifyRequest
        What is to be done.
    on_event : callable
        Gets an `Event` for every stage, step and warning.
    executor : Executor, optional
        Where tasks run; by default what the request asks for.
    cancelled : callable
        Asked several times a second, from another thread; once it is true the command ends as soon as it can.

    Returns
    -------
    ClassifySummary
        Files, counts, timings.

    Raises
    ------
    InputError
        An input cannot be used, or not be written anew without loss.
    SettingsError
        Settings are out of range.
    RunError
        A file cannot be written, or is there already.
    RunCancelledError
        `cancelled` called it off; files that were complete stay.
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
        out=request.out,
        settings=request.settings,
        footprints=request.footprints,
        crs=request.crs,
        vertical_unit=request.vertical_unit,
    )
    plan, paths = plan_inputs(run_request, request.settings, progress)
    for path in paths:
        if is_url(path):
            raise InputError(shown(path), "classify reads files of this machine only", "Fetch it first")
    for info in plan.sources:
        check_writable(info)
    footprints = None if request.footprints is None else given_footprints(request.footprints, plan)
    for warning in () if footprints is None else footprints.warnings:
        progress.warn("plan", warning)
    reference = plan.sources[0].reference
    cell = default_cell(reference.horizontal_unit_m) if request.raster_cell is None else request.raster_cell
    boxes = [info.bounds_m for info in plan.sources]
    RasterLattice.over(_bounds_of_boxes(boxes), cell, reference.horizontal_unit_m)  # refused early
    out = _checked_folder(request, paths)
    for name in remove_abandoned(out / _SCRATCH):
        progress.warn("plan", f"removed {out / _SCRATCH / name}: an earlier command was cut off and left it")
    progress.timings["plan"] = time.perf_counter() - began
    with held_folder(out / _SCRATCH) as scratch_dir:
        scratch = Scratch(str(scratch_dir))
        engine = executor or executor_for(
            workers=request.workers,
            scheduler=request.scheduler,
            local_directory=str(scratch_dir / "dask"),
            work=expected(plan, 0),
            tls=request.tls,
            isolates=False,
            loads=loads_of("classify", footprints=request.footprints is not None),
        )
        with calling_off(scratch, cancelled) as called_off, engine:
            progress.watch = Watch(cancelled=called_off, stop=scratch.cancel, listener=on_event)
            engine.prepare("plan", progress.watch)
            check_memory(plan, engine.memory_limit_bytes)
            stages = Stages(
                settings=request.settings,
                meshes="none",
                plan=plan,
                progress=progress,
                executor=engine,
                scratch=scratch,
            )
            try:
                ingested = stages.ingest(paths)
                splits = stages.split(ingested, footprints)
                joined = stages.join(splits, footprints, reference)
                tiles = sorted(splits.places)
                _label_all(stages, tiles, joined, ingested)
                files = _write_all(stages, paths, ingested, out)
                rasters = _draw_all(stages, tiles, ingested, cell, reference, out) if request.rasters else []
            except BaseException:
                scratch.cancel()
                raise
    for file in files:
        for warning in file.warnings:
            progress.warn("write", f"{file.source}: {warning}")
    classes: Counter[int] = Counter()
    for file in files:
        classes.update(file.classes)
    driver, peak_bytes = peak_of_process()
    progress.peaks[driver] = peak_bytes
    progress.timings["total"] = time.perf_counter() - began
    progress.tell("finished", "", f"{sum(classes.values())} points in {progress.timings['total']:.1f} s")
    return ClassifySummary(
        out=str(out),
        files=tuple(files),
        rasters=tuple(rasters),
        classes={code: classes[code] for code in sorted(classes)},
        buildings=len(joined.candidates),
        timings_s=progress.timings,
        peak_memory_bytes=progress.peaks,
        warnings=tuple(progress.warnings),
    )


def _label_all(stages: Stages, tiles: Sequence[Tile], joined: Joined, ingested: Sequence[Ingested]) -> None:
    """The classes of all tiles' points, in scratch."""
    plan, settings = stages.plan, stages.settings
    classes, _ = classes_in_use(ingested, trust=settings.general.classes == "trust")
    held: dict[Tile, list[PointRange]] = {}
    for site in joined.candidates:
        for part in site.ranges:
            held.setdefault(part.tile, []).append(part)
    tasks = [
        LabelTask(
            tile=tile,
            grid=plan.grid,
            settings=settings.scene,
            classes=classes,
            scratch=stages.scratch,
            buildings=tuple(
                part
                for other in plan.grid.tiles_over(neighbourhood(tile, plan.grid, settings.scene))
                for part in held.get(other, ())
            ),
        )
        for tile in tiles
    ]
    stages.progress.stage(stages.executor, "classify", label, tasks)


def _write_all(stages: Stages, paths: Sequence[str], ingested: Sequence[Ingested], out: Path) -> list[ClassifiedFile]:
    """All files, in the inputs' order."""
    tasks = [
        ClassifiedTask(
            part=part_of(path),
            path=path,
            used=sum(ingested[k].points_by_tile.values()),
            name=output_name(path),
            out=str(out),
            options=stages.plan.options,
            grid=stages.plan.grid,
            scratch=stages.scratch,
        )
        for k, path in enumerate(paths)
    ]
    files = stages.progress.stage(stages.executor, "write", write_classified, tasks)
    return sorted(files, key=lambda file: file.source)


def _draw_all(
    stages: Stages,
    tiles: Sequence[Tile],
    ingested: Sequence[Ingested],
    cell: float,
    reference: SpatialReference,
    out: Path,
) -> list[str]:
    """All rasters, each one mosaic of the tiles; their paths."""
    boxes = [tuple(v / MM for v in found.bounds_mm) for found in ingested if found.bounds_mm is not None]
    lattice = RasterLattice.over(_bounds_of_boxes(boxes), cell, reference.horizontal_unit_m)
    drawn = with_neighbours(set(tiles))
    stages.progress.stage(
        stages.executor,
        "rasters",
        draw_tile,
        [
            RasterTask(
                tile=tile,
                grid=stages.plan.grid,
                lattice=lattice,
                settings=stages.settings.scene,
                scratch=stages.scratch,
                vertical_unit_m=reference.vertical_unit_m,
            )
            for tile in drawn
        ],
    )
    mosaics = [
        MosaicTask(
            name=name, tiles=tuple(drawn), lattice=lattice, scratch=stages.scratch, out=str(out), reference=reference
        )
        for name in RASTERS
    ]
    return sorted(stages.progress.stage(stages.executor, "mosaics", write_mosaic, mosaics))


def _bounds_of_boxes(boxes: Sequence[tuple[float, ...]]) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max around boxes of x, y, z minimum, then maximum."""
    return (
        min(box[0] for box in boxes),
        min(box[1] for box in boxes),
        max(box[3] for box in boxes),
        max(box[4] for box in boxes),
    )


def _checked_folder(request: ClassifyRequest, paths: Sequence[str]) -> Path:
    """The folder of the outcome, made, after a look at what would be written.

    Raises
    ------
    RunError
        Two inputs would get one name, an input would be replaced, a file is there already, something stands in the
        way, or it cannot be written.
    """
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
