"""Half-edges of a triangulation of the sphere: the split and the flip that incremental Delaunay insertion is made of.

Facet t owns the half-edges 4 t, 4 t + 1 and 4 t + 2 (the stride of 4 saves divisions and keeps a facet in one cache
line; slot 3 is unused). `origin[e]` is the vertex where e starts, `twin[e]` the opposite half-edge of the adjacent
facet. Facets turn left. The plane is closed to a sphere by one vertex at infinity (number `infinity`, one past the real
ones): beyond every edge of the hull lies a facet with it, so no edge is without a twin and no corner has to be "far
enough" away.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.tin.predicates import lies_in_circumcircle, orientation


@kernel(inline="always")
def following(e: int) -> int:
    """The next half-edge of the same facet."""
    return e - 2 if e & 3 == 2 else e + 1


@kernel(inline="always")
def preceding(e: int) -> int:
    """The previous half-edge of the same facet."""
    return e + 2 if e & 3 == 0 else e - 1


@kernel
def start_sphere(x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, a: int, b: int, c: int) -> None:
    """Facet 0 of three vertices that are not collinear, and the facets 1 to 3 between its edges and infinity."""
    infinity = len(x) - 1
    if orientation(x[a], y[a], x[b], y[b], x[c], y[c]) < 0.0:
        b, c = c, b
    corners = (a, b, c)
    for k in range(3):
        outer = 4 * (k + 1)
        origin[k] = corners[k]
        origin[outer] = corners[(k + 1) % 3]
        origin[outer + 1] = corners[k]
        origin[outer + 2] = infinity
        twin[k] = outer
        twin[outer] = k
        # around vertex k the edge to infinity is shared with the facet before
        before = 4 * ((k + 2) % 3 + 1)
        twin[outer + 1] = before + 2
        twin[before + 2] = outer + 1


@kernel
def split_facet(origin: LabelArray, twin: LabelArray, facet: int, first_new: int, p: int) -> None:
    """Put vertex p into a facet; it becomes three: `facet`, `first_new`, `first_new + 1`, each with p in slot 0."""
    e = 4 * facet
    f = 4 * first_new
    g = f + 4
    a = origin[e]
    b = origin[e + 1]
    c = origin[e + 2]
    twin_ab = twin[e]
    twin_bc = twin[e + 1]
    twin_ca = twin[e + 2]
    origin[e] = p
    origin[e + 1] = b
    origin[e + 2] = c
    origin[f] = p
    origin[f + 1] = c
    origin[f + 2] = a
    origin[g] = p
    origin[g + 1] = a
    origin[g + 2] = b
    twin[e + 1] = twin_bc
    twin[f + 1] = twin_ca
    twin[twin_ca] = f + 1
    twin[g + 1] = twin_ab
    twin[twin_ab] = g + 1
    twin[e + 2] = f
    twin[f] = e + 2
    twin[f + 2] = g
    twin[g] = f + 2
    twin[g + 2] = e
    twin[e] = g + 2


@kernel(inline="always")
def must_flip(x: FloatArray, y: FloatArray, p: int, u: int, v: int, q: int) -> bool:
    """Whether the edge u, v between the facets (p, u, v) and (v, u, q) is not Delaunay; p is the new vertex."""
    infinity = len(x) - 1
    if u == infinity:
        return bool(orientation(x[p], y[p], x[v], y[v], x[q], y[q]) < 0.0)
    if v == infinity:
        return bool(orientation(x[q], y[q], x[u], y[u], x[p], y[p]) < 0.0)
    if q == infinity:
        # p on the edge of the hull itself
        return bool(orientation(x[p], y[p], x[u], y[u], x[v], y[v]) <= 0.0)
    return bool(lies_in_circumcircle(x[p], y[p], x[u], y[u], x[v], y[v], x[q], y[q]))


@kernel
def restore_delaunay(x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, facet: int) -> int:
    """Flip around the newest vertex until all is Delaunay again (Lawson 1977); return how many flips were made.

    Every facet around that vertex has it in slot 0, before and after, and `facet` stays one of them: so the walk
    around the vertex needs no stack, it just stays at a facet until its outer edge holds.
    """
    first = 4 * facet
    e = first
    flips = 0
    p = origin[e]
    while True:
        f = twin[e + 1]
        after = following(f)
        before = preceding(f)
        u = origin[e + 1]
        v = origin[e + 2]
        q = origin[before]
        if must_flip(x, y, p, u, v, q):
            flips += 1
            # (p, u, v) and (v, u, q) become (p, u, q) and (p, q, v)
            twin_uq = twin[after]
            twin_qv = twin[before]
            twin_vp = twin[e + 2]
            g = f - (f & 3)
            origin[e + 2] = q
            twin[e + 1] = twin_uq
            twin[twin_uq] = e + 1
            origin[g] = p
            origin[g + 1] = q
            origin[g + 2] = v
            twin[g + 1] = twin_qv
            twin[twin_qv] = g + 1
            twin[g + 2] = twin_vp
            twin[twin_vp] = g + 2
            twin[e + 2] = g
            twin[g] = e + 2
        else:
            e = twin[e + 2]
            if e == first:
                return flips


@kernel
def locate(x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, facet: int, p: int) -> int:
    """The facet that holds p (on its border counts), or a facet at infinity whose hull edge p lies beyond.

    A visibility walk from `facet`: it cannot go round in circles in a Delaunay triangulation (De Floriani 1991).
    """
    infinity = len(x) - 1
    px = x[p]
    py = y[p]
    e = 4 * facet
    for k in range(3):
        if origin[e + k] == infinity:
            # the edge opposite to infinity belongs to a real facet too
            e = twin[following(e + k)]
            e -= e & 3
            break
    entered = -1
    while True:
        crossed = -1
        for k in range(3):
            h = e + k
            if h == entered:
                continue
            a = origin[h]
            b = origin[following(h)]
            if orientation(x[a], y[a], x[b], y[b], px, py) < 0.0:
                crossed = h
                break
        if crossed < 0:
            return int(e >> 2)
        entered = twin[crossed]
        e = entered - (entered & 3)
        if origin[preceding(entered)] == infinity:
            return int(e >> 2)


@kernel
def canonical_facets(
    origin: LabelArray, twin: LabelArray, n_facets: int, order: LabelArray
) -> tuple[LabelArray, LabelArray, LabelArray]:
    """Real facets by the caller's vertex numbers, smallest vertex first, sorted.

    From the half-edges (4 m,), the number of facets in use, those at infinity among them, and the caller's number of
    every vertex, `order` (n,). Returns facets and neighbours (r, 3) as in `pipeline.model.Tin`, and the row of every
    facet, -1 at infinity.
    """
    n = len(order)
    first_edge = np.full(n_facets, -1, np.int32)
    starts = np.zeros(n + 2, np.int32)
    for t in range(n_facets):
        e = 4 * t
        a, b, c = origin[e], origin[e + 1], origin[e + 2]
        if n in (a, b, c):
            continue
        a, b, c = order[a], order[b], order[c]
        k = 0
        if b < a and b < c:
            k = 1
            a = b
        elif c < a and c < b:
            k = 2
            a = c
        first_edge[t] = e + k
        starts[a + 2] += 1
    for v in range(n):
        starts[v + 2] += starts[v + 1]
    # the facets of each smallest vertex: its second one goes before the facet in one whole number
    n_real = starts[n + 1]
    sorted_facets = np.empty(n_real, np.int64)
    for t in range(n_facets):
        if first_edge[t] >= 0:
            v = order[origin[first_edge[t]]]
            sorted_facets[starts[v + 1]] = (np.int64(order[origin[following(first_edge[t])]]) << 32) | t
            starts[v + 1] += 1
    # every start has moved to its end, which is the next one's start; the facets between are few
    number = np.full(n_facets, -1, np.int32)
    for v in range(n):
        for k in range(starts[v], starts[v + 1]):
            facet = sorted_facets[k]
            i = k
            while i > starts[v] and sorted_facets[i - 1] > facet:
                sorted_facets[i] = sorted_facets[i - 1]
                i -= 1
            sorted_facets[i] = facet
        for i in range(starts[v], starts[v + 1]):
            number[sorted_facets[i] & 0xFFFFFFFF] = i
    # facet after facet as they were made: what it refers to is then near in memory
    facets = np.empty((n_real, 3), np.int32)
    neighbours = np.empty((n_real, 3), np.int32)
    for t in range(n_facets):
        i = number[t]
        if i < 0:
            continue
        e = first_edge[t]
        for k in range(3):
            facets[i, k] = order[origin[e]]
            e = following(e)
            neighbours[i, k] = number[twin[e] >> 2]
    return facets, neighbours, number
