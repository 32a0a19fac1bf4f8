"""City-scale runs from one file."""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.batch.remaining_time import duration
from pipeline.cli.command_options import AsJson, Quiet
from pipeline.cli.run_summary import show_summary
from pipeline.console import Console, ExitCode

if TYPE_CHECKING:
    from pipeline.batch.batch_file import Batch
    from pipeline.batch.batch_status import Status
    from pipeline.batch.estimates import Estimate

BatchFile = Annotated[str, typer.Argument(metavar="FILE", help="The batch file, TOML; docs/how_to/batch.md.")]
_NEXT = 3


def plan(
    file: BatchFile,
    as_json: AsJson = False,
) -> None:
    """Estimate what a batch run takes, and refuse what cannot work, before anything runs."""
    with Console(as_json=as_json) as console:
        from pipeline.batch.batch_file import read_batch
        from pipeline.batch.estimates import estimate, refuse

        batch = read_batch(file)
        found = estimate(batch)
        console.table(f"The plan of {file}", ("figure", "value"), [*_rows(found), *_times(batch)])
        for warning in found.warnings:
            console.warn(warning)
        console.document(dataclasses.asdict(found))
        refuse(found.refusals)


def run(file: BatchFile, as_json: AsJson = False, quiet: Quiet = False) -> None:
    """Run a batch; an interrupted one continues where it stopped, and unchanged parts are not computed again."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.batch.batch_file import read_batch
        from pipeline.batch.batch_run import compile_for_batch, run_batch

        # SIGTERM, as systemd and Kubernetes send it, leaves a run that can continue
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        batch = read_batch(file)
        compile_for_batch(batch, console.on_event)
        summary = run_batch(batch, console.on_event)
        show_summary(console, summary)
        console.document(dataclasses.asdict(summary))
        if not summary.is_complete:
            raise typer.Exit(ExitCode.TILES_FAILED)


def status(file: BatchFile, as_json: AsJson = False) -> None:
    """Show the progress of a batch run, from any terminal, even after it died."""
    with Console(as_json=as_json) as console:
        from pipeline.batch.batch_file import read_batch
        from pipeline.batch.batch_status import NAME, read_status

        batch = read_batch(file)
        if batch.schedule.cron and not Path(batch.work_folder, NAME).exists():
            console.table(f"The run of {file}", ("figure", "value"), [("state", "never run"), *_times(batch)])
            console.document({"state": "never run", "schedule": _scheduled(batch)})
            return
        found = read_status(batch.work_folder)
        console.table(f"The run of {file}", ("figure", "value"), [*_status_rows(found), *_times(batch)])
        for warning in found.warnings:
            console.warn(warning)
        console.document(dataclasses.asdict(found) | {"schedule": _scheduled(batch)})


def schedule(file: BatchFile, as_json: AsJson = False, quiet: Quiet = False) -> None:
    """Run a batch at the times of its table [schedule] until this command ends; report missed times."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.batch.batch_file import read_batch
        from pipeline.batch.schedule_process import Ending, keep_schedule, start_run

        ending = Ending()
        _end_by_signals(ending.set)
        batch = read_batch(file)
        words = [word for word, is_so in (("--json", as_json), ("--quiet", quiet)) if is_so]
        keep_schedule(file, ending, console.on_event, functools.partial(start_run, words=words))
        console.document(_scheduled(batch) or {})


def _end_by_signals(end: Callable[[], None]) -> None:
    """Have signals call a function; under nohup, closing the terminal ends nothing."""
    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: end())


def _scheduled(batch: Batch) -> dict[str, Any] | None:
    """The history of a batch's schedule, as plain JSON values."""
    from pipeline.batch.schedule_file import read_schedule

    state = read_schedule(batch.work_folder)
    return None if state is None else state.as_dict()


def _times(batch: Batch) -> list[tuple[str, str]]:
    """The next times, and the outcome of the last one."""
    from pipeline.batch.schedule_file import iso, read_schedule

    if not batch.schedule.cron:
        return []
    next_times = "paused"
    if not batch.schedule.paused:
        times = batch.schedule.rules.cron.next_times(dt.datetime.now(tz=dt.UTC), _NEXT)
        next_times = ", ".join(f"{at:%Y-%m-%d %H:%M %Z}" for at in times)
    rows = [("next times", next_times)]
    state = read_schedule(batch.work_folder)
    if state is not None and state.entries:
        last = state.entries[-1]
        rows.append(("last time", f"{iso(last.slot)}: {last.outcome.value}{last.message and ', '}{last.message}"))
        rows.append(("times so far", ", ".join(f"{count} {name}" for name, count in state.counts.items())))
    return rows


def _rows(found: Estimate) -> list[tuple[str, str]]:
    basis = ", by a sample" if found.sampled else ""
    largest, most, all_gib = (n / 2**30 for n in (found.worker_bytes, found.worker_most_bytes, found.memory_bytes))
    limit = "" if found.worker_limit_bytes is None else f" of {found.worker_limit_bytes / 2**30:.1f}"
    return [
        ("inputs", f"files: {found.files}, {found.points / 1e6:,.1f} million points"),
        ("tiles", f"{found.tiles} of {found.tile_size_m:g} m"),
        ("buildings", f"about {found.buildings:,} ({found.buildings_from})"),
        ("memory per worker", f"about {largest:.1f} GiB, at most {most:.1f}{limit} GiB"),
        ("memory in all", f"about {all_gib:.1f} GiB"),
        ("time", f"{duration(found.seconds[0])} to {duration(found.seconds[1])} with {_hands(found.workers)}{basis}"),
        ("work folder", f"{found.work_bytes / 1e9:.2f} GB{_of(found.work_free_bytes)}"),
        ("results", f"{found.out_bytes / 1e9:.2f} GB{_of(found.out_free_bytes)}"),
    ]


def _hands(workers: int) -> str:
    """The number of workers; without any, the time is that of one."""
    return f"{workers} workers" if workers > 1 else "1 worker" if workers else "1 worker (none is there now)"


def _of(free: int | None) -> str:
    return "" if free is None else f" of {free / 1e9:.1f} GB free"


def _status_rows(found: Status) -> list[tuple[str, str]]:
    rows = [("state", found.state), ("process", found.process), ("started", found.started_at)]
    rows.append(("updated", found.updated_at))
    if found.stage and not found.stages:
        rows.append((found.stage, "under way" if found.state == "running" else "was under way"))
    for name, stage in found.stages.items():
        kept = f", {stage['kept']} of them before" if stage["kept"] else ""
        rows.append((name, f"{stage['done']} of {stage['total']}{kept}, {duration(stage['seconds'])}"))
    if found.buildings:
        failed = f", {found.buildings['failed']} failed"
        rows.append(("buildings", f"{found.buildings['done']} done{failed}, {found.buildings['queued']} queued"))
    if found.rate_per_s is not None and found.state == "running":
        rows.append(("rate", f"{found.rate_per_s:g} per second in {found.stage}"))
    if found.remaining_s is not None:
        rows.append(("remaining", f"{duration(found.remaining_s[0])} to {duration(found.remaining_s[1])}"))
    rows.extend((name, text) for name, text in (("waiting", found.waiting), ("message", found.message)) if text)
    return rows
