"""The plan cut into one piece per roof plane: marching triangles over a labelled TIN.

Every facet is cut into one piece for each label around its vertices: a facet of two labels by one segment between the
cut points of its two mixed edges, a facet of three by three segments that meet inside it. A cut point lies inside its
edge and joins exactly two facets, a meeting point joins exactly three pieces. Therefore pieces cannot overlap and
borders cannot pinch (Lorensen and Cline 1987 in the plane, with many labels).
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.kernels.sorting import ascending_order, counting_sort
from pipeline.kernels.union_find import numbered_sets, unite
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, Reason, RoofType, Tin
from pipeline.prepared_cloud import SHADING_HEIGHT_M

OUTSIDE = -1
"""The label of places without roof."""
_ABSORPTIONS = 50
"""Most rounds in which small regions join a neighbour: a guard, since a round without a change is the last."""
_MAX_MISFIT_M = 1.0
"""Points farther from a plane all count as this far: outliers do not decide."""
_NEAR_END = 0.03
"""Share of an edge within which a border keeps away from its ends; numerical guard."""
_JUST_BEYOND = 0.3
"""A crossing this share of an edge beyond its end still counts as on it: the noise of the planes moves it so far."""
_PARALLEL = 1e-3
"""Determinant of three planes' slopes below which they do not meet in one point; numerical guard."""
_INSIDE_MM = 5.0
"""How far the meeting point keeps from the sides of its facet; numerical guard."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPartition:
    """Polygons that share their borders exactly, each with a roof plane."""

    polygons: tuple[shapely.Polygon, ...]
    """In integer millimetres of the candidate's local frame."""
    labels: LabelArray
    """(p,) int32, the plane of each polygon."""
    planes: tuple[Plane, ...] | None = None
    """The planes that the labels number; None for those of the segmentation."""
    roof_type: RoofType | None = None
    """That of a curved surface, whose facets stay as they are; None for the rule over the planes."""


class MinAreas(NamedTuple):
    """Smaller regions of a labelled plan are absorbed; square metres."""

    face_m2: float
    void_m2: float


@kernel
def connected_regions(facets: LabelArray, labels: LabelArray) -> tuple[LabelArray, int]:
    """Components of equally labelled vertices along TIN edges, (n,) numbered by their lowest vertex; their number."""
    parent = np.arange(len(labels))
    for t in range(len(facets)):
        a, b, c = facets[t, 0], facets[t, 1], facets[t, 2]
        if labels[a] == labels[b]:
            unite(parent, a, b)
        if labels[b] == labels[c]:
            unite(parent, b, c)
        if labels[c] == labels[a] != labels[b]:
            unite(parent, c, a)
    return numbered_sets(parent)


@kernel
def _region_areas(
    x: IntArray, y: IntArray, facets: LabelArray, regions: LabelArray, count: int, counted: LabelArray
) -> FloatArray:
    """Plan area of every region, (count,) m2: a third of each facet to each of its vertices that counts."""
    areas = np.zeros(count)
    for t in range(len(facets)):
        a, b, c = facets[t, 0], facets[t, 1], facets[t, 2]
        twice = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        for k in range(3):
            v = facets[t, k]
            if counted[v] != 0:
                areas[regions[v]] += twice * 1e-6 / 6.0
    return areas


@kernel(inline="always")
def _adjacency(facets: LabelArray, n: int) -> tuple[LabelArray, LabelArray]:
    """The facets around n vertices in compressed rows: starts (n + 1,) and the two other vertices of each, (c, 2)."""
    starts, corners = counting_sort(facets.ravel(), n)
    others = np.empty((len(corners), 2), np.int32)
    for s in range(len(corners)):
        t, k = corners[s] // 3, corners[s] % 3
        others[s, 0], others[s, 1] = facets[t, (k + 1) % 3], facets[t, (k + 2) % 3]
    return starts, others


@kernel(inline="always")
def _best_label(
    x: IntArray,
    y: IntArray,
    z: FloatArray,
    members: LabelArray,
    label: int,
    counted: LabelArray,
    planes: FloatArray,
    border: IntArray,
) -> int:
    """The label that suits the members of a small region best, from the length of its border with each label plus 1."""
    total = 0
    for k in range(len(border)):
        total += border[k]
    if total == 0:
        return label
    n_members = 0
    for v in members:
        n_members += counted[v]
    best = OUTSIDE
    best_cost = math.inf
    for k in range(len(planes)):
        if border[k + 1] == 0:
            continue
        cost = 0.0
        if label >= 0:
            for v in members:
                if counted[v] != 0:
                    fit = planes[k, 0] * x[v] * 1e-3 + planes[k, 1] * y[v] * 1e-3 + planes[k, 2]
                    cost += min(abs(z[v] - fit), _MAX_MISFIT_M)
            cost /= max(1, n_members)
        cost -= border[k + 1] / total
        if cost < best_cost:
            best_cost = cost
            best = k
    return best


@kernel
def absorb_small_regions(
    x: IntArray,
    y: IntArray,
    z: FloatArray,
    facets: LabelArray,
    labels: LabelArray,
    counted: LabelArray,
    planes: FloatArray,
    min_areas: MinAreas,
) -> LabelArray:
    """Labels (n,) in which no region is too small: small ones join a neighbour, smallest first.

    A roof region joins the adjacent plane that fits its points best, where a larger common border counts as a better
    fit; the outside only if no plane is adjacent. A small void joins the plane with the longest border. The region of
    the last vertex, the surroundings, stays. `x`, `y` are millimetres, `z` metres, all (n,).
    """
    labels = labels.copy()
    n = len(labels)
    starts, others = np.empty(0, np.int32), np.empty((0, 2), np.int32)
    border = np.zeros(len(planes) + 1, np.int64)
    for _ in range(_ABSORPTIONS):
        regions, count = connected_regions(facets, labels)
        areas = _region_areas(x, y, facets, regions, count, counted)
        first, by_region = counting_sort(regions, count)
        touched = np.zeros(count, np.uint8)
        changed = False
        for r in ascending_order(areas):
            if areas[r] >= max(min_areas.face_m2, min_areas.void_m2):
                break
            members = by_region[first[r] : first[r + 1]]
            label = labels[members[0]]
            if areas[r] >= (min_areas.void_m2 if label < 0 else min_areas.face_m2) or r == regions[n - 1]:
                continue
            if touched[r] != 0:
                continue  # it grew since its area was taken: the next round judges it
            if len(starts) == 0:
                starts, others = _adjacency(facets, n)
            border[:] = 0
            for v in members:
                for w in others[starts[v] : starts[v + 1]].ravel():
                    if labels[w] != label:
                        border[labels[w] + 1] += 1
            best = _best_label(x, y, z, members, label, counted, planes, border)
            if best == label:
                continue
            for v in members:
                for w in others[starts[v] : starts[v + 1]].ravel():
                    if labels[w] == best:
                        touched[regions[w]] = 1
                labels[v] = best
            changed = True
        if not changed:
            break
    return labels


class _Labelled(NamedTuple):
    """A labelled TIN and where its edges are cut."""

    x: IntArray
    """(n,) int64, millimetres."""
    y: IntArray
    """(n,) int64, millimetres."""
    labels: LabelArray
    """(n,) int32, plane of every vertex; -1 outside."""
    planes: FloatArray
    """(k, 3) float64, coefficients a, b, c; metres."""
    outside_fraction: float
    """Where on the way from a roof vertex to an outside one the border lies."""
    step_offset_m: float
    """Distance of a high step edge from the points of its upper face."""


@kernel
def _cut_fraction(tin: _Labelled, p: int, q: int) -> float:
    """Where on the edge from p to q the label changes, 0 to 1."""
    planes, label_p, label_q = tin.planes, tin.labels[p], tin.labels[q]
    x0, y0, x1, y1 = tin.x[p], tin.y[p], tin.x[q], tin.y[q]
    if label_p < 0:
        return 1.0 - tin.outside_fraction
    if label_q < 0:
        return tin.outside_fraction
    da = planes[label_p, 0] - planes[label_q, 0]
    db = planes[label_p, 1] - planes[label_q, 1]
    dc = planes[label_p, 2] - planes[label_q, 2]
    d0 = (da * x0 + db * y0) * 1e-3 + dc
    d1 = (da * x1 + db * y1) * 1e-3 + dc
    if (d0 < 0.0 < d1) or (d1 < 0.0 < d0):
        fraction: float = d0 / (d0 - d1)
        return min(max(fraction, _NEAR_END), 1.0 - _NEAR_END)
    # the planes cross shortly beyond one end: the border hugs that end; a step lies in the middle
    length = math.sqrt(float((x1 - x0) ** 2 + (y1 - y0) ** 2)) * 1e-3
    if min(abs(d0), abs(d1)) < _JUST_BEYOND * math.sqrt(da * da + db * db) * length:
        return _NEAR_END if abs(d0) < abs(d1) else 1.0 - _NEAR_END
    if min(abs(d0), abs(d1)) > SHADING_HEIGHT_M:
        # lower points within the shading radius of the upper face were left out: the step is close to the latter
        near = min(max(tin.step_offset_m / max(length, 1e-3), 0.05), 0.5)
        return near if d0 > 0.0 else 1.0 - near
    return 0.5


@kernel
def _cut_point(tin: _Labelled, a: int, b: int) -> tuple[float, float]:
    """Where the edge between two vertices is cut, millimetres; the same for both directions."""
    p, q = (a, b) if a < b else (b, a)
    f = _cut_fraction(tin, p, q)
    return tin.x[p] + f * (tin.x[q] - tin.x[p]), tin.y[p] + f * (tin.y[q] - tin.y[p])


@kernel
def _meeting_point(tin: _Labelled, corners: LabelArray) -> tuple[float, float]:
    """Where the three pieces of a facet meet: at the three planes' common point if it fits, else amid the cuts.

    `corners` are the facet's vertices, (3,); the result is in millimetres.
    """
    planes = tin.planes
    lab = (tin.labels[corners[0]], tin.labels[corners[1]], tin.labels[corners[2]])
    if min(lab[0], lab[1], lab[2]) >= 0:
        a1 = planes[lab[0], 0] - planes[lab[1], 0]
        b1 = planes[lab[0], 1] - planes[lab[1], 1]
        c1 = planes[lab[0], 2] - planes[lab[1], 2]
        a2 = planes[lab[0], 0] - planes[lab[2], 0]
        b2 = planes[lab[0], 1] - planes[lab[2], 1]
        c2 = planes[lab[0], 2] - planes[lab[2], 2]
        determinant = a1 * b2 - a2 * b1
        if abs(determinant) > _PARALLEL:
            px = (b1 * c2 - b2 * c1) / determinant * 1e3
            py = (a2 * c1 - a1 * c2) / determinant * 1e3
            inside = True
            for k in range(3):
                ax, ay = float(tin.x[corners[k]]), float(tin.y[corners[k]])
                bx, by = float(tin.x[corners[(k + 1) % 3]]), float(tin.y[corners[(k + 1) % 3]])
                cross = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
                if cross < _INSIDE_MM * np.hypot(bx - ax, by - ay):
                    inside = False
            if inside:
                return px, py
    (x0, y0), (x1, y1) = _cut_point(tin, corners[0], corners[1]), _cut_point(tin, corners[1], corners[2])
    x2, y2 = _cut_point(tin, corners[2], corners[0])
    return (x0 + x1 + x2) / 3.0, (y0 + y1 + y2) / 3.0


@kernel
def _march(
    tin: _Labelled, facets: LabelArray, neighbours: LabelArray
) -> tuple[FloatArray, LabelArray, LabelArray, LabelArray]:
    """Rings around all roof regions: nodes (m, 2) in mm, first node (r + 1,), region and label (r,) of each ring.

    A ring keeps its region on the left. The state of the walk is a half-edge a -> b of a facet with a inside the
    region and b not; it leaves the facet across b -> third where third is inside too, else across third -> a.
    """
    regions, _ = connected_regions(facets, tin.labels)
    labels = tin.labels
    mixed = 0
    mixed_edges = np.empty(3 * len(facets), np.int32)
    for t in range(len(facets)):
        for k in range(3):
            a, b = facets[t, (k + 1) % 3], facets[t, (k + 2) % 3]
            if labels[a] >= 0 and labels[a] != labels[b]:
                mixed_edges[mixed] = 3 * t + k
                mixed += 1
    visited = np.zeros((len(facets), 3), np.uint8)
    nodes = np.empty((2 * mixed, 2))
    ring_starts = np.zeros(mixed + 1, np.int32)
    ring_regions, ring_labels = np.empty(mixed, np.int32), np.empty(mixed, np.int32)
    count = 0
    rings = 0
    for start in mixed_edges[:mixed]:
        t, k = start // 3, start % 3
        if visited[t, k] != 0:
            continue
        a = facets[t, (k + 1) % 3]
        ring_regions[rings], ring_labels[rings] = regions[a], labels[a]
        while visited[t, k] == 0:
            visited[t, k] = 1
            a = facets[t, (k + 1) % 3]
            b = facets[t, (k + 2) % 3]
            third = facets[t, k]
            x, y = _cut_point(tin, a, b)
            nodes[count, 0], nodes[count, 1] = np.rint(x), np.rint(y)
            count += 1
            side = (k + 1) % 3
            if labels[third] != labels[a]:
                side = (k + 2) % 3
                if labels[third] != labels[b]:
                    x, y = _meeting_point(tin, facets[t])
                    nodes[count, 0], nodes[count, 1] = np.rint(x), np.rint(y)
                    count += 1
            # step over the side opposite to vertex `side`; find the same side in the neighbour
            u = neighbours[t, side]
            back = 0
            while neighbours[u, back] != t:
                back += 1
            t = u
            k = back
        rings += 1
        ring_starts[rings] = count
    return nodes[:count], ring_starts[: rings + 1], ring_regions[:rings], ring_labels[:rings]


def march(
    xy_mm: IntArray, tin: Tin, labels: LabelArray, planes: FloatArray, outside_fraction: float, step_offset_m: float
) -> RoofPartition:
    """Cut the plan into one polygon per connected region of equal labels, in the order of their first facets.

    Vertices (n, 2) are in millimetres, their `labels` -1 outside, where all vertices of the hull must be; planes (k, 3)
    are the coefficients a, b, c of z = a x + b y + c, metres. `outside_fraction` is where on the way from a roof vertex
    to an outside one the border lies, `step_offset_m` the distance of a high step edge from the points of its upper
    face. Polygons are rounded to 1 mm. Raises BuildingError `no_partition` where no roof vertex is inside.

    Examples
    --------
    >>> import numpy as np
    >>> from pipeline.tin.delaunay import triangulate
    >>> xy = np.array([[0, 0], [900, 0], [900, 900], [0, 900], [400, 450]])
    >>> labels = np.array([-1, -1, -1, -1, 0], np.int32)
    >>> march(xy, triangulate(xy), labels, np.zeros((1, 3)), 0.5, 0.1).polygons[0].area
    202500.0
    """
    x, y = np.ascontiguousarray(xy_mm[:, 0]), np.ascontiguousarray(xy_mm[:, 1])
    labelled = _Labelled(x, y, labels, planes, outside_fraction, step_offset_m)
    nodes, ring_starts, ring_regions, ring_labels = _march(labelled, tin.facets, tin.neighbours)
    if len(ring_regions) == 0:
        raise BuildingError(Reason.NO_PARTITION, "no point with a plane lies inside the triangulation")
    xy, ring, face, face_labels = _by_face(nodes, ring_starts, ring_regions, ring_labels)
    polygons = shapely.polygons(shapely.linearrings(xy, indices=ring), indices=face)
    return RoofPartition(polygons=tuple(polygons.tolist()), labels=face_labels)


@kernel
def _by_face(
    nodes: FloatArray, ring_starts: LabelArray, ring_regions: LabelArray, ring_labels: LabelArray
) -> tuple[FloatArray, IntArray, IntArray, LabelArray]:
    """The rings of `_march` by region, in each the counter-clockwise one, its outside, before the others.

    Nodes (m, 2), the ring of each, (m,), the face of every ring, and the label of every face. Rings of fewer than three
    nodes are left out.
    """
    keys = np.empty(len(ring_regions), np.int64)
    for r in range(len(ring_regions)):
        start, end = ring_starts[r], ring_starts[r + 1]
        twice_area, before = 0.0, end - 1
        for k in range(start, end):
            twice_area += nodes[before, 0] * nodes[k, 1] - nodes[k, 0] * nodes[before, 1]
            before = k
        keys[r] = 2 * ring_regions[r] + (twice_area <= 0.0)
    xy, ring = np.empty(nodes.shape), np.empty(len(nodes), np.int64)
    face, labels = np.empty(len(keys), np.int64), np.empty(len(keys), np.int32)
    count = rings = faces = 0
    region = -1
    for r in ascending_order(keys):
        start, end = ring_starts[r], ring_starts[r + 1]
        if end - start < 3:
            continue
        if ring_regions[r] != region:
            region, labels[faces] = ring_regions[r], ring_labels[r]
            faces += 1
        for k in range(start, end):
            xy[count], ring[count] = nodes[k], rings
            count += 1
        face[rings] = faces - 1
        rings += 1
    return xy[:count], ring[:count], face[:rings], labels[:faces].copy()
