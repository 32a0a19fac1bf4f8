"""Whole surfaces are judged: which are candidates for buildings, and why the others are not.

The Z_avg rule (Shorter and Kasparis, section 3.1) asks whether a facet lies above the mean height of
the walls. For a scene it is asked of each surface and the walls that touch it: a roof lies at the
top of its walls, a street at their foot. Each metre of outline votes, so one tower beside a low roof
cannot outvote the roof's own eaves.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.model import IntArray, KindArray, Reason
from pipeline.parameters import Parameters, parameter
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.surfaces import Sum


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateSettings(Parameters):
    """What a surface must be to become a candidate."""

    min_object_area_m2: float = parameter(
        4.0,
        "Smaller surfaces are no objects: crowns fall apart into thousands of them; they are counted, not listed.",
        unit="m2",
        minimum=0.5,
        maximum=100.0,
    )
    min_area_m2: float = parameter(
        5.0, "Least plan area of a surface that is surely a roof.", unit="m2", minimum=1.0, maximum=1000.0
    )
    sure_planar_share: float = parameter(
        0.75,
        "Share of vertices with planar surroundings from which a surface is surely a roof.",
        minimum=0.0,
        maximum=1.0,
    )
    max_slenderness: float = parameter(
        3.0,
        "Largest height over mean width of a small surface that is surely a roof.",
        minimum=0.5,
        maximum=100.0,
    )
    doubtful_area_m2: float = parameter(
        20.0, "Least plan area of a building's surface that is not.", unit="m2", minimum=1.0, maximum=1000.0
    )
    min_height_m: float = parameter(
        2.0,
        "Least height above the terrain, of a pitched roof that of its ridge, as the spread of its heights tells.",
        unit="m",
        minimum=0.5,
        maximum=20.0,
    )
    min_width_m: float = parameter(
        2.0,
        "Least mean width, twice the area over the outline; half of it for what is surely a roof.",
        unit="m",
        minimum=0.0,
        maximum=20.0,
    )
    min_planar_share: float = parameter(
        0.5, "Least share of vertices with planar surroundings.", minimum=0.0, maximum=1.0
    )
    max_canopy_share: float = parameter(
        0.35, "Largest share of earlier returns above the surface.", minimum=0.0, maximum=1.0
    )
    min_wall_share: float = parameter(0.15, "Least share of the outline that touches walls.", minimum=0.0, maximum=1.0)
    min_top_share: float = parameter(
        0.3,
        "Least share of the touching walls at whose top the surface lies (the Z_avg rule by surface).",
        minimum=0.0,
        maximum=1.0,
    )
    unite_share: float = parameter(
        0.5,
        "A surface with at least this share of its outline along steps joins the largest roof beside them.",
        minimum=0.1,
        maximum=1.0,
    )
    unite_reach_m: float = parameter(
        3.0, "Farthest that this roof may be, between the boxes around both.", unit="m", minimum=0.0, maximum=50.0
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Whole surfaces, merged over tiles."""

    kind: KindArray
    """(k,) FacetKind."""
    sums: IntArray
    """(k, N_SUMS) columns as in Sum."""
    boxes_mm: IntArray
    """(k, 4) xmin, ymin, xmax, ymax."""
    lowest_point_mm: IntArray
    """(k, 3) smallest assigned point; 2^62 where there is none."""
    along_steps: IntArray
    """(s, 3) surface, step, shared length in mm; one row a pair."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is said of a surface that is no candidate."""

    reason: Reason
    """From the closed list."""
    detail: str
    """The measured figure and the threshold."""


def _figures(sums: IntArray) -> dict[str, float]:
    """The measures of one surface in metres and shares."""
    facets_mm2 = float(sums[Sum.AREA2]) / 2.0
    outline_mm = max(1, int(sums[Sum.BOUNDARY]))
    # the facets end at the outermost points, half a spacing inside the edges: grown by that (Steiner's formula)
    half_mm = 0.5 * math.sqrt(2.0 * facets_mm2 / max(1, int(sums[Sum.FACETS])))
    area_mm2 = facets_mm2 + half_mm * outline_mm + math.pi * half_mm * half_mm
    grown_outline_mm = outline_mm + 2.0 * math.pi * half_mm
    judged = max(1, int(sums[Sum.PLANAR] + sums[Sum.ROUGH]))
    vertices = max(1, int(sums[Sum.VERTICES]))
    mean_mm = float(sums[Sum.HEIGHT]) / vertices
    # heights over a slope are uniform between eave and ridge: the ridge lies sqrt(3) standard deviations above the mean
    spread_mm = math.sqrt(max(0.0, 3.0 * (float(sums[Sum.HEIGHT2]) / vertices - mean_mm * mean_mm)))
    return {
        "area_m2": area_mm2 / 1e6,
        "height_m": mean_mm / 1000.0,
        "top_m": (mean_mm + spread_mm) / 1000.0,
        "width_m": 2.0 * area_mm2 / grown_outline_mm / 1000.0,
        "planar_share": float(sums[Sum.PLANAR]) / judged,
        "judged": float(sums[Sum.PLANAR] + sums[Sum.ROUGH]),
        "canopy_share": float(sums[Sum.CANOPY]) / max(1, int(sums[Sum.CANOPY] + sums[Sum.POINTS])),
        "wall_share": float(sums[Sum.WALL]) / outline_mm,
        "top_share": float(sums[Sum.WALL_TOP]) / max(1, int(sums[Sum.WALL])),
        "step_share": float(sums[Sum.STEP]) / outline_mm,
    }


def judge_surface(kind: int, sums: IntArray, settings: CandidateSettings) -> Verdict | None:
    """Why one whole surface is no candidate; None where it is one.

    Parameters
    ----------
    kind : int
        FacetKind of the surface: OBJECT, BUILDING or CROWN.
    sums : (N_SUMS,) int64
        Its sums.
    settings : CandidateSettings
        The thresholds.
    """
    f = _figures(sums)
    sure = f["judged"] > 0 and f["planar_share"] >= settings.sure_planar_share
    sure = sure and f["canopy_share"] <= settings.max_canopy_share
    slender = f["height_m"] > settings.max_slenderness * f["width_m"]
    sure = sure and (f["area_m2"] >= settings.doubtful_area_m2 or not slender)
    least_m2 = settings.min_area_m2
    if kind != FacetKind.BUILDING and not sure:
        least_m2 = max(least_m2, settings.doubtful_area_m2)
    if f["area_m2"] < least_m2:
        return Verdict(reason=Reason.TOO_SMALL, detail=f"area {f['area_m2']:.1f} m2, at least {least_m2:g}")
    if kind == FacetKind.BUILDING:
        return None
    if f["top_m"] < settings.min_height_m:
        return Verdict(
            reason=Reason.TOO_LOW,
            detail=f"top {f['top_m']:.2f} m above the terrain, at least {settings.min_height_m:g}",
        )
    if kind == FacetKind.CROWN:
        return Verdict(
            reason=Reason.VEGETATION,
            detail=f"a crown: most of what surrounds its vertices is rough, planar share {f['planar_share']:.2f}",
        )
    if f["judged"] > 0 and f["planar_share"] < settings.min_planar_share:
        return Verdict(
            reason=Reason.VEGETATION,
            detail=f"planar share {f['planar_share']:.2f}, at least {settings.min_planar_share:g}",
        )
    if f["canopy_share"] > settings.max_canopy_share:
        return Verdict(
            reason=Reason.VEGETATION,
            detail=f"canopy share {f['canopy_share']:.2f}, at most {settings.max_canopy_share:g}",
        )
    width_m = settings.min_width_m * (0.5 if sure else 1.0)
    if f["width_m"] < width_m:
        return Verdict(reason=Reason.TOO_NARROW, detail=f"mean width {f['width_m']:.2f} m, at least {width_m:g}")
    if f["wall_share"] < settings.min_wall_share:
        return Verdict(
            reason=Reason.NO_WALLS,
            detail=f"walls along {f['wall_share']:.2f} of the outline, at least {settings.min_wall_share:g}",
        )
    if not sure and f["top_share"] < settings.min_top_share:
        z_avg = float(sums[Sum.WALLS_Z_MX]) / max(1, int(sums[Sum.WALLS])) / 1000.0
        own = float(sums[Sum.WALLS_OWN_Z]) / max(1, int(sums[Sum.WALLS])) / 1000.0
        return Verdict(
            reason=Reason.BELOW_Z_AVG,
            detail=f"at the top of {f['top_share']:.2f} of its walls, at least {settings.min_top_share:g} "
            f"(own {own:.2f} m, Z_avg {z_avg:.2f} m)",
        )
    return None


def is_object(kind: int, sums: IntArray, settings: CandidateSettings) -> bool:
    """Whether a surface is large enough to be listed at all, as candidate or rejected."""
    large_enough = bool(sums[Sum.AREA2] >= 2e6 * settings.min_object_area_m2)
    return kind in {FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN} and large_enough


def _joins(kind: int, sums: IntArray, verdict: Verdict | None, settings: CandidateSettings) -> bool:
    """Whether a surface is roof-like and mostly bounded by steps, as a dormer, a lift house or an upper storey."""
    f = _figures(sums)
    small_roof = verdict is None or (
        verdict.reason in {Reason.TOO_SMALL, Reason.TOO_NARROW, Reason.BELOW_Z_AVG}
        and f["top_m"] >= settings.min_height_m
        and f["planar_share"] >= settings.min_planar_share
        and f["canopy_share"] <= settings.max_canopy_share
    )
    return kind in {FacetKind.OBJECT, FacetKind.BUILDING} and small_roof and f["step_share"] >= settings.unite_share


def unite_levels(surfaces: Surfaces, verdicts: list[Verdict | None], settings: CandidateSettings) -> IntArray:
    """The candidate that each surface belongs to: its own index, or that of a larger roof across a step.

    Parameters
    ----------
    surfaces : Surfaces
        Whole surfaces.
    verdicts : list of Verdict or None
        One a surface.
    settings : CandidateSettings
        `unite_share`.

    Returns
    -------
    (k,) int64
        Index of the surface that leads the candidate; -1 for surfaces that belong to none.
    """
    count = len(surfaces.kind)
    leader = np.array([k if verdicts[k] is None else -1 for k in range(count)], np.int64)
    # the largest first; equal areas by the smallest point, so that numbering does not matter
    order = np.lexsort((*surfaces.lowest_point_mm.T[::-1], -surfaces.sums[:, Sum.AREA2]))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    roofs_at: dict[int, list[int]] = {}
    steps_of: dict[int, list[int]] = {}
    for surface, step, _length in surfaces.along_steps.tolist():
        steps_of.setdefault(surface, []).append(step)
        if verdicts[surface] is None:
            roofs_at.setdefault(step, []).append(surface)
    ranked = {step: np.array(sorted(roofs, key=lambda k: rank[k]), np.int64) for step, roofs in roofs_at.items()}
    reach_mm = round(settings.unite_reach_m * 1000)
    for k in sorted(steps_of):
        if not _joins(int(surfaces.kind[k]), surfaces.sums[k], verdicts[k], settings):
            continue
        x0, y0, x1, y1 = (int(v) for v in surfaces.boxes_mm[k])
        best = -1
        for step in steps_of[k]:
            roofs = ranked.get(step, np.empty(0, np.int64))
            boxes = surfaces.boxes_mm[roofs]
            # one step can run through a whole town: only roofs that come near count
            near = (
                (boxes[:, 0] <= x1 + reach_mm)
                & (boxes[:, 2] >= x0 - reach_mm)
                & (boxes[:, 1] <= y1 + reach_mm)
                & (boxes[:, 3] >= y0 - reach_mm)
                & (rank[roofs] < rank[k])
            )
            if near.any():
                first = int(roofs[int(near.argmax())])
                if best < 0 or rank[first] < rank[best]:
                    best = first
        if best >= 0:
            leader[k] = best
    # a leader may itself have joined a larger one: follow to the end; ranks strictly fall, so there is no cycle
    for k in range(count):
        top = int(leader[k])
        while top >= 0 and int(leader[top]) != top:
            top = int(leader[top])
        leader[k] = top
    return leader
