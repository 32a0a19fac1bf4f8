"""LoD2.3 from LoD2.2: the same roof faces at the eaves, walls at the wall outline, and undersides between the two.

The plan within the eaves is cut into cells by the borders of the roof faces and the wall outline. Over each cell the
building is one interval of heights: from the floor to the roof inside the walls, from the underside to the roof outside
them. The underside is parallel to the roof, lower by a thickness that is assumed and not measured: a solid cannot have
an overhang of no thickness. Walls separate two neighbouring cells wherever their intervals differ. So a wall ends at
the underside, an eave has a fascia as high as the thickness, and a step between two roof faces continues over the
overhang.

As in `pipeline.roof.solid`, a vertical line through a plan vertex has one solid vertex per level, and walls take up all
levels on their way: every edge of the solid belongs to exactly two faces.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.kernels.union_find import united
from pipeline.model import FaceKind, IntArray, NoOverhang, Plane, Reason, Solid, SolidFace
from pipeline.roof.extrusion import MIN_SPAN_MM, SAME_HEIGHT_MM
from pipeline.roof.footprint import polygons_of
from pipeline.roof.solid import SolidPart


class _Form(NamedTuple):
    """One way to draw the same overhangs, in millimetres."""

    snap_mm: float
    """How far the wall outline may move to a border or vertex of the roof."""
    thicker_mm: int
    """Added to the thickness: undersides may otherwise touch a roof along an edge."""
    unite_mm: float
    """How near a new vertex of the plan is to another that takes its place."""


_FORMS = (
    _Form(snap_mm=10.0, thicker_mm=0, unite_mm=2.0),
    _Form(snap_mm=10.0, thicker_mm=7, unite_mm=2.0),
    _Form(snap_mm=30.0, thicker_mm=0, unite_mm=5.0),
    _Form(snap_mm=30.0, thicker_mm=-7, unite_mm=10.0),
    _Form(snap_mm=100.0, thicker_mm=7, unite_mm=10.0),
)
"""Tried from the most exact on; the first whose solid is valid is delivered. 7 mm exceed
`SAME_HEIGHT_MM`, within which heights are one."""
_STRIP_HALF_WIDTH_MM = 20.0
"""Half the width of strips between eaves and walls that are not overhangs: outlines are simplified by as much."""
_MIN_VERTEX_DISTANCE_MM = 2.0
"""Vertices of the plan are at least this far apart, so that no reader takes two for one."""
_STRAIGHT_MM = 1.5
"""A vertex this near to the line between its neighbours is idle: rounding to 1 mm moves a point on it as far."""

XY = tuple[int, int]
Edge = tuple[int, int]
Ring = list[int]


class UndrawableError(Exception):
    """The overhangs of a building cannot be drawn; `reason` says why."""

    def __init__(self, reason: NoOverhang, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


def overhanging_solids(
    parts: Sequence[SolidPart],
    planes: Sequence[Plane],
    walls_mm: MultiPolygon,
    thickness_m: float,
    lowest_m: float,
    is_sound: Callable[[Solid], bool],
) -> list[Solid]:
    """One closed solid with overhangs for each part of a building in LoD2.2; a part without overhangs stays as it is.

    Parameters
    ----------
    parts : sequence of SolidPart
        Their roof faces number `planes`.
    walls_mm : MultiPolygon
        Outline of the walls in integer millimetres; what lies outside the parts does not matter.
    thickness_m : float
        Vertical distance between roof and underside.
    lowest_m : float
        Where an underside would come lower than this, local metres, the wall goes to the eaves.
    is_sound : callable
        Judges a solid.

    Raises
    ------
    UndrawableError
        With `walls_break` if the walls are the eaves, `invalid_solid` if no form of a part is sound, `too_low` if no
        part has an underside above `lowest_m`.
    """
    plan = shapely.transform(np.array([part.footprint for part in parts], object), lambda xy: np.rint(xy * 1e3))
    if shapely.is_empty(shapely.buffer(shapely.difference(plan, walls_mm), -_STRIP_HALF_WIDTH_MM)).all():
        raise UndrawableError(NoOverhang.WALLS_BREAK, "the outline breaks where it is drawn back to the walls")
    solids = []
    hangs = False
    for part in parts:
        solid = _sound_solid(part, planes, walls_mm, round(thickness_m * 1e3), round(lowest_m * 1e3), is_sound)
        hangs = hangs or solid is not part.solid
        solids.append(solid)
    if not hangs:
        raise UndrawableError(NoOverhang.TOO_LOW, f"no underside lies higher than {lowest_m:.3f} m")
    return solids


def floor_m2(solid: Solid) -> float:
    """Area of a solid's floors."""
    rings = [
        solid.vertices[list(ring), :2] for face in solid.faces if face.kind is FaceKind.GROUND for ring in face.rings
    ]
    # a floor's outer ring runs clockwise in plan, its holes the other way
    return math.fsum(
        -0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) for x, y in (ring.T for ring in rings)
    )


def _sound_solid(
    part: SolidPart,
    planes: Sequence[Plane],
    walls_mm: MultiPolygon,
    thickness_mm: int,
    lowest_mm: int,
    is_sound: Callable[[Solid], bool],
) -> Solid:
    """The first sound form of one part."""
    faults: list[str] = []
    for form in _FORMS:
        try:
            drawn = _Overhangs(part, planes, thickness_mm + form.thicker_mm)
            drawn.cut(walls_mm, form.snap_mm, form.unite_mm)
            solid = drawn.solid(lowest_mm)
        except (BuildingError, shapely.errors.GEOSException) as error:
            faults.append(str(error))
            continue
        if solid is part.solid or is_sound(solid):
            return solid
        faults.append("not valid")
    raise UndrawableError(
        NoOverhang.INVALID_SOLID, f"no form of the overhangs is valid: {'; '.join(sorted({*faults}))}"
    )


def _fault(detail: str) -> BuildingError:
    return BuildingError(Reason.NO_PARTITION, detail)


@dataclasses.dataclass(frozen=True)
class _Cell:
    """A piece of the plan with one roof face above it."""

    face: int
    """Number of the roof face in its part."""
    rings: tuple[Ring, ...]
    """Plan vertices: the outer ring counter-clockwise, holes clockwise."""


class _Overhangs:
    """One part while it is drawn."""

    def __init__(self, part: SolidPart, planes: Sequence[Plane], thickness_mm: int) -> None:
        self._part = part
        self._thickness_mm = thickness_mm
        self._planes = [planes[face.plane] for face in part.faces]
        self._floor_mm = round(float(part.solid.vertices[:, 2].min()) * 1e3)
        self._xy: list[XY] = []
        self._number: dict[XY, int] = {}
        self._faces: list[list[Ring]] = []
        """Rings of the roof faces as plan vertices."""
        self._top: list[dict[int, float]] = []
        """Height of each roof face over plan vertices, mm."""
        self._take_faces()
        self._count = len(self._xy)
        """Plan vertices of LoD2.2."""
        self._cells: list[_Cell] = []
        self._is_inside: list[bool] = []

    def _vertex(self, xy: XY) -> int:
        vertex = self._number.setdefault(xy, len(self._xy))
        if vertex == len(self._xy):
            self._xy.append(xy)
        return vertex

    def _take_faces(self) -> None:
        """Plan vertices and heights of the roof faces, as they are in LoD2.2."""
        for face in self._part.faces:
            polygon = shapely.orient_polygons(face.polygon)
            top: dict[int, float] = {}
            rings: list[Ring] = []
            for line in (polygon.exterior, *polygon.interiors):
                corners = np.rint(shapely.get_coordinates(line, include_z=True)[:-1] * 1e3).astype(np.int64).tolist()
                ring = [self._vertex((x, y)) for x, y, _ in corners]
                top.update(zip(ring, (float(z) for _, _, z in corners), strict=True))
                rings.append(ring)
            self._faces.append(rings)
            self._top.append(top)

    def _polygon(self, rings: Sequence[Ring]) -> Polygon:
        outer, *holes = ([self._xy[v] for v in ring] for ring in rings)
        return Polygon(outer, holes)

    def cut(self, walls_mm: MultiPolygon, snap_mm: float, unite_mm: float) -> None:
        """Cut the roof faces along the wall outline into cells."""
        roof = [self._polygon(rings) for rings in self._faces]
        borders = shapely.MultiLineString(shapely.get_rings(roof).tolist())
        walls = _snapped(walls_mm, borders, snap_mm)
        lines = united_lines(shapely.union(borders, walls.boundary, grid_size=1.0), self._xy, unite_mm)
        shapely.prepare(walls)
        tree = shapely.STRtree(roof)
        for polygon in polygons_of(shapely.polygonize([lines])):
            place = shapely.point_on_surface(polygon)
            over = tree.query(place, predicate="within").tolist()
            if not over:
                continue  # a courtyard
            oriented = shapely.orient_polygons(polygon)
            rings = []
            for line in (oriented.exterior, *oriented.interiors):
                corners = np.rint(shapely.get_coordinates(line)[:-1]).astype(np.int64).tolist()
                rings.append([self._vertex((x, y)) for x, y in corners])
            self._cells.append(_Cell(min(over), tuple(rings)))
            self._is_inside.append(bool(shapely.intersects(walls, place)))
        if _closest(self._xy, self._count) < _MIN_VERTEX_DISTANCE_MM:
            raise _fault("vertices of walls and roof are too close to one another")
        self._find_tops()

    def _edges(self) -> dict[Edge, int]:
        """Cell to the left of every directed edge."""
        edges: dict[Edge, int] = {}
        for number, cell in enumerate(self._cells):
            for ring in cell.rings:
                for edge in _edges_of(ring):
                    if edge in edges:
                        raise _fault(f"two cells overlap at {self._xy[edge[0]]} mm")
                    edges[edge] = number
        return edges

    def _find_tops(self) -> None:
        """Heights of the roof faces over the new plan vertices; their rings with those on their borders.

        On a border a height is between those of the border's ends, so that two faces meet there as they do in LoD2.2.
        """
        edges = self._edges()
        for face, rings in enumerate(self._faces):
            following: dict[int, list[int]] = {}
            for (a, b), cell in edges.items():
                other = edges.get((b, a), -1)
                if self._cells[cell].face == face and (other < 0 or self._cells[other].face != face):
                    following.setdefault(a, []).append(b)
            top = self._top[face]
            for k, ring in enumerate(rings):
                longer: Ring = []
                for a, b in _edges_of(ring):
                    between = self._chain(a, b, following)
                    for v in between:
                        share = math.dist(self._xy[a], self._xy[v]) / math.dist(self._xy[a], self._xy[b])
                        top[v] = top[a] + share * (top[b] - top[a])
                    longer += [a, *between]
                rings[k] = longer
        for own in self._cells:
            top, plane = self._top[own.face], self._planes[own.face]
            for v in itertools.chain.from_iterable(own.rings):
                if v not in top:
                    top[v] = _height_mm(plane, self._xy[v])

    def _chain(self, a: int, b: int, following: dict[int, list[int]]) -> Ring:
        """The new vertices on the border of a face from one of its own vertices to the next."""
        chain: Ring = []
        at = a
        while True:
            ways = following.get(at, [])
            if b in ways:
                return chain
            ways = [v for v in ways if v >= self._count]
            if len(ways) != 1 or len(chain) > len(self._xy):
                raise _fault(f"the border of a roof face is lost at {self._xy[at]} mm")
            at = ways[0]
            chain.append(at)

    def _interval(self, cell: int, v: int) -> tuple[float, float]:
        """From where to where the building goes over a plan vertex of a cell, mm."""
        top = self._top[self._cells[cell].face][v]
        return float(self._floor_mm) if self._is_inside[cell] else top - self._thickness_mm, top

    def _stand_on_floor(self, lowest_mm: int) -> None:
        """Take overhangs as inside the walls that are too low, hang on no walls, or keep the part from being one."""
        for number, own in enumerate(self._cells):
            if not self._is_inside[number]:
                low = min(self._interval(number, v)[0] for v in itertools.chain.from_iterable(own.rings))
                self._is_inside[number] = low < lowest_mm
        edges = self._edges()
        pairs = [(a, b, one, edges[b, a]) for (a, b), one in edges.items() if a < b and (b, a) in edges]
        groups = self._groups(pairs)
        standing = {group for group, inside in zip(groups, self._is_inside, strict=True) if inside}
        self._is_inside = [i or group not in standing for group, i in zip(groups, self._is_inside, strict=True)]
        while len({*(groups := self._groups(pairs))}) > 1:
            apart = {cell for _, _, *both in pairs if groups[both[0]] != groups[both[1]] for cell in both}
            if all(self._is_inside[cell] for cell in apart):
                return
            self._is_inside = [i or cell in apart for cell, i in enumerate(self._is_inside)]

    def _groups(self, pairs: Sequence[tuple[int, int, int, int]]) -> list[int]:
        """The group of each cell: cells that share an edge and heights over it are in one."""
        joined = [(one, other) for a, b, one, other in pairs if self._meet(one, other, a, b)]
        left, right = np.array(joined, np.int64).reshape(-1, 2).T
        groups: list[int] = united(len(self._cells), left, right).tolist()
        return groups

    def _meet(self, one: int, other: int, a: int, b: int) -> bool:
        """Whether two cells have heights in common over an edge between them."""
        return max(self._common(one, other, v) for v in (a, b)) > SAME_HEIGHT_MM

    def _common(self, one: int, other: int, v: int) -> float:
        """How much of their heights two cells have in common over a plan vertex, mm."""
        (bottom, top), (other_bottom, other_top) = self._interval(one, v), self._interval(other, v)
        return min(top, other_top) - max(bottom, other_bottom)

    def _insert_crossings(self) -> dict[Edge, int]:
        """Give every edge a vertex where roof and underside of its sides meet; the edges afterwards."""
        edges = self._edges()
        inserted: dict[Edge, Ring] = {}
        for (a, b), one in edges.items():
            other = edges.get((b, a), -1)
            if a > b or other < 0 or self._cells[one].face == self._cells[other].face:
                continue
            at_a, at_b = ((self._interval(one, v), self._interval(other, v)) for v in (a, b))
            shares = []
            for mine, theirs in ((0, 1), (1, 0)):
                over_a, over_b = at_a[0][mine] - at_a[1][theirs], at_b[0][mine] - at_b[1][theirs]
                if over_a * over_b < 0.0 and min(abs(over_a), abs(over_b)) > SAME_HEIGHT_MM:
                    shares.append(over_a / (over_a - over_b))
            new: Ring = []
            (xa, ya), (xb, yb) = self._xy[a], self._xy[b]
            steps = itertools.pairwise((0.0, *sorted(shares), 1.0))
            if shares and min(end - start for start, end in steps) * math.dist((xa, ya), (xb, yb)) < MIN_SPAN_MM:
                raise _fault("roof and underside meet next to a vertex")
            for share in sorted(shares):
                v = self._vertex((round(xa + share * (xb - xa)), round(ya + share * (yb - ya))))
                for cell in (one, other):
                    top = self._top[self._cells[cell].face]
                    top[v] = top[a] + share * (top[b] - top[a])
                new.append(v)
            if new:
                inserted[a, b], inserted[b, a] = new, new[::-1]
        if not inserted:
            return edges
        self._cells = [
            dataclasses.replace(cell, rings=tuple(_with_vertices(ring, inserted) for ring in cell.rings))
            for cell in self._cells
        ]
        self._faces = [[_with_vertices(ring, inserted) for ring in rings] for rings in self._faces]
        return self._edges()

    def solid(self, lowest_mm: int) -> Solid:
        """The closed solid, not yet judged; that of LoD2.2 where no cell is outside the walls."""
        self._stand_on_floor(lowest_mm)
        while True:
            if all(self._is_inside):
                return self._part.solid
            edges = self._insert_crossings()
            cells_at: dict[int, set[int]] = {}
            for (a, _), cell in edges.items():
                cells_at.setdefault(a, set()).add(cell)
            levels = _Levels(self._xy)
            for v in sorted(cells_at):
                levels.stack(v, {cell: self._interval(cell, v) for cell in cells_at[v]})
            faces = [*self._boundary(levels, edges), *self._floors(levels, edges)]
            if not self._stand_at(_crossed(faces, levels.points), cells_at):
                return self._compact(levels.points, faces)

    def _stand_at(self, places: set[XY], cells_at: dict[int, set[int]]) -> bool:
        """Take the highest overhang at each of some plan vertices as inside the walls; whether there was one.

        There two overhangs of one height touch along an upright line, between a higher and a lower one.
        """
        changed = False
        for v in sorted(self._number[xy] for xy in places):
            hanging = [cell for cell in sorted(cells_at[v]) if not self._is_inside[cell]]
            if hanging:
                self._is_inside[max(hanging, key=lambda cell: self._interval(cell, v))] = changed = True
        return changed

    def _boundary(self, levels: _Levels, edges: dict[Edge, int]) -> list[SolidFace]:
        """Roofs, walls and undersides."""
        faces: list[SolidFace] = []
        owner = {(self._cells[cell].face, a): cell for (a, _), cell in sorted(edges.items())}
        for face, rings in enumerate(self._faces):
            solid_rings = tuple(tuple(levels.top(v, owner[face, v]) for v in ring) for ring in rings)
            faces.append(SolidFace(rings=solid_rings, kind=FaceKind.ROOF, plane=self._part.faces[face].plane))
        for (a, b), cell in sorted(edges.items()):
            faces += [SolidFace(rings=(ring,), kind=FaceKind.WALL) for ring in levels.walls(a, b, cell, edges)]
        for number, cell_of in enumerate(self._cells):
            if not self._is_inside[number]:
                under = tuple(tuple(levels.bottom(v, number) for v in ring[::-1]) for ring in cell_of.rings)
                faces.append(SolidFace(rings=under, kind=FaceKind.CEILING))
        return faces

    def _floors(self, levels: _Levels, edges: dict[Edge, int]) -> list[SolidFace]:
        """One floor for every group of cells inside the walls that are connected."""
        inside = {edge: cell for edge, cell in edges.items() if self._is_inside[cell]}
        pairs = np.array([(c, inside[b, a]) for (a, b), c in inside.items() if (b, a) in inside], np.int64).reshape(
            -1, 2
        )
        groups = united(len(self._cells), pairs[:, 0], pairs[:, 1]).tolist()
        below: dict[int, dict[int, int]] = {}
        cell_at: dict[int, int] = {}
        for (a, b), cell in sorted(inside.items()):
            cell_at[a] = cell
            if (b, a) in inside:
                continue
            ring = below.setdefault(groups[cell], {})
            if b in ring:
                raise _fault(f"the wall outline touches itself at {self._xy[b]} mm")
            ring[b] = a
        floors = []
        for _, following in sorted(below.items()):
            rings = _trace(following, self._xy)
            solid_rings = tuple(tuple(levels.bottom(v, cell_at[v]) for v in ring) for ring in rings)
            floors.append(SolidFace(rings=solid_rings, kind=FaceKind.GROUND))
        return floors

    def _compact(self, points: Sequence[tuple[int, int, int]], faces: Sequence[SolidFace]) -> Solid:
        """The solid without vertices that no face uses, and without new ones amid a straight edge of two faces."""
        beside: dict[int, list[Edge]] = {}
        for face in faces:
            for ring in face.rings:
                for k, v in enumerate(ring):
                    beside.setdefault(v, []).append((ring[k - 1], ring[(k + 1) % len(ring)]))
        own = set(self._xy[: self._count])
        idle = {
            v
            for v, pairs in beside.items()
            if len(pairs) == 2
            and points[v][:2] not in own
            and pairs[0] == pairs[1][::-1]
            and _is_straight(points[pairs[0][0]], points[v], points[pairs[0][1]])
        }
        used = [v for v in sorted(beside) if v not in idle]
        number = {v: k for k, v in enumerate(used)}
        return Solid(
            vertices=np.array([points[v] for v in used], np.float64) / 1e3,
            faces=tuple(
                dataclasses.replace(
                    face, rings=tuple(tuple(number[v] for v in ring if v not in idle) for ring in face.rings)
                )
                for face in faces
            ),
        )


class _Levels:
    """Solid vertices on the vertical lines through the plan vertices."""

    def __init__(self, xy: Sequence[XY]) -> None:
        self.points: list[tuple[int, int, int]] = []
        self._xy = xy
        self._line: dict[int, list[int]] = {}
        self._ranks: dict[Edge, tuple[int, int]] = {}
        """(plan vertex, cell) to the places of its bottom and its top in the line."""

    def stack(self, v: int, intervals: dict[int, tuple[float, float]]) -> None:
        """Make the solid vertices over a plan vertex; heights nearer than 2 mm are one."""
        line: list[int] = []
        level = 0
        ends: dict[tuple[int, bool], int] = {}
        heights = [
            (z, cell, is_top) for cell, pair in intervals.items() for z, is_top in zip(pair, (False, True), strict=True)
        ]
        for height, cell, is_top in sorted(heights):
            z = round(height)
            if not line or z - level >= SAME_HEIGHT_MM:
                level = z
                line.append(len(self.points))
                self.points.append((*self._xy[v], z))
            ends[cell, is_top] = len(line) - 1
        self._line[v] = line
        for cell in intervals:
            self._ranks[v, cell] = ends[cell, False], ends[cell, True]

    def bottom(self, v: int, cell: int) -> int:
        """Solid vertex of a cell's floor or underside."""
        return self._line[v][self._ranks[v, cell][0]]

    def top(self, v: int, cell: int) -> int:
        """Solid vertex of a cell's roof."""
        return self._line[v][self._ranks[v, cell][1]]

    def walls(self, a: int, b: int, cell: int, edges: dict[Edge, int]) -> list[tuple[int, ...]]:
        """Rings of the walls of a cell along one of its edges: what it has without its neighbour, seen from there."""
        other = edges.get((b, a), -1)
        mine = self._ranks[a, cell], self._ranks[b, cell]
        if other < 0:
            spans = [tuple(mine)]
        else:
            theirs = self._ranks[a, other], self._ranks[b, other]
            pairs = list(zip(mine, theirs, strict=True))
            spans = [
                tuple((bottom, min(top, other_bottom)) for (bottom, top), (other_bottom, _) in pairs),
                tuple((max(bottom, other_top), top) for (bottom, top), (_, other_top) in pairs),
            ]
        rings = []
        for (low_a, high_a), (low_b, high_b) in spans:
            if high_a <= low_a and high_b <= low_b:
                continue
            if high_a < low_a or high_b < low_b:
                raise _fault("two roof planes cross between the ends of an edge")
            up, down = self._line[b][low_b : high_b + 1], self._line[a][low_a : high_a + 1]
            rings.append((*up, *down[::-1]))
        return rings


def _snapped(walls_mm: MultiPolygon, borders: shapely.MultiLineString, snap_mm: float) -> shapely.Geometry:
    """The wall outline with its vertices on borders of the roof that are near, and its lines on vertices that are."""
    corners = shapely.MultiPoint(np.unique(shapely.get_coordinates(borders), axis=0))
    near = shapely.snap(walls_mm, corners, snap_mm)

    def onto(xy: IntArray) -> IntArray:
        nearest = shapely.get_coordinates(shapely.shortest_line(shapely.points(xy), borders)).reshape(-1, 2, 2)[:, 1]
        is_near = np.hypot(*(nearest - xy).T) <= snap_mm
        return np.where(is_near[:, None], np.rint(nearest), xy)

    moved = shapely.transform(near, onto)
    return shapely.make_valid(moved, method="structure", keep_collapsed=False)


def united_lines(lines: shapely.Geometry, own: Sequence[XY], unite_mm: float) -> shapely.Geometry:
    """Noded lines on the grid without new vertices that are near to others; those of `own` stay."""
    vertices = np.unique(shapely.get_coordinates(lines), axis=0)
    stay = {*own}
    is_new = np.array([(x, y) not in stay for x, y in vertices.tolist()], np.bool_)
    order = np.lexsort((vertices[:, 1], vertices[:, 0], is_new))
    points = shapely.points(vertices[order])
    first, second = shapely.STRtree(points).query(points, "dwithin", unite_mm)
    is_later = (first < second) & is_new[order][second]
    places: list[XY] = [(x, y) for x, y in vertices[order].tolist()]
    into: dict[XY, XY] = {}
    for a, b in sorted(zip(first[is_later].tolist(), second[is_later].tolist(), strict=True)):
        if places[a] not in into:
            into.setdefault(places[b], places[a])
    if not into:
        return lines
    moved = shapely.transform(lines, lambda xy: np.array([into.get((x, y), (x, y)) for x, y in xy.tolist()]))
    return shapely.union_all(moved, grid_size=1.0)


def _closest(places: Sequence[XY], known: int) -> float:
    """The least distance of a plan vertex from the `known` one on to any other; infinite without one."""
    points = shapely.points(places)
    _, distances = shapely.STRtree(points).query_nearest(points[known:], return_distance=True, exclusive=True)
    return float(distances.min(initial=math.inf))


def _crossed(faces: Sequence[SolidFace], points: Sequence[tuple[int, int, int]]) -> set[XY]:
    """Plan vertices over which an upright edge has more than two faces."""
    counts = Counter(edge for face in faces for ring in face.rings for edge in _edges_of(ring))
    return {points[a][:2] for (a, b), count in counts.items() if count > 1 and points[a][:2] == points[b][:2]}


def _edges_of(ring: Sequence[int]) -> list[Edge]:
    """The directed edges of a ring."""
    return list(zip(ring, (*ring[1:], ring[0]), strict=True))


def _with_vertices(ring: Ring, inserted: dict[Edge, Ring]) -> Ring:
    """A ring with further vertices on its edges."""
    return [v for a, b in _edges_of(ring) for v in (a, *inserted.get((a, b), ()))]


def _is_straight(a: Sequence[int], v: Sequence[int], b: Sequence[int]) -> bool:
    """Whether a vertex lies on the line between two others, in space."""
    start, place, end = np.array(a, np.float64), np.array(v, np.float64), np.array(b, np.float64)
    length = float(np.linalg.norm(end - start))
    return length > 0.0 and float(np.linalg.norm(np.cross(end - start, place - start))) <= _STRAIGHT_MM * length


def _height_mm(plane: Plane, xy: tuple[int, int]) -> float:
    """Height of a plane over a plan vertex; all in millimetres."""
    return (plane.a * (xy[0] * 1e-3) + plane.b * (xy[1] * 1e-3) + plane.c) * 1e3


def _trace(following: dict[int, int], xy: Sequence[tuple[int, int]]) -> list[Ring]:
    """Closed rings of a successor table, the outer one (clockwise: a floor is seen from below) first."""
    rings: list[Ring] = []
    left = dict(following)
    while left:
        start = next(iter(left))
        ring = [start]
        v = left.pop(start)
        while v != start:
            ring.append(v)
            v = left.pop(v)
        rings.append(ring)

    def twice_area(ring: Ring) -> int:
        return sum(xy[a][0] * xy[b][1] - xy[b][0] * xy[a][1] for a, b in zip(ring, ring[1:] + ring[:1], strict=True))

    rings.sort(key=twice_area)
    if sum(twice_area(ring) < 0 for ring in rings) != 1:
        raise BuildingError(Reason.NO_PARTITION, "the outline of a part is not one ring with holes")
    return rings
