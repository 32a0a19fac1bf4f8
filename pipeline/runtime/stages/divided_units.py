"""Units: the candidates of a tile, divided where several buildings touch, and the outlines of touching units.

A task sees all points of its candidates, in whichever tiles they lie, so the outcome does not depend on the tiles. The
points of divided candidates are stored again, sorted by unit, tile by tile: a range still lies in the tile it names.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
import zlib
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.model import IntArray, Reason
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import POINT, OpenScratch, Scratch
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
from pipeline.runtime.stages.cleanup import clear_units
from pipeline.runtime.stages.gather import canonical_order
from pipeline.runtime.stages.sites import (
    UNITS,
    CandidateSite,
    FoundSites,
    PointRange,
    RejectedSite,
    folders_with_points,
    largest_first,
    near_tiles,
    object_id,
)
from pipeline.runtime.stages.split import Split, Splits
from pipeline.runtime.stages.stored_sites import SitesBrief, scale_of, stored_sites
from pipeline.runtime.stages.tile_sites import TileSites, TileSitesFigures, sites_of
from pipeline.runtime.stages.window_points import folders_of
from pipeline.terrain.candidates import Verdict
from pipeline.terrain.terrain_settings import SceneSettings
from pipeline.terrain.unit_division import smallest_points, units_of
from pipeline.tiling import MM, Tile, TileGrid

_POINTS_PER_TASK = 50_000
_REACH_MM, _REACH_SPACINGS, _SPARSE_MM = 1000, 4.0, 3000
"""How far from its points an outline may end: outlines end within 3 point spacings, which are 3 m at most where they
are drawn, and few boxes hold a sixteenth of their points in the roof."""
_KEY_DIGITS = 16


@dataclasses.dataclass(frozen=True, kw_only=True)
class BorderSites:
    """Sites of a tile that reach other tiles, as the join found them."""

    place: Place
    """The outcome of the join that holds them."""
    part: int
    """Their part of it."""
    figures: TileSitesFigures
    """What the driver knows of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnitTask:
    """A share of the candidates of one tile."""

    tile: Tile
    """The tile."""
    share: int
    """Number of the share, from 0; the first one lists the rejected objects, too."""
    shares: int
    """Number of shares."""
    split: Place | None
    """The outcome of the tile's split, with the sites that no other tile sees; None where it has no split."""
    borders: tuple[BorderSites, ...]
    """The tile's other sites."""
    scene: SceneSettings
    """What is a candidate, and what separates units."""
    roof: RoofSettings
    """How outlines are drawn; strips of a candidate that disagree by more than its limit are aligned first."""
    outlines: bool
    """Whether the outlines of touching units are drawn."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Holds the points, and gets those of the units."""
    crs_name: str
    """Goes into the ids."""
    scale: int
    """How many times larger groups are than those of a small run."""
    folder: str = ""
    """Folder of scratch for the points of units."""


def find_units(
    context: RunContext,
    settings: SceneSettings,
    roof: RoofSettings,
    splits: Splits,
    borders: Iterable[BorderSites],
    crs_name: str,
    *,
    outlines: bool,
) -> dict[Place, SitesBrief]:
    """The candidates of all tiles, divided into units with their outlines, and the rejected objects."""
    scratch, grid = context.scratch, context.plan.grid
    reaching: dict[Tile, list[BorderSites]] = {}
    for sites in borders:
        reaching.setdefault(sites.figures.owner, []).append(sites)
    alone = {figures.tile: figures.sites for figures in splits.figures}
    points = {figures.tile: figures.candidate_points for figures in splits.figures if figures.sites}
    for tile, own in reaching.items():
        points[tile] = points.get(tile, 0) + sum(sites.figures.points for sites in own)
    scale = scale_of(sum(points.values()))
    alike = key_of(settings, roof if outlines else roof.min_strip_offset_m, outlines, grid, crs_name, scale)
    tasks: dict[Place, UnitTask] = {}
    for tile, of_tile in sorted(points.items()):
        own = reaching.get(tile, [])
        around = {tile, *(other for sites in own for other in sites.figures.tiles)}
        shares = max(1, round(of_tile / (_POINTS_PER_TASK * scale)))
        # the same points may be other sites: by other classes of the file, say
        listed = [alone.get(tile, ""), *(sites.figures.digest for sites in own)]
        content = [splits.keys.get(other, "") for other in sorted(around)], listed
        for share in range(shares):
            place = Place(UNITS, tile.key, key_of(alike, tile, share, shares, content))
            tasks[place] = UnitTask(
                tile=tile,
                share=share,
                shares=shares,
                split=splits.places.get(tile),
                borders=tuple(own),
                scene=settings,
                roof=roof,
                outlines=outlines,
                grid=grid,
                scratch=scratch,
                crs_name=crs_name,
                scale=scale,
                folder=f"{UNITS}/{tile.key}/{place.key[:_KEY_DIGITS]}",
            )
    drop_outcomes(scratch, UNITS, tasks)
    clear_units(scratch, {task.folder for task in tasks.values()})
    files: Files[UnitTask, SitesBrief] = Files(reads=_read, leaves=_left, intact=is_intact)
    found = context.map_stored("outline", sites_of_tile, tasks, brief_within, files=files)
    for warning in sorted(warning for brief in found.values() for warning in brief.warnings):
        context.progress.warn("outline", warning)
    return found


def _read(task: UnitTask) -> set[str]:
    """The folders of scratch with the sites of a task, their points, and what lies around them."""
    tiles = {task.tile, *(tile for sites in task.borders for tile in sites.figures.tiles)}
    listed = {sites.place.folder for sites in task.borders}
    if task.split is not None:
        listed.add(task.split.folder)
    points = folders_with_points(PointRange(tile=tile, start=0, stop=0) for tile in tiles)
    return listed | points | folders_of(near_tiles(tiles, task.grid))


def _left(task: UnitTask, brief: SitesBrief) -> set[str]:
    """The folder of scratch with the points of the units."""
    return {task.folder} if brief.checksums else set()


def is_intact(task: UnitTask, brief: SitesBrief, folder: str) -> bool:
    """Whether the points of the units below a folder of scratch are as they were stored."""
    return all(
        zlib.crc32(np.ascontiguousarray(task.scratch.array(f"{folder}/{tile}", "points", mapped=True)).data) == checksum
        for tile, checksum in brief.checksums.items()
    )


def sites_of_tile(task: UnitTask) -> InParts[SitesBrief]:
    """The share's candidates, divided into units; those that are one unit stay as they are.

    Raises MemoryError or OSError if scratch cannot be read, or does not fit into memory.
    """
    task = dataclasses.replace(task, scratch=OpenScratch(task.scratch.root, task.scratch.attempt))
    found = _found(task)
    divided, checksums = divide(shares_of(found.candidates, task.shares)[task.share], task)
    warnings: list[str] = []
    if task.outlines:
        divided = list(largest_first(divided))
        if any(site.block is not None for site in divided):
            from pipeline.runtime.stages.outline import outlined

            divided, warnings = outlined(divided, task.roof, task.grid, task.scratch)
    least_m = task.roof.min_strip_offset_m
    rejected = with_strips_that_disagree(found.rejected, task.scratch, least_m) if task.share == 0 else ()
    return stored_sites(divided, rejected, task.grid, task.scale, checksums, warnings)


def _found(task: UnitTask) -> FoundSites:
    """The tile's sites before they are divided."""
    parts: list[TileSites] = []
    if task.split is not None:
        split: Split = result_of(task.scratch, task.split)
        if split.surfaces is not None:
            parts.append(TileSites(found=split.surfaces.done, tiles=(split.tile,)))
    parts += [part_of(task.scratch, sites.place, sites.part) for sites in task.borders]
    return sites_of(parts, task.grid, task.scene.candidates, task.crs_name)


def shares_of(sites: Sequence[CandidateSite], shares: int) -> list[list[CandidateSite]]:
    """Candidates, which come largest first, in shares of about as many points: each goes to the share with least.

    >>> site = lambda n: CandidateSite(building_id=str(n), owner=Tile(0, 0), ranges=(), points=n)
    >>> [[one.points for one in share] for share in shares_of([site(n) for n in (90, 40, 30, 20, 0)], 2)]
    [[90, 0], [40, 30, 20]]
    """
    found: list[list[CandidateSite]] = [[] for _ in range(shares)]
    points = [0] * shares
    for site in sites:
        least = points.index(min(points))
        found[least].append(site)
        points[least] += site.points
    return found


class _Restored:
    """The points of divided candidates, by tile, on their way to scratch."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._pieces: dict[Tile, list[npt.NDArray[np.void]]] = collections.defaultdict(list)
        self._counts: dict[Tile, int] = collections.Counter()

    def add(self, tile: Tile, points: npt.NDArray[np.void]) -> PointRange:
        """Add points of a tile; where they will lie."""
        start = self._counts[tile]
        self._pieces[tile].append(points)
        self._counts[tile] += len(points)
        return PointRange(tile=tile, start=start, stop=self._counts[tile], folder=self._folder)

    def store(self, scratch: Scratch) -> dict[str, int]:
        """Store them; the CRC-32 of each tile's by its key."""
        checksums = {}
        for tile, pieces in self._pieces.items():
            points = np.concatenate(pieces).view(np.uint8)
            scratch.put_arrays(f"{self._folder}/{tile.key}", {"points": points})
            checksums[tile.key] = zlib.crc32(points.data)
        return checksums


def divide(sites: Sequence[CandidateSite], task: UnitTask) -> tuple[list[CandidateSite], dict[str, int]]:
    """The units of some candidates, whose points are stored again, and the CRC-32 of these points by tile."""
    found: list[CandidateSite] = []
    restored = _Restored(task.folder)
    for site in sites:
        task.scratch.check_cancelled()
        found.extend(_units_of_site(site, task, restored))
    return found, restored.store(task.scratch)


def _aligned_mm(
    points: npt.NDArray[np.void], xyz_mm: tuple[IntArray, IntArray, IntArray], min_offset_m: float
) -> tuple[IntArray, IntArray, IntArray]:
    """Coordinates of the points with their strips aligned: a step between two strips does not separate units."""
    source = points["source"]
    if len(points) == 0 or (source == source[0]).all():
        return xyz_mm
    from pipeline.strip_alignment import strip_offsets_m

    order = canonical_order(points)
    places = np.column_stack([values[order] - values[order[0]] for values in xyz_mm]) / MM
    offsets = np.empty_like(places)
    offsets[order] = strip_offsets_m(places, source[order], min_offset_m)
    moved = np.rint(offsets * MM).astype(np.int64)
    x, y, z = (values - moved[:, k] for k, values in enumerate(xyz_mm))
    return x, y, z


def _units_of_site(site: CandidateSite, task: UnitTask, restored: _Restored) -> list[CandidateSite]:
    by_tile: dict[Tile, list[npt.NDArray[np.void]]] = {}
    for part in site.ranges:
        stored = task.scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
        by_tile.setdefault(part.tile, []).append(np.array(stored[part.start : part.stop]))
    tiles = sorted(by_tile)
    pieces = [np.concatenate(by_tile[tile]) for tile in tiles]
    if not pieces:
        return [site]
    points = np.concatenate(pieces)
    x, y, z = points["x"].astype(np.int64), points["y"].astype(np.int64), points["z"].astype(np.int64)
    settings = task.scene.units
    site = dataclasses.replace(site, reach_mm=_reach_mm(x, y))
    if settings.split == "nothing":
        return [site]
    aligned = _aligned_mm(points, (x, y, z), task.roof.min_strip_offset_m)
    if site.is_glass:
        # the bays of a greenhouse lie between gutters
        settings = dataclasses.replace(settings, split="steps")
    unit = units_of(*aligned, settings, points["source"].astype(np.int64))
    count = int(unit.max(initial=0)) + 1
    if count == 1:
        return [site]
    firsts = smallest_points(x, y, z, unit)
    ranges: list[list[PointRange]] = [[] for _ in range(count)]
    done = 0
    for tile, piece in zip(tiles, pieces, strict=True):
        own = unit[done : done + len(piece)]
        done += len(piece)
        by_unit = np.argsort(own, kind="stable")
        ordered = piece[by_unit]
        borders = np.searchsorted(own[by_unit], np.arange(count + 1)).tolist()
        for k, (start, stop) in enumerate(itertools.pairwise(borders)):
            if start < stop:
                ranges[k].append(restored.add(tile, ordered[start:stop]))
    return [
        CandidateSite(
            building_id=object_id(task.crs_name, (int(x[first]), int(y[first]), int(z[first]))),
            owner=task.grid.tile_of(int(x[first]), int(y[first])),
            ranges=tuple(ranges[k]),
            points=sum(part.stop - part.start for part in ranges[k]),
            block=site.building_id,
            reach_mm=_reach_mm(x[unit == k], y[unit == k]),
        )
        for k, first in enumerate(firsts.tolist())
    ]


def _reach_mm(x: IntArray, y: IntArray) -> tuple[int, int, int, int]:
    """The box around points, and what an outline drawn around them may cover beside it."""
    x0, y0, x1, y1 = int(x.min()), int(y.min()), int(x.max()), int(y.max())
    beside = round(_REACH_MM + _REACH_SPACINGS * min(_SPARSE_MM, math.sqrt((x1 - x0) * (y1 - y0) / len(x))))
    return x0 - beside, y0 - beside, x1 + beside, y1 + beside


def with_strips_that_disagree(
    rejected: Iterable[RejectedSite], scratch: Scratch, min_offset_m: float
) -> tuple[RejectedSite, ...]:
    """Rejected objects; rough ones whose strips lie farther than `min_offset_m` above one another have that reason."""
    return tuple(_judged(site, scratch, min_offset_m) for site in rejected)


def _judged(site: RejectedSite, scratch: Scratch, min_offset_m: float) -> RejectedSite:
    if site.verdict.reason is not Reason.VEGETATION or not site.ranges:
        return site
    pieces = []
    for part in site.ranges:
        stored = scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
        pieces.append(np.array(stored[part.start : part.stop]))
    points = np.concatenate(pieces)
    if (points["source"] == points["source"][0]).all():
        return site
    from pipeline.strip_alignment import disagreement_m

    points = points[canonical_order(points)]
    places = np.column_stack([points[axis].astype(np.int64) - int(points[axis][0]) for axis in "xyz"]) / MM
    apart_m = disagreement_m(places, points["source"], min_offset_m)
    if math.isnan(apart_m):
        return site
    detail = f"strips lie {apart_m:.2f} m apart, at most {min_offset_m:g}; {site.verdict.reason}: {site.verdict.detail}"
    return dataclasses.replace(site, verdict=Verdict(reason=Reason.STRIPS_DISAGREE, detail=detail))
