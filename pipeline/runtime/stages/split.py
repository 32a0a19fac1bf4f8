"""Split: one tile's window of points to surface fragments, or to the points of given footprints."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.open_fragments import TileSurfaces, open_fragments
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, SplitTile, WindowPoints, lattice_of, split_tile, terrain_of
from pipeline.spatial_hash import first_of_each
from pipeline.terrain.ground import Terrain, ground_points
from pipeline.terrain.scene_settings import APRON_M, ClassesInUse, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

if TYPE_CHECKING:
    from hashlib import _Hash as Hash

_PLACE_BITS = 20
"""Bits of a coordinate in a sort key: 1,048 m in millimetres."""
_STRIPS = 2**16 - 1
"""Strips of a tile in which the points of footprints are looked for; their numbers fit two bytes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice, its halo as wide as `settings.support_with` asks for."""
    settings: SceneSettings
    """Ground to candidates."""
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
    """What the process that splits it comes to take; 0 where nobody reckoned."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootprintPoints:
    """Where the points of given footprints lie in a tile's sorted points; k of them hold some."""

    starts: npt.NDArray[np.int64]
    """(k + 1,) int64, where the points of each start."""
    keys: npt.NDArray[np.int64]
    """(k,) int64, the footprint's place in the task."""
    lowest_points_mm: npt.NDArray[np.int64]
    """(k, 3) int64, lexicographically smallest point of each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Split:
    """The small descriptors of one tile that travel to the driver."""

    tile: Tile
    """The tile."""
    surfaces: TileSurfaces | None
    """What the join needs of the tile's surfaces; None where footprints were given."""
    footprints: FootprintPoints | None
    """The points in given footprints; None where none were given."""
    points: int
    """Points of the core, without duplicates."""
    duplicates: int
    """Exact duplicates in the core that were dropped."""
    outliers: int
    """Gross outliers in the core."""
    audit: tuple[int, int, int]
    """Points of the core: assigned and class 6, assigned and not, class 6 and not assigned."""
    outcome: str
    """Digest of the points and the terrain that were stored: equal where what comes after sees no difference."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitTold:
    """A split without its descriptors: its figures, as of `Split`."""

    tile: Tile
    points: int
    duplicates: int
    outliers: int
    audit: tuple[int, int, int]
    outcome: str


def told_of_split(found: Split) -> SplitTold:
    """What the driver learns of a split."""
    return SplitTold(
        tile=found.tile,
        points=found.points,
        duplicates=found.duplicates,
        outliers=found.outliers,
        audit=found.audit,
        outcome=found.outcome,
    )


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
"""Those that are held of the points of a window; the others only tell duplicates."""


@kernel
def _columns_inside(records: npt.NDArray[np.void], x0: int, y0: int, x1: int, y1: int) -> Columns:
    """Kernel: the columns of the records with x0 <= x < x1 and y0 <= y < y1, in their order."""
    size = records.size
    # room for all of them, of which only what is written takes memory: records are wide, and looked at once
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
    """The points in a window of the buckets of one tile, one of each set of equal points; and which of them stayed."""
    found = [_columns_inside(part, window.x0_mm, window.y0_mm, window.x1_mm, window.y1_mm) for part in parts]
    columns: Columns = found[0] if len(found) == 1 else tuple(map(np.concatenate, zip(*found, strict=True)))  # type: ignore[assignment]
    kept = first_of_each(*columns)
    if not kept.all():
        columns = tuple(column[kept] for column in columns)  # type: ignore[assignment]
    return columns, kept


def load_window(scratch: Scratch, grid: TileGrid, tile: Tile) -> LoadedWindow:
    """Read the core and its halo.

    Equal points share a tile, so each tile's buckets are freed of duplicates on their own. Of the halo only the few
    needed columns are held, since it can be many times its core.
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


def split(task: SplitTask) -> Split:
    """Split one tile and store its points, sorted by fragment, and its terrain.

    Returns
    -------
    Split
        Descriptors; arrays are in scratch under `<folder>/<tile>/`.

    Raises
    ------
    RunCancelledError
        The run was called off.
    """
    task.scratch.check_cancelled()
    loaded = load_window(task.scratch, task.grid, task.tile)
    points = loaded.points
    core, window = task.grid.core(task.tile), task.grid.window(task.tile)
    task.scratch.check_cancelled()
    result: SplitTile | None = None
    if task.footprints is None:
        result = split_tile(points, core, window, task.settings, task.classes)
        index, owner = result.core_index, result.point_fragment.astype(np.int64)
        terrain, occupied, outliers = result.terrain, result.occupied, result.outliers
    else:
        wanted = core.grown(math.ceil(task.settings.terrain_m(footprints=True) * MM))
        terrain, kept, occupied = terrain_of(points, window, task.settings, task.classes, wanted)
        own = len(loaded.core)
        outliers = int((~kept[:own]).sum())
        index, owner = _inside_footprints(points, np.flatnonzero(kept[:own]), terrain, task)
    is_building = points.classification[index] == BUILDING_CLASS
    assigned = owner >= 0
    audit = (
        int((assigned & is_building).sum()),
        int((assigned & ~is_building).sum()),
        int((~assigned & is_building).sum()),
    )
    outcome = hashlib.sha256()
    keys, starts, lowest = _store(task, loaded.core[index[assigned]], owner[assigned], outcome)
    _store_terrain(task, terrain, occupied, core, outcome)
    surfaces, footprints = None, None
    if result is None:
        footprints = FootprintPoints(starts=starts, keys=keys, lowest_points_mm=lowest)
    else:
        cut, judging = task.settings.surfaces, task.settings.candidates
        surfaces = open_fragments(result.fragments, keys, starts, task.tile, task.grid, cut, judging)
    return Split(
        tile=task.tile,
        surfaces=surfaces,
        footprints=footprints,
        points=len(loaded.core),
        duplicates=loaded.duplicates,
        outliers=outliers,
        audit=audit,
        outcome=outcome.hexdigest(),
    )


def _put(task: SplitTask, arrays: dict[str, npt.NDArray[Any]], outcome: Hash) -> None:
    """Store arrays of the tile, and add them to the digest of its outcome."""
    for name, array in sorted(arrays.items()):
        outcome.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        outcome.update(array.tobytes())
    task.scratch.put_arrays(f"{task.folder}/{task.tile.key}", arrays)


def _store(
    task: SplitTask, records: npt.NDArray[np.void], owner: npt.NDArray[np.int64], outcome: Hash
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Store points sorted by owner; the owners, where each one's points start, and their smallest points."""
    order = _order_by_owner(records, owner)
    records, owner = np.take(records, order), owner[order]
    _put(task, {"points": records.view(np.uint8)}, outcome)
    keys, starts = np.unique(owner, return_index=True)
    lowest = np.column_stack([records[name][starts] for name in "xyz"]).astype(np.int64)
    return keys, np.append(starts, len(owner)).astype(np.int64), lowest


def _order_by_owner(records: npt.NDArray[np.void], owner: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
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


def _store_terrain(task: SplitTask, terrain: Terrain, occupied: BoolArray, core: Window, outcome: Hash) -> None:
    """Store the terrain of the core and an apron around it.

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


def _inside_footprints(
    points: WindowPoints, index: npt.NDArray[np.int64], terrain: Terrain, task: SplitTask
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices of the core's points, as they are given, and the footprint that holds each, -1 where none.

    Inside a footprint all points above the ground count, or those of class 6 where it is believed.
    """
    owner = np.full(len(index), -1, np.int64)
    if task.classes.building:
        above = points.classification[index] == BUILDING_CLASS
    else:
        above = ~ground_points(
            points.x_mm[index], points.y_mm[index], points.z_mm[index], terrain, task.settings.ground
        )
        if task.classes.ground:
            above &= points.classification[index] != GROUND_CLASS
    inner = np.flatnonzero(above)
    if len(inner) == 0:
        return index, owner
    # by strips of the tile, so many that their numbers have two bytes: a stable sort of these is a radix sort
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
    return index, owner
