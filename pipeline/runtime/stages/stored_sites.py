"""Candidates and rejected objects on their way to scratch: in groups, each of which one task models.

Tasks make the sites of a tile and store them; the driver gets figures of each group. It holds no object per building.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
import shapely

from pipeline.model import Reason
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.outcomes import InParts, Place, brief_within, drop_outcomes, key_of
from pipeline.runtime.stages.sites import (
    CandidateSite,
    FoundSites,
    GroupFigures,
    Joined,
    RejectedFigures,
    RejectedSite,
    Stored,
    box_around,
    by_owner,
    folders_with_points,
    largest_first,
    near_pairs,
    tiles_of,
)
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_GROUP = 40_000
"""About a quarter of a second of modelling. A task costs some five milliseconds beside it."""
_MOST_PER_GROUP = 128
_GROUPS = 8192
"""A run has about as many groups at most: larger runs have larger ones."""
_LARGEST_SCALE = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class SitesBrief:
    """What the driver learns of the sites that a task stored."""

    groups: tuple[GroupFigures, ...]
    """The groups; group k is part k of the outcome."""
    rejected: tuple[RejectedFigures, ...]
    """Rejected objects by tile; the parts behind those of the groups."""
    checksums: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """CRC-32 of the points that the task stored again, by the keys of their tiles."""
    warnings: tuple[str, ...] = ()
    """What was odd but usable."""
    come_near: bool = False
    """Whether two of its candidates may have outlines that touch, other than units of one block."""


def stored_sites(
    candidates: Iterable[CandidateSite],
    rejected: Iterable[RejectedSite],
    grid: TileGrid,
    scale: int = 1,
    checksums: Mapping[str, int] | None = None,
    warnings: Sequence[str] = (),
) -> InParts[SitesBrief]:
    """Some sites for scratch, in groups of one owner each, `scale` times as large as those of a small run."""
    owned = sorted(by_owner(largest_first(candidates)).items())
    groups = [group for _, sites in owned for group in groups_of(sites, scale)]
    listed = [(owner, tuple(sorted(sites, key=lambda r: r.object_id))) for owner, sites in _by_owner(rejected)]
    return InParts(
        parts=(*groups, *(sites for _, sites in listed)),
        brief=SitesBrief(
            groups=tuple(group_figures(group, grid) for group in groups),
            rejected=tuple(_rejected_figures(owner, sites) for owner, sites in listed),
            checksums=checksums or {},
            warnings=tuple(warnings),
            come_near=len(near_pairs([site for _, sites in owned for site in sites])) > 0,
        ),
    )


def _by_owner(sites: Iterable[RejectedSite]) -> list[tuple[Tile, list[RejectedSite]]]:
    found: dict[Tile, list[RejectedSite]] = {}
    for site in sites:
        found.setdefault(site.owner, []).append(site)
    return sorted(found.items())


def group_figures(sites: tuple[CandidateSite, ...], grid: TileGrid) -> GroupFigures:
    """What the driver needs to know of a group."""
    return GroupFigures(
        owner=sites[0].owner,
        count=len(sites),
        points=sum(site.points for site in sites),
        largest=max(site.points for site in sites),
        tiles=tuple(sorted(tiles_of(sites, grid))),
        folders=tuple(sorted(folders_with_points(part for site in sites for part in site.ranges))),
        digest=key_of(sites),
        overridden=tuple(
            (site.building_id, site.override) for site in sites if site.override is not None and site.override.remodels
        ),
        reach_mm=box_around(site.reach_mm for site in sites),
    )


def _rejected_figures(owner: Tile, sites: Sequence[RejectedSite]) -> RejectedFigures:
    bridges = [part for site in sites if site.verdict.reason is Reason.BRIDGE for part in site.ranges]
    return RejectedFigures(
        owner=owner,
        reasons=Counter(site.verdict.reason.value for site in sites),
        bridges_in=tuple(sorted({part.tile for part in bridges})),
        folders=tuple(sorted(folders_with_points(bridges))),
        digest=key_of([dataclasses.replace(site, ranges=()) for site in sites]),
    )


def groups_of(sites: Sequence[CandidateSite], scale: int = 1) -> list[tuple[CandidateSite, ...]]:
    """Group the candidates of a tile, which come largest first, so that a task models each group in some seconds.

    >>> site = lambda n: CandidateSite(building_id=str(n), owner=Tile(0, 0), ranges=(), points=n)
    >>> [len(group) for group in groups_of([site(60_000), site(28_000), site(10_000), site(8_000), site(10)])]
    [1, 2, 2]
    """
    groups: list[tuple[CandidateSite, ...]] = []
    current: list[CandidateSite] = []
    points = 0
    for site in sites:
        full = points + site.points > _POINTS_PER_GROUP * scale or len(current) == _MOST_PER_GROUP * scale
        if current and full:
            groups.append(tuple(current))
            current, points = [], 0
        current.append(site)
        points += site.points
    if current:
        groups.append(tuple(current))
    return groups


def scale_of(points: int) -> int:
    """How many times larger the tasks of a run are, by the points of its candidates: 1, 2, 4 or 8.

    A task costs driver and scheduler milliseconds, however small it is. Powers of two, so that runs of about the same
    size have the same tasks.

    >>> [scale_of(points) for points in (0, 320_000_000, 400_000_000, 10**9, 10**10)]
    [1, 1, 2, 4, 8]
    """
    scale = 1
    while scale < _LARGEST_SCALE and points > _GROUPS * _POINTS_PER_GROUP * scale:
        scale *= 2
    return scale


def may_touch(briefs: Collection[SitesBrief]) -> bool:
    """Whether candidates may have outlines that touch: those of one task, or of tasks whose boxes meet."""
    reach = [box_around(group.reach_mm for group in brief.groups) for brief in briefs]
    boxes = np.array([shapely.box(*box) for box in reach if box is not None], dtype=object)
    meet = len(shapely.STRtree(boxes).query(boxes, predicate="intersects").T) > len(boxes)
    return meet or any(brief.come_near for brief in briefs)


def joined_of(briefs: Mapping[Place, SitesBrief], small_fragments: int, keys: Mapping[Tile, str]) -> Joined:
    """All stored sites of a run."""
    return Joined(
        groups=tuple(
            Stored(place=place, part=part, figures=figures)
            for place, brief in briefs.items()
            for part, figures in enumerate(brief.groups)
        ),
        rejected=tuple(
            Stored(place=place, part=len(brief.groups) + part, figures=figures)
            for place, brief in briefs.items()
            for part, figures in enumerate(brief.rejected)
        ),
        small_fragments=small_fragments,
        keys=keys,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoreTask:
    """Sites that the driver found, of one owner."""

    tile: Tile
    """The owner."""
    sites: FoundSites
    """The sites."""
    grid: TileGrid
    """The lattice."""
    scale: int
    """How many times larger groups are than those of a small run."""


def store_sites(context: RunContext, folder: str, found: FoundSites, *, quiet: bool = True) -> dict[Place, SitesBrief]:
    """Store sites that the driver found: in given footprints, or changed by overrides; each stage in a `folder`."""
    grid = context.plan.grid
    candidates, rejected = by_owner(found.candidates), dict(_by_owner(found.rejected))
    scale = scale_of(sum(site.points for site in found.candidates))
    tasks = {}
    for tile in sorted({*candidates, *rejected}):
        own = FoundSites(candidates=tuple(candidates.get(tile, ())), rejected=tuple(rejected.get(tile, ())))
        tasks[Place(folder, tile.key, key_of(own, grid, scale))] = StoreTask(
            tile=tile, sites=own, grid=grid, scale=scale
        )
    drop_outcomes(context.scratch, folder, tasks)
    return context.map_stored("outline", store, tasks, brief_within, quiet=quiet)


def store(task: StoreTask) -> InParts[SitesBrief]:
    """The sites of a task, in groups."""
    return stored_sites(task.sites.candidates, task.sites.rejected, task.grid, task.scale)
