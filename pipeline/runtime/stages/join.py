"""Join: fragments become whole surfaces by union-find over the facets that cross tile borders; then they are judged.

The tiles have finished all surfaces that no other tile sees, and pass on the rest by columns. A task joins those of a
block of tiles, finishes what no tile outside of the block sees, and passes on the rest; one more task joins that. The
sites are then made tile by tile (`divided_units.py`). The driver holds no object per building, unless footprints are
given.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, IntArray
from pipeline.registry import extra
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import (
    Files,
    InParts,
    Place,
    brief_within,
    drop_outcomes,
    key_of,
    part_of,
    result_of,
)
from pipeline.runtime.stages.border_facets import are_beyond, united_by_name
from pipeline.runtime.stages.cleanup import clear_units
from pipeline.runtime.stages.divided_units import BorderSites, find_units
from pipeline.runtime.stages.open_fragments import BorderFacets, Finished, OpenSurfaces, finished
from pipeline.runtime.stages.sites import UNITS, Joined
from pipeline.runtime.stages.split import Split, Splits
from pipeline.runtime.stages.stored_sites import joined_of, may_touch, store_sites
from pipeline.runtime.stages.tile_sites import TileSitesFigures, by_owner, figures_of
from pipeline.terrain.candidates import NOWHERE, Surfaces
from pipeline.terrain.fragment_sums import N_SUMS
from pipeline.terrain.terrain_settings import CandidateSettings, SceneSettings
from pipeline.tiling import Tile, TileGrid

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints

_STAGE = "join"
_TILES_ACROSS = 8
"""Tiles along the side of a block. Few surfaces of a block of 64 tiles reach beyond it."""

_AT_ONCE = 64
"""So few tiles are joined by one task."""
Area = tuple[int, int, int, int]
"""First column, first row, last column, last row."""


class _Columns:
    """The open surfaces and steps of several tiles or blocks, by columns, numbered through."""

    def __init__(self, parts: Iterable[OpenSurfaces]) -> None:
        self._columns: dict[str, list[npt.NDArray[Any]]] = collections.defaultdict(list)
        self.surfaces = 0
        self.steps = 0
        tiles: dict[Tile, int] = {}
        for part in parts:
            self._add(part, np.array([tiles.setdefault(tile, len(tiles)) for tile in part.tiles], np.int64))
        self.tiles = tuple(tiles)

    def _add(self, part: OpenSurfaces, tile: IntArray) -> None:
        """Add those of one more tile or block; `tile` are the numbers of its tiles here."""
        ranges = part.ranges
        new: dict[str, npt.NDArray[Any]] = {
            "kind": part.kind,
            "sums": part.sums,
            "boxes": part.boxes_mm,
            "points": part.lowest_point_mm,
            "ranges": np.column_stack((ranges[:, 0] + self.surfaces, tile[ranges[:, 1]], ranges[:, 2:])),
            "reach": part.reach,
            "names": part.facets.names,
            "holders": part.facets.holders + np.int64(self.surfaces),
            "step_reach": part.step_reach,
            "step_names": part.step_facets.names,
            "step_holders": part.step_facets.holders + np.int64(self.steps),
            "along": part.along_steps + np.array([self.surfaces, self.steps], np.int64),
        }
        for name, column in new.items():
            if len(column):
                self._columns[name].append(column)
        self.surfaces += len(part.kind)
        self.steps += len(part.step_reach)

    def take(self, name: str, *shape: int, dtype: npt.DTypeLike = np.int64) -> npt.NDArray[Any]:
        """A column of all parts, with rows of that shape; its memory is released."""
        parts = self._columns.pop(name, [])
        return np.concatenate(parts) if parts else np.empty((0, *shape), dtype)


def united_surfaces(parts: Iterable[OpenSurfaces]) -> OpenSurfaces:
    """The surfaces of several tiles or blocks, as far as facets connect them; one row of facets per name."""
    columns = _Columns(parts)
    names, holders = columns.take("names", 2, dtype=np.uint64), columns.take("holders")
    step_names, step_holders = columns.take("step_names", 2, dtype=np.uint64), columns.take("step_holders")
    members, surface = _numbered(united_by_name(columns.surfaces, names, holders))
    step_members, step = _numbered(united_by_name(columns.steps, step_names, step_holders))
    k, s = len(members), len(step_members)
    sums = np.zeros((k, N_SUMS), np.int64)
    np.add.at(sums, surface, columns.take("sums", N_SUMS))
    points = columns.take("points", 3)
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], surface))
    along = columns.take("along", 2)
    pairs = np.unique(surface[along[:, 0]] * max(1, s) + step[along[:, 1]])
    ranges = columns.take("ranges", 4)
    ranges[:, 0] = surface[ranges[:, 0]]
    return OpenSurfaces(
        tiles=columns.tiles,
        kind=columns.take("kind", dtype=np.int8)[members],
        sums=sums,
        boxes_mm=_around(surface, k, columns.take("boxes", 4)),
        lowest_point_mm=points[order[np.searchsorted(surface[order], np.arange(k))]],
        ranges=ranges,
        reach=_around(surface, k, columns.take("reach", 4)),
        facets=_once(names, surface[holders]),
        step_reach=_around(step, s, columns.take("step_reach", 4)),
        step_facets=_once(step_names, step[step_holders]),
        along_steps=np.column_stack((pairs // max(1, s), pairs % max(1, s))),
    )


def _numbered(roots: IntArray) -> tuple[IntArray, IntArray]:
    """The smallest member of each set, and the set of each element, numbered from 0."""
    members, number = np.unique(roots, return_inverse=True)
    return members, number.reshape(-1)


def _around(number: IntArray, count: int, boxes: IntArray) -> IntArray:
    """The smallest box (count, 4) around the boxes of each number: two lower bounds, then two upper ones."""
    around = np.empty((count, 4), np.int64)
    around[:, :2], around[:, 2:] = NOWHERE, -NOWHERE
    np.minimum.at(around[:, :2], number, boxes[:, :2])
    np.maximum.at(around[:, 2:], number, boxes[:, 2:])
    return around


def _once(names: npt.NDArray[np.uint64], holders: IntArray) -> BorderFacets:
    """Facets of united holders, each name once: all that share it are one now."""
    _, first = np.unique(names, axis=0, return_index=True)
    return BorderFacets(names=names[first], holders=holders[first].astype(np.int32))


def finished_within(
    found: OpenSurfaces, area: Area | None, settings: CandidateSettings
) -> tuple[Finished, OpenSurfaces]:
    """The sites of united surfaces that no tile outside of an area sees, and the rest; all sites without an area.

    Surfaces that steps connect are finished together.
    """
    k = len(found.kind)
    waits = np.zeros(k + len(found.step_reach), np.bool_)
    if area is not None:
        pairs = found.along_steps
        piece = united(len(waits), pairs[:, 0], pairs[:, 1] + k)
        waits[piece[are_beyond(np.concatenate((found.reach, found.step_reach)), area)]] = True
        waits = waits[piece]
    done = _chosen(found, ~waits[:k], ~waits[k:])
    whole = Surfaces(
        kind=done.kind,
        sums=done.sums,
        boxes_mm=done.boxes_mm,
        lowest_point_mm=done.lowest_point_mm,
        along_steps=done.along_steps,
    )
    return finished(whole, done.ranges, settings), _chosen(found, waits[:k], waits[k:])


def _chosen(found: OpenSurfaces, surfaces: BoolArray, steps: BoolArray) -> OpenSurfaces:
    """Some of the surfaces and all that belongs to them; none of the steps along them is left out."""
    number, step_number = np.cumsum(surfaces) - 1, np.cumsum(steps) - 1
    ranges = found.ranges[surfaces[found.ranges[:, 0]]]
    along = found.along_steps[surfaces[found.along_steps[:, 0]]]
    return OpenSurfaces(
        tiles=found.tiles,
        kind=found.kind[surfaces],
        sums=found.sums[surfaces],
        boxes_mm=found.boxes_mm[surfaces],
        lowest_point_mm=found.lowest_point_mm[surfaces],
        ranges=np.column_stack((number[ranges[:, 0]], ranges[:, 1:])),
        reach=found.reach[surfaces],
        facets=_facets_of(found.facets, surfaces, number),
        step_reach=found.step_reach[steps],
        step_facets=_facets_of(found.step_facets, steps, step_number),
        along_steps=np.column_stack((number[along[:, 0]], step_number[along[:, 1]])),
    )


def _facets_of(facets: BorderFacets, chosen: BoolArray, number: IntArray) -> BorderFacets:
    own = chosen[facets.holders]
    return BorderFacets(names=facets.names[own], holders=number[facets.holders[own]].astype(np.int32))


# --- tasks -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class JoinTask:
    """Tiles, or blocks of tiles, to be joined."""

    splits: tuple[Place, ...]
    """Outcomes of the splits of the tiles; empty for blocks."""
    blocks: tuple[tuple[Place, int], ...]
    """Outcomes of the blocks, and the parts with what they passed on."""
    area: Area | None
    """The block; None finishes everything."""
    settings: CandidateSettings
    """What is a candidate."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Holds all of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JoinBrief:
    """What the driver learns of a join."""

    owned: tuple[TileSitesFigures, ...]
    """The finished sites by owner, in the order of the parts of the outcome."""
    passed_on: str
    """Digest of the last part, what waits for other blocks; empty where nothing does."""
    small_fragments: int
    """Surfaces below the size of an object."""


def join_surfaces(task: JoinTask) -> InParts[JoinBrief]:
    """Join the surfaces of some tiles, or of some blocks: the finished sites by owner, then what is passed on."""
    scratch = task.scratch

    def parts() -> Iterable[OpenSurfaces]:
        for place in task.splits:
            scratch.check_cancelled()
            split: Split = result_of(scratch, place)
            if split.surfaces is not None:
                yield split.surfaces.open
        for place, part in task.blocks:
            yield part_of(scratch, place, part)

    found = united_surfaces(parts())
    done, rest = finished_within(found, task.area, task.settings)
    owned = by_owner(done, found.tiles, task.grid)
    waits = len(rest.kind) + len(rest.step_reach) > 0
    return InParts(
        parts=(*owned.values(), *((rest,) if waits else ())),
        brief=JoinBrief(
            owned=tuple(figures_of(owner, sites) for owner, sites in owned.items()),
            passed_on=key_of(rest) if waits else "",
            small_fragments=done.small,
        ),
    )


def join(
    context: RunContext,
    settings: SceneSettings,
    roof: RoofSettings,
    splits: Splits,
    footprints: GivenFootprints | None,
    *,
    outlines: bool = True,
) -> Joined:
    """The candidates of all tiles, divided into units, and the rejected objects; one per footprint where given.

    The outlines of touching units are drawn, unless nothing needs them.
    """
    plan = context.plan
    crs_name = plan.reference.named
    if footprints is not None:
        with context.progress.stage(_STAGE, 1) as counter:
            found = extra("join_footprints")(
                splits.stored(context),
                plan.grid,
                splits.numbers,
                footprints.polygons,
                footprints.ids,
                crs_name,
                footprints,
            )
            counter.add(1)
        clear_units(context.scratch, ())
        return joined_of(store_sites(context, UNITS, found, quiet=False), 0, splits.keys)
    borders = _joined_borders(context, settings.candidates, splits)
    small = sum(figures.small for figures in splits.figures) + sum(brief.small_fragments for brief in borders.values())
    owned = [
        BorderSites(place=place, part=part, figures=figures)
        for place, brief in borders.items()
        for part, figures in enumerate(brief.owned)
    ]
    units = find_units(context, settings, roof, splits, owned, crs_name, outlines=outlines)
    joined = joined_of(units, small, splits.keys)
    if outlines and may_touch(units.values()):
        from pipeline.runtime.stages.touching import drawn_apart

        joined = drawn_apart(context, roof, joined)
    return joined


def _joined_borders(context: RunContext, settings: CandidateSettings, splits: Splits) -> dict[Place, JoinBrief]:
    """What reaches beyond its tile, joined within blocks of tiles, then between them."""
    scratch, grid = context.scratch, context.plan.grid
    tasks: dict[Place, JoinTask] = {}
    blocks: Mapping[tuple[int, int], tuple[Area | None, list[Tile]]] = blocks_of(splits.places, _TILES_ACROSS)
    if len(splits.places) <= _AT_ONCE:
        blocks = {(0, 0): (None, sorted(splits.places))}
    for (column, row), (area, tiles) in blocks.items():
        places = tuple(splits.places[tile] for tile in tiles)
        key = key_of(settings, grid, area, places)
        place = Place(_STAGE, f"block_x{column}_y{row}", key)
        tasks[place] = JoinTask(splits=places, blocks=(), area=area, settings=settings, grid=grid, scratch=scratch)
    found = _run(context, tasks)
    passing = tuple((place, len(brief.owned)) for place, brief in found.items() if brief.passed_on)
    if passing:
        place = Place(_STAGE, "blocks", key_of(settings, grid, [found[place].passed_on for place, _ in passing]))
        final = JoinTask(splits=(), blocks=passing, area=None, settings=settings, grid=grid, scratch=scratch)
        found |= _run(context, {place: final}, quiet=True)
    drop_outcomes(scratch, _STAGE, found)
    return found


def _run(context: RunContext, tasks: Mapping[Place, JoinTask], *, quiet: bool = False) -> dict[Place, JoinBrief]:
    files: Files[JoinTask, JoinBrief] = Files(reads=_read)
    return context.map_stored(_STAGE, join_surfaces, tasks, brief_within, files=files, quiet=quiet)


def _read(task: JoinTask) -> set[str]:
    """The folders of scratch with the surfaces of a task."""
    return {place.folder for place in task.splits} | {place.folder for place, _ in task.blocks}


def blocks_of(tiles: Iterable[Tile], across: int) -> dict[tuple[int, int], tuple[Area, list[Tile]]]:
    """Tiles by square blocks of so many across, and the area of each."""
    blocks: dict[tuple[int, int], tuple[Area, list[Tile]]] = {}
    for tile in sorted(tiles):
        column, row = tile.column // across, tile.row // across
        area = column * across, row * across, (column + 1) * across - 1, (row + 1) * across - 1
        blocks.setdefault((column, row), (area, []))[1].append(tile)
    return blocks
