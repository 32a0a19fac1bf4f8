"""Join: fragments become whole surfaces by union-find over the facets that cross tile borders; then they are judged.

The tiles have finished all surfaces that no other tile sees, and pass on the rest by columns. The join reads one tile
at a time, makes its sites, and collects its columns with those of the others. It makes no object per fragment.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import IntArray
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.border_facets import united_by_name
from pipeline.runtime.stages.finished_surfaces import Finished, finished
from pipeline.runtime.stages.given_footprints import GivenFootprints, Outline
from pipeline.runtime.stages.open_fragments import TileSurfaces
from pipeline.runtime.stages.sites import CandidateSite, Joined, PointRange, RejectedSite, largest_first, object_id
from pipeline.runtime.stages.split import Splits
from pipeline.runtime.stages.split_window import Split
from pipeline.runtime.stages.units import divide_units
from pipeline.terrain.candidates import NOWHERE, Surfaces, verdicts
from pipeline.terrain.fragment_sums import N_SUMS, Sum
from pipeline.terrain.scene_settings import SceneSettings
from pipeline.terrain.settings import CandidateSettings
from pipeline.tiling import MM, Tile, TileGrid


class _Waiting:
    """The fragments and steps of all tiles that wait for other tiles, by columns, numbered through."""

    def __init__(self) -> None:
        self._columns: dict[str, list[npt.NDArray[Any]]] = collections.defaultdict(list)
        self.fragments = 0
        self.steps = 0

    def add(self, tile: int, found: TileSurfaces) -> None:
        """Add the open fragments of one more tile, by its number."""
        held = np.flatnonzero(found.ranges[:, 1] > found.ranges[:, 0])
        new: dict[str, npt.NDArray[Any]] = {
            "kind": found.kind,
            "sums": found.sums,
            "boxes": found.boxes_mm,
            "points": found.lowest_point_mm,
            "ranges": np.column_stack((held + self.fragments, np.full(len(held), tile), found.ranges[held])),
            "names": found.facets.names,
            "holders": found.facets.holders + np.int64(self.fragments),
            "step_names": found.step_facets.names,
            "step_holders": found.step_facets.holders + np.int64(self.steps),
            "along": found.along_steps + np.array([self.fragments, self.steps], np.int64),
        }
        for name, column in new.items():
            if len(column):
                self._columns[name].append(column)
        self.fragments += len(found.kind)
        self.steps += found.steps

    def take(self, name: str, *shape: int, dtype: npt.DTypeLike = np.int64) -> npt.NDArray[Any]:
        """A column of all tiles, with rows of that shape; its memory is released."""
        parts = self._columns.pop(name, [])
        return np.concatenate(parts) if parts else np.empty((0, *shape), dtype)


def _whole_surfaces(waiting: _Waiting) -> tuple[Surfaces, IntArray]:
    """Whole surfaces, united from the fragments of several tiles, and the ranges of their points for `finished`."""
    count, steps = waiting.fragments, waiting.steps
    roots = united_by_name(count, waiting.take("names", 2, dtype=np.uint64), waiting.take("holders"))
    step = united_by_name(steps, waiting.take("step_names", 2, dtype=np.uint64), waiting.take("step_holders"))
    members, surface = np.unique(roots, return_inverse=True)
    surface = surface.reshape(-1)
    k = len(members)
    sums = np.zeros((k, N_SUMS), np.int64)
    np.add.at(sums, surface, waiting.take("sums", N_SUMS))
    boxes = np.empty((k, 4), np.int64)
    boxes[:, :2], boxes[:, 2:] = NOWHERE, -NOWHERE
    of_fragments = waiting.take("boxes", 4)
    np.minimum.at(boxes[:, :2], surface, of_fragments[:, :2])
    np.maximum.at(boxes[:, 2:], surface, of_fragments[:, 2:])
    del of_fragments
    points = waiting.take("points", 3)
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], surface))
    first = order[np.searchsorted(surface[order], np.arange(k))]
    along = waiting.take("along", 2)
    pairs = np.unique(surface[along[:, 0]] * max(1, steps) + step[along[:, 1]])
    whole = Surfaces(
        kind=waiting.take("kind", dtype=np.int8)[members],
        sums=sums,
        boxes_mm=boxes,
        lowest_point_mm=points[first],
        along_steps=np.column_stack((pairs // max(1, steps), pairs % max(1, steps))),
    )
    ranges = waiting.take("ranges", 4)
    ranges[:, 0] = surface[ranges[:, 0]]
    return whole, ranges


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Sites:
    """Makes sites from finished surfaces."""

    grid: TileGrid
    settings: CandidateSettings
    crs_name: str
    candidates: list[CandidateSite] = dataclasses.field(default_factory=list)
    rejected: list[RejectedSite] = dataclasses.field(default_factory=list)
    tiles: dict[Tile, Tile] = dataclasses.field(default_factory=dict)

    def add(self, found: Finished, tiles: Sequence[Tile]) -> None:
        """Add the sites of some finished surfaces; `tiles` by their numbers there."""
        of_candidates = _site_ranges(found.candidate_ranges, len(found.candidate_points_mm), tiles)
        for point, ranges in zip(found.candidate_points_mm.tolist(), of_candidates, strict=True):
            self.candidates.append(
                CandidateSite(
                    building_id=object_id(self.crs_name, point),
                    owner=self._owner(point),
                    ranges=ranges,
                    points=sum(part.stop - part.start for part in ranges),
                )
            )
        judged = verdicts(found.kind, found.sums, self.settings)
        of_rejected = _site_ranges(found.rejected_ranges, len(found.kind), tiles)
        lowest, boxes = found.lowest_point_mm.tolist(), found.boxes_mm.tolist()
        for verdict, point, box, sums, ranges in zip(judged, lowest, boxes, found.sums, of_rejected, strict=True):
            assert verdict is not None
            self.rejected.append(
                RejectedSite(
                    object_id=object_id(self.crs_name, point),
                    owner=self._owner(point),
                    verdict=verdict,
                    box_mm=tuple(box),
                    area_m2=float(sums[Sum.AREA2]) / 2e6,
                    height_m=float(sums[Sum.HEIGHT]) / max(1, int(sums[Sum.VERTICES])) / 1000.0,
                    points=int(sums[Sum.POINTS]),
                    ranges=ranges,
                )
            )

    def _owner(self, point_mm: Sequence[int]) -> Tile:
        """The tile of a point; one object for all sites of a tile, since these are many."""
        tile = self.grid.tile_of(point_mm[0], point_mm[1])
        return self.tiles.setdefault(tile, tile)


def _site_ranges(ranges: IntArray, count: int, tiles: Sequence[Tile]) -> Iterator[tuple[PointRange, ...]]:
    """Point ranges of each of `count` sites, by tile, then start; `ranges` as in `Finished`."""
    place = np.empty(len(tiles), np.int64)
    place[sorted(range(len(tiles)), key=tiles.__getitem__)] = np.arange(len(tiles))
    ordered = ranges[np.lexsort((ranges[:, 2], place[ranges[:, 1]], ranges[:, 0]))]
    first = np.searchsorted(ordered[:, 0], np.arange(count + 1)).tolist()
    for begin, end in itertools.pairwise(first):
        yield tuple(
            PointRange(tile=tiles[tile], start=start, stop=stop) for _, tile, start, stop in ordered[begin:end].tolist()
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class JoinTask:
    """All tiles, to be joined."""

    splits: Splits
    """Where their descriptors are."""
    scratch: Scratch
    """The run's scratch."""
    grid: TileGrid
    """The lattice."""
    crs_name: str
    """Goes into the ids."""


def join(
    context: RunContext,
    settings: SceneSettings,
    min_strip_offset_m: float,
    splits: Splits,
    footprints: GivenFootprints | None,
) -> Joined:
    """The candidates of all tiles, divided into units, and the rejected objects; one per footprint where given.

    Strips that disagree by more than `min_strip_offset_m` are aligned before units are separated.
    """
    plan, progress = context.plan, context.progress
    started = time.perf_counter()
    progress.tell("stage", "join", total=1)
    crs_name = f"EPSG:{plan.reference.epsg}" if plan.reference.epsg is not None else plan.reference.name
    if footprints is None:
        task = JoinTask(splits=splits, scratch=context.scratch, grid=plan.grid, crs_name=crs_name)
        function = functools.partial(_joined, settings=settings.candidates)
        joined = context.executor.run_step("join", function, task, progress.watch)
        joined = dataclasses.replace(joined, keys=splits.keys)
        joined = divide_units(context, settings.units, min_strip_offset_m, joined, crs_name)
    else:
        joined = join_footprints(
            splits.stored(context.scratch),
            plan.grid,
            splits.numbers,
            footprints.polygons,
            footprints.ids,
            crs_name,
            footprints.attributes,
        )
        joined = dataclasses.replace(joined, keys=splits.keys)
    progress.timings["join"] = time.perf_counter() - started
    progress.tell("progress", "join", f"{len(joined.candidates)} candidates", done=1, total=1)
    return joined


def _joined(task: JoinTask, settings: CandidateSettings) -> Joined:
    """The tiles of a task, joined; a process that has the kernels does this."""
    return join_tiles(task.splits.stored(task.scratch), task.grid, settings, task.crs_name)


def join_tiles(splits: Iterable[Split], grid: TileGrid, settings: CandidateSettings, crs_name: str) -> Joined:
    """Finish the surfaces that several tiles see, and find where each candidate's points lie."""
    waiting, tiles, small = _Waiting(), list[Tile](), 0
    sites = _Sites(grid=grid, settings=settings, crs_name=crs_name)
    for split in splits:
        if split.surfaces is not None:
            sites.add(split.surfaces.done, [split.tile])
            small += split.surfaces.done.small
            waiting.add(len(tiles), split.surfaces)
        tiles.append(split.tile)
    rest = finished(*_whole_surfaces(waiting), settings)
    sites.add(rest, tiles)
    return Joined(
        candidates=largest_first(sites.candidates),
        rejected=tuple(sorted(sites.rejected, key=lambda r: r.object_id)),
        small_fragments=small + rest.small,
    )


def join_footprints(
    splits: Iterable[Split],
    grid: TileGrid,
    numbers: Mapping[Tile, Sequence[int]],
    footprints: Sequence[Outline],
    source_ids: Sequence[str],
    crs_name: str,
    attributes: Sequence[str | None] | None = None,
) -> Joined:
    """The candidates where footprints were given: one per footprint, also where it holds no point; splits in any order.

    Parameters
    ----------
    numbers : mapping
        By tile, the numbers of its footprints; its split numbers them from 0.
    footprints, source_ids : sequences
        The given outlines in metres, in the order of their numbers, and their own ids.
    crs_name : str
        Goes into the ids. A footprint without points is named by its smallest corner and its own id.
    attributes : sequence of str or None, optional
        Their columns, each as the text of a JSON object.
    """
    ranges: dict[int, list[PointRange]] = {}
    lowest: dict[int, tuple[int, ...]] = {}
    for s in sorted(splits, key=lambda s: s.tile):
        if s.footprints is None:
            continue
        held = s.footprints
        starts = held.starts.tolist()
        for j, (key, point) in enumerate(zip(held.keys.tolist(), held.lowest_points_mm.tolist(), strict=True)):
            owner = numbers[s.tile][key]
            ranges.setdefault(owner, []).append(PointRange(tile=s.tile, start=starts[j], stop=starts[j + 1]))
            lowest[owner] = min(lowest.get(owner, tuple(point)), tuple(point))
    candidates = []
    for number, (footprint, source_id) in enumerate(zip(footprints, source_ids, strict=True)):
        name, point = crs_name, lowest.get(number)
        if point is None:
            corner = min(map(tuple, shapely.get_coordinates(footprint).tolist()))
            name, point = f"{crs_name}|{source_id}", (round(corner[0] * MM), round(corner[1] * MM), 0)
        found = ranges.get(number, [])
        candidates.append(
            CandidateSite(
                building_id=object_id(name, point),
                owner=grid.tile_of(point[0], point[1]),
                ranges=tuple(found),
                points=sum(r.stop - r.start for r in found),
                footprint=footprint,
                source_id=source_id,
                source_attributes=None if attributes is None else attributes[number],
            )
        )
    return Joined(candidates=largest_first(candidates), rejected=(), small_fragments=0)
