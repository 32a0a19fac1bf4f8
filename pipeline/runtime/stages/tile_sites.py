"""Finished surfaces as sites: cut by the tiles that own them, and made to candidates and rejected objects there."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from pipeline.model import IntArray
from pipeline.runtime.scratch.outcomes import key_of
from pipeline.runtime.stages.open_fragments import Finished
from pipeline.runtime.stages.sites import CandidateSite, FoundSites, PointRange, RejectedSite, largest_first, object_id
from pipeline.terrain.candidates import verdicts
from pipeline.terrain.fragment_sums import Sum
from pipeline.terrain.terrain_settings import CandidateSettings
from pipeline.tiling import Tile, TileGrid


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileSites:
    """Finished surfaces of one owner, by columns."""

    found: Finished
    """The surfaces."""
    tiles: tuple[Tile, ...]
    """The tiles in which their points lie, by number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileSitesFigures:
    """What the driver knows of them."""

    owner: Tile
    """The tile that publishes them."""
    points: int
    """Points of the candidates."""
    tiles: tuple[Tile, ...]
    """The tiles in which all of them lie, sorted."""
    digest: str
    """Of all that is stored of them."""


def figures_of(owner: Tile, sites: TileSites) -> TileSitesFigures:
    """What the driver needs to know."""
    return TileSitesFigures(
        owner=owner,
        points=sites.found.candidate_points,
        tiles=tuple(sorted(sites.tiles)),
        digest=key_of(sites),
    )


def by_owner(found: Finished, tiles: Sequence[Tile], grid: TileGrid) -> dict[Tile, TileSites]:
    """Finished surfaces by the tile of their smallest point, which publishes them; `tiles` by their numbers there."""
    candidates = _shares(found.candidate_points_mm, found.candidate_ranges, grid)
    rejected = _shares(found.lowest_point_mm, found.rejected_ranges, grid)
    owned = {}
    for owner in sorted({*candidates, *rejected}):
        own, own_ranges = candidates.get(owner, _NOTHING)
        others, other_ranges = rejected.get(owner, _NOTHING)
        used, number = np.unique(np.concatenate((own_ranges[:, 1], other_ranges[:, 1])), return_inverse=True)
        of_own, of_others = np.split(number.reshape(-1), [len(own_ranges)])
        owned[owner] = TileSites(
            found=Finished(
                candidate_points_mm=found.candidate_points_mm[own],
                candidate_ranges=np.column_stack((own_ranges[:, 0], of_own, own_ranges[:, 2:])),
                candidate_is_glass=found.candidate_is_glass[own],
                kind=found.kind[others],
                sums=found.sums[others],
                boxes_mm=found.boxes_mm[others],
                lowest_point_mm=found.lowest_point_mm[others],
                rejected_ranges=np.column_stack((other_ranges[:, 0], of_others, other_ranges[:, 2:])),
                small=0,
            ),
            tiles=tuple(tiles[k] for k in used.tolist()),
        )
    return owned


_NOTHING = (np.empty(0, np.int64), np.empty((0, 4), np.int64))


def _shares(points_mm: IntArray, ranges: IntArray, grid: TileGrid) -> dict[Tile, tuple[IntArray, IntArray]]:
    """The sites of each owner by their smallest points (n, 3), and their `ranges`, in which they are numbered anew."""
    places = np.column_stack(grid.columns_rows(points_mm[:, 0], points_mm[:, 1]))
    owners, owner = np.unique(places, axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    order = np.argsort(owner, kind="stable")
    first = np.searchsorted(owner[order], np.arange(len(owners) + 1))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - first[owner[order]]
    of_range = owner[ranges[:, 0]]
    range_order = np.argsort(of_range, kind="stable")
    range_first = np.searchsorted(of_range[range_order], np.arange(len(owners) + 1))
    numbered = np.column_stack((rank[ranges[:, 0]], ranges[:, 1:]))[range_order]
    return {
        Tile(column, row): (order[first[k] : first[k + 1]], numbered[range_first[k] : range_first[k + 1]])
        for k, (column, row) in enumerate(owners.tolist())
    }


def sites_of(parts: Iterable[TileSites], grid: TileGrid, settings: CandidateSettings, crs_name: str) -> FoundSites:
    """The sites of some finished surfaces; the name of the CRS goes into their ids."""
    candidates: list[CandidateSite] = []
    rejected: list[RejectedSite] = []
    owners: dict[Tile, Tile] = {}

    def owner_of(point_mm: Sequence[int]) -> Tile:
        # one object for all sites of a tile, since these are many
        tile = grid.tile_of(point_mm[0], point_mm[1])
        return owners.setdefault(tile, tile)

    for part in parts:
        found = part.found
        of_candidates = _site_ranges(found.candidate_ranges, len(found.candidate_points_mm), part.tiles)
        columns = found.candidate_points_mm.tolist(), of_candidates, found.candidate_is_glass.tolist()
        for point, ranges, is_glass in zip(*columns, strict=True):
            candidates.append(
                CandidateSite(
                    building_id=object_id(crs_name, point),
                    owner=owner_of(point),
                    ranges=ranges,
                    points=sum(one.stop - one.start for one in ranges),
                    is_glass=is_glass,
                )
            )
        judged = verdicts(found.kind, found.sums, settings)
        of_rejected = _site_ranges(found.rejected_ranges, len(found.kind), part.tiles)
        lowest, boxes = found.lowest_point_mm.tolist(), found.boxes_mm.tolist()
        for verdict, point, box, sums, ranges in zip(judged, lowest, boxes, found.sums, of_rejected, strict=True):
            assert verdict is not None
            rejected.append(
                RejectedSite(
                    object_id=object_id(crs_name, point),
                    owner=owner_of(point),
                    verdict=verdict,
                    box_mm=tuple(box),
                    area_m2=float(sums[Sum.AREA2]) / 2e6,
                    height_m=float(sums[Sum.HEIGHT]) / max(1, int(sums[Sum.VERTICES])) / 1000.0,
                    points=int(sums[Sum.POINTS]),
                    ranges=ranges,
                    planar=int(sums[Sum.PLANAR]),
                    rough=int(sums[Sum.ROUGH]),
                )
            )
    return FoundSites(candidates=largest_first(candidates), rejected=tuple(sorted(rejected, key=lambda r: r.object_id)))


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
