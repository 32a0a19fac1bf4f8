"""The output of a command: progress, tables, errors and exit codes, for people, logs and programs.

| mode | standard output | standard error |
| --- | --- | --- |
| terminal | tables | progress bars, warnings, errors |
| elsewhere (a file, a pipe, CI) | tables | one log line per event, throttled |
| `--json` | one JSON document | one JSON object per event, one per line |
| `--quiet` | as above | warnings and errors only |
| `GABLEWORK_LOG_JSON=1` | as above | one JSON object per line: events, errors, lines of libraries |
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import typer

from pipeline.errors import InputError, RemoteError, RunError, SettingsError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.progress import Progress, TaskID

    from pipeline.runtime.monitoring.progress import Event

LOG_INTERVAL_S = 2.0
"""Shortest time between two log lines of progress of one stage."""


LOG_WIDTH = 120
"""Columns of a table that is not printed on a terminal."""


class ExitCode(IntEnum):
    """What a command's exit code means."""

    DONE = 0
    TILES_FAILED = 1
    USAGE = 2
    INPUT = 3
    RUN_DIRECTORY = 4
    INTERNAL = 5
    SERVICE = 6
    DISMISSED = 7
    INTERRUPTED = 130


EXIT_CODES: Mapping[ExitCode, str] = {
    ExitCode.DONE: "Done. Single buildings may still be doubtful or have failed: each has a record with its reason.",
    ExitCode.TILES_FAILED: (
        "The run or job finished, but at least one tile failed or has no points; all other tiles are complete. Or: the "
        "building of a replay failed again."
    ),
    ExitCode.USAGE: "The command line or a setting is wrong; nothing was done.",
    ExitCode.INPUT: "An input cannot be used; the message names the file, the value and the fix.",
    ExitCode.RUN_DIRECTORY: (
        "A run directory or work folder cannot be written, read or resumed; or a batch's plan cannot work."
    ),
    ExitCode.INTERNAL: "A fault of gablework itself; the traceback is printed, or is in the log of the service.",
    ExitCode.SERVICE: (
        "A service does not answer, refuses the key or the request, or had to give up the job for lack of workers or "
        "room."
    ),
    ExitCode.DISMISSED: "The job was dismissed.",
    ExitCode.INTERRUPTED: "Interrupted from the keyboard.",
}
"""The meaning of each code, for the reference docs."""


def exit_code_of(error: BaseException) -> ExitCode:
    """Which exit code an exception ends a command with.

    >>> exit_code_of(SettingsError(["v is 7: use 0 to 1"])).name
    'USAGE'
    >>> exit_code_of(ZeroDivisionError()).name
    'INTERNAL'
    """
    table: tuple[tuple[type[BaseException], ExitCode], ...] = (
        (KeyboardInterrupt, ExitCode.INTERRUPTED),
        (SettingsError, ExitCode.USAGE),
        (InputError, ExitCode.INPUT),
        (RunError, ExitCode.RUN_DIRECTORY),
        (RemoteError, ExitCode.SERVICE),
    )
    return next((code for kind, code in table if isinstance(error, kind)), ExitCode.INTERNAL)


class Console:
    """The output of a command; as a context manager it turns exceptions into messages and exit codes.

    Parameters
    ----------
    as_json : bool
        One JSON document on standard output, events as JSON lines on standard error.
    quiet : bool
        No progress.
    log_json : bool
        Everything on standard error is one JSON object per line, like with `GABLEWORK_LOG_JSON=1`.
    clock : callable
        Seconds, monotonic; replaced in tests.
    code_of : callable
        The exit code of an exception.
    """

    def __init__(
        self,
        *,
        as_json: bool = False,
        quiet: bool = False,
        log_json: bool = False,
        clock: Callable[[], float] = time.monotonic,
        code_of: Callable[[BaseException], ExitCode] = exit_code_of,
    ) -> None:
        self.as_json = as_json
        self._code_of = code_of
        self.quiet = quiet
        self._clock = clock
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._last_line_s: dict[str, float] = {}
        self._firsts: set[str] = set()
        self._log_json = log_json
        self._logs = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Start logging; raises typer.Exit if `GABLEWORK_LOG_JSON` is neither 1 nor 0."""
        if self._log_json or os.environ.get("GABLEWORK_LOG_JSON"):
            from pipeline.runtime.monitoring.log_lines import log_everything_as_json
            from pipeline.runtime.monitoring.logs import wants_json

            try:
                self._log_json = wants_json() or self._log_json
            except SettingsError as error:
                self._show_error(error, ExitCode.USAGE)
                raise typer.Exit(ExitCode.USAGE) from error
            if self._log_json:
                self._logs.callback(log_everything_as_json())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bars; print what went wrong and end with its exit code.

        Raises typer.Exit with the code of `EXIT_CODES`, in place of any error except those that typer itself handles.
        """
        self._close_bars()
        with self._logs:
            if error is None or isinstance(error, SystemExit | typer.Exit | typer.Abort | typer.BadParameter):
                return
            code = self._code_of(error)
            self._show_error(error, code)
            raise typer.Exit(code) from error

    # --- progress ----------------------------------------------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """Show an event of a run."""
        if event.kind == "warning" and event.facts and not (self._log_json or self.as_json):
            self.say_first(event.message)
        elif event.kind == "warning":
            self.warn(event.message, stage=event.stage)
        elif self.quiet or event.kind == "detail":
            # its own lines are in the worker's log, and its counts in the progress
            return
        elif self._log_json:
            self._log(event)
        elif self.as_json:
            print(json.dumps(dataclasses.asdict(event)), file=sys.stderr, flush=True)
        elif sys.stderr.isatty():
            self._advance_bar(event)
        else:
            self._log(event)

    def _advance_bar(self, event: Event) -> None:
        if event.kind == "waiting":
            self.warn(event.message)
        if event.kind not in {"stage", "progress"}:
            return
        if self._bars is None:
            from rich.console import Console as RichConsole
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (
                TextColumn("{task.description:<12}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[message]}"),
            )
            self._bars = Progress(*columns, console=RichConsole(stderr=True))
            self._bars.start()
        if event.stage not in self._tasks:
            self._tasks[event.stage] = self._bars.add_task(event.stage, total=None, message="")
        total = event.total or None
        self._bars.update(self._tasks[event.stage], completed=event.done, total=total, message=event.message)

    def _log(self, event: Event) -> None:
        now = self._clock()
        ended = event.kind != "progress" or event.done == event.total
        if not ended and now - self._last_line_s.get(event.stage, -LOG_INTERVAL_S) < LOG_INTERVAL_S:
            return
        self._last_line_s[event.stage] = now
        if self._log_json:
            from pipeline.runtime.monitoring.logs import LOG

            facts = {"stage": event.stage or None, "done": event.done, "total": event.total, "failed": event.failed}
            level = "warning" if event.kind == "waiting" else "info"
            getattr(LOG, level)(event.message or event.kind, extra=facts)
            return
        counted = f"{event.done}/{event.total}" if event.total else str(event.done or "")
        words = [word for word in (event.stage, counted, event.message) if word]
        if words:
            print(" ".join(words), file=sys.stderr, flush=True)

    def _close_bars(self) -> None:
        if self._bars is not None:
            self._bars.stop()
            self._bars = None
            self._tasks = {}

    # --- single messages -------------------------------------------------------------------------------------------

    def warn(self, message: str, stage: str = "") -> None:
        """Print a warning on standard error."""
        if self._log_json:
            from pipeline.runtime.monitoring.logs import LOG

            LOG.warning(message, extra={"stage": stage or None})
        elif self.as_json:
            print(json.dumps({"kind": "warning", "message": message}), file=sys.stderr, flush=True)
        elif self._bars is not None:
            self._bars.console.print(f"warning: {message}", style="yellow", markup=False, highlight=False)
        else:
            print(f"warning: {message}", file=sys.stderr, flush=True)

    def say(self, message: str) -> None:
        """Print a line for people; silent with `--json`."""
        if not self.as_json:
            self._close_bars()
            print(message, flush=True)

    def say_first(self, message: str) -> None:
        """Print a warning above the results of a run, once: its event may come before its summary."""
        if message not in self._firsts:
            self._firsts.add(message)
            self.say(f"warning: {message}")

    def status(self, message: str) -> None:
        """Report the state of a command that runs until it is ended: a line for people, or a line of its log."""
        if self._log_json:
            from pipeline.runtime.monitoring.logs import LOG

            LOG.info(message)
        else:
            self.say(message)

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Show a table for people; nothing without rows. Columns of numbers are aligned right."""
        if not rows or self.as_json:
            return
        from rich.table import Table

        table = Table(title=title or None, title_justify="left")
        for name, *cells in zip(header, *rows, strict=True):
            table.add_column(name, justify="right" if all(is_figure(str(cell)) for cell in cells) else "left")
        for row in rows:
            table.add_row(*map(str, row))
        self.show(table)

    def show(self, renderable: RenderableType) -> None:
        """Print what rich can render, for people; silent with `--json`."""
        if self.as_json:
            return
        from rich.console import Console as RichConsole

        self._close_bars()
        width = None if sys.stdout.isatty() else LOG_WIDTH
        RichConsole(file=sys.stdout, width=width, markup=False, highlight=False).print(renderable)

    def document(self, content: Mapping[str, Any]) -> None:
        """Print the JSON document of `--json`; silent without."""
        if self.as_json:
            print(json.dumps(_json_value(content), indent=2, allow_nan=False), flush=True)

    def _show_error(self, error: BaseException, code: ExitCode) -> None:
        message = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__
        # a fault of a service elsewhere has its traceback there
        is_ours = code is ExitCode.INTERNAL and not isinstance(error, RemoteError)
        if self._log_json:
            from pipeline.runtime.monitoring.logs import LOG

            LOG.error(message, exc_info=error if is_ours else None)
        elif is_ours:
            traceback.print_exception(error, file=sys.stderr)
        if self.as_json:
            detail: dict[str, Any] = {"type": type(error).__name__, "exit_code": int(code), "message": message}
            if isinstance(error, InputError):
                detail |= {"path": error.path, "problem": error.problem, "fix": error.fix}
            if isinstance(error, SettingsError):
                detail["faults"] = list(error.faults)
            print(json.dumps({"error": detail}, indent=2), flush=True)
        if self.as_json or self._log_json:
            return
        lines = list(error.faults) if isinstance(error, SettingsError) and len(error.faults) > 1 else [message]
        for line in lines:
            print(f"error: {line}", file=sys.stderr, flush=True)
        if code is ExitCode.INTERNAL:
            print("This is a fault of gablework, not of your input: please report it.", file=sys.stderr, flush=True)


def _json_value(value: Any) -> Any:
    """A value as JSON: numbers that are not finite become null, unknown types their text.

    >>> _json_value({"rmse_m": float("nan"), 3: (1, Ellipsis)})
    {'rmse_m': None, '3': [1, 'Ellipsis']}
    """
    if isinstance(value, Mapping):
        return {str(name): _json_value(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def is_figure(text: str) -> bool:
    """Whether a cell is a number, with or without a unit.

    >>> [is_figure(text) for text in ("12", "98.5 %", "0.3 m", "gable", "")]
    [True, True, True, False, True]
    """
    head = text.split(" ", maxsplit=1)[0]
    try:
        float(head.replace(",", "") or 0)
    except ValueError:
        return False
    return True
