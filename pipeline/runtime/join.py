"""Join: fragments become whole surfaces by union-find over the facets that cross tile borders; then they are judged."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import IntArray, Reason
from pipeline.runtime.overrides import Override
from pipeline.runtime.split import Split
from pipeline.terrain.candidates import (
    CandidateSettings,
    Surfaces,
    Verdict,
    is_object,
    judge_surface,
    unite_levels,
)
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.surfaces import N_SUMS, Fragments, Sum
from pipeline.tiling import MM, Tile, TileGrid

NOWHERE = 2**62
"""Coordinate of the smallest point of a surface that has none."""

_NOT_JUDGED = Verdict(reason=Reason.TOO_FEW_POINTS, detail="ground, a step between levels, or a surface without points")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointRange:
    """A run of points in the sorted points of one tile."""

    tile: Tile
    start: int
    stop: int
    folder: str = "tiles"
    """Folder of the scratch that holds the tile's points."""


@dataclasses.dataclass(frozen=True, kw_only=True)
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


@dataclasses.dataclass(frozen=True, kw_only=True)
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


def _roots(count: int, pairs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Smallest member of the set of each of `count` elements under the unions of `pairs` (n, 2)."""
    parent = list(range(count))

    def find(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for a, b in pairs.tolist():
        root_a, root_b = find(a), find(b)
        if root_a != root_b:
            parent[max(root_a, root_b)] = min(root_a, root_b)
    return np.array([find(k) for k in range(count)], np.int64)


def _crossing_pairs(splits: Sequence[Split], offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Pairs of fragments (n, 2) that hold the same facet."""
    keys = np.concatenate([s.fragments.crossing_keys for s in splits if s.fragments is not None])
    owners = np.concatenate(
        [s.fragments.crossing_fragment + offset for s, offset in zip(splits, offsets, strict=True) if s.fragments]
    )
    if len(keys) == 0:
        return np.empty((0, 2), np.int64)
    order = np.lexsort(keys.T[::-1])
    keys, owners = keys[order], owners[order]
    same = np.flatnonzero((keys[1:] == keys[:-1]).all(axis=1))
    pairs = np.column_stack((owners[same], owners[same + 1])).astype(np.int64)
    return np.unique(pairs, axis=0)


def whole_surfaces(splits: Sequence[Split]) -> tuple[Surfaces, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Unite the fragments of all tiles.

    Parameters
    ----------
    splits : sequence of Split
        All tiles, each with fragments.

    Returns
    -------
    Surfaces
        Whole surfaces with their sums.
    (f,) int64
        The surface of every fragment, tile after tile.
    (t + 1,) int64
        Where each tile's fragments start in that list.
    """
    counts = [0 if s.fragments is None else len(s.fragments.kind) for s in splits]
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    total = int(offsets[-1])
    described = [s.fragments for s in splits if s.fragments is not None]
    if total == 0:
        empty = np.empty(0, np.int64)
        nothing = Surfaces(
            kind=np.empty(0, np.int8),
            sums=np.empty((0, N_SUMS), np.int64),
            boxes_mm=np.empty((0, 4), np.int64),
            lowest_point_mm=np.empty((0, 3), np.int64),
            along_steps=np.empty((0, 3), np.int64),
        )
        return nothing, empty, offsets
    roots = _roots(total, _crossing_pairs(splits, offsets[:-1]))
    members, surface = np.unique(roots, return_inverse=True)
    k = len(members)
    sums = np.zeros((k, N_SUMS), np.int64)
    np.add.at(sums, surface, np.concatenate([f.sums for f in described]))
    fragment_boxes = np.concatenate([f.boxes_mm for f in described])
    boxes = np.empty((k, 4), np.int64)
    boxes[:, :2], boxes[:, 2:] = NOWHERE, -NOWHERE
    np.minimum.at(boxes[:, :2], surface, fragment_boxes[:, :2])
    np.maximum.at(boxes[:, 2:], surface, fragment_boxes[:, 2:])
    points = np.concatenate([f.lowest_point_mm for f in described])
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], surface))
    _, first = np.unique(surface[order], return_index=True)
    along = [
        f.along_steps + np.array([offset, offset, 0])
        for f, offset in _with_offsets(splits, offsets)
        if len(f.along_steps)
    ]
    pairs = _summed_pairs(np.concatenate(along), surface) if along else np.empty((0, 3), np.int64)
    whole = Surfaces(
        kind=np.concatenate([f.kind for f in described])[members],
        sums=sums,
        boxes_mm=boxes,
        lowest_point_mm=points[order][first],
        along_steps=pairs,
    )
    return whole, surface.astype(np.int64), offsets


def _with_offsets(splits: Sequence[Split], offsets: npt.NDArray[np.int64]) -> list[tuple[Fragments, int]]:
    """Each tile's fragments and where they start."""
    return [(s.fragments, int(o)) for s, o in zip(splits, offsets, strict=False) if s.fragments is not None]


def _summed_pairs(along: IntArray, surface: npt.NDArray[np.int64]) -> IntArray:
    """Rows (surface, step, length) with one row a pair of whole surfaces."""
    pairs = np.column_stack((surface[along[:, 0]], surface[along[:, 1]]))
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    lengths = np.zeros(len(unique), np.int64)
    np.add.at(lengths, inverse.ravel(), along[:, 2])
    return np.column_stack((unique, lengths))


def _ranges_by_key(splits: Sequence[Split], surface_of: dict[tuple[int, int], int]) -> dict[int, list[PointRange]]:
    """Point ranges of every surface that has points; `surface_of` maps (tile index, key) to it."""
    ranges: dict[int, list[PointRange]] = {}
    for t, s in enumerate(splits):
        for j, key in enumerate(s.keys.tolist()):
            where = surface_of.get((t, key))
            if where is not None:
                ranges.setdefault(where, []).append(
                    PointRange(tile=s.tile, start=int(s.starts[j]), stop=int(s.starts[j + 1]))
                )
    return ranges


def join(splits: Sequence[Split], grid: TileGrid, settings: CandidateSettings, crs_name: str) -> Joined:
    """Unite, judge, and say where each candidate's points lie.

    Parameters
    ----------
    splits : sequence of Split
        All tiles, in any order.
    grid : TileGrid
        The lattice, for the owners.
    settings : CandidateSettings
        What makes a surface a candidate.
    crs_name : str
        Goes into the ids.
    """
    splits = sorted(splits, key=lambda s: s.tile)
    surfaces, surface_of_fragment, offsets = whole_surfaces(splits)
    count = len(surfaces.kind)
    verdicts: list[Verdict | None] = []
    for k in range(count):
        kind = int(surfaces.kind[k])
        judged = kind in {FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN}
        verdict = judge_surface(kind, surfaces.sums[k], settings) if judged else _NOT_JUDGED
        if verdict is None and surfaces.lowest_point_mm[k, 0] == NOWHERE:
            verdict = _NOT_JUDGED
        verdicts.append(verdict)
    leader = unite_levels(surfaces, verdicts, settings)
    group: dict[tuple[int, int], int] = {}
    # those that are rejected keep their points, too: the user may know better
    listed = [is_object(int(surfaces.kind[k]), surfaces.sums[k], settings) for k in range(count)]
    for t in range(len(splits)):
        for local, fragment in enumerate(range(int(offsets[t]), int(offsets[t + 1]))):
            surface = int(surface_of_fragment[fragment])
            lead = int(leader[surface])
            if lead >= 0 or listed[surface]:
                group[t, local] = lead if lead >= 0 else surface
    ranges = _ranges_by_key(splits, group)
    lowest: dict[int, tuple[int, ...]] = {}
    for k in np.flatnonzero(leader >= 0).tolist():
        point = tuple(int(v) for v in surfaces.lowest_point_mm[k])
        lead = int(leader[k])
        lowest[lead] = min(lowest.get(lead, point), point)
    candidates = [
        CandidateSite(
            building_id=object_id(crs_name, lowest[lead]),
            owner=grid.tile_of(lowest[lead][0], lowest[lead][1]),
            ranges=tuple(found),
            points=sum(r.stop - r.start for r in found),
        )
        for lead, found in ranges.items()
        if lead in lowest
    ]
    rejected, small = [], 0
    for k, verdict in enumerate(verdicts):
        kind = int(surfaces.kind[k])
        if verdict is None or int(leader[k]) >= 0 or kind in {FacetKind.STEP, FacetKind.GROUND}:
            continue
        point = tuple(int(v) for v in surfaces.lowest_point_mm[k])
        if not listed[k] or point[0] == NOWHERE:
            small += 1
            continue
        sums = surfaces.sums[k]
        rejected.append(
            RejectedSite(
                object_id=object_id(crs_name, point),
                owner=grid.tile_of(point[0], point[1]),
                verdict=verdict,
                box_mm=tuple(int(v) for v in surfaces.boxes_mm[k]),  # type: ignore[arg-type]
                area_m2=float(sums[Sum.AREA2]) / 2e6,
                height_m=float(sums[Sum.HEIGHT]) / max(1, int(sums[Sum.VERTICES])) / 1000.0,
                points=int(sums[Sum.POINTS]),
                ranges=tuple(ranges.get(k, ())),
            )
        )
    return Joined(
        candidates=tuple(sorted(candidates, key=lambda c: (-c.points, c.building_id))),
        rejected=tuple(sorted(rejected, key=lambda r: r.object_id)),
        small_fragments=small,
    )


def join_footprints(
    splits: Sequence[Split],
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
    splits : sequence of Split
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
    splits = sorted(splits, key=lambda s: s.tile)
    number_of = {(t, key): numbers[s.tile][key] for t, s in enumerate(splits) for key in s.keys.tolist()}
    ranges = _ranges_by_key(splits, number_of)
    lowest: dict[int, tuple[int, ...]] = {}
    for s in splits:
        for key, point in zip(s.keys.tolist(), s.lowest_points_mm.tolist(), strict=True):
            owner = numbers[s.tile][key]
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
