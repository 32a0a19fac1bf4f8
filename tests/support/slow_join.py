"""The join as the science defines it, slowly: all fragments of all tiles at once, each surface judged on its own."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.model import IntArray, Reason
from pipeline.runtime.stages.sites import CandidateSite, FoundSites, PointRange, RejectedSite, object_id
from pipeline.terrain.candidates import NOWHERE, Surfaces, Verdict
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.fragment_sums import N_SUMS, Sum
from pipeline.terrain.settings import CandidateSettings
from pipeline.terrain.surfaces import Fragments
from pipeline.tiling import Tile, TileGrid

_NOT_JUDGED = Verdict(reason=Reason.TOO_FEW_POINTS, detail="ground, a step between levels, or a surface without points")


@dataclasses.dataclass(frozen=True, kw_only=True)
class WholeSplit:
    """All fragments of one tile."""

    tile: Tile
    fragments: Fragments
    starts: npt.NDArray[np.int64]
    """(k + 1,) where each fragment's points start in the tile's sorted points."""
    keys: npt.NDArray[np.int64]
    """(k,) the fragment."""


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
    points = max(1, int(sums[Sum.POINTS]))
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
        "smooth_share": float(sums[Sum.SMOOTH]) / max(1, int(sums[Sum.PLANAR] + sums[Sum.ROUGH])),
        "canopy_share": float(sums[Sum.CANOPY]) / max(1, int(sums[Sum.CANOPY] + sums[Sum.POINTS])),
        "points": float(points),
        "several_share": float(sums[Sum.SEVERAL]) / points,
        "through_share": float(sums[Sum.THROUGH]) / points,
        "wall_share": float(sums[Sum.WALL]) / outline_mm,
        "top_share": float(sums[Sum.WALL_TOP]) / max(1, int(sums[Sum.WALL])),
        "step_share": float(sums[Sum.STEP]) / outline_mm,
        "open_share": float(sums[Sum.OPEN]) / outline_mm,
        **_shape(sums, facets_mm2 / 1e6, half_mm / 500.0),
    }


def _moments(sums: IntArray, columns: Sequence[Sum], x: int, y: int) -> tuple[float, ...]:
    """Moments of one or two outlines, or of an area, about a place in dm; wrapped sums become exact again."""
    w, sx, sy, sxx, sxy, syy = (sum(int(sums[first + k]) for first in columns) for k in range(6))
    exact = (w, sx - w * x, sy - w * y, sxx - 2 * x * sx + w * x * x, sxy - x * sy - y * sx + w * x * y)
    exact = (*exact, syy - 2 * y * sy + w * y * y)
    _, *rest = ((value + 2**63) % 2**64 - 2**63 for value in exact)
    return tuple(value / float(max(1, w)) / unit for value, unit in zip(rest, (10, 10, 100, 100, 100), strict=True))


def _shape(sums: IntArray, facets_m2: float, spacing_m: float) -> dict[str, float]:
    """The measures that show decks and vehicles."""
    weight = max(1, int(sums[Sum.AREA_W]))
    x, y = int(sums[Sum.AREA_X]) // weight, int(sums[Sum.AREA_Y]) // weight
    dx, dy, xx, xy, yy = _moments(sums, (Sum.AREA_W,), x, y)
    a, b, d = xx - dx * dx, xy - dx * dy, yy - dy * dy
    middle = (a + d) / 2.0
    half = math.sqrt(max(0.0, middle * middle - (a * d - b * b)))
    found = {
        "end_share": 0.0,
        "apart_m": 0.0,
        "ends": 0.0,
        "across_m": math.sqrt(12.0 * max(0.0, middle - half)) + spacing_m,
        "along_m": math.sqrt(12.0 * max(0.0, middle + half)) + spacing_m,
        "spacing_m": spacing_m,
    }
    is_open = int(sums[Sum.OPEN]) >= 0.85 * max(1, int(sums[Sum.BOUNDARY]))
    cut, whole = (Sum.LEVEL_W, Sum.GAP_W), (Sum.LEVEL_W,)
    for outlines, ends, long in ((whole, 1.0, 8.0), (cut, 1.0, 1.0), (whole, 2.0, 0.0)):
        if long > 1.0 and not is_open:
            continue
        mx, my, lxx, lxy, lyy = _moments(sums, outlines, x, y)
        inverse = max(1e-12, a * d - b * b)
        m = ((d * lxx - b * lxy) / inverse, (d * lxy - b * lyy) / inverse)
        n = ((a * lxy - b * lxx) / inverse, (a * lyy - b * lxy) / inverse)
        mean = (m[0] + n[1]) / 2.0
        root = math.sqrt(max(0.0, mean * mean - (m[0] * n[1] - m[1] * n[0])))
        if mean + root < 2.45 or mean - root > 1.5:
            continue
        if long <= 1.0 and (d * mx * mx - 2.0 * b * mx * my + a * my * my) / inverse > 1.0:
            continue
        forms = ((mean + root - n[1], n[0]), (m[1], mean + root - m[0]))
        p, q = max(forms, key=lambda form: form[0] * form[0] + form[1] * form[1])
        u, v = a * p + b * q, b * p + d * q
        apart = math.sqrt(12.0 * max(0.0, (u * u + v * v) / max(1e-12, p * u + q * v)))
        if apart * apart < long * facets_m2:
            continue
        found["apart_m"], found["ends"] = apart, ends
        found["end_share"] = int(sums[Sum.LEVEL_W]) / 100.0 / max(1e-6, ends * facets_m2 / max(1e-6, apart))
    return found


def slowly_judged(kind: int, sums: IntArray, settings: CandidateSettings) -> Verdict | None:
    """Why one whole surface is no candidate; None where it is one."""
    fault = _fault(kind, sums, settings)
    return None if fault is None else Verdict(reason=fault[0], detail=fault[1])


def _fault(kind: int, sums: IntArray, settings: CandidateSettings) -> tuple[Reason, str] | None:
    """The reason and its detail."""
    f = _figures(sums)
    sure = f["judged"] > 0 and f["planar_share"] >= settings.sure_planar_share
    slender = f["height_m"] > settings.max_slenderness * f["width_m"]
    sure = sure and (f["area_m2"] >= settings.doubtful_area_m2 or not slender)
    p = settings.max_through_share
    scatter = math.sqrt(p * (1.0 - p) / f["points"])
    is_intact = f["several_share"] > 0.0 and f["several_share"] + scatter <= p
    sure = sure or (is_intact and f["area_m2"] >= settings.doubtful_area_m2)
    sure = sure and f["canopy_share"] <= settings.max_canopy_share
    min_m2 = settings.min_area_m2
    if kind != FacetKind.BUILDING and not sure:
        min_m2 = max(min_m2, settings.doubtful_area_m2)
    if f["area_m2"] < min_m2:
        return Reason.TOO_SMALL, f"area {f['area_m2']:.1f} m2, at least {min_m2:g}"
    if kind == FacetKind.BUILDING:
        return None
    if f["top_m"] < settings.min_height_m:
        return Reason.TOO_LOW, f"top {f['top_m']:.2f} m above the terrain, at least {settings.min_height_m:g}"
    if kind == FacetKind.CROWN:
        rough = "a crown: most of what surrounds its vertices is rough"
        return Reason.VEGETATION, f"{rough}, planar share {f['planar_share']:.2f}"
    if f["judged"] == 0 and not is_intact:
        return Reason.TOO_FEW_POINTS, "no vertex has enough neighbours to show whether the surface is planar"
    if f["planar_share"] < settings.min_planar_share and not is_intact:
        return Reason.VEGETATION, f"planar share {f['planar_share']:.2f}, at least {settings.min_planar_share:g}"
    most = p + settings.beam_m / max(1.0, f["width_m"]) + scatter
    q = settings.min_smooth_share
    is_smooth = f["smooth_share"] >= q + math.sqrt(q * (1.0 - q) / max(1.0, f["judged"]))
    if f["several_share"] < 1.0 and not is_smooth and f["through_share"] > most:
        share = f"pulses of {f['through_share']:.2f} of its points go on below"
        return Reason.VEGETATION, f"{share}, at most {most:.2f}"
    if f["canopy_share"] > settings.max_canopy_share:
        return Reason.VEGETATION, f"canopy share {f['canopy_share']:.2f}, at most {settings.max_canopy_share:g}"
    width_m = settings.min_width_m * (0.5 if sure else 1.0)
    if f["width_m"] < width_m:
        return Reason.TOO_NARROW, f"mean width {f['width_m']:.2f} m, at least {width_m:g}"
    if f["wall_share"] < settings.min_wall_share:
        share = f["wall_share"]
        return Reason.NO_WALLS, f"walls along {share:.2f} of the outline, at least {settings.min_wall_share:g}"
    if not sure and f["top_share"] < settings.min_top_share:
        z_avg = float(sums[Sum.WALLS_Z_MX]) / max(1, int(sums[Sum.WALLS])) / 1000.0
        own = float(sums[Sum.WALLS_OWN_Z]) / max(1, int(sums[Sum.WALLS])) / 1000.0
        detail = f"at the top of {f['top_share']:.2f} of its walls, at least {settings.min_top_share:g}"
        return Reason.BELOW_Z_AVG, f"{detail} (own {own:.2f} m, Z_avg {z_avg:.2f} m)"
    if f["end_share"] >= settings.min_deck_end_share:
        share, apart = f"level with the ground along {f['end_share']:.2f}", f"{f['apart_m']:.1f} m"
        ends = f"of two opposite ends, {apart} apart" if f["ends"] == 2.0 else f"of one end, {apart} from the other"
        return Reason.BRIDGE, f"{share} {ends}, at least {settings.min_deck_end_share:g}"
    if (
        f["across_m"] <= settings.max_vehicle_width_m
        and f["spacing_m"] <= 0.25 * settings.max_vehicle_width_m
        and f["along_m"] >= settings.min_vehicle_length_m
        and f["top_m"] <= settings.max_vehicle_height_m
        and f["open_share"] >= settings.min_vehicle_open_share
    ):
        size = f"{f['across_m']:.2f} m wide, at most {settings.max_vehicle_width_m:g}, {f['along_m']:.1f} m long"
        return Reason.VEHICLE, f"{size}, {f['top_m']:.2f} m high, free along {f['open_share']:.2f} of the outline"
    return None


def is_object(kind: int, sums: IntArray, settings: CandidateSettings) -> bool:
    """Whether a surface is large enough to be listed at all, as candidate or rejected."""
    large_enough = bool(sums[Sum.AREA2] >= 2e6 * settings.min_object_area_m2)
    return kind in {FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN} and large_enough


def _joins(kind: int, sums: IntArray, verdict: Verdict | None, settings: CandidateSettings) -> bool:
    """Whether a surface may join a larger roof, along steps as a dormer does, or along a seam of classes."""
    f = _figures(sums)
    small_roof = verdict is None or (
        verdict.reason in {Reason.TOO_SMALL, Reason.TOO_NARROW, Reason.BELOW_Z_AVG}
        and f["top_m"] >= settings.min_height_m
        and f["planar_share"] >= settings.min_planar_share
        and f["canopy_share"] <= settings.max_canopy_share
    )
    by_class = kind == FacetKind.BUILDING and verdict is not None and verdict.reason == Reason.TOO_SMALL
    along_steps = small_roof and f["step_share"] >= settings.unite_share
    along_seam = (small_roof or by_class) and sums[Sum.SEAM] >= 2000
    return kind in {FacetKind.OBJECT, FacetKind.BUILDING} and (along_steps or along_seam)


def slowly_united(surfaces: Surfaces, verdicts: list[Verdict | None], settings: CandidateSettings) -> IntArray:
    """The candidate that each surface belongs to: its own index, or that of a larger roof across a step.

    (k,) int64, the index of the surface that leads the candidate; -1 for surfaces that belong to none.
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


def _crossing_pairs(splits: Sequence[WholeSplit], offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Pairs of fragments (n, 2) that hold the same facet."""
    keys = np.concatenate([s.fragments.crossing_keys for s in splits])
    owners = np.concatenate([s.fragments.crossing_fragment + offset for s, offset in zip(splits, offsets, strict=True)])
    if len(keys) == 0:
        return np.empty((0, 2), np.int64)
    order = np.lexsort(keys.T[::-1])
    keys, owners = keys[order], owners[order]
    same = np.flatnonzero((keys[1:] == keys[:-1]).all(axis=1))
    pairs = np.column_stack((owners[same], owners[same + 1])).astype(np.int64)
    return np.unique(pairs, axis=0)


def whole_surfaces(splits: Sequence[WholeSplit]) -> tuple[Surfaces, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The surfaces of all tiles, whole, with their sums.

    Beside them the surface of every fragment, (f,) int64, tile after tile, and where each tile's fragments start in
    that list, (t + 1,) int64.
    """
    counts = [len(s.fragments.kind) for s in splits]
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    total = int(offsets[-1])
    described = [s.fragments for s in splits]
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
    starts = zip(described, offsets.tolist(), strict=False)
    along = [f.along_steps + np.array([offset, offset, 0]) for f, offset in starts if len(f.along_steps)]
    pairs = _summed_pairs(np.concatenate(along), surface) if along else np.empty((0, 3), np.int64)
    whole = Surfaces(
        kind=np.concatenate([f.kind for f in described])[members],
        sums=sums,
        boxes_mm=boxes,
        lowest_point_mm=points[order][first],
        along_steps=pairs,
    )
    return whole, surface.astype(np.int64), offsets


def _summed_pairs(along: IntArray, surface: npt.NDArray[np.int64]) -> IntArray:
    """Rows (surface, step, length) with one row a pair of whole surfaces."""
    pairs = np.column_stack((surface[along[:, 0]], surface[along[:, 1]]))
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    lengths = np.zeros(len(unique), np.int64)
    np.add.at(lengths, inverse.ravel(), along[:, 2])
    return np.column_stack((unique, lengths))


def _ranges_by_key(splits: Sequence[WholeSplit], surface_of: dict[tuple[int, int], int]) -> dict[int, list[PointRange]]:
    """Point ranges of every surface that has points; `surface_of` maps (tile index, key) to it."""
    ranges: dict[int, list[PointRange]] = {}
    for t, s in enumerate(splits):
        for j, key in enumerate(s.keys.tolist()):
            where = surface_of.get((t, key))
            if where is not None:
                held = PointRange(tile=s.tile, start=int(s.starts[j]), stop=int(s.starts[j + 1]))
                ranges.setdefault(where, []).append(held)
    return ranges


def whole_join(
    splits: Sequence[WholeSplit], grid: TileGrid, settings: CandidateSettings, crs_name: str
) -> tuple[FoundSites, int]:
    """Unite, judge, and say where each candidate's points lie."""
    splits = sorted(splits, key=lambda s: s.tile)
    surfaces, surface_of_fragment, offsets = whole_surfaces(splits)
    count = len(surfaces.kind)
    verdicts: list[Verdict | None] = []
    for k in range(count):
        kind = int(surfaces.kind[k])
        judged = kind in {FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN}
        verdict = slowly_judged(kind, surfaces.sums[k], settings) if judged else _NOT_JUDGED
        if verdict is None and surfaces.lowest_point_mm[k, 0] == NOWHERE:
            verdict = _NOT_JUDGED
        verdicts.append(verdict)
    leader = slowly_united(surfaces, verdicts, settings)
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
    glass: dict[int, tuple[int, int]] = {}
    for k in np.flatnonzero(leader >= 0).tolist():
        point = tuple(int(v) for v in surfaces.lowest_point_mm[k])
        lead = int(leader[k])
        lowest[lead] = min(lowest.get(lead, point), point)
        seen_through, stopped = glass.get(lead, (0, 0))
        own = surfaces.sums[k]
        glass[lead] = seen_through + int(own[Sum.GLASS]), stopped + int(own[Sum.POINTS])
    candidates = [
        CandidateSite(
            building_id=object_id(crs_name, lowest[lead]),
            owner=grid.tile_of(lowest[lead][0], lowest[lead][1]),
            ranges=tuple(found),
            points=sum(r.stop - r.start for r in found),
            is_glass=0 < glass[lead][0] >= 0.15 * sum(glass[lead]),
        )
        for lead, found in ranges.items()
        if lead in lowest
    ]
    rejected, small = [], 0
    for k, verdict in enumerate(verdicts):
        kind = int(surfaces.kind[k])
        if verdict is None or int(leader[k]) >= 0 or kind in {FacetKind.STEP, FacetKind.SEAM, FacetKind.GROUND}:
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
                planar=int(sums[Sum.PLANAR]),
                rough=int(sums[Sum.ROUGH]),
            )
        )
    found = FoundSites(
        candidates=tuple(sorted(candidates, key=lambda c: (-c.points, c.building_id))),
        rejected=tuple(sorted(rejected, key=lambda r: r.object_id)),
    )
    return found, small
