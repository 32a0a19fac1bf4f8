"""What a run is expected to cost, by its plan: the one place of measured rates.

Rates were measured by hand on two cores of a shared x86_64 machine: the stage times that `run.json` tells of serial
runs in one process, kernels compiled and loaded, so that wall time stands for CPU time; `docs/how_to/plan_a_run.md`
names the surveys. Machines and scenes differ by a factor of two either way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from pipeline.runtime.plan import Plan
from pipeline.tiling import MM, Tile, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rates:
    """Measured on real tiles; docs/how_to/plan_a_run.md tells how."""

    start_s: float = 1.5
    """Wall seconds before the first point is read: libraries, kernels, child processes."""
    cluster_start_s: float = 3.0
    """Wall seconds that an embedded cluster takes to start and to end, on top."""
    ingest_per_million: float = 0.5
    """CPU seconds a million points."""
    split_per_million: float = 1.0
    """A million points of windows, halos and all."""
    join_per_million: float = 0.3
    """A million points; the driver's own, not shared among workers."""
    reconstruct_each: float = 0.017
    """A building, its outline included."""
    publish_each: float = 0.003
    """A building."""
    buildings_per_million: float = 300.0
    """To be expected in a million points where nothing else tells."""
    compiling_s: float = 45.0
    """Wall seconds of the first run, which compiles the kernels that it calls, over those of the next."""
    process_gib: float = 0.3
    """Memory of a process with its libraries and kernels; the largest task of the plan comes on top."""


RATES = Rates()
"""The measured rates."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Expected:
    """What a run has to do, by the headers of its inputs."""

    points_by_file: Mapping[str, int]
    """Points in the window that is wanted, as if those of a file were spread evenly over its bounds; without the files
    that lie off it."""
    tiles: int
    """Of the lattice, that these meet."""
    seen_points: float
    """Points of the tiles' windows, halos and all."""
    buildings: int
    """How many."""
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
            "split": self.seen_points / 1e6 * RATES.split_per_million,
            "join": millions * RATES.join_per_million,
            "reconstruct": self.buildings * RATES.reconstruct_each,
            "publish": self.buildings * RATES.publish_each,
        }

    def wall_s(self, hands: int) -> dict[str, float]:
        """Wall seconds by stage where so many processes work."""
        at_once = {"ingest": len(self.points_by_file), "split": self.tiles, "join": 1, "publish": self.tiles}
        return {
            stage: seconds / max(1, min(hands, at_once.get(stage, hands))) for stage, seconds in self.cpu_s().items()
        }


def expected(plan: Plan, buildings: int | None = None) -> Expected:
    """What a plan has to do.

    Parameters
    ----------
    plan : Plan
        Its files and its lattice.
    buildings : int, optional
        How many there will be; by default as many as so many points hold as a rule.
    """
    tiles: set[Tile] = set()
    points: dict[str, int] = {}
    for info in plan.sources:
        x_min, y_min, _, x_max, y_max, _ = info.bounds_m
        left, bottom, right, top = x_min, y_min, x_max, y_max
        if plan.options.window is not None:
            unit = info.reference.horizontal_unit_m
            window = plan.options.window
            left, bottom = max(left, window.x_min * unit), max(bottom, window.y_min * unit)
            right, top = min(right, window.x_max * unit), min(top, window.y_max * unit)
        if left > right or bottom > top:
            continue
        whole = (x_max - x_min) * (y_max - y_min)
        points[info.path] = round(info.point_count * ((right - left) * (top - bottom) / whole if whole > 0.0 else 1.0))
        x0, y0, x1, y1 = (round(value * MM) for value in (left, bottom, right, top))
        tiles.update(plan.grid.tiles_over(Window(x0_mm=x0, y0_mm=y0, x1_mm=x1 + 1, y1_mm=y1 + 1)))
    total = sum(points.values())
    side = plan.grid.size_mm / MM
    halo_share = ((side + 2.0 * plan.grid.halo_mm / MM) / side) ** 2
    return Expected(
        points_by_file=points,
        tiles=len(tiles),
        # tiles at the edge of the data see less: no window sees more than there is
        seen_points=total * min(halo_share, max(1.0, len(tiles))),
        buildings=round(total / 1e6 * RATES.buildings_per_million) if buildings is None else buildings,
        task_bytes=plan.window_bytes,
    )
