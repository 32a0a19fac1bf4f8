"""A batch run: estimated, refused if it cannot work, run in its work folder, with a status file."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path

from pipeline.batch.batch_file import Batch
from pipeline.batch.batch_keys import as_keys, errors_with_keys
from pipeline.batch.batch_status import StatusWriter, buildings_before
from pipeline.batch.estimates import estimate, places_refused, refuse
from pipeline.errors import GableworkError, RunCancelledError
from pipeline.report.run_page import write_run_page
from pipeline.runtime.cluster.run_metrics import RunMetrics, combined, serve_metrics
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.compiling import compile_for, kernel_groups
from pipeline.runtime.monitoring.progress import Event, Listener, ignore, never
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.scratch.work_folder import DRIVER_LOCK, locked_file, make_work, refuse_locked

_WORTH_S = 60.0
"""Runs that take less wall time by the rates are not sampled: they should begin soon."""


def refuse_at_once(batch: Batch) -> None:
    """Refuse a batch whose folders cannot be used, before anything is read; raises as `run_batch`."""
    refuse_locked(batch.work_folder)
    refuse(places_refused(batch))


def compile_for_batch(batch: Batch, on_event: Listener) -> None:
    """Compile the kernels that a batch lacks here, after a look for its folders and files; raises as `run_batch`."""
    refuse_at_once(batch)
    request = batch.request()
    general, files = request.settings.general, (request.footprints, request.guides, request.overrides, request.aoi)
    groups = kernel_groups(method=general.method, points=request.points, terrain=general.terrain)
    with errors_with_keys():
        compile_for(on_event, groups, request.inputs, files, scheduler=request.resources.scheduler)


def run_batch(
    batch: Batch,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> RunSummary:
    """Run a batch, or continue one that was cut off. Parts that did not change since an earlier run are not done again.

    Raises
    ------
    BatchRefusedError
        It cannot work as planned.
    RunError
        Another process runs it, or its folders cannot be used.
    InputError, SettingsError, ClusterError, RunCancelledError
        As in `pipeline.runtime.run.run`.
    """
    refuse_at_once(batch)
    with contextlib.ExitStack() as shown, errors_with_keys():
        # a second run must not write into the status of the first
        work = Path(batch.work_folder).resolve()
        make_work(work)
        shown.enter_context(locked_file(work, DRIVER_LOCK))
        known = buildings_before(batch.work_folder)
        status = StatusWriter(batch.work_folder, str(batch.path), batch.out)
        if batch.cluster.metrics_port:
            shown.callback(serve_metrics(batch.cluster.metrics_port))
            on_event = combined(RunMetrics(), on_event)
        return _run_with_status(batch, status, on_event, executor, cancelled, known)


def _run_with_status(
    batch: Batch,
    status: StatusWriter,
    on_event: Listener,
    executor: Executor | None,
    cancelled: Callable[[], bool],
    known: tuple[int, int],
) -> RunSummary:
    """Plan and run a batch, and write its status."""

    def listen(event: Event) -> None:
        event = dataclasses.replace(event, message=as_keys(event.message))
        status.on_event(event)
        is_plain = event.kind == "progress" and not event.message
        on_event(dataclasses.replace(event, message=status.summary()) if is_plain else event)

    def tick() -> bool:
        status.tick()
        return cancelled()

    try:
        # the headers of thousands of remote inputs take minutes
        status.begin()
        planned = estimate(batch, _WORTH_S, known)
        refuse(planned.refusals)
        status.plan(planned.stage_s, planned.points)
        summary = run(batch.request(), listen, executor, tick)
    except (KeyboardInterrupt, RunCancelledError):
        status.end("interrupted", "run the batch again, and it continues from here")
        raise
    except BaseException as error:
        status.end("failed", as_keys(f"{type(error).__name__}: {error}".removesuffix(": ")))
        raise
    status.end("finished" if summary.is_complete else "incomplete", f"digest {summary.digest}")
    if batch.output.report:
        _write_report(summary, on_event)
    return summary


def _write_report(summary: RunSummary, on_event: Listener) -> None:
    """Write the page about a run; a complete run does not fail because of it."""
    on_event(Event(kind="stage", stage="report"))
    try:
        write_run_page(summary.run_dir)
    except (GableworkError, OSError) as error:
        message = f"the run is complete, its report could not be written: {error}. Write it with gablework report"
        on_event(Event(kind="warning", stage="report", message=message))
