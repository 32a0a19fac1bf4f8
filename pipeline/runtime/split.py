"""Split: one tile's window of points to surface fragments, or to the points of given footprints."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray
from pipeline.runtime.scratch import POINT, Scratch
from pipeline.scene import (
    BUILDING_CLASS,
    GROUND_CLASS,
    ClassesInUse,
    SceneSettings,
    WindowPoints,
    lattice_of,
    split_tile,
    terrain_of,
)
from pipeline.spatial_hash import first_of_each
from pipeline.terrain.ground import Terrain
from pipeline.terrain.lattice import NO_DATA, height_above
from pipeline.terrain.surfaces import Fragments
from pipeline.tiling import MM, Tile, TileGrid, Window

APRON_MM = 6 * MM
"""Width of the terrain that a tile stores beyond its core; less than the halo's own margin."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice."""
    settings: SceneSettings
    """Ground to candidates."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    scratch: Scratch
    """Points in, fragments out."""
    footprints: tuple[tuple[int, Polygon | MultiPolygon], ...] | None
    """Numbers and outlines in metres of the given footprints that meet the tile; None where none were given."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Split:
    """The small descriptors of one tile that travel to the driver."""

    tile: Tile
    """The tile."""
    fragments: Fragments | None
    """Surface fragments; None where footprints were given or the tile has no points."""
    starts: npt.NDArray[np.int64]
    """(k + 1,) int64, where each fragment's (or footprint's) points start in the tile's sorted points."""
    keys: npt.NDArray[np.int64]
    """(k,) int64, the fragment's or footprint's number."""
    lowest_points_mm: npt.NDArray[np.int64]
    """(k, 3) int64, lexicographically smallest point of each."""
    points: int
    """Points of the core, without duplicates."""
    duplicates: int
    """Exact duplicates in the core that were dropped."""
    outliers: int
    """Gross outliers in the core."""
    audit: tuple[int, int, int]
    """Points of the core: assigned and class 6, assigned and not, class 6 and not assigned."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadedWindow:
    """The points of a tile's window, those of the core first."""

    points: WindowPoints
    """All of them."""
    core: npt.NDArray[np.void]
    """(n,) POINT, the core's records without exact duplicates: the first n of `points`, in that order."""
    duplicates: int
    """Exact duplicates that were dropped from the core."""


_WINDOW_COLUMNS = ("x", "y", "z", "return_number", "return_count", "classification")


def _without_duplicates(records: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """One of each set of equal points."""
    kept = first_of_each(
        np.ascontiguousarray(records["x"]),
        np.ascontiguousarray(records["y"]),
        records["z"].astype(np.int64),
        np.ascontiguousarray(records["return_number"]),
        np.ascontiguousarray(records["gps_time"]),
        np.ascontiguousarray(records["source"]),
        np.ascontiguousarray(records["classification"]),
        np.ascontiguousarray(records["return_count"]),
    )
    return records if kept.all() else records[kept]


def load_window(scratch: Scratch, grid: TileGrid, tile: Tile) -> LoadedWindow:
    """Read the core and its halo.

    Equal points share a tile, so each tile's buckets are freed of duplicates on their own. Of the halo only the few
    needed columns are held, since it can be many times its core.
    """
    window = grid.window(tile)
    own = [np.fromfile(part, POINT) for part in _parts(scratch, tile)]
    records = np.concatenate(own) if own else np.empty(0, POINT)
    core = _without_duplicates(records)
    duplicates = len(records) - len(core)
    del own, records
    columns = {name: [np.ascontiguousarray(core[name])] for name in _WINDOW_COLUMNS}
    for other in grid.tiles_over(window):
        if other == tile:
            continue
        seen = [_inside(np.fromfile(part, POINT), window) for part in _parts(scratch, other)]
        if seen:
            records = _without_duplicates(np.concatenate(seen))
            for name, pieces in columns.items():
                pieces.append(np.ascontiguousarray(records[name]))
    whole = {}
    for name in _WINDOW_COLUMNS:
        whole[name] = np.concatenate(columns.pop(name))
    points = WindowPoints(
        x_mm=whole["x"],
        y_mm=whole["y"],
        z_mm=whole["z"].astype(np.int64),
        return_number=whole["return_number"],
        return_count=whole["return_count"],
        classification=whole["classification"],
    )
    return LoadedWindow(points=points, core=core, duplicates=duplicates)


def _inside(records: npt.NDArray[np.void], window: Window) -> npt.NDArray[np.void]:
    """The records of a window."""
    return records[window.contains(records["x"], records["y"])]


def _parts(scratch: Scratch, tile: Tile) -> list[Path]:
    """The buckets of a tile, in the order of the inputs."""
    return sorted(Path(scratch.root, "points", tile.key).glob("*.bin"))


def split(task: SplitTask) -> Split:
    """Split one tile and store its points, sorted by fragment, and its terrain.

    Returns
    -------
    Split
        Descriptors; arrays are in scratch under `tiles/<tile>/`.

    Raises
    ------
    RunCancelledError
        The run was called off.
    """
    task.scratch.check_cancelled()
    loaded = load_window(task.scratch, task.grid, task.tile)
    points = loaded.points
    core, window = task.grid.core(task.tile), task.grid.window(task.tile)
    fragments: Fragments | None = None
    task.scratch.check_cancelled()
    if task.footprints is None:
        result = split_tile(points, core, window, task.settings, task.classes)
        index, owner = result.core_index, result.point_fragment.astype(np.int64)
        fragments, terrain, occupied, outliers = result.fragments, result.terrain, result.occupied, result.outliers
    else:
        terrain, kept, occupied = terrain_of(points, window, task.settings, task.classes)
        in_core = core.contains(points.x_mm, points.y_mm)
        outliers = int((in_core & ~kept).sum())
        index, owner = _inside_footprints(points, in_core & kept, terrain, task)
    is_building = points.classification[index] == BUILDING_CLASS
    assigned = owner >= 0
    audit = (
        int((assigned & is_building).sum()),
        int((assigned & ~is_building).sum()),
        int((~assigned & is_building).sum()),
    )
    keys, starts, lowest = _store(task, loaded.core[index[assigned]], owner[assigned])
    _store_terrain(task, terrain, occupied, core)
    return Split(
        tile=task.tile,
        fragments=fragments,
        starts=starts,
        keys=keys,
        lowest_points_mm=lowest,
        points=len(loaded.core),
        duplicates=loaded.duplicates,
        outliers=outliers,
        audit=audit,
    )


def _store(
    task: SplitTask, records: npt.NDArray[np.void], owner: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Store points sorted by owner; the owners, where each one's points start, and their smallest points."""
    order = np.lexsort((records["z"], records["y"], records["x"], owner))
    records, owner = records[order], owner[order]
    task.scratch.put_arrays(f"tiles/{task.tile.key}", {"points": records.view(np.uint8)})
    keys, starts = np.unique(owner, return_index=True)
    lowest = np.column_stack([records[name][starts] for name in "xyz"]).astype(np.int64)
    return keys, np.append(starts, len(owner)).astype(np.int64), lowest


def _store_terrain(task: SplitTask, terrain: Terrain, occupied: BoolArray, core: Window) -> None:
    """Store the terrain of the core and an apron around it.

    The apron lets a candidate at the data's edge see terrain whose own tile holds no point and so is never made.
    Where aprons overlap they agree.
    """
    apron = core.grown(APRON_MM)
    column0, row0, n_columns, n_rows = lattice_of(apron)
    rows = slice(row0 - terrain.row0, row0 - terrain.row0 + n_rows)
    columns = slice(column0 - terrain.column0, column0 - terrain.column0 + n_columns)
    task.scratch.put_arrays(
        f"tiles/{task.tile.key}",
        {
            "terrain": np.ascontiguousarray(terrain.elevation_mm[rows, columns]),
            "occupied": np.ascontiguousarray(occupied[rows, columns]),
            "corner": np.array([column0, row0], np.int64),
        },
    )


def _inside_footprints(
    points: WindowPoints, usable: BoolArray, terrain: Terrain, task: SplitTask
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices of the core's points and the footprint that holds each, -1 where none.

    Inside a footprint all points above the ground count, or those of class 6 where it is believed.
    """
    index = np.flatnonzero(usable)
    owner = np.full(len(index), -1, np.int64)
    x, y = points.x_mm[index], points.y_mm[index]
    height = height_above(x, y, points.z_mm[index], terrain.elevation_mm, terrain.column0, terrain.row0)
    above = (height == NO_DATA) | (height >= round(task.settings.ground.tolerance_m * MM))
    if task.classes.building:
        above = points.classification[index] == BUILDING_CLASS
    elif task.classes.ground:
        above &= points.classification[index] != GROUND_CLASS
    # the smaller number wins where footprints overlap, whatever the tile
    for number, polygon in sorted(task.footprints or (), key=lambda item: item[0], reverse=True):
        x0, y0, x1, y1 = (round(v * MM) for v in polygon.bounds)
        near = np.flatnonzero(above & (x >= x0 - 1) & (x <= x1 + 1) & (y >= y0 - 1) & (y <= y1 + 1))
        if len(near):
            shapely.prepare(polygon)
            owner[near[shapely.contains_xy(polygon, x[near] / MM, y[near] / MM)]] = number
    return index, owner
