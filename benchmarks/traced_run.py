"""One run of the pipeline that records every task; `city_scale.py` starts it as a separate process.

    python -m benchmarks.traced_run INPUT --out RUN --trace trace.json [--workers 2] [--tile-size M]

It calls the function of `gablework reconstruct` with an executor that passes tasks on and stores the measurements of
`Measured`. For every eighth task it also takes the sizes of task and result.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import pickle
import shutil
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.engine import executor_for
from pipeline.runtime.monitoring.measurement import Measured, Result, Task
from pipeline.runtime.monitoring.progress import Event, Watch
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import run
from pipeline.settings import RunSettings

SIZED_EVERY = 8
SCRATCH_AFTER = ("split", "reconstruct", "publish")
"""Scratch is weighed when these stages begin: it holds the points, then the fragments, then the models too."""


class TracingExecutor:
    """Hands tasks on to an executor, which does the work, and keeps what each took."""

    def __init__(self, inner: Executor) -> None:
        self._inner = inner
        self.tasks: list[dict[str, Any]] = []
        """One row per task, in the order in which they came back."""
        self.sizes: list[dict[str, Any]] = []
        """Bytes of some tasks and of their results, as they travel."""
        self.sizing_s = 0.0
        """CPU seconds that taking the sizes took."""

    def prepare(self, stage: str, watch: Watch) -> None:
        """As the inner one."""
        self._inner.prepare(stage, watch)

    @property
    def memory_limit_bytes(self) -> int | None:
        """As the inner one."""
        return self._inner.memory_limit_bytes

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """As the inner one."""
        self._size(stage, "task", [(function, task) for task in tasks[::SIZED_EVERY]])
        for number, measured in enumerate(self._inner.map(stage, function, tasks, watch)):
            self.tasks.append(
                {
                    "stage": stage,
                    "function": function.__name__,
                    "process": measured.process,
                    "began_s": measured.began_s,
                    "seconds": measured.seconds,
                    "cpu_s": measured.cpu_s,
                    "back_s": time.time(),
                }
            )
            if number % SIZED_EVERY == 0:
                self._size(stage, "result", [measured])
            yield measured

    def _size(self, stage: str, what: str, values: Sequence[object]) -> None:
        began = time.process_time()
        for value in values:
            self.sizes.append({"stage": stage, "what": what, "bytes": len(pickle.dumps(value, protocol=5))})
        self.sizing_s += time.process_time() - began

    def __enter__(self) -> Self:
        """Enter the inner one."""
        self._inner.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the inner one."""
        self._inner.__exit__(kind, error, trace)


def folder_bytes(folder: Path) -> int:
    """Size of all files below a folder, of those that are still there."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += Path(place, name).stat().st_size
    return total


class Diary:
    """What the driver reports while it runs, with its own CPU time."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        self.lines: list[dict[str, Any]] = []
        self.scratch_bytes: dict[str, int] = {}
        self.weighing_s = 0.0

    def __call__(self, event: Event) -> None:
        """Write down an event; progress only at its end."""
        if event.kind == "progress" and event.done < event.total:
            return
        if event.kind == "stage" and event.stage in SCRATCH_AFTER:
            began = time.process_time()
            self.scratch_bytes[event.stage] = folder_bytes(self._scratch)
            self.weighing_s += time.process_time() - began
        self.lines.append(
            {
                "at_s": time.time(),
                "cpu_s": time.process_time(),
                "kind": event.kind,
                "stage": event.stage,
                "message": event.message,
            }
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("input")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--trace", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tile-size", type=float, default=0.0)
    wanted = parser.parse_args(arguments)
    settings = RunSettings.from_mapping({"tile_size_m": wanted.tile_size} if wanted.tile_size else {})
    request = RunRequest(
        inputs=(wanted.input,),
        out=str(wanted.out),
        settings=settings,
        resources=Resources(workers=wanted.workers),
        overwrite=True,
    )
    diary = Diary(wanted.out / "scratch")
    place = tempfile.mkdtemp(prefix="gablework-dask-")
    began_s = time.time()
    found: dict[str, Any] = {"began_s": began_s, "workers": wanted.workers, "diary": diary.lines}
    executor = TracingExecutor(executor_for(request.resources, local_directory=place))
    try:
        found["summary"] = dataclasses.asdict(run(request, diary, executor))
    finally:
        shutil.rmtree(place, ignore_errors=True)
        # of a run that broke off, too
        found |= {
            "ended_s": time.time(),
            "driver_cpu_s": time.process_time(),
            "tracing_cpu_s": executor.sizing_s + diary.weighing_s,
            "scratch_bytes": diary.scratch_bytes,
            "sizes": executor.sizes,
            "tasks": executor.tasks,
        }
        wanted.trace.write_text(json.dumps(found) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
