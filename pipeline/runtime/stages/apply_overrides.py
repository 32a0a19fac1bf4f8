"""What overrides do to the candidates of a run: their buildings are found, then accepted, rejected or redrawn.

Candidates are judged first, as without overrides, so that one override changes its own building and no other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import Reason
from pipeline.runtime.overrides.overrides_file import Override
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.join import CandidateSite, Joined, PointRange, RejectedSite
from pipeline.terrain.candidates import Verdict
from pipeline.tiling import MM, TileGrid, Window

INSIDE_M = 3.0
"""A point of an entry is inside a building one of whose points lies that near in plan: the spacing of sparse clouds."""
TOLD_M = 50.0
"""How far the nearest building is sought for the message about a point that is inside none."""
WARNING = "overrides: "
"""How the warnings about entries begin."""

Sites = Mapping[str, CandidateSite | RejectedSite]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EntryOutcome:
    """What became of one entry of the overrides file."""

    override: Override
    """The entry."""
    building_id: str | None
    """The building or object that it names; None where there is none."""
    effective: Override | None
    """What of it took effect; None where nothing did."""
    told: str = ""
    """Why nothing, or not all of it, took effect."""

    @property
    def warning(self) -> str:
        """The sentence for the run's warnings; empty where all took effect."""
        return f"{WARNING}entry {self.override.entry} ({self.override.place}): {self.told}" if self.told else ""

    def as_dict(self) -> dict[str, Any]:
        """As `overrides.json` lists it."""
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
            "told": self.told,
            "fingerprint": None if self.effective is None else self.effective.fingerprint,
        }


def outcomes_of(
    overrides: Sequence[Override], joined: Joined, scratch: Scratch, grid: TileGrid
) -> tuple[EntryOutcome, ...]:
    """Find the building of each entry, and what of the entry takes effect.

    Parameters
    ----------
    overrides : sequence of Override
        The entries.
    joined : Joined
        The candidates and rejected objects as they were judged.
    scratch, grid : Scratch, TileGrid
        Where the points are, for entries that name a place.
    """
    candidates: Sites = {site.building_id: site for site in joined.candidates}
    rejected: Sites = {site.object_id: site for site in joined.rejected}
    by_source = {site.source_id: site.building_id for site in joined.candidates if site.source_id is not None}
    found: list[EntryOutcome] = []
    entry_of: dict[str, int] = {}
    for override in overrides:
        if override.source_id is not None:
            name = by_source.get(override.source_id)
            told = "" if name else _unknown(override.source_id, by_source, "source_id of this run")
        elif override.point_m is not None:
            among = (rejected, "rejected object") if override.action == "accept" else (candidates, "building")
            name, told = _at(override.point_m, *among, scratch, grid)
        else:
            name = override.building_id
            told = ""
            if name not in candidates and name not in rejected:
                told = _unknown(str(name), [*candidates, *rejected], "building or rejected object of this run")
                name = None
        if name is not None and name in entry_of:
            told = f"{name} has entry {entry_of[name]} already"
            found.append(EntryOutcome(override=override, building_id=name, effective=None, told=told))
            continue
        if name is None:
            found.append(EntryOutcome(override=override, building_id=None, effective=None, told=told))
            continue
        entry_of[name] = override.entry
        found.append(_judged(override, name, candidates, rejected))
    return tuple(found)


def _judged(override: Override, name: str, candidates: Sites, rejected: Sites) -> EntryOutcome:
    """What of an entry takes effect on its building."""
    effective: Override | None = override
    told = ""
    if name in candidates and override.action == "accept":
        told = f"{name} is a building already: there is nothing to accept"
        effective = dataclasses.replace(override, action=None)
    elif name not in candidates and override.action != "accept":
        site = rejected[name]
        assert isinstance(site, RejectedSite)
        done = f"{name} is rejected already ({site.verdict.reason})"
        told = done if override.action == "reject" else f'{done}: give action = "accept", too'
        effective = None
    if effective is not None and not effective.effects:
        effective = None
    return EntryOutcome(override=override, building_id=name, effective=effective, told=told)


def _unknown(name: str, names: Iterable[str], what: str) -> str:
    """That a name is none, and the one that begins most like it."""
    nearest = max(sorted(names), key=lambda other: _shared_start(name, other), default=None)
    return f"it is no {what}" + ("" if nearest is None else f"; the nearest is {nearest}")


def _shared_start(a: str, b: str) -> int:
    """How many characters two words begin with in common."""
    return next((k for k, (one, other) in enumerate(zip(a, b, strict=False)) if one != other), min(len(a), len(b)))


def _at(
    point_m: tuple[float, float], sites: Sites, what: str, scratch: Scratch, grid: TileGrid
) -> tuple[str | None, str]:
    """The site that a place lies in, by its footprint or by its nearest point in plan; or why there is none."""
    reach = round(TOLD_M * MM)
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
    if not near or near[0][0] > TOLD_M:
        return None, f"there is no {what} within {TOLD_M:g} m"
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


def layers_of(outcomes: Sequence[EntryOutcome]) -> list[list[EntryOutcome]]:
    """The entries with another footprint, in layers without overlaps; accepted objects apart from judged buildings.

    So each building gets all the points in its own outline, whatever other entries draw there.
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


def accepts(layer: Sequence[EntryOutcome]) -> bool:
    """Whether a layer holds accepted objects."""
    return _accepts(layer[0])


def _outline(outcome: EntryOutcome) -> shapely.Geometry:
    assert outcome.effective is not None
    assert outcome.effective.footprint is not None
    return outcome.effective.footprint


def overridden(
    joined: Joined,
    outcomes: Sequence[EntryOutcome],
    redrawn: Mapping[str, tuple[PointRange, ...]],
    scratch: Scratch,
) -> Joined:
    """The candidates and rejected objects after the overrides.

    Parameters
    ----------
    joined : Joined
        As they were judged.
    outcomes : sequence of EntryOutcome
        As of `outcomes_of`.
    redrawn : mapping
        By building_id, the points inside its other footprint.
    scratch : Scratch
        Where the points are.
    """
    candidates = {site.building_id: site for site in joined.candidates}
    rejected = {site.object_id: site for site in joined.rejected}
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
    return dataclasses.replace(
        joined,
        candidates=tuple(sorted(candidates.values(), key=lambda c: (-c.points, c.building_id))),
        rejected=tuple(sorted(rejected.values(), key=lambda r: r.object_id)),
    )


def _accepted(site: RejectedSite) -> CandidateSite:
    """A rejected object as a candidate of its own id."""
    return CandidateSite(building_id=site.object_id, owner=site.owner, ranges=site.ranges, points=site.points)


def _rejected(site: CandidateSite, effective: Override, scratch: Scratch) -> RejectedSite:
    """A candidate as a rejected object; its box is that of its points, or of its footprint where it has none."""
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
