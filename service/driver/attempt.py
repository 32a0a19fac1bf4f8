"""One attempt at one job: a fresh folder, the inputs, the run, the outputs."""

from __future__ import annotations

import dataclasses
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from pipeline import __version__
from pipeline.errors import GableworkError, RunCancelledError
from pipeline.runtime.classify import ClassifyRequest, ClassifySummary, classify
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.compare import CompareRequest, CompareSummary, own_tables, parse_variants
from pipeline.runtime.monitoring import tracing
from pipeline.runtime.monitoring.events import Event, Listener
from pipeline.runtime.request import RunRequest
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings
from service.driver.failures import failure_of, has_no_space
from service.driver.leased_job import LOG, LeasedJob
from service.driver.messages import (
    classification_digest,
    classification_outcome,
    comparison_digest,
    comparison_outcome,
    digest_of,
    outcome,
)
from service.driver.shared_cluster import SharedCluster
from service.driver.so_far import shown_while_watched
from service.errors import RequestError
from service.fetching import Fetched, JobFiles, gather
from service.files import StateFolder
from service.jobs import JobRequest
from service.outputs import write_classification_outputs, write_comparison_outputs, write_echo, write_outputs
from service.outputs.kinds import RASTERS
from service.outputs.published import publish
from service.settings import ServiceSettings
from service.store import JobStore

_NAMED = 10
"""Inputs that the log of a job names."""


class Run(Protocol):
    """`pipeline.runtime.run.run`."""

    def __call__(
        self, request: RunRequest, on_event: Listener, executor: Executor | None, cancelled: Callable[[], bool]
    ) -> RunSummary:
        """Reconstruct all buildings."""


class Compare(Protocol):
    """`compare` of this module."""

    def __call__(
        self, request: CompareRequest, on_event: Listener, executor: Executor | None, cancelled: Callable[[], bool]
    ) -> CompareSummary:
        """Run several methods on the same candidates and write the comparison."""


class Classify(Protocol):
    """`pipeline.runtime.classify.classify`."""

    def __call__(
        self, request: ClassifyRequest, on_event: Listener, executor: Executor | None, cancelled: Callable[[], bool]
    ) -> ClassifySummary:
        """Classify all points."""


class Gather(Protocol):
    """`service.fetching.gather`."""

    def __call__(
        self,
        request: JobRequest,
        *,
        store: JobStore,
        folder: StateFolder,
        settings: ServiceSettings,
        target: Path,
        cancelled: Callable[[], bool],
    ) -> JobFiles:
        """Fetch all inputs to this machine's disk."""


class WriteOutputs(Protocol):
    """`service.outputs.write_outputs`."""

    def __call__(
        self, run_dir: Path, out_dir: Path, wanted: Sequence[str] | None, on_progress: Callable[[int, int], None]
    ) -> None:
        """Assemble the outputs."""


class Publish(Protocol):
    """`service.outputs.published.publish`."""

    def __call__(
        self,
        run_dir: Path,
        out_dir: Path,
        formats: Sequence[str],
        *,
        name: str,
        geoid_height_m: float | None,
        on_progress: Callable[[int, int], None],
    ) -> Mapping[str, Exception]:
        """Write further formats; returns why some could not be made."""


class WriteComparison(Protocol):
    """`service.outputs.write_comparison_outputs`."""

    def __call__(
        self,
        folder: Path,
        labels: Sequence[str],
        out_dir: Path,
        wanted: Sequence[str] | None,
        on_progress: Callable[[int, int], None],
    ) -> None:
        """Assemble the outputs of a comparison."""


def compare(
    request: CompareRequest, on_event: Listener, executor: Executor | None, cancelled: Callable[[], bool]
) -> CompareSummary:
    """`report.compare_files.compare_files` without a reference; imported late: it loads matplotlib."""
    from pipeline.ruler.report.compare_files import compare_files

    return compare_files(request, on_event=on_event, executor=executor, cancelled=cancelled).summary


class WriteClassification(Protocol):
    """`service.outputs.write_classification_outputs`."""

    def __call__(
        self,
        summary: ClassifySummary,
        out_dir: Path,
        wanted: Sequence[str] | None,
        on_progress: Callable[[int, int], None],
        scrub: Callable[[str], str],
    ) -> None:
        """Assemble the outputs of a classification."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tools:
    """The steps of an attempt; tests replace them."""

    gather: Gather = gather
    run: Run = run
    compare: Compare = compare
    classify: Classify = classify
    publish: Publish = publish
    write_outputs: WriteOutputs = write_outputs
    write_comparison: WriteComparison = write_comparison_outputs
    write_classification: WriteClassification = write_classification_outputs


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriverParts:
    """The parts of a driver that its attempts use."""

    settings: ServiceSettings
    folder: StateFolder
    store: JobStore
    cluster: SharedCluster
    tools: Tools = Tools()


def perform(held: LeasedJob, shop: DriverParts) -> tuple[str, dict[str, Any]]:
    """Do all the work of a job.

    Parameters
    ----------
    held : LeasedJob
        The job; records the progress, and may be cancelled.
    shop : DriverParts
        Store, folder, cluster.

    Returns
    -------
    tuple of str and dict
        The result in one sentence, and the summary to store. The files are in the attempt's folder.

    Raises
    ------
    RunCancelledError
        The job was cancelled.
    Exception
        Any other error; `failures` describes it.
    """
    job, folder = held.job, shop.folder
    begin = WORK.get(job.request.process_id)
    if begin is None:
        raise RequestError([f"this driver does not run the process {job.request.process_id}, only {', '.join(WORK)}"])
    attempt = folder.attempt(job.job_id, job.attempt)
    # the number of an attempt is unique; files there are from before a backup of the database was restored
    shutil.rmtree(attempt, ignore_errors=True)
    attempt.mkdir(parents=True)
    scrub = held.scrub
    # the scrubber would not recognise a folder with blanks in its name as one path
    scrub.name(f"{folder.root}/", "/state/")
    held.record(Event(kind="stage", stage="inputs"))
    target = folder.inputs(job.job_id, job.attempt)
    with tracing.span("stage inputs", stage="inputs"):
        files = shop.tools.gather(
            job.request,
            store=shop.store,
            folder=folder,
            settings=shop.settings,
            target=target,
            cancelled=held.cancelled,
        )
    for fetched in files.all:
        scrub.name(str(fetched.path), fetched.path.name)
    _note_inputs(held, files.tiles)
    work = begin(held, shop, files)
    shop.cluster.wait_until_there(held)
    held.record(Event(kind="stage", stage="plan"))
    held.engine = shop.cluster.engine()
    # jobs are interactive: they go before batch runs on the same scheduler
    done = work(held.engine.executor(job.priority))
    _check(held)
    shutil.rmtree(target, ignore_errors=True)
    return done


def _note_inputs(held: LeasedJob, tiles: Sequence[Fetched]) -> None:
    """Say in the job's log which program runs on what."""
    if tiles:
        names = ", ".join(tile.path.name for tile in tiles[:_NAMED])
        more = f" and {len(tiles) - _NAMED} more" if len(tiles) > _NAMED else ""
        inputs = f"{names}{more}, {sum(tile.points or 0 for tile in tiles)} points"
        held.note(f"gablework {__version__} on {inputs}", stage="inputs")


_Work = Callable[[Executor], tuple[str, dict[str, Any]]]
"""The work that needs the workers; returns the result in one sentence, and the summary."""


def _reconstruct(held: LeasedJob, shop: DriverParts, files: JobFiles) -> _Work:
    """The process `reconstruct`."""
    job, folder = held.job, shop.folder
    run_dir, out_dir = folder.run(job.job_id, job.attempt), folder.outputs(job.job_id, job.attempt)
    request = run_request(job.request, files, run_dir, shop.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        with shown_while_watched(held, run_dir, folder.so_far(job.job_id, job.attempt)):
            summary = shop.tools.run(request, held.record, executor, held.cancelled)
        problems = _published(held, shop, run_dir, out_dir)
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            shop.tools.write_outputs(Path(request.out), out_dir, job.request.outputs, begin)
        found = digest_of(summary, held.scrub, __version__) | ({"unpublished": problems} if problems else {})
        return outcome(summary, problems), found

    return work


def _published(held: LeasedJob, shop: DriverParts, run_dir: Path, out_dir: Path) -> dict[str, str]:
    """Write the further formats of a job, if it wants any; why some could not be made, for clients."""
    request = held.job.request
    if not request.publish:
        return {}
    on_progress = _begun(held, "formats")
    held.scrub.name(str(run_dir), "this job")
    with tracing.span("stage formats", stage="formats"):
        found = shop.tools.publish(
            run_dir,
            out_dir,
            request.publish,
            name=held.job.job_id,
            geoid_height_m=request.geoid_height,
            on_progress=on_progress,
        )
    problems = {}
    for form, error in found.items():
        if has_no_space(error):
            raise error
        problems[form] = held.scrub(str(error))
        if not isinstance(error, GableworkError):
            reference = secrets.token_hex(4)
            facts = {**held.facts, "reference": reference}
            LOG.error("%s could not be published: %s", form, error, extra=facts, exc_info=error)
            problems[form] = failure_of(error, scrub=held.scrub, reference=reference, attempts=1).detail
        held.record(Event(kind="warning", stage="formats", message=f"{form} could not be published: {problems[form]}"))
    return problems


def _compare(held: LeasedJob, shop: DriverParts, files: JobFiles) -> _Work:
    """The process `compare`."""
    job, folder = held.job, shop.folder
    place, out_dir = folder.comparison(job.job_id, job.attempt), folder.outputs(job.job_id, job.attempt)
    request = compare_request(job.request, files, place, shop.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = shop.tools.compare(request, held.record, executor, held.cancelled)
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            shop.tools.write_comparison(place, list(summary.runs), out_dir, job.request.outputs, begin)
        return comparison_outcome(summary), comparison_digest(summary, held.scrub, __version__)

    return work


def _classify(held: LeasedJob, shop: DriverParts, files: JobFiles) -> _Work:
    """The process `classify`."""
    job, folder = held.job, shop.folder
    place, out_dir = folder.run(job.job_id, job.attempt), folder.outputs(job.job_id, job.attempt)
    request = classify_request(job.request, files, place, shop.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = shop.tools.classify(request, held.record, executor, held.cancelled)
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            shop.tools.write_classification(summary, out_dir, job.request.outputs, begin, held.scrub)
        return classification_outcome(summary), classification_digest(summary, held.scrub, __version__)

    return work


def _echo(held: LeasedJob, shop: DriverParts, files: JobFiles) -> _Work:
    """The process `echo`."""
    del files
    job = held.job
    asked = job.request.echo or {}

    def work(_executor: Executor) -> tuple[str, dict[str, Any]]:
        held.wait(asked["delay"])
        _begun(held, "outputs")
        write_echo(asked["message"], shop.folder.outputs(job.job_id, job.attempt))
        return "echoed", {"engine_version": __version__}

    return work


WORK: Mapping[str, Callable[[LeasedJob, DriverParts, JobFiles], _Work]] = MappingProxyType(
    {"reconstruct": _reconstruct, "compare": _compare, "classify": _classify, "echo": _echo}
)
"""The work of each process: checks the request with the fetched inputs, and returns the rest of the work."""


def _begun(held: LeasedJob, stage: str) -> Callable[[int, int], None]:
    """Record that a stage of the driver's own begins; returns a function that records the progress."""
    _check(held)
    held.record(Event(kind="stage", stage=stage))

    def written(done: int, total: int) -> None:
        _check(held)
        held.record(Event(kind="progress", stage=stage, done=done, total=total))

    return written


def run_request(request: JobRequest, files: JobFiles, out: Path, settings: ServiceSettings) -> RunRequest:
    """The request of a run, with the fetched inputs.

    Raises
    ------
    SettingsError
        Settings are out of range.
    """
    return RunRequest(
        inputs=tuple(str(tile.path) for tile in files.tiles),
        only_files=True,  # a client's tile may be a tile index in disguise, which must not be followed
        out=str(out),
        settings=RunSettings.from_mapping(request.settings),
        footprints=None if files.footprints is None else str(files.footprints.path),
        guides=None if files.guides is None else str(files.guides.path),
        crs=request.crs,
        vertical_unit=request.vertical_unit,
        allow_outside_area_of_use=request.allow_outside_area_of_use,
        bbox=request.bbox,
        resources=settings.resources,
        meshes=request.meshes,
        points=request.points,
        licence=request.licence,
    )


def compare_request(request: JobRequest, files: JobFiles, out: Path, settings: ServiceSettings) -> CompareRequest:
    """The request of a comparison, with the fetched inputs.

    Raises
    ------
    SettingsError
        Settings are out of range, or a method is not known.
    """
    return CompareRequest(
        run=run_request(request, files, out, settings),
        variants=parse_variants(request.methods),
        tables=own_tables(request.settings),
    )


def classify_request(request: JobRequest, files: JobFiles, out: Path, settings: ServiceSettings) -> ClassifyRequest:
    """The request of a classification, with the fetched inputs.

    Raises
    ------
    SettingsError
        Settings are out of range.
    """
    has_rasters = request.outputs is None or not set(RASTERS).isdisjoint(request.outputs)
    return ClassifyRequest(
        inputs=tuple(str(tile.path) for tile in files.tiles),
        only_files=True,
        out=str(out),
        settings=RunSettings.from_mapping(request.settings),
        footprints=None if files.footprints is None else str(files.footprints.path),
        crs=request.crs,
        vertical_unit=request.vertical_unit,
        allow_outside_area_of_use=request.allow_outside_area_of_use,
        rasters=has_rasters,
        raster_cell=request.raster_cell if has_rasters else None,
        resources=settings.resources,
    )


def _check(held: LeasedJob) -> None:
    if held.cancelled():
        raise RunCancelledError("the job was cancelled")
