"""Split: every tile becomes surface fragments, or the points of given footprints."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import operator
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from shapely import MultiPolygon, Polygon

from pipeline.kernels.sorting import radix_order
from pipeline.model import IntArray
from pipeline.registry import extra
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import split_grid, window_bytes
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, Place, key_of, result_of
from pipeline.runtime.stages.cleanup import clear_tiles
from pipeline.runtime.stages.ground_stage import Ground, terrain_of_window, terrain_window
from pipeline.runtime.stages.ingested import Ingested, classes_in_use, content_by_tile, points_by_tile
from pipeline.runtime.stages.open_fragments import TileSurfaces, open_fragments
from pipeline.runtime.stages.tile_content import content_of_window
from pipeline.runtime.stages.window_points import LoadedWindow, folders_of, load_window, surroundings_of, terrain_around
from pipeline.scene import BUILDING_CLASS, SplitTile, split_tile
from pipeline.settings import RunSettings
from pipeline.terrain.lattice import CELL_MM
from pipeline.terrain.terrain_settings import ClassesInUse, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints, Outline


@dataclasses.dataclass(frozen=True, kw_only=True)
class Splits:
    """All tiles, split."""

    figures: tuple[SplitFigures, ...]
    """The figures of each."""
    places: Mapping[Tile, Place]
    """Where their descriptors are stored."""
    keys: Mapping[Tile, str]
    """Digest of what lies in and near each tile: equal where later stages see no difference."""
    numbers: Mapping[Tile, Sequence[int]]
    """By tile, the numbers of the given footprints that meet it; empty where none were given."""

    def stored(self, context: RunContext) -> Iterator[Split]:
        """The descriptors of all tiles in their order, read one after the other."""
        context.check(place.folder for place in self.places.values())
        return (
            result_of(context.scratch, place) for _, place in sorted(self.places.items(), key=operator.itemgetter(0))
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitWindows:
    """How a set of tiles is split."""

    grid: TileGrid
    """The lattice, with the halo that these settings need."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    outlines: Mapping[Tile, tuple[Outline, ...] | None]
    """The tiles in the order of their tasks, each with the footprints that meet it; None finds the buildings."""
    numbers: Mapping[Tile, Sequence[int]]
    """The numbers of these footprints."""
    folder: str = "tiles"
    """Folder of scratch for the outcome."""


def split(
    context: RunContext,
    settings: RunSettings,
    ingested: Sequence[Ingested],
    ground: Ground,
    footprints: GivenFootprints | None,
    only: Collection[Tile] | None = None,
) -> Splits:
    """Split all tiles, or only some."""
    plan, progress = context.plan, context.progress
    tiles = points_by_tile(ingested)
    classes, why = classes_in_use(ingested, trust=settings.general.classes == "trust")
    grid = split_grid(plan, settings, footprints=footprints is not None)
    if only is not None:
        tiles = Counter({tile: points for tile, points in tiles.items() if tile in only})
    if why:
        progress.warn("split", why)
    polygons: Sequence[Outline] = ()
    numbers: Mapping[Tile, Sequence[int]] = {}
    if footprints is not None:
        polygons = footprints.polygons
        numbers = extra("numbers_by_tile")(tiles, plan.grid, polygons)
    # the fullest first, so that no long task is left for the end
    order = [tile for tile, _ in sorted(tiles.items(), key=lambda item: (-item[1], item[0]))]
    outlines = {tile: None if footprints is None else tuple(polygons[k] for k in numbers[tile]) for tile in order}
    windows = SplitWindows(grid=grid, classes=classes, outlines=outlines, numbers=numbers)
    return split_windows(context, "split", windows, settings, ingested, ground)


def _read(task: SplitTask) -> set[str]:
    """The folders of scratch with the points and the terrain that the split of a tile sees."""
    return folders_of(task.grid.tiles_over(terrain_window(task.grid, task.tile)))


def _stored(task: SplitTask, _: SplitFigures) -> tuple[str, ...]:
    """The folder of scratch with the sorted points of a tile."""
    return (f"{task.folder}/{task.tile.key}",)


def split_windows(
    context: RunContext,
    stage: str,
    windows: SplitWindows,
    settings: RunSettings,
    ingested: Sequence[Ingested],
    ground: Ground,
) -> Splits:
    """Split some tiles, each with its own footprints."""
    content, points = content_by_tile(ingested), points_by_tile(ingested)
    plan_grid, grid, folder = context.plan.grid, windows.grid, windows.folder
    seen = {
        tile: (
            content_of_window(content, plan_grid, plan_grid.window(tile), tile),
            terrain_of_window(ground, plan_grid, tile),
        )
        for tile in windows.outlines
    }
    alike = key_of(grid, settings.scene, windows.classes, folder)
    tasks = {}
    for tile, outlines in windows.outlines.items():
        task = SplitTask(
            tile=tile,
            grid=grid,
            classes=windows.classes,
            scratch=context.scratch,
            footprints=outlines,
            folder=folder,
            memory_bytes=window_bytes(grid, tile, points),
        )
        key = key_of(alike, tile, outlines, seen[tile])
        tasks[Place(folder, tile.key, key)] = task
    clear_tiles(context.scratch, folder, tasks)
    function = functools.partial(split_window, settings=settings.scene)
    brief: Callable[[Split], SplitFigures] = operator.attrgetter("figures")
    stored = Files(reads=_read, leaves=_stored, intact=is_intact)
    found = context.map_stored(stage, function, tasks, brief, files=stored)
    return Splits(
        figures=tuple(found.values()),
        places={figures.tile: place for place, figures in found.items()},
        keys={figures.tile: key_of(figures.outcome, seen[figures.tile]) for figures in found.values()},
        numbers=windows.numbers,
    )


_PLACE_BITS = 20
"""Bits of a coordinate in a sort key: 1,048 m in millimetres."""


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
        from pipeline.runtime.stages.footprint_points import above_ground, inside_footprints

        above = above_ground(loaded.points, index, terrain, task.classes, settings.ground)
        owner = inside_footprints(loaded.points, index, above, task.footprints, task.grid)
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
