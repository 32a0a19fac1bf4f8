"""An outline cut into cells by chords: an adaptive subdivision whose vertices always lie on the millimetre grid.

The cells are faces of a planar graph of half-edges (Muller and Preparata 1978). A line cuts only the cells in which it
has support, each along a chord from border to border. A chord ends at a vertex, or at a new one that is rounded to 1 mm
and belongs to the edges of both cells beside it. Cells therefore share their borders exactly by construction and
nothing is snapped afterwards. Every chord, and every edge that a rounded vertex bends, is tested with exact integers
against all other edges; one that would touch them is not drawn.

Half-edges h and h ^ 1 are twins. `face` is the cell left of a half-edge, -1 outside.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import lies_between, same_ray, segments_meet, turn_of
from pipeline.kernels.sorting import ascending_order, in_order
from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.candidate_lines import CandidateLines


class Subdivision(NamedTuple):
    """An outline and the cells in it, with room for more; kernels change it in place."""

    xy: IntArray
    """(v, 2) int64, vertices, millimetres."""
    graph: IntArray
    """(h, 5) int64, half-edges; the columns are `ORIGIN` to `LINE`."""
    counts: IntArray
    """(3,) int64, vertices, half-edges and cells in use."""


ORIGIN, NEXT, PREVIOUS, FACE, LINE = 0, 1, 2, 3, 4
"""Start vertex; half-edges after and before; cell to the left; the line it lies on (outline edges from -2 down)."""
VERTICES, EDGES, CELLS = 0, 1, 2
"""Places of `counts`."""
_SNAP_MM = 60.0
"""A line passes through vertices nearer to it than this: steps are known to a few centimetres."""
SNAP_CROSSING_MM = 35.0
"""The same where planes cross: there the line is exact."""
_CLEARANCE_MM = 25.0
"""Chords keep this far from vertices; numerical guard of solids, whose vertices must stay distinct."""
_APART_MM = 10.0
"""New vertices keep this far from edges; the same guard."""
_MIN_SUPPORT_MM = 10.0
"""A line that a cell supports over less does not cut it; numerical guard."""


@kernel
def _is_clear(plan: Subdivision, a: int, b: int, skipped: int) -> bool:
    """Whether segment a b touches edges only at its own ends; the edge `skipped` and its twin do not count."""
    xy, graph = plan.xy, plan.graph
    low_x, high_x = min(xy[a, 0], xy[b, 0]), max(xy[a, 0], xy[b, 0])
    low_y, high_y = min(xy[a, 1], xy[b, 1]), max(xy[a, 1], xy[b, 1])
    for h in range(0, plan.counts[EDGES], 2):
        if h == skipped or h == skipped ^ 1:
            continue
        c, d = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        if max(xy[c, 0], xy[d, 0]) < low_x or min(xy[c, 0], xy[d, 0]) > high_x:
            continue
        if max(xy[c, 1], xy[d, 1]) < low_y or min(xy[c, 1], xy[d, 1]) > high_y:
            continue
        from_c, from_d = (c - a) * (c - b) == 0, (d - a) * (d - b) == 0
        if from_c or from_d:
            shared, other = (c, d) if from_c else (d, c)
            far = b if shared == a else a
            if other == far or same_ray(xy, shared, other, far):
                return False
        elif segments_meet(xy, a, b, c, d):
            return False
    return True


@kernel
def _has_clearance(plan: Subdivision, a: int, b: int, face: int) -> bool:
    """Whether all vertices of a cell keep their distance from the chord a b."""
    xy, graph = plan.xy, plan.graph
    dx, dy = float(xy[b, 0] - xy[a, 0]), float(xy[b, 1] - xy[a, 1])
    length = math.hypot(dx, dy)
    for h in range(plan.counts[EDGES]):
        if graph[h, FACE] != face:
            continue
        v = graph[h, ORIGIN]
        if v in (a, b):
            continue
        along = ((xy[v, 0] - xy[a, 0]) * dx + (xy[v, 1] - xy[a, 1]) * dy) / length
        off = abs((xy[v, 0] - xy[a, 0]) * dy - (xy[v, 1] - xy[a, 1]) * dx) / length
        if off < _CLEARANCE_MM and -_CLEARANCE_MM < along < length + _CLEARANCE_MM:
            return False
    return True


@kernel
def _is_apart(plan: Subdivision, w: int, skipped: int) -> bool:
    """Whether a new vertex keeps away from all edges except its own (`skipped`), also where two meet narrowly."""
    xy, graph = plan.xy, plan.graph
    for h in range(0, plan.counts[EDGES], 2):
        if h == skipped or h == skipped ^ 1:
            continue
        p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        dx, dy = float(xy[q, 0] - xy[p, 0]), float(xy[q, 1] - xy[p, 1])
        px, py = float(xy[w, 0] - xy[p, 0]), float(xy[w, 1] - xy[p, 1])
        along = (px * dx + py * dy) / max(dx * dx + dy * dy, 1.0)
        along = min(max(along, 0.0), 1.0)
        if math.hypot(px - along * dx, py - along * dy) < _APART_MM:
            return False
    return True


@kernel
def insert_vertex(plan: Subdivision, h: int, x: int, y: int) -> bool:
    """Cut half-edge h and its twin at a new vertex, unless that would touch other edges.

    The new vertex and half-edges are the last ones; the even half-edge starts at the new vertex.
    """
    xy, graph, counts = plan.xy, plan.graph, plan.counts
    w = counts[VERTICES]
    xy[w, 0] = x
    xy[w, 1] = y
    a, b = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
    if not (_is_clear(plan, a, w, h) and _is_clear(plan, w, b, h) and _is_apart(plan, w, h)):
        return False
    twin, new, back = h ^ 1, counts[EDGES], counts[EDGES] ^ 1
    for column in range(LINE + 1):
        graph[new, column] = graph[h, column]
        graph[back, column] = graph[twin, column]
    graph[new, ORIGIN] = w
    graph[back, ORIGIN] = b
    graph[twin, ORIGIN] = w
    after, before = graph[h, NEXT], graph[twin, PREVIOUS]
    graph[new, NEXT] = after
    graph[new, PREVIOUS] = h
    graph[after, PREVIOUS] = new
    graph[h, NEXT] = new
    graph[back, PREVIOUS] = before
    graph[back, NEXT] = twin
    graph[before, NEXT] = back
    graph[twin, PREVIOUS] = back
    counts[VERTICES] += 1
    counts[EDGES] += 2
    return True


@kernel
def _corner(plan: Subdivision, v: int, towards: int, face: int) -> int:
    """The half-edge that leaves v in the corner of the cell in which the vertex `towards` lies; -1 for none."""
    xy, graph = plan.xy, plan.graph
    for h in range(plan.counts[EDGES]):
        if graph[h, ORIGIN] != v or graph[h, FACE] != face:
            continue
        a, b = graph[h ^ 1, ORIGIN], graph[graph[h, PREVIOUS], ORIGIN]
        left_of_a, right_of_b = turn_of(xy, v, a, towards) > 0, turn_of(xy, v, b, towards) < 0
        turn = turn_of(xy, v, a, b)
        if turn > 0 or (turn == 0 and not same_ray(xy, v, a, b)):
            inside = left_of_a and (right_of_b if turn > 0 else True)
        else:
            inside = left_of_a or right_of_b or (turn_of(xy, v, a, towards) == 0 and not same_ray(xy, v, a, towards))
        if inside:
            return h
    return -1


@kernel(inline="always")
def _twice_loop_area(plan: Subdivision, start: int) -> int:
    """Twice the signed area of the loop of a half-edge in mm2; exact."""
    xy, graph = plan.xy, plan.graph
    area = 0
    origin, h = graph[start, ORIGIN], start
    while True:
        area += turn_of(xy, origin, graph[h, ORIGIN], graph[h ^ 1, ORIGIN])
        h = graph[h, NEXT]
        if h == start:
            return area


@kernel
def _is_in_loop(plan: Subdivision, start: int, v: int) -> int:
    """1 where vertex v lies inside a loop, -1 outside, 0 on it; exact."""
    xy, graph = plan.xy, plan.graph
    inside = False
    h = start
    while True:
        p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        turn = turn_of(xy, p, q, v)
        if turn == 0 and lies_between(xy, p, q, v):
            return 0
        if (xy[p, 1] > xy[v, 1]) != (xy[q, 1] > xy[v, 1]) and (turn > 0) == (xy[q, 1] > xy[p, 1]):
            inside = not inside
        h = graph[h, NEXT]
        if h == start:
            return 1 if inside else -1


@kernel
def _set_face(graph: IntArray, start: int, face: int) -> None:
    h = start
    while True:
        graph[h, FACE] = face
        h = graph[h, NEXT]
        if h == start:
            return


@kernel
def insert_chord(plan: Subdivision, u: int, v: int, face: int, line: int) -> int:
    """Join two vertices of a cell by an edge, which is the last one then, unless it would touch anything.

    Returns the cells made: 1, or 0 where two loops of the cell became one; -1 if the chord does not fit, or no
    edge is left.
    """
    graph, counts = plan.graph, plan.counts
    if counts[EDGES] + 2 > len(graph):
        return -1
    at_u, at_v = _corner(plan, u, v, face), _corner(plan, v, u, face)
    if at_u < 0 or at_v < 0 or not _has_clearance(plan, u, v, face) or not _is_clear(plan, u, v, -1):
        return -1
    out, back = counts[EDGES], counts[EDGES] ^ 1
    counts[EDGES] += 2
    before_u, before_v = graph[at_u, PREVIOUS], graph[at_v, PREVIOUS]
    graph[out, ORIGIN], graph[out, NEXT], graph[out, PREVIOUS] = u, at_v, before_u
    graph[back, ORIGIN], graph[back, NEXT], graph[back, PREVIOUS] = v, at_u, before_v
    graph[before_u, NEXT], graph[before_v, NEXT] = out, back
    graph[at_v, PREVIOUS], graph[at_u, PREVIOUS] = out, back
    graph[out, FACE], graph[back, FACE] = face, face
    graph[out, LINE], graph[back, LINE] = line, line
    h = graph[out, NEXT]
    while h != out:
        if h == back:
            return 0
        h = graph[h, NEXT]
    made = int(counts[CELLS])
    counts[CELLS] += 1
    start = out if _twice_loop_area(plan, out) > 0 else back
    _set_face(graph, start, made)
    # the other loops of the old cell are holes: each lies in one of the two; those that stay are marked meanwhile
    stays = -3
    _set_face(graph, back if start == out else out, stays)
    for h in range(out):
        if graph[h, FACE] != face:
            continue
        where = 0
        g = h
        while where == 0:
            where = _is_in_loop(plan, start, graph[g, ORIGIN])
            g = graph[g, NEXT]
            if g == h:
                break
        _set_face(graph, h, made if where > 0 else stays)
    for h in range(counts[EDGES]):
        if graph[h, FACE] == stays:
            graph[h, FACE] = face
    return 1


@kernel(inline="always")
def between_vertices(y: float) -> float:
    """The nearest ordinate half-way between those that vertices can have: a ray there passes none."""
    return math.floor(y) + 0.5


@kernel
def cell_at(plan: Subdivision, x: float, y: float) -> int:
    """The cell in which a place lies, to half a millimetre; -1 outside."""
    xy, graph = plan.xy, plan.graph
    y = between_vertices(y)
    nearest = -math.inf
    face = -1
    for h in range(plan.counts[EDGES]):
        p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        # the half of an edge that runs down has the places to the right of it on its left side
        if xy[p, 1] > y >= xy[q, 1]:
            at = xy[p, 0] + (y - xy[p, 1]) * (xy[q, 0] - xy[p, 0]) / (xy[q, 1] - xy[p, 1])
            if nearest < at <= x:
                nearest = at
                face = int(graph[h, FACE])
    return face


@kernel
def subdivision_of(ring_xy: IntArray, ring_starts: IntArray, polygon_of_ring: IntArray, room: int) -> Subdivision:
    """An outline with one cell per polygon, and room for some vertices and edges.

    Vertices `ring_xy` (n, 2) of the rings, not closed, are in millimetres; outer rings turn left, holes right. They
    come first, and so do their 2 n half-edges, the even ones inside. `ring_starts` (r + 1,) is the first vertex of
    every ring.
    """
    n = len(ring_xy)
    xy = np.zeros((n + room, 2), np.int64)
    graph = np.full((2 * (n + room), 5), -1, np.int64)
    counts = np.array([n, 2 * n, 0])
    for r in range(len(ring_starts) - 1):
        first, last = ring_starts[r], ring_starts[r + 1]
        counts[CELLS] = max(counts[CELLS], polygon_of_ring[r] + 1)
        for v in range(first, last):
            xy[v, 0], xy[v, 1] = ring_xy[v, 0], ring_xy[v, 1]
            after = v + 1 if v + 1 < last else first
            before = v - 1 if v > first else last - 1
            graph[2 * v, ORIGIN], graph[2 * v + 1, ORIGIN] = v, after
            graph[2 * v, NEXT], graph[2 * v, PREVIOUS] = 2 * after, 2 * before
            graph[2 * v + 1, NEXT], graph[2 * v + 1, PREVIOUS] = 2 * before + 1, 2 * after + 1
            graph[2 * v, FACE] = polygon_of_ring[r]
            graph[2 * v, LINE] = graph[2 * v + 1, LINE] = -2 - v
    return Subdivision(xy, graph, counts)


class _Passages(NamedTuple):
    """Where a line passes vertices and crosses edges of a subdivision, (m,) each."""

    along: FloatArray
    """float64, millimetres along the line."""
    vertex: IntArray
    """int64, the vertex, or -1."""
    crossed: IntArray
    """int64, the half-edge, or -1."""


@kernel(inline="always")
def _passages(plan: Subdivision, line: FloatArray, snap_mm: float) -> _Passages:
    """Vertices nearer to a line than a distance, and edges that it crosses."""
    xy, graph = plan.xy, plan.graph
    n_vertices, n_edges = plan.counts[VERTICES], plan.counts[EDGES]
    nx, ny = line[0], line[1]
    off = np.empty(n_vertices)
    for v in range(n_vertices):
        off[v] = nx * xy[v, 0] + ny * xy[v, 1] + line[2]
        if abs(off[v]) < snap_mm:
            off[v] = 0.0
    along = np.empty(n_vertices + n_edges // 2)
    vertex = np.empty(n_vertices + n_edges // 2, np.int64)
    crossed = np.empty(n_vertices + n_edges // 2, np.int64)
    m = 0
    for v in range(n_vertices):
        if off[v] == 0.0:
            along[m] = -ny * xy[v, 0] + nx * xy[v, 1]
            vertex[m] = v
            crossed[m] = -1
            m += 1
    for h in range(0, n_edges, 2):
        p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        if (off[p] > 0.0 > off[q]) or (off[p] < 0.0 < off[q]):
            fraction = off[p] / (off[p] - off[q])
            x = xy[p, 0] + fraction * (xy[q, 0] - xy[p, 0])
            y = xy[p, 1] + fraction * (xy[q, 1] - xy[p, 1])
            along[m] = -ny * x + nx * y
            vertex[m] = -1
            crossed[m] = h
            m += 1
    return _Passages(along[:m], vertex[:m], crossed[:m])


@kernel
def cut_by_line(plan: Subdivision, line: FloatArray, number: int, snap_mm: float, spans: FloatArray, only: int) -> None:
    """Cut the cells in which a line has support, or `only` one of them; -1 for all.

    `spans` (s, 2) are the stretches of the line with support, in mm along it. `line` (3,) is in mm.
    """
    xy, graph, counts = plan.xy, plan.graph, plan.counts
    nx, ny = line[0], line[1]
    along, vertex, crossed = _passages(plan, line, snap_mm)
    order = ascending_order(along)
    for k in range(len(along) - 1):
        i, j = order[k], order[k + 1]
        low, high = along[i], along[j]
        if high - low < 2.0 * _CLEARANCE_MM:
            continue
        supported = False
        for s in range(len(spans)):
            supported = supported or min(high, spans[s, 1]) - max(low, spans[s, 0]) > _MIN_SUPPORT_MM
        if not supported or counts[VERTICES] + 2 > len(xy) or counts[EDGES] + 6 > len(graph):
            continue
        middle = 0.5 * (low + high)
        face = cell_at(plan, -nx * line[2] - ny * middle, -ny * line[2] + nx * middle)
        if face < 0 or (only >= 0 and face != only):
            continue
        room = True
        for e in (i, j):
            if vertex[e] < 0 and room:
                x = int(np.rint(-nx * line[2] - ny * along[e]))
                y = int(np.rint(-ny * line[2] + nx * along[e]))
                room = insert_vertex(plan, crossed[e], x, y)
                if room:
                    vertex[e] = counts[VERTICES] - 1
        if room:
            insert_chord(plan, vertex[i], vertex[j], face, number)


@kernel
def _supported_spans(candidates: CandidateLines, number: int, half_m: float) -> FloatArray:
    """The stretches of a line near its supporting places, (s, 2) mm along it."""
    line, line_of, places = candidates.lines[number], candidates.line_of, candidates.places
    n = 0
    for q in range(len(places)):
        n += line_of[q] == number
    along = np.empty(n)
    n = 0
    for q in range(len(places)):
        if line_of[q] == number:
            along[n] = -line[1] * places[q, 0] + line[0] * places[q, 1]
            n += 1
    along = in_order(along)
    spans = np.empty((n, 2))
    m = 0
    for t in along:
        if m > 0 and (t - half_m) * 1e3 <= spans[m - 1, 1]:
            spans[m - 1, 1] = (t + half_m) * 1e3
        else:
            spans[m, 0], spans[m, 1] = (t - half_m) * 1e3, (t + half_m) * 1e3
            m += 1
    return spans[:m]


@kernel
def subdivide(plan: Subdivision, candidates: CandidateLines, reach_m: float, clearance: float) -> None:
    """Cut an outline from `subdivision_of` by candidate lines, those with the highest scores first, in place.

    A line cuts `reach_m` beyond its supporting places, and passes through a vertex within `clearance` times the usual
    distance.
    """
    in_mm = np.empty(3)
    for number in ascending_order(-candidates.scores):
        spans = _supported_spans(candidates, number, reach_m)
        line = candidates.lines[number]
        in_mm[0], in_mm[1], in_mm[2] = line[0], line[1], line[2] * 1e3
        snap_mm = SNAP_CROSSING_MM if candidates.crossing[number] != 0 else _SNAP_MM
        cut_by_line(plan, in_mm, number, clearance * snap_mm, spans, -1)
