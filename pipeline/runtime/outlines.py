"""Outlines of touching units, drawn together: one task draws some blocks, of all points of all their units.

A stage between join and reconstruct. What a user says of one unit does not move its neighbours' walls: blocks are drawn
before overrides are applied.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from shapely import MultiPolygon
from shapely.affinity import translate

from pipeline.io.gps_time import GpsTimeKind
from pipeline.roof.settings import RoofSettings
from pipeline.roof.unit_outlines import unit_outlines
from pipeline.runtime.gather import canonical_order, gather, stored_points
from pipeline.runtime.join import CandidateSite
from pipeline.runtime.scratch import Scratch
from pipeline.tiling import TileGrid

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
    """Where points and terrain are."""


def outline_tasks(
    sites: Sequence[CandidateSite], settings: RoofSettings, grid: TileGrid, scratch: Scratch
) -> list[OutlineTask]:
    """Group the blocks of several units to tasks of some tenths of a second each, the largest blocks first."""
    blocks: dict[str, list[CandidateSite]] = {}
    for site in sites:
        if site.block is not None:
            blocks.setdefault(site.block, []).append(site)
    sized = [(sum(site.points for site in units), name) for name, units in blocks.items()]
    groups: list[list[tuple[CandidateSite, ...]]] = []
    points = 0
    for size, name in sorted(sized, key=lambda entry: (-entry[0], entry[1])):
        if not groups or points + size > _POINTS_PER_TASK:
            groups.append([])
            points = 0
        groups[-1].append(tuple(blocks[name]))
        points += size
    return [OutlineTask(blocks=tuple(group), settings=settings, grid=grid, scratch=scratch) for group in groups]


def draw_outlines(task: OutlineTask) -> dict[str, MultiPolygon]:
    """The outlines of units by their building_id, in metres of the CRS; without those that could not be drawn.

    Raises
    ------
    RunCancelledError
        The run was called off.
    """
    drawn: dict[str, MultiPolygon] = {}
    for units in task.blocks:
        task.scratch.check_cancelled()
        pieces = [stored_points(task.scratch, site) for site in units]
        points = np.concatenate(pieces)
        unit = np.repeat(np.arange(len(units), dtype=np.int32), [len(piece) for piece in pieces])
        whole = CandidateSite(
            building_id=units[0].block or "",
            owner=units[0].owner,
            ranges=tuple(part for site in units for part in site.ranges),
            points=len(points),
        )
        candidate, _ = gather(task.scratch, task.grid, whole, GpsTimeKind.NONE, beside=task.settings.at_walls)
        outlines = unit_outlines(candidate, unit[canonical_order(points)], task.settings)
        for site, outline in zip(units, outlines, strict=True):
            if outline is not None:
                drawn[site.building_id] = translate(outline, candidate.origin[0], candidate.origin[1])
    return drawn
