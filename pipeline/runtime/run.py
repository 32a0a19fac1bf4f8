"""A run from inputs to a run directory: plan, ingest, ground, split, join, outline, reconstruct, publish."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import functools
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from pipeline.io import storage_at
from pipeline.registry import extra
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.monitoring.measurement import peak_of_process
from pipeline.runtime.monitoring.progress import Listener, Progress, ignore, never
from pipeline.runtime.request import RunRequest, plan_inputs
from pipeline.runtime.run_context import RunContext, run_context
from pipeline.runtime.run_directory import RunDirectory, about_emptiness, input_files, run_counts
from pipeline.runtime.run_plan import Plan
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.location import check_scratch, run_scratch
from pipeline.runtime.scratch.outcomes import Place
from pipeline.runtime.stages.cleanup import tidy
from pipeline.runtime.stages.content_digest import STAGE as DIGEST
from pipeline.runtime.stages.content_digest import content_digest
from pipeline.runtime.stages.ground_stage import Ground, find_ground
from pipeline.runtime.stages.ingested import Ingested
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.publish import Published, RunOutput, publish
from pipeline.runtime.stages.read_inputs import footprints_for, guides_for, overrides_for, read_inputs
from pipeline.runtime.stages.reconstruct import Models, models_stage, reconstruct
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits, split
from pipeline.settings import RunSettings
from pipeline.terrain.flight_passes import Strip
from pipeline.tiling import MM

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.overrides_file import Override
    from pipeline.extras.terrain_tin.terrain_output import TerrainOutcome
    from pipeline.runtime.expected import Expected


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
    begun = begin(request, {request.out: request.settings}, on_event, executor, cancelled)
    (directory,) = begun.directories
    with under_way(begun, executor, cancelled) as context:
        found = find_candidates(context, begun)
        models = reconstruct(context, directory.settings, found.joined, begun.guides)
        results = publish_models(context, begun, found, models, directory)
    summary = finish(begun, found, results, directory, time.perf_counter() - begun.began)
    begun.tell_end(summary)
    return summary


@dataclasses.dataclass(frozen=True, kw_only=True)
class Begun:
    """A run whose inputs were looked at."""

    request: RunRequest
    """What to reconstruct; the stages up to the candidates use its settings."""
    directories: tuple[RunDirectory, ...]
    """Where results go: one, or in a comparison one per way to model the candidates."""
    progress: Progress
    plan: Plan
    paths: Sequence[str]
    """The input files, in order."""
    footprints: GivenFootprints | None
    guides: GivenGuides | None
    overrides: Sequence[Override]
    began: float
    """When it began, by `time.perf_counter`."""

    def tell_end(self, summary: RunSummary) -> None:
        """Send the event of its end."""
        seconds = time.perf_counter() - self.began
        self.progress.tell("finished", "", f"{summary.counts['candidates']} candidates in {seconds:.1f} s")


def begin(
    request: RunRequest,
    outs: Mapping[str, RunSettings],
    on_event: Listener,
    executor: Executor | None,
    cancelled: Callable[[], bool],
) -> Begun:
    """Look at the inputs of a run, and at what else is given; `outs` are its run directories with their settings."""
    started_at, began = dt.datetime.now(tz=dt.UTC), time.perf_counter()
    resources = request.resources
    if request.work is None:
        check_scratch(request.out, resources.scratch, resources.scheduler)
    for out in outs:
        storage_at(out)  # refuses a URL of no storage before anything is read
    if resources.workers and resources.scheduler is None and executor is None:
        from pipeline.runtime.cluster.worker_fork_server import start_early

        start_early()
    progress = Progress(on_event)
    progress.tell("run", "plan", f"run into {request.out}")
    plan, paths = plan_inputs(request, progress, cancelled, executor)
    footprints = footprints_for(request, plan)
    for warning in () if footprints is None else footprints.warnings:
        progress.warn("plan", warning)
    guides = guides_for(request, plan, list(outs.values()))
    for warning in () if guides is None else guides.warnings:
        progress.warn("plan", warning)
    overrides = overrides_for(request, plan, request.settings)
    directories = [
        RunDirectory.of(request, out, settings, plan, progress, started_at) for out, settings in outs.items()
    ]
    progress.timings["plan"] = time.perf_counter() - began
    return Begun(
        request=request,
        directories=tuple(directories),
        progress=progress,
        plan=plan,
        paths=paths,
        footprints=footprints,
        guides=guides,
        overrides=overrides,
        began=began,
    )


@contextlib.contextmanager
def under_way(begun: Begun, executor: Executor | None, cancelled: Callable[[], bool]) -> Iterator[RunContext]:
    """The stages of a run, in the block: its directories are locked and say how it ended if it fails."""
    request, settings, footprints = begun.request, begun.request.settings, begun.footprints
    with contextlib.ExitStack() as locks:
        for one in begun.directories:
            one.lock(locks)
        context = locks.enter_context(
            run_context(
                begun.plan,
                begun.progress,
                request.resources,
                _scratch_of(request),
                functools.partial(_expected, begun.plan, None if footprints is None else len(footprints.polygons)),
                loads=loads_of("reconstruct", footprints=footprints is not None, method=settings.general.method),
                executor=executor,
                cancelled=cancelled,
            )
        )
        # all checks passed: only now are results of an earlier run removed
        for one in begun.directories:
            one.begin(footprints, begun.guides)
        try:
            with context.blaming_lost_scratch():
                yield context
        except BaseException as error:
            context.scratch.cancel()
            for one in begun.directories:
                one.fail(error)
            raise
        if request.resources.work is not None:
            stages = {models_stage(one.settings) for one in begun.directories}
            run_dirs = [one.run_dir for one in begun.directories]
            tidy(context.scratch, stages, run_dirs, overridden=request.overrides is not None)


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
class Candidates:
    """The candidates of a run, and what the stages before them found."""

    ingested: Sequence[Ingested]
    moves_mm: Mapping[Strip, int]
    ground: Ground
    splits: Splits
    joined: Joined


def find_candidates(context: RunContext, begun: Begun) -> Candidates:
    """Ingest, ground, split, join and outline; then the overrides."""
    settings, footprints = begun.request.settings, begun.footprints
    inputs = read_inputs(context, settings, begun.paths, footprints)
    ground = find_ground(context, settings, inputs.cells)
    splits = split(context, settings, inputs.ingested, ground, footprints)
    joined = join(context, settings.scene, settings.building.roof, splits, footprints)
    if headline := about_emptiness(inputs.ingested, ground, joined, trust=settings.general.classes == "trust"):
        context.progress.warn_first("join", headline)
    if begun.request.overrides is not None:
        joined, entries = extra("overridden")(context, settings, joined, begun.overrides, inputs.ingested, ground)
        for one in begun.directories:
            one.put_overrides(entries)
    return Candidates(ingested=inputs.ingested, moves_mm=inputs.moves_mm, ground=ground, splits=splits, joined=joined)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Results:
    """What was modelled, and written into one run directory."""

    models: Models
    published: Mapping[Place, Published]
    without_points: tuple[str, ...]
    """Keys of tiles whose points could not be written."""
    terrain: TerrainOutcome | None
    """The terrain; None where none was requested."""
    digest: str
    """sha256 of the content."""

    @property
    def failed_tiles(self) -> tuple[str, ...]:
        """Keys of the tiles that could not be published."""
        return tuple(outcome.tile.key for outcome in self.published.values() if outcome.error)


def publish_models(
    context: RunContext, begun: Begun, found: Candidates, models: Models, directory: RunDirectory
) -> Results:
    """Publish the models, and the points and the terrain that were asked for, into a run directory; with its digest."""
    request, settings, run_dir = begun.request, directory.settings, directory.run_dir
    output = RunOutput(run_dir=run_dir, meshes=request.meshes)
    published = publish(context, settings, found.splits, found.joined, models, output)
    without_points: tuple[str, ...] = ()
    if request.points:
        given = request.footprints is not None
        points = extra("PointsOutput")(run_dir=run_dir, splits=found.splits, ingested=found.ingested, given=given)
        without_points = extra("write_points")(context, settings, found.joined, models, points)
    terrain: TerrainOutcome | None = None
    if settings.general.terrain != "none":
        terrain = extra("write_terrain")(context, settings, found.ground, models, run_dir, request.meshes)
    started = time.perf_counter()
    digest = _digest(context, found.joined, models, published, run_dir)
    context.progress.timings[DIGEST] = time.perf_counter() - started
    directory.check_same()
    return Results(models=models, published=published, without_points=without_points, terrain=terrain, digest=digest)


def _digest(
    context: RunContext, joined: Joined, models: Models, published: Mapping[Place, Published], run_dir: str
) -> str:
    """The digest of all that was published."""
    if any(outcome.error for outcome in published.values()):
        from pipeline.runtime.stages.digest_of_rest import digest_of_rest

        return digest_of_rest(context, joined, models, list(published.values()), run_dir)
    places = [place for place, outcome in published.items() if outcome.has_tables]
    return content_digest(context.executor, context.scratch, places, context.progress.watch)


def finish(begun: Begun, found: Candidates, results: Results, directory: RunDirectory, total_s: float) -> RunSummary:
    """Write the manifest of a run directory; the run can no longer be cancelled."""
    progress, counted = directory.progress, results.models.counted
    progress.timings["total"] = total_s
    driver, peak_bytes = peak_of_process()
    progress.peaks[driver] = peak_bytes
    counts = run_counts(begun.plan, found.ingested, found.ground, found.splits, found.joined, counted)
    without_terrain: tuple[str, ...] = ()
    if results.terrain is not None:
        counts |= results.terrain.counts
        without_terrain = results.terrain.failed
    manifest = directory.finish(
        status=RunStatus.INCOMPLETE if results.failed_tiles else RunStatus.FINISHED,
        inputs=input_files(begun.request, begun.paths, found.ingested, begun.plan),
        tiles=tuple(outcome.tile.key for outcome in results.published.values()),
        failed_tiles=results.failed_tiles,
        tiles_without_points=results.without_points,
        tiles_without_terrain=without_terrain,
        counts=counts,
        slowest=counted.slowest,
        strip_moves_m={str(strip): move / MM for strip, move in sorted(found.moves_mm.items())},
        content_sha256=results.digest,
    )
    rejected = Counter(counted.rejected)
    for listed in found.joined.rejected:
        rejected.update(listed.figures.reasons)
    return RunSummary(
        run_dir=directory.run_dir,
        digest=results.digest,
        statuses=dict(counted.statuses),
        reasons=dict(counted.reasons),
        rejected=dict(rejected),
        roof_types=dict(counted.roof_types),
        counts=counts,
        timings_s=progress.timings,
        peak_memory_bytes=progress.peaks,
        warnings=manifest.warnings,
        headline=progress.headline,
        failed_tiles=manifest.failed_tiles,
        tiles_without_points=manifest.tiles_without_points,
        tiles_without_terrain=manifest.tiles_without_terrain,
    )
