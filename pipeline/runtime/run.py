"""A run from inputs to a run directory: plan, ingest, split, join, reconstruct, publish."""

from __future__ import annotations

import dataclasses
import datetime as dt
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import shapely

from pipeline import __version__
from pipeline.errors import EmptyInputError, InconsistentInputError, RunError
from pipeline.export.records import RecordContext
from pipeline.io import ReadOptions, SpatialReference, find_inputs, open_source
from pipeline.io.footprints import read_area, read_footprints
from pipeline.io.gps_time import GpsTimeKind
from pipeline.io.storage import sha256_of
from pipeline.runtime.digest import run_digest
from pipeline.runtime.events import Event, Listener, ignore
from pipeline.runtime.executors import Executor, executor_for
from pipeline.runtime.ingest import Ingested, IngestTask, ingest, spread_m
from pipeline.runtime.join import Joined, join, join_footprints
from pipeline.runtime.manifest import InputFile, RunManifest, RunStatus, write_manifest
from pipeline.runtime.modelling import BatchTask, Footprints, Modelled, batches, model_batch
from pipeline.runtime.plan import Plan, check_memory, make_plan
from pipeline.runtime.publish import PublishTask, publish
from pipeline.runtime.scratch import Scratch
from pipeline.runtime.split import Split, SplitTask, split
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, ClassesInUse
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

Task = TypeVar("Task")
Result = TypeVar("Result")

_LINE_SPREAD_M = 0.05
_OWN_FOLDERS = ("buildings", "planes", "rejected", "meshes", "cityjson", "state", "scratch")
_FOOTPRINTS = "footprints.pickle"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunRequest:
    """What is to be done."""

    inputs: tuple[str, ...]
    """Files, folders or patterns."""
    out: str
    """The run directory; new or empty, unless `overwrite`."""
    settings: RunSettings = dataclasses.field(default_factory=RunSettings)
    """All settings."""
    footprints: str | None = None
    """A vector file of building outlines to be modelled."""
    crs: str | None = None
    """Stands above the headers' CRS."""
    vertical_unit: str | None = None
    """Stands above the headers' vertical unit."""
    bbox: tuple[float, float, float, float] | None = None
    """x_min, y_min, x_max, y_max in the CRS's units."""
    aoi: str | None = None
    """A vector file of areas of interest."""
    workers: int = 2
    """Processes of the embedded cluster; 0 runs serially in this process."""
    scheduler: str | None = None
    """Address of a Dask scheduler that takes the place of the embedded cluster."""
    meshes: str = "building"
    """One OBJ a building, one a tile, or none."""
    licence: str | None = None
    """Licence of the source data, in the user's words."""
    overwrite: bool = False
    """Replace what an earlier run left in `out`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSummary:
    """What a run found."""

    run_dir: str
    """Where the results are."""
    digest: str
    """sha256 of the content."""
    statuses: dict[str, int]
    """Candidates by status."""
    reasons: dict[str, int]
    """Candidates that are not ok, by reason."""
    rejected: dict[str, int]
    """Objects that are no buildings, by reason."""
    roof_types: dict[str, int]
    """Candidates by roof type."""
    counts: dict[str, int]
    """Points, duplicates, outliers, tiles and the like."""
    timings_s: dict[str, float]
    """Wall-clock seconds by stage."""
    peak_memory_bytes: dict[str, int]
    """Largest resident size by process."""
    warnings: tuple[str, ...]
    """What was odd but usable."""
    failed_tiles: tuple[str, ...] = ()
    """Tiles that could not be published."""


class _Driver:
    """The state of one run on the driver's side: timings, memory, warnings, events."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.timings: dict[str, float] = {}
        self.task_seconds: dict[str, float] = {}
        self.peaks: dict[str, int] = {}
        self.warnings: list[str] = []

    def tell(self, kind: str, stage: str, message: str = "", done: int = 0, total: int = 0) -> None:
        """Send an event."""
        self._listener(Event(kind=kind, stage=stage, done=done, total=total, message=message))  # type: ignore[arg-type]

    def warn(self, stage: str, message: str) -> None:
        """Keep and send a warning."""
        if message not in self.warnings:
            self.warnings.append(message)
            self.tell("warning", stage, message)

    def stage(
        self,
        executor: Executor,
        name: str,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        weight: Callable[[Result], int] = lambda _: 1,
        total: int | None = None,
    ) -> list[Result]:
        """Run a stage's tasks and report its progress in units of `weight`."""
        started = time.perf_counter()
        whole = len(tasks) if total is None else total
        done = 0
        self.tell("stage", name, total=whole)
        results = []
        for measured in executor.map(name, function, tasks):
            results.append(measured.result)
            self.peaks[measured.process] = max(self.peaks.get(measured.process, 0), measured.peak_bytes)
            self.task_seconds[name] = self.task_seconds.get(name, 0.0) + measured.seconds
            done += weight(measured.result)
            self.tell("progress", name, done=done, total=whole)
        self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started
        return results


def run(request: RunRequest, on_event: Listener = ignore, executor: Executor | None = None) -> RunSummary:
    """Reconstruct all buildings of the inputs into a run directory.

    Parameters
    ----------
    request : RunRequest
        What is to be done.
    on_event : callable
        Gets an `Event` for every stage, step and warning.
    executor : Executor, optional
        Where tasks run; by default what the request asks for.

    Returns
    -------
    RunSummary
        Counts, timings, digest.

    Raises
    ------
    InputError
        An input cannot be used.
    SettingsError
        Settings are out of range.
    RunError
        The run directory cannot be used, or workers died.
    """
    started_at = dt.datetime.now(tz=dt.UTC)
    driver = _Driver(on_event)
    began = time.perf_counter()
    driver.tell("run", "plan", f"run into {request.out}")
    plan, paths = _plan(request, driver)
    run_dir = _prepared(request)
    scratch = Scratch(str(run_dir / "scratch"))
    reference = plan.sources[0].reference
    manifest = RunManifest(
        status=RunStatus.RUNNING,
        engine_version=__version__,
        method=request.settings.general.method,
        settings=request.settings.as_dict(),
        settings_hash=request.settings.settings_hash,
        started_at=started_at,
        crs=_crs_facts(reference),
        source_licence=request.licence,
    )
    write_manifest(run_dir, manifest)
    driver.timings["plan"] = time.perf_counter() - began
    engine = executor or executor_for(
        workers=request.workers, scheduler=request.scheduler, local_directory=str(run_dir / "scratch" / "dask")
    )
    try:
        starting = time.perf_counter()
        with engine:
            driver.timings["start workers"] = time.perf_counter() - starting
            check_memory(plan, engine.memory_limit_bytes)
            stages = _Stages(request=request, plan=plan, driver=driver, executor=engine, scratch=scratch)
            ingested = stages.ingest(paths)
            footprints = stages.read_footprints(reference)
            splits = stages.split(ingested, footprints)
            joined = stages.join(splits, footprints, reference)
            modelled = stages.reconstruct(joined, footprints)
            tiles = stages.publish(joined, modelled, reference, str(run_dir))
    finally:
        scratch.clear()
    finishing = time.perf_counter()
    digest = run_digest(str(run_dir))
    driver.timings["digest"] = time.perf_counter() - finishing
    driver.timings["total"] = time.perf_counter() - began
    counts = _counts(plan, ingested, splits, joined, modelled)
    inputs = [
        InputFile(
            path=path,
            sha256=found.sha256,
            size_bytes=Path(path).stat().st_size,
            n_points=sum(found.points_by_tile.values()),
        )
        for path, found in zip(paths, ingested, strict=True)
    ]
    if request.footprints is not None:
        path = Path(request.footprints)
        inputs.append(InputFile(path=str(path), sha256=sha256_of(path), size_bytes=path.stat().st_size))
    write_manifest(
        run_dir,
        dataclasses.replace(
            manifest,
            status=RunStatus.FINISHED,
            finished_at=dt.datetime.now(tz=dt.UTC),
            inputs=tuple(inputs),
            tiles=tuple(tiles),
            counts=counts,
            timings_s={name: round(seconds, 3) for name, seconds in driver.timings.items()},
            peak_memory_bytes=driver.peaks,
            warnings=tuple(driver.warnings),
            content_sha256=digest,
        ),
    )
    driver.tell("finished", "", f"{counts['candidates']} candidates in {driver.timings['total']:.1f} s")
    return RunSummary(
        run_dir=str(run_dir),
        digest=digest,
        statuses=dict(Counter(m.status for m in modelled)),
        reasons=dict(Counter(m.reason for m in modelled if m.reason is not None)),
        rejected=dict(Counter(site.verdict.reason.value for site in joined.rejected)),
        roof_types=dict(Counter(m.roof_type for m in modelled)),
        counts=counts,
        timings_s=driver.timings,
        peak_memory_bytes=driver.peaks,
        warnings=tuple(driver.warnings),
    )


def _plan(request: RunRequest, driver: _Driver) -> tuple[Plan, list[str]]:
    """The plan and the input files in order."""
    paths = sorted(str(path) for path in find_inputs(request.inputs))
    options = ReadOptions(crs=request.crs, vertical_unit=request.vertical_unit, bbox=request.bbox)
    if request.aoi is not None:
        reference = open_source(paths[0], options).info.reference
        options = dataclasses.replace(options, aoi=read_area(request.aoi, reference))
    plan = make_plan(paths, options, request.settings)
    for warning in plan.warnings:
        driver.warn("plan", warning)
    if not any(info.has_returns for info in plan.sources):
        driver.warn("plan", "the inputs have one return a pulse: vegetation is told by its roughness alone")
    if not any(info.has_classes for info in plan.sources) and request.settings.general.classes == "trust":
        driver.warn("plan", "the inputs have no classes: ground and buildings are found in the points alone")
    return plan, paths


def _prepared(request: RunRequest) -> Path:
    """The run directory, without what an earlier run left in it.

    Raises
    ------
    RunError
        It holds something and `overwrite` is not asked for, or it cannot be written.
    """
    run_dir = Path(request.out)
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        left = [entry.name for entry in run_dir.iterdir()]
        if left and not request.overwrite:
            raise RunError(f"{run_dir} is not empty ({left[0]} …): give another --out, or --overwrite")
        if left and "run.json" not in left:
            raise RunError(f"{run_dir} holds {left[0]} and no run.json, so it is no run: give another --out")
        for name in _OWN_FOLDERS:
            shutil.rmtree(run_dir / name, ignore_errors=True)
    except OSError as error:
        raise RunError(f"{run_dir} cannot be written: {error.strerror or error}. Give another --out") from error
    return run_dir


def _crs_facts(reference: SpatialReference) -> dict[str, object]:
    return {
        "epsg": reference.epsg,
        "name": reference.name,
        "wkt": reference.wkt,
        "horizontal_unit_m": reference.horizontal_unit_m,
        "vertical_unit_m": reference.vertical_unit_m,
    }


def _counts(
    plan: Plan, ingested: Sequence[Ingested], splits: Sequence[Split], joined: Joined, modelled: Sequence[Modelled]
) -> dict[str, int]:
    """The counts of run.json."""
    by_status = Counter(m.status for m in modelled)
    dropped: Counter[str] = Counter()
    for found in ingested:
        dropped.update(found.dropped)
    return {
        "points_promised": plan.points,
        "points": sum(s.points for s in splits),
        **{f"dropped_{cause}": count for cause, count in sorted(dropped.items())},
        "duplicates": sum(s.duplicates for s in splits),
        "outliers": sum(s.outliers for s in splits),
        "tiles": len(splits),
        "candidates": len(modelled),
        "ok": by_status["ok"],
        "fallback": by_status["fallback"],
        "failed": by_status["failed"],
        "rejected": len(joined.rejected),
        "small_surfaces": joined.small_fragments,
        "roof_faces": sum(m.faces for m in modelled),
        "class_6_in_candidates": sum(s.audit[0] for s in splits),
        "other_classes_in_candidates": sum(s.audit[1] for s in splits),
        "class_6_elsewhere": sum(s.audit[2] for s in splits),
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Stages:
    """The stages of one run, each a map over tasks or a step of the driver."""

    request: RunRequest
    plan: Plan
    driver: _Driver
    executor: Executor
    scratch: Scratch

    def ingest(self, paths: Sequence[str]) -> list[Ingested]:
        """Bucket all points by tile, and look at what they are."""
        tasks = [
            IngestTask(index=k, path=path, options=self.plan.options, grid=self.plan.grid, scratch=self.scratch)
            for k, path in enumerate(paths)
        ]
        ingested = sorted(self.driver.stage(self.executor, "ingest", ingest, tasks), key=lambda found: found.index)
        for found in ingested:
            for warning in found.warnings:
                self.driver.warn("ingest", f"{paths[found.index]}: {warning}")
        kept = sum(sum(found.points_by_tile.values()) for found in ingested)
        if kept == 0:
            causes = Counter[str]()
            for found in ingested:
                causes.update(found.dropped)
            told = ", ".join(f"{count} {cause}" for cause, count in causes.items() if count)
            raise EmptyInputError(
                paths[0], f"no usable point is left ({told or 'none in the files'})", "Check --bbox, --aoi and classes"
            )
        spread = spread_m(ingested)
        if spread < _LINE_SPREAD_M:
            raise InconsistentInputError(
                paths[0],
                f"all {kept} points lie on one line (they stray {spread:.3f} m from it)",
                "Check the columns and the scale of the file",
            )
        return ingested

    def read_footprints(self, reference: SpatialReference) -> Footprints | None:
        """The given footprints, stored for the workers."""
        if self.request.footprints is None:
            return None
        found = read_footprints(self.request.footprints, reference)
        for warning in found.warnings:
            self.driver.warn("split", warning)
        low_x, low_y = min(i.bounds_m[0] for i in self.plan.sources), min(i.bounds_m[1] for i in self.plan.sources)
        high_x, high_y = max(i.bounds_m[3] for i in self.plan.sources), max(i.bounds_m[4] for i in self.plan.sources)
        box = shapely.box(low_x, low_y, high_x, high_y)
        inside = [k for k, polygon in enumerate(found.polygons) if polygon.intersects(box)]
        if len(inside) < len(found.polygons):
            self.driver.warn(
                "split", f"{len(found.polygons) - len(inside)} of {len(found.polygons)} footprints lie off the data"
            )
        # one order, whatever the file's: overlaps are decided by it
        inside.sort(key=lambda k: (found.polygons[k].bounds, found.ids[k]))
        footprints = Footprints(
            polygons=tuple(found.polygons[k] for k in inside), ids=tuple(found.ids[k] for k in inside)
        )
        self.scratch.put_object(_FOOTPRINTS, footprints)
        return footprints

    def split(self, ingested: Sequence[Ingested], footprints: Footprints | None) -> list[Split]:
        """Fragments of all tiles."""
        histogram: Counter[int] = Counter()
        tiles: Counter[Tile] = Counter()
        for found in ingested:
            histogram.update(found.classes)
            tiles.update(found.points_by_tile)
        trust = self.request.settings.general.classes == "trust"
        classes = ClassesInUse(
            ground=trust and histogram[GROUND_CLASS] > 0, building=trust and histogram[BUILDING_CLASS] > 0
        )
        tasks = [
            SplitTask(
                tile=tile,
                grid=self.plan.grid,
                settings=self.request.settings.scene,
                classes=classes,
                scratch=self.scratch,
                footprints=None if footprints is None else _FOOTPRINTS,
            )
            # the fullest first, so that no long task is left for the end
            for tile, _ in sorted(tiles.items(), key=lambda item: (-item[1], item[0]))
        ]
        splits = self.driver.stage(self.executor, "split", split, tasks)
        duplicates, outliers = sum(s.duplicates for s in splits), sum(s.outliers for s in splits)
        if duplicates:
            self.driver.warn("split", f"{duplicates} duplicated points were dropped")
        if outliers:
            self.driver.warn("split", f"{outliers} gross outliers were left out")
        return splits

    def join(self, splits: Sequence[Split], footprints: Footprints | None, reference: SpatialReference) -> Joined:
        """Whole surfaces, judged."""
        started = time.perf_counter()
        self.driver.tell("stage", "join", total=1)
        crs_name = f"EPSG:{reference.epsg}" if reference.epsg is not None else reference.name
        if footprints is None:
            joined = join(splits, self.plan.grid, self.request.settings.scene.candidates, crs_name)
        else:
            corners = []
            for number, polygon in enumerate(footprints.polygons):
                x, y = min(map(tuple, shapely.get_coordinates(polygon).tolist()))
                corners.append((round(x * MM), round(y * MM), number))
            joined = join_footprints(splits, self.plan.grid, corners, crs_name)
        self.driver.timings["join"] = time.perf_counter() - started
        self.driver.tell("progress", "join", done=1, total=1, message=f"{len(joined.candidates)} candidates")
        return joined

    def reconstruct(self, joined: Joined, footprints: Footprints | None) -> list[Modelled]:
        """All candidates, largest first."""
        kinds = {info.gps_time_kind for info in self.plan.sources}
        kind = kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE
        tasks = [
            BatchTask(
                number=number,
                sites=sites,
                method=self.request.settings.general.method,
                settings=self.request.settings.building,
                grid=self.plan.grid,
                scratch=self.scratch,
                footprints=None if footprints is None else _FOOTPRINTS,
                gps_kind=kind,
            )
            for number, sites in enumerate(batches(joined.candidates))
        ]
        parts = self.driver.stage(
            self.executor, "reconstruct", model_batch, tasks, weight=len, total=len(joined.candidates)
        )
        return [building for part in parts for building in part]

    def publish(
        self, joined: Joined, modelled: Sequence[Modelled], reference: SpatialReference, run_dir: str
    ) -> list[str]:
        """Write every tile that owns something; their keys."""
        batch_of = {
            site.building_id: number for number, sites in enumerate(batches(joined.candidates)) for site in sites
        }
        numbers: dict[Tile, set[int]] = {}
        for building in modelled:
            numbers.setdefault(building.owner, set()).add(batch_of[building.building_id])
        owners = sorted({*numbers, *(site.owner for site in joined.rejected)})
        times = [(i.acquired_from, i.acquired_to) for i in self.plan.sources]
        known = [(a, b) for a, b in times if a is not None and b is not None]
        context = RecordContext(
            reference=reference,
            settings_hash=self.request.settings.settings_hash,
            engine_version=__version__,
            acquired_from=min((a for a, _ in known), default=None),
            acquired_to=max((b for _, b in known), default=None),
        )
        tasks = [
            PublishTask(
                tile=tile,
                run_dir=run_dir,
                scratch=self.scratch,
                batches=tuple(sorted(numbers.get(tile, ()))),
                rejected=tuple(site for site in joined.rejected if site.owner == tile),
                context=context,
                meshes=self.request.meshes,
            )
            for tile in owners
        ]
        published = self.driver.stage(self.executor, "publish", publish, tasks)
        return sorted(p.tile.key for p in published)
