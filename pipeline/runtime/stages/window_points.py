"""The points of a tile's window: its core and its halo, without exact duplicates."""

from __future__ import annotations

import dataclasses
import mmap
import os
from collections.abc import Iterable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray, IntArray
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.scene import WindowPoints
from pipeline.terrain.ground import Terrain, slopes_of
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.tiling import Tile, TileGrid, Window

CELLS_FOLDER = "cells"
"""Folder of scratch with the states of each tile's points."""
_MAPPED_POINTS = 20_000
"""A map keeps its file open, and so many inputs may reach into one tile that no process may open all at once: smaller
buckets are read. A tile holds some millions of points, so few are larger."""


class PointState(IntEnum):
    """What is known of a point in a bucket."""

    DUPLICATE = 0
    """It equals another one, which stays."""
    OUTLIER = 1
    """It is nearly alone."""
    KEPT = 2


_DUPLICATE, _KEPT = int(PointState.DUPLICATE), int(PointState.KEPT)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadedWindow:
    """The points of a tile's window, those of the core first."""

    points: WindowPoints
    """All of them."""
    kept: BoolArray
    """Which of them are not outliers."""
    core: npt.NDArray[np.void]
    """(n,) POINT, the core's records without exact duplicates: the first n of `points`, in that order."""


_Columns: TypeAlias = tuple[IntArray, IntArray, IntArray, ByteArray, ByteArray, ByteArray, BoolArray]
"""x, y, z in mm, return number, return count, class, whether it is kept."""


@kernel
def _columns_inside(records: npt.NDArray[np.void], states: ByteArray, x0: int, y0: int, x1: int, y1: int) -> _Columns:
    """Columns of the records (n,) with x0 <= x < x1 and y0 <= y < y1 in mm, without duplicates, in their order."""
    size = records.size
    # room for all records, though only what is written takes memory: records are wide, and this reads them once
    x, y, z = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    return_number, return_count = np.empty(size, np.uint8), np.empty(size, np.uint8)
    classification, kept = np.empty(size, np.uint8), np.empty(size, np.bool_)
    n = 0
    for i in range(size):
        point = records[i]
        if states[i] != _DUPLICATE and x0 <= point.x < x1 and y0 <= point.y < y1:
            x[n], y[n], z[n] = point.x, point.y, point.z
            return_number[n], return_count[n] = point.return_number, point.return_count
            classification[n], kept[n] = point.classification, states[i] == _KEPT
            n += 1
    return x[:n], y[:n], z[:n], return_number[:n], return_count[:n], classification[:n], kept[:n]


def load_window(scratch: Scratch, grid: TileGrid, tile: Tile) -> LoadedWindow:
    """Read the core and its halo.

    Only the needed columns of the halo stay in memory, since it can be many times its core.
    """
    core, window = grid.core(tile), grid.window(tile)
    own = list(_buckets(scratch, tile))
    found = [_columns_inside(records, states, *_bounds(core)) for records, states in own]
    unique = [records if states.all() else records[states != _DUPLICATE] for records, states in own]
    records = np.empty(0, POINT) if not unique else unique[0] if len(unique) == 1 else np.concatenate(unique)
    del own, unique
    for other in grid.tiles_over(window):
        if other != tile:
            found.extend(_columns_inside(*bucket, *_bounds(window)) for bucket in _buckets(scratch, other))
    if not found:
        found.append(_columns_inside(records, np.empty(0, np.uint8), *_bounds(core)))
    x, y, z, return_number, return_count, classification, kept = (
        columns[0] if len(columns) == 1 else np.concatenate(columns) for columns in zip(*found, strict=True)
    )
    points = WindowPoints(
        x_mm=x, y_mm=y, z_mm=z, return_number=return_number, return_count=return_count, classification=classification
    )
    return LoadedWindow(points=points, kept=kept, core=records)


def _bounds(window: Window) -> tuple[int, int, int, int]:
    return window.x0_mm, window.y0_mm, window.x1_mm, window.y1_mm


def _buckets(scratch: Scratch, tile: Tile) -> Iterator[tuple[npt.NDArray[np.void], ByteArray]]:
    """The buckets of a tile, each with the states of its points."""
    paths = bucket_paths(scratch, tile)
    states = scratch.array(f"{CELLS_FOLDER}/{tile.key}", "states") if paths else np.empty(0, np.uint8)
    begin = 0
    for path in paths:
        records = bucket(path)
        yield records, states[begin : begin + len(records)]
        begin += len(records)


def bucket_paths(scratch: Scratch, tile: Tile) -> list[Path]:
    """The buckets of a tile, in the order of the inputs."""
    return sorted(Path(scratch.root, "points", tile.key).glob("*.bin"))


def bucket(path: Path) -> npt.NDArray[np.void]:
    """The points of a bucket, (n,) POINT; mapped if they are many, since of most of them few columns are wanted."""
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size // POINT.itemsize
        if size < _MAPPED_POINTS:
            return np.fromfile(stream, POINT)
        # a copy on write: kernels take arrays that they may write to, although they only read this one
        return np.frombuffer(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_COPY), POINT, size)


def folders_of(tiles: Iterable[Tile]) -> set[str]:
    """The folders of scratch with all that was found of some tiles before they are split: points, states, terrain."""
    return {f"{kind}/{tile.key}" for kind in ("points", CELLS_FOLDER, "ground") for tile in tiles}


GROUND_FOLDER = "ground"
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
        name = f"{GROUND_FOLDER}/{tile.key}"
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
