"""Units: a candidate in which several buildings touch becomes one candidate a unit, between join and reconstruct.

A task sees all points of its candidates, whichever tiles they lie in, so the outcome does not depend on the tiles. The
points of a divided candidate are stored again, sorted by unit, tile by tile: a range still lies in the tile it names.
The outline is drawn here too, around all units at once: they share their walls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from shapely import MultiPolygon
from shapely.affinity import translate

from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import LabelArray
from pipeline.roof.settings import RoofSettings
from pipeline.roof.unit_outlines import unit_outlines
from pipeline.runtime.gather import canonical_order, gather
from pipeline.runtime.join import CandidateSite, PointRange, object_id
from pipeline.runtime.scratch import POINT, Scratch
from pipeline.terrain.units import UnitSettings, units_of
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_TASK = 200_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnitTask:
    """Some candidates for one task."""

    sites: tuple[CandidateSite, ...]
    """The candidates."""
    settings: UnitSettings
    """What separates units."""
    roof: RoofSettings
    """How outlines are drawn."""
    grid: TileGrid
    """The lattice, for the owners."""
    scratch: Scratch
    """Where the points are, and where those of units go."""
    crs_name: str
    """Goes into the ids."""


def unit_tasks(
    sites: Sequence[CandidateSite],
    settings: UnitSettings,
    roof: RoofSettings,
    grid: TileGrid,
    scratch: Scratch,
    crs_name: str,
) -> list[UnitTask]:
    """Group candidates to tasks of some tenths of a second each."""
    groups: list[list[CandidateSite]] = []
    points = 0
    for site in sites:
        if not groups or points + site.points > _POINTS_PER_TASK:
            groups.append([])
            points = 0
        groups[-1].append(site)
        points += site.points
    return [
        UnitTask(sites=tuple(group), settings=settings, roof=roof, grid=grid, scratch=scratch, crs_name=crs_name)
        for group in groups
    ]


def divide(task: UnitTask) -> tuple[CandidateSite, ...]:
    """The units of some candidates; those that are one unit stay as they are.

    Raises
    ------
    RunCancelledError
        The run was called off.
    """
    found: list[CandidateSite] = []
    for site in task.sites:
        task.scratch.check_cancelled()
        found.extend(_units_of_site(site, task))
    return tuple(found)


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
    unit = units_of(x, y, z, task.settings)
    count = int(unit.max(initial=0)) + 1
    if count == 1:
        return [site]
    outlines = _outlines(site, unit[canonical_order(points)], task)
    order = np.lexsort((z, y, x, unit))
    firsts = order[np.searchsorted(unit[order], np.arange(count))]
    ranges: list[list[PointRange]] = [[] for _ in range(count)]
    folder = f"units/{site.building_id}"
    start = 0
    for tile, piece in zip(tiles, pieces, strict=True):
        own = unit[start : start + len(piece)]
        start += len(piece)
        by_unit = np.argsort(own, kind="stable")
        task.scratch.put_arrays(f"{folder}/{tile.key}", {"points": piece[by_unit].view(np.uint8)})
        borders = np.searchsorted(own[by_unit], np.arange(count + 1)).tolist()
        for k in range(count):
            if borders[k] < borders[k + 1]:
                ranges[k].append(PointRange(tile=tile, start=borders[k], stop=borders[k + 1], folder=folder))
    return [
        CandidateSite(
            building_id=object_id(task.crs_name, (int(x[first]), int(y[first]), int(z[first]))),
            owner=task.grid.tile_of(int(x[first]), int(y[first])),
            ranges=tuple(ranges[k]),
            points=sum(part.stop - part.start for part in ranges[k]),
            outline=outlines[k],
        )
        for k, first in enumerate(firsts.tolist())
    ]


def _outlines(site: CandidateSite, units: LabelArray, task: UnitTask) -> list[MultiPolygon | None]:
    """The outlines of a candidate's units in metres of the CRS; `units` in the canonical order of its points."""
    candidate, _ = gather(task.scratch, task.grid, site, GpsTimeKind.NONE)
    drawn = unit_outlines(candidate, units, task.roof)
    return [None if one is None else translate(one, candidate.origin[0], candidate.origin[1]) for one in drawn]
