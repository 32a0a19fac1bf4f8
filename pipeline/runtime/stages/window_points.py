"""The points of a tile's window: its core and its halo, without exact duplicates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.scene import WindowPoints
from pipeline.spatial_hash import first_of_each
from pipeline.tiling import Tile, TileGrid, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadedWindow:
    """The points of a tile's window, those of the core first."""

    points: WindowPoints
    """All of them."""
    core: npt.NDArray[np.void]
    """(n,) POINT, the core's records without exact duplicates: the first n of `points`, in that order."""
    duplicates: int
    """Exact duplicates that were dropped from the core."""


Columns: TypeAlias = tuple[
    IntArray,
    IntArray,
    IntArray,
    ByteArray,
    FloatArray,
    npt.NDArray[np.uint16],
    ByteArray,
    ByteArray,
]
"""x, y, z in mm, return number, GPS time, source, class, return count: as `first_of_each` takes them."""

_OF_POINTS = (0, 1, 2, 3, 6, 7)
"""The columns that stay in memory; the others only serve to find duplicates."""


@kernel
def _columns_inside(records: npt.NDArray[np.void], x0: int, y0: int, x1: int, y1: int) -> Columns:
    """Columns of the (n,) records with x0 <= x < x1 and y0 <= y < y1 in mm, in the order of the records."""
    size = records.size
    # room for all records, though only what is written takes memory: records are wide, and this reads them once
    x, y, z = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    return_number, return_count = np.empty(size, np.uint8), np.empty(size, np.uint8)
    classification, source, gps_time = np.empty(size, np.uint8), np.empty(size, np.uint16), np.empty(size, np.float64)
    n = 0
    for i in range(size):
        point = records[i]
        if x0 <= point.x < x1 and y0 <= point.y < y1:
            x[n], y[n], z[n] = point.x, point.y, point.z
            return_number[n], return_count[n] = point.return_number, point.return_count
            classification[n], source[n], gps_time[n] = point.classification, point.source, point.gps_time
            n += 1
    return x[:n], y[:n], z[:n], return_number[:n], gps_time[:n], source[:n], classification[:n], return_count[:n]


def _columns_of(parts: Sequence[npt.NDArray[np.void]], window: Window) -> tuple[Columns, BoolArray]:
    """Points in a window of one tile's buckets, one of each set of equal points; and which of them stayed."""
    found = [_columns_inside(part, window.x0_mm, window.y0_mm, window.x1_mm, window.y1_mm) for part in parts]
    columns: Columns = found[0] if len(found) == 1 else tuple(map(np.concatenate, zip(*found, strict=True)))  # type: ignore[assignment]
    kept = first_of_each(*columns)
    if not kept.all():
        columns = tuple(column[kept] for column in columns)  # type: ignore[assignment]
    return columns, kept


def load_window(scratch: Scratch, grid: TileGrid, tile: Tile) -> LoadedWindow:
    """Read the core and its halo.

    Equal points share a tile, so duplicates are removed tile by tile. Only the needed columns of the halo stay in
    memory, since it can be many times its core.
    """
    window = grid.window(tile)
    own = [np.fromfile(path, POINT) for path in bucket_paths(scratch, tile)] or [np.empty(0, POINT)]
    columns, kept = _columns_of(own, grid.core(tile))
    records = own[0] if len(own) == 1 else np.concatenate(own)
    core = records if kept.all() else records[kept]
    duplicates = len(records) - len(core)
    del own, records
    around = [bucket_paths(scratch, other) for other in grid.tiles_over(window) if other != tile]
    halo = [_columns_of([np.fromfile(path, POINT) for path in paths], window)[0] for paths in around if paths]
    everything = list(zip(columns, *halo, strict=True))
    x, y, z, return_number, classification, return_count = (
        everything[k][0] if len(everything[k]) == 1 else np.concatenate(everything[k]) for k in _OF_POINTS
    )
    points = WindowPoints(
        x_mm=x, y_mm=y, z_mm=z, return_number=return_number, return_count=return_count, classification=classification
    )
    return LoadedWindow(points=points, core=core, duplicates=duplicates)


def bucket_paths(scratch: Scratch, tile: Tile) -> list[Path]:
    """The buckets of a tile, in the order of the inputs."""
    return sorted(Path(scratch.root, "points", tile.key).glob("*.bin"))
