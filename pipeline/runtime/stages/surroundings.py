"""The terrain of any window of a run, from the parts that its tiles have stored."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray
from pipeline.runtime.scratch.folder import Scratch
from pipeline.terrain.ground import Terrain, slopes_of
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.tiling import TileGrid, Window

FOLDER = "ground"
"""Folder of scratch with the terrain of each tile and of an apron around it."""
NO_POINT = np.int16(np.iinfo(np.int16).min)
"""In place of a distance: no point lies in the cell."""
NO_GROUND = np.int16(np.iinfo(np.int16).max)
"""In place of a distance: the cell's lowest point is not at the terrain, or one of them is unknown."""
_NEAR_MM = 1000
"""A lowest point that is farther from the terrain is not ground."""


class Surroundings(NamedTuple):
    """Terrain of a window, on the 1 m lattice."""

    column0: int
    row0: int
    elevation_mm: npt.NDArray[np.int32]
    """(rows, columns), NO_DATA where unknown."""
    occupied: BoolArray
    """(rows, columns), some point lies in the cell."""
    off_mm: npt.NDArray[np.int16]
    """(rows, columns), how far the cell's lowest point lies above the terrain, `NO_GROUND` or `NO_POINT`."""


def surroundings_of(scratch: Scratch, grid: TileGrid, view: Window) -> Surroundings:
    """Mosaic of the tiles' terrain over a view."""
    column0, row0 = view.x0_mm // CELL_MM, view.y0_mm // CELL_MM
    columns, rows = -(-view.x1_mm // CELL_MM) - column0, -(-view.y1_mm // CELL_MM) - row0
    elevation = np.full((rows, columns), NO_DATA, np.int32)
    off_mm = np.full((rows, columns), NO_POINT, np.int16)
    # a cell belongs to the tile of its centre, so neighbours of the view's own tiles may have its border cells
    for tile in grid.tiles_over(view.grown(CELL_MM)):
        name = f"{FOLDER}/{tile.key}"
        if not scratch.has(name):
            continue
        corner = scratch.array(name, "corner")
        part = scratch.array(name, "terrain", mapped=True)
        c0, r0 = int(corner[0]) - column0, int(corner[1]) - row0
        left, right = max(c0, 0), min(c0 + part.shape[1], columns)
        low, high = max(r0, 0), min(r0 + part.shape[0], rows)
        if left < right and low < high:
            theirs = (slice(low - r0, high - r0), slice(left - c0, right - c0))
            ours = (slice(low, high), slice(left, right))
            elevation[ours] = part[theirs]
            off_mm[ours] = scratch.array(name, "off", mapped=True)[theirs]
    return Surroundings(column0, row0, elevation, off_mm != NO_POINT, off_mm)


def distances_to_terrain(lowest_mm: Elevations, occupied: BoolArray, elevation_mm: Elevations) -> npt.NDArray[np.int16]:
    """How far the lowest points of cells (rows, columns) lie above the terrain: `Surroundings.off_mm`."""
    off_mm = lowest_mm.astype(np.int64) - elevation_mm
    is_ground = (lowest_mm != NO_DATA) & (elevation_mm != NO_DATA) & (np.abs(off_mm) <= _NEAR_MM)
    found: npt.NDArray[np.int16] = np.where(occupied, np.where(is_ground, off_mm, NO_GROUND), NO_POINT).astype(np.int16)
    return found


def terrain_around(around: Surroundings) -> Terrain:
    """The same with slopes; the cells along its border need a neighbour for theirs."""
    return Terrain(
        elevation_mm=around.elevation_mm,
        slope_mm=slopes_of(around.elevation_mm),
        measured=around.elevation_mm != NO_DATA,
        column0=around.column0,
        row0=around.row0,
    )
