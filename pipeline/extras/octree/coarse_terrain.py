"""The terrain of a run as one coarse lattice beside its points, for viewers: a city needs no cell of a metre.

The nodes of the lattice are cells of the 1 m terrain whose column and row, counted from the CRS's origin, are multiples
of the spacing. Each tile gives those in its core, so for one spacing the result does not depend on the tiles.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Iterable

import numpy as np

from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.window_points import surroundings_of
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.tiling import MM, Tile, TileGrid, Window

MOST_NODES = 512
"""Nodes along the longer side, at most."""
_UNIT_MM = 10
"""Unit of the elevations in the file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerrainPart:
    """The nodes in one tile."""

    column: int
    """Column of the first node, in spacings from the CRS's origin."""
    row: int
    """Its row."""
    elevation_mm: Elevations
    """(rows, columns), NO_DATA where unknown."""


def terrain_spacing(tiles: Collection[Tile], grid: TileGrid) -> int:
    """Metres between nodes, a power of two, with which some tiles have at most `MOST_NODES` along each side.

    >>> grid = TileGrid(size_mm=250_000, halo_mm=0)
    >>> terrain_spacing([Tile(0, 0)], grid), terrain_spacing([Tile(0, 0), Tile(3, 1)], grid)
    (1, 2)
    """
    columns, rows = [tile.column for tile in tiles], [tile.row for tile in tiles]
    side_mm = grid.size_mm * (1 + max(max(columns) - min(columns), max(rows) - min(rows)))
    spacing = 1
    while side_mm > spacing * CELL_MM * MOST_NODES:
        spacing *= 2
    return spacing


def terrain_part(scratch: Scratch, grid: TileGrid, tile: Tile, spacing: int) -> TerrainPart:
    """The nodes whose cells have their centres in the core of a tile."""
    core = grid.core(tile)
    # the first cell with its centre at or beyond the edge, then the first node
    edges = (core.x0_mm, core.y0_mm, core.x1_mm, core.y1_mm)
    west, south, east, north = (-((CELL_MM // 2 - edge) // (CELL_MM * spacing)) for edge in edges)
    view = Window(
        x0_mm=west * spacing * CELL_MM,
        y0_mm=south * spacing * CELL_MM,
        x1_mm=east * spacing * CELL_MM,
        y1_mm=north * spacing * CELL_MM,
    )
    found = surroundings_of(scratch, grid, view).elevation_mm[::spacing, ::spacing]
    return TerrainPart(column=west, row=south, elevation_mm=np.ascontiguousarray(found))


def terrain_document(parts: Iterable[TerrainPart], spacing: int, bounds: Window) -> bytes:
    """The file, as docs/how_to/points.md describes it: the nodes within some bounds, and those just outside."""
    side_mm = spacing * CELL_MM
    # nodes lie in the middle of cells of a metre
    west, south = ((edge - CELL_MM // 2) // side_mm for edge in (bounds.x0_mm, bounds.y0_mm))
    columns, rows = (
        -((CELL_MM // 2 - edge) // side_mm) + 1 - first for edge, first in ((bounds.x1_mm, west), (bounds.y1_mm, south))
    )
    whole = np.full((rows, columns), NO_DATA, np.int32)
    for part in parts:
        column, row = part.column - west, part.row - south
        high, wide = part.elevation_mm.shape
        left, low, right, top = max(0, column), max(0, row), min(columns, column + wide), min(rows, row + high)
        if left < right and low < top:
            whole[low:top, left:right] = part.elevation_mm[low - row : top - row, left - column : right - column]
    rounded, unknown = np.rint(whole / _UNIT_MM).astype(np.int64).tolist(), (whole == NO_DATA).tolist()
    return json.dumps(
        {
            "origin_m": [west * spacing + 0.5, south * spacing + 0.5],
            "spacing_m": spacing,
            "elevation_unit_m": _UNIT_MM / MM,
            "elevations": [
                [None if lacks else value for value, lacks in zip(*row, strict=True)]
                for row in zip(rounded, unknown, strict=True)
            ],
        },
        separators=(",", ":"),
    ).encode()
