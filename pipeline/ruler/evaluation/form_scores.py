"""Form of outlines: how regular they are, and how found ones agree with drawn ones.

Regularity needs no reference: a surveyor draws few directions, right angles and no short edges. Beside drawn outlines
the same figures of these show how much of that is in the place itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from scipy.spatial import KDTree

from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Statistic, Sums, quantile, ratio, share
from pipeline.ruler.evaluation.building_matching import (
    MIN_IOU,
    MIN_SHARE,
    Geometries,
    mostly_on,
    overlapping,
    sound_polygons,
    summed,
)
from pipeline.ruler.evaluation.measure import Better, Definition, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.outline_edges import (
    ALONG_DEG,
    STRAIGHT_M,
    directions,
    edges_of,
    is_near,
    main_direction,
    off,
    ring_of,
    turns,
    united_blocks,
)
from pipeline.ruler.evaluation.subsets import MODELS_ALONE, Columns, measured, measured_all, measured_median, total
from pipeline.ruler.evaluation.wireframe_network import roof_segments, split, welded
from pipeline.ruler.evaluation.wireframe_scores import matched_corners, sampled, tolerance_name

SHORT_M = 1.0
"""Shorter edges are short."""
RIGHT_DEG = 7.0
"""A right corner differs from 90 degrees by at most this angle."""
ACUTE_DEG = 45.0
"""An inner corner below it is acute."""
TOLERANCES_M = (1.0, 0.5)
"""Distances in plan up to which corners of blocks are one."""
MIN_TURN_DEG = 10.0
"""A corner of a block turns by more."""
STEP_M = 0.2
"""Two faces of one model have a step between them from this difference of heights on, in the middle of the edge."""
MIN_OBLIQUE_M, MIN_OBLIQUE_DEG = 3.0, 12.0
"""A drawn edge of this length that is farther off both directions of its block is oblique."""
NEAR_M = 1.0
"""An oblique edge is found where a model has an edge of its direction within this distance."""
_STRAIGHT_CORNER_M = 0.1
"""As `STRAIGHT_M`, for corners of blocks."""
_SPACING_M = 0.2
"""Spacing of the places on outlines."""
AWAY_M: FloatArray = np.concatenate(([0.0, 1e-6], np.arange(1, 500) * 0.01, np.arange(50, 500) * 0.1, [1e5]))
"""Borders of the bins of distances: 1 cm up to 5 m, 10 cm up to 50 m, and all beyond."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FormScore:
    """The form of outlines, as columns."""

    found: Columns
    """Of each model, summed over its outlines: `outlines`, `corners`, `length_m`, `along_m` in two directions, `right`
    corners, `short` edges, `acute` outlines, `triangles`."""
    drawn: Columns
    """The same of the drawn outlines; empty without any."""
    inner: Columns
    """Of each block of models: `length_m`, `along_m` in its two directions and `short` pieces, after `wall_` those of
    its common walls, after `inner_` those of walls and steps."""
    blocks: Columns
    """Of each drawn block: `x` and `y` of its middle; `compared`: whether a block of models stands there, and if so
    `iou`, `found` and `drawn` corners, `right_1m` and `right_0_5m` pairs of them, `away`: numbers of places on the
    found outline by their distance to the drawn one, in the bins of `AWAY_M`; `oblique_m` and `oblique_found_m` of
    drawn edges. Empty without drawn outlines."""


def score_form(models: Sequence[RoofModel], drawn: Sequence[shapely.Geometry] = ()) -> FormScore:
    """The form of the outlines of models, and of drawn ones if there are any."""
    made, given = sound_polygons([model.footprint for model in models]), sound_polygons(drawn)
    blocks = united_blocks(made)
    return FormScore(
        found=_regularity(made),
        drawn=_regularity(given) if len(drawn) else {},
        inner=_inner_edges(models, blocks, mostly_on(len(made), overlapping(blocks, made))),
        blocks=_beside_drawn(made, blocks, united_blocks(given)) if len(drawn) else {},
    )


# ----------------------------------------------------------------------------------------------------------- regularity

_REGULARITY = ("outlines", "corners", "length_m", "along_m", "right", "short", "acute", "triangles")


def _regularity(outlines: Geometries) -> Columns:
    """The columns of `FormScore.found`, a row per (multi)polygon."""
    parts, owner = shapely.get_parts(outlines, return_index=True)
    rows = np.array([_regularity_of(ring_of(part)) for part in parts], np.float64).reshape(-1, len(_REGULARITY))
    return {name: summed(owner, rows[:, k], len(outlines)) for k, name in enumerate(_REGULARITY)}


def _regularity_of(ring: FloatArray) -> tuple[float, ...]:
    """The figures of one outline, in the order of `_REGULARITY`."""
    if len(ring) < 3:
        return (0.0,) * len(_REGULARITY)
    units, length, direction = edges_of(ring)
    follows = off(direction, main_direction(direction, length)) <= ALONG_DEG
    turn = turns(units)
    return (
        1.0,
        len(ring),
        length.sum(),
        length[follows].sum(),
        (np.abs(turn - 90.0) <= RIGHT_DEG).sum(),
        (length < SHORT_M).sum(),
        float((turn > 180.0 - ACUTE_DEG).any()),
        float(len(ring) == 3),
    )


# ---------------------------------------------------------------------------------------------- steps and common walls

_KINDS = ("wall", "inner")


def _inner_edges(models: Sequence[RoofModel], blocks: Geometries, block: IntArray) -> Columns:
    """The columns of `FormScore.inner`, (b,)."""
    columns = {f"{kind}_{name}": np.zeros(len(blocks)) for kind in _KINDS for name in ("length_m", "along_m", "short")}
    stretches, owner, is_wall = _inner_stretches(models)
    known = block[owner] >= 0  # a footprint without area lies in no block
    stretches, owner, is_wall = stretches[known], owner[known], is_wall[known]
    of = block[owner]
    order = np.argsort(of, kind="stable")
    for here in np.split(order, np.flatnonzero(np.diff(of[order])) + 1) if len(of) else ():
        k = int(of[here[0]])
        _, length_m, direction = edges_of(ring_of(blocks[k]))
        main = main_direction(direction, length_m)
        for kind, chosen in zip(_KINDS, (here[is_wall[here]], here), strict=True):
            lines = _straight_lines(stretches[chosen])
            along = lines[:, 1] - lines[:, 0]
            metres = np.hypot(along[:, 0], along[:, 1])
            piece = _straight_pieces(lines)
            columns[f"{kind}_length_m"][k] = metres.sum()
            columns[f"{kind}_along_m"][k] = metres[off(directions(along), main) <= ALONG_DEG].sum()
            columns[f"{kind}_short"][k] = (np.bincount(piece, weights=metres)[np.unique(piece)] < SHORT_M).sum()
    return columns


def _inner_stretches(models: Sequence[RoofModel]) -> tuple[FloatArray, IntArray, BoolArray]:
    """Stretches of common walls and steps in plan, (e, 2, 2), a model of each, (e,), and whether it is a wall, (e,)."""
    segments = roof_segments(models, range(len(models)))
    vertices, ends = welded(segments.ends[:, :, :2].reshape(-1, 2))
    pieces, source = split(vertices, ends.reshape(-1, 2))
    real = pieces[:, 0] != pieces[:, 1]
    pieces, source = pieces[real], source[real]
    low, high = segments.ends[source, 0], segments.ends[source, 1]
    along = (high - low)[:, :2]
    middle = vertices[pieces].mean(axis=1) - low[:, :2]
    share_of = (middle * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)
    height = low[:, 2] + share_of * (high - low)[:, 2]
    unique, stretch = np.unique(np.sort(pieces, axis=1), axis=0, return_inverse=True)
    last, lowest, highest = np.full(len(unique), -1), np.full(len(unique), np.inf), np.full(len(unique), -np.inf)
    first, owner = np.full(len(unique), len(models)), segments.owner[source]
    for extreme, ufunc, values in (
        (first, np.minimum, owner),
        (last, np.maximum, owner),
        (lowest, np.minimum, height),
        (highest, np.maximum, height),
    ):
        ufunc.at(extreme, stretch.ravel(), values)
    inner = (last > first) | (highest - lowest > STEP_M)
    return vertices[unique[inner]], first[inner], (last > first)[inner]


def _straight_lines(stretches: FloatArray) -> FloatArray:
    """Stretches (e, 2, 2) joined where two meet, and made straight: lines between corners and junctions, (n, 2, 2)."""
    chains = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(stretches)))
    corners, chain = shapely.get_coordinates(shapely.simplify(chains, STRAIGHT_M), return_index=True)
    follows = chain[1:] == chain[:-1]
    return np.stack([corners[:-1][follows], corners[1:][follows]], axis=1)


def _straight_pieces(lines: FloatArray) -> IntArray:
    """The piece of each line, (n,): at a junction the two lines that go straight on, within `STRAIGHT_M`, are one."""
    vertices, ends = welded(lines.reshape(-1, 2))
    pairs = []
    order = np.argsort(ends, kind="stable")
    for at in np.split(order, np.cumsum(np.bincount(ends, minlength=len(vertices)))[:-1]) if len(lines) else ():
        if len(at) < 2:
            continue
        towards = vertices[ends[at ^ 1]] - vertices[ends[at]]
        a, b = np.triu_indices(len(at), 1)
        chord = towards[b] - towards[a]
        away = np.abs(towards[a][:, 0] * towards[b][:, 1] - towards[a][:, 1] * towards[b][:, 0])
        away /= np.maximum(np.hypot(chord[:, 0], chord[:, 1]), 1e-9)
        away[(towards[a] * towards[b]).sum(axis=1) >= 0.0] = np.inf
        free = set(range(len(at)))
        for k in np.argsort(away, kind="stable").tolist():
            if away[k] <= STRAIGHT_M and {a[k], b[k]} <= free:
                free -= {a[k], b[k]}
                pairs.append((at[a[k]] // 2, at[b[k]] // 2))
    return united(len(lines), *np.array(pairs, np.int64).reshape(-1, 2).T)


# ------------------------------------------------------------------------------------------------ beside drawn outlines


def _beside_drawn(made: Geometries, found: Geometries, drawn: Geometries) -> Columns:
    """The columns of `FormScore.blocks`, a row per drawn block.

    A block of models stands for the drawn one that holds more than half of it; of several the one with most of it, if
    their IoU is at least one half.
    """
    count = len(drawn)
    pairs = overlapping(drawn, found)
    found_m2, drawn_m2 = shapely.area(found), shapely.area(drawn)
    inside = np.flatnonzero(pairs.common_m2 > MIN_SHARE * found_m2[pairs.second])
    best = inside[np.argsort(pairs.common_m2[inside], kind="stable")]
    iou, partner = np.zeros(count), np.full(count, -1, np.int64)
    partner[pairs.first[best]] = pairs.second[best]
    common = np.zeros(count)
    common[pairs.first[best]] = pairs.common_m2[best]
    iou = common / (drawn_m2 + np.append(found_m2, 0.0)[partner] - common)
    middles = shapely.centroid(drawn)
    names = ("found", "drawn", *(f"right_{tolerance_name(tolerance)}" for tolerance in TOLERANCES_M))
    columns: Columns = {"x": shapely.get_x(middles), "y": shapely.get_y(middles), "iou": iou}
    columns |= {"compared": (iou >= MIN_IOU).astype(np.float64), **{name: np.zeros(count) for name in names}}
    columns |= {"away": np.zeros((count, len(AWAY_M) - 1)), "oblique_m": np.zeros(count)}
    columns["oblique_found_m"] = np.zeros(count)
    rings = [shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.get_parts(made))]
    edges = np.concatenate([np.zeros((0, 2, 2)), *(np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings)])
    for k in np.flatnonzero(columns["compared"]).tolist():
        one, other = _block_corners(found[partner[k]]), _block_corners(drawn[k])
        right = [matched_corners(other, one, tolerance)[0].sum() for tolerance in TOLERANCES_M]
        for name, value in zip(names, (len(one), len(other), *right), strict=True):
            columns[name][k] = value
        away, _ = KDTree(_places_along(drawn[k])).query(_places_along(found[partner[k]]))
        columns["away"][k] = np.histogram(away, AWAY_M)[0]
        columns["oblique_m"][k], columns["oblique_found_m"][k] = _oblique(drawn[k], edges)
    return columns


def _block_corners(block: shapely.Geometry) -> FloatArray:
    """Corners of the exterior of a block, (k, 2)."""
    ring = ring_of(block, _STRAIGHT_CORNER_M)
    return ring[turns(edges_of(ring)[0]) > MIN_TURN_DEG]


def _places_along(block: shapely.Geometry) -> FloatArray:
    """Places on the exterior of a block, (s, 2), from its most western corner on, however its ring is written."""
    ring = shapely.get_exterior_ring(shapely.normalize(block))
    places = shapely.line_interpolate_point(ring, np.arange(0.0, ring.length, _SPACING_M))
    xy: FloatArray = shapely.get_coordinates(places)
    return xy


def _oblique(block: shapely.Geometry, edges: FloatArray) -> tuple[float, float]:
    """Metres of the oblique edges of a drawn block, and of their parts where one of the edges (e, 2, 2) runs along."""
    ring = ring_of(block)
    _, length, direction = edges_of(ring)
    oblique = (length >= MIN_OBLIQUE_M) & (off(direction, main_direction(direction, length)) > MIN_OBLIQUE_DEG)
    along = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)[oblique]
    places, metres, edge = sampled(along, _SPACING_M)
    towards = along[:, 1] - along[:, 0]
    heading = np.degrees(np.arctan2(towards[:, 1], towards[:, 0]))
    return float(metres.sum()), float(metres[is_near(places, heading[edge], edges, NEAR_M)].sum())


# -------------------------------------------------------------------------------------------------------------- figures


def _f1(sums: Sums) -> FloatArray:
    return 2.0 * sums["right"] / (sums["found"] + sums["drawn"])


def measures(score: FormScore) -> list[Measure]:
    """The figures; models, drawn outlines and blocks are resampled."""
    sides = [_regular(which, columns) for which, columns in (("", score.found), ("drawn_", score.drawn)) if columns]
    figures = [one for beside in zip(*sides, strict=True) for one in beside]
    inner = {name: column[score.inner["inner_length_m"] > 0.0] for name, column in score.inner.items()}
    for kind in _KINDS:
        length, metres = f"{kind}_length_m", inner[f"{kind}_length_m"].sum()
        statistics = (
            (f"form.{kind}_short_edges", _per_100m(f"{kind}_short", length), metres),
            (f"form.{kind}_two_directions", share(f"{kind}_along_m", length), metres),
        )
        figures += measured_all(inner, MODELS_ALONE, statistics)
    if not score.drawn:
        return figures
    blocks, all_blocks = score.blocks, len(score.blocks["iou"])
    figures.append(measured("form.blocks", blocks, total("compared"), n=all_blocks, subset=MODELS_ALONE))
    blocks = {name: column[blocks["compared"] > 0.0] for name, column in blocks.items()}
    figures.append(measured_median("form.block_iou_median", blocks["iou"], MODELS_ALONE))
    found, drawn = blocks["found"].sum(), blocks["drawn"].sum()
    for tolerance in TOLERANCES_M:
        at = tolerance_name(tolerance)
        corners = {"right": blocks[f"right_{at}"], "found": blocks["found"], "drawn": blocks["drawn"]}
        shares = (
            (f"form.corner_precision_{at}", share("right", "found"), found),
            (f"form.corner_recall_{at}", share("right", "drawn"), drawn),
            (f"form.corner_f1_{at}", Share(figure=_f1, denominator="drawn"), found + drawn),
        )
        figures += measured_all(corners, MODELS_ALONE, shares)
    n = blocks["away"].sum()
    figures += measured_all(
        blocks,
        MODELS_ALONE,
        [
            ("form.outline_distance_median", quantile("away", AWAY_M, 0.5), n),
            ("form.outline_distance_p90", quantile("away", AWAY_M, 0.9), n),
            ("form.oblique_found", share("oblique_found_m", "oblique_m"), blocks["oblique_m"].sum()),
        ],
    )
    return figures


def _per_100m(short: str, length_m: str) -> Statistic:
    """Short pieces per 100 m."""
    per_metre = ratio(short, length_m)
    return lambda sums: 100.0 * per_metre(sums)


def _regular(which: str, columns: Mapping[str, FloatArray]) -> list[Measure]:
    n = {name: column.sum() for name, column in columns.items()}
    return measured_all(
        columns,
        MODELS_ALONE,
        [
            (f"form.{which}two_directions", share("along_m", "length_m"), n["length_m"]),
            (f"form.{which}right_corners", share("right", "corners"), n["corners"]),
            (f"form.{which}acute_outlines", share("acute", "outlines"), n["outlines"]),
            (f"form.{which}short_edges", _per_100m("short", "length_m"), n["length_m"]),
            (f"form.{which}triangles", total("triangles"), n["outlines"]),
            (f"form.{which}corners", ratio("corners", "outlines"), n["outlines"]),
        ],
    )


_RINGS = f"exteriors of all outlines, corners closer than {100 * STRAIGHT_M:g} cm to a straight edge left out"
_MAIN = f"within {ALONG_DEG:g} deg of the direction that most of the length shares, or of its perpendicular"
_BLOCKS = (
    "blocks: outlines united, gaps under 0.3 m closed; a block of models stands for the drawn one that holds over half "
    "of it, with an IoU >= 0.5"
)
_SIDES = (("", "", ""), ("drawn_", ", drawn", "of the drawn outlines: "))
_WALLS = "edges in plan that two models of a block share"
_INNER = (
    ("wall", "common walls", _WALLS),
    (
        "inner",
        "steps and common walls",
        f"{_WALLS}, or two faces of one model whose heights differ by more than {STEP_M:g} m in the middle of the edge",
    ),
)


def _definitions_of(which: str, label: str, of: str) -> tuple[Definition, ...]:
    """The measures of regularity of found or of drawn outlines."""
    lower = Better.LOWER if not which else Better.NEITHER
    higher = Better.HIGHER if not which else Better.NEITHER
    rows = (
        ("two_directions", "length along two directions", f"share of the length {_MAIN}; {_RINGS}", higher, "share"),
        ("right_corners", "right corners", f"share of corners within {RIGHT_DEG:g} deg of 90", higher, "share"),
        (
            "acute_outlines",
            f"outlines with a corner under {ACUTE_DEG:g} deg",
            f"share of outlines with an inner or outer angle under {ACUTE_DEG:g} deg",
            lower,
            "share",
        ),
        ("short_edges", "short edges per 100 m", f"edges under {SHORT_M:g} m / length, times 100 m", lower, ""),
        ("triangles", "triangles", "outlines with three corners", lower, "count"),
        ("corners", "corners per outline", "corners / outlines", Better.NEITHER, ""),
    )
    return tuple(
        defined(f"form.{which}{name}", what + label, of + formula, better, unit)
        for name, what, formula, better, unit in rows
    )


def _definitions_at(tolerance_m: float) -> tuple[Definition, ...]:
    """The measures of corners at one tolerance."""
    at, name = f"{tolerance_m:g} m", tolerance_name(tolerance_m)
    corners = f"corners of exteriors of blocks that turn by more than {MIN_TURN_DEG:g} deg, one to one within {at}"
    return (
        defined(f"form.corner_precision_{name}", f"block corners right, {at}", f"pairs / found corners; {corners}"),
        defined(f"form.corner_recall_{name}", f"block corners found, {at}", f"pairs / drawn corners; {corners}"),
        defined(f"form.corner_f1_{name}", f"block corner F1, {at}", "2 pairs / (found + drawn corners)"),
    )


def _definitions_inside(kind: str, label: str, edges: str) -> tuple[Definition, ...]:
    """The measures of edges inside blocks."""
    short = f"pieces under {SHORT_M:g} m / length, times 100 m; {edges}; merged where collinear within "
    along = f"share of their length within {ALONG_DEG:g} deg of the two directions of their block; {edges}; n in metres"
    return (
        defined(
            f"form.{kind}_short_edges",
            f"short pieces of {label} per 100 m",
            f"{short}{100 * STRAIGHT_M:g} cm",
            Better.LOWER,
            "",
        ),
        defined(f"form.{kind}_two_directions", f"{label} along two directions", along),
    )


DEFINITIONS = (
    *(one for beside in zip(*(_definitions_of(*side) for side in _SIDES), strict=True) for one in beside),
    *(one for kind in _INNER for one in _definitions_inside(*kind)),
    defined(
        "form.blocks",
        "blocks compared",
        f"drawn blocks for which models stand; n: all drawn blocks; {_BLOCKS}",
        Better.HIGHER,
        "count",
    ),
    defined("form.block_iou_median", "IoU of blocks, median", f"median over the blocks compared; {_BLOCKS}"),
    *(one for tolerance in TOLERANCES_M for one in _definitions_at(tolerance)),
    *(
        defined(
            f"form.outline_distance_{name}",
            f"distance of outlines, {label}",
            f"{label} over places every {_SPACING_M:g} m on exteriors of found blocks of the distance to the nearest "
            "such place on the drawn block",
            Better.LOWER,
            "m",
        )
        for name, label in (("median", "median"), ("p90", "90 %"))
    ),
    defined(
        "form.oblique_found",
        "drawn oblique edges found",
        f"share of the length of drawn edges >= {MIN_OBLIQUE_M:g} m, over {MIN_OBLIQUE_DEG:g} deg off both directions "
        f"of their block, with an edge of a model within {NEAR_M:g} m and {ALONG_DEG:g} deg, tried every "
        f"{_SPACING_M:g} m; blocks compared; n in metres",
    ),
)
"""The measures."""
