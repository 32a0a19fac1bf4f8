"""Whole surfaces are judged and grouped to candidates and rejected objects: columns in, columns out.

The task of a tile finishes the surfaces that no neighbour sees, and the join all others, with the same function. The
result for a connected set of surfaces does not depend on the others, since judging looks at one surface, and uniting
only along steps.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.terrain.candidates import NOWHERE, SOLID, Surfaces, are_glass, are_objects, judge_surfaces, unite_levels
from pipeline.terrain.settings import CandidateSettings


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
