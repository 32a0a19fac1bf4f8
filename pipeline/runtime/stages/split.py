"""Split: every tile becomes surface fragments, or the points of given footprints."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.registry import extra
from pipeline.runtime.plan import split_grid, window_bytes
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.kept_files import Files
from pipeline.runtime.scratch.outcomes import Place, key_of, result_of
from pipeline.runtime.stages.cleanup import clear_tiles
from pipeline.runtime.stages.ground import Ground, terrain_of_window, terrain_window
from pipeline.runtime.stages.ingested import Ingested, classes_in_use, content_by_tile, points_by_tile
from pipeline.runtime.stages.split_window import Split, SplitFigures, SplitTask, is_intact, split_window
from pipeline.runtime.stages.tile_content import content_of_window
from pipeline.runtime.stages.window_points import folders_of
from pipeline.settings import RunSettings
from pipeline.terrain.scene_settings import ClassesInUse
from pipeline.tiling import Tile, TileGrid

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
