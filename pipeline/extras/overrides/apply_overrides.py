"""Overrides, applied to the candidates of a run: their buildings are found, then accepted, rejected or redrawn.

Candidates are first judged without overrides, so one override changes its own building and no other.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.extras.footprints.footprint_sites import join_footprints
from pipeline.extras.footprints.given_footprints import numbers_by_tile
from pipeline.extras.overrides.overrides_file import Override
from pipeline.model import Reason
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import split_grid
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.cleanup import OVERRIDDEN, REDRAWN
from pipeline.runtime.stages.ground_stage import Ground
from pipeline.runtime.stages.ingested import Ingested, classes_in_use, points_by_tile
from pipeline.runtime.stages.sites import (
    CandidateSite,
    FoundSites,
    Joined,
    PointRange,
    RejectedSite,
    folders_with_points,
    found_sites,
)
from pipeline.runtime.stages.split import SplitWindows, split_windows
from pipeline.runtime.stages.stored_sites import joined_of, store_sites
from pipeline.settings import RunSettings
from pipeline.terrain.candidates import Verdict
from pipeline.tiling import MM, Tile, TileGrid, Window

INSIDE_M = 3.0
"""A place is inside a building that has a point this near in plan. Not a setting: the spacing of sparse clouds."""
NEAREST_M = 50.0
"""The nearest building within this distance is named in a message. Not a setting: it changes no result."""
WARNING = "overrides: "
"""Prefix of the warnings about entries."""

Sites = Mapping[str, CandidateSite | RejectedSite]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EntryOutcome:
    """The outcome of one entry of the overrides file."""

    override: Override
    """The entry."""
    building_id: str | None
    """The building or object that it names; None where there is none."""
    effective: Override | None
    """The part of it that took effect; None where nothing did."""
    fault: str = ""
    """Why nothing, or not all of it, took effect."""

    @property
    def warning(self) -> str:
        """The sentence for the run's warnings; empty where all of it took effect."""
        return f"{WARNING}entry {self.override.entry} ({self.override.place}): {self.fault}" if self.fault else ""

    def as_dict(self) -> dict[str, Any]:
        """Its entry in `overrides.json`."""
        return {
            "entry": self.override.entry,
            "place": self.override.place,
            "building_id": self.building_id,
            "effects": "" if self.effective is None else self.effective.effects,
            "method": self.override.method,
            "preset": self.override.preset,
            "settings": self.override.settings,
            "footprint": None if self.override.footprint is None else self.override.footprint.wkt,
            "note": self.override.note,
            "fault": self.fault,
            "fingerprint": None if self.effective is None else self.effective.fingerprint,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Overridden:
    """What overrides change; all other sites of the run stay where they are stored."""

    before: FoundSites
    """The sites that the overrides name, or that lie near a place of one, without overrides."""
    owners: frozenset[Tile]
    """The tiles that publish a site which an override changes."""
    sites: FoundSites
    """All sites of these tiles, after the overrides."""
    outcomes: tuple[EntryOutcome, ...]
    """The outcome of each entry."""


def apply_overrides(
    context: RunContext,
    settings: RunSettings,
    joined: Joined,
    overrides: Sequence[Override],
    ingested: Sequence[Ingested],
    ground: Ground,
    also: Collection[str] = (),
) -> Overridden:
    """Apply overrides; those sites count as changed that `also` names. The time counts as join and redraw.

    Stored sites are looked through one group after the other, and only those that an override concerns stay in memory.
    """
    started = time.perf_counter()
    scratch, grid = context.scratch, context.plan.grid
    concerns = _concerned(overrides, also, grid)
    before = found_sites(filter(concerns, joined.each(scratch)))
    every: Iterable[CandidateSite | RejectedSite] = (*before.candidates, *before.rejected)
    context.check(folders_with_points(part for site in every for part in site.ranges))
    outcomes = outcomes_of(overrides, before, lambda: joined.each(scratch), scratch, grid)
    redrawn: dict[str, tuple[PointRange, ...]] = {}
    for number, layer in enumerate(_layers_of(outcomes)):
        redrawn |= _redrawn(context, settings, layer, ingested, ground, f"{REDRAWN}{number}")
    changed = {*also, *(o.building_id for o in outcomes if o.effective is not None)}
    owners = frozenset(site.owner for site in every if _id_of(site) in changed)
    sites = _overridden(found_sites(joined.each(scratch, owners)), outcomes, redrawn, scratch)
    timings = context.progress.timings
    timings["join"] = timings.get("join", 0.0) + time.perf_counter() - started - timings.get("redraw", 0.0)
    return Overridden(before=before, owners=owners, sites=sites, outcomes=outcomes)


def overridden(
    context: RunContext,
    settings: RunSettings,
    joined: Joined,
    overrides: Sequence[Override],
    ingested: Sequence[Ingested],
    ground: Ground,
) -> tuple[Joined, tuple[EntryOutcome, ...]]:
    """The sites of a run after the overrides, stored; and the outcome of each entry, of which the run warns."""
    context.check(listed.place.folder for listed in (*joined.groups, *joined.rejected))
    applied = apply_overrides(context, settings, joined, overrides, ingested, ground)
    for entry in applied.outcomes:
        if entry.warning:
            context.progress.warn("join", entry.warning)
    if headline := about_no_effect(applied.outcomes):
        context.progress.warn_first("join", headline)
    changed = joined_of(store_sites(context, OVERRIDDEN, applied.sites), 0, {})
    return joined.in_place_of(applied.owners, changed), applied.outcomes


def about_no_effect(outcomes: Sequence[EntryOutcome]) -> str:
    """A warning where no override took effect; empty where one did, or there are none."""
    if not outcomes or any(entry.effective is not None for entry in outcomes):
        return ""
    return f"{WARNING}none of {len(outcomes)} took effect; overrides.json says why of each"


def _id_of(site: CandidateSite | RejectedSite) -> str:
    return site.building_id if isinstance(site, CandidateSite) else site.object_id


def _concerned(
    overrides: Sequence[Override], also: Collection[str], grid: TileGrid
) -> Callable[[CandidateSite | RejectedSite], bool]:
    """Whether overrides or other names name a site, or whether it may lie near a place of an override."""
    names = {*also, *(name for one in overrides for name in (one.building_id, one.source_id) if name is not None)}
    places = [one.point_m for one in overrides if one.point_m is not None]
    points = shapely.MultiPoint(places)
    shapely.prepare(points)
    reach = round(NEAREST_M * MM)
    corners = [(round(x * MM), round(y * MM)) for x, y in places]
    squares = [Window(x0_mm=x, y0_mm=y, x1_mm=x + 1, y1_mm=y + 1).grown(reach) for x, y in corners]
    near = {tile for square in squares for tile in grid.tiles_over(square)}

    def concerns(site: CandidateSite | RejectedSite) -> bool:
        if _id_of(site) in names or any(part.tile in near for part in site.ranges):
            return True
        if isinstance(site, RejectedSite):
            return False
        is_near = site.footprint is not None and len(places) > 0 and points.dwithin(site.footprint, NEAREST_M)
        return is_near or site.source_id in names

    return concerns


def _redrawn(
    context: RunContext,
    settings: RunSettings,
    layer: Sequence[EntryOutcome],
    ingested: Sequence[Ingested],
    ground: Ground,
    folder: str,
) -> dict[str, tuple[PointRange, ...]]:
    """The points inside the other footprints of some buildings, by building_id; stored in a folder of scratch."""
    named = [(str(o.building_id), o.effective.footprint) for o in layer if o.effective and o.effective.footprint]
    classes, _ = classes_in_use(ingested, trust=settings.general.classes == "trust")
    if _accepts(layer[0]):
        # the user overrules the classes, which say that there is no building
        classes = dataclasses.replace(classes, building=False, vegetation=False)
    polygons, grid = [polygon for _, polygon in named], context.plan.grid
    met = numbers_by_tile(points_by_tile(ingested), grid, polygons)
    numbers = {tile: found for tile, found in met.items() if found}
    windows = SplitWindows(
        grid=split_grid(context.plan, settings, footprints=True),
        classes=classes,
        outlines={tile: tuple(polygons[k] for k in found) for tile, found in sorted(numbers.items())},
        numbers=numbers,
        folder=folder,
    )
    splits = split_windows(context, "redraw", windows, settings, ingested, ground)
    names = [name for name, _ in named]
    sites = join_footprints(splits.stored(context), grid, splits.numbers, polygons, names, "").candidates
    return {
        str(site.source_id): tuple(dataclasses.replace(part, folder=folder) for part in site.ranges) for site in sites
    }


def outcomes_of(
    overrides: Sequence[Override],
    sites: FoundSites,
    every: Callable[[], Iterable[CandidateSite | RejectedSite]],
    scratch: Scratch,
    grid: TileGrid,
) -> tuple[EntryOutcome, ...]:
    """Find the building of each entry, and which part of the entry takes effect.

    `sites` are those that the overrides concern, `every` gives all of the run, for the name nearest to an unknown one.
    """
    candidates: Sites = {site.building_id: site for site in sites.candidates}
    rejected: Sites = {site.object_id: site for site in sites.rejected}
    by_source = {site.source_id: site.building_id for site in sites.candidates if site.source_id is not None}
    of_several = Counter(site.source_id for site in sites.candidates)
    found: list[EntryOutcome] = []
    entry_of: dict[str, int] = {}
    nearest_id = _nearest_names(
        {o.building_id for o in overrides if o.building_id is not None} - {*candidates, *rejected}, map(_id_of, every())
    )
    own_ids = (site.source_id for site in every() if isinstance(site, CandidateSite) and site.source_id is not None)
    nearest_source = _nearest_names({o.source_id for o in overrides if o.source_id is not None} - {*by_source}, own_ids)
    for override in overrides:
        fault = ""
        if override.source_id is not None:
            name = by_source.get(override.source_id)
            if name is None:
                fault = _unknown(nearest_source.get(override.source_id), "source_id of this run")
            elif (several := of_several[override.source_id]) > 1:
                name, fault = None, f"{several} footprints have this source_id: name the building by its building_id"
        elif override.point_m is not None:
            among = (rejected, "rejected object") if override.action == "accept" else (candidates, "building")
            name, fault = _at(override.point_m, *among, scratch, grid)
        else:
            name = override.building_id
            if name not in candidates and name not in rejected:
                fault = _unknown(nearest_id.get(str(name)), "building or rejected object of this run")
                name = None
        if name is not None and name in entry_of:
            fault = f"{name} has entry {entry_of[name]} already"
        if name is None or name in entry_of:
            found.append(EntryOutcome(override=override, building_id=name, effective=None, fault=fault))
            continue
        entry_of[name] = override.entry
        found.append(_judged(override, name, candidates, rejected))
    return tuple(found)


def _judged(override: Override, name: str, candidates: Sites, rejected: Sites) -> EntryOutcome:
    """Which part of an entry takes effect on its building."""
    effective: Override | None = override
    fault = ""
    if name not in candidates and override.action != "accept":
        site = rejected[name]
        assert isinstance(site, RejectedSite)
        done = f"{name} is rejected already ({site.verdict.reason})"
        fault = done if override.action == "reject" else f'{done}: give action = "accept", too'
        effective = None
    if effective is not None and not effective.effects:
        effective = None
    return EntryOutcome(override=override, building_id=name, effective=effective, fault=fault)


def _unknown(nearest: str | None, what: str) -> str:
    """The fault of an unknown name, with the known name that begins most like it."""
    return f"it is no {what}" + ("" if nearest is None else f"; the nearest is {nearest}")


def _nearest_names(unknown: Collection[str], names: Iterable[str]) -> dict[str, str]:
    """By unknown name the known one that begins most like it: of several, the first; the names are read once."""
    best: dict[str, tuple[int, str]] = {}
    for other in names if unknown else ():
        for name in unknown:
            rank = -_shared_start(name, other), other
            best[name] = min(best.get(name, rank), rank)
    return {name: other for name, (_, other) in best.items()}


def _shared_start(a: str, b: str) -> int:
    """Number of characters that two words have in common at their start."""
    return next((k for k, (one, other) in enumerate(zip(a, b, strict=False)) if one != other), min(len(a), len(b)))


def _at(
    point_m: tuple[float, float], sites: Sites, what: str, scratch: Scratch, grid: TileGrid
) -> tuple[str | None, str]:
    """The site at a place, by its footprint or its nearest point in plan; or the fault that there is none."""
    reach = round(NEAREST_M * MM)
    x, y = round(point_m[0] * MM), round(point_m[1] * MM)
    near: list[tuple[float, str, float]] = []
    for name, site in sites.items():
        footprint = site.footprint if isinstance(site, CandidateSite) else None
        if footprint is not None:
            near.append((float(footprint.distance(shapely.Point(point_m))), name, 0.0))
        elif any(_holds(grid.core(part.tile).grown(reach), x, y) for part in site.ranges):
            xy = plan_mm(scratch, site.ranges)
            near.append((float(np.hypot(xy[:, 0] - x, xy[:, 1] - y).min()) / MM, name, INSIDE_M))
    near.sort()
    if not near or near[0][0] > NEAREST_M:
        return None, f"there is no {what} within {NEAREST_M:g} m"
    inside = next((name for distance, name, limit in near if distance <= limit), None)
    distance, nearest, _ = near[0]
    return inside, "" if inside else f"it is in no {what}; the nearest is {nearest}, {distance:.1f} m away"


def _holds(window: Window, x_mm: int, y_mm: int) -> bool:
    return window.x0_mm <= x_mm < window.x1_mm and window.y0_mm <= y_mm < window.y1_mm


def plan_mm(scratch: Scratch, ranges: Sequence[PointRange]) -> npt.NDArray[np.int64]:
    """Easting and northing in millimetres, (n, 2) int64, of points in scratch; n may be 0."""
    pieces = [np.empty((0, 2), np.int64)]
    for part in ranges:
        stored = scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
        points = stored[part.start : part.stop]
        pieces.append(np.column_stack((points["x"], points["y"])).astype(np.int64))
    return np.concatenate(pieces)


def _layers_of(outcomes: Sequence[EntryOutcome]) -> list[list[EntryOutcome]]:
    """The entries with another footprint, in layers without overlaps; accepted objects apart from judged buildings.

    Each building then gets all points in its own outline, whatever other entries draw there.
    """
    layers: list[tuple[bool, list[EntryOutcome]]] = []
    drawn = [o for o in outcomes if o.effective is not None and o.effective.footprint is not None]
    for outcome in sorted(drawn, key=lambda o: str(o.building_id)):
        accepted = _accepts(outcome)
        outline = _outline(outcome)
        for kind, layer in layers:
            if kind == accepted and not any(outline.intersects(_outline(other)) for other in layer):
                layer.append(outcome)
                break
        else:
            layers.append((accepted, [outcome]))
    return [layer for _, layer in layers]


def _accepts(outcome: EntryOutcome) -> bool:
    return outcome.effective is not None and outcome.effective.action == "accept"


def _outline(outcome: EntryOutcome) -> shapely.Geometry:
    assert outcome.effective is not None
    assert outcome.effective.footprint is not None
    return outcome.effective.footprint


def _overridden(
    found: FoundSites,
    outcomes: Sequence[EntryOutcome],
    redrawn: Mapping[str, tuple[PointRange, ...]],
    scratch: Scratch,
) -> FoundSites:
    """The candidates and rejected objects after the overrides; `redrawn` has the points in other footprints, by id."""
    candidates = {site.building_id: site for site in found.candidates}
    rejected = {site.object_id: site for site in found.rejected}
    for outcome in outcomes:
        name, effective = outcome.building_id, outcome.effective
        if name is None or effective is None:
            continue
        if effective.action == "reject":
            rejected[name] = _rejected(candidates.pop(name), effective, scratch)
            continue
        site = candidates.get(name) or _accepted(rejected.pop(name))
        if effective.footprint is not None:
            ranges = redrawn[name]
            points = sum(part.stop - part.start for part in ranges)
            site = dataclasses.replace(site, footprint=effective.footprint, ranges=ranges, points=points)
        candidates[name] = dataclasses.replace(site, override=effective)
    return found_sites((*candidates.values(), *rejected.values()))


def _accepted(site: RejectedSite) -> CandidateSite:
    """A rejected object as a candidate with the same id."""
    return CandidateSite(building_id=site.object_id, owner=site.owner, ranges=site.ranges, points=site.points)


def _rejected(site: CandidateSite, effective: Override, scratch: Scratch) -> RejectedSite:
    """A candidate as a rejected object; its box is that of its points, or of its footprint if it has none."""
    xy = plan_mm(scratch, site.ranges)
    if len(xy):
        box = (*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist())
    else:
        box = (0, 0, 0, 0) if site.footprint is None else tuple(round(v * MM) for v in site.footprint.bounds)
    detail = effective.note or "an override says that it is no building"
    return RejectedSite(
        object_id=site.building_id,
        owner=site.owner,
        verdict=Verdict(reason=Reason.OVERRIDDEN, detail=detail),
        box_mm=box,
        area_m2=float("nan") if site.footprint is None else float(site.footprint.area),
        height_m=float("nan"),
        points=site.points,
        ranges=site.ranges,
    )
