"""Roof edges and corners of models against true wireframes, in three dimensions and in both directions.

Edges count by length: a place on an edge is right if an edge of the other side passes within a tolerance. Corners count
one to one: where a person draws one corner and a model has a cluster of vertices, only one of the cluster is right.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Statistic, Sums, ratio, share
from pipeline.ruler.evaluation.building_matching import (
    MIN_SHARE,
    Geometries,
    mostly_on,
    overlapping,
    sound_polygons,
    where_judged,
)
from pipeline.ruler.evaluation.measure import Better, Definition, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading.raw import grouped
from pipeline.ruler.evaluation.reading.wireframe_files import Wireframe
from pipeline.ruler.evaluation.subsets import Subset, measured, measured_all
from pipeline.ruler.evaluation.wireframe_network import (
    MIN_TURN_DEG,
    Network,
    drawn_segments,
    joined,
    network,
    roof_segments,
)

TOLERANCES_M = (0.3, 0.5, 1.0)
"""Distances in space up to which an edge or a corner is right."""
SAMPLE_M = 0.1
"""Largest spacing of the places on an edge."""
_GAP_M = 0.5
"""Half of the widest gap in drawn lines that is closed where the area of a wireframe is sought: ends that were meant to
meet, and narrow passages between parts, are closer than a metre."""
_ROUNDING = 1e-9
"""Numerical guard for comparisons of distances and shares."""
_AMOUNTS = ("true_edges", "model_edges", "true_corners", "model_corners")
_PLACES_AT_ONCE = 20_000
"""Bounds the memory of the distances."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireframeScore:
    """All true buildings of a file, in the order of the wireframes."""

    building_ids: tuple[str, ...]
    places: FloatArray
    """(n, 2) float64: x, y of the middle of each."""
    model_ids: tuple[tuple[str, ...], ...]
    """The models that are counted for each. Empty if it has none, or shares that of a neighbour with more of it."""
    has_model: BoolArray
    """(n,) bool, True if a model stands there, be it counted for a neighbour."""
    amounts: Mapping[str, FloatArray]
    """`true_edges` and `model_edges` in metres, numbers of `true_corners` and `model_corners`; (n, 1 + tolerances)
    each: the whole amount, then what the other side has within each of `TOLERANCES_M`."""
    elsewhere: int
    """Number of models that stand on no wireframe; they are not judged."""

    def columns(self, kind: str, tolerance: int) -> dict[str, FloatArray]:
        """Amounts of a kind, edge or corner, and what is found of them within `TOLERANCES_M[tolerance]`; (n,) each."""
        found: dict[str, FloatArray] = {}
        for side in ("true", "model"):
            amounts = self.amounts[f"{side}_{kind}s"]
            found |= {side: amounts[:, 0], f"{side}_found": amounts[:, 1 + tolerance]}
        return found


def score_wireframes(models: Sequence[RoofModel], wireframes: Sequence[Wireframe]) -> WireframeScore:
    """Compare models with true wireframes.

    Buildings and models that hang together in plan are compared as a whole, so it does not matter how a row is divided.
    A model is counted for the building that holds most of it.
    """
    places = np.array([_area_of(wireframe) for wireframe in wireframes], object)
    building, model, home = _links(models, wireframes, places)
    count = len(wireframes)
    amounts = {name: np.zeros((count, 1 + len(TOLERANCES_M))) for name in _AMOUNTS}
    pairs = zip(building.tolist(), (count + model).tolist(), strict=True)
    for members in grouped(count + len(models), pairs):
        true = [k for k in members if k < count]
        made = [k - count for k in members if k >= count]
        if true:
            drawn = network(joined([drawn_segments(wireframes[k], k) for k in true]))
            _add(amounts, drawn, network(roof_segments([models[m] for m in made], home[made].tolist())))
    middles = [shapely.centroid(place) for place in places]
    return WireframeScore(
        building_ids=tuple(wireframe.building_id for wireframe in wireframes),
        places=np.array([(middle.x, middle.y) for middle in middles]).reshape(-1, 2),
        model_ids=tuple(tuple(models[m].building_id for m in np.flatnonzero(home == k).tolist()) for k in range(count)),
        has_model=np.isin(np.arange(count), building),
        amounts=amounts,
        elsewhere=int((home < 0).sum()),
    )


# ------------------------------------------------------------------------------------------------- which model is where


def _area_of(wireframe: Wireframe) -> shapely.Geometry:
    """What the edges of a wireframe enclose in plan, without holes; their convex hull if they enclose nothing."""
    lines = shapely.linestrings(wireframe.vertices[wireframe.edges][:, :, :2])
    drawn = shapely.union_all(shapely.buffer(lines, _GAP_M))
    filled = shapely.union_all([shapely.Polygon(part.exterior) for part in shapely.get_parts(drawn)])
    area = shapely.buffer(filled, -_GAP_M)
    return area if not area.is_empty else shapely.convex_hull(shapely.multilinestrings(lines))


def _links(
    models: Sequence[RoofModel], wireframes: Sequence[Wireframe], places: Geometries
) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of a true building and a model that stands there: two (p,), and the building of each model, (m,), or -1.

    Models of given outlines whose id is that of a wireframe in the same place belong to it. Others belong where they
    share at least half of either area.
    """
    made = sound_polygons([model.footprint for model in models])
    pairs = overlapping(places, made)
    home = np.where(where_judged(made, places, pairs, None), mostly_on(len(made), pairs), -1)
    numbers = {wireframe.building_id: k for k, wireframe in enumerate(wireframes)}
    named = np.array([numbers.get(model.source_id or "", -1) for model in models], np.int64)
    by_name = np.zeros(len(models), np.bool_)
    by_name[pairs.second[named[pairs.second] == pairs.first]] = True
    home[by_name] = named[by_name]
    least = np.minimum(shapely.area(places)[pairs.first], shapely.area(made)[pairs.second])
    covers = (pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * least) & ~by_name[pairs.second]
    kept = (home[pairs.second] >= 0) & (covers | (home[pairs.second] == pairs.first))
    return pairs.first[kept], pairs.second[kept], home


# ------------------------------------------------------------------------------------------------------ both directions


def _add(amounts: Mapping[str, FloatArray], true: Network, made: Network) -> None:
    """Add the amounts of one group to those of its buildings."""

    def count(name: str, owner: IntArray, amount: FloatArray, found: BoolArray) -> None:
        np.add.at(amounts[name], owner, amount[:, None] * np.column_stack([np.ones(len(owner), np.bool_), found]))

    for name, one, other in (("true_edges", true, made), ("model_edges", made, true)):
        places, metres, edge = sampled(one.edges)
        found = distances(places, other.edges)[:, None] <= np.array(TOLERANCES_M) + _ROUNDING
        count(name, one.edge_owner[edge], metres, found)
    matched = [matched_corners(true.corners, made.corners, tolerance) for tolerance in TOLERANCES_M]
    for side, name, one in ((0, "true_corners", true), (1, "model_corners", made)):
        right = np.column_stack([pair[side] for pair in matched])
        count(name, one.corner_owner, np.ones(len(one.corners)), right)


def sampled(edges: FloatArray, spacing_m: float = SAMPLE_M) -> tuple[FloatArray, FloatArray, IntArray]:
    """Places on edges (e, 2, d) in the middle of equal pieces: (s, d), the metres of each (s,), and its edge (s,).

    Examples
    --------
    >>> sampled(np.array([[[0.0, 0.0, 0.0], [0.25, 0.0, 0.0]]]))[1].round(4).tolist()
    [0.0833, 0.0833, 0.0833]
    """
    along = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(along, axis=1)
    pieces = np.maximum(np.ceil(length / spacing_m - _ROUNDING), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), pieces)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (number + 0.5) / pieces[edge]
    return edges[edge, 0] + share[:, None] * along[edge], (length / pieces)[edge], edge


def distances(places: FloatArray, edges: FloatArray) -> FloatArray:
    """Distance in space from places (s, 3) to the nearest of some edges (e, 2, 3); inf beyond the largest tolerance."""
    nearest = np.full(len(places), np.inf)
    if not len(edges):
        return nearest
    reach = TOLERANCES_M[-1] + SAMPLE_M
    low, high = edges[:, :, :2].min(axis=1) - reach, edges[:, :, :2].max(axis=1) + reach
    tree = shapely.STRtree(shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1]))
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    squared = np.maximum((along**2).sum(axis=1), _ROUNDING)
    for first in range(0, len(places), _PLACES_AT_ONCE):
        some = places[first : first + _PLACES_AT_ONCE]
        place, edge = tree.query(shapely.points(some[:, :2]))
        offset = some[place] - start[edge]
        position = np.clip((offset * along[edge]).sum(axis=1) / squared[edge], 0.0, 1.0)
        away = np.linalg.norm(offset - position[:, None] * along[edge], axis=1)
        np.minimum.at(nearest, first + place, away)
    return nearest


def matched_corners(true: FloatArray, made: FloatArray, tolerance_m: float) -> tuple[BoolArray, BoolArray]:
    """Which corners of both sides, (t, 3) and (m, 3), have a partner within a tolerance, one to one.

    As many pairs as possible, and of these choices the one with the smallest sum of distances.
    """
    true_found, made_found = np.zeros(len(true), np.bool_), np.zeros(len(made), np.bool_)
    if not len(true) or not len(made):
        return true_found, made_found
    near = KDTree(made).query_ball_point(true, tolerance_m + _ROUNDING, return_sorted=True)
    pairs = [(k, len(true) + other) for k, others in enumerate(near) for other in others]
    for members in grouped(len(true) + len(made), pairs):
        rows = np.array([k for k in members if k < len(true)], np.int64)
        columns = np.array([k - len(true) for k in members if k >= len(true)], np.int64)
        if len(rows) and len(columns):
            away = np.linalg.norm(true[rows][:, None] - made[columns][None], axis=2)
            # A pair too far apart costs more than all near pairs together, so no near pair is given up for distance.
            cost = np.where(away <= tolerance_m + _ROUNDING, away, tolerance_m * (1 + len(rows) + len(columns)))
            row, column = linear_sum_assignment(cost)
            right = away[row, column] <= tolerance_m + _ROUNDING
            true_found[rows[row[right]]] = True
            made_found[columns[column[right]]] = True
    return true_found, made_found


# -------------------------------------------------------------------------------------------------------------- figures


def _f1(sums: Sums) -> FloatArray:
    """Harmonic mean of recall and precision; 0 without a model."""
    recall = sums["true_found"] / sums["true"]
    precision = np.where(sums["model"] > 0.0, sums["model_found"] / sums["model"], 0.0)
    both = recall + precision
    return np.where(both > 0.0, 2.0 * recall * precision / both, np.where(sums["true"] > 0.0, 0.0, np.nan))


STATISTICS: Mapping[str, Statistic] = {
    "recall": share("true_found", "true"),
    "precision": share("model_found", "model"),
    "f1": Share(figure=_f1, denominator="true"),
}
"""The shares at each tolerance."""


def wireframe_measures(score: WireframeScore) -> list[Measure]:
    """The figures of all buildings; whole buildings are resampled."""
    count = len(score.building_ids)
    everything = Subset(name="all", buildings=np.ones(count, np.bool_), elsewhere=True)
    there = {"found": score.has_model.astype(np.float64), "all": np.ones(count)}
    found = [measured("wireframes.with_model", there, share("found", "all"), n=count, subset=everything)]
    for kind in ("edge", "corner"):
        true, made = (float(score.amounts[f"{side}_{kind}s"][:, 0].sum()) for side in ("true", "model"))
        n = {"recall": true, "precision": made, "f1": true + made}
        for k, tolerance in enumerate(TOLERANCES_M):
            columns, at = score.columns(kind, k), tolerance_name(tolerance)
            figures = ((f"wireframes.{kind}_{name}_{at}", of, n[name]) for name, of in STATISTICS.items())
            found += measured_all(columns, everything, figures)
        found += measured_all(columns, everything, [(f"wireframes.{kind}_ratio", ratio("model", "true"), true)])
    return found


def tolerance_name(tolerance_m: float) -> str:
    """A tolerance in the names of measures and columns: `0_5m`, `1m`."""
    return f"{tolerance_m:g}m".replace(".", "_")


_F1 = "2 recall precision / (recall + precision); 0 without a model"
_EDGES = "model edges are those of roof faces, without stretches between faces of one plane"
_CORNERS = f"a corner is where an edge turns by more than {MIN_TURN_DEG:g} deg or ends, or where three edges meet"


def _definitions_at(tolerance_m: float) -> tuple[tuple[Definition, ...], tuple[Definition, ...]]:
    """The measures of edges and those of corners at one tolerance."""
    at, name = f"{tolerance_m:g} m", tolerance_name(tolerance_m)
    near = f"within {at} in space, tried every {SAMPLE_M:g} m"
    edges = (
        ("recall", "true edges found", f"share of the length of true edges with a model edge {near}; n in metres"),
        ("precision", "edges that are right", f"share of the length of model edges with a true edge {near}; {_EDGES}"),
        ("f1", "edge F1", _F1),
    )
    pairs = f"at most {at} away in space, one to one, as many pairs as possible"
    corners = (
        ("recall", "true corners found", f"share of the true corners paired with a model corner {pairs}; {_CORNERS}"),
        ("precision", "corners that are right", f"share of the model corners paired with a true corner {pairs}"),
        ("f1", "corner F1", _F1),
    )
    return (
        tuple(defined(f"wireframes.edge_{key}_{name}", f"{label}, {at}", formula) for key, label, formula in edges),
        tuple(defined(f"wireframes.corner_{key}_{name}", f"{label}, {at}", formula) for key, label, formula in corners),
    )


DEFINITIONS = (
    defined(
        "wireframes.with_model",
        "wireframes with a model",
        "share of the wireframes where a model stands, by id or by place",
    ),
    *(one for tolerance in TOLERANCES_M for one in _definitions_at(tolerance)[0]),
    defined(
        "wireframes.edge_ratio",
        "length of edges, models / truth",
        f"model edges / true edges; {_EDGES}",
        Better.NEITHER,
        "",
    ),
    *(one for tolerance in TOLERANCES_M for one in _definitions_at(tolerance)[1]),
    defined(
        "wireframes.corner_ratio",
        "corners, models / truth",
        f"model corners / true corners; {_CORNERS}",
        Better.NEITHER,
        "",
    ),
)
"""The measures."""
