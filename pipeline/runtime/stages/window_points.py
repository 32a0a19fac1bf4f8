"""The points of a tile's window: its core and its halo, without exact duplicates."""

from __future__ import annotations

import dataclasses
import mmap
import os
from collections.abc import Iterable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray, IntArray
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.scene import WindowPoints
from pipeline.tiling import Tile, TileGrid, Window

FOLDER = "cells"
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
    states = scratch.array(f"{FOLDER}/{tile.key}", "states") if paths else np.empty(0, np.uint8)
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
    return {f"{kind}/{tile.key}" for kind in ("points", FOLDER, "ground") for tile in tiles}
