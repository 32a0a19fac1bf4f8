"""One attempt at one job: a fresh folder, the inputs, the run, the outputs."""

from __future__ import annotations

import contextlib
import dataclasses
import pickle
import secrets
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

from pipeline import __version__
from pipeline.errors import GableworkError, RunCancelledError
from pipeline.extras.classify.classify import ClassifyRequest, classify
from pipeline.extras.compare.compare import CompareRequest, CompareSummary, own_tables, parse_variants
from pipeline.options import InputOptions, ModelOptions, values_of
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring import tracing
from pipeline.runtime.monitoring.progress import Event, Listener
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import run
from pipeline.runtime.scratch.location import SCRATCH
from pipeline.settings import RunSettings
from service.disk import has_no_space
from service.driver.failure_words import (
    Scrubber,
    classification_digest,
    classification_outcome,
    comparison_digest,
    comparison_outcome,
    digest_of,
    outcome,
)
from service.driver.failures import failure_of
from service.driver.gathered import gathered_before, note_gathered
from service.driver.leased_job import LOG
from service.driver.workplace import INPUTS
from service.errors import RequestError
from service.fetching import Fetched, JobFiles, UploadTable, gather
from service.files import StateFolder
from service.jobs import Job, JobRequest, LogLevel
from service.outputs import write_classification_outputs, write_comparison_outputs, write_echo, write_outputs
from service.outputs.kinds import RASTERS
from service.outputs.published_forms import publish
from service.settings import ServiceSettings

Done = TypeVar("Done")

_MOMENT_S = 1.0
_NAMED = 10
"""Inputs that the log of a job names."""


def compare(
    request: CompareRequest, on_event: Listener, executor: Executor | None, cancelled: Callable[[], bool]
) -> CompareSummary:
    """`report.comparison.compare_files` without a reference; imported late: it loads matplotlib."""
    from pipeline.ruler.report.comparison import compare_files

    return compare_files(request, on_event=on_event, executor=executor, cancelled=cancelled).summary


class Held(Protocol):
    """The job, for the work on it: `ChildJob` in the process of an attempt, `LeasedJob` in the tests of this module."""

    job: Job
    scrub: Scrubber

    @property
    def facts(self) -> dict[str, object]:
        """Additional fields of a log line."""

    def cancelled(self) -> bool:
        """Whether the attempt must end."""

    def wait(self, seconds: float) -> bool:
        """Wait, at most until the attempt must end; returns whether it must."""

    def record(self, event: Event) -> None:
        """Take an event of the run."""

    def move(self) -> None:
        """Note that the attempt got somewhere."""

    def note(self, message: str, *, level: LogLevel = LogLevel.INFO, **facts: Any) -> None:
        """Add a line to the job's log."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AttemptParts:
    """What the work on a job needs beside the job; its steps are functions of this module, which tests replace."""

    settings: ServiceSettings
    folder: StateFolder
    place: Path
    """The folder in which the attempt works."""
    uploads: UploadTable
    """Knows the uploads of the job."""
    executor: Callable[[], Executor]
    """An executor for the run of the job, as soon as there are workers."""

    @property
    def inputs(self) -> Path:
        """The fetched inputs."""
        return self.place / INPUTS

    @property
    def run(self) -> Path:
        """The run directory."""
        return self.place / "run"

    @property
    def comparison(self) -> Path:
        """The folder of a comparison."""
        return self.place / "comparison"

    @property
    def outputs(self) -> Path:
        """The outputs."""
        return self.place / "outputs"

    @property
    def done(self) -> Path:
        """What the parts of the work found that are done: an attempt that resumes does not repeat them."""
        return self.place / "done"

    def clear_scratch(self) -> None:
        """Remove the intermediate results of a run whose summary is stored."""
        for folder in (self.run, self.comparison):
            shutil.rmtree(folder / SCRATCH, ignore_errors=True)

    def once(self, name: str, work: Callable[[], Done]) -> Done:
        """The result of a part of the work, which is stored; that of an attempt before, by the same version, if any."""
        path = self.done / f"{name}-{__version__}"
        # one that a loss of power cut off is as good as none
        with contextlib.suppress(FileNotFoundError, EOFError, pickle.UnpicklingError):
            before: Done = pickle.loads(path.read_bytes())  # noqa: S301 - from a folder of the service's own
            return before
        found = work()
        self.done.mkdir(exist_ok=True)
        new = path.with_name(f".{path.name}")
        new.write_bytes(pickle.dumps(found))
        new.rename(path)
        return found


def perform(held: Held, parts: AttemptParts) -> tuple[str, dict[str, Any]]:
    """Do all the work of a job.

    Parameters
    ----------
    held : Held
        The job; records the progress, and may be cancelled.
    parts : AttemptParts
        Folder, uploads, workers.

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
    job = held.job
    begin = WORK.get(job.request.process_id)
    if begin is None:
        raise RequestError([f"this driver does not run the process {job.request.process_id}, only {', '.join(WORK)}"])
    scrub = held.scrub
    # the scrubber would not recognise a folder with blanks in its name as one path
    scrub.name(f"{parts.folder.root}/", "/state/")
    held.record(Event(kind="stage", stage="inputs"))
    with tracing.span("stage inputs", stage="inputs"):
        files = _gathered(held, parts)
    for fetched in files.all:
        scrub.name(str(fetched.path), fetched.path.name)
    _note_inputs(held, files.tiles)
    work = begin(held, parts, files)
    executor = parts.executor()
    held.record(Event(kind="stage", stage="plan"))
    done = work(executor)
    _check(held)
    for folder in (parts.inputs, parts.done):
        shutil.rmtree(folder, ignore_errors=True)
    return done


def _gathered(held: Held, parts: AttemptParts) -> JobFiles:
    """The inputs; those of an attempt that was handed back are used again."""
    before = gathered_before(parts.inputs, held.job.request)
    if before is not None:
        return before
    shutil.rmtree(parts.inputs, ignore_errors=True)
    files = gather(
        held.job.request,
        store=parts.uploads,
        folder=parts.folder,
        settings=parts.settings,
        target=parts.inputs,
        cancelled=held.cancelled,
        # bytes that come at a useful rate
        progress=lambda _bytes: held.move(),
    )
    note_gathered(parts.inputs, files)
    return files


def _note_inputs(held: Held, tiles: Sequence[Fetched]) -> None:
    """Say in the job's log which program runs on what."""
    if tiles:
        names = ", ".join(tile.path.name for tile in tiles[:_NAMED])
        more = f" and {len(tiles) - _NAMED} more" if len(tiles) > _NAMED else ""
        inputs = f"{names}{more}, {sum(tile.points or 0 for tile in tiles)} points"
        held.note(f"gablework {__version__} on {inputs}", stage="inputs")


_Work = Callable[[Executor], tuple[str, dict[str, Any]]]
"""The work that needs the workers; returns the result in one sentence, and the summary."""


def _reconstruct(held: Held, parts: AttemptParts, files: JobFiles) -> _Work:
    """The process `reconstruct`."""
    job, out_dir = held.job, parts.outputs
    request = run_request(job.request, files, parts.run, parts.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = parts.once("run", lambda: run(request, held.record, executor, held.cancelled))
        parts.clear_scratch()
        problems = parts.once("formats", lambda: _published(held, parts))
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            write_outputs(Path(request.out), out_dir, job.request.outputs, begin)
        found = digest_of(summary, held.scrub, __version__) | ({"unpublished": problems} if problems else {})
        return outcome(summary, problems), found

    return work


def _published(held: Held, parts: AttemptParts) -> dict[str, str]:
    """Write the further formats of a job, if it wants any; why some could not be made, for clients."""
    request = held.job.request
    # an attempt before may have left a part of them
    shutil.rmtree(parts.outputs, ignore_errors=True)
    if not request.publish:
        return {}
    on_progress = _begun(held, "formats")
    held.scrub.name(str(parts.run), "this job")
    with tracing.span("stage formats", stage="formats"):
        found = publish(
            parts.run,
            parts.outputs,
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


def _compare(held: Held, parts: AttemptParts, files: JobFiles) -> _Work:
    """The process `compare`."""
    job, place, out_dir = held.job, parts.comparison, parts.outputs
    request = compare_request(job.request, files, place, parts.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = parts.once("compare", lambda: compare(request, held.record, executor, held.cancelled))
        parts.clear_scratch()
        shutil.rmtree(out_dir, ignore_errors=True)
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            write_comparison_outputs(place, list(summary.runs), out_dir, job.request.outputs, begin)
        return comparison_outcome(summary), comparison_digest(summary, held.scrub, __version__)

    return work


def _classify(held: Held, parts: AttemptParts, files: JobFiles) -> _Work:
    """The process `classify`."""
    job, out_dir = held.job, parts.outputs
    request = classify_request(job.request, files, parts.run, parts.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = parts.once("classify", lambda: classify(request, held.record, executor, held.cancelled))
        parts.clear_scratch()
        shutil.rmtree(out_dir, ignore_errors=True)
        begin = _begun(held, "outputs")
        with tracing.span("stage outputs", stage="outputs"):
            write_classification_outputs(summary, out_dir, job.request.outputs, begin, held.scrub)
        return classification_outcome(summary), classification_digest(summary, held.scrub, __version__)

    return work


def _echo(held: Held, parts: AttemptParts, files: JobFiles) -> _Work:
    """The process `echo`."""
    del files
    asked = held.job.request.echo or {}

    def work(_executor: Executor) -> tuple[str, dict[str, Any]]:
        until_s = time.monotonic() + asked["delay"]
        while (left_s := until_s - time.monotonic()) > 0.0 and not held.wait(min(left_s, _MOMENT_S)):
            held.move()
        _begun(held, "outputs")
        shutil.rmtree(parts.outputs, ignore_errors=True)
        write_echo(asked["message"], parts.outputs)
        return "echoed", {"engine_version": __version__}

    return work


WORK: Mapping[str, Callable[[Held, AttemptParts, JobFiles], _Work]] = MappingProxyType(
    {"reconstruct": _reconstruct, "compare": _compare, "classify": _classify, "echo": _echo}
)
"""The work of each process: checks the request with the fetched inputs, and returns the rest of the work."""


def _begun(held: Held, stage: str) -> Callable[[int, int], None]:
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
        resources=_resources(settings),
        # an attempt that was handed back may have begun it; the folder is the attempt's own
        overwrite=True,
        **values_of(ModelOptions, request),
    )


def _resources(settings: ServiceSettings) -> Resources:
    """What runs run with: one that is handed back resumes."""
    return dataclasses.replace(settings.resources, resume=True)


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
        rasters=has_rasters,
        raster_cell=request.raster_cell if has_rasters else None,
        resources=_resources(settings),
        # files of an attempt that was handed back
        overwrite=True,
        **values_of(InputOptions, request),
    )


def _check(held: Held) -> None:
    if held.cancelled():
        raise RunCancelledError("the job was cancelled")
