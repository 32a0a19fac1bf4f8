"""A run from inputs to a run directory: plan, ingest, split, join, outline, reconstruct, publish."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from uuid import uuid4

import shapely

from pipeline import __version__
from pipeline.errors import RunCancelledError, RunError, SettingsError
from pipeline.io import (
    ReadOptions,
    SpatialReference,
    find_inputs,
    is_url,
    open_source,
    sha256_of,
    shown,
    storage_at,
)
from pipeline.io.footprints import read_area
from pipeline.io.remote_file import on_this_machine
from pipeline.io.tile_index import TileIndex
from pipeline.runtime.cluster.dispatch import TICK_S
from pipeline.runtime.cluster.priorities import Traffic
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.cluster.tls import TlsFiles
from pipeline.runtime.engine import executor_for
from pipeline.runtime.expected import expected
from pipeline.runtime.isolation.isolated_items import IsolationLimits
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.manifest import (
    NAME,
    PAGE,
    InputFile,
    RunManifest,
    RunStatus,
    read_manifest,
    write_manifest,
)
from pipeline.runtime.monitoring.events import Listener, Watch, ignore, never
from pipeline.runtime.monitoring.logs import about
from pipeline.runtime.monitoring.measurement import peak_of_process
from pipeline.runtime.overrides.overrides_file import read_overrides
from pipeline.runtime.plan import Plan, check_memory, make_plan, without_far_files
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import held_results
from pipeline.runtime.scratch.location import check_scratch, remove_folder, scratch_folder
from pipeline.runtime.scratch.work_folder import held_work
from pipeline.runtime.stages.cleanup import tidy
from pipeline.runtime.stages.counts import Counted, told_counts
from pipeline.runtime.stages.ingest import Ingested
from pipeline.runtime.stages.join import Joined
from pipeline.runtime.stages.progress import Progress
from pipeline.runtime.stages.publish import QUARANTINE, Published
from pipeline.runtime.stages.stages import MODELS, Models, Stages, given_footprints
from pipeline.settings import RunSettings
from pipeline.tiling import MM

FOOTPRINTS = "footprints.json"
"""What was wrong with the given footprints, one by one; there where footprints were given."""
OVERRIDES = "overrides.json"
"""What became of each entry of the overrides; there where overrides were given."""

_RESULTS = ("buildings", "planes", "rejected", "meshes", "cityjson", "state", QUARANTINE)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunRequest:
    """What is to be done."""

    inputs: tuple[str, ...]
    """Files, folders, patterns, URLs or tile indexes."""
    out: str
    """The run directory, a folder or `s3://bucket/prefix`; new or empty, unless `overwrite`."""
    settings: RunSettings = dataclasses.field(default_factory=RunSettings)
    """All settings."""
    footprints: str | None = None
    """A vector file of building outlines to be modelled."""
    overrides: str | None = None
    """A TOML file that says of single buildings what is to be done; `pipeline.runtime.overrides.overrides_file`."""
    crs: str | None = None
    """Stands above the headers' CRS."""
    vertical_unit: str | None = None
    """Stands above the headers' vertical unit."""
    bbox: tuple[float, float, float, float] | None = None
    """x_min, y_min, x_max, y_max in the CRS's units."""
    aoi: str | None = None
    """A vector file of areas of interest."""
    workers: int | None = None
    """Processes of the embedded cluster; 0 runs serially in this process, None leaves it to the estimate."""
    scheduler: str | None = None
    """Address of a Dask scheduler that takes the place of the embedded cluster."""
    tls: TlsFiles | None = None
    """Certificates for the cluster's traffic; by default those of the environment."""
    traffic: Traffic = "interactive"
    """Whether somebody waits for the run; tasks of a `batch` go behind where workers are scarce."""
    performance_report: str | None = None
    """Gets a page about the workers' time; none by default."""
    scratch: str | None = None
    """A folder for what is neither input nor result, the same for all workers; by default the run directory, or a
    temporary folder of this machine where that is a URL."""
    only_files: bool = False
    """Take each input for the path of a file and follow neither folders, patterns, URLs nor tile indexes: for inputs
    that strangers name."""
    meshes: str = "building"
    """One OBJ a building, one a tile, or none."""
    licence: str | None = None
    """Licence of the source data, in the user's words."""
    overwrite: bool = False
    """Replace what an earlier run left in `out`."""
    work: str | None = None
    """A folder that keeps what the tasks find. A run with the same one goes on where the one before was cut off, and
    does again only what changed since; None keeps nothing."""
    isolate: bool | None = None
    """Model buildings in supervised child processes; None does so with workers and not serially."""
    building_timeout_s: float = IsolationLimits.timeout_s
    """Wall-clock seconds that one building may take where buildings are isolated."""
    building_memory_bytes: int = IsolationLimits.memory_bytes
    """Memory that the process of one building may take where buildings are isolated."""

    @property
    def isolation(self) -> IsolationLimits | None:
        """Limits of the supervised children; None where buildings are modelled in the workers themselves."""
        serial = self.workers == 0 and self.scheduler is None
        if not (not serial if self.isolate is None else self.isolate):
            return None
        return IsolationLimits(timeout_s=self.building_timeout_s, memory_bytes=self.building_memory_bytes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSummary:
    """What a run found."""

    run_dir: str
    """Where the results are: a path, or a URL."""
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunVariant:
    """One way to model the candidates of a run, and where its results go."""

    settings: RunSettings
    """Those of the request but for method, preset and what models a building."""
    out: str
    """Its own run directory."""
    label: str = ""
    """What messages call it; empty where there is but one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantOutcome:
    """What became of one variant."""

    summary: RunSummary
    """As of a run."""
    seconds: dict[str, float]
    """Wall-clock seconds of each building, by its id; empty where there is but one variant."""


def run(
    request: RunRequest,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> RunSummary:
    """Reconstruct all buildings of the inputs into a run directory.

    Parameters
    ----------
    request : RunRequest
        What is to be done.
    on_event : callable
        Gets an `Event` for every stage, step and warning.
    executor : Executor, optional
        Where tasks run; by default what the request asks for.
    cancelled : callable
        Asked several times a second, from another thread; once it is true the run ends as soon as it can.

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
        The run directory cannot be used, or workers died again and again on one task.
    RunCancelledError
        `cancelled` called the run off; its scratch is gone, and `run.json` says so.
    ClusterError
        The scheduler does not answer or was lost, or its processes run other versions; the run may be tried again.
    """
    variant = RunVariant(settings=request.settings, out=request.out)
    (outcome,) = run_variants(request, (variant,), request.out, on_event, executor, cancelled)
    return outcome.summary


def run_variants(
    request: RunRequest,
    variants: Sequence[RunVariant],
    work_dir: str,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
    stale: Sequence[Path] = (),
) -> list[VariantOutcome]:
    """Model the same candidates in several ways: ingest, split and join run once, the rest once a variant.

    Parameters
    ----------
    request : RunRequest
        The inputs and how to run; its `settings` and `out` are not looked at.
    variants : sequence of RunVariant
        At least one; they agree in all that finds candidates.
    work_dir : str
        Folder for the scratch.
    on_event, executor, cancelled
        As of `run`. Progress of a stage counts all variants together.
    stale : sequence of Path
        Files that tell of an earlier run: they go with its results.

    Returns
    -------
    list of VariantOutcome
        In the variants' order.

    Raises
    ------
    SettingsError
        The variants would not find the same candidates.
    InputError, RunError, RunCancelledError, ClusterError
        As `run`.
    """
    started_at = dt.datetime.now(tz=dt.UTC)
    if request.work is None:
        check_scratch(work_dir, request.scratch, request.scheduler)
    for variant in variants:
        storage_at(variant.out)  # a URL where nothing can be stored is told before anything is read
    shared = Progress(on_event)
    began = time.perf_counter()
    settings = _common_settings(variants)
    shared.tell("run", "plan", f"run into {work_dir}")
    plan, paths = plan_inputs(request, settings, shared)
    footprints = None if request.footprints is None else given_footprints(request.footprints, plan)
    for warning in () if footprints is None else footprints.warnings:
        shared.warn("plan", warning)
    reference = plan.sources[0].reference
    overrides = () if request.overrides is None else read_overrides(request.overrides, reference, settings)
    run_dirs = [_checked(variant.out, overwrite=request.overwrite, work=request.work) for variant in variants]
    manifests = [
        RunManifest(
            status=RunStatus.RUNNING,
            engine_version=__version__,
            method=variant.settings.general.method,
            settings=variant.settings.as_dict(),
            settings_hash=variant.settings.settings_hash,
            started_at=started_at,
            crs=_crs_facts(reference),
            request=told_request(request),
            lattice={
                "tile_size_m": plan.grid.size_mm / MM,
                "origin_x_m": plan.grid.origin_x_mm / MM,
                "origin_y_m": plan.grid.origin_y_mm / MM,
            },
            source_licence=request.licence,
        )
        for variant in variants
    ]
    shared.timings["plan"] = time.perf_counter() - began
    with contextlib.ExitStack() as held:
        for run_dir in run_dirs:
            held.enter_context(held_results(run_dir))
            # whoever held it a moment ago may have left something
            check_out(run_dir, overwrite=request.overwrite, work=request.work)
        scratch = held.enter_context(
            _scratch(work_dir, request.scratch) if request.work is None else held_work(request.work)
        )
        engine = executor or executor_for(
            workers=request.workers,
            scheduler=request.scheduler,
            local_directory=str(Path(scratch.root, "dask")),
            work=expected(plan, None if footprints is None else len(footprints.polygons)),
            traffic=request.traffic,
            tls=request.tls,
            performance_report=request.performance_report,
            loads=loads_of("reconstruct", footprints=footprints is not None, method=settings.general.method),
        )
        starting = time.perf_counter()
        with about(run=scratch.name), calling_off(scratch, cancelled) as called_off, engine:
            shared.watch = Watch(cancelled=called_off, stop=scratch.cancel, listener=on_event)
            engine.prepare("plan", shared.watch)
            shared.timings["start workers"] = time.perf_counter() - starting
            check_memory(plan, engine.memory_limit_bytes)
            # nothing of an earlier run goes before all that can be checked is checked
            for run_dir, manifest in zip(run_dirs, manifests, strict=True):
                # whoever reads meanwhile sees that the directory is being changed
                known = request.work is not None and _is_of_work(run_dir, request.work)
                write_manifest(run_dir, manifest, storage_at(run_dir).put)
                storage_at(run_dir).clear((PAGE,) if known else (*_RESULTS, FOOTPRINTS, OVERRIDES, PAGE))
                if footprints is not None:
                    put_json(run_dir, FOOTPRINTS, footprints.report)
            for path in stale:
                path.unlink(missing_ok=True)
            stages = Stages(
                settings=settings,
                meshes=request.meshes,
                plan=plan,
                progress=shared,
                executor=engine,
                scratch=scratch,
                isolation=request.isolation,
                compared=len(variants) > 1,
            )
            progresses: list[Progress] = []
            try:
                ingested = stages.ingest(paths)
                splits = stages.split(ingested, footprints)
                joined = stages.outline(stages.join(splits, footprints, reference))
                if request.overrides is not None:
                    joined, outcomes_of_entries = stages.override(joined, overrides, ingested)
                    for outcome in outcomes_of_entries:
                        if outcome.warning:
                            shared.warn("join", outcome.warning)
                    for run_dir in run_dirs:
                        put_json(run_dir, OVERRIDES, [outcome.as_dict() for outcome in outcomes_of_entries])
                progresses.extend(shared.part(k, len(variants), v.label) for k, v in enumerate(variants))
                each = [
                    dataclasses.replace(stages, settings=v.settings, progress=own)
                    for v, own in zip(variants, progresses, strict=True)
                ]
                modelled = [own.reconstruct(joined) for own in each]
                published = [
                    own.publish(splits, joined, models, reference, run_dir)
                    for own, models, run_dir in zip(each, modelled, run_dirs, strict=True)
                ]
                found = [Counted.of(models, each_told=len(variants) > 1) for models in modelled]
            except BaseException as error:
                scratch.cancel()
                off = isinstance(error, RunCancelledError | KeyboardInterrupt)
                status = RunStatus.CANCELLED if off else RunStatus.FAILED
                message = f"{type(error).__name__}: {error}".removesuffix(": ")
                for k, (run_dir, manifest) in enumerate(zip(run_dirs, manifests, strict=True)):
                    warnings = (progresses[k] if progresses else shared).warnings
                    broken = dataclasses.replace(manifest, status=status, warnings=(*warnings, message))
                    write_manifest(run_dir, broken, storage_at(run_dir).put)
                raise
            if request.work is not None:
                tidy(scratch, joined, {f"{MODELS}-{v.settings.settings_hash[:16]}" for v in variants}, run_dirs)
    inputs = _inputs_told(request, paths, ingested, plan)
    driver, peak_bytes = peak_of_process()
    outcomes = []
    for k, (run_dir, own) in enumerate(zip(run_dirs, progresses, strict=True)):
        finishing = time.perf_counter()
        content = (run_dir, _with_tables(run_dir, joined, modelled[k], published[k]))
        # the run can be called off no more
        digest = engine.run_step("digest", _digest_of, content, Watch())
        own.timings["digest"] = time.perf_counter() - finishing
        # of several variants each is told with what it took alone: the shared stages and its own
        alone = len(variants) == 1
        own.timings["total"] = time.perf_counter() - began if alone else sum(own.timings.values())
        own.peaks[driver] = peak_bytes
        tiles = [outcome.tile.key for outcome in published[k]]
        failed_tiles = [outcome.tile.key for outcome in published[k] if outcome.error]
        counts = told_counts(plan, ingested, splits, joined, found[k])
        write_manifest(
            run_dir,
            dataclasses.replace(
                manifests[k],
                status=RunStatus.INCOMPLETE if failed_tiles else RunStatus.FINISHED,
                finished_at=dt.datetime.now(tz=dt.UTC),
                inputs=inputs,
                tiles=tuple(tiles),
                failed_tiles=tuple(failed_tiles),
                counts=counts,
                timings_s={name: round(seconds, 3) for name, seconds in own.timings.items()},
                peak_memory_bytes=own.peaks,
                slowest=found[k].slowest,
                warnings=tuple(own.warnings),
                content_sha256=digest,
            ),
            storage_at(run_dir).put,
        )
        summary = RunSummary(
            run_dir=run_dir,
            digest=digest,
            statuses=dict(found[k].statuses),
            reasons=dict(found[k].reasons),
            rejected=dict(Counter(site.verdict.reason.value for site in joined.rejected)),
            roof_types=dict(found[k].roof_types),
            counts=counts,
            timings_s=own.timings,
            peak_memory_bytes=own.peaks,
            warnings=tuple(own.warnings),
            failed_tiles=tuple(failed_tiles),
        )
        outcomes.append(VariantOutcome(summary=summary, seconds=found[k].seconds))
    seconds = time.perf_counter() - began
    shared.tell("finished", "", f"{outcomes[0].summary.counts['candidates']} candidates in {seconds:.1f} s")
    return outcomes


def _common_settings(variants: Sequence[RunVariant]) -> RunSettings:
    """The settings that find the candidates.

    Raises
    ------
    SettingsError
        The variants differ in them.
    """
    first = variants[0].settings
    method, preset = first.general.method, first.general.preset
    for variant in variants[1:]:
        general = dataclasses.replace(variant.settings.general, method=method, preset=preset)
        if variant.settings.scene != first.scene or general != first.general:
            raise SettingsError([f"{variant.label} would find other candidates than {variants[0].label}"])
    return first


def _inputs_told(
    request: RunRequest, paths: Sequence[str], ingested: Sequence[Ingested], plan: Plan
) -> tuple[InputFile, ...]:
    """The inputs as the manifest tells them."""
    sizes = {info.path: info.file_size for info in plan.sources}
    inputs = [
        InputFile(
            path=shown(path),
            sha256=found.sha256,
            size_bytes=sizes[shown(path)],
            n_points=sum(found.points_by_tile.values()),
            bounds_m=_plan_bounds_m(found),
        )
        for path, found in zip(paths, ingested, strict=True)
    ]
    inputs.extend(told_file(name) for name in (request.footprints, request.aoi, request.overrides) if name is not None)
    return tuple(inputs)


def _digest_of(content: tuple[str, list[str] | None]) -> str:
    """The digest of a run directory, and of which tiles."""
    from pipeline.runtime.digest import run_digest  # with Arrow, which a driver does without

    run_dir, tiles = content
    return run_digest(run_dir, tiles=tiles)


def _plan_bounds_m(found: Ingested) -> tuple[float, float, float, float] | None:
    """Where the kept points of an input lie."""
    if found.bounds_mm is None:
        return None
    x0, y0, _, x1, y1, _ = found.bounds_mm
    return x0 / MM, y0 / MM, x1 / MM, y1 / MM


def told_file(name: str) -> InputFile:
    """A file beside the point clouds as the manifest tells it."""
    with on_this_machine(name) as path:
        return InputFile(path=_told_path(name), sha256=sha256_of(path), size_bytes=path.stat().st_size)


def _told_path(name: str) -> str:
    return shown(name) if is_url(name) else str(Path(name).resolve())


def told_request(request: RunRequest) -> dict[str, object]:
    """What of a request `run.json` keeps, so that single buildings of the run can be modelled again."""

    def whole(path: str | None) -> str | None:
        return None if path is None else _told_path(path)

    return {
        "footprints": whole(request.footprints),
        "overrides": whole(request.overrides),
        "crs": request.crs,
        "vertical_unit": request.vertical_unit,
        "bbox": None if request.bbox is None else list(request.bbox),
        "aoi": whole(request.aoi),
        "meshes": request.meshes,
        "work": whole(request.work),
    }


def put_json(run_dir: str | Path, name: str, content: object) -> None:
    """Write a document of a run directory, whole or not at all."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    storage_at(run_dir).put(name, text.encode())


@contextlib.contextmanager
def calling_off(scratch: Scratch, cancelled: Callable[[], bool]) -> Iterator[Callable[[], bool]]:
    """Watch for the end of a run from a thread of its own, so that a task in this very process learns of it, too.

    Yields
    ------
    callable
        Whether the run was called off; then its scratch is marked.
    """
    if cancelled is never:
        yield never
        return
    if cancelled():  # before it began: a short run could else be over before it is asked again
        scratch.cancel()
        yield lambda: True
        return
    over, off = threading.Event(), threading.Event()

    def ask() -> None:
        try:
            while not over.wait(TICK_S) and not cancelled():
                pass
        finally:
            # a run whose end nobody could tell any more ends, too
            if not over.is_set():
                off.set()
                scratch.cancel()

    asking = threading.Thread(target=ask, name="gablework-cancelled", daemon=True)
    asking.start()
    try:
        yield off.is_set
    finally:
        over.set()
        asking.join()


def plan_inputs(request: RunRequest, settings: RunSettings, progress: Progress) -> tuple[Plan, list[str]]:
    """The plan and the input files in order."""
    options = ReadOptions(
        crs=request.crs,
        vertical_unit=request.vertical_unit,
        bbox=request.bbox,
        class_table=settings.class_codes.table,
    )

    def cut(index: TileIndex) -> Sequence[str]:
        """The files of an index that the window may need: the others are neither opened nor fetched."""
        if request.bbox is None and request.aoi is None:
            return index.locations
        reference = open_source(index.locations[0], options).info.reference
        area = None if request.aoi is None else read_area(request.aoi, reference)
        if request.bbox is not None:
            box = shapely.box(*request.bbox)
            area = box if area is None else box & area
        return index.within(area, reference)

    paths = find_inputs(request.inputs, only_files=request.only_files, cut=cut)
    if request.aoi is not None:
        reference = open_source(paths[0], options).info.reference
        options = dataclasses.replace(options, aoi=read_area(request.aoi, reference))
    plan = make_plan(paths, options, settings)
    plan, paths = without_far_files(plan, paths)
    for warning in plan.warnings:
        progress.warn("plan", warning)
    if not any(info.has_returns for info in plan.sources):
        progress.warn("plan", "the inputs have one return a pulse: vegetation is told by its roughness alone")
    return plan, paths


@contextlib.contextmanager
def _scratch(work_dir: str, wanted: str | None) -> Iterator[Scratch]:
    """A scratch folder for the duration of a run."""
    folder = scratch_folder(work_dir, wanted)
    scratch = Scratch(str(folder / uuid4().hex))
    scratch.create()
    try:
        yield scratch
    finally:
        remove_folder(folder)


def _is_of_work(run_dir: str, work: str) -> bool:
    """Whether a run directory was written from this very work folder, so that what is there is known there."""
    try:
        told = read_manifest(run_dir).request.get("work")
    except RunError:
        return False
    return told == str(Path(work).resolve())


def _with_tables(run_dir: str, joined: Joined, models: Models, published: Sequence[Published]) -> list[str] | None:
    """The tiles that have tables in an object store, so that their digest needs no listing; None to list.

    A store may list what is there some time after it was put. Of tiles that failed nobody knows what was put, so that
    the store must be asked; where all of them failed it has no folder to list.
    """
    tiles = sorted(outcome.tile.key for outcome in published)
    failed = {outcome.tile.key for outcome in published if outcome.error}
    owners = {tile.key for tile in models.places} | {site.owner.key for site in joined.rejected} or set(tiles[:1])
    if not is_url(run_dir) or (failed and not owners <= failed):
        return None
    return sorted(owners - failed)


def _checked(out: str, *, overwrite: bool, work: str | None = None) -> str:
    """The run directory, which may be written: a path, or a URL.

    Raises
    ------
    RunError
        It holds something and `overwrite` is not asked for, or it cannot be written.
    """
    check_out(out, overwrite=overwrite, work=work)
    storage = storage_at(out)
    try:
        storage.make()
    except OSError as error:
        raise RunError(f"{storage.place} cannot be written: {error.strerror or error}. Give another --out") from error
    return storage.place


def check_out(out: str, *, overwrite: bool, work: str | None = None) -> None:
    """Say whether a run directory may be written, by what is there; nothing is made.

    Raises
    ------
    RunError
        It holds something and `overwrite` is not asked for, or it cannot be read.
    """
    storage = storage_at(out)
    run_dir = storage.place
    try:
        left = storage.names()
        if left and not overwrite and not (work is not None and _is_of_work(run_dir, work)):
            raise RunError(f"{run_dir} is not empty ({left[0]} …): give another --out, or --overwrite")
        if left and NAME not in left:
            raise RunError(f"{run_dir} holds {left[0]} and no run.json, so it is no run: give another --out")
    except OSError as error:
        raise RunError(f"{run_dir} cannot be read: {error.strerror or error}. Give another --out") from error


def _crs_facts(reference: SpatialReference) -> dict[str, object]:
    return {
        "epsg": reference.epsg,
        "name": reference.name,
        "wkt": reference.wkt,
        "horizontal_unit_m": reference.horizontal_unit_m,
        "vertical_unit_m": reference.vertical_unit_m,
    }
