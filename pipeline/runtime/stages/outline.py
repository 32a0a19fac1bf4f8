"""Outlines of touching units, drawn together: all units of a block, from all their points.

They are drawn before overrides are applied, so an override of one unit does not move its neighbours' walls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from shapely import MultiPolygon
from shapely.affinity import translate

from pipeline.errors import GableworkError
from pipeline.io.gps_time import GpsTimeKind
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.gather import canonical_order, gather, stored_points
from pipeline.runtime.stages.sites import CandidateSite
from pipeline.tiling import TileGrid


def outlined(
    sites: Sequence[CandidateSite], settings: RoofSettings, grid: TileGrid, scratch: Scratch
) -> tuple[list[CandidateSite], list[str]]:
    """Some sites, with all units of their blocks, and the outlines of these units; a warning per block without them.

    A block that cannot be drawn does not end the run: its units lose their common walls and are drawn one by one.
    Raises MemoryError or OSError if scratch cannot be read, or does not fit into memory.
    """
    blocks: dict[str, list[CandidateSite]] = {}
    for site in sites:
        if site.block is not None:
            blocks.setdefault(site.block, []).append(site)
    drawn: dict[str, MultiPolygon] = {}
    warnings = []
    for units in blocks.values():
        scratch.check_cancelled()
        try:
            drawn |= _drawn(units, settings, grid, scratch)
        except (MemoryError, OSError, GableworkError):
            raise
        except Exception as error:  # noqa: BLE001 - becomes a warning of the run
            names = ", ".join(sorted(site.building_id for site in units))
            warnings.append(
                f"the outlines of {names}, which touch, are drawn one by one: {type(error).__name__}: {error}"
            )
    return [dataclasses.replace(site, outline=drawn.get(site.building_id)) for site in sites], warnings


def _drawn(
    units: Sequence[CandidateSite], settings: RoofSettings, grid: TileGrid, scratch: Scratch
) -> dict[str, MultiPolygon]:
    """The outlines of the units of one block by their building_id, in metres of the CRS."""
    pieces = [stored_points(scratch, site) for site in units]
    points = np.concatenate(pieces)
    unit = np.repeat(np.arange(len(units), dtype=np.int32), [len(piece) for piece in pieces])
    whole = CandidateSite(
        building_id=units[0].block or "",
        owner=units[0].owner,
        ranges=tuple(part for site in units for part in site.ranges),
        points=len(points),
    )
    candidate, _ = gather(scratch, grid, whole, GpsTimeKind.NONE, settings if settings.at_walls else None)
    from pipeline.roof.unit_outlines import unit_outlines  # most tiles have no touching units

    outlines = unit_outlines(candidate, unit[canonical_order(points)], settings)
    return {
        site.building_id: translate(outline, candidate.origin[0], candidate.origin[1])
        for site, outline in zip(units, outlines, strict=True)
        if outline is not None
    }
