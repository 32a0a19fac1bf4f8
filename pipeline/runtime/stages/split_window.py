"""Split of one tile: its window of points becomes surface fragments, or the points of given footprints."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray, IntArray
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import key_of
from pipeline.runtime.stages.gather import VIEW_M
from pipeline.runtime.stages.open_fragments import TileSurfaces, open_fragments
from pipeline.runtime.stages.window_points import load_window
from pipeline.scene import (
    BUILDING_CLASS,
    GROUND_CLASS,
    VEGETATION_CLASSES,
    SplitTile,
    WindowPoints,
    lattice_of,
    split_tile,
    terrain_of,
)
from pipeline.terrain.ground import Terrain, ground_points
from pipeline.terrain.scene_settings import APRON_M, ClassesInUse, SceneSettings
from pipeline.terrain.settings import GroundSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

if TYPE_CHECKING:
    from hashlib import _Hash as Hash

_PLACE_BITS = 20
"""Bits of a coordinate in a sort key: 1,048 m in millimetres."""
_SEEN_CELLS = APRON_M + VIEW_M + 2
"""Cells from the edge of a tile's terrain, its apron included, that a building of a neighbour may see: the view may
begin and end within a cell."""
_NEIGHBOURS = tuple((column, row) for column in (-1, 0, 1) for row in (-1, 0, 1) if (column, row) != (0, 0))
_STRIPS = 2**16 - 1
"""Strips of a tile in which the points of footprints are looked for; their numbers fit two bytes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice, its halo as wide as `SceneSettings.support_with` asks for."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    scratch: Scratch
    """Points in, fragments out."""
    footprints: tuple[Polygon | MultiPolygon, ...] | None
    """Outlines in metres of the given footprints that meet the tile; None where none were given. The first wins where
    they overlap."""
    folder: str = "tiles"
    """Folder of the scratch for the outcome."""
    memory_bytes: int = 0
    """Estimated peak memory of the process that splits the tile; 0 if unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootprintPoints:
    """Where the points of given footprints lie in a tile's sorted points; k of them hold some."""

    starts: IntArray
    """(k + 1,) int64, where the points of each start."""
    keys: IntArray
    """(k,) int64, the footprint's place in the task."""
    lowest_points_mm: IntArray
    """(k, 3) int64, lexicographically smallest point of each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitFigures:
    """The figures of one tile, which travel to the driver."""

    tile: Tile
    """The tile."""
    points: int
    """Points of the core, without duplicates."""
    duplicates: int
    """Exact duplicates in the core that were dropped."""
    outliers: int
    """Gross outliers in the core."""
    audit: tuple[int, int, int]
    """Points of the core: assigned and class 6, assigned and not, class 6 and not assigned."""
    outcome: str
    """Digest of the stored points and terrain: equal where later stages see no difference."""
    borders: tuple[str, ...]
    """Digests of the terrain that each of the eight neighbours may see, in the order of `_NEIGHBOURS`."""

    def facing(self, other: Tile) -> str:
        """Digest of the tile's terrain that the buildings of a neighbour may see."""
        return self.borders[_NEIGHBOURS.index((other.column - self.tile.column, other.row - self.tile.row))]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Split:
    """What the join needs of one tile, and the tile's figures."""

    tile: Tile
    """The tile."""
    surfaces: TileSurfaces | None
    """What the join needs of the tile's surfaces; None where footprints were given."""
    footprints: FootprintPoints | None
    """The points in given footprints; None where none were given."""
    figures: SplitFigures
    """The tile's figures."""


def split_window(task: SplitTask, settings: SceneSettings) -> Split:
    """Split one tile and store its points, sorted by fragment, and its terrain.

    The arrays are in scratch under `<folder>/<tile>/`.
    """
    task.scratch.check_cancelled()
    loaded = load_window(task.scratch, task.grid, task.tile)
    points = loaded.points
    core, window = task.grid.core(task.tile), task.grid.window(task.tile)
    task.scratch.check_cancelled()
    result: SplitTile | None = None
    if task.footprints is None:
        result = split_tile(points, core, window, settings, task.classes)
        index, owner = result.core_index, result.point_fragment.astype(np.int64)
        terrain, occupied, outliers = result.terrain, result.occupied, result.outliers
    else:
        wanted = core.grown(math.ceil(settings.terrain_m(footprints=True) * MM))
        terrain, kept, occupied = terrain_of(points, window, settings, task.classes, wanted)
        own = len(loaded.core)
        outliers = int((~kept[:own]).sum())
        index = np.flatnonzero(kept[:own])
        above = _above_ground(points, index, terrain, task.classes, settings.ground)
        owner = _inside_footprints(points, index, above, task)
    is_building = points.classification[index] == BUILDING_CLASS
    assigned = owner >= 0
    audit = (
        int((assigned & is_building).sum()),
        int((assigned & ~is_building).sum()),
        int((~assigned & is_building).sum()),
    )
    outcome = hashlib.sha256()
    keys, starts, lowest = _store(task, loaded.core[index[assigned]], owner[assigned], outcome)
    borders = _store_terrain(task, terrain, occupied, core, outcome)
    surfaces, footprints = None, None
    if result is None:
        footprints = FootprintPoints(starts=starts, keys=keys, lowest_points_mm=lowest)
    else:
        cut, judging = settings.surfaces, settings.candidates
        surfaces = open_fragments(result.fragments, keys, starts, task.tile, task.grid, cut, judging)
    figures = SplitFigures(
        tile=task.tile,
        points=len(loaded.core),
        duplicates=loaded.duplicates,
        outliers=outliers,
        audit=audit,
        outcome=outcome.hexdigest(),
        borders=borders,
    )
    return Split(tile=task.tile, surfaces=surfaces, footprints=footprints, figures=figures)


def _put(task: SplitTask, arrays: dict[str, npt.NDArray[Any]], outcome: Hash) -> None:
    """Store arrays of the tile, and add them to the digest of its outcome."""
    for name, array in sorted(arrays.items()):
        outcome.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        outcome.update(array.tobytes())
    task.scratch.put_arrays(f"{task.folder}/{task.tile.key}", arrays)


def _store(
    task: SplitTask, records: npt.NDArray[np.void], owner: IntArray, outcome: Hash
) -> tuple[IntArray, IntArray, IntArray]:
    """Store points sorted by owner; the owners, where each one's points start, and their smallest points."""
    order = _order_by_owner(records, owner)
    records, owner = np.take(records, order), owner[order]
    _put(task, {"points": records.view(np.uint8)}, outcome)
    keys, starts = np.unique(owner, return_index=True)
    lowest = np.column_stack([records[name][starts] for name in "xyz"]).astype(np.int64)
    return keys, np.append(starts, len(owner)).astype(np.int64), lowest


def _order_by_owner(records: npt.NDArray[np.void], owner: IntArray) -> IntArray:
    """Indices that sort points by owner, then x, y and z.

    Owner, x and y are packed into one key where a tile is small enough for it: one sort of integers in place of four.
    """
    if len(records) == 0:
        return np.empty(0, np.int64)
    x, y = records["x"] - records["x"].min(), records["y"] - records["y"].min()
    if max(int(x.max()), int(y.max())) >> _PLACE_BITS or int(owner.max()) >> (63 - 2 * _PLACE_BITS):
        return np.lexsort((records["z"], y, x, owner)).astype(np.int64)
    key = (owner << 2 * _PLACE_BITS) | (x << _PLACE_BITS) | y
    order = np.argsort(key)
    key = key[order]
    tied = np.flatnonzero(key[1:] == key[:-1])
    if len(tied):
        rows = np.unique(np.concatenate((tied, tied + 1)))
        points = order[rows]
        order[rows] = points[np.lexsort((points, records["z"][points], key[rows]))]
    return order.astype(np.int64)


def _store_terrain(
    task: SplitTask, terrain: Terrain, occupied: BoolArray, core: Window, outcome: Hash
) -> tuple[str, ...]:
    """Store the terrain of the core and an apron around it; the digests of what each neighbour may see of it.

    The apron lets a candidate at the data's edge see terrain whose own tile holds no point and so is never made.
    Where aprons overlap they agree.
    """
    apron = core.grown(APRON_M * MM)
    column0, row0, n_columns, n_rows = lattice_of(apron)
    rows = slice(row0 - terrain.row0, row0 - terrain.row0 + n_rows)
    columns = slice(column0 - terrain.column0, column0 - terrain.column0 + n_columns)
    arrays: dict[str, npt.NDArray[Any]] = {
        "terrain": np.ascontiguousarray(terrain.elevation_mm[rows, columns]),
        "occupied": np.ascontiguousarray(occupied[rows, columns]),
        "corner": np.array([column0, row0], np.int64),
    }
    _put(task, arrays, outcome)
    return tuple(_seen_from(column, row, arrays["terrain"], arrays["occupied"]) for column, row in _NEIGHBOURS)


def _seen_from(column: int, row: int, *arrays: npt.NDArray[Any]) -> str:
    """Digest of the cells of a tile's arrays near one neighbour, by its column and row counted from the tile."""
    cells = {-1: slice(_SEEN_CELLS), 0: slice(None), 1: slice(-_SEEN_CELLS, None)}
    return key_of(*(array[cells[row], cells[column]] for array in arrays))


def _above_ground(
    points: WindowPoints, index: IntArray, terrain: Terrain, classes: ClassesInUse, settings: GroundSettings
) -> BoolArray:
    """Whether each of the points at `index` counts inside a footprint.

    Where class 6 is believed its points count, else all points above the ground that are not vegetation by their class.
    """
    if classes.building:
        is_building: BoolArray = points.classification[index] == BUILDING_CLASS
        return is_building
    above = ~ground_points(points.x_mm[index], points.y_mm[index], points.z_mm[index], terrain, settings)
    if classes.ground:
        above &= points.classification[index] != GROUND_CLASS
    if classes.vegetation:
        above &= ~np.isin(points.classification[index], VEGETATION_CLASSES)
    return above


def _inside_footprints(points: WindowPoints, index: IntArray, above: BoolArray, task: SplitTask) -> IntArray:
    """The footprint that holds each of the points at `index`, -1 where none does or the point does not count."""
    owner = np.full(len(index), -1, np.int64)
    inner = np.flatnonzero(above)
    if len(inner) == 0:
        return owner
    # sort by strips of the tile, as many as two bytes can number: numpy then sorts stably by radix
    west = int(points.x_mm[index[inner]].min())
    strip_mm = task.grid.size_mm // _STRIPS + 1
    strip = (points.x_mm[index[inner]] - west) // strip_mm
    order = np.argsort(strip.astype(np.uint16), kind="stable")
    from_west, strip = inner[order], strip[order]
    x, y = points.x_mm[index[from_west]], points.y_mm[index[from_west]]
    # the first wins where footprints overlap, whatever the tile
    for number, polygon in reversed(list(enumerate(task.footprints or ()))):
        x0, y0, x1, y1 = (round(v * MM) for v in polygon.bounds)
        first = np.searchsorted(strip, (x0 - 1 - west) // strip_mm, side="left")
        last = np.searchsorted(strip, (x1 + 1 - west) // strip_mm, side="right")
        near = first + np.flatnonzero((y[first:last] >= y0 - 1) & (y[first:last] <= y1 + 1))
        if len(near):
            shapely.prepare(polygon)
            inside = shapely.contains_xy(polygon, x[near] / MM, y[near] / MM)
            owner[from_west[near[inside]]] = number
    return owner
