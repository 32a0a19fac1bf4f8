"""Split of one tile: its window of points becomes surface fragments, or the points of given footprints."""

from __future__ import annotations

import dataclasses
import hashlib
import math

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.kernels.sorting import radix_order
from pipeline.model import BoolArray, IntArray
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import key_of
from pipeline.runtime.stages.open_fragments import TileSurfaces, open_fragments
from pipeline.runtime.stages.surroundings import surroundings_of, terrain_around
from pipeline.runtime.stages.window_points import LoadedWindow, load_window
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, SplitTile, WindowPoints, never_roof, split_tile
from pipeline.terrain.ground import Terrain, ground_points
from pipeline.terrain.lattice import CELL_MM
from pipeline.terrain.settings import ClassesInUse, GroundSettings, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid

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
    """The lattice, its halo as wide as `SceneSettings.split_support_m` asks for."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    scratch: Scratch
    """Points and terrain in, fragments out."""
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


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class SplitFigures:
    """The figures of one tile, which travel to the driver."""

    tile: Tile
    """The tile."""
    points: int
    """Points of the core, without duplicates."""
    audit: tuple[int, int, int]
    """Points of the core: assigned and class 6, assigned and not, class 6 and not assigned."""
    outcome: str
    """Digest of the stored points: equal where later stages see no difference."""
    sites: str = ""
    """Digest of the candidates and rejected objects that no other tile sees; empty where there are none."""
    candidate_points: int = 0
    """Points of these candidates."""
    small: int = 0
    """Surfaces below the size of an object that no other tile sees."""


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
    """Split one tile and store its points, sorted by fragment.

    They are in scratch under `<folder>/<tile>/`.
    """
    task.scratch.check_cancelled()
    loaded = load_window(task.scratch, task.grid, task.tile)
    core = task.grid.core(task.tile)
    # one cell more for heights between the middles of cells, one for the slope there
    near = core.grown(math.ceil(settings.terrain_m(footprints=task.footprints is not None) * MM) + 2 * CELL_MM)
    terrain = terrain_around(surroundings_of(task.scratch, task.grid, near))
    task.scratch.check_cancelled()
    result: SplitTile | None = None
    if task.footprints is None:
        kept = np.flatnonzero(loaded.kept)
        points = loaded.points if len(kept) == len(loaded.points) else loaded.points.take(kept)
        result = split_tile(points, core, terrain, settings, task.classes)
        index, owner = kept[result.core_index], result.point_fragment.astype(np.int64)
    else:
        index = np.flatnonzero(loaded.kept[: len(loaded.core)])
        above = _above_ground(loaded.points, index, terrain, task.classes, settings.ground)
        owner = _inside_footprints(loaded.points, index, above, task)
    points = loaded.points
    is_building = points.classification[index] == BUILDING_CLASS
    assigned = owner >= 0
    audit = (
        int((assigned & is_building).sum()),
        int((assigned & ~is_building).sum()),
        int((~assigned & is_building).sum()),
    )
    keys, starts, lowest, outcome = _store(task, loaded, index[assigned], owner[assigned])
    surfaces, footprints = None, None
    if result is None:
        footprints = FootprintPoints(starts=starts, keys=keys, lowest_points_mm=lowest)
    else:
        cut, judging = settings.surfaces, settings.candidates
        surfaces = open_fragments(result.fragments, keys, starts, task.tile, task.grid, cut, judging)
    done = None if surfaces is None else surfaces.done
    figures = SplitFigures(
        tile=task.tile,
        points=len(loaded.core),
        audit=audit,
        outcome=outcome,
        sites=key_of(done) if done is not None and len(done.candidate_points_mm) + len(done.kind) else "",
        candidate_points=0 if done is None else done.candidate_points,
        small=0 if done is None else done.small,
    )
    return Split(tile=task.tile, surfaces=surfaces, footprints=footprints, figures=figures)


def is_intact(task: SplitTask, figures: SplitFigures, folder: str) -> bool:
    """Whether a tile's points in a folder of scratch are as they were stored."""
    stored = task.scratch.array(folder, "points", mapped=True)
    return hashlib.sha256(np.ascontiguousarray(stored).data).hexdigest() == figures.outcome


def _store(
    task: SplitTask, loaded: LoadedWindow, index: IntArray, owner: IntArray
) -> tuple[IntArray, IntArray, IntArray, str]:
    """Store points of the core, (n,) indices, sorted by owner.

    Returns the owners, where each one's points start, their smallest points, and a digest.
    """
    points = loaded.points
    order = _order_by_owner(points.x_mm[index], points.y_mm[index], points.z_mm[index], owner)
    records, owner = np.take(loaded.core, index[order]), owner[order]
    content = records.view(np.uint8)
    task.scratch.put_arrays(f"{task.folder}/{task.tile.key}", {"points": content})
    is_first = np.ones(len(owner), np.bool_)
    is_first[1:] = owner[1:] != owner[:-1]
    starts = np.flatnonzero(is_first)
    lowest = np.column_stack([records[name][starts] for name in "xyz"]).astype(np.int64)
    return (
        owner[starts],
        np.append(starts, len(owner)).astype(np.int64),
        lowest,
        hashlib.sha256(content.data).hexdigest(),
    )


def _order_by_owner(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, owner: IntArray) -> IntArray:
    """Indices that sort points by owner, then x, y and z.

    Owner, x and y are packed into one key where a tile is small enough for it: one sort of integers in place of four.
    """
    if len(owner) == 0:
        return np.empty(0, np.int64)
    x, y = x_mm - x_mm.min(), y_mm - y_mm.min()
    if max(int(x.max()), int(y.max())) >> _PLACE_BITS or int(owner.max()) >> (63 - 2 * _PLACE_BITS):
        return np.lexsort((z_mm, y, x, owner)).astype(np.int64)
    key = (owner << 2 * _PLACE_BITS) | (x << _PLACE_BITS) | y
    order = radix_order(key).astype(np.int64)
    key = key[order]
    tied = np.flatnonzero(key[1:] == key[:-1])
    if len(tied):
        rows = np.unique(np.concatenate((tied, tied + 1)))
        points = order[rows]
        order[rows] = points[np.lexsort((points, z_mm[points], key[rows]))]
    return order


def _above_ground(
    points: WindowPoints, index: IntArray, terrain: Terrain, classes: ClassesInUse, settings: GroundSettings
) -> BoolArray:
    """Whether each of the points at `index` counts inside a footprint.

    Where class 6 is believed its points count, else all above the ground that are not of a class that is never roof.
    """
    if classes.building:
        is_building: BoolArray = points.classification[index] == BUILDING_CLASS
        return is_building
    above = ~ground_points(points.x_mm[index], points.y_mm[index], points.z_mm[index], terrain, settings)
    if classes.ground:
        above &= points.classification[index] != GROUND_CLASS
    if classes.roofs:
        above |= points.classification[index] == BUILDING_CLASS
    return above & ~never_roof(points.classification[index], classes)


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
