"""Outlines of touching units, drawn together: a task draws some blocks from all points of all their units.

A stage between join and reconstruct. It runs before overrides are applied, so an override of one unit does not move its
neighbours' walls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from shapely import MultiPolygon
from shapely.affinity import translate

from pipeline.errors import GableworkError
from pipeline.io.gps_time import GpsTimeKind
from pipeline.roof.settings import RoofSettings
from pipeline.roof.unit_outlines import unit_outlines
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import OpenScratch, Scratch
from pipeline.runtime.scratch.kept_files import Files
from pipeline.runtime.scratch.outcomes import Place, drop_outcomes, key_of, whole
from pipeline.runtime.stages.gather import canonical_order, gather, stored_points
from pipeline.runtime.stages.grouping import in_groups
from pipeline.runtime.stages.sites import CandidateSite, Joined, folders_around
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_TASK = 50_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutlineTask:
    """Some blocks for one task."""

    blocks: tuple[tuple[CandidateSite, ...], ...]
    """The units of each."""
    settings: RoofSettings
    """How outlines are drawn."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Holds points and terrain."""


def outline(context: RunContext, settings: RoofSettings, joined: Joined) -> Joined:
    """The candidates with the outlines of touching units, drawn together."""
    scratch, grid, alike = context.scratch, context.plan.grid, key_of(settings)
    tasks = {}
    for tile, units in _blocks_by_tile(joined.candidates).items():
        for task in outline_tasks(units, settings, grid, scratch):
            sites = [site for block in task.blocks for site in block]
            tasks[Place("outline", tile.key, key_of(alike, task.blocks, joined.around(sites, grid)))] = task
    drop_outcomes(scratch, "outline", tasks)
    files: Files[OutlineTask, DrawnOutlines] = Files(reads=_read)
    drawn = context.map_stored("outline", draw_outlines, tasks, whole, files=files)
    outlines: dict[str, MultiPolygon] = {}
    for found in drawn.values():
        outlines |= found.outlines
    for warning in sorted(warning for found in drawn.values() for warning in found.warnings):
        context.progress.warn("outline", warning)
    outlined = (
        dataclasses.replace(site, outline=outlines.get(site.building_id)) if site.block is not None else site
        for site in joined.candidates
    )
    return dataclasses.replace(joined, candidates=tuple(outlined))


def _read(task: OutlineTask) -> set[str]:
    """The folders of scratch from which the units of a task are gathered."""
    return folders_around([site for block in task.blocks for site in block], task.grid)


def _blocks_by_tile(sites: Sequence[CandidateSite]) -> dict[Tile, list[CandidateSite]]:
    """Units by the first of the tiles that own some of their block, in their order."""
    home: dict[str, Tile] = {}
    for site in sites:
        if site.block is not None:
            home[site.block] = min(home.get(site.block, site.owner), site.owner)
    found: dict[Tile, list[CandidateSite]] = {}
    for site in sites:
        if site.block is not None:
            found.setdefault(home[site.block], []).append(site)
    return found


def outline_tasks(
    sites: Sequence[CandidateSite], settings: RoofSettings, grid: TileGrid, scratch: Scratch
) -> list[OutlineTask]:
    """Tasks of some tenths of a second each, the largest blocks first; none where outlines are drawn one by one."""
    if not settings.straight_eaves:
        return []
    blocks: dict[str, list[CandidateSite]] = {}
    for site in sites:
        if site.block is not None:
            blocks.setdefault(site.block, []).append(site)
    sized = [(sum(site.points for site in units), name) for name, units in blocks.items()]
    largest_first = sorted(sized, key=lambda entry: (-entry[0], entry[1]))
    groups = in_groups(((tuple(blocks[name]), size) for size, name in largest_first), _POINTS_PER_TASK)
    return [OutlineTask(blocks=tuple(group), settings=settings, grid=grid, scratch=scratch) for group in groups]


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnOutlines:
    """What a task drew."""

    outlines: dict[str, MultiPolygon]
    """By the units' building_id, in metres of the CRS; those that could not be drawn are missing."""
    warnings: tuple[str, ...]
    """One per block that could not be drawn because of a fault in the program."""


def draw_outlines(task: OutlineTask) -> DrawnOutlines:
    """Draw the outlines of the units of some blocks.

    A block that cannot be drawn does not end the run: its units lose their common walls and are drawn one by one.
    Raises MemoryError or OSError if scratch cannot be read, or does not fit into memory.
    """
    drawn: dict[str, MultiPolygon] = {}
    warnings = []
    task = dataclasses.replace(task, scratch=OpenScratch(task.scratch.root, task.scratch.attempt))
    for units in task.blocks:
        task.scratch.check_cancelled()
        try:
            drawn |= _drawn(task, units)
        except (MemoryError, OSError, GableworkError):
            raise
        except Exception as error:  # noqa: BLE001 - becomes a warning of the run
            names = ", ".join(sorted(site.building_id for site in units))
            warnings.append(
                f"the outlines of {names}, which touch, are drawn one by one: {type(error).__name__}: {error}"
            )
    return DrawnOutlines(outlines=drawn, warnings=tuple(warnings))


def _drawn(task: OutlineTask, units: Sequence[CandidateSite]) -> dict[str, MultiPolygon]:
    """The outlines of the units of one block by their building_id."""
    pieces = [stored_points(task.scratch, site) for site in units]
    points = np.concatenate(pieces)
    unit = np.repeat(np.arange(len(units), dtype=np.int32), [len(piece) for piece in pieces])
    whole = CandidateSite(
        building_id=units[0].block or "",
        owner=units[0].owner,
        ranges=tuple(part for site in units for part in site.ranges),
        points=len(points),
    )
    facades = task.settings if task.settings.at_walls else None
    candidate, _ = gather(task.scratch, task.grid, whole, GpsTimeKind.NONE, facades)
    outlines = unit_outlines(candidate, unit[canonical_order(points)], task.settings)
    return {
        site.building_id: translate(outline, candidate.origin[0], candidate.origin[1])
        for site, outline in zip(units, outlines, strict=True)
        if outline is not None
    }
