"""Sites: where the points of candidates and of rejected objects lie in scratch."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import GivenHeights, IntArray
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Place, part_of
from pipeline.runtime.stages.window_points import folders_of
from pipeline.terrain.candidates import Verdict
from pipeline.tiling import MM, Tile, TileGrid, Window

if TYPE_CHECKING:
    from pipeline.extras.overrides.overrides_file import Override

UNITS = "units"
"""The stage under which the sites of tiles are stored, and the folder of scratch with the points of units."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class PointRange:
    """A run of points in the sorted points of one tile."""

    tile: Tile
    start: int
    stop: int
    folder: str = "tiles"
    """Folder of the scratch that holds the tile's points."""

    @property
    def left_in(self) -> str:
        """The folder of scratch that the task which stored the points left."""
        return self.folder if "/" in self.folder else f"{self.folder}/{self.tile.key}"


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class CandidateSite:
    """Where the points of one candidate lie."""

    building_id: str
    """As in the records."""
    owner: Tile
    """The tile of its smallest point, which publishes it."""
    ranges: tuple[PointRange, ...]
    """Its points in scratch."""
    points: int
    """Number of its points."""
    is_glass: bool = False
    """Pulses went through its roof: it is one building, whatever its gutters."""
    footprint: Polygon | MultiPolygon | None = None
    """Given footprint in metres; None where none was given."""
    source_id: str | None = None
    """Its own id."""
    source_attributes: str | None = None
    """The given footprint's columns as the text of a JSON object; None where none was given."""
    given: GivenHeights | None = None
    """Its heights by attributes, elevations in the vertical datum in metres; None where none is known."""
    overlap: str = ""
    """Which other footprint has points that lie in this one, in words; empty where none has."""
    block: str | None = None
    """The id of the candidate from which the unit was divided; None where it was not divided."""
    outline: MultiPolygon | None = None
    """Its outline where it was drawn with regard to others that touch it, in metres; None where none does."""
    reach_mm: tuple[int, int, int, int] | None = None
    """xmin, ymin, xmax, ymax of what an outline around its points may cover; None in a given footprint."""
    override: Override | None = None
    """The override of this building, as far as it took effect; None where there is none."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class RejectedSite:
    """An object that was judged not to be a building."""

    object_id: str
    """Made like a building_id."""
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
    """Number of its points."""
    ranges: tuple[PointRange, ...] = ()
    """Its points in scratch, should an override accept it."""
    planar: int = 0
    """Number of its places with planar surroundings."""
    rough: int = 0
    """Number of its places with rough surroundings; the surroundings of the others were not judged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundSites:
    """Candidates and rejected objects in memory: those of a tile, or of a whole run that is small enough."""

    candidates: tuple[CandidateSite, ...]
    """Largest first, then by id."""
    rejected: tuple[RejectedSite, ...]
    """By id."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """What the driver knows of some stored sites."""

    owner: Tile
    """The tile that publishes all of them."""
    folders: tuple[str, ...]
    """The folders of scratch with points of candidates or bridges, sorted."""
    digest: str
    """Of all that later stages see of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupFigures(Figures):
    """What the driver knows of some stored candidates, which one task models."""

    count: int
    """Number of candidates."""
    points: int
    """Number of their points."""
    largest: int
    """Points of the largest."""
    tiles: tuple[Tile, ...]
    """The tiles in which they lie, sorted."""
    overridden: tuple[tuple[str, Override], ...] = ()
    """Ids and overrides of those that are modelled in their own way."""
    reach_mm: tuple[int, int, int, int] | None = None
    """xmin, ymin, xmax, ymax of what their outlines may cover; None in given footprints."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedFigures(Figures):
    """What the driver knows of the rejected objects of a tile."""

    reasons: Mapping[str, int]
    """Number of objects by reason."""
    bridges_in: tuple[Tile, ...]
    """The tiles in which bridges lie, sorted."""

    @property
    def count(self) -> int:
        """Number of objects."""
        return sum(self.reasons.values())


Site_co = TypeVar("Site_co", covariant=True)
Known_co = TypeVar("Known_co", bound=Figures, covariant=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stored(Generic[Site_co, Known_co]):
    """Some sites that lie in scratch: the driver holds no object per building."""

    place: Place
    """The outcome of which they are a part."""
    part: int
    """Its number."""
    figures: Known_co
    """What the driver knows of them."""

    def sites(self, scratch: Scratch) -> tuple[Site_co, ...]:
        """The sites, candidates largest first, rejected objects by id; raises the errors of `part_of`."""
        found: tuple[Site_co, ...] = part_of(scratch, self.place, self.part)
        return found


StoredGroup = Stored[CandidateSite, GroupFigures]
"""Candidates that one task models."""
StoredRejected = Stored[RejectedSite, RejectedFigures]
"""The rejected objects of a tile."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joined:
    """The candidates of a run, in scratch."""

    groups: tuple[StoredGroup, ...]
    """Candidates, group by group; those of one tile follow each other."""
    rejected: tuple[StoredRejected, ...]
    """Rejected objects, tile by tile."""
    small_fragments: int
    """Surfaces below the size of an object: counted, not listed."""
    keys: Mapping[Tile, str] = dataclasses.field(default_factory=dict)
    """Digest of what lies in and around each tile: equal where later stages see no difference."""

    @property
    def candidates(self) -> int:
        """Number of candidates."""
        return sum(group.figures.count for group in self.groups)

    def around(self, tiles: Iterable[Tile]) -> list[str]:
        """Digests of what lies in and around some tiles."""
        return [self.keys.get(tile, "") for tile in tiles]

    def each(self, scratch: Scratch, owners: Collection[Tile] | None = None) -> Iterator[CandidateSite | RejectedSite]:
        """All candidates, then all rejected objects, or those of some owners: one stored group after the other."""
        for stored in (self.groups, self.rejected):
            for listed in stored:
                if owners is None or listed.figures.owner in owners:
                    yield from listed.sites(scratch)

    def in_place_of(self, owners: Collection[Tile], other: Joined) -> Joined:
        """These sites with those of some owners replaced by other ones."""
        return dataclasses.replace(
            self,
            groups=(*(one for one in self.groups if one.figures.owner not in owners), *other.groups),
            rejected=(*(one for one in self.rejected if one.figures.owner not in owners), *other.rejected),
        )


def found_sites(sites: Iterable[CandidateSite | RejectedSite]) -> FoundSites:
    """Sites in memory, in their order."""
    candidates: list[CandidateSite] = []
    rejected: list[RejectedSite] = []
    for site in sites:
        if isinstance(site, CandidateSite):
            candidates.append(site)
        else:
            rejected.append(site)
    return FoundSites(candidates=largest_first(candidates), rejected=tuple(sorted(rejected, key=lambda r: r.object_id)))


def tiles_of(sites: Iterable[CandidateSite], grid: TileGrid) -> set[Tile]:
    """The tiles in which some candidates lie: their points, their footprints, their outlines."""
    tiles = set[Tile]()
    for site in sites:
        tiles.update(part.tile for part in site.ranges)
        for area in (site.footprint, site.outline):
            if area is not None and not area.is_empty:
                x0, y0, x1, y1 = (round(value * MM) for value in area.bounds)
                tiles.update(grid.tiles_over(Window(x0_mm=x0, y0_mm=y0, x1_mm=x1 + 1, y1_mm=y1 + 1)))
    return tiles


def near_pairs(sites: Sequence[CandidateSite]) -> IntArray:
    """Pairs of sites by their numbers, (k, 2), the smaller first, whose outlines may touch.

    Units of one block that were drawn together are left out: their borders are common already.
    """
    number = np.array([k for k, site in enumerate(sites) if site.reach_mm is not None], np.int64)
    boxes = shapely.box(*np.array([sites[k].reach_mm for k in number], np.float64).reshape(-1, 4).T)
    pairs = [
        (i, j)
        for i, j in number[shapely.STRtree(boxes).query(boxes).T].tolist()
        if i < j and (sites[i].block is None or sites[i].block != sites[j].block or not _are_drawn(sites[i], sites[j]))
    ]
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def _are_drawn(*sites: CandidateSite) -> bool:
    return all(site.outline is not None for site in sites)


def box_around(boxes: Iterable[tuple[int, int, int, int] | None]) -> tuple[int, int, int, int] | None:
    """The smallest box around some, None without any."""
    known = np.array([box for box in boxes if box is not None], np.int64).reshape(-1, 4)
    if len(known) == 0:
        return None
    (x0, y0), (x1, y1) = known[:, :2].min(axis=0).tolist(), known[:, 2:].max(axis=0).tolist()
    return x0, y0, x1, y1


def folders_with_points(ranges: Iterable[PointRange]) -> set[str]:
    """The folders of scratch from which some points are read."""
    return {part.left_in for part in ranges}


def near_tiles(tiles: Iterable[Tile], grid: TileGrid) -> set[Tile]:
    """Some tiles and those that touch them: what lies there is seen where their candidates are gathered."""
    return {near for tile in tiles for near in grid.tiles_over(grid.core(tile).grown(grid.size_mm))}


def folders_around(group: StoredGroup, grid: TileGrid) -> set[str]:
    """The folders of scratch from which the candidates of a group are gathered, and in which they are listed."""
    return {*folders_of(near_tiles(group.figures.tiles, grid)), *group.figures.folders, group.place.folder}


def object_id(crs_name: str, lowest_point_mm: Sequence[int]) -> str:
    """Identity of an object: base32 of a sha256 over the CRS and its lexicographically smallest point in mm.

    >>> object_id("EPSG:28992", (84900123, 447500000, 7000))
    'gjjf4vlm6iovpli7yu4hjko4'
    """
    text = f"{crs_name}|{lowest_point_mm[0]}|{lowest_point_mm[1]}|{lowest_point_mm[2]}"
    digest = hashlib.sha256(text.encode()).digest()
    return base64.b32encode(digest[:15]).decode().lower()


def by_owner(sites: Sequence[CandidateSite]) -> dict[Tile, list[CandidateSite]]:
    """Candidates by the tile that publishes them, in their order."""
    found: dict[Tile, list[CandidateSite]] = {}
    for site in sites:
        found.setdefault(site.owner, []).append(site)
    return found


def largest_first(sites: Iterable[CandidateSite]) -> tuple[CandidateSite, ...]:
    """Candidates by their number of points, then by id."""
    return tuple(sorted(sites, key=lambda site: (-site.points, site.building_id)))
