"""A run from inputs to a run directory: plan, ingest, ground, split, join, outline, reconstruct, publish."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import functools
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline import __version__
from pipeline.errors import RunCancelledError, RunError
from pipeline.export.coordinates import one_unit
from pipeline.export.folders import POINTS_FOLDER, TERRAIN_FOLDER
from pipeline.io import SourceInfo, SpatialReference, Storage, is_url, shown, storage_at
from pipeline.methods import ReconstructSettings
from pipeline.registry import extra
from pipeline.runtime.cluster.serial_executor import Executor, run_alone
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.manifest import NAME, PAGE, InputFile, PointFileFacts, RunManifest, RunStatus, write_manifest
from pipeline.runtime.monitoring.events import Listener, ignore, never
from pipeline.runtime.monitoring.measurement import peak_of_process
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.plan import Plan
from pipeline.runtime.request import RunRequest, input_file, plan_inputs, request_record
from pipeline.runtime.run_context import RunContext, run_context
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import locked_results
from pipeline.runtime.scratch.location import check_scratch, run_scratch
from pipeline.runtime.scratch.outcomes import Place
from pipeline.runtime.stages.batch_figures import Counted
from pipeline.runtime.stages.cleanup import OVERRIDDEN, publishing, tidy
from pipeline.runtime.stages.content_digest import STAGE as DIGEST
from pipeline.runtime.stages.content_digest import content_digest
from pipeline.runtime.stages.counts import about_emptiness, run_counts
from pipeline.runtime.stages.given_files import footprints_for, guides_for, overrides_for
from pipeline.runtime.stages.ground import Ground, find_ground
from pipeline.runtime.stages.ingested import Ingested
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.publish import Published, RunOutput, publish
from pipeline.runtime.stages.read_inputs import read_inputs
from pipeline.runtime.stages.reconstruct import QUARANTINE, Models, models_stage, reconstruct
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits, split
from pipeline.runtime.stages.stored_sites import joined_of, store_sites
from pipeline.settings import RunSettings
from pipeline.terrain.flight_strip import Strip
from pipeline.tiling import MM

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.overrides_file import Override
    from pipeline.extras.terrain_tin.terrain_output import TerrainOutcome
    from pipeline.runtime.expected import Expected

FOOTPRINTS = "footprints.json"
"""File of the run directory with the faults of the given footprints, one by one."""
GUIDES = "guides.json"
"""The same of the given guides."""
OVERRIDES = "overrides.json"
"""File of the run directory with the outcome of each entry of the overrides."""

_RESULTS = ("buildings", "planes", "rejected", "decisions", "meshes", "cityjson", "state", QUARANTINE)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The outcome of a run."""

    run_dir: str
    """Where the results are: a path, or a URL."""
    digest: str
    """sha256 of the content."""
    statuses: dict[str, int]
    """Candidates by status."""
    reasons: dict[str, int]
    """Candidates that are not ok, by reason."""
    rejected: dict[str, int]
    """Objects that are not buildings, by reason."""
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
    headline: str = ""
    """The first warning, where it says why the result is empty; else empty."""
    failed_tiles: tuple[str, ...] = ()
    """Tiles that could not be published."""
    tiles_without_points: tuple[str, ...] = ()
    """Tiles whose points were requested and could not be written."""
    tiles_without_terrain: tuple[str, ...] = ()
    """Tiles whose terrain was requested and could not be written."""

    @property
    def is_complete(self) -> bool:
        """Whether every tile has all that was requested."""
        return not (self.failed_tiles or self.tiles_without_points or self.tiles_without_terrain)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunVariant:
    """One way to model the candidates of a run, and where its results go."""

    method: str
    """The method that models the buildings."""
    preset: str
    """Where the method's settings start."""
    building: ReconstructSettings
    """From a candidate to its model."""
    out: str
    """Its own run directory."""
    label: str = ""
    """Its name in messages; empty for a single variant."""

    def settings_in(self, settings: RunSettings) -> RunSettings:
        """The settings of a run with this method in the place of theirs."""
        general = dataclasses.replace(settings.general, method=self.method, preset=self.preset)
        return dataclasses.replace(settings, general=general, building=self.building)


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantOutcome:
    """The outcome of one variant."""

    summary: RunSummary
    """As for a run."""
    seconds: dict[str, float]
    """Wall-clock seconds of each building, by its id; empty for a single variant."""


def run(
    request: RunRequest,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> RunSummary:
    """Reconstruct all buildings of the inputs into a run directory.

    Parameters
    ----------
    on_event : callable
        Gets an `Event` for every stage, step and warning.
    executor : Executor, optional
        Runs the tasks; by default the one that the request calls for.
    cancelled : callable
        Asked several times a second, from another thread. Once it is true, the run ends as soon as it can.

    Raises
    ------
    InputError
        An input cannot be used.
    SettingsError
        Settings are out of range.
    RunError
        The run directory cannot be used, or workers died again and again on one task.
    FolderLostError
        Its scratch or its run directory was removed while it was going.
    RunCancelledError
        `cancelled` ended the run; its scratch is gone, and `run.json` says so.
    ClusterError
        The scheduler does not answer or was lost, or its processes run other versions; the run may be tried again.
    """
    settings = request.settings
    variant = RunVariant(
        method=settings.general.method, preset=settings.general.preset, building=settings.building, out=request.out
    )
    (outcome,) = run_variants(request, (variant,), on_event, executor, cancelled)
    return outcome.summary


def run_variants(
    request: RunRequest,
    variants: Sequence[RunVariant],
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
    outdated: Sequence[Path] = (),
) -> list[VariantOutcome]:
    """Model the same candidates in several ways: all up to the join runs once, the rest once per variant, in order.

    Raises the errors of `run`.

    Parameters
    ----------
    request : RunRequest
        The inputs and how to run. Scratch goes to its `out`; its method does not count.
    variants : sequence of RunVariant
        At least one.
    outdated : sequence of Path
        Files about an earlier run, removed together with its results.
    """
    started_at, began = dt.datetime.now(tz=dt.UTC), time.perf_counter()
    resources, settings, work = request.resources, variants[0].settings_in(request.settings), request.work
    if work is None:
        check_scratch(request.out, resources.scratch, resources.scheduler)
    for variant in variants:
        storage_at(variant.out)  # refuses a URL of no storage before anything is read
    if resources.workers and resources.scheduler is None and executor is None:
        from pipeline.runtime.cluster.worker_fork_server import start_early

        start_early()
    progress = Progress(on_event)
    progress.tell("run", "plan", f"run into {request.out}")
    plan, paths = plan_inputs(request, progress, cancelled, executor)
    footprints = footprints_for(request, plan)
    for warning in () if footprints is None else footprints.warnings:
        progress.warn("plan", warning)
    guides = guides_for(request, plan, [variant.settings_in(request.settings) for variant in variants])
    for warning in () if guides is None else guides.warnings:
        progress.warn("plan", warning)
    overrides = overrides_for(request, plan, settings)
    runs = [_VariantRun.of(variant, request, plan, progress, started_at) for variant in variants]
    progress.timings["plan"] = time.perf_counter() - began
    with contextlib.ExitStack() as locks:
        for one in runs:
            one.check_same = locks.enter_context(locked_results(one.run_dir))
            # the process that held it a moment ago may have left something
            check_out(one.run_dir, overwrite=request.overwrite, work=work)
        context = locks.enter_context(
            run_context(
                plan,
                progress,
                resources,
                _scratch_of(request),
                functools.partial(_expected, plan, None if footprints is None else len(footprints.polygons)),
                loads=loads_of("reconstruct", footprints=footprints is not None, method=settings.general.method),
                executor=executor,
                cancelled=cancelled,
            )
        )
        # all checks passed: only now are results of an earlier run removed
        for one in runs:
            one.begin(footprints, guides, work, points=request.points, terrain=settings.general.terrain != "none")
        for path in outdated:
            path.unlink(missing_ok=True)
        try:
            with context.blaming_lost_scratch():
                found = _find_candidates(context, settings, paths, footprints)
                if request.overrides is not None:
                    found = _override(context, settings, found, overrides, runs)
                _model(context, request, found, guides, runs)
                for one in runs:
                    one.find_digest(context, found.joined)
        except BaseException as error:
            context.scratch.cancel()
            for one in runs:
                one.fail(error)
            raise
        if resources.work is not None:
            stages = {models_stage(variant.settings_in(request.settings)) for variant in variants}
            run_dirs = [one.run_dir for one in runs]
            tidy(context.scratch, stages, run_dirs, overridden=request.overrides is not None)
    inputs = _input_files(request, paths, found.ingested, plan)
    # a single run took all the time; of several, each took that of the shared stages and its own
    outcomes = [one.finish(context, found, inputs, began if len(runs) == 1 else None) for one in runs]
    seconds = time.perf_counter() - began
    progress.tell("finished", "", f"{outcomes[0].summary.counts['candidates']} candidates in {seconds:.1f} s")
    return outcomes


def _scratch_of(request: RunRequest) -> AbstractContextManager[Scratch]:
    """The scratch of a run: its work folder, if it has one."""
    if request.work is None:
        return run_scratch(request.out, request.resources.scratch)
    from pipeline.runtime.scratch.work_folder import locked_work

    return locked_work(request.work)


def _expected(plan: Plan, footprints: int | None) -> Expected:
    """The cost of the run, with so many footprints."""
    from pipeline.runtime.expected import expected

    return expected(plan, footprints)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Candidates:
    """What the stages that all variants share found."""

    ingested: Sequence[Ingested]
    moves_mm: Mapping[Strip, int]
    ground: Ground
    splits: Splits
    joined: Joined


def _find_candidates(
    context: RunContext, settings: RunSettings, paths: Sequence[str], footprints: GivenFootprints | None
) -> _Candidates:
    """The stages up to the candidates."""
    inputs = read_inputs(context, settings, paths, footprints)
    ground = find_ground(context, settings, inputs.cells)
    splits = split(context, settings, inputs.ingested, ground, footprints)
    joined = join(context, settings.scene, settings.building.roof, splits, footprints)
    if headline := about_emptiness(inputs.ingested, ground, joined, trust=settings.general.classes == "trust"):
        context.progress.warn_first("join", headline)
    return _Candidates(ingested=inputs.ingested, moves_mm=inputs.moves_mm, ground=ground, splits=splits, joined=joined)


def _override(
    context: RunContext,
    settings: RunSettings,
    found: _Candidates,
    overrides: Sequence[Override],
    runs: Sequence[_VariantRun],
) -> _Candidates:
    """The candidates after the overrides; the outcome of each entry goes into the run directories."""
    context.check(listed.place.folder for listed in (*found.joined.groups, *found.joined.rejected))
    applied = extra("apply_overrides")(context, settings, found.joined, overrides, found.ingested, found.ground)
    for entry in applied.outcomes:
        if entry.warning:
            context.progress.warn("join", entry.warning)
    if headline := extra("about_no_effect")(applied.outcomes):
        context.progress.warn_first("join", headline)
    for one in runs:
        put_json(one.run_dir, OVERRIDES, [entry.as_dict() for entry in applied.outcomes])
    changed = joined_of(store_sites(context, OVERRIDDEN, applied.sites), 0, {})
    joined = found.joined.in_place_of(applied.owners, changed)
    return dataclasses.replace(found, joined=joined)


def _model(
    context: RunContext,
    request: RunRequest,
    found: _Candidates,
    guides: GivenGuides | None,
    runs: Sequence[_VariantRun],
) -> None:
    """The stages of each variant: models, then publishing."""
    several = len(runs) > 1
    for number, one in enumerate(runs):
        one.progress = context.progress.part(number, len(runs), one.variant.label)
    own = [
        (one, dataclasses.replace(context, progress=one.progress), one.variant.settings_in(request.settings))
        for one in runs
    ]
    for one, part, settings in own:
        one.models = reconstruct(part, settings, found.joined, guides, compared=several)
    for one, part, settings in own:
        output = RunOutput(run_dir=one.run_dir, meshes=request.meshes)
        one.published = publish(part, settings, found.splits, found.joined, one.models, output)
        if request.points:
            one.without_points = _write_points(part, settings, found, one, given=request.footprints is not None)
        if settings.general.terrain != "none":
            one.terrain = _write_terrain(part, settings, found, one, meshes=request.meshes)


def _write_points(
    context: RunContext, settings: RunSettings, found: _Candidates, one: _VariantRun, *, given: bool
) -> tuple[str, ...]:
    """Write the points of a variant over its models; the keys of tiles that failed."""
    output = extra("PointsOutput")(run_dir=one.run_dir, splits=found.splits, ingested=found.ingested, given=given)
    failed: tuple[str, ...] = extra("write_points")(context, settings, found.joined, one.models, output)
    return failed


def _write_terrain(
    context: RunContext, settings: RunSettings, found: _Candidates, one: _VariantRun, *, meshes: str
) -> TerrainOutcome:
    """Write the terrain around the models of a variant."""
    outcome: TerrainOutcome = extra("write_terrain")(context, settings, found.ground, one.models, one.run_dir, meshes)
    return outcome


@dataclasses.dataclass(kw_only=True)
class _VariantRun:
    """One variant while it runs: its run directory, its manifest, and what its own stages found."""

    variant: RunVariant
    run_dir: str
    manifest: RunManifest
    progress: Progress
    keeps_work: bool
    """Whether the work folder outlives the run; one in which an interrupted run resumes does not."""
    check_same: Callable[[], None] = dataclasses.field(init=False)
    """Raises FolderLostError if the run directory was removed since it was locked."""
    models: Models = dataclasses.field(init=False)
    published: Mapping[Place, Published] = dataclasses.field(init=False)
    without_points: tuple[str, ...] = ()
    """Keys of tiles whose points could not be written."""
    terrain: TerrainOutcome | None = None
    """The terrain; None where none was requested."""
    digest: str = ""
    """sha256 of the content."""

    @classmethod
    def of(
        cls, variant: RunVariant, request: RunRequest, plan: Plan, progress: Progress, started_at: dt.datetime
    ) -> _VariantRun:
        """A variant that is about to run; its run directory exists and may be written."""
        settings = variant.settings_in(request.settings)
        return cls(
            variant=variant,
            run_dir=_checked(variant.out, overwrite=request.overwrite, work=request.work),
            manifest=RunManifest(
                status=RunStatus.RUNNING,
                engine_version=__version__,
                method=variant.method,
                settings=settings.as_dict(),
                settings_hash=settings.settings_hash,
                started_at=started_at,
                crs=_crs_facts(plan.reference),
                request=request_record(request),
                lattice={
                    "tile_size_m": plan.grid.size_mm / MM,
                    "origin_x_m": plan.grid.origin_x_mm / MM,
                    "origin_y_m": plan.grid.origin_y_mm / MM,
                },
                source_licence=request.licence,
            ),
            progress=progress,
            keeps_work=request.resources.work is not None,
        )

    @property
    def counted(self) -> Counted:
        """The counts of its models."""
        return self.models.counted

    @property
    def storage(self) -> Storage:
        """The run directory's storage."""
        return storage_at(self.run_dir)

    def begin(
        self,
        footprints: GivenFootprints | None,
        guides: GivenGuides | None,
        work: str | None,
        *,
        points: bool,
        terrain: bool,
    ) -> None:
        """Remove an earlier run, except what the work folder knows; readers see that the directory changes."""
        known = work is not None and _is_of_work(self.run_dir, work)
        write_manifest(self.run_dir, self.manifest, self.storage.put)
        outdated = [FOOTPRINTS, GUIDES, OVERRIDES, PAGE]
        if not (known and points):
            outdated.append(POINTS_FOLDER)
        if not (known and terrain):
            outdated.append(TERRAIN_FOLDER)
        self.storage.clear(outdated if known else [*outdated, *_RESULTS])
        if footprints is not None:
            put_json(self.run_dir, FOOTPRINTS, footprints.report)
        if guides is not None:
            put_json(self.run_dir, GUIDES, guides.report)

    def fail(self, error: BaseException) -> None:
        """Write how the run ended."""
        cancelled = isinstance(error, RunCancelledError | KeyboardInterrupt)
        message = f"{type(error).__name__}: {error}".removesuffix(": ")
        ended = dataclasses.replace(
            self.manifest,
            status=RunStatus.CANCELLED if cancelled else RunStatus.FAILED,
            warnings=(*self.progress.warnings, message),
        )
        write_manifest(self.run_dir, ended, self.storage.put)

    @property
    def failed_tiles(self) -> tuple[str, ...]:
        """Keys of the tiles that could not be published."""
        return tuple(outcome.tile.key for outcome in self.published.values() if outcome.error)

    def find_digest(self, context: RunContext, joined: Joined) -> None:
        """The digest of all that was published; raises FolderLostError if it was removed meanwhile."""
        began, watch = time.perf_counter(), self.progress.watch
        if self.failed_tiles:
            content = (self.run_dir, _with_tables(self.run_dir, joined, self.models, list(self.published.values())))
            self.digest = run_alone(context.executor, DIGEST, _digest_of, content, watch)
        else:
            places = [place for place, outcome in self.published.items() if outcome.has_tables]
            self.digest = content_digest(context.executor, context.scratch, places, watch)
        self.progress.timings[DIGEST] = time.perf_counter() - began
        self.check_same()

    def finish(
        self, context: RunContext, found: _Candidates, inputs: tuple[InputFile, ...], began: float | None
    ) -> VariantOutcome:
        """Write the manifest; the run can no longer be cancelled."""
        outcomes = list(self.published.values())
        timings = self.progress.timings
        timings["total"] = sum(timings.values()) if began is None else time.perf_counter() - began
        driver, peak_bytes = peak_of_process()
        self.progress.peaks[driver] = peak_bytes
        failed_tiles = self.failed_tiles
        counts = run_counts(context.plan, found.ingested, found.ground, found.splits, found.joined, self.counted)
        without_terrain: tuple[str, ...] = ()
        if self.terrain is not None:
            counts |= self.terrain.counts
            without_terrain = self.terrain.failed
        manifest = dataclasses.replace(
            self.manifest,
            status=RunStatus.INCOMPLETE if failed_tiles else RunStatus.FINISHED,
            request=self.manifest.request if self.keeps_work else {**self.manifest.request, "work": None},
            finished_at=dt.datetime.now(tz=dt.UTC),
            inputs=inputs,
            tiles=tuple(outcome.tile.key for outcome in outcomes),
            failed_tiles=failed_tiles,
            tiles_without_points=self.without_points,
            tiles_without_terrain=without_terrain,
            counts=counts,
            timings_s={name: round(seconds, 3) for name, seconds in timings.items()},
            peak_memory_bytes=self.progress.peaks,
            slowest=self.counted.slowest,
            strip_moves_m={str(strip): move / MM for strip, move in sorted(found.moves_mm.items())},
            warnings=tuple(self.progress.warnings),
            headline=self.progress.headline,
            content_sha256=self.digest,
        )
        write_manifest(self.run_dir, manifest, self.storage.put)
        rejected = Counter(self.counted.rejected)
        for listed in found.joined.rejected:
            rejected.update(listed.figures.reasons)
        summary = RunSummary(
            run_dir=self.run_dir,
            digest=self.digest,
            statuses=dict(self.counted.statuses),
            reasons=dict(self.counted.reasons),
            rejected=dict(rejected),
            roof_types=dict(self.counted.roof_types),
            counts=counts,
            timings_s=timings,
            peak_memory_bytes=self.progress.peaks,
            warnings=manifest.warnings,
            headline=self.progress.headline,
            failed_tiles=failed_tiles,
            tiles_without_points=self.without_points,
            tiles_without_terrain=without_terrain,
        )
        return VariantOutcome(summary=summary, seconds=self.counted.seconds)


def _input_files(
    request: RunRequest, paths: Sequence[str], ingested: Sequence[Ingested], plan: Plan
) -> tuple[InputFile, ...]:
    """The inputs for the manifest."""
    sources = {info.path: info for info in plan.sources}
    inputs = [
        InputFile(
            path=shown(path),
            sha256=found.sha256,
            size_bytes=sources[shown(path)].file_size,
            n_points=sum(found.points_by_tile.values()),
            bounds_m=_plan_bounds_m(found),
            file=_file_facts(sources[shown(path)]),
        )
        for path, found in zip(paths, ingested, strict=True)
    ]
    others = (request.footprints, request.guides, request.aoi, request.overrides)
    inputs.extend(input_file(name) for name in others if name is not None)
    return tuple(inputs)


@functools.lru_cache(maxsize=64)
def _as_mapping(dimensions: tuple[tuple[str, str], ...]) -> Mapping[str, str]:
    """Dimensions by name; one object for all files that have the same."""
    return dict(dimensions)


def _file_facts(info: SourceInfo) -> PointFileFacts:
    """An input as a whole, for the manifest."""
    x0, y0, _, x1, y1, _ = info.bounds_m
    return PointFileFacts(
        format=info.format,
        n_points=info.point_count,
        bounds_m=(x0, y0, x1, y1),
        acquired=(info.acquired_from, info.acquired_to) if info.acquired_from and info.acquired_to else None,
        dimensions=_as_mapping(info.facts.dimensions),
    )


def _digest_of(content: tuple[str, list[str] | None]) -> str:
    """The digest of a run directory, given its tiles with tables."""
    from pipeline.runtime.digest import run_digest  # loads Arrow, which the driver does not need

    run_dir, tiles = content
    return run_digest(run_dir, tiles=tiles)


def _plan_bounds_m(found: Ingested) -> tuple[float, float, float, float] | None:
    """Bounds of an input's kept points."""
    if found.bounds_mm is None:
        return None
    x0, y0, _, x1, y1, _ = found.bounds_mm
    return x0 / MM, y0 / MM, x1 / MM, y1 / MM


def put_json(run_dir: str | Path, name: str, content: object) -> None:
    """Write a document of a run directory, whole or not at all."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    storage_at(run_dir).put(name, text.encode())


def _is_of_work(run_dir: str, work: str) -> bool:
    """Whether a run directory was written from this work folder, which then knows what is there."""
    from pipeline.runtime.manifest_reading import read_manifest

    try:
        known = read_manifest(run_dir).request.get("work")
    except RunError:
        from pipeline.runtime.scratch.work_folder import is_known

        # missing or damaged
        return is_known(work, publishing(run_dir))
    return known == str(Path(work).resolve())


def _with_tables(run_dir: str, joined: Joined, models: Models, published: Sequence[Published]) -> list[str] | None:
    """The tiles that have tables in an object store, so that their digest needs no listing; None to list them.

    A store may list an object only some time after it was put. Which tables a failed tile has is unknown, so then the
    store must list them; where all tiles failed it has no folder to list.
    """
    tiles = sorted(outcome.tile.key for outcome in published)
    failed = {outcome.tile.key for outcome in published if outcome.error}
    owners = {tile.key for tile in models.places} | {listed.figures.owner.key for listed in joined.rejected} or set(
        tiles[:1]
    )
    if not is_url(run_dir) or (failed and not owners <= failed):
        return None
    return sorted(owners - failed)


def _checked(out: str, *, overwrite: bool, work: str | None = None) -> str:
    """The run directory, a path or URL, made and checked."""
    check_out(out, overwrite=overwrite, work=work)
    storage = storage_at(out)
    try:
        storage.make()
    except OSError as error:
        raise RunError(f"{storage.place} cannot be written: {error.strerror or error}. Give another --out") from error
    return storage.place


def check_out(out: str, *, overwrite: bool, work: str | None = None) -> None:
    """Refuse a run directory that must not be written, by its content; makes nothing.

    Raises RunError if it is not empty and `overwrite` is not set, or it cannot be read.
    """
    storage = storage_at(out)
    run_dir = storage.place
    try:
        # a run that was interrupted before it wrote anything left only its work
        left = [name for name in storage.names() if work is None or Path(run_dir, name) != Path(work)]
        of_work = work is not None and _is_of_work(run_dir, work)
        if left and not overwrite and not of_work:
            raise RunError(f"{run_dir} is not empty ({left[0]} …): give another --out, or --overwrite")
        if left and NAME not in left and not of_work:
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
        "vertical_unit_assumed": reference.vertical_unit_assumed,
        "cityjson_vertical_unit_m": one_unit(reference).vertical_unit_m,
    }
