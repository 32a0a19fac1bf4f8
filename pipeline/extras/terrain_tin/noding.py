"""Lines of a tile cut at their crossings: nodes on whole millimetres, no two of them closer than 2 mm.

Snap rounding (Hobby 1999) puts nodes on whole millimetres. It leaves some 1 mm apart, which programs that snap vertices
within a millimetre take for one. One of such nodes stays, and lines through the others are led through it instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import IntArray

ON_LINE_MM = 0.75
"""Noding moves a line by at most 0.71 mm, half the diagonal of a millimetre."""
APART_MM = 2
"""Nodes are at least so far apart."""

_CLOSE_MM = 1.5
"""On whole millimetres nearer than 2 mm is at most 1.42 mm."""
_ROUNDS = 20
"""Lines that were moved may cross anew. One round is the rule; on real data five were enough for the worst tile."""

Lines = npt.NDArray[np.object_]


@dataclasses.dataclass(frozen=True, kw_only=True)
class NodedLines:
    """Lines that meet at nodes only."""

    nodes: IntArray
    """(n, 2) int64 mm, sorted by x and y."""
    edges: IntArray
    """(s, 2) int64, the ends of each edge."""
    outlines: Lines
    """The rings that were given; those through a node too close to another are led through that one."""


def noded(side_mm: int, beyond_mm: int, data_edges: Lines, outlines: Lines) -> NodedLines:
    """The nodes and edges in a tile of the lines in and around it.

    Parameters
    ----------
    side_mm : int
        The tile extends from (0, 0) to (side_mm, side_mm); its border is cut in, too.
    beyond_mm : int
        How far beyond the tile all lines are given. The border goes on there, as neighbours have it.
    data_edges, outlines : (k,) object
        Lines and rings on whole millimetres.

    Of close nodes the corner of the tile stays, else one on its border, on a data edge, at a corner of an outline, or
    the one with the smaller x and y. So neighbours agree on their border, and outlines leave their place by at most
    1.42 mm at a node. Data edges leave theirs only where the border runs beside them.
    """
    low, high = -float(beyond_mm), float(side_mm + beyond_mm)
    across = [[(low, at), (high, at)] for at in (0.0, float(side_mm))]
    border = shapely.linestrings(across + [[end[::-1] for end in ends] for ends in across])
    lines = np.concatenate((data_edges, outlines))
    original = {tuple(place) for place in shapely.get_coordinates(outlines).tolist()}
    nodes, ends = _cut(np.concatenate((border, lines)))
    for _ in range(_ROUNDS):
        target = _targets(nodes, side_mm, data_edges, original)
        if (target == np.arange(len(nodes))).all():
            break
        lines = _led(lines, nodes, target)
        nodes, ends = _cut(np.concatenate((border, lines)))
    is_inside = ((nodes[ends] >= 0) & (nodes[ends] <= side_mm)).all(axis=(1, 2))
    used, edges = np.unique(ends[is_inside], return_inverse=True)
    return NodedLines(nodes=nodes[used], edges=edges.reshape(-1, 2), outlines=lines[len(data_edges) :])


def _cut(lines: Lines) -> tuple[IntArray, IntArray]:
    """Snap rounding: the nodes (n, 2), sorted, and the ends of all edges (s, 2)."""
    xy, line = shapely.get_coordinates(shapely.get_parts(shapely.union_all(lines, grid_size=1.0)), return_index=True)
    nodes, number = np.unique(np.rint(xy).astype(np.int64), axis=0, return_inverse=True)
    number = number.reshape(-1)
    return nodes, np.column_stack((number[:-1], number[1:]))[line[:-1] == line[1:]]


def _targets(nodes: IntArray, side_mm: int, data_edges: Lines, original: Iterable[tuple[float, float]]) -> IntArray:
    """The node that takes the place of each (n,); most stay."""
    target = np.arange(len(nodes))
    points = shapely.points(nodes.astype(np.float64))
    one, other = shapely.STRtree(points).query(points, predicate="dwithin", distance=_CLOSE_MM)
    one, other = one[one != other], other[one != other]
    close = np.unique(one)
    if len(close) == 0:
        return target
    on_border = np.isin(nodes[close], (0, side_mm)).sum(axis=1)
    on_data = np.zeros(len(close), np.bool_)
    on_data[shapely.STRtree(data_edges).query(points[close], predicate="dwithin", distance=0.0)[0]] = True
    is_corner = np.array([tuple(place) in original for place in nodes[close].tolist()])
    taken = np.zeros(len(nodes), np.bool_)
    for node in close[np.lexsort((close, ~is_corner, ~on_data, -on_border))].tolist():
        if not taken[node]:
            near = other[one == node]
            near = near[~taken[near]]
            target[near], taken[near], taken[node] = node, True, True
    return target


def _led(lines: Lines, nodes: IntArray, target: IntArray) -> Lines:
    """The lines; each with a node that does not stay leads through all its nodes, or what takes their place."""
    xy, line = shapely.get_coordinates(lines, return_index=True)
    is_edge = line[:-1] == line[1:]
    starts, ends, line = xy[:-1][is_edge], xy[1:][is_edge], line[:-1][is_edge]
    edges = shapely.STRtree(shapely.linestrings(np.stack((starts, ends), axis=1)))
    node, edge = edges.query(shapely.points(nodes.astype(np.float64)), predicate="dwithin", distance=ON_LINE_MM)
    along = ((nodes[node] - starts[edge]) * (ends[edge] - starts[edge])).sum(axis=1)
    order = np.lexsort((along, edge))
    node, line = node[order], line[edge[order]]
    found = lines.copy()
    for moved in np.unique(line[target[node] != node]):
        found[moved] = type(lines[moved])(nodes[target[node[line == moved]]].astype(np.float64))
    return found
