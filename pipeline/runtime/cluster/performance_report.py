"""A page about the time of the workers: their load over time, per stage and per process.

It is drawn from the measurements of the tasks and needs neither a library nor the scheduler. (Dask's own report needs
bokeh on client and scheduler, loads scripts from the internet, and its scheduler remembers only the last hundred
thousand tasks.) Its memory is bounded for any number of tasks: sums over bins of time that get wider.
"""

from __future__ import annotations

import datetime as dt
import heapq
import html
import os
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pipeline.errors import RunError
from pipeline.runtime.monitoring.measurement import Measured

BINS = 480
"""Largest number of time bins; if a run lasts longer, bins are merged in pairs."""
ROWS = 200
"""Largest number of processes with a row in the picture; the table has all."""
SLOWEST = 20
"""Number of longest tasks that are listed."""

_FIRST_BIN_S = 0.125
_COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#76b7b2", "#edc948", "#b07aa1", "#9c755f")
_WIDTH, _HEIGHT, _ROW = 960, 160, 9
_STYLE = (
    "body{font:14px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:64rem;color:#222;background:#fff}"
    "table{border-collapse:collapse;margin:1rem 0}"
    "td,th{padding:.15rem .7rem;text-align:right;border-bottom:1px solid #ddd}"
    "td:first-child,th:first-child{text-align:left}"
    ".key{display:inline-block;width:.8rem;height:.8rem;margin:0 .3rem 0 1rem}"
)


class PerformanceReport:
    """Collects measurements during a run and writes the page on exit, also if the run breaks off.

    Parameters
    ----------
    path : str
        The HTML page; written under a temporary name first.
    clock : callable
        Seconds since 1970; replaced in tests.

    Raises
    ------
    RunError
        The folder of the page does not exist.
    """

    def __init__(self, path: str, clock: Callable[[], float] = time.time) -> None:
        self.path = Path(path).absolute()
        if not self.path.parent.is_dir():
            raise RunError(f"the performance report {path} cannot be written: make the folder {self.path.parent} first")
        self._clock = clock
        self._began_s = self._ended_s = clock()
        self._bin_s = _FIRST_BIN_S
        self._by_stage: dict[str, list[float]] = {}
        self._by_process: dict[str, list[float]] = {}
        self._stages: dict[str, list[float]] = {}
        self._processes: dict[str, list[float]] = {}
        self._slowest: list[tuple[float, str, str, float]] = []

    def __enter__(self) -> Self:
        """Start the clock."""
        self._began_s = self._clock()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the page."""
        self._ended_s = self._clock()
        unfinished = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            unfinished.write_text(self.page(), encoding="utf-8")
            unfinished.replace(self.path)
        except OSError as fault:
            if error is None:
                raise RunError(f"the performance report {self.path} cannot be written: {fault.strerror}") from fault

    def add(self, stage: str, measured: Measured[Any]) -> None:
        """Add the measurement of one task."""
        # clocks of machines differ: an earlier start counts as the start of the run
        start_s = max(0.0, measured.began_s - self._began_s)
        for name, sums in ((stage, self._stages), (measured.process, self._processes)):
            row = sums.setdefault(name, [0.0, 0.0, 0.0, 0.0])
            row[0] += 1
            row[1] += measured.seconds
            row[2] = max(row[2], measured.seconds)
            row[3] = max(row[3], measured.peak_bytes)
        self._spread(self._bins(self._by_stage, stage), start_s, measured.seconds)
        if measured.process in self._by_process or len(self._by_process) < ROWS:
            self._spread(self._bins(self._by_process, measured.process), start_s, measured.seconds)
        entry = (measured.seconds, stage, measured.process, start_s)
        if len(self._slowest) < SLOWEST:
            heapq.heappush(self._slowest, entry)
        else:
            heapq.heappushpop(self._slowest, entry)

    @staticmethod
    def _bins(of: dict[str, list[float]], name: str) -> list[float]:
        return of.setdefault(name, [0.0] * BINS)

    def _spread(self, bins: list[float], start_s: float, seconds: float) -> None:
        """Add a task's seconds to its bins; widens all bins if they end too early."""
        end_s = start_s + seconds
        while end_s > BINS * self._bin_s:
            self._bin_s *= 2.0
            for some in (*self._by_stage.values(), *self._by_process.values()):
                some[:] = [a + b for a, b in zip(some[::2], some[1::2], strict=True)] + [0.0] * (BINS // 2)
        first, last = int(start_s / self._bin_s), min(BINS - 1, int(end_s / self._bin_s))
        for k in range(first, last + 1):
            bins[k] += max(0.0, min(end_s, (k + 1) * self._bin_s) - max(start_s, k * self._bin_s))

    # --- the page ----------------------------------------------------------------------------------------------------

    @property
    def efficiency(self) -> float:
        """Seconds of all tasks divided by the time of all working processes, 0 to 1."""
        wall_s = max(1e-9, self._ended_s - self._began_s)
        busy_s = sum(row[1] for row in self._processes.values())
        return busy_s / (wall_s * max(1, len(self._processes)))

    def page(self) -> str:
        """The whole page."""
        wall_s = self._ended_s - self._began_s
        began = dt.datetime.fromtimestamp(self._began_s, dt.UTC).isoformat(timespec="seconds")
        tasks = int(sum(row[0] for row in self._stages.values()))
        summary = (
            f"Began {began}, took {wall_s:.1f} s: {tasks} tasks on {len(self._processes)} processes, "
            f"which were busy {100 * self.efficiency:.0f} % of the time."
        )
        stages = [
            [name, f"{row[0]:.0f}", f"{row[1]:.1f}", f"{row[1] / row[0]:.3f}", f"{row[2]:.2f}"]
            for name, row in self._stages.items()
        ]
        processes = [
            [name, f"{row[0]:.0f}", f"{row[1]:.1f}", f"{100 * row[1] / max(1e-9, wall_s):.0f}", f"{row[3] / 2**20:.0f}"]
            for name, row in sorted(self._processes.items())
        ]
        slowest = [
            [stage, process, f"{seconds:.2f}", f"{start_s:.1f}"]
            for seconds, stage, process, start_s in sorted(self._slowest, reverse=True)
        ]
        parts = [
            "<!doctype html><html lang=en><meta charset=utf-8><title>Workers' time</title>",
            f"<style>{_STYLE}</style><h1>Workers' time</h1><p>{html.escape(summary)}</p>",
            *(["<p>No task was finished.</p>"] if not tasks else [self._chart(), self._rows()]),
            _table("Stages", ["stage", "tasks", "seconds", "mean s", "longest s"], stages),
            _table("Processes", ["process", "tasks", "seconds", "busy %", "peak MiB"], processes),
            _table("Longest tasks", ["stage", "process", "seconds", "began at s"], slowest),
            "<p>Seconds are wall-clock times measured by the tasks; each machine uses its own clock.</p>",
        ]
        return "\n".join(parts) + "\n"

    def _shown(self) -> int:
        """Number of bins that the run reached."""
        return max(1, min(BINS, int((self._ended_s - self._began_s) / self._bin_s) + 1))

    def _chart(self) -> str:
        """Busy processes over time, stages one on the other."""
        shown, most = self._shown(), max(1, len(self._processes))
        below = [0.0] * shown
        shapes, keys = [], []
        for k, (stage, bins) in enumerate(self._by_stage.items()):
            colour = _COLOURS[k % len(_COLOURS)]
            above = [low + busy / self._bin_s for low, busy in zip(below, bins[:shown], strict=True)]
            upper = [
                f"{_WIDTH * i / shown:.1f},{_y(v, most)} {_WIDTH * (i + 1) / shown:.1f},{_y(v, most)}"
                for i, v in enumerate(above)
            ]
            lower = [
                f"{_WIDTH * (i + 1) / shown:.1f},{_y(v, most)} {_WIDTH * i / shown:.1f},{_y(v, most)}"
                for i, v in enumerate(below)
            ]
            shapes.append(f'<polygon fill="{colour}" points="{" ".join([*upper, *reversed(lower)])}"/>')
            keys.append(f'<span class=key style="background:{colour}"></span>{html.escape(stage)}')
            below = above
        picture = _picture("busy processes over time", _HEIGHT, shapes)
        return f"<h2>Busy processes over time</h2><p>{''.join(keys)}</p>{picture}"

    def _rows(self) -> str:
        """One row per process: the darker, the busier."""
        shown = self._shown()
        cells = [
            f'<rect x="{_WIDTH * k / shown:.1f}" y="{_ROW * row}" width="{_WIDTH / shown + 0.2:.1f}" '
            f'height="{_ROW - 1}" fill="{_COLOURS[0]}" fill-opacity="{min(1.0, busy / self._bin_s):.2f}"/>'
            for row, (_, bins) in enumerate(sorted(self._by_process.items()))
            for k, busy in enumerate(bins[:shown])
            if busy > 0.0
        ]
        left = len(self._processes) - len(self._by_process)
        note = f"<p>{left} more processes have no row.</p>" if left else ""
        height = _ROW * len(self._by_process)
        picture = _picture("each process over time", height, cells)
        return f"<h2>Each process over time</h2>{picture}{note}"


def _picture(label: str, height: int, shapes: list[str]) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {height}" role=img aria-label="{label}">{"".join(shapes)}</svg>'


def _y(value: float, most: int) -> str:
    return f"{_HEIGHT * (1.0 - min(1.0, value / most)):.1f}"


def _table(title: str, header: list[str], rows: list[list[str]]) -> str:
    """A table; empty without rows."""
    if not rows:
        return ""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<h2>{html.escape(title)}</h2><table><tr>{head}</tr>{body}</table>"
