"""The expected cost of a run, from its plan; the only place for measured rates.

The rates are stage times in `run.json` of serial runs, on two cores of a shared x86_64 machine, with kernels compiled
and loaded, so wall time equals CPU time; `docs/how_to/plan_a_run.md` names the surveys. Machines and scenes differ by a
factor of two either way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from pipeline.runtime.plan import Plan, shares_of, wanted_bounds_m, wanted_points
from pipeline.tiling import MM, Tile, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rates:
    """Rates measured on real tiles, as docs/how_to/plan_a_run.md describes."""

    start_s: float = 1.5
    """Wall seconds before the first point is read: libraries, kernels, child processes."""
    cluster_start_s: float = 3.0
    """Additional wall seconds to start and end an embedded cluster."""
    ingest_per_million: float = 0.5
    """CPU seconds per million points."""
    cells_per_million: float = 0.1
    """CPU seconds per million points."""
    ground_per_km2: float = 2.0
    """CPU seconds per square kilometre of tiles."""
    split_per_million: float = 1.0
    """CPU seconds per million points of windows, halos included."""
    join_per_million: float = 0.3
    """CPU seconds per million points, spent by the driver and not shared among workers."""
    reconstruct_each: float = 0.017
    """CPU seconds per building, its outline included."""
    publish_each: float = 0.003
    """CPU seconds per building."""
    buildings_per_million: float = 300.0
    """Buildings per million points where no better estimate exists."""
    compiling_s: float = 45.0
    """Additional wall seconds of the first run, which compiles its kernels."""
    process_gib: float = 0.3
    """Memory of a process with its libraries and kernels, without the largest task of the plan."""


RATES = Rates()
"""The measured rates."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Expected:
    """The work of a run, estimated from the headers of its inputs."""

    points_by_file: Mapping[str, int]
    """Points in the requested window, as if those of a file were spread evenly over its bounds; without the files off
    the window."""
    tiles: int
    """Tiles of the lattice that these files meet."""
    readers: int = 1
    """Tasks that read the files."""
    seen_points: float
    """Points of the tiles' windows, halos included."""
    buildings: int
    """Number of buildings."""
    area_km2: float = 0.0
    """Area of the tiles."""
    task_bytes: int = 0
    """Memory of its largest task, above the process's own size."""
    models: bool = True
    """Whether buildings are modelled."""

    @property
    def points(self) -> int:
        """Points of all files."""
        return sum(self.points_by_file.values())

    def cpu_s(self) -> dict[str, float]:
        """CPU seconds by stage."""
        millions = self.points / 1e6
        return {
            "ingest": millions * RATES.ingest_per_million,
            "cells": millions * RATES.cells_per_million,
            "ground": self.area_km2 * RATES.ground_per_km2,
            "split": self.seen_points / 1e6 * RATES.split_per_million,
            "join": millions * RATES.join_per_million,
            "reconstruct": self.buildings * RATES.reconstruct_each,
            "publish": self.buildings * RATES.publish_each,
        }

    def wall_s(self, hands: int) -> dict[str, float]:
        """Wall seconds by stage with so many processes."""
        at_once = {"ingest": self.readers, "join": 1, "ground": max(1, round(self.area_km2))}
        at_once |= dict.fromkeys(("cells", "split", "publish"), self.tiles)
        return {
            stage: seconds / max(1, min(hands, at_once.get(stage, hands))) for stage, seconds in self.cpu_s().items()
        }


def expected(plan: Plan, buildings: int | None = None) -> Expected:
    """The work of a plan; by default with as many buildings as so many points usually have."""
    tiles: set[Tile] = set()
    points: dict[str, int] = {}
    readers = 0
    for info in plan.sources:
        box = wanted_bounds_m(info, plan.options)
        if box is None:
            continue
        points[info.path] = wanted_points(info, plan.options)
        readers += len(shares_of(info, plan.options))
        x0, y0, x1, y1 = (round(value * MM) for value in box)
        tiles.update(plan.grid.tiles_over(Window(x0_mm=x0, y0_mm=y0, x1_mm=x1 + 1, y1_mm=y1 + 1)))
    total = sum(points.values())
    side = plan.grid.size_mm / MM
    halo_share = ((side + 2.0 * plan.grid.halo_mm / MM) / side) ** 2
    return Expected(
        points_by_file=points,
        readers=readers,
        tiles=len(tiles),
        # tiles at the edge of the data see less, and no window sees more points than there are
        seen_points=total * min(halo_share, max(1.0, len(tiles))),
        area_km2=len(tiles) * side**2 / 1e6,
        buildings=round(total / 1e6 * RATES.buildings_per_million) if buildings is None else buildings,
        task_bytes=plan.window_bytes,
    )
