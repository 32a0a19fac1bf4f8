"""Join: fragments become whole surfaces by union-find over the facets that cross tile borders; then they are judged.

The tiles have finished what no other tile sees, and hand on the rest by columns. Here one tile is read at a time, its
sites are made, and its columns wait for those of the others. No object is made of a fragment.
"""

from __future__ import annotations

import base64
import collections
import dataclasses
import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import IntArray
from pipeline.runtime.overrides.overrides_file import Override
from pipeline.runtime.stages.border_facets import united_by_name
from pipeline.runtime.stages.finished_surfaces import Finished, finished
from pipeline.runtime.stages.open_fragments import TileSurfaces
from pipeline.runtime.stages.split import Split
from pipeline.terrain.candidates import NOWHERE, Surfaces, Verdict, verdicts
from pipeline.terrain.settings import CandidateSettings
from pipeline.terrain.surfaces import N_SUMS, Sum
from pipeline.tiling import MM, Tile, TileGrid


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class PointRange:
    """A run of points in the sorted points of one tile."""

    tile: Tile
    start: int
    stop: int
    folder: str = "tiles"
    """Folder of the scratch that holds the tile's points."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class CandidateSite:
    """Where the points of one candidate lie."""

    building_id: str
    """As in the records."""
    owner: Tile
    """The tile of its smallest point: publishes it."""
    ranges: tuple[PointRange, ...]
    """Its points in scratch."""
    points: int
    """How many they are."""
    footprint: Polygon | MultiPolygon | None = None
    """Given footprint in metres; None where none was given."""
    source_id: str | None = None
    """Its own id."""
    source_attributes: str | None = None
    """The given footprint's columns as the text of a JSON object; None where none was given."""
    block: str | None = None
    """Of a unit: the id of the candidate that it was divided from."""
    outline: MultiPolygon | None = None
    """What it has of the outline drawn around touching units, in metres; None where it stands alone."""
    override: Override | None = None
    """What the user said of this building, as far as it took effect; None where nothing was."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class RejectedSite:
    """An object that was judged to be no building."""

    object_id: str
    """Made as a building_id."""
    owner: Tile
    """The tile of its smallest point."""
    verdict: Verdict
    """Why."""
    box_mm: tuple[int, int, int, int]
    """xmin, ymin, xmax, ymax of its facets."""
    area_m2: float
    """Plan area of its facets."""
    height_m: float
    """Mean height above the terrain."""
    points: int
    """Its points."""
    ranges: tuple[PointRange, ...] = ()
    """They in scratch, for whoever wants them modelled after all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joined:
    """The candidates of a run."""

    candidates: tuple[CandidateSite, ...]
    """Largest first, then by id."""
    rejected: tuple[RejectedSite, ...]
    """By id."""
    small_fragments: int
    """Surfaces below the size of an object: counted, not listed."""
    keys: Mapping[Tile, str] = dataclasses.field(default_factory=dict)
    """Digest of what lies in and around each tile: equal where nothing that comes after sees a difference."""


def object_id(crs_name: str, lowest_point_mm: Sequence[int]) -> str:
    """Identity of an object: base32 of a sha256 over the CRS and its lexicographically smallest point in mm.

    >>> object_id("EPSG:28992", (84900123, 447500000, 7000))
    'gjjf4vlm6iovpli7yu4hjko4'
    """
    text = f"{crs_name}|{lowest_point_mm[0]}|{lowest_point_mm[1]}|{lowest_point_mm[2]}"
    digest = hashlib.sha256(text.encode()).digest()
    return base64.b32encode(digest[:15]).decode().lower()


class _Waiting:
    """What waits of all tiles, by columns: of each a list with an array a tile; fragments and steps are counted on."""

    def __init__(self) -> None:
        self._columns: dict[str, list[npt.NDArray[Any]]] = collections.defaultdict(list)
        self.fragments = 0
        self.steps = 0

    def add(self, tile: int, found: TileSurfaces) -> None:
        """Take what waits of one more tile, by its number."""
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
        """A column of all tiles, with rows of that shape; it is held no longer."""
        parts = self._columns.pop(name, [])
        return np.concatenate(parts) if parts else np.empty((0, *shape), dtype)


def _whole_surfaces(waiting: _Waiting) -> tuple[Surfaces, IntArray]:
    """Unite fragments of several tiles to whole surfaces; and the ranges of their points, as `finished` takes them."""
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
    """Makes sites of what is finished."""

    grid: TileGrid
    settings: CandidateSettings
    crs_name: str
    candidates: list[CandidateSite] = dataclasses.field(default_factory=list)
    rejected: list[RejectedSite] = dataclasses.field(default_factory=list)
    tiles: dict[Tile, Tile] = dataclasses.field(default_factory=dict)

    def add(self, found: Finished, tiles: Sequence[Tile]) -> None:
        """The sites of what was finished somewhere; `tiles` by their numbers there."""
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


def join(splits: Iterable[Split], grid: TileGrid, settings: CandidateSettings, crs_name: str) -> Joined:
    """Finish the surfaces that several tiles see, and say where each candidate's points lie.

    Parameters
    ----------
    splits : iterable of Split
        All tiles, in any order; one is held at a time.
    grid : TileGrid
        The lattice, for the owners.
    settings : CandidateSettings
        What makes a surface a candidate: those of the splits.
    crs_name : str
        Goes into the ids.
    """
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
        candidates=tuple(sorted(sites.candidates, key=lambda c: (-c.points, c.building_id))),
        rejected=tuple(sorted(sites.rejected, key=lambda r: r.object_id)),
        small_fragments=small + rest.small,
    )


def join_footprints(
    splits: Iterable[Split],
    grid: TileGrid,
    numbers: Mapping[Tile, Sequence[int]],
    footprints: Sequence[Polygon | MultiPolygon],
    source_ids: Sequence[str],
    crs_name: str,
    attributes: Sequence[str | None] | None = None,
) -> Joined:
    """The candidates where footprints were given: one a footprint, also where it holds no point.

    Parameters
    ----------
    splits : iterable of Split
        All tiles, in any order.
    grid : TileGrid
        The lattice, for the owners.
    numbers : mapping
        By tile, the numbers of the footprints that its split knows by their place.
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
    return Joined(
        candidates=tuple(sorted(candidates, key=lambda c: (-c.points, c.building_id))), rejected=(), small_fragments=0
    )
