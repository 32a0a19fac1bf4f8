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
from pipeline.ruler.evaluation.matching import (
    MIN_SHARE,
    Geometries,
    mostly_on,
    overlapping,
    sound_polygons,
    where_judged,
)
from pipeline.ruler.evaluation.measure import Better, Definition, Group, Measure
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading.raw import grouped
from pipeline.ruler.evaluation.reading.wireframes import Wireframe
from pipeline.ruler.evaluation.subsets import Subset, measured
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
_PLACES_AT_ONCE = 20_000
"""Bounds the memory of the distances."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """The edges or corners of one side, and how much of them the other side has at each tolerance."""

    total: float
    """Metres of edge, or number of corners."""
    found: tuple[float, ...]
    """The same, within each of `TOLERANCES_M` of the other side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireframeRow:
    """One true building."""

    building_id: str
    """Its name."""
    place: tuple[float, float]
    """x, y of its middle."""
    model_ids: tuple[str, ...]
    """The models that are counted for it. Empty if it has none, or shares that of a neighbour with more of it."""
    has_model: bool
    """True if a model stands there, be it counted for a neighbour."""
    true_edges: Found
    """Drawn edges, metres."""
    model_edges: Found
    """Edges of its models, metres."""
    true_corners: Found
    """Corners of the drawn edges."""
    model_corners: Found
    """Corners of its models."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireframeScore:
    """All true buildings of a file."""

    rows: tuple[WireframeRow, ...]
    """One per building, in the order of the wireframes."""
    elsewhere: int
    """Number of models that stand on no wireframe; they are not judged."""


def score_wireframes(models: Sequence[RoofModel], wireframes: Sequence[Wireframe]) -> WireframeScore:
    """Compare models with true wireframes.

    Buildings and models that hang together in plan are compared as a whole, so it does not matter how a row is divided.
    A model is counted for the building that holds most of it.
    """
    places = np.array([_area_of(wireframe) for wireframe in wireframes], object)
    building, model, home = _links(models, wireframes, places)
    count = len(wireframes)
    sides = _Sides(count)
    pairs = zip(building.tolist(), (count + model).tolist(), strict=True)
    for members in grouped(count + len(models), pairs):
        true = [k for k in members if k < count]
        made = [k - count for k in members if k >= count]
        if true:
            drawn = network(joined([drawn_segments(wireframes[k], k) for k in true]))
            sides.add(drawn, network(roof_segments([models[m] for m in made], home[made].tolist())))
    rows = []
    for k, wireframe in enumerate(wireframes):
        middle = shapely.centroid(places[k])
        rows.append(
            WireframeRow(
                building_id=wireframe.building_id,
                place=(middle.x, middle.y),
                model_ids=tuple(models[m].building_id for m in np.flatnonzero(home == k).tolist()),
                has_model=bool((building == k).any()),
                true_edges=sides.found("true_edges", k),
                model_edges=sides.found("model_edges", k),
                true_corners=sides.found("true_corners", k),
                model_corners=sides.found("model_corners", k),
            )
        )
    return WireframeScore(rows=tuple(rows), elsewhere=int((home < 0).sum()))


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


class _Sides:
    """Totals and found amounts of all buildings, added up group by group."""

    def __init__(self, buildings: int) -> None:
        names = ("true_edges", "model_edges", "true_corners", "model_corners")
        self._sums = {name: np.zeros((buildings, 1 + len(TOLERANCES_M))) for name in names}

    def add(self, true: Network, made: Network) -> None:
        """Compare the networks of one group."""
        for name, one, other in (("true_edges", true, made), ("model_edges", made, true)):
            places, metres, edge = sampled(one.edges)
            found = distances(places, other.edges)[:, None] <= np.array(TOLERANCES_M) + _ROUNDING
            self._count(name, one.edge_owner[edge], metres, found)
        matched = [matched_corners(true.corners, made.corners, tolerance) for tolerance in TOLERANCES_M]
        for side, name, one in ((0, "true_corners", true), (1, "model_corners", made)):
            right = np.column_stack([pair[side] for pair in matched])
            self._count(name, one.corner_owner, np.ones(len(one.corners)), right)

    def _count(self, name: str, owner: IntArray, amount: FloatArray, found: BoolArray) -> None:
        np.add.at(self._sums[name], owner, amount[:, None] * np.column_stack([np.ones(len(owner), np.bool_), found]))

    def found(self, name: str, building: int) -> Found:
        """The amounts of a building."""
        total, *found = self._sums[name][building].tolist()
        return Found(total=total, found=tuple(found))


def sampled(edges: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Places on edges (e, 2, 3) in the middle of equal pieces: (s, 3), the metres of each (s,), and its edge (s,).

    Examples
    --------
    >>> sampled(np.array([[[0.0, 0.0, 0.0], [0.25, 0.0, 0.0]]]))[1].round(4).tolist()
    [0.0833, 0.0833, 0.0833]
    """
    along = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(along, axis=1)
    pieces = np.maximum(np.ceil(length / SAMPLE_M - _ROUNDING), 1).astype(np.int64)
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


def recall_precision_f1(true: Found, made: Found, tolerance: int) -> tuple[float, float, float]:
    """The three shares of one building at `TOLERANCES_M[tolerance]`; nan where the denominator is zero."""
    sums = {
        "true": np.array([true.total]),
        "true_found": np.array([true.found[tolerance]]),
        "model": np.array([made.total]),
        "model_found": np.array([made.found[tolerance]]),
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        recall, precision, f1 = (
            float(statistic(sums)[0]) for statistic in (ratio("true_found", "true"), ratio("model_found", "model"), _f1)
        )
    return recall, precision, f1


def _f1(sums: Sums) -> FloatArray:
    """Harmonic mean of recall and precision; 0 without a model."""
    recall = sums["true_found"] / sums["true"]
    precision = np.where(sums["model"] > 0.0, sums["model_found"] / sums["model"], 0.0)
    both = recall + precision
    return np.where(both > 0.0, 2.0 * recall * precision / both, np.where(sums["true"] > 0.0, 0.0, np.nan))


def wireframe_measures(score: WireframeScore) -> list[Measure]:
    """The figures of all buildings; whole buildings are resampled."""
    rows = score.rows
    everything = Subset(name="all", buildings=np.ones(len(rows), np.bool_), elsewhere=True)
    there = {"found": np.array([float(row.has_model) for row in rows]), "all": np.ones(len(rows))}
    found = [measured("wireframes.with_model", there, share("found", "all"), n=len(rows), subset=everything)]
    statistics: Mapping[str, Statistic] = {
        "recall": share("true_found", "true"),
        "precision": share("model_found", "model"),
        "f1": Share(figure=_f1, denominator="true"),
    }
    for kind in ("edge", "corner"):
        true, made = ([getattr(row, f"{side}_{kind}s") for row in rows] for side in ("true", "model"))
        columns = {"true": np.array([one.total for one in true]), "model": np.array([one.total for one in made])}
        n = {"recall": columns["true"].sum(), "precision": columns["model"].sum()}
        n["f1"] = n["recall"] + n["precision"]
        for k, tolerance in enumerate(TOLERANCES_M):
            columns["true_found"] = np.array([one.found[k] for one in true])
            columns["model_found"] = np.array([one.found[k] for one in made])
            for name, statistic in statistics.items():
                measure = f"wireframes.{kind}_{name}_{tolerance_name(tolerance)}"
                found.append(measured(measure, columns, statistic, n=float(n[name]), subset=everything))
        found.append(
            measured(f"wireframes.{kind}_ratio", columns, ratio("model", "true"), n=n["recall"], subset=everything)
        )
    return found


def tolerance_name(tolerance_m: float) -> str:
    """A tolerance in the names of measures and columns: `0_5m`, `1m`."""
    return f"{tolerance_m:g}m".replace(".", "_")


def _definition(name: str, label: str, formula: str, better: Better = Better.HIGHER, unit: str = "share") -> Definition:
    return Definition(
        name=f"wireframes.{name}", group=Group.WIREFRAMES, label=label, unit=unit, better=better, formula=formula
    )


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
        tuple(_definition(f"edge_{key}_{name}", f"{label}, {at}", formula) for key, label, formula in edges),
        tuple(_definition(f"corner_{key}_{name}", f"{label}, {at}", formula) for key, label, formula in corners),
    )


DEFINITIONS = (
    _definition(
        "with_model", "wireframes with a model", "share of the wireframes where a model stands, by id or by place"
    ),
    *(one for tolerance in TOLERANCES_M for one in _definitions_at(tolerance)[0]),
    _definition(
        "edge_ratio", "length of edges, models / truth", f"model edges / true edges; {_EDGES}", Better.NEITHER, ""
    ),
    *(one for tolerance in TOLERANCES_M for one in _definitions_at(tolerance)[1]),
    _definition(
        "corner_ratio", "corners, models / truth", f"model corners / true corners; {_CORNERS}", Better.NEITHER, ""
    ),
)
"""The measures."""
