"""Roof edges and corners by the measures of the Building3D board (R. Wang, S. Huang, H. Yang: Building3D, 2023).

Lengths are relative to the building. Edges are paired one to one by their Hausdorff distance; corners are those of
right edges, then free ones that are near.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from pipeline.kernels.union_find import united
from pipeline.model import FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Sums, ratio, share
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading.wireframe_files import Wireframe
from pipeline.ruler.evaluation.subsets import MODELS_ALONE, Columns, measured_all
from pipeline.ruler.evaluation.wireframe_network import Network, network, roof_segments

LIMIT = 0.1
"""Largest distance of a right edge or corner, as share of the distance of the farthest true corner from the middle."""
PLACES = 20
"""Places on each edge, its ends included, between which the Hausdorff distance is taken."""
_COUNTS = (
    *("true_corners", "model_corners", "right_corners", "true_edges", "model_edges", "right_edges"),
    *("offset", "offsets"),
)


def score_board(wireframes: Sequence[Wireframe], models: Sequence[Sequence[RoofModel]]) -> Columns:
    """Corners and edges of each wireframe and of its models, (n,): `true_…`, `model_…`, and `right_…` of both.

    `offset` is the sum of the relative distances of `offsets` right corners.
    """
    pairs = zip(wireframes, models, strict=True)
    rows = [_compared(one, network(roof_segments(made, [0] * len(made)))) for one, made in pairs]
    return {name: np.array([row[k] for row in rows], np.float64) for k, name in enumerate(_COUNTS)}


def _compared(true: Wireframe, made: Network) -> tuple[float, ...]:
    """The figures of one building, in the order of `_COUNTS`."""
    middle = true.vertices.mean(axis=0)
    size = np.linalg.norm(true.vertices - middle, axis=1).max()
    true_xyz, model_xyz = (true.vertices - middle) / size, (made.corners - middle) / size
    edges = _straight_edges(made)
    apart = _hausdorff(model_xyz[edges], true_xyz[true.edges])
    one, other = linear_sum_assignment(apart)
    right = apart[one, other] <= LIMIT
    ends, true_ends = np.unique(edges[one[right]]), np.unique(true.edges[other[right]])
    near = cdist(model_xyz[ends], true_xyz[true_ends]).min(axis=1, initial=np.inf)
    free, true_free = np.setdiff1d(np.arange(len(model_xyz)), ends), np.setdiff1d(np.arange(len(true_xyz)), true_ends)
    away = cdist(model_xyz[free], true_xyz[true_free])
    away = away[linear_sum_assignment(away)]
    away = away[away <= LIMIT]
    corners = min(len(ends), len(true_ends)) + len(away)
    offset, offsets = near.sum() + away.sum(), len(near) + len(away)
    return (len(true_xyz), len(model_xyz), corners, len(true.edges), len(edges), right.sum(), offset, offsets)


def _straight_edges(made: Network) -> IntArray:
    """The edges between corners, (e, 2) indices into `made.corners`: stretches that go straight on are one."""
    count = len(made.edges)
    vertices, index = np.unique(np.concatenate([made.edges.reshape(-1, 3), made.corners]), axis=0, return_inverse=True)
    index = index.ravel()
    corner = np.full(len(vertices), -1, np.int64)
    corner[index[2 * count :]] = np.arange(len(made.corners))
    order = np.argsort(index[: 2 * count], kind="stable")
    same = index[order][1:] == index[order][:-1]
    inner = same & (corner[index[order][1:]] < 0)
    line = united(count, order[:-1][inner] // 2, order[1:][inner] // 2)
    at_corner = np.flatnonzero(corner[index[: 2 * count]] >= 0)
    at_corner = at_corner[np.argsort(line[at_corner // 2], kind="stable")]
    return corner[index[at_corner]].reshape(-1, 2)


def _hausdorff(made: FloatArray, true: FloatArray) -> FloatArray:
    """Hausdorff distance between places on edges (m, 2, 3) and on others (t, 2, 3): (m, t)."""
    share_of = np.linspace(0.0, 1.0, PLACES)[:, None]
    one, other = (ends[:, None, 0] + share_of * (ends[:, None, 1] - ends[:, None, 0]) for ends in (made, true))
    found = np.zeros((len(made), len(true)))
    for k, places in enumerate(one):
        apart = cdist(places, other.reshape(-1, 3)).reshape(PLACES, len(true), PLACES)
        found[k] = np.maximum(apart.min(axis=2).max(axis=0), apart.min(axis=0).max(axis=1))
    return found


def _f1(kind: str) -> Share:
    """F1 of corners or of edges."""

    def figure(sums: Sums) -> FloatArray:
        return 2.0 * sums[f"right_{kind}s"] / (sums[f"model_{kind}s"] + sums[f"true_{kind}s"])

    return Share(figure=figure, denominator=f"true_{kind}s")


def board_measures(columns: Mapping[str, FloatArray]) -> list[Measure]:
    """The figures of all buildings; whole buildings are resampled."""
    found: list[Measure] = []
    for kind in ("corner", "edge"):
        true, made = (float(columns[f"{side}_{kind}s"].sum()) for side in ("true", "model"))
        found += measured_all(
            columns,
            MODELS_ALONE,
            [
                (f"wireframes.board_{kind}_precision", share(f"right_{kind}s", f"model_{kind}s"), made),
                (f"wireframes.board_{kind}_recall", share(f"right_{kind}s", f"true_{kind}s"), true),
                (f"wireframes.board_{kind}_f1", _f1(kind), true + made),
            ],
        )
    offset = ("wireframes.board_corner_offset", ratio("offset", "offsets"), float(columns["offsets"].sum()))
    return found + measured_all(columns, MODELS_ALONE, [offset])


_BY = (
    "lengths over the distance of the farthest true corner from their mean; edges one to one by the Hausdorff distance "
    f"of {PLACES} places on each, right up to {LIMIT:g}"
)
_CORNERS = (
    "corners of right edges (at most as many as the true corners of these), then free ones, one to one, up to "
    f"{LIMIT:g}; {_BY}"
)

DEFINITIONS = (
    *(
        defined(f"wireframes.board_{kind}_{key}", f"{label} of the Building3D board", formula)
        for kind, right in (("corner", f"right corners: {_CORNERS}"), ("edge", _BY))
        for key, label, formula in (
            ("precision", f"{kind} precision", f"right {kind}s / model {kind}s; {right}"),
            ("recall", f"{kind} recall", f"right {kind}s / true {kind}s, as drawn"),
            ("f1", f"{kind} F1", f"2 right / (model + true {kind}s)"),
        )
    ),
    defined(
        "wireframes.board_corner_offset",
        "corner offset of the Building3D board",
        "mean relative distance of right corners: to the nearest true corner of a right edge, or to their partner",
        Better.LOWER,
        "",
    ),
)
"""The measures."""
