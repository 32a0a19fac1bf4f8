"""The expected cost of a run, from its plan; the only place for measured rates.

The rates are CPU seconds on two cores of an x86_64 machine, with kernels compiled and loaded. Machines and scenes
differ from them by a factor of two and more either way. `pipeline.runtime.sample` measures by how much, stage by stage,
on the machine and the inputs at hand. `docs/how_to/plan_a_run.md` has the measurements.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping

from pipeline.runtime.run_plan import Plan, shares_of, tiles_per_block, wanted_bounds_m, wanted_points
from pipeline.tiling import MM, Tile, TileGrid, Window

_GROUND_REACH_M = 205.0
"""How far a block of the ground stage looks, about; `docs/architecture.md`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rates:
    """Rates measured on real and simulated tiles, as docs/how_to/plan_a_run.md describes."""

    start_s: float = 1.5
    """Wall seconds before the first point is read: libraries, kernels, child processes."""
    cluster_start_s: float = 3.0
    """Additional wall seconds to start and end an embedded cluster."""
    ingest_per_million: float = 0.45
    """CPU seconds per million points that are read."""
    cells_per_million: float = 0.1
    """CPU seconds per million points."""
    ground_per_km2: float = 0.65
    """CPU seconds per square kilometre with points that its blocks see."""
    ground_empty: float = 0.38
    """Cost of cells without points in a block's rectangle, as a share of the cost of cells with points."""
    split_per_million: float = 1.2
    """CPU seconds per million points."""
    split_halo: float = 0.5
    """Cost of a point in the halo of a tile, as a share of the cost of its own points."""
    join_each: float = 0.00002
    """CPU seconds per building, mostly spent by one process."""
    units_per_million: float = 0.4
    """CPU seconds per million points."""
    outline_each: float = 0.002
    """CPU seconds per building."""
    reconstruct_each: float = 0.010
    """CPU seconds per building."""
    publish_tile: float = 0.05
    """CPU seconds per tile."""
    publish_each: float = 0.002
    """CPU seconds per building."""
    octree_per_million: float = 2.0
    """CPU seconds per million points that are written over the models."""
    digest_s: float = 0.015
    """CPU seconds per run, spent by one process."""
    digest_each: float = 0.00003
    """CPU seconds per building, spent by one process."""
    buildings_per_km2: float = 1500.0
    """Buildings where no better estimate exists."""
    points_per_building: float = 100.0
    """The least points per building on average, where no better estimate exists."""
    other_methods: float = 2.0
    """Cost of modelling by other methods than the default one, as a multiple of its own."""
    process_gib: float = 0.3
    """Memory that a process may need with its libraries and kernels, without the largest task of the plan."""
    kernels_gib: float = 0.18
    """Memory of a process with libraries and kernels, as measured."""
    tables_gib: float = 0.05
    """Memory that a process takes to write tables; twice that where it does everything alone."""
    driver_gib: float = 0.15
    """Memory of a command whose children do all work."""
    cluster_driver_gib: float = 0.32
    """Memory of a command with an embedded cluster."""
    split_bytes: float = 130.0
    """Memory per point of a tile's window; twice that where points are written over the models."""
    ground_bytes: float = 130e6
    """Memory per square kilometre that a block of the ground sees."""


RATES = Rates()
"""The measured rates."""
_ALONE = ("join", "digest")
"""Stages that one process does."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Expected:
    """The work of a run, estimated from the headers of its inputs."""

    points_by_file: Mapping[str, int]
    """Points in the requested window, as if those of a file were spread evenly over its bounds; without the files off
    the window."""
    read_points: int | None = None
    """Points that are read; those in the window by default."""
    tiles: int
    """Tiles of the lattice that these files meet."""
    readers: int = 1
    """Tasks that read the files."""
    seen_points: float
    """Points of the tiles' windows by the cost of their split; those of halos count less."""
    buildings: int
    """Number of buildings."""
    ground_km2: tuple[float, ...] = ()
    """Area of each block of the ground stage and its surroundings; cells without points count less."""
    window_points: float = 0.0
    """Points of the largest window of a tile."""
    task_bytes: int = 0
    """Memory of its largest task, above the process's own size."""
    models: bool = True
    """Whether buildings are modelled."""
    octree: bool = False
    """Whether points are written over the models."""
    pace: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """By stage, the seconds measured in a sample over those by the rates; 1 where nothing was measured."""

    @property
    def points(self) -> int:
        """Points of all files."""
        return sum(self.points_by_file.values())

    def cpu_s(self) -> dict[str, float]:
        """CPU seconds by stage; `units` are a part of the stage `outline`."""
        millions = self.points / 1e6
        read = millions if self.read_points is None else self.read_points / 1e6
        by_rates = {
            "ingest": read * RATES.ingest_per_million,
            "cells": millions * RATES.cells_per_million,
            "ground": sum(self.ground_km2) * RATES.ground_per_km2,
            "split": self.seen_points / 1e6 * RATES.split_per_million,
            "join": self.buildings * RATES.join_each,
            "units": millions * RATES.units_per_million,
            "outline": self.buildings * RATES.outline_each,
            "reconstruct": self.buildings * RATES.reconstruct_each,
            "publish": self.tiles * RATES.publish_tile + self.buildings * RATES.publish_each,
            "octree": millions * RATES.octree_per_million if self.octree else 0.0,
            "digest": RATES.digest_s + self.buildings * RATES.digest_each,
        }
        return {stage: seconds * self.pace.get(stage, 1.0) for stage, seconds in by_rates.items()}

    def wall_s(self, hands: int) -> dict[str, float]:
        """Wall seconds by stage with so many processes."""
        at_once = dict.fromkeys(("cells", "split", "publish", "octree"), float(self.tiles)) | dict.fromkeys(_ALONE, 1.0)
        at_once["ingest"] = self.readers
        if self.ground_km2:
            at_once["ground"] = sum(self.ground_km2) / max(self.ground_km2)
        wall = {
            stage: seconds / max(1.0, min(hands, at_once.get(stage, hands))) for stage, seconds in self.cpu_s().items()
        }
        wall["outline"] += wall.pop("units")
        return wall

    def process_bytes(self, *, alone: bool) -> int:
        """Peak memory of the largest process that works, of several or `alone`."""
        tables_bytes = RATES.tables_gib * 2**30 * (2.0 if alone else 1.0)
        ground_bytes = max(self.ground_km2, default=0.0) * RATES.ground_bytes
        window_bytes = self.window_points * RATES.split_bytes * (2.0 if self.octree else 1.0)
        largest = max(ground_bytes, window_bytes + tables_bytes)
        return round(RATES.kernels_gib * 2**30 + largest)


def expected(plan: Plan, buildings: int | None = None) -> Expected:
    """The work of a plan; by default with as many buildings as its area usually has."""
    grid, options = plan.grid, plan.options
    points: dict[str, int] = {}
    boxes: list[tuple[Window, float]] = []
    readers = read = 0
    for info in plan.sources:
        box = wanted_bounds_m(info, options)
        if box is None:
            continue
        points[info.path] = wanted_points(info, options)
        # only of COPC is less than all of it read
        read += points[info.path] if info.format == "copc" else info.point_count
        readers += len(shares_of(info, options))
        x0, y0, x1, y1 = (round(value * MM) for value in box)
        window = Window(x0_mm=x0, y0_mm=y0, x1_mm=x1 + 1, y1_mm=y1 + 1)
        boxes.append((window, points[info.path] / _area_km2(window)))
    tiles = {tile for window, _ in boxes for tile in grid.tiles_over(window)}
    total = sum(points.values())
    area_km2 = min(sum(_area_km2(window) for window, _ in boxes), len(tiles) * (grid.size_mm / MM / 1000.0) ** 2)
    if buildings is None:
        buildings = round(min(area_km2 * RATES.buildings_per_km2, total / RATES.points_per_building))
    seen = _seen_points(grid, tiles, boxes)
    return Expected(
        points_by_file=points,
        read_points=read,
        readers=readers,
        tiles=len(tiles),
        seen_points=total + RATES.split_halo * max(0.0, sum(seen.values()) - total),
        window_points=max(seen.values(), default=0.0),
        ground_km2=_blocks_km2(grid, tiles, filled_cells(total, area_km2)),
        buildings=buildings,
        task_bytes=plan.window_bytes,
    )


def _area_km2(window: Window) -> float:
    return (window.x1_mm - window.x0_mm) * (window.y1_mm - window.y0_mm) / (1000.0 * MM) ** 2


def _common_km2(one: Window, other: Window) -> float:
    """Area of two windows' intersection."""
    width = min(one.x1_mm, other.x1_mm) - max(one.x0_mm, other.x0_mm)
    depth = min(one.y1_mm, other.y1_mm) - max(one.y0_mm, other.y0_mm)
    return max(0, width) * max(0, depth) / (1000.0 * MM) ** 2


def _seen_points(grid: TileGrid, tiles: set[Tile], boxes: Iterable[tuple[Window, float]]) -> dict[Tile, float]:
    """Points that the window of each tile sees, from the bounds of files and their points per square kilometre."""
    seen = dict.fromkeys(tiles, 0.0)
    for box, per_km2 in boxes:
        for tile in grid.tiles_over(box.grown(grid.halo_mm)):
            if tile in tiles:
                seen[tile] += per_km2 * _common_km2(grid.window(tile), box)
    return seen


def filled_cells(points: float, area_km2: float) -> float:
    """Share of cells of 1 m that hold a point, if points are spread evenly.

    >>> [round(filled_cells(density * 1e6, 1.0), 2) for density in (0.06, 0.3, 5.0)]
    [0.06, 0.26, 0.99]
    """
    return 1.0 - math.exp(-points / (area_km2 * 1e6)) if area_km2 > 0.0 else 0.0


def _blocks_km2(grid: TileGrid, tiles: set[Tile], filled: float) -> tuple[float, ...]:
    """The area that each block of the ground stage sees, by its cost."""
    side = tiles_per_block(grid.size_mm)
    blocks: dict[tuple[int, int], list[Tile]] = {}
    for tile in tiles:
        blocks.setdefault((tile.column // side, tile.row // side), []).append(tile)
    areas = []
    for own in blocks.values():
        first = grid.core(Tile(min(tile.column for tile in own), min(tile.row for tile in own)))
        last = grid.core(Tile(max(tile.column for tile in own), max(tile.row for tile in own)))
        whole = Window(x0_mm=first.x0_mm, y0_mm=first.y0_mm, x1_mm=last.x1_mm, y1_mm=last.y1_mm)
        around = whole.grown(round(_GROUND_REACH_M * MM))
        held = sum(_common_km2(around, grid.core(tile)) for tile in grid.tiles_over(around) if tile in tiles)
        areas.append(block_km2(filled * held, _area_km2(around)))
    return tuple(areas)


def block_km2(filled: float, whole: float) -> float:
    """The area of a block of the ground stage by its cost, from the part of it with points.

    >>> block_km2(1.0, 2.0)
    1.38
    """
    return filled + RATES.ground_empty * (whole - filled)


def around_km2(side_m: float) -> float:
    """The area that the ground stage sees if it is asked for a square, in all directions.

    >>> round(around_km2(590.0), 2)
    1.0
    """
    return ((side_m + 2.0 * _GROUND_REACH_M) / 1000.0) ** 2
