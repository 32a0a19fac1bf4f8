"""The results of a run, shown to people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipeline.console import Console
from pipeline.runtime.isolation.preloading import has_idle_child

if TYPE_CHECKING:
    from pipeline.runtime.run import RunSummary


def _statistics_of(run_dir: str) -> dict[str, Any]:
    """The figures of a run, read by a child of the run if there is one: it has loaded Arrow, which takes longer."""
    if has_idle_child():
        from pipeline.runtime.cluster.local_executor import LocalExecutor
        from pipeline.runtime.cluster.serial_executor import run_alone

        return run_alone(LocalExecutor(1), "report", _read_statistics, run_dir)
    return _read_statistics(run_dir)


def _read_statistics(run_dir: str) -> dict[str, Any]:
    from pipeline.report.statistics import run_statistics

    return run_statistics(run_dir)


def show_statistics(console: Console, statistics: Mapping[str, Any]) -> None:
    """The figures of a run as tables."""
    from pipeline.report.table import statistics_tables

    for table in statistics_tables(statistics):
        console.table(table.title, table.header, table.rows)


def show_summary(console: Console, summary: RunSummary) -> None:
    """The results of a run, as tables."""
    if summary.headline:
        console.say_first(summary.headline)
    show_statistics(console, _statistics_of(summary.run_dir))
    console.table(
        "Time", ["stage", "wall clock"], [(k, f"{seconds:.1f} s") for k, seconds in summary.timings_s.items()]
    )
    points, tiles = summary.counts["points"], summary.counts["tiles"]
    largest = max(summary.peak_memory_bytes.values(), default=0) / 2**30
    console.say(f"{points} points, tiles: {tiles}, peak memory of a process: {largest:.2f} GiB")
    for tile in summary.failed_tiles:
        console.warn(f"tile {tile} failed")
    for tile in summary.tiles_without_points:
        console.warn(f"tile {tile} has no points")
    for tile in summary.tiles_without_terrain:
        console.warn(f"tile {tile} has no terrain")
    console.say(f"content sha256 {summary.digest}")
    console.say(f"results are in {summary.run_dir}")
