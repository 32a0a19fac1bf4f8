"""The plan cut into one piece a roof plane: marching triangles over a labelled TIN.

Every facet is cut into one piece for each label around its vertices: a facet of two labels by one segment between the
cut points of its two mixed edges, a facet of three by three segments that meet inside it. A cut point lies inside its
edge and joins exactly two facets, a meeting point joins exactly three pieces, so the pieces cannot overlap and no
border can pinch (Lorensen and Cline 1987 in the plane, with many labels).
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.kernels.counting_sort import counting_sort
from pipeline.kernels.merge_sort import ascending_order
from pipeline.kernels.union_find import numbered_sets, unite
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, Reason, Tin
from pipeline.prepared_cloud import SHADING_HEIGHT_M

OUTSIDE = -1
"""The label of what is no roof."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPartition:
    """Polygons that share their borders exactly, each with a roof plane."""

    polygons: tuple[shapely.Polygon, ...]
    """In integer millimetres of the candidate's local frame."""
    labels: LabelArray
    """(p,) int32, the plane of each polygon."""
    planes: tuple[Plane, ...] | None = None
    """What the labels number; None for the planes of the segmentation."""


@kernel
def connected_regions(facets: LabelArray, labels: LabelArray) -> tuple[LabelArray, int]:
    """Components of equally labelled vertices along TIN edges, numbered by their lowest vertex."""
    n = len(labels)
    parent = np.arange(n)
    for t in range(len(facets)):
        for k in range(3):
            a = facets[t, k]
            b = facets[t, (k + 1) % 3]
            if labels[a] == labels[b]:
                unite(parent, a, b)
    return numbered_sets(parent)


@kernel
def _region_areas(
    x: IntArray, y: IntArray, facets: LabelArray, regions: LabelArray, count: int, counted: LabelArray
) -> FloatArray:
    """Plan area of every region in m2: a third of each facet to each of its vertices that counts."""
    areas = np.zeros(count)
    for t in range(len(facets)):
        a, b, c = facets[t, 0], facets[t, 1], facets[t, 2]
        twice = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        for k in range(3):
            v = facets[t, k]
            if counted[v] != 0:
                areas[regions[v]] += twice * 1e-6 / 6.0
    return areas


@kernel
def absorb_small_regions(
    x: IntArray,
    y: IntArray,
    z: FloatArray,
    facets: LabelArray,
    labels: LabelArray,
    counted: LabelArray,
    planes: FloatArray,
    min_area_m2: float,
    min_void_m2: float,
) -> LabelArray:
    """Labels in which no region is smaller than it may be: small ones join a neighbour, smallest first.

    A roof region joins the adjacent plane that fits its points best, a vertex of common border counting for a better
    fit; the outside only where no plane is adjacent. A small void joins the plane with the longest border.
    Distances are capped at 1 m. The region of the last vertex, the surroundings, stays.
    """
    labels = labels.copy()
    n_planes = len(planes)
    n = len(labels)
    # adjacency of vertices in compressed rows, both directions of every edge (inner edges twice, which does not matter)
    corners = np.empty(6 * len(facets), np.int32)
    for t in range(len(facets)):
        for k in range(6):
            corners[6 * t + k] = facets[t, k // 2]
    starts, adjacent = counting_sort(corners, n)
    for s in range(len(adjacent)):
        t, k = adjacent[s] // 6, adjacent[s] % 6
        adjacent[s] = facets[t, (k // 2 + 1 + k % 2) % 3]
    border = np.zeros(n_planes + 1, np.int64)
    for _ in range(50):
        regions, count = connected_regions(facets, labels)
        areas = _region_areas(x, y, facets, regions, count, counted)
        first, members = counting_sort(regions, count)
        touched = np.zeros(count, np.uint8)
        changed = False
        for r in ascending_order(areas):
            label = labels[members[first[r]]]
            if areas[r] >= max(min_area_m2, min_void_m2):
                break
            if areas[r] >= (min_void_m2 if label < 0 else min_area_m2) or r == regions[n - 1]:
                continue
            if touched[r] != 0:
                continue  # it grew since its area was taken: the next round judges it
            border[:] = 0
            n_members = 0
            for m in range(first[r], first[r + 1]):
                v = members[m]
                n_members += counted[v]
                for s in range(starts[v], starts[v + 1]):
                    w = adjacent[s]
                    if labels[w] != label:
                        border[labels[w] + 1] += 1
            total = 0
            for k in range(n_planes + 1):
                total += border[k]
            if total == 0:
                continue
            best = OUTSIDE
            best_cost = 1e30
            for k in range(n_planes):
                if border[k + 1] == 0:
                    continue
                cost = 0.0
                if label >= 0:
                    for m in range(first[r], first[r + 1]):
                        v = members[m]
                        if counted[v] != 0:
                            fit = planes[k, 0] * x[v] * 1e-3 + planes[k, 1] * y[v] * 1e-3 + planes[k, 2]
                            cost += min(abs(z[v] - fit), 1.0)
                    cost /= max(1, n_members)
                cost -= border[k + 1] / total
                if cost < best_cost:
                    best_cost = cost
                    best = k
            touched[r] = 1
            if best == label:
                continue
            for m in range(first[r], first[r + 1]):
                for s in range(starts[members[m]], starts[members[m] + 1]):
                    if labels[adjacent[s]] == best:
                        touched[regions[adjacent[s]]] = 1
                labels[members[m]] = best
            changed = True
        if not changed:
            break
    return labels


@kernel
def _cut_fraction(
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    label0: int,
    label1: int,
    planes: FloatArray,
    outside_fraction: float,
    step_offset_m: float,
) -> float:
    """Where on the edge from 0 to 1 the label changes."""
    if label0 < 0:
        return 1.0 - outside_fraction
    if label1 < 0:
        return outside_fraction
    da = planes[label0, 0] - planes[label1, 0]
    db = planes[label0, 1] - planes[label1, 1]
    dc = planes[label0, 2] - planes[label1, 2]
    d0 = (da * x0 + db * y0) * 1e-3 + dc
    d1 = (da * x1 + db * y1) * 1e-3 + dc
    if (d0 < 0.0 < d1) or (d1 < 0.0 < d0):
        fraction: float = d0 / (d0 - d1)
        return min(max(fraction, 0.03), 0.97)
    # the planes cross shortly beyond one end: the border hugs that end; a step lies in the middle
    length = math.sqrt(float((x1 - x0) ** 2 + (y1 - y0) ** 2)) * 1e-3
    if min(abs(d0), abs(d1)) < 0.3 * math.sqrt(da * da + db * db) * length:
        return 0.03 if abs(d0) < abs(d1) else 0.97
    if min(abs(d0), abs(d1)) > SHADING_HEIGHT_M:
        # lower points within the shading radius of the upper face were left out: the step stands near to the latter
        near = min(max(step_offset_m / max(length, 1e-3), 0.05), 0.5)
        return near if d0 > 0.0 else 1.0 - near
    return 0.5


@kernel
def _meeting_point(
    vx: FloatArray, vy: FloatArray, mx: FloatArray, my: FloatArray, lab: LabelArray, planes: FloatArray
) -> tuple[float, float]:
    """Where the three pieces of a facet meet: at the three planes' common point if it fits, else amid the cuts.

    `vx`, `vy` are the corners, `mx`, `my` the cuts after each corner.
    """
    if min(lab[0], lab[1], lab[2]) >= 0:
        a1 = planes[lab[0], 0] - planes[lab[1], 0]
        b1 = planes[lab[0], 1] - planes[lab[1], 1]
        c1 = planes[lab[0], 2] - planes[lab[1], 2]
        a2 = planes[lab[0], 0] - planes[lab[2], 0]
        b2 = planes[lab[0], 1] - planes[lab[2], 1]
        c2 = planes[lab[0], 2] - planes[lab[2], 2]
        determinant = a1 * b2 - a2 * b1
        if abs(determinant) > 1e-3:
            px = (b1 * c2 - b2 * c1) / determinant * 1e3
            py = (a2 * c1 - a1 * c2) / determinant * 1e3
            inside = True
            for k in range(3):
                j = (k + 1) % 3
                # at least 5 mm off every side
                cross = (vx[j] - vx[k]) * (py - vy[k]) - (vy[j] - vy[k]) * (px - vx[k])
                if cross < 5.0 * np.hypot(vx[j] - vx[k], vy[j] - vy[k]):
                    inside = False
            if inside:
                return px, py
    return (mx[0] + mx[1] + mx[2]) / 3.0, (my[0] + my[1] + my[2]) / 3.0


@kernel
def _march(
    x: IntArray,
    y: IntArray,
    facets: LabelArray,
    neighbours: LabelArray,
    labels: LabelArray,
    regions: LabelArray,
    planes: FloatArray,
    outside_fraction: float,
    step_offset_m: float,
) -> tuple[FloatArray, LabelArray, LabelArray]:
    """Rings around all roof regions: node coordinates in mm ring after ring, ring starts, region of each ring.

    A ring keeps its region on the left. The state of the walk is a half-edge a -> b of a facet with a inside the
    region and b not; it leaves the facet across b -> third where third is inside too, else across third -> a.
    """
    m = len(facets)
    visited = np.zeros((m, 3), np.uint8)
    capacity = 1024
    nodes = np.empty((capacity, 2))
    count = 0
    ring_starts = [0]
    ring_regions = [np.int32(0)]
    ring_regions.pop()
    vx = np.empty(3)
    vy = np.empty(3)
    mx = np.empty(3)
    my = np.empty(3)
    lab = np.empty(3, np.int32)
    for start in range(m):
        for start_edge in range(3):
            a = facets[start, (start_edge + 1) % 3]
            b = facets[start, (start_edge + 2) % 3]
            if visited[start, start_edge] != 0 or labels[a] < 0 or labels[a] == labels[b]:
                continue
            t = start
            k = start_edge
            while visited[t, k] == 0:
                visited[t, k] = 1
                a = facets[t, (k + 1) % 3]
                b = facets[t, (k + 2) % 3]
                w = facets[t, k]
                if count + 2 > capacity:
                    grown = np.empty((2 * capacity, 2))
                    for c in range(count):
                        grown[c, 0], grown[c, 1] = nodes[c, 0], nodes[c, 1]
                    nodes = grown
                    capacity *= 2
                p, q = (a, b) if a < b else (b, a)
                f = _cut_fraction(x[p], y[p], x[q], y[q], labels[p], labels[q], planes, outside_fraction, step_offset_m)
                nodes[count, 0] = np.rint(x[p] + f * (x[q] - x[p]))
                nodes[count, 1] = np.rint(y[p] + f * (y[q] - y[p]))
                count += 1
                if labels[w] == labels[a]:
                    side = (k + 1) % 3
                else:
                    side = (k + 2) % 3
                    if labels[w] != labels[b]:
                        for j in range(3):
                            p = facets[t, j]
                            q = facets[t, (j + 1) % 3]
                            vx[j] = x[p]
                            vy[j] = y[p]
                            lab[j] = labels[p]
                            if p > q:
                                p, q = q, p
                            f = _cut_fraction(
                                x[p], y[p], x[q], y[q], labels[p], labels[q], planes, outside_fraction, step_offset_m
                            )
                            mx[j] = x[p] + f * (x[q] - x[p])
                            my[j] = y[p] + f * (y[q] - y[p])
                        px, py = _meeting_point(vx, vy, mx, my, lab, planes)
                        nodes[count, 0] = np.rint(px)
                        nodes[count, 1] = np.rint(py)
                        count += 1
                # step over the side opposite to vertex `side`; find the same side in the neighbour
                u = neighbours[t, side]
                back = 0
                while neighbours[u, back] != t:
                    back += 1
                t = u
                k = back
            ring_starts.append(count)
            ring_regions.append(regions[facets[start, (start_edge + 1) % 3]])
    return nodes[:count].copy(), np.array(ring_starts, np.int32), np.array(ring_regions, np.int32)


def march(
    xy_mm: IntArray, tin: Tin, labels: LabelArray, planes: FloatArray, outside_fraction: float, step_offset_m: float
) -> RoofPartition:
    """Cut the plan into one polygon a connected region of equal labels.

    Parameters
    ----------
    xy_mm : (n, 2) int64
        Vertices of the TIN, millimetres.
    tin : Tin
        Their Delaunay triangulation.
    labels : (n,) int32
        Plane of every vertex, -1 outside. All vertices of the hull must be outside.
    planes : (k, 3) float64
        Coefficients a, b, c of z = a x + b y + c, metres.
    outside_fraction : float
        Where on the way from a roof vertex to an outside one the border lies.
    step_offset_m : float
        Distance of a high step edge from the points of its upper face.

    Returns
    -------
    RoofPartition
        The polygons in the order of their first facets; rounded to 1 mm.

    Raises
    ------
    BuildingError
        `no_partition` where no roof vertex is inside.

    Examples
    --------
    >>> import numpy as np
    >>> from pipeline.tin.delaunay import triangulate
    >>> xy = np.array([[0, 0], [900, 0], [900, 900], [0, 900], [400, 450]])
    >>> labels = np.array([-1, -1, -1, -1, 0], np.int32)
    >>> march(xy, triangulate(xy), labels, np.zeros((1, 3)), 0.5, 0.1).polygons[0].area
    202500.0
    """
    regions, _ = connected_regions(tin.facets, labels)
    nodes, ring_starts, ring_regions = _march(
        np.ascontiguousarray(xy_mm[:, 0]),
        np.ascontiguousarray(xy_mm[:, 1]),
        tin.facets,
        tin.neighbours,
        labels,
        regions,
        planes,
        outside_fraction,
        step_offset_m,
    )
    if len(ring_regions) == 0:
        raise BuildingError(Reason.NO_PARTITION, "no point with a plane lies inside the triangulation")
    label_of_region = np.full(int(regions.max()) + 1, OUTSIDE, np.int32)
    label_of_region[regions] = labels
    return _polygons(nodes, ring_starts, ring_regions, label_of_region)


def _polygons(
    nodes: FloatArray, ring_starts: LabelArray, ring_regions: LabelArray, label_of_region: LabelArray
) -> RoofPartition:
    """Collect the rings of every region: the counter-clockwise one is its outside, the others are holes."""
    sizes = np.diff(ring_starts)
    ring_of_node = np.repeat(np.arange(len(sizes)), sizes)
    following = np.arange(1, len(nodes) + 1)
    following[ring_starts[1:] - 1] = ring_starts[:-1]
    cross = nodes[:, 0] * nodes[following, 1] - nodes[following, 0] * nodes[:, 1]
    twice_area = np.bincount(ring_of_node, weights=cross, minlength=len(sizes))
    # rings of one region together, the outer ring before its holes
    order = np.lexsort((np.arange(len(sizes)), twice_area <= 0.0, ring_regions))
    order = order[sizes[order] >= 3]
    rings = [shapely.linearrings(nodes[ring_starts[r] : ring_starts[r + 1]]) for r in order]
    owners = ring_regions[order]
    bounds = [0, *(np.flatnonzero(np.diff(owners)) + 1).tolist(), len(rings)]
    polygons = [shapely.Polygon(rings[i], rings[i + 1 : j]) for i, j in itertools.pairwise(bounds)]
    return RoofPartition(polygons=tuple(polygons), labels=label_of_region[owners[bounds[:-1]]])
