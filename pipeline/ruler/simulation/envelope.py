"""The exact upper envelope of convex parts: which face of which part is on top where.

A part is a convex plan polygon under a concave roof, the lowest of some planes. A face is visible in the convex region
where its plane is the lowest of its part, except where another part is higher. Those regions are convex too: inside the
outline of the other part, under each of its planes. So half-plane clipping finds all borders. Corners that agree within
some micrometres become one node, nodes are inserted into the edges that they lie on, and regions of one plane are
joined. Finally each node moves to the exact crossing of the lines that meet in it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import FloatArray, IntArray
from pipeline.ruler.simulation.roof_dimensions import FaceRings, RoofFaces

GRID_M = 1e-6
"""Grid of the clipped regions, whose vertices are exact again afterwards. Smaller regions are dropped."""

_SAME = 1e-9
"""Numerical guard: planes whose coefficients differ by less are one."""
_NEAR_M = 5e-6
"""Numerical guard: corners that are closer are one node."""

Place = tuple[float, float]
Line = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPart:
    """A convex plan polygon under the lowest of some planes."""

    outline: tuple[Place, ...]
    """Counter-clockwise, metres."""
    planes: tuple[Line, ...]
    """Coefficients a, b, c of heights a u + b v + c."""
    labels: tuple[str, ...]
    """Group of each plane: faces with one label are one group, and one face if their planes agree too."""


def envelope(parts: Sequence[RoofPart]) -> RoofFaces:
    """The faces that are visible from above; of two parts of equal height, the first one. ValueError without any area.

    They are in the order of parts and planes. Faces share vertices where they meet at one height, and have vertices of
    their own where one stands over the other; every vertex on an edge is a vertex of the faces on both sides.
    """
    regions = _visible_regions(parts)
    if not regions:
        raise ValueError("a roof needs at least one part with an area")
    planes = _distinct_planes(parts)
    owned: dict[tuple[str, int], list[shapely.Polygon]] = {}
    owners: dict[tuple[str, int], tuple[int, int]] = {}
    for (part, plane), polygon in _noded(regions):
        key = parts[part].labels[plane], planes[part][plane]
        owned.setdefault(key, []).append(polygon)
        owners.setdefault(key, (part, plane))
    polygons: list[shapely.Polygon] = []
    faces: list[tuple[str, Line]] = []
    for key, pieces in owned.items():
        joined = shapely.get_parts(shapely.normalize(shapely.coverage_union_all(pieces)))
        part, plane = owners[key]
        for polygon in sorted(joined, key=lambda polygon: polygon.bounds):
            polygons.append(polygon)
            faces.append((key[0], parts[part].planes[plane]))
    return _faces(polygons, faces, [line for part in parts for line in _sides(part)])


def _clipped(polygon: list[Place], line: Line) -> list[Place]:
    """The part of a convex polygon where a x + b y + c >= 0 (Sutherland and Hodgman)."""
    a, b, c = line
    kept: list[Place] = []
    for k, (x2, y2) in enumerate(polygon):
        x1, y1 = polygon[k - 1]
        before, here = a * x1 + b * y1 + c, a * x2 + b * y2 + c
        if (before < 0.0) != (here < 0.0):
            share = before / (before - here)
            kept.append((x1 + share * (x2 - x1), y1 + share * (y2 - y1)))
        if here >= 0.0:
            kept.append((x2, y2))
    return kept


def _area(polygon: list[Place]) -> float:
    """Area of a counter-clockwise polygon."""
    return 0.5 * sum(polygon[k - 1][0] * y - x * polygon[k - 1][1] for k, (x, y) in enumerate(polygon))


def _cleaned(polygon: list[Place]) -> shapely.Polygon:
    """Without corners that clipping made twice."""
    corners = [place for k, place in enumerate(polygon) if math.dist(place, polygon[k - 1]) > 0.1 * GRID_M]
    return shapely.Polygon(corners)


def _above(upper: Line, lower: Line) -> Line | None:
    """The half-plane where a plane is above another; None if they are the same."""
    a, b, c = upper[0] - lower[0], upper[1] - lower[1], upper[2] - lower[2]
    return None if max(abs(a), abs(b), abs(c)) < _SAME else (a, b, c)


def _under_all(polygon: list[Place], lower: Line, planes: Sequence[Line], wins_ties: Sequence[bool]) -> list[Place]:
    """Where all planes are above the lower one; the same plane counts as above where the flag says so."""
    for plane, wins in zip(planes, wins_ties, strict=True):
        line = _above(plane, lower)
        if line is None:
            if not wins:
                return []
            continue
        polygon = _clipped(polygon, line)
        if len(polygon) < 3:
            return []
    return polygon


def _sides(part: RoofPart) -> list[Line]:
    """Lines of its outline: unit normal to the inside, offset."""
    lines = []
    for k, (x2, y2) in enumerate(part.outline):
        x1, y1 = part.outline[k - 1]
        length = math.hypot(x2 - x1, y2 - y1)
        a, b = (y1 - y2) / length, (x2 - x1) / length
        lines.append((a, b, -a * x1 - b * y1))
    return lines


def _visible_regions(parts: Sequence[RoofPart]) -> list[tuple[tuple[int, int], shapely.Polygon]]:
    """The visible regions of every plane of every part, with the numbers of part and plane."""
    visible = []
    sides = [_sides(part) for part in parts]
    boxes = [(*np.min(part.outline, axis=0), *np.max(part.outline, axis=0)) for part in parts]
    for i, part in enumerate(parts):
        near = [
            j
            for j in range(len(parts))
            if j != i
            and boxes[i][0] <= boxes[j][2]
            and boxes[j][0] <= boxes[i][2]
            and boxes[i][1] <= boxes[j][3]
            and boxes[j][1] <= boxes[i][3]
        ]
        for k, plane in enumerate(part.planes):
            others = [line for n, line in enumerate(part.planes) if n != k]
            own = _under_all(list(part.outline), plane, others, [n > k for n in range(len(part.planes)) if n != k])
            if len(own) < 3 or _area(own) < GRID_M:
                continue
            hidden = []
            for j in near:
                under = own
                for line in sides[j]:
                    under = _clipped(under, line)
                under = _under_all(under, plane, parts[j].planes, [j < i] * len(parts[j].planes))
                if len(under) > 2 and _area(under) > GRID_M:
                    hidden.append(_cleaned(under))
            region = _cleaned(own)
            if hidden:
                region = shapely.difference(region, shapely.union_all(hidden, grid_size=GRID_M), grid_size=GRID_M)
            visible += [((i, k), piece) for piece in shapely.get_parts(region) if piece.area > GRID_M * piece.length]
    return visible


def _noded(regions: list[tuple[tuple[int, int], shapely.Polygon]]) -> list[tuple[tuple[int, int], shapely.Polygon]]:
    """The regions with common nodes: corners within `_NEAR_M` are one, and stand in all edges that pass so near."""
    rings = [
        [shapely.get_coordinates(line)[:-1] for line in (polygon.exterior, *polygon.interiors)]
        for _, polygon in regions
    ]
    corners = np.concatenate([ring for face in rings for ring in face])
    near = np.hypot(*(corners[:, None] - corners[None]).T) < _NEAR_M
    first = np.argmax(near, axis=0)
    node_of = first[first]
    nodes = np.unique(node_of)
    noded = []
    at = 0
    for (owner, _), face in zip(regions, rings, strict=True):
        found: list[FloatArray] = []
        for ring in face:
            numbers = _with_nodes_between(node_of[at : at + len(ring)], nodes, corners)
            at += len(ring)
            if len(numbers) > 2:
                found.append(corners[numbers])
            elif not found:
                break
        if found:
            noded.append((owner, shapely.Polygon(found[0], found[1:])))
    return noded


def _with_nodes_between(ring: IntArray, nodes: IntArray, places: FloatArray) -> list[int]:
    """The ring with all nodes that lie on its edges, without nodes twice in a row and without spikes."""
    start, end = places[ring], places[np.roll(ring, -1)]
    edge = end - start
    length = np.maximum(np.hypot(edge[:, 0], edge[:, 1]), GRID_M)[:, None]
    off_x, off_y = (places[nodes, k][None] - start[:, k, None] for k in range(2))
    along = (off_x * edge[:, :1] + off_y * edge[:, 1:]) / length
    aside = np.abs(off_x * edge[:, 1:] - off_y * edge[:, :1]) / length
    between = (aside < _NEAR_M) & (along > _NEAR_M) & (along < length - _NEAR_M)
    longer: list[int] = []
    for k, node in enumerate(ring):
        passed = np.flatnonzero(between[k])
        longer.append(int(node))
        longer += nodes[passed[np.argsort(along[k, passed])]].tolist()
    clean: list[int] = []
    for node in longer:
        if clean and clean[-1] == node:
            continue
        if len(clean) > 1 and clean[-2] == node:
            clean.pop()
        else:
            clean.append(node)
    while len(clean) > 2 and (clean[0] == clean[-1] or clean[1] == clean[-1] or clean[0] == clean[-2]):
        if clean[1] == clean[-1]:
            clean.pop(0)
        else:
            clean.pop()
    return clean


def _distinct_planes(parts: Sequence[RoofPart]) -> list[list[int]]:
    """A number for every plane of every part: that of the first equal one."""
    known: list[Line] = []
    numbers = []
    for part in parts:
        row = []
        for plane in part.planes:
            same = next((n for n, other in enumerate(known) if _above(plane, other) is None), len(known))
            if same == len(known):
                known.append(plane)
            row.append(same)
        numbers.append(row)
    return numbers


@dataclasses.dataclass
class _Drawing:
    """Faces in plan: nodes, rings of node numbers, and the face to the left of every directed edge."""

    nodes: list[Place]
    rings: list[list[list[int]]]
    left: dict[tuple[int, int], int]


def _drawing(polygons: Sequence[shapely.Polygon]) -> _Drawing:
    """Number the nodes of polygons that share their vertices; leave out nodes in the middle of straight edges."""
    nodes: list[Place] = []
    number: dict[tuple[int, int], int] = {}
    rings: list[list[list[int]]] = []
    around: dict[int, set[int]] = {}
    for polygon in shapely.orient_polygons(np.array(polygons)):
        rings.append([])
        for line in (polygon.exterior, *polygon.interiors):
            ring = []
            for x, y in shapely.get_coordinates(line)[:-1].tolist():
                node = number.setdefault((round(x / GRID_M), round(y / GRID_M)), len(nodes))
                if node == len(nodes):
                    nodes.append((x, y))
                ring.append(node)
            for k, node in enumerate(ring):
                around.setdefault(node, set()).add(ring[k - 1])
                around.setdefault(ring[k - 1], set()).add(node)
            rings[-1].append(ring)
    straight = {node for node, others in around.items() if len(others) == 2 and _is_between(nodes, node, *others)}
    rings = [[[node for node in ring if node not in straight] for ring in face] for face in rings]
    left = {(ring[k - 1], node): face for face, own in enumerate(rings) for ring in own for k, node in enumerate(ring)}
    return _Drawing(nodes=nodes, rings=rings, left=left)


def _is_between(nodes: list[Place], node: int, before: int, after: int) -> bool:
    """Whether a node lies on the straight line between two others."""
    (x, y), (x1, y1), (x2, y2) = nodes[node], nodes[before], nodes[after]
    cross = (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)
    return abs(cross) < _NEAR_M * math.hypot(x2 - x1, y2 - y1)


def _distance(line: Line, place: Place) -> float:
    return abs(line[0] * place[0] + line[1] * place[1] + line[2])


def _exact_nodes(drawing: _Drawing, faces: Sequence[tuple[str, Line]], outlines: Sequence[Line]) -> list[Place]:
    """Every node at the crossing of the exact lines that its edges lie on: outlines, and where two planes cross."""
    meeting: dict[int, list[Line]] = {}
    for (start, end), face in drawing.left.items():
        ends = drawing.nodes[start], drawing.nodes[end]
        lines = [line for line in outlines if max(_distance(line, place) for place in ends) < _NEAR_M]
        other = drawing.left.get((end, start))
        crossing = None if other is None else _above(faces[face][1], faces[other][1])
        if crossing is not None:
            steep = math.hypot(crossing[0], crossing[1])
            if steep > 1e-3:
                line = crossing[0] / steep, crossing[1] / steep, crossing[2] / steep
                if max(_distance(line, place) for place in ends) < _NEAR_M:
                    lines.append(line)
        for node in (start, end):
            meeting.setdefault(node, []).extend(lines)
    exact = list(drawing.nodes)
    for node, lines in meeting.items():
        # Least squares for the shift from the node; sums in fixed order, so the same bits everywhere.
        x, y = drawing.nodes[node]
        aa = sum(a * a for a, _, _ in lines)
        ab = sum(a * b for a, b, _ in lines)
        bb = sum(b * b for _, b, _ in lines)
        ar = sum(a * (a * x + b * y + c) for a, b, c in lines)
        br = sum(b * (a * x + b * y + c) for a, b, c in lines)
        determinant = aa * bb - ab * ab
        if determinant > 1e-6:
            exact[node] = x - (bb * ar - ab * br) / determinant, y - (aa * br - ab * ar) / determinant
    return exact


def _faces(
    polygons: Sequence[shapely.Polygon], faces: Sequence[tuple[str, Line]], outlines: Sequence[Line]
) -> RoofFaces:
    """Lift the polygons to their planes; corners of one node and one height are one vertex."""
    drawing = _drawing(polygons)
    exact = _exact_nodes(drawing, faces, outlines)
    vertices: list[tuple[float, float, float]] = []
    over: dict[int, list[int]] = {}

    def vertex(node: int, plane: Line) -> int:
        x, y = exact[node]
        z = plane[0] * x + plane[1] * y + plane[2]
        for known in over.setdefault(node, []):
            if abs(vertices[known][2] - z) < GRID_M:
                return known
        over[node].append(len(vertices))
        vertices.append((x, y, z))
        return len(vertices) - 1

    rings: list[FaceRings] = []
    for own, (_, plane) in zip(drawing.rings, faces, strict=True):
        rings.append(tuple(tuple(vertex(node, plane) for node in ring) for ring in own))
    labels = list(dict.fromkeys(label for label, _ in faces))
    array: FloatArray = np.array(vertices, dtype=np.float64)
    return RoofFaces(vertices=array, faces=tuple(rings), groups=tuple(labels.index(label) for label, _ in faces))
