"""Judges whole surfaces: which are candidates for buildings, and why the others are not.

By the Z_avg rule (Shorter and Kasparis, section 3.1) a roof facet lies above the mean height of the walls. In a scene
the rule applies to each surface and the walls that touch it: a roof lies at the top of its walls, a street at their
foot. Each metre of outline votes: one tower beside a low roof cannot outvote its eaves.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import assert_never

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, KindArray, Reason
from pipeline.terrain.decks_and_vehicles import are_decks, are_vehicles, deck_detail, shape_figures, vehicle_detail
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.fragment_sums import Sum
from pipeline.terrain.terrain_settings import CandidateSettings

NOWHERE = 2**62
"""Coordinate of the smallest point of a surface that has none."""
SOLID = (FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN)
"""Kinds of the surfaces that are judged."""
CONNECTING = (FacetKind.STEP, FacetKind.SEAM)
"""Kinds of what lies between two of them that may be one building."""
_NARROW_M = 1.0
"""Narrower surfaces count as this wide: their width is known no better."""
_LEAST_SEAM_M = 2.0
"""Shorter seams join nothing, as shorter borders of patches do not in `unit_division`. Not a setting: what they join is
divided into units again, at steps."""
_GLASS_SHARE = 0.15
"""Least share of the points in a candidate's outline that were seen through it. Not a setting: it is below that of
any glass, and the tiles of a roof let none through."""
_BLOCK = 65_536
"""Surfaces judged at once: it limits the memory to 20 MB."""


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
    """(k, 3) smallest assigned point; NOWHERE where there is none."""
    along_steps: IntArray
    """(s, 2) surface and step; one row per pair. The numbers of steps need not be those of surfaces."""


class Fault(IntEnum):
    """The first rule that a surface breaks."""

    NONE = 0
    """It is a candidate."""
    TOO_SMALL = 1
    TOO_LOW = 2
    CROWN = 3
    """A crown by its kind."""
    ROUGH = 4
    """Too little of it is planar."""
    COVERED = 5
    """Too many earlier returns above it."""
    TOO_NARROW = 6
    NO_WALLS = 7
    BELOW_Z_AVG = 8
    TOO_SPARSE = 9
    """No vertex has enough neighbours to show whether the surface is planar."""
    PIERCED = 10
    """Too many pulses go on below it."""
    DECK = 11
    """A bridge."""
    VEHICLE = 12
    NOT_JUDGED = 13
    """Ground, a step between levels, or a surface without points."""


REASON_OF_FAULT = {
    Fault.TOO_SMALL: Reason.TOO_SMALL,
    Fault.TOO_LOW: Reason.TOO_LOW,
    Fault.CROWN: Reason.VEGETATION,
    Fault.ROUGH: Reason.VEGETATION,
    Fault.COVERED: Reason.VEGETATION,
    Fault.TOO_NARROW: Reason.TOO_NARROW,
    Fault.NO_WALLS: Reason.NO_WALLS,
    Fault.BELOW_Z_AVG: Reason.BELOW_Z_AVG,
    Fault.TOO_SPARSE: Reason.TOO_FEW_POINTS,
    Fault.PIERCED: Reason.VEGETATION,
    Fault.DECK: Reason.BRIDGE,
    Fault.VEHICLE: Reason.VEHICLE,
}
"""The reason in the records for each fault."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """Why a surface is not a candidate."""

    reason: Reason
    """From the closed list."""
    detail: str
    """The measured figure and the threshold."""


def _figures(sums: IntArray) -> dict[str, FloatArray]:
    """The measures of surfaces (k, N_SUMS) in metres and shares, each (k,)."""
    facets_mm2 = sums[:, Sum.AREA2] / 2.0
    outline_mm = np.maximum(1, sums[:, Sum.BOUNDARY])
    # the facets end at the outermost points, half a spacing inside the edges: grown by that (Steiner's formula)
    half_mm = 0.5 * np.sqrt(2.0 * facets_mm2 / np.maximum(1, sums[:, Sum.FACETS]))
    area_mm2 = facets_mm2 + half_mm * outline_mm + math.pi * half_mm * half_mm
    grown_outline_mm = outline_mm + 2.0 * math.pi * half_mm
    known = sums[:, Sum.PLANAR] + sums[:, Sum.ROUGH]
    vertices = np.maximum(1, sums[:, Sum.VERTICES])
    mean_mm = sums[:, Sum.HEIGHT] / vertices
    # heights over a slope are uniform between eave and ridge: the ridge lies sqrt(3) standard deviations above the mean
    points = np.maximum(1, sums[:, Sum.POINTS])
    spread_mm = np.sqrt(np.maximum(0.0, 3.0 * (sums[:, Sum.HEIGHT2] / vertices - mean_mm * mean_mm)))
    return {
        "area_m2": area_mm2 / 1e6,
        "height_m": mean_mm / 1000.0,
        "top_m": (mean_mm + spread_mm) / 1000.0,
        "width_m": 2.0 * area_mm2 / grown_outline_mm / 1000.0,
        "planar_share": sums[:, Sum.PLANAR] / np.maximum(1, known),
        "judged": known.astype(np.float64),
        "smooth_share": sums[:, Sum.SMOOTH] / np.maximum(1, known),
        "canopy_share": sums[:, Sum.CANOPY] / np.maximum(1, sums[:, Sum.CANOPY] + sums[:, Sum.POINTS]),
        "points": points.astype(np.float64),
        "several_share": sums[:, Sum.SEVERAL] / points,
        "through_share": sums[:, Sum.THROUGH] / points,
        "wall_share": sums[:, Sum.WALL] / outline_mm,
        "top_share": sums[:, Sum.WALL_TOP] / np.maximum(1, sums[:, Sum.WALL]),
        "step_share": sums[:, Sum.STEP] / outline_mm,
        "seam_m": sums[:, Sum.SEAM] / 1000.0,
        **shape_figures(sums),
    }


def _penetration(f: dict[str, FloatArray], settings: CandidateSettings) -> tuple[BoolArray, FloatArray]:
    """Which surfaces surely let few pulses through, and the largest share that may go on below each.

    At the edge of a roof pulses go on, too: the narrower a surface, the larger the part of it that is edge. Shares of
    few points scatter by the standard deviation of a binomial distribution. A surface without any pulse of several
    returns shows nothing, and so does one without any of a single return: the scanner may record one echo of each
    pulse, or a first and a last one of each. A surface of which a part is as smooth as the scanner measures is a roof,
    however many pulses meet its edges.
    """
    p = settings.max_through_share
    scatter = np.sqrt(p * (1.0 - p) / f["points"])
    is_intact = (f["several_share"] > 0.0) & (f["several_share"] + scatter <= p)
    most = p + settings.beam_m / np.maximum(_NARROW_M, f["width_m"]) + scatter
    q = settings.min_smooth_share
    is_smooth = f["smooth_share"] >= q + np.sqrt(q * (1.0 - q) / np.maximum(1.0, f["judged"]))
    return is_intact, np.where(is_smooth | (f["several_share"] >= 1.0), np.inf, most)


def _limits(
    kind: KindArray, f: dict[str, FloatArray], settings: CandidateSettings
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Which surfaces are surely roofs, and the least area (m2) and width (m) of each."""
    sure = (f["judged"] > 0) & (f["planar_share"] >= settings.sure_planar_share)
    slender = f["height_m"] > settings.max_slenderness * f["width_m"]
    sure &= (f["area_m2"] >= settings.doubtful_area_m2) | ~slender
    is_intact, _ = _penetration(f, settings)
    sure |= is_intact & (f["area_m2"] >= settings.doubtful_area_m2)
    sure &= f["canopy_share"] <= settings.max_canopy_share
    doubtful = (kind != FacetKind.BUILDING) & ~sure
    min_m2 = np.where(doubtful, max(settings.min_area_m2, settings.doubtful_area_m2), settings.min_area_m2)
    return sure, min_m2, settings.min_width_m * np.where(sure, 0.5, 1.0)


def _faults(kind: KindArray, sums: IntArray, settings: CandidateSettings) -> KindArray:
    """The first fault of each of some surfaces, by their kind and sums alone."""
    f = _figures(sums)
    sure, min_m2, width_m = _limits(kind, f, settings)
    is_intact, max_through = _penetration(f, settings)
    # the first rule that holds decides
    rules = [
        (f["area_m2"] < min_m2, Fault.TOO_SMALL),
        (kind == FacetKind.BUILDING, Fault.NONE),
        (f["top_m"] < settings.min_height_m, Fault.TOO_LOW),
        (kind == FacetKind.CROWN, Fault.CROWN),
        (~is_intact & (f["judged"] == 0), Fault.TOO_SPARSE),
        (~is_intact & (f["planar_share"] < settings.min_planar_share), Fault.ROUGH),
        (f["through_share"] > max_through, Fault.PIERCED),
        (f["canopy_share"] > settings.max_canopy_share, Fault.COVERED),
        (f["width_m"] < width_m, Fault.TOO_NARROW),
        (f["wall_share"] < settings.min_wall_share, Fault.NO_WALLS),
        (~sure & (f["top_share"] < settings.min_top_share), Fault.BELOW_Z_AVG),
        (are_decks(f, settings), Fault.DECK),
        (are_vehicles(f, settings), Fault.VEHICLE),
    ]
    found = np.select([held for held, _ in rules], [np.int8(fault) for _, fault in rules], np.int8(Fault.NONE))
    return found.astype(np.int8)


def judge_surfaces(surfaces: Surfaces, settings: CandidateSettings) -> KindArray:
    """The first `Fault` of each whole surface of any kind, (k,) int8.

    NOT_JUDGED for ground, steps, and surfaces that would be candidates without points.
    """
    found = np.full(len(surfaces.kind), Fault.NOT_JUDGED, np.int8)
    solid = np.flatnonzero(np.isin(surfaces.kind, SOLID))
    for start in range(0, len(solid), _BLOCK):
        block = solid[start : start + _BLOCK]
        found[block] = _faults(surfaces.kind[block], surfaces.sums[block], settings)
    found[(found == Fault.NONE) & (surfaces.lowest_point_mm[:, 0] == NOWHERE)] = Fault.NOT_JUDGED
    return found


def judge_surface(kind: int, sums: IntArray, settings: CandidateSettings) -> Verdict | None:
    """Why one whole surface is not a candidate, in words; None if it is one.

    Its kind is OBJECT, BUILDING or CROWN; `sums` are (N_SUMS,) int64.
    """
    return next(verdicts(np.array([kind], np.int8), sums[None], settings))


def verdicts(kind: KindArray, sums: IntArray, settings: CandidateSettings) -> Iterator[Verdict | None]:
    """The verdicts on surfaces (k,), (k, N_SUMS), each as in `judge_surface`."""
    for start in range(0, len(kind), _BLOCK):
        own = slice(start, start + _BLOCK)
        faults, figures = _faults(kind[own], sums[own], settings), _figures(sums[own])
        _, min_m2, width_m = _limits(kind[own], figures, settings)
        figures |= {"min_m2": min_m2, "least_width_m": width_m}
        figures |= {"max_through": _penetration(figures, settings)[1]}
        walls = np.maximum(1, sums[own, Sum.WALLS])
        figures |= {"z_avg": sums[own, Sum.WALLS_Z_MX] / walls / 1000.0}
        figures |= {"own": sums[own, Sum.WALLS_OWN_Z] / walls / 1000.0}
        names = list(figures)
        for fault, row in zip(faults.tolist(), np.column_stack(list(figures.values())).tolist(), strict=True):
            yield _verdict(Fault(fault), dict(zip(names, row, strict=True)), settings)


def _verdict(fault: Fault, f: Mapping[str, float], settings: CandidateSettings) -> Verdict | None:
    """A fault in words, with the figure and the threshold; None where no rule is broken."""
    match fault:
        case Fault.NONE | Fault.NOT_JUDGED:
            return None
        case Fault.TOO_SMALL:
            detail = f"area {f['area_m2']:.1f} m2, at least {f['min_m2']:g}"
        case Fault.TOO_LOW:
            detail = f"top {f['top_m']:.2f} m above the terrain, at least {settings.min_height_m:g}"
        case Fault.CROWN:
            share = f["planar_share"]
            detail = f"a crown: most of what surrounds its vertices is rough, planar share {share:.2f}"
        case Fault.ROUGH:
            detail = f"planar share {f['planar_share']:.2f}, at least {settings.min_planar_share:g}"
        case Fault.TOO_SPARSE:
            detail = "no vertex has enough neighbours to show whether the surface is planar"
        case Fault.PIERCED:
            share = f["through_share"]
            detail = f"pulses of {share:.2f} of its points go on below, at most {f['max_through']:.2f}"
        case Fault.COVERED:
            detail = f"canopy share {f['canopy_share']:.2f}, at most {settings.max_canopy_share:g}"
        case Fault.TOO_NARROW:
            detail = f"mean width {f['width_m']:.2f} m, at least {f['least_width_m']:g}"
        case Fault.NO_WALLS:
            detail = f"walls along {f['wall_share']:.2f} of the outline, at least {settings.min_wall_share:g}"
        case Fault.BELOW_Z_AVG:
            detail = f"at the top of {f['top_share']:.2f} of its walls, at least {settings.min_top_share:g} "
            detail += f"(own {f['own']:.2f} m, Z_avg {f['z_avg']:.2f} m)"
        case Fault.DECK:
            detail = deck_detail(f, settings)
        case Fault.VEHICLE:
            detail = vehicle_detail(f, settings)
        case _:
            assert_never(fault)
    return Verdict(reason=REASON_OF_FAULT[fault], detail=detail)


def are_objects(kind: KindArray, sums: IntArray, settings: CandidateSettings) -> BoolArray:
    """Which surfaces (k,) are large enough to be listed, as candidate or rejected."""
    large_enough: BoolArray = sums[:, Sum.AREA2] >= 2e6 * settings.min_object_area_m2
    return np.isin(kind, SOLID) & large_enough


def are_glass(sums: IntArray, candidate: IntArray, count: int) -> BoolArray:
    """Which of `count` candidates pulses went through; surfaces (k, N_SUMS), with the candidate of each (k,)."""
    through, stopped = np.zeros(count, np.int64), np.zeros(count, np.int64)
    np.add.at(through, candidate, sums[:, Sum.GLASS])
    np.add.at(stopped, candidate, sums[:, Sum.POINTS])
    found: BoolArray = through >= _GLASS_SHARE * (through + stopped)
    return found & (through > 0)


def may_join(kind: KindArray, sums: IntArray, faults: KindArray, settings: CandidateSettings) -> BoolArray:
    """Which surfaces (k,) may belong to a larger roof across a step or a seam.

    They are roof-like or classified, and mostly bounded by steps, like a dormer, a lift house or an upper storey; or
    they go on in the larger roof without a wall, of which the classes of the file name one part only.
    """
    f = _figures(sums)
    small_roof = np.isin(faults, (Fault.TOO_SMALL, Fault.TOO_NARROW, Fault.BELOW_Z_AVG))
    small_roof &= f["top_m"] >= settings.min_height_m
    small_roof &= f["planar_share"] >= settings.min_planar_share
    small_roof &= f["canopy_share"] <= settings.max_canopy_share
    small_roof |= (kind == FacetKind.BUILDING) & (faults == Fault.TOO_SMALL)
    joins: BoolArray = (faults == Fault.NONE) | small_roof
    joins &= (f["step_share"] >= settings.unite_share) | (f["seam_m"] >= _LEAST_SEAM_M)
    return np.isin(kind, (FacetKind.OBJECT, FacetKind.BUILDING)) & joins


@kernel
def _largest_beside(
    joining: IntArray,
    steps: IntArray,
    roofs: IntArray,
    first: IntArray,
    rank: IntArray,
    boxes: IntArray,
    reach_mm: int,
    leader: IntArray,
) -> None:
    """Set the leader of each joining surface (row by row with one of its steps) to the largest larger roof beside it.

    The roofs of step s are `roofs[first[s]:first[s + 1]]`, by rank.
    """
    for i in range(joining.size):
        k = joining[i]
        # one step can run through a whole town: only roofs that come near count
        x0, y0, x1, y1 = boxes[k, 0] - reach_mm, boxes[k, 1] - reach_mm, boxes[k, 2] + reach_mm, boxes[k, 3] + reach_mm
        for j in range(first[steps[i]], first[steps[i] + 1]):
            roof = roofs[j]
            if rank[roof] >= rank[k]:
                break
            if boxes[roof, 0] <= x1 and boxes[roof, 2] >= x0 and boxes[roof, 1] <= y1 and boxes[roof, 3] >= y0:
                if leader[k] < 0 or rank[roof] < rank[leader[k]]:
                    leader[k] = roof
                break


def unite_levels(surfaces: Surfaces, faults: KindArray, settings: CandidateSettings) -> IntArray:
    """The candidate that each whole surface belongs to, (k,): its own index, or that of a larger roof beside it.

    `faults` are those of `judge_surfaces`. -1 for surfaces that belong to no candidate.
    """
    count = len(surfaces.kind)
    is_roof = faults == Fault.NONE
    leader = np.where(is_roof, np.arange(count), -1)
    # the largest first; equal areas by the smallest point, so that numbering does not matter
    order = np.lexsort((*surfaces.lowest_point_mm.T[::-1], -surfaces.sums[:, Sum.AREA2]))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    surface = surfaces.along_steps[:, 0]
    numbers, step = np.unique(surfaces.along_steps[:, 1], return_inverse=True)
    step = step.reshape(-1)
    at_roof = np.flatnonzero(is_roof[surface])
    at_roof = at_roof[np.lexsort((rank[surface[at_roof]], step[at_roof]))]
    first = np.searchsorted(step[at_roof], np.arange(len(numbers) + 1))
    beside, place = np.unique(surface, return_inverse=True)
    joins = may_join(surfaces.kind[beside], surfaces.sums[beside], faults[beside], settings)[place.reshape(-1)]
    _largest_beside(
        surface[joins], step[joins], surface[at_roof], first, rank, surfaces.boxes_mm,
        round(settings.unite_reach_m * 1000), leader,
    )  # fmt: skip
    # a leader may itself have joined a larger one: follow to the end; ranks strictly fall, so there is no cycle
    led = np.flatnonzero(leader >= 0)
    while True:
        further = leader[leader[led]]
        if (further == leader[led]).all():
            return leader
        leader[led] = further
