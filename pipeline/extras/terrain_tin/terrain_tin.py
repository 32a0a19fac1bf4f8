"""The terrain of a tile as triangles, with the outlines of buildings cut out, seamless with its neighbours.

Everything on the border of a tile depends only on terrain and outlines within a few metres of it, which both tiles see:
outlines are noded with the border on whole millimetres, and the vertices between these nodes are chosen along the
border alone. So both tiles have the same vertices there, whatever lies inside.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.compiler import kernel
from pipeline.extras.terrain_tin.noding import APART_MM, ON_LINE_MM, noded
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations, height_above
from pipeline.tiling import Window
from pipeline.tin.constrained import LatticePoints, RefinedTin, refine, triangulate_constrained

GAP_CELLS = 16
"""Gaps between points are closed up to twice as many cells wide. Not a setting: terrain far from any point is a guess,
and wide waters give no points."""
CLEARANCE_MM = 500
"""Terrain nearer than this to an outline does not count: the TIN goes to the base of the building there."""
BESIDE_MM = 2000
"""Nearer than this to an outline all vertices along a border stay, so that the slope to its base ends near it. Outlines
up to so far from a tile matter to it."""
REACH_M = 2 * GAP_CELLS + 3
"""How far beyond a tile terrain is looked at."""

_BORDER_MM = 250
"""Cells whose middle is nearer than this to the border of a tile are left to the vertices on it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outline:
    """The floor of a building."""

    rings: tuple[IntArray, ...]
    """Outer ring, then holes: (k, 2) int64 each, absolute millimetres, the first corner not repeated."""
    z_mm: int
    """Its elevation."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerrainMesh:
    """The terrain of a tile as triangles."""

    vertices_mm: IntArray
    """(v, 3) int64, absolute millimetres, sorted by x, y, z; each is used."""
    triangles: LabelArray
    """(t, 3) int32, counter-clockwise seen from above, each from its smallest vertex, sorted. Upright ones join terrain
    and floor where buildings with floors at different levels touch."""
    n_cells: int
    """Cells of the terrain that count, those that became vertices among them."""
    squares_mm2: float
    """Sum of their squared vertical errors."""
    max_error_mm: float
    """The largest vertical error."""


def terrain_mesh(
    core: Window,
    terrain: Elevations,
    occupied: BoolArray,
    corner: tuple[int, int],
    outlines: Sequence[Outline],
    tolerance_mm: float,
) -> TerrainMesh:
    """Triangulate the terrain of a tile.

    Parameters
    ----------
    core : Window
        The tile, at most 2 km wide.
    terrain : (rows, columns) int32
        Elevations of cells of 1 m in mm, NO_DATA where unknown: the tile and `REACH_M` around it.
    occupied : (rows, columns) bool
        The cells that hold points.
    corner : tuple of int
        Absolute column and row of the first cell.
    outlines : sequence of Outline
        All that meet the tile; others do no harm.
    tolerance_mm : float
        Vertical distance between the middle of a cell and the triangle there, at most.
    """
    drawn = _Drawn(core=core, terrain=terrain, corner=corner, known=_known(terrain, occupied), outlines=outlines)
    nodes, z_mm = drawn.with_more(tolerance_mm)
    tin = triangulate_constrained(nodes, drawn.edges)
    floor_of_region, is_terrain = drawn.judged(nodes[tin.inside].mean(axis=1))
    if not is_terrain.any():
        return _no_mesh()
    found = refine(tin, z_mm, is_terrain, drawn.lattice_points(), tolerance_mm)
    return _mesh(found, drawn.floors_beyond(found, floor_of_region), drawn.floors_at_nodes(), core)


def _no_mesh() -> TerrainMesh:
    return TerrainMesh(
        vertices_mm=np.empty((0, 3), np.int64),
        triangles=np.empty((0, 3), np.int32),
        n_cells=0,
        squares_mm2=0.0,
        max_error_mm=0.0,
    )


def _widened(mask: BoolArray, cells: int) -> BoolArray:
    """A mask and all within some cells of it along rows and columns."""
    out: BoolArray = mask
    for axis in (0, 1):
        sums = np.cumsum(np.moveaxis(out, axis, 0), axis=0, dtype=np.int32)
        padded = np.pad(sums, ((cells + 1, 0), (0, 0)))
        padded = np.pad(padded, ((0, cells), (0, 0)), mode="edge")
        out = np.moveaxis(padded[2 * cells + 1 :] > padded[: -2 * cells - 1], 0, axis)
    return out


def _known(terrain: Elevations, occupied: BoolArray) -> BoolArray:
    """The cells with terrain and with points on all sides nearby."""
    closed = ~_widened(~_widened(occupied, GAP_CELLS), GAP_CELLS)
    known: BoolArray = closed & (terrain != NO_DATA)
    return known


@kernel
def _near_segments(ends: IntArray, shape: tuple[int, int], reach_mm: int) -> BoolArray:
    """The cells of a lattice whose middles lie nearer than a distance to segments (s, 2, 2) in mm from its corner."""
    rows, columns = shape
    out = np.zeros((rows, columns), np.bool_)
    for s in range(len(ends)):
        ax, ay, bx, by = ends[s, 0, 0], ends[s, 0, 1], ends[s, 1, 0], ends[s, 1, 1]
        dx, dy = float(bx - ax), float(by - ay)
        length2 = dx * dx + dy * dy
        for r in range(max((min(ay, by) - reach_mm) // 1000, 0), min((max(ay, by) + reach_mm) // 1000 + 1, rows)):
            for c in range(
                max((min(ax, bx) - reach_mm) // 1000, 0), min((max(ax, bx) + reach_mm) // 1000 + 1, columns)
            ):
                px, py = 1000.0 * c + 500.0 - ax, 1000.0 * r + 500.0 - ay
                along = 0.0 if length2 == 0.0 else min(max((px * dx + py * dy) / length2, 0.0), 1.0)
                qx, qy = px - along * dx, py - along * dy
                if qx * qx + qy * qy < reach_mm * reach_mm:
                    out[r, c] = True
    return out


@kernel
def _thinned(place: IntArray, z_mm: IntArray, must_stay: BoolArray, tolerance_mm: float) -> BoolArray:
    """Which points of a profile (n,) stay so that none is off by more than a tolerance (Douglas and Peucker 1973).

    The first and the last must stay.
    """
    stays = must_stay.copy()
    waiting = [(0, 0)]
    for i in range(1, len(place)):
        if must_stay[i]:
            waiting.append((waiting[-1][1], i))
    while len(waiting) > 0:
        first, last = waiting.pop()
        worst, chosen = tolerance_mm, -1
        for i in range(first + 1, last):
            share = (place[i] - place[first]) / (place[last] - place[first])
            error = abs(z_mm[i] - z_mm[first] - share * (z_mm[last] - z_mm[first]))
            if error > worst:
                worst, chosen = error, i
        if chosen >= 0:
            stays[chosen] = True
            waiting.append((first, chosen))
            waiting.append((chosen, last))
    return stays


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Drawn:
    """The lines of a tile; all coordinates are millimetres from its lower left corner."""

    core: Window
    terrain: Elevations
    corner: tuple[int, int]
    known: BoolArray
    outlines: Sequence[Outline]
    _low: IntArray = dataclasses.field(init=False)
    _side: int = dataclasses.field(init=False)
    _lines: npt.NDArray[np.object_] = dataclasses.field(init=False)
    """The rings of the outlines. What is decided on the border by distances needs them: neighbours have the same."""
    _noded_lines: npt.NDArray[np.object_] = dataclasses.field(init=False)
    """The rings as they lead through the nodes."""
    _floor_of_line: IntArray = dataclasses.field(init=False)
    nodes: IntArray = dataclasses.field(init=False)
    """(n, 2): where outlines, the border and the edge of the data in the tile meet or turn."""
    edges: IntArray = dataclasses.field(init=False)
    """(s, 2): the nodes at the ends of each edge."""

    def __post_init__(self) -> None:
        """Move the outlines near the tile to its corner, and cut all lines at their crossings."""
        low = np.array([self.core.x0_mm, self.core.y0_mm])
        side = self.core.x1_mm - self.core.x0_mm
        near = [
            outline
            for outline in self.outlines
            if (outline.rings[0].max(axis=0) - low >= -BESIDE_MM).all()
            and (outline.rings[0].min(axis=0) - low <= side + BESIDE_MM).all()
        ]
        rings = np.array([shapely.linearrings(ring - low) for outline in near for ring in outline.rings], dtype=object)
        object.__setattr__(self, "outlines", near)
        object.__setattr__(self, "_low", low)
        object.__setattr__(self, "_side", side)
        found = noded(side, BESIDE_MM, self._data_edges(), rings)
        object.__setattr__(self, "_lines", rings)
        object.__setattr__(self, "_noded_lines", found.outlines)
        object.__setattr__(self, "nodes", found.nodes)
        object.__setattr__(self, "edges", found.edges)
        floors = [outline.z_mm for outline in near for _ in outline.rings]
        object.__setattr__(self, "_floor_of_line", np.array(floors, dtype=np.int64))

    def _data_edges(self) -> npt.NDArray[np.object_]:
        """The sides between cells with and without terrain, in runs as long as they are straight."""
        lines = []
        for mask, axis in ((self.known, 0), (self.known.T, 1)):
            changes = np.diff(np.pad(mask, ((1, 1), (0, 0))).astype(np.int8), axis=0)
            level = np.pad(changes != 0, ((0, 0), (1, 1))).astype(np.int8)
            at, start = np.nonzero(np.diff(level, axis=1) == 1)
            _, stop = np.nonzero(np.diff(level, axis=1) == -1)
            runs = np.stack((np.column_stack((start, at)), np.column_stack((stop, at))), axis=1)
            lines.append(runs if axis == 0 else runs[:, :, ::-1])
        cells = np.concatenate(lines).astype(np.int64) + np.array(self.corner)
        found: npt.NDArray[np.object_] = shapely.linestrings((cells * CELL_MM - self._low).astype(np.float64))
        return found

    def elevations(self, xy: IntArray) -> IntArray:
        """Terrain at some points, mm; NO_DATA where there is none."""
        absolute = xy + self._low
        x, y = np.ascontiguousarray(absolute[:, 0]), np.ascontiguousarray(absolute[:, 1])
        below = height_above(x, y, np.zeros(len(xy), np.int64), self.terrain, *self.corner)
        return np.where(below == NO_DATA, np.int64(NO_DATA), -below)

    def with_more(self, tolerance_mm: float) -> tuple[IntArray, IntArray]:
        """The nodes and further ones along the border and the edge of the data, and the elevation of each.

        On an outline it is that of the floor, of the lowest where several touch there.
        """
        z_mm = self.elevations(self.nodes)
        node, floor = self.floors_at_nodes().T
        lowest = np.full(len(self.nodes), np.iinfo(np.int64).max)
        np.minimum.at(lowest, node, floor)
        z_mm[node] = lowest[node]
        added = self._between(z_mm, tolerance_mm)
        return np.concatenate((self.nodes, added)), np.concatenate((z_mm, self.elevations(added)))

    def floors_at_nodes(self) -> IntArray:
        """The nodes on outlines and the floor of each outline there: (k, 2)."""
        points = shapely.points(self.nodes.astype(np.float64))
        node, line = shapely.STRtree(self._noded_lines).query(points, predicate="dwithin", distance=ON_LINE_MM)
        return np.column_stack((node, self._floor_of_line[line]))

    def _samples(self) -> tuple[IntArray, IntArray]:
        """The middles of cells along those edges that run along rows or columns, (k, 2), and the edge of each."""
        found, of_edge = [np.empty((0, 2), np.int64)], [np.empty(0, np.int64)]
        for axis in (0, 1):
            along, ends = 1 - axis, self.nodes[self.edges]
            straight = np.flatnonzero(ends[:, 0, axis] == ends[:, 1, axis])
            low, high = (edge(ends[straight][:, :, along], axis=1) for edge in (np.min, np.max))
            half, shift = CELL_MM // 2, int(self._low[along])
            first = (low + shift + half) // CELL_MM  # the cell with the first middle beyond the lower end
            counts = np.maximum((high + shift - half - 1) // CELL_MM - first + 1, 0)
            number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            xy = np.empty((len(number), 2), np.int64)
            xy[:, along] = (np.repeat(first, counts) + number) * CELL_MM + half - shift
            xy[:, axis] = np.repeat(ends[straight, 0, axis], counts)
            found.append(xy)
            of_edge.append(np.repeat(straight, counts))
        return np.concatenate(found), np.concatenate(of_edge)

    def _between(self, z_mm: IntArray, tolerance_mm: float) -> IntArray:
        """Points (k, 2) on edges along rows or columns that the terrain needs between their ends."""
        xy, of_edge = self._samples()
        z = self.elevations(xy)
        too_close = ((xy > 0) & (xy < APART_MM)) | ((xy < self._side) & (xy > self._side - APART_MM))
        usable, beside = (z != NO_DATA) & ~too_close.any(axis=1), np.zeros(len(z), np.bool_)
        if len(self._lines):
            tree, points = shapely.STRtree(self._lines), shapely.points(xy.astype(np.float64))
            beside[tree.query(points, predicate="dwithin", distance=float(BESIDE_MM))[0]] = True
            usable[tree.query(points, predicate="dwithin", distance=float(CLEARANCE_MM))[0]] = False
        xy, z, beside, of_edge = xy[usable], z[usable], beside[usable], of_edge[usable]
        chosen = [np.empty((0, 2), np.int64)]
        for own in np.split(np.arange(len(xy)), np.flatnonzero(np.diff(of_edge)) + 1) if len(xy) else ():
            a, b = self.edges[of_edge[own[0]]]
            if NO_DATA in (z_mm[a], z_mm[b]):
                continue
            if self.nodes[a].sum() > self.nodes[b].sum():
                a, b = b, a
            place = np.concatenate(([self.nodes[a]], xy[own], [self.nodes[b]])).sum(axis=1)
            profile = np.concatenate(([z_mm[a]], z[own], [z_mm[b]]))
            stays = _thinned(place, profile, np.concatenate(([True], beside[own], [True])), tolerance_mm)
            chosen.append(xy[own][stays[1:-1]])
        return np.concatenate(chosen)

    def judged(self, places: FloatArray) -> tuple[IntArray, BoolArray]:
        """The floor of the building at a point of each region (r, 2), and whether the region is terrain.

        Of several buildings the lowest floor counts; it is NO_DATA where there is none.
        """
        floor = np.full(len(places), NO_DATA, np.int64)
        if self.outlines:
            ring = iter(self._noded_lines)
            polygons = [shapely.Polygon(next(ring), [next(ring) for _ in one.rings[1:]]) for one in self.outlines]
            place, polygon = shapely.STRtree(polygons).query(shapely.points(places), predicate="intersects")
            np.minimum.at(floor, place, np.array([one.z_mm for one in self.outlines], np.int64)[polygon])
        cells = np.floor((places + self._low) / CELL_MM).astype(np.int64) - np.array(self.corner)
        return floor, (floor == NO_DATA) & self.known[cells[:, 1], cells[:, 0]]

    def floors_beyond(self, found: RefinedTin, floor_of_region: IntArray) -> IntArray:
        """The floor of the building beyond each edge of the facets, (t, 3); NO_DATA where there is none.

        Beyond the border of the tile it is that of the outlines 0.5 mm from there: noding moves those that are nearer
        onto the border.
        """
        floor: IntArray = np.concatenate((floor_of_region, np.full(1, NO_DATA, np.int64)))[found.beyond]
        t, k = np.nonzero(found.beyond < 0)
        ends = found.vertices_mm[np.stack((found.facets[t, k], found.facets[t, (k + 1) % 3]), axis=1), :2]
        places, is_on_border = ends.mean(axis=1), np.zeros(len(t), np.bool_)
        for axis in (0, 1):
            for border, step in ((0, -0.5), (self._side, 0.5)):
                on = (ends[:, :, axis] == border).all(axis=1)
                places[on, axis] += step
                is_on_border |= on
        floor[t[is_on_border], k[is_on_border]] = self.judged(places[is_on_border])[0]
        return floor

    def lattice_points(self) -> LatticePoints:
        """The middles of the cells that count."""
        middle = np.array(self.corner) * CELL_MM + CELL_MM // 2 - self._low
        x = middle[0] + CELL_MM * np.arange(self.known.shape[1])
        y = middle[1] + CELL_MM * np.arange(self.known.shape[0])
        columns = np.flatnonzero((x > _BORDER_MM) & (x < self._side - _BORDER_MM))
        rows = np.flatnonzero((y > _BORDER_MM) & (y < self._side - _BORDER_MM))
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        counts = self.known[part].copy()
        if len(self._lines):
            xy, line = shapely.get_coordinates(self._lines, return_index=True)
            ends = np.stack((xy[:-1], xy[1:]), axis=1)[line[:-1] == line[1:]].astype(np.int64)
            first_cell = np.array([x[columns[0]], y[rows[0]]]) - CELL_MM // 2
            counts &= ~_near_segments(ends - first_cell, counts.shape, CLEARANCE_MM)
        return LatticePoints(
            z_mm=np.where(counts, self.terrain[part], np.nan), west_mm=int(x[columns[0]]), south_mm=int(y[rows[0]])
        )


def _upright(vertices: IntArray, walls: IntArray, floors_at: IntArray) -> IntArray:
    """The triangles (k, 3, 3) that close steps beneath walls (w, 3): from vertex u to v, at the level of a floor.

    Each level of another floor at a vertex is a corner of theirs, too, so that those of two walls share whole edges.
    Levels less than `APART_MM` above another are left out.
    """
    levels: dict[int, list[int]] = {}
    for vertex, z in np.unique(np.concatenate((floors_at, walls[:, [0, 2]], walls[:, [1, 2]])), axis=0).tolist():
        at = levels.setdefault(vertex, [])
        if not at or z >= at[-1] + APART_MM:
            at.append(z)
    found: list[tuple[tuple[int, ...], ...]] = []
    is_step = (vertices[walls[:, :2], 2] != walls[:, 2:]).any(axis=1)
    for u, v, floor in walls[is_step].tolist():
        on_u, on_v = ([(*vertices[e, :2].tolist(), z) for z in levels[e] if z <= floor] for e in (u, v))
        found += [(on_v[0], lower, upper) for lower, upper in itertools.pairwise(on_u)]
        found += [(lower, on_u[-1], upper) for lower, upper in itertools.pairwise(on_v)]
    return np.array(found, dtype=np.int64).reshape(-1, 3, 3)


def _mesh(found: RefinedTin, floor: IntArray, floors_at: IntArray, core: Window) -> TerrainMesh:
    """The facets and the upright triangles between them and floors, in canonical order and absolute coordinates.

    `floor` (t, 3) is that of the building beyond each edge, NO_DATA without one; `floors_at` (k, 2) are vertices and
    the floors that touch there.
    """
    vertices, facets = found.vertices_mm, found.facets
    t, k = np.nonzero(floor != NO_DATA)
    walls = np.column_stack((facets[t, k], facets[t, (k + 1) % 3], floor[t, k])).astype(np.int64)
    upright = _upright(vertices, walls, floors_at)
    corners = np.concatenate((vertices[facets], upright))
    places, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = number.reshape(-1, 3)
    start = np.argmin(triangles, axis=1)
    turned = triangles[np.arange(len(triangles))[:, None], (start[:, None] + np.arange(3)) % 3]
    ordered = turned[np.lexsort((turned[:, 2], turned[:, 1], turned[:, 0]))]
    return TerrainMesh(
        vertices_mm=places + np.array([core.x0_mm, core.y0_mm, 0]),
        triangles=ordered.astype(np.int32),
        n_cells=found.n_points,
        squares_mm2=found.squares_mm2,
        max_error_mm=found.max_error_mm,
    )
