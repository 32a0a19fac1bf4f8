"""The candidates of given footprints."""

from __future__ import annotations

import collections
from collections.abc import Iterable, Mapping, Sequence

import shapely

from pipeline.extras.footprints.given_footprints import GivenFootprints, Outline
from pipeline.runtime.stages.sites import CandidateSite, FoundSites, PointRange, largest_first, object_id
from pipeline.runtime.stages.split import Split
from pipeline.tiling import MM, Tile, TileGrid


def join_footprints(
    splits: Iterable[Split],
    grid: TileGrid,
    numbers: Mapping[Tile, Sequence[int]],
    footprints: Sequence[Outline],
    source_ids: Sequence[str],
    crs_name: str,
    given: GivenFootprints | None = None,
) -> FoundSites:
    """The candidates where footprints were given: one per footprint, also where it holds no point; splits in any order.

    Parameters
    ----------
    numbers : mapping
        By tile, the numbers of its footprints; its split numbers them from 0.
    footprints, source_ids : sequences
        The given outlines in metres, in the order of their numbers, and their own ids.
    crs_name : str
        Goes into the ids. A footprint without points is named by its smallest corner and its own id, and by its place
        among those that share both.
    given : GivenFootprints, optional
        What else is known of them.
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
    alike: collections.Counter[str] = collections.Counter()
    for number, (footprint, source_id) in enumerate(zip(footprints, source_ids, strict=True)):
        name, point = crs_name, lowest.get(number)
        if point is None:
            corner = min(map(tuple, shapely.get_coordinates(footprint).tolist()))
            name, point = f"{crs_name}|{source_id}", (round(corner[0] * MM), round(corner[1] * MM), 0)
            alike[f"{name} {point}"] += 1
            name += "|" * (alike[f"{name} {point}"] - 1)
        found = ranges.get(number, [])
        candidates.append(
            CandidateSite(
                building_id=object_id(name, point),
                owner=grid.tile_of(point[0], point[1]),
                ranges=tuple(found),
                points=sum(r.stop - r.start for r in found),
                footprint=footprint,
                source_id=source_id,
                source_attributes=None if given is None else given.attributes[number],
                given=None if given is None else given.heights[number],
                overlap="" if given is None else given.overlaps[number],
            )
        )
    return FoundSites(candidates=largest_first(candidates), rejected=())
