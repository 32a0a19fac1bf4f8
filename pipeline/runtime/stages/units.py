"""Units: a candidate in which several buildings touch becomes one candidate per unit, at the end of the join.

A task sees all points of its candidates, in whichever tiles they lie, so the outcome does not depend on the tiles. The
points of a divided candidate are stored again, sorted by unit, tile by tile: a range still lies in the tile it names.
"""

from __future__ import annotations

import dataclasses
import itertools
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.model import IntArray
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.scratch.kept_files import Files
from pipeline.runtime.scratch.outcomes import Place, drop_outcomes, key_of, whole
from pipeline.runtime.stages.gather import canonical_order, stored_bytes
from pipeline.runtime.stages.grouping import in_groups
from pipeline.runtime.stages.sites import (
    CandidateSite,
    Joined,
    PointRange,
    by_owner,
    folders_with_points,
    largest_first,
    object_id,
)
from pipeline.strip_alignment import strip_offsets_m
from pipeline.terrain.settings import UnitSettings
from pipeline.terrain.units import smallest_points, units_of
from pipeline.tiling import MM, Tile, TileGrid

_POINTS_PER_TASK = 50_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnitTask:
    """Some candidates for one task."""

    sites: tuple[CandidateSite, ...]
    """The candidates."""
    settings: UnitSettings
    """What separates units."""
    min_strip_offset_m: float
    """Strips of a candidate that disagree by more are aligned first."""
    grid: TileGrid
    """The lattice, for the owners."""
    scratch: Scratch
    """Holds the points, and gets those of the units."""
    crs_name: str
    """Goes into the ids."""


def divide_units(
    context: RunContext, settings: UnitSettings, min_strip_offset_m: float, joined: Joined, crs_name: str
) -> Joined:
    """The candidates, divided into units; part of the join and not a stage of its own."""
    if settings.split == "nothing":
        return joined
    scratch, grid, alike = context.scratch, context.plan.grid, key_of(settings, min_strip_offset_m, crs_name)
    tasks = {}
    for tile, candidates in by_owner(joined.candidates).items():
        for task in unit_tasks(candidates, settings, min_strip_offset_m, grid, scratch, crs_name):
            key = key_of(alike, task.sites, joined.around(task.sites, grid))
            tasks[Place("units", tile.key, key)] = task
    drop_outcomes(scratch, "units", tasks)
    files: Files[UnitTask, tuple[CandidateSite, ...]] = Files(reads=_read, leaves=_left, intact=is_intact)
    divided = context.map_stored("join", divide, tasks, whole, files=files, quiet=True)
    return dataclasses.replace(joined, candidates=largest_first(itertools.chain(*divided.values())))


def _read(task: UnitTask) -> set[str]:
    """The folders of scratch with the points of a task's candidates."""
    return folders_with_points(part for site in task.sites for part in site.ranges)


def _left(_: UnitTask, units: Sequence[CandidateSite]) -> set[str]:
    """The folders of scratch with the points of the units."""
    return folders_with_points(part for site in units if site.block is not None for part in site.ranges)


def is_intact(task: UnitTask, units: Sequence[CandidateSite], folder: str) -> bool:
    """Whether the points of the units below a folder of scratch are as they were stored."""
    return all(
        zlib.crc32(stored_bytes(task.scratch, part).data) == part.checksum
        for site in units
        for part in site.ranges
        if part.left_in == folder
    )


def unit_tasks(
    sites: Sequence[CandidateSite],
    settings: UnitSettings,
    min_strip_offset_m: float,
    grid: TileGrid,
    scratch: Scratch,
    crs_name: str,
) -> list[UnitTask]:
    """Group candidates to tasks of some tenths of a second each."""
    groups = in_groups(((site, site.points) for site in sites), _POINTS_PER_TASK)
    return [
        UnitTask(
            sites=tuple(group),
            settings=settings,
            min_strip_offset_m=min_strip_offset_m,
            grid=grid,
            scratch=scratch,
            crs_name=crs_name,
        )
        for group in groups
    ]


def divide(task: UnitTask) -> tuple[CandidateSite, ...]:
    """The units of some candidates; those that are one unit stay as they are."""
    found: list[CandidateSite] = []
    for site in task.sites:
        task.scratch.check_cancelled()
        found.extend(_units_of_site(site, task))
    return tuple(found)


def _aligned_mm(
    points: npt.NDArray[np.void], xyz_mm: tuple[IntArray, IntArray, IntArray], min_offset_m: float
) -> tuple[IntArray, IntArray, IntArray]:
    """Coordinates of the points with their strips aligned: a step between two strips does not separate units."""
    source = points["source"]
    if len(points) == 0 or (source == source[0]).all():
        return xyz_mm
    order = canonical_order(points)
    places = np.column_stack([values[order] - values[order[0]] for values in xyz_mm]) / MM
    offsets = np.empty_like(places)
    offsets[order] = strip_offsets_m(places, source[order], min_offset_m)
    moved = np.rint(offsets * MM).astype(np.int64)
    x, y, z = (values - moved[:, k] for k, values in enumerate(xyz_mm))
    return x, y, z


def _units_of_site(site: CandidateSite, task: UnitTask) -> list[CandidateSite]:
    by_tile: dict[Tile, list[npt.NDArray[np.void]]] = {}
    for part in site.ranges:
        stored = task.scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
        by_tile.setdefault(part.tile, []).append(np.array(stored[part.start : part.stop]))
    tiles = sorted(by_tile)
    pieces = [np.concatenate(by_tile[tile]) for tile in tiles]
    if not pieces:
        return [site]
    points = np.concatenate(pieces)
    x, y, z = points["x"].astype(np.int64), points["y"].astype(np.int64), points["z"].astype(np.int64)
    aligned = _aligned_mm(points, (x, y, z), task.min_strip_offset_m)
    unit = units_of(*aligned, task.settings, points["source"].astype(np.int64))
    count = int(unit.max(initial=0)) + 1
    if count == 1:
        return [site]
    firsts = smallest_points(x, y, z, unit)
    ranges: list[list[PointRange]] = [[] for _ in range(count)]
    folder = f"units/{site.building_id}"
    done = 0
    for tile, piece in zip(tiles, pieces, strict=True):
        own = unit[done : done + len(piece)]
        done += len(piece)
        by_unit = np.argsort(own, kind="stable")
        ordered = piece[by_unit]
        task.scratch.put_arrays(f"{folder}/{tile.key}", {"points": ordered.view(np.uint8)})
        borders = np.searchsorted(own[by_unit], np.arange(count + 1)).tolist()
        for k, (start, stop) in enumerate(itertools.pairwise(borders)):
            if start < stop:
                checksum = zlib.crc32(ordered[start:stop].view(np.uint8).data)
                ranges[k].append(PointRange(tile=tile, start=start, stop=stop, folder=folder, checksum=checksum))
    return [
        CandidateSite(
            building_id=object_id(task.crs_name, (int(x[first]), int(y[first]), int(z[first]))),
            owner=task.grid.tile_of(int(x[first]), int(y[first])),
            ranges=tuple(ranges[k]),
            points=sum(part.stop - part.start for part in ranges[k]),
            block=site.building_id,
        )
        for k, first in enumerate(firsts.tolist())
    ]
