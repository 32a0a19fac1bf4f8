"""Planar patches of one candidate's roof and the borders between them, by which units are separated.

Patches grow over a TIN of thinned points from the most planar places. Steps are measured between the planes of two
patches, not on the facets at their border, which are one point spacing wide: so they are as sharp in sparse data as in
dense data. All sums are of whole millimetres or in one fixed order.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import median_of
from pipeline.kernels.normal_equations import add_to_sums, smallest_eigenvalue, solve_plane_moments
from pipeline.kernels.sorting import counting_sort, radix_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray, Tin
from pipeline.spatial_hash import points_by_cell

# Not settings: patches only serve to separate units, and the thresholds of units are settings.
_MAX_RADIUS_M = 3.0
"""Facets with a wider circumcircle bridge a gap in the roof: nothing touches across them."""
_TYPICAL_RADII = 3.0
"""So does a facet with a circumradius this many times the median of a dense roof, but no less than half of that."""
_WINDOW_MM = 1200
"""Radius of the smallest windows around vertices."""
_SCALES = 3
"""The windows have one, two and four times that radius."""
MIN_POINTS = 7
"""Fewest points of a window and of a patch: more than twice what a plane needs."""
_ROUGHNESS_MM = 120.0
"""Largest orthogonal standard deviation of a planar window."""
_DISTANCE_MM = 150.0
"""A patch takes what lies this near to its plane: three times the noise of a good survey."""
_NOISE_MM = 50.0
"""Noise of a good survey, orthogonal to a roof."""
_NARROW_MM = 300.0
"""Standard deviation across of points about a metre wide."""
MIN_COSINE = math.cos(math.radians(18.0))
"""Cosine of the largest angle between a patch and the surroundings of its vertices, or another patch of its slope."""
MIN_TURN = math.cos(math.radians(3.0))
"""Cosine of the angle between patches from which on they have different directions: at less they are one plane."""
_DIRECTIONS = 5
"""Directions of a curve, no two within the least turn: roofs of planes with one ridge have four."""
_UNKNOWN = 1e30
"""Deviation where a vertex has no plane around it."""
_MAX_BESIDE_MM = 750.0
"""Farthest that the border of a fold lies from the line in which its planes intersect: half an edge, and a gutter."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Patches:
    """The planar patches of a roof; k of them over n vertices."""

    of_vertex: LabelArray
    """(n,) int32, patch of each vertex; all vertices have one."""
    slopes: FloatArray
    """(k, 2) rise over run along easting and northing; nan where a patch has no plane."""
    levels_mm: FloatArray
    """(k,) elevation of each plane at the origin of x and y; nan where a patch has no plane."""
    areas_m2: FloatArray
    """(k,) plan area: a third of each facet belongs to each of its vertices."""
    centres_m: FloatArray
    """(k, 3) mean of the vertices."""
    tops_m: FloatArray
    """(k,) elevation below which nine tenths of the vertices lie."""
    outlines_m: FloatArray
    """(k,) length of the outline in plan, against other patches and against nothing."""


class RoofVertices(NamedTuple):
    """Thinned points of one roof, and which of them share a facet that bridges no gap."""

    x: IntArray
    y: IntArray
    z: IntArray
    """(n,) int64, millimetres from a place near by, sorted by (x, y)."""
    start: LabelArray
    """(n + 1,) int32, where the neighbours of each vertex begin."""
    others: LabelArray
    """Neighbours of all vertices, int32; some twice."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Borders:
    """Borders between patches, one row per pair that touches; arrays of one length."""

    first: LabelArray
    """The patch with the smaller number."""
    second: LabelArray
    """The other."""
    length_m: FloatArray
    """Length in plan."""
    extent_m: FloatArray
    """Length without the zigzag between points: that of a straight line with the same spread, at most `length_m`."""
    level_m: FloatArray
    """Length along which both planes meet: in a fold, or where one goes on in the other without a step."""
    direction: FloatArray
    """(b, 2) unit vector along the border: main axis of its pieces."""
    gap_pairs: IntArray
    """(g, 2) pairs of patches that see each other across gaps, those with the longest sight first."""


@kernel
def solve_plane(s: FloatArray) -> tuple[float, float, float, bool]:
    """Slopes and level at the sums' origin, from sums of 1, x, y, z, xx, xy, yy, xz, yz; False where there is none.

    Points show no slope across their length if they are 32 times longer than wide and narrower than `_NARROW_MM`.
    """
    n = s[0]
    if n < 3:
        return 0.0, 0.0, 0.0, False
    mx, my, mz = s[1] / n, s[2] / n, s[3] / n
    xx, xy, yy = s[4] / n - mx * mx, s[5] / n - mx * my, s[6] / n - my * my
    xz, yz = s[7] / n - mx * mz, s[8] / n - my * mz
    det = xx * yy - xy * xy
    if det <= min(1e-3 * (xx + yy), _NARROW_MM * _NARROW_MM) * (xx + yy) or det <= 0.0:
        return 0.0, 0.0, 0.0, False
    a, b = solve_plane_moments(xx, xy, yy, xz, yz)
    return a, b, mz - a * mx - b * my, True


@kernel
def local_planes(x: IntArray, y: IntArray, z: IntArray) -> FloatArray:
    """Slopes along x and y and orthogonal deviation in mm of the plane around every vertex, (n, 3).

    The window is a circle, doubled up to twice where it holds too few points. Where there is still no plane the
    deviation is `_UNKNOWN`.
    """
    n = x.size
    out = np.zeros((n, 3))
    out[:, 2] = _UNKNOWN
    if n == 0:
        return out
    for scale in range(_SCALES):
        radius = _WINDOW_MM * 2**scale
        limit = radius * radius
        start, members, column0, row0, columns, rows = points_by_cell(x, y, np.ones(n, np.bool_), radius)
        s = np.empty(10)
        for i in range(n):
            if out[i, 2] < _UNKNOWN:
                continue
            c, r = x[i] // radius - column0, y[i] // radius - row0
            s[:] = 0.0
            for rr in range(max(r - 1, 0), min(r + 2, rows)):
                low, high = start[rr * columns + max(c - 1, 0)], start[rr * columns + min(c + 1, columns - 1) + 1]
                for m in range(low, high):
                    j = members[m]
                    dx, dy, dz = float(x[j] - x[i]), float(y[j] - y[i]), float(z[j] - z[i])
                    if dx * dx + dy * dy > limit:
                        continue
                    add_to_sums(s, dx, dy, dz)
                    s[9] += dz * dz
            if s[0] < MIN_POINTS:
                continue
            a, b, _, found = solve_plane(s[:9])
            if not found:
                continue
            mx, my, mz = s[1] / s[0], s[2] / s[0], s[3] / s[0]
            out[i, 0], out[i, 1] = a, b
            out[i, 2] = math.sqrt(
                smallest_eigenvalue(
                    s[4] / s[0] - mx * mx,
                    s[5] / s[0] - mx * my,
                    s[7] / s[0] - mx * mz,
                    s[6] / s[0] - my * my,
                    s[8] / s[0] - my * mz,
                    s[9] / s[0] - mz * mz,
                )
            )
    return out


@kernel
def facet_sizes(x: IntArray, y: IntArray, facets: LabelArray) -> tuple[FloatArray, FloatArray]:
    """Circumradius of every facet, (m,), and the lengths of its edges, (m, 3), in the unit of the vertices."""
    radii, lengths = np.empty(len(facets)), np.empty((len(facets), 3))
    for t in range(len(facets)):
        a, b, c = facets[t]
        ux, uy, vx, vy = float(x[b] - x[a]), float(y[b] - y[a]), float(x[c] - x[a]), float(y[c] - y[a])
        wx, wy = vx - ux, vy - uy
        lengths[t, 0], lengths[t, 1] = math.sqrt(ux * ux + uy * uy), math.sqrt(vx * vx + vy * vy)
        lengths[t, 2] = math.sqrt(wx * wx + wy * wy)
        radii[t] = lengths[t, 0] * lengths[t, 1] * lengths[t, 2] / (2.0 * (ux * vy - uy * vx))
    return radii, lengths


@kernel
def vertex_neighbours(n: int, facets: LabelArray, sound: LabelArray) -> tuple[LabelArray, LabelArray]:
    """Compressed rows: the vertices that share a sound facet with each; some twice."""
    corners = np.empty(6 * sound.size, np.int32)
    for k in range(sound.size):
        for q in range(6):
            corners[6 * k + q] = facets[sound[k], q // 2]
    start, members = counting_sort(corners, n)
    others = np.empty(len(members), np.int32)
    for s in range(len(members)):
        k, q = members[s] // 6, members[s] % 6
        others[s] = facets[sound[k], (q // 2 + 1 + q % 2) % 3]
    return start, others


@kernel
def grow_patches(vertices: RoofVertices, local: FloatArray, order: IntArray) -> tuple[LabelArray, FloatArray]:
    """Patch of every vertex, -1 where none took it; slopes and level at the origin of every patch (k, 3).

    Seeds come in the given order (n,), the most planar first by `local_planes`. A vertex joins where it lies near the
    plane and its own surroundings, if they are planar at all, face the same way.
    """
    x, y, z, start, others = vertices
    n = x.size
    label = np.full(n, -1, np.int32)
    tried = np.zeros(n, np.bool_)
    planes = np.zeros((n, 3))
    queue = np.empty(n, np.int32)
    count = 0
    s = np.empty(9)
    for o in range(n):
        seed = order[o]
        if label[seed] >= 0 or tried[seed] or local[seed, 2] > _ROUGHNESS_MM:
            continue
        a, b, level = local[seed, 0], local[seed, 1], 0.0
        s[:] = 0.0
        s[0] = 1.0
        label[seed] = count
        queue[0] = seed
        head, tail, fitted = 0, 1, 4
        while head < tail:
            v = queue[head]
            head += 1
            for e in range(start[v], start[v + 1]):
                w = others[e]
                if label[w] >= 0:
                    continue
                dx, dy, dz = float(x[w] - x[seed]), float(y[w] - y[seed]), float(z[w] - z[seed])
                steepness = math.sqrt(1.0 + a * a + b * b)
                if abs(dz - level - a * dx - b * dy) > _DISTANCE_MM * steepness:
                    continue
                if local[w, 2] <= _ROUGHNESS_MM:
                    p, q = local[w, 0], local[w, 1]
                    if a * p + b * q + 1.0 < MIN_COSINE * steepness * math.sqrt(1.0 + p * p + q * q):
                        continue
                label[w] = count
                queue[tail] = w
                tail += 1
                add_to_sums(s, dx, dy, dz)
                if tail >= 2 * fitted:
                    na, nb, nl, found = solve_plane(s)
                    if found:
                        a, b, level = na, nb, nl
                    fitted = tail
        na, nb, nl, found = solve_plane(s)
        if tail < MIN_POINTS or not found:
            for k in range(tail):
                label[queue[k]] = -1
                # each other seed of a narrow strip would grow it again
                tried[queue[k]] = tail >= MIN_POINTS
            tried[seed] = True
            continue
        planes[count, 0], planes[count, 1] = na, nb
        planes[count, 2] = z[seed] + nl - na * x[seed] - nb * y[seed]
        count += 1
    return label, planes[:count].copy()


@kernel
def fill_patches(vertices: RoofVertices, label: LabelArray, planes: FloatArray) -> int:
    """Add the vertices that no patch took to the adjacent patch with the nearest plane; returns the number of patches.

    All vertices of a round join at once. Vertices that touch no patch become patches without a plane.
    """
    x, y, z, start, others = vertices
    n = x.size
    wanted = np.empty(n, np.int32)
    while True:
        found = 0
        for v in range(n):
            wanted[v] = -1
            if label[v] >= 0:
                continue
            best = 0.0
            for e in range(start[v], start[v + 1]):
                p = label[others[e]]
                if p < 0:
                    continue
                away = abs(z[v] - planes[p, 2] - planes[p, 0] * x[v] - planes[p, 1] * y[v])
                if wanted[v] < 0 or away < best or (away == best and p < wanted[v]):
                    wanted[v] = p
                    best = away
                    found += 1
        if found == 0:
            break
        for v in range(n):
            if wanted[v] >= 0:
                label[v] = wanted[v]
    count = int(planes.shape[0])
    stack = np.empty(n, np.int32)
    for v in range(n):
        if label[v] >= 0:
            continue
        label[v] = count
        stack[0] = v
        top = 1
        while top > 0:
            top -= 1
            u = stack[top]
            for e in range(start[u], start[u + 1]):
                if label[others[e]] < 0:
                    label[others[e]] = count
                    stack[top] = others[e]
                    top += 1
        count += 1
    return count


@kernel
def settle_patches(vertices: RoofVertices, label: LabelArray, planes: FloatArray) -> int:
    """Move vertices to the adjacent patch where they fit best; returns the number of moves.

    A patch that grew first took what lies near its plane, also of the next house. A vertex fits where it lies near the
    plane (half the square of its distance over the noise, at most that of `_DISTANCE_MM`) and beside few vertices of
    other patches (one each, as for a deviation of 1.4 times the noise). Each move lowers the sum, so the moves end.
    """
    x, y, z, start, others = vertices
    n = x.size
    steepness = np.sqrt(1.0 + planes[:, 0] ** 2 + planes[:, 1] ** 2)
    moves = 0
    while True:
        found = 0
        for v in range(n):
            own = label[v]
            if own < 0:
                continue
            at, best = own, np.inf
            for e in range(start[v] - 1, start[v + 1]):
                p = label[others[e]] if e >= start[v] else own
                if p < 0 or (p == own and e >= start[v]):
                    continue
                away = abs(z[v] - planes[p, 2] - planes[p, 0] * x[v] - planes[p, 1] * y[v]) / steepness[p]
                cost = 0.5 * (min(away, _DISTANCE_MM) / _NOISE_MM) ** 2
                for g in range(start[v], start[v + 1]):
                    cost += 0.5 * (label[others[g]] >= 0 and label[others[g]] != p)
                if cost < best - 1e-6:
                    at, best = p, cost
            if at != own:
                label[v] = at
                found += 1
        if found == 0:
            return moves
        moves += found


@kernel
def border_pieces(
    x: IntArray, y: IntArray, facets: LabelArray, neighbours: LabelArray, sound: LabelArray, label: LabelArray, k: int
) -> tuple[LabelArray, FloatArray, FloatArray, FloatArray]:
    """Pieces of border: patches (b, 2), ends in mm (b, 4); and area in mm2 and open outline in mm of each patch.

    In a facet between two patches the border joins the middles of two edges; between three it is a star about the
    centroid.
    """
    is_sound = np.zeros(facets.shape[0], np.bool_)
    is_sound[sound] = True
    pairs = np.empty((3 * sound.size, 2), np.int32)
    ends = np.empty((3 * sound.size, 4))
    area = np.zeros(k)
    outline = np.zeros(k)
    count = 0
    for i in range(sound.size):
        f = sound[i]
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        twice = float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        cut = 0
        for q in range(3):
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            area[label[facets[f, q]]] += twice / 6.0
            cut += label[v] != label[w]
            g = neighbours[f, q]
            if g < 0 or not is_sound[g]:
                half = 0.5 * math.sqrt(float((x[v] - x[w]) ** 2 + (y[v] - y[w]) ** 2))
                outline[label[v]] += half
                outline[label[w]] += half
        if cut == 0:
            continue
        mx, my = (x[a] + x[b] + x[c]) / 3.0, (y[a] + y[b] + y[c]) / 3.0
        if cut == 2:
            # the middles of the two edges that are cut; their common vertex stands alone
            for q in range(3):
                u, v, w = facets[f, q], facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
                if label[v] == label[w]:
                    pairs[count, 0], pairs[count, 1] = min(label[u], label[v]), max(label[u], label[v])
                    ends[count, 0], ends[count, 1] = (x[u] + x[v]) / 2.0, (y[u] + y[v]) / 2.0
                    ends[count, 2], ends[count, 3] = (x[u] + x[w]) / 2.0, (y[u] + y[w]) / 2.0
                    count += 1
        else:
            for q in range(3):
                v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
                pairs[count, 0], pairs[count, 1] = min(label[v], label[w]), max(label[v], label[w])
                ends[count, 0], ends[count, 1] = (x[v] + x[w]) / 2.0, (y[v] + y[w]) / 2.0
                ends[count, 2], ends[count, 3] = mx, my
                count += 1
    return pairs[:count].copy(), ends[:count].copy(), area, outline


@dataclasses.dataclass(frozen=True, kw_only=True)
class GrownPatches:
    """Patches of a roof before they are measured; k of them over n vertices."""

    vertices: RoofVertices
    """The roof's vertices."""
    tin: Tin
    """Their Delaunay TIN."""
    is_sound: BoolArray
    """(m,) whether a facet bridges no gap."""
    half_edge_mm: float
    """Half the median edge of the facets that bridge none."""
    label: LabelArray
    """(n,) int32, patch of every vertex."""
    planes: FloatArray
    """(k, 3) slopes and level at the origin in mm; nan where a patch has no plane."""


def grown_patches(x: IntArray, y: IntArray, z: IntArray, tin: Tin) -> GrownPatches:
    """Planar patches of a roof.

    Vertices (n,) are in millimetres from a place near by, sorted by (x, y), under their Delaunay TIN.
    """
    radii, lengths = facet_sizes(x, y, tin.facets)
    limit = _TYPICAL_RADII * median_of(radii)
    is_sound = radii <= 1000.0 * min(max(limit / 1000.0, _MAX_RADIUS_M / 2.0), _MAX_RADIUS_M)
    sound = np.flatnonzero(is_sound).astype(np.int32)
    half_mm = 0.5 * median_of(lengths[sound].ravel()) if len(sound) else 0.0
    vertices = RoofVertices(x, y, z, *vertex_neighbours(len(x), tin.facets, sound))
    local = local_planes(x, y, z)
    label, planes = grow_patches(vertices, local, np.argsort(local[:, 2], kind="stable"))
    settle_patches(vertices, label, planes)
    count = int(fill_patches(vertices, label, planes))
    planes = np.concatenate((planes, np.full((count - len(planes), 3), np.nan)))
    kept = np.bincount(label, minlength=count) > 0  # some patches lost all their vertices
    label = (np.cumsum(kept, dtype=np.int32) - 1)[label]
    return GrownPatches(
        vertices=vertices, tin=tin, is_sound=is_sound, half_edge_mm=half_mm, label=label, planes=planes[kept]
    )


def measured_patches(grown: GrownPatches, min_step_m: float) -> tuple[Patches, Borders]:
    """Sizes of the patches and the borders between them. Planes closer than `min_step_m` in elevation meet."""
    x, y, z, label, planes, count = *grown.vertices[:3], grown.label, grown.planes, len(grown.planes)
    facets, neighbours = grown.tin.facets, grown.tin.neighbours
    sound, across = (np.flatnonzero(part).astype(np.int32) for part in (grown.is_sound, ~grown.is_sound))
    pairs, ends, area, outline = border_pieces(x, y, facets, neighbours, sound, label, count)
    sums = [np.bincount(label, values / 1000.0, minlength=count) for values in (x, y, z)]
    centres = np.column_stack(sums) / np.maximum(np.bincount(label, minlength=count), 1)[:, None]
    gaps, sights, _, _ = border_pieces(x, y, facets, neighbours, across, label, count)
    within_mm = 1000.0 * min_step_m, grown.half_edge_mm
    borders = _borders(pairs, ends, planes, within_mm, _longest_first(gaps, sights, count))
    outlines = outline / 1000.0
    np.add.at(outlines, borders.first, borders.length_m)
    np.add.at(outlines, borders.second, borders.length_m)
    patches = Patches(
        of_vertex=label,
        slopes=planes[:, :2],
        levels_mm=planes[:, 2],
        areas_m2=area / 1e6,
        centres_m=centres,
        tops_m=_tops(z, label, count),
        outlines_m=outlines,
    )
    return patches, borders


def _tops(z: IntArray, label: LabelArray, count: int) -> FloatArray:
    """Elevation in metres below which nine tenths of the vertices of each patch lie, (k,); none of (n,) is below 0."""
    order = radix_order((label.astype(np.int64) << int(z.max()).bit_length()) | z)
    ends = np.cumsum(np.bincount(label, minlength=count))
    starts = np.concatenate(([0], ends[:-1]))
    return z[order[starts + (9 * (ends - 1 - starts)) // 10]] / 1000.0


def _longest_first(pairs: LabelArray, ends: FloatArray, count: int) -> IntArray:
    """Different pairs of patches, the greatest summed length first; equal ones by their numbers."""
    keys, row = np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1], return_inverse=True)
    lengths = np.bincount(row, np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]), len(keys))
    keys = keys[np.argsort(-lengths, kind="stable")]
    return np.column_stack((keys // count, keys % count))


def _borders(
    pairs: LabelArray, ends: FloatArray, planes: FloatArray, within_mm: tuple[float, float], gap_pairs: IntArray
) -> Borders:
    """Sum up the pieces of each pair. `within_mm` are the least step, and half an edge between two points."""
    count = len(planes)
    middle = (ends[:, :2] + ends[:, 2:]) / 2.0
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    keys, row = np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1], return_inverse=True)
    first, second = (keys // count).astype(np.int32), (keys % count).astype(np.int32)
    whole, xx, xy, yy = _scatter(middle, length, row, len(keys))
    # main axis of a 2 x 2 scatter: half the angle of (xx - yy, 2 xy)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    direction = np.column_stack((np.cos(angle), np.sin(angle)))
    spread = 0.5 * (xx + yy + np.hypot(xx - yy, 2.0 * xy))
    difference = planes[pairs[:, 0]] - planes[pairs[:, 1]]
    step = difference[:, 0] * middle[:, 0] + difference[:, 1] * middle[:, 1] + difference[:, 2]
    level = np.bincount(row, np.where(np.abs(step) < within_mm[0], length, 0.0), minlength=len(keys))
    beside = _beside(step, np.hypot(difference[:, 0], difference[:, 1]), length, row, within_mm[1])
    normal = np.column_stack((planes[:, :2], np.ones(count)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # planes that differ meet in one line, if at all: anywhere else they are level where they just cross
    alike = (normal[first] * normal[second]).sum(axis=1) >= MIN_COSINE
    return Borders(
        first=first,
        second=second,
        length_m=whole / 1000.0,
        extent_m=np.minimum(whole, np.sqrt(12.0 * np.maximum(spread, 0.0))) / 1000.0,
        level_m=np.maximum(beside, np.where(alike, level, 0.0)) / 1000.0,
        direction=direction,
        gap_pairs=gap_pairs,
    )


def _scatter(
    middle: FloatArray, length: FloatArray, row: IntArray, rows: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Length of every border, and the second moments xx, xy, yy of its pieces about their mean."""
    mx, my = middle.T
    moments = 1.0, mx, my, mx * mx, mx * my, my * my
    whole, x, y, xx, xy, yy = (np.bincount(row, length * part, rows).astype(np.float64) for part in moments)
    n = np.maximum(whole, 1e-9)
    return whole, xx / n - (x / n) ** 2, xy / n - x * y / n**2, yy / n - (y / n) ** 2


def _beside(step: FloatArray, slope: FloatArray, length: FloatArray, row: IntArray, half_edge_mm: float) -> FloatArray:
    """Length of every border that runs along the line in which its planes intersect.

    A border is drawn through the middles of edges: up to half an edge to either side of a line beside the fold. A
    gutter or the tiles of a ridge can lie between that line and the fold. Where planes only cross, at a party wall, the
    border leaves any such line.
    """
    rows = int(row.max(initial=-1)) + 1
    near = np.abs(step) < _MAX_BESIDE_MM * slope
    away = np.divide(step, slope, out=np.zeros_like(step), where=near)
    mean = np.bincount(row, length * away, minlength=rows) / np.maximum(np.bincount(row, length * near, rows), 1e-9)
    is_beside = near & (np.abs(away - mean[row]) <= half_edge_mm)
    return np.bincount(row, np.where(is_beside, length, 0.0), rows).astype(np.float64)


def cosine(one: FloatArray, other: FloatArray) -> float:
    """Cosine of the angle between unit normals (3,); written out, since a matrix product differs between machines."""
    return float(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def has_directions(normals: FloatArray) -> bool:
    """Whether the normals (k, 3) have as many directions as a curve has, the least turn apart or more."""
    kept: list[FloatArray] = []
    for normal in normals[np.isfinite(normals).all(axis=1)]:
        if all(cosine(normal, other) <= MIN_TURN for other in kept):
            kept.append(normal)
            if len(kept) == _DIRECTIONS:
                return True
    return False
