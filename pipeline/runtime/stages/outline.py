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

from pipeline.errors import GableworkError
from pipeline.io.gps_time import GpsTimeKind
from pipeline.roof.settings import RoofSettings
from pipeline.roof.unit_outlines import unit_outlines
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.gather import canonical_order, gather, stored_points
from pipeline.runtime.stages.grouping import in_groups
from pipeline.runtime.stages.join import CandidateSite
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
    """Group the blocks of several units to tasks of some tenths of a second each, the largest blocks first.

    Raw outlines are drawn one by one: then there is no task.
    """
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
    """By the units' building_id, in metres of the CRS; without those that could not be drawn."""
    warnings: tuple[str, ...]
    """One of each block at which drawing stumbled over a fault of its own."""


def draw_outlines(task: OutlineTask) -> DrawnOutlines:
    """Draw the outlines of the units of some blocks.

    A block that cannot be drawn costs its units the common walls, not the run: they are drawn one by one.

    Raises
    ------
    RunCancelledError
        The run was called off.
    MemoryError, OSError
        Scratch cannot be read, or not held.
    """
    drawn: dict[str, MultiPolygon] = {}
    warnings = []
    for units in task.blocks:
        task.scratch.check_cancelled()
        try:
            drawn |= _drawn(task, units)
        except (MemoryError, OSError, GableworkError):
            raise
        except Exception as error:  # noqa: BLE001 - told in the run's warnings
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
    candidate, _ = gather(task.scratch, task.grid, whole, GpsTimeKind.NONE, beside=task.settings.at_walls)
    outlines = unit_outlines(candidate, unit[canonical_order(points)], task.settings)
    return {
        site.building_id: translate(outline, candidate.origin[0], candidate.origin[1])
        for site, outline in zip(units, outlines, strict=True)
        if outline is not None
    }
