"""What of a tile's fragments a join over tiles can need; the rest is finished where it is found.

A fragment without a facet that another tile may see is a whole surface: closed. It is judged in its tile. Levels unite
along steps, so what belongs together is connected by facets of neighbouring tiles and by steps beside roofs. Of a set
that is connected in its tile and has nothing open, candidates and rejected objects are known at once. Open fragments,
and the closed ones that steps connect with them, are handed on:

- no ground, which is neither judged nor listed nor united;
- of steps their identity only: which surfaces lie along one;
- no closed surface that is no candidate and may not join one: it leads nothing and follows nothing.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray
from pipeline.runtime.stages.border_facets import are_beyond, facet_names, shared_facets
from pipeline.terrain.candidates import (
    CONNECTING,
    NOWHERE,
    SOLID,
    Fault,
    Surfaces,
    are_glass,
    are_objects,
    judge_surfaces,
    may_join,
    unite_levels,
)
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.surfaces import Fragments
from pipeline.terrain.terrain_settings import CandidateSettings, SurfaceSettings
from pipeline.tiling import Tile, TileGrid


@dataclasses.dataclass(frozen=True, kw_only=True)
class BorderFacets:
    """Facets by which the fragments of several tiles find each other."""

    names: npt.NDArray[np.uint64]
    """(j, 2) uint64, from `facet_names`."""
    holders: LabelArray
    """(j,) int32, the fragment or step of each facet."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenSurfaces:
    """k surfaces, or fragments of them, that wait for other tiles: those of a tile, or of a block of tiles."""

    tiles: tuple[Tile, ...]
    """The tiles in which their points lie, by number."""
    kind: KindArray
    """(k,) int8, FacetKind: OBJECT, BUILDING or CROWN."""
    sums: IntArray
    """(k, N_SUMS) int64, columns as in Sum."""
    boxes_mm: IntArray
    """(k, 4) int64, xmin, ymin, xmax, ymax; xmin > xmax where no facet is owned."""
    lowest_point_mm: IntArray
    """(k, 3) int64, smallest assigned point in mm; NOWHERE where there is none."""
    ranges: IntArray
    """(p, 4) int64, surface, number of the tile, start, stop: points in the sorted points of the tile."""
    reach: IntArray
    """(k, 4) int64, first column, first row, last column, last row of the tiles that may see some of it."""
    facets: BorderFacets
    """Facets of the surfaces."""
    step_reach: IntArray
    """(s, 4) int64, the same of the steps that lie along the surfaces or cross a border."""
    step_facets: BorderFacets
    """Facets of the steps."""
    along_steps: IntArray
    """(q, 2) int64, surface and step; one row per pair."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileSurfaces:
    """The surfaces of one tile."""

    done: Finished
    """Sites that no other tile can change; their tile has number 0."""
    open: OpenSurfaces
    """What waits for other tiles."""


def open_fragments(
    fragments: Fragments,
    keys: IntArray,
    starts: IntArray,
    tile: Tile,
    grid: TileGrid,
    cut: SurfaceSettings,
    settings: CandidateSettings,
) -> TileSurfaces:
    """Finish what a tile can, and pass on the part of its other fragments that a join needs.

    `keys` (n,) int64 are the fragments with points, ascending, and `starts` (n + 1,) where the points of each begin in
    the tile's sorted points.
    """
    kind, count = fragments.kind, len(fragments.kind)
    reach, holders, names = _shared_facets(fragments, tile, grid, cut)
    is_open = are_beyond(reach, (tile.column, tile.row, tile.column, tile.row))
    solid, step = np.isin(kind, SOLID), np.isin(kind, CONNECTING)
    pairs = _linking_pairs(fragments, is_open, settings)
    piece = united(count, pairs[:, 0], pairs[:, 1])
    waits = np.zeros(count, np.bool_)
    waits[piece[is_open]] = True
    waits = waits[piece]
    linked = np.zeros(count, np.bool_)
    linked[pairs.ravel()] = True
    # a step without a surface along it matters only where it connects several facets for other tiles
    facets_of = np.bincount(holders, minlength=count)
    waiting_steps = step & waits & (linked | (facets_of > 1))
    waiting = solid & waits
    ranges = np.zeros((count, 2), np.int64)
    ranges[keys, 0], ranges[keys, 1] = starts[:-1], starts[1:]
    pair_waits = waits[pairs[:, 0]]
    chosen = np.flatnonzero(waiting)
    held = np.flatnonzero(ranges[chosen, 1] > ranges[chosen, 0])
    return TileSurfaces(
        done=_finished(fragments, solid & ~waits, pairs[~pair_waits], ranges, settings),
        open=OpenSurfaces(
            tiles=(tile,),
            kind=kind[chosen],
            sums=fragments.sums[chosen],
            boxes_mm=fragments.boxes_mm[chosen],
            lowest_point_mm=fragments.lowest_point_mm[chosen],
            ranges=np.column_stack((held, np.zeros(len(held), np.int64), ranges[chosen[held]])),
            reach=reach[chosen],
            facets=_facets_of(waiting, holders, names),
            step_reach=reach[waiting_steps],
            step_facets=_facets_of(waiting_steps, holders, names),
            along_steps=np.column_stack(
                (_numbers(waiting)[pairs[pair_waits, 0]], _numbers(waiting_steps)[pairs[pair_waits, 1]])
            ),
        ),
    )


def _numbers(mask: BoolArray) -> IntArray:
    """The rank of each True element among the True ones."""
    return np.cumsum(mask, dtype=np.int64) - 1


def _facets_of(chosen: BoolArray, holders: IntArray, names: npt.NDArray[np.uint64]) -> BorderFacets:
    """The facets of the chosen fragments, which are numbered from 0."""
    own = chosen[holders]
    return BorderFacets(names=names[own], holders=_numbers(chosen)[holders[own]].astype(np.int32))


def _shared_facets(
    fragments: Fragments, tile: Tile, grid: TileGrid, cut: SurfaceSettings
) -> tuple[IntArray, IntArray, npt.NDArray[np.uint64]]:
    """The tiles that may see each fragment (k, 4), and the fragments and names of the facets named to other tiles."""
    keys = fragments.crossing_keys
    holders = fragments.crossing_fragment.astype(np.int64)
    names = facet_names(keys)
    seen_by, named = shared_facets(keys, names, fragments.kind[holders], tile, grid, cut)
    reach = np.tile(np.array([tile.column, tile.row, tile.column, tile.row], np.int64), (len(fragments.kind), 1))
    np.minimum.at(reach[:, :2], holders, seen_by[:, :2])
    np.maximum.at(reach[:, 2:], holders, seen_by[:, 2:])
    return reach, holders[named], names[named]


def _linking_pairs(fragments: Fragments, is_open: BoolArray, settings: CandidateSettings) -> IntArray:
    """Pairs (s, 2) of a step and a surface that may lead or join along it, as far as the tile can know."""
    count = len(fragments.kind)
    may_link = is_open & np.isin(fragments.kind, (FacetKind.OBJECT, FacetKind.BUILDING))
    beside = np.zeros(count, np.bool_)
    beside[fragments.along_steps[:, 0]] = True
    closed = np.flatnonzero(beside & ~is_open)
    surfaces = _surfaces(fragments, closed, np.empty((0, 2), np.int64))
    faults = judge_surfaces(surfaces, settings)
    may_link[closed] = (faults == Fault.NONE) | may_join(surfaces.kind, surfaces.sums, faults, settings)
    rows = fragments.along_steps[may_link[fragments.along_steps[:, 0]], :2]
    pairs = np.unique(rows[:, 0] * count + rows[:, 1])
    return np.column_stack((pairs // max(1, count), pairs % max(1, count)))


def _surfaces(fragments: Fragments, chosen: IntArray, pairs: IntArray) -> Surfaces:
    """Some fragments as whole surfaces; `pairs` by their place among those chosen."""
    return Surfaces(
        kind=fragments.kind[chosen],
        sums=fragments.sums[chosen],
        boxes_mm=fragments.boxes_mm[chosen],
        lowest_point_mm=fragments.lowest_point_mm[chosen],
        along_steps=pairs,
    )


def _finished(
    fragments: Fragments, closed: BoolArray, pairs: IntArray, ranges: IntArray, settings: CandidateSettings
) -> Finished:
    """Candidates and rejected objects of closed surfaces; `pairs` of these and steps."""
    chosen = np.flatnonzero(closed)
    number = _numbers(closed)
    held = np.flatnonzero(closed & (ranges[:, 1] > ranges[:, 0]))
    own = np.column_stack((number[held], np.zeros(len(held), np.int64), ranges[held]))
    along = np.column_stack((number[pairs[:, 0]], pairs[:, 1]))
    return finished(_surfaces(fragments, chosen, along), own, settings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finished:
    """c candidates and r rejected objects, by columns."""

    candidate_points_mm: IntArray
    """(c, 3) int64, smallest point of each candidate in mm."""
    candidate_ranges: IntArray
    """(p, 4) candidate, tile, start, stop: points in the sorted points of a tile; tiles are numbered by the caller."""
    candidate_is_glass: BoolArray
    """(c,) whether pulses went through it."""
    kind: KindArray
    """(r,) FacetKind of each rejected object."""
    sums: IntArray
    """(r, N_SUMS) columns as in Sum."""
    boxes_mm: IntArray
    """(r, 4) xmin, ymin, xmax, ymax."""
    lowest_point_mm: IntArray
    """(r, 3) smallest point."""
    rejected_ranges: IntArray
    """(q, 4) rejected object, tile, start, stop: an override may accept it and then needs its points."""
    small: int
    """Surfaces below the size of an object: counted, not listed."""

    @property
    def candidate_points(self) -> int:
        """Number of points of the candidates."""
        return int((self.candidate_ranges[:, 3] - self.candidate_ranges[:, 2]).sum())


def finished(surfaces: Surfaces, ranges: IntArray, settings: CandidateSettings) -> Finished:
    """Judge whole surfaces, and unite levels to candidates; no step connects the surfaces with any other.

    `ranges` (p, 4) int64 are surface, tile, start, stop of runs of their points.
    """
    leader = unite_levels(surfaces, judge_surfaces(surfaces, settings), settings)
    points = surfaces.lowest_point_mm
    led = np.flatnonzero(leader >= 0)
    leads, candidate = np.unique(leader[led], return_inverse=True)
    candidate = candidate.reshape(-1)
    order = np.lexsort((*points[led].T[::-1], candidate))
    smallest = led[order[np.searchsorted(candidate[order], np.arange(len(leads)))]]
    rest = np.isin(surfaces.kind, SOLID) & (leader < 0)
    rejected = np.flatnonzero(rest & are_objects(surfaces.kind, surfaces.sums, settings) & (points[:, 0] != NOWHERE))
    return Finished(
        candidate_points_mm=points[smallest],
        candidate_ranges=_ranges_of(ranges, led, candidate, len(leader)),
        candidate_is_glass=are_glass(surfaces.sums[led], candidate, len(leads)),
        kind=surfaces.kind[rejected],
        sums=surfaces.sums[rejected],
        boxes_mm=surfaces.boxes_mm[rejected],
        lowest_point_mm=points[rejected],
        rejected_ranges=_ranges_of(ranges, rejected, np.arange(len(rejected)), len(leader)),
        small=int(rest.sum()) - len(rejected),
    )


def _ranges_of(ranges: IntArray, members: IntArray, site: IntArray, count: int) -> IntArray:
    """The ranges of some of `count` surfaces, with the number of the site in place of the surface's."""
    site_of = np.full(count, -1, np.int64)
    site_of[members] = site
    found = site_of[ranges[:, 0]]
    held = found >= 0
    return np.column_stack((found[held], ranges[held, 1:]))
