"""One attempt at one job: a fresh folder, the inputs, the run, the outputs."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from pipeline import __version__
from pipeline.errors import RunCancelledError
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.compare import CompareRequest, CompareSummary, own_tables, parse_variants
from pipeline.runtime.monitoring.events import Event, Listener
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings
from service.driver.clusters import SharedCluster
from service.driver.held import HeldJob
from service.driver.wording import comparison_digest, comparison_outcome, digest_of, outcome
from service.errors import RequestError
from service.fetching import Fetched, gather
from service.files import StateFolder
from service.jobs import JobRequest
from service.outputs import write_comparison_outputs, write_outputs
from service.settings import ServiceSettings
from service.store import JobStore


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
        """Run several methods over the same candidates, and write what they have to show."""


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
    ) -> tuple[list[Fetched], Fetched | None]:
        """All inputs on this machine's disk."""


class WriteOutputs(Protocol):
    """`service.outputs.write_outputs`."""

    def __call__(
        self, run_dir: Path, out_dir: Path, wanted: Sequence[str] | None, on_progress: Callable[[int, int], None]
    ) -> None:
        """Assemble the outputs."""


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
    """`report.compare_files.compare_files` without a reference; it loads the library that draws, so late."""
    from pipeline.ruler.report.compare_files import compare_files

    return compare_files(request, on_event=on_event, executor=executor, cancelled=cancelled).summary


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tools:
    """What an attempt is made of; tests put in their own."""

    gather: Gather = gather
    run: Run = run
    compare: Compare = compare
    write_outputs: WriteOutputs = write_outputs
    write_comparison: WriteComparison = write_comparison_outputs


@dataclasses.dataclass(frozen=True, kw_only=True)
class Workshop:
    """What all attempts of a driver share."""

    settings: ServiceSettings
    folder: StateFolder
    store: JobStore
    cluster: SharedCluster
    tools: Tools = Tools()


def perform(held: HeldJob, shop: Workshop) -> tuple[str, dict[str, Any]]:
    """Do all the work of a job.

    Parameters
    ----------
    held : HeldJob
        The job; learns how it goes, and may call it off.
    shop : Workshop
        Store, folder, cluster.

    Returns
    -------
    tuple of str and dict
        What came out in one sentence, and the summary to be stored. The results lie in the attempt's folder.

    Raises
    ------
    RunCancelledError
        It was called off.
    Exception
        Whatever ends the attempt: `faults` tells what comes of it.
    """
    job, folder = held.job, shop.folder
    begin = WORK.get(job.request.process_id)
    if begin is None:
        raise RequestError([f"this driver knows no process {job.request.process_id}: it knows {', '.join(WORK)}"])
    attempt = folder.attempt(job.job_id, job.attempt)
    # an attempt's number is given once; what lies there was left by a database that was put back
    shutil.rmtree(attempt, ignore_errors=True)
    attempt.mkdir(parents=True)
    scrub = held.scrub
    # a folder whose name has blanks would not be seen as one path
    scrub.name(f"{folder.root}/", "/state/")
    held.tell(Event(kind="stage", stage="inputs"))
    target = folder.inputs(job.job_id, job.attempt)
    tiles, outlines = shop.tools.gather(
        job.request,
        store=shop.store,
        folder=folder,
        settings=shop.settings,
        target=target,
        cancelled=held.cancelled,
    )
    for fetched in [*tiles, *([] if outlines is None else [outlines])]:
        scrub.name(str(fetched.path), fetched.path.name)
    work = begin(held, shop, tiles, outlines)
    shop.cluster.wait_until_there(held)
    held.tell(Event(kind="stage", stage="plan"))
    held.engine = shop.cluster.engine()
    # its jobs are interactive traffic: they go before batch runs on the same scheduler
    done = work(held.engine.executor(job.priority))
    _check(held)
    shutil.rmtree(target, ignore_errors=True)
    return done


_Work = Callable[[Executor], tuple[str, dict[str, Any]]]
"""All that needs the workers; gives what came out in one sentence, and the summary."""


def _reconstruct(held: HeldJob, shop: Workshop, tiles: Sequence[Fetched], outlines: Fetched | None) -> _Work:
    """The process `reconstruct`."""
    job, folder = held.job, shop.folder
    run_dir, out_dir = folder.run(job.job_id, job.attempt), folder.outputs(job.job_id, job.attempt)
    request = run_request(job.request, tiles, outlines, run_dir, shop.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = shop.tools.run(request, held.tell, executor, held.cancelled)
        shop.tools.write_outputs(Path(request.out), out_dir, job.request.outputs, _outputs_begin(held))
        return outcome(summary), digest_of(summary, held.scrub, __version__)

    return work


def _compare(held: HeldJob, shop: Workshop, tiles: Sequence[Fetched], outlines: Fetched | None) -> _Work:
    """The process `compare`."""
    job, folder = held.job, shop.folder
    place, out_dir = folder.comparison(job.job_id, job.attempt), folder.outputs(job.job_id, job.attempt)
    request = compare_request(job.request, tiles, outlines, place, shop.settings)

    def work(executor: Executor) -> tuple[str, dict[str, Any]]:
        summary = shop.tools.compare(request, held.tell, executor, held.cancelled)
        shop.tools.write_comparison(place, list(summary.runs), out_dir, job.request.outputs, _outputs_begin(held))
        return comparison_outcome(summary), comparison_digest(summary, held.scrub, __version__)

    return work


WORK: Mapping[str, Callable[[HeldJob, Workshop, Sequence[Fetched], Fetched | None], _Work]] = MappingProxyType(
    {"reconstruct": _reconstruct, "compare": _compare}
)
"""What a driver does for each process: checks the request with the inputs where they lie, and gives back the work."""


def _outputs_begin(held: HeldJob) -> Callable[[int, int], None]:
    """Tell that outputs are assembled now; what comes back tells how far that is."""
    _check(held)
    held.tell(Event(kind="stage", stage="outputs"))

    def written(done: int, total: int) -> None:
        _check(held)
        held.tell(Event(kind="progress", stage="outputs", done=done, total=total))

    return written


def run_request(
    request: JobRequest, tiles: Sequence[Fetched], outlines: Fetched | None, out: Path, settings: ServiceSettings
) -> RunRequest:
    """A job's request as a run's, with the inputs where they lie now.

    Raises
    ------
    SettingsError
        Settings are out of range.
    """
    return RunRequest(
        inputs=tuple(str(tile.path) for tile in tiles),
        only_files=True,  # a tile of a stranger that reads as a tile index would else be followed wherever it leads
        out=str(out),
        settings=RunSettings.from_mapping(request.settings),
        footprints=None if outlines is None else str(outlines.path),
        crs=request.crs,
        vertical_unit=request.vertical_unit,
        bbox=request.bbox,
        resources=Resources(
            scheduler=settings.scheduler,
            building_timeout_s=settings.building_timeout_s,
            building_memory_bytes=settings.building_memory_bytes,
        ),
        meshes=request.meshes,
        licence=request.licence,
    )


def compare_request(
    request: JobRequest, tiles: Sequence[Fetched], outlines: Fetched | None, out: Path, settings: ServiceSettings
) -> CompareRequest:
    """A job's request as a comparison's.

    Raises
    ------
    SettingsError
        Settings are out of range, or a method is not known.
    """
    return CompareRequest(
        run=run_request(request, tiles, outlines, out, settings),
        variants=parse_variants(request.methods),
        tables=own_tables(request.settings),
    )


def _check(held: HeldJob) -> None:
    if held.cancelled():
        raise RunCancelledError("the job was called off")
