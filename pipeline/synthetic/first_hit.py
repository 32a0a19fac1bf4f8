"""What a line from above hits first: exact, over flat arrays and a grid of objects.

A line is given by its point on the terrain and its lean (metres east and north per metre up). The first hit from above
is then the highest one, so elevation itself is the parameter along the line and no ray marching is needed.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.synthetic.scene import Scene

GROUND, ROOF, WALL, TREE, BOX = 0, 1, 2, 3, 4
"""Kinds of hits."""

_CELL_M = 5.0
_ON_ROOF_M = 1e-6


class SceneArrays(NamedTuple):
    """A scene for the kernels. Prisms are buildings, then boxes; entries of the grid >= 0 are prisms, < 0 trees (~i)."""

    terrain: FloatArray
    """(3,) float64: base elevation, slope east, slope north."""
    waves: FloatArray
    """(k, 4) float64, as `Terrain.waves`."""
    n_buildings: int
    """Prisms below this number are buildings."""
    face_start: LabelArray
    """(prisms + 1,) int32, first face of each prism."""
    ring_start: LabelArray
    """(faces + 1,) int32, first vertex of each face."""
    ring_x: FloatArray
    """(vertices,) float64."""
    ring_y: FloatArray
    """(vertices,) float64."""
    planes: FloatArray
    """(faces, 3) float64: a, b, c."""
    trees: FloatArray
    """(trees, 6) float64: x, y, z, radius, half height, free path."""
    grid: FloatArray
    """(2,) float64, lower left corner of the grid."""
    cells_across: int
    """Columns of the grid."""
    cells_up: int
    """Rows of the grid."""
    cell_start: LabelArray
    """(cells + 1,) int32, first entry of each cell."""
    cell_entries: LabelArray
    """(entries,) int32."""


def scene_arrays(scene: Scene, max_lean: float = 0.0, margin_m: float = 0.5) -> SceneArrays:
    """Flatten a scene.

    Parameters
    ----------
    scene : Scene
        What can be hit.
    max_lean : float
        Largest lean of the lines to come: objects are entered into all cells from whose terrain they can be hit.
    margin_m : float
        Added to the reach, for beams with a footprint.
    """
    face_start, ring_start = [0], [0]
    rings: list[FloatArray] = []
    planes: list[tuple[float, float, float]] = []
    bounds: list[tuple[float, float, float, float]] = []
    for building in scene.buildings:
        low, high = building.vertices.min(axis=0), building.vertices.max(axis=0)
        for face, plane in zip(building.faces, building.planes, strict=True):
            rings.append(building.vertices[list(face), :2])
            planes.append(plane.coefficients)
            ring_start.append(ring_start[-1] + len(face))
        face_start.append(len(planes))
        bounds.append(_reach(low, high, (high[2] - building.floor_z_m) * max_lean + margin_m))
    for box in scene.boxes:
        rings.append(box.corners)
        planes.append((0.0, 0.0, box.top_z_m))
        ring_start.append(ring_start[-1] + len(box.corners))
        face_start.append(len(planes))
        bounds.append(_reach(box.corners.min(axis=0), box.corners.max(axis=0), 5.0 * max_lean + margin_m))
    trees = np.array([dataclasses.astuple(tree) for tree in scene.trees]).reshape(-1, 6)
    ground = scene.terrain.elevation(trees[:, 0], trees[:, 1])
    for row, z in zip(trees, ground, strict=True):
        reach = row[3] + max(0.0, row[2] + row[4] - z) * max_lean * 1.5 + margin_m
        bounds.append((row[0] - reach, row[1] - reach, row[0] + reach, row[1] + reach))
    numbers = [*range(len(scene.buildings) + len(scene.boxes)), *(~k for k in range(len(trees)))]
    vertices = np.concatenate(rings) if rings else np.zeros((0, 2))
    grid, across, up, cell_start, cell_entries = _cells(scene.extent, np.array(bounds).reshape(-1, 4), numbers)
    terrain = scene.terrain
    return SceneArrays(
        terrain=np.array([terrain.base_z_m, terrain.slope_x, terrain.slope_y]),
        waves=np.ascontiguousarray(terrain.waves, dtype=np.float64),
        n_buildings=len(scene.buildings),
        face_start=np.array(face_start, dtype=np.int32),
        ring_start=np.array(ring_start, dtype=np.int32),
        ring_x=np.ascontiguousarray(vertices[:, 0]),
        ring_y=np.ascontiguousarray(vertices[:, 1]),
        planes=np.array(planes, dtype=np.float64).reshape(-1, 3),
        trees=trees,
        grid=grid,
        cells_across=across,
        cells_up=up,
        cell_start=cell_start,
        cell_entries=cell_entries,
    )


def _reach(low: FloatArray, high: FloatArray, reach_m: float) -> tuple[float, float, float, float]:
    return (low[0] - reach_m, low[1] - reach_m, high[0] + reach_m, high[1] + reach_m)


def _cells(
    extent: tuple[float, float, float, float], bounds: FloatArray, numbers: list[int]
) -> tuple[FloatArray, int, int, LabelArray, LabelArray]:
    """The grid: each object's number in every cell that its bounds touch, in the order of the objects."""
    pad = 50.0  # pulses may start outside the extent; beyond the grid nothing stands
    low = np.array(extent[:2]) - pad
    across = math.ceil((extent[2] - extent[0] + 2 * pad) / _CELL_M)
    up = math.ceil((extent[3] - extent[1] + 2 * pad) / _CELL_M)
    cells: list[npt.NDArray[np.int64]] = [np.zeros(0, np.int64)]
    entries: list[npt.NDArray[np.int64]] = [np.zeros(0, np.int64)]
    for bound, number in zip(bounds, numbers, strict=True):
        first = np.clip(np.floor((bound[:2] - low) / _CELL_M).astype(int), 0, [across - 1, up - 1])
        last = np.clip(np.floor((bound[2:] - low) / _CELL_M).astype(int), 0, [across - 1, up - 1])
        rows, columns = np.mgrid[first[1] : last[1] + 1, first[0] : last[0] + 1]
        cells.append((rows * across + columns).ravel())
        entries.append(np.full(rows.size, number))
    flat, values = np.concatenate(cells), np.concatenate(entries)
    order = np.argsort(flat, kind="stable")
    start = np.zeros(across * up + 1, np.int32)
    start[1:] = np.cumsum(np.bincount(flat, minlength=across * up))
    return low, across, up, start, values[order].astype(np.int32)


@njit(cache=True, nogil=True)
def mixed_bits(value: np.uint64) -> np.uint64:
    """The finaliser of splitmix64 (Steele, Lea, Flood 2014): 64 bits in, 64 well mixed bits out."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, nogil=True)
def uniform_of(state: np.uint64, draw: int) -> float:
    """The draw-th uniform number in (0, 1) of a state: a pure function, so order and chunks cannot matter."""
    bits = mixed_bits(state + np.uint64(draw) * np.uint64(0x9E3779B97F4A7C15))
    return float((bits >> np.uint64(11)) + np.uint64(1)) / 9007199254740994.0


@njit(cache=True, nogil=True)
def terrain_z(scene: SceneArrays, x: float, y: float) -> float:
    """Elevation of the terrain."""
    z = scene.terrain[0] + scene.terrain[1] * x + scene.terrain[2] * y
    for k in range(len(scene.waves)):
        z += scene.waves[k, 0] * math.sin(scene.waves[k, 1] * x + scene.waves[k, 2] * y + scene.waves[k, 3])
    return z


@njit(cache=True, nogil=True)
def terrain_hit(scene: SceneArrays, x: float, y: float, z: float, lean_x: float, lean_y: float) -> Any:
    """Where the line through (x, y, z) meets the terrain: fixed-point steps, each shrinks the error by slope * lean."""
    for _ in range(40):
        ground = terrain_z(scene, x, y)
        rise = ground - z
        if abs(rise) < 1e-7:
            break
        x += rise * lean_x
        y += rise * lean_y
        z = ground
    return x, y, z


@njit(cache=True, nogil=True)
def _inside(scene: SceneArrays, face: int, x: float, y: float) -> bool:
    """Point in polygon by crossings; points on the border belong to one side or the other."""
    start, end = scene.ring_start[face], scene.ring_start[face + 1]
    inside = False
    before = end - 1
    for k in range(start, end):
        y1, y2 = scene.ring_y[before], scene.ring_y[k]
        if (y1 > y) != (y2 > y):
            x1, x2 = scene.ring_x[before], scene.ring_x[k]
            if x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
                inside = not inside
        before = k
    return inside


@njit(cache=True, nogil=True)
def _prism_hit(scene: SceneArrays, prism: int, x: float, y: float, z: float, lean_x: float, lean_y: float) -> Any:
    """Highest hit of a line with the prisms under a building's faces: elevation (-inf for none), face or -1 for a wall."""
    best, hit = -np.inf, -1
    first = scene.face_start[prism]
    for face in range(first, scene.face_start[prism + 1]):
        a, b, c = scene.planes[face, 0], scene.planes[face, 1], scene.planes[face, 2]
        leaning = 1.0 - a * lean_x - b * lean_y
        if leaning > 1e-9:
            top = (a * (x - z * lean_x) + b * (y - z * lean_y) + c) / leaning
            if top > best and _inside(scene, face, x + (top - z) * lean_x, y + (top - z) * lean_y):
                best, hit = top, face - first
        if lean_x == 0.0 and lean_y == 0.0:
            continue
        start, end = scene.ring_start[face], scene.ring_start[face + 1]
        before = end - 1
        for k in range(start, end):
            x1, y1 = scene.ring_x[before], scene.ring_y[before]
            edge_x, edge_y = scene.ring_x[k] - x1, scene.ring_y[k] - y1
            before = k
            # The interior lies left of an edge, so this is positive where a falling line enters the prism.
            entering = lean_x * edge_y - lean_y * edge_x
            if entering <= 1e-12:
                continue
            up = ((x1 - x) * edge_y - (y1 - y) * edge_x) / entering
            if up <= 0.0 or z + up <= best:
                continue
            at_x, at_y = x + up * lean_x, y + up * lean_y
            along = (at_x - x1) * edge_x + (at_y - y1) * edge_y
            if along < 0.0 or along > edge_x * edge_x + edge_y * edge_y:
                continue
            if z + up < a * at_x + b * at_y + c - _ON_ROOF_M:
                best, hit = z + up, -1
    return best, hit


@njit(cache=True, nogil=True)
def _tree_hit(
    scene: SceneArrays, tree: int, x: float, y: float, z: float, lean_x: float, lean_y: float, chance: float
) -> float:
    """Elevation where a beam ends in a crown, -inf where it passes: depth = -ln(chance) * free path along the chord."""
    radius, half_height = scene.trees[tree, 3], scene.trees[tree, 4]
    from_x = (x - scene.trees[tree, 0]) / radius
    from_y = (y - scene.trees[tree, 1]) / radius
    from_z = (z - scene.trees[tree, 2]) / half_height
    to_x, to_y, to_z = lean_x / radius, lean_y / radius, 1.0 / half_height
    square = to_x * to_x + to_y * to_y + to_z * to_z
    linear = from_x * to_x + from_y * to_y + from_z * to_z
    root = linear * linear - square * (from_x * from_x + from_y * from_y + from_z * from_z - 1.0)
    if root <= 0.0:
        return -np.inf
    length = math.sqrt(1.0 + lean_x * lean_x + lean_y * lean_y)
    depth = -math.log(chance) * scene.trees[tree, 5]
    up = (-linear + math.sqrt(root)) / square - depth / length
    if up <= (-linear - math.sqrt(root)) / square or up <= 0.0:
        return -np.inf
    return z + up


@njit(cache=True, nogil=True)
def cell_of(scene: SceneArrays, x: float, y: float) -> int:
    """Number of the grid's cell, -1 outside."""
    column = int(math.floor((x - scene.grid[0]) / _CELL_M))
    row = int(math.floor((y - scene.grid[1]) / _CELL_M))
    if column < 0 or row < 0 or column >= scene.cells_across or row >= scene.cells_up:
        return -1
    return row * scene.cells_across + column


@njit(cache=True, nogil=True)
def first_hit(
    scene: SceneArrays,
    cell: int,
    x: float,
    y: float,
    z: float,
    lean_x: float,
    lean_y: float,
    state: np.uint64,
    draw: int,
) -> Any:
    """Highest hit of the line through the terrain point (x, y, z): elevation, kind, object, roof face.

    A crown's chance is drawn from the state at draw + number of the tree's entry; draw < 0 leaves crowns out.
    """
    best, kind, thing, face = z, GROUND, -1, -1
    if cell < 0:
        return best, kind, thing, face
    for entry in range(scene.cell_start[cell], scene.cell_start[cell + 1]):
        number = scene.cell_entries[entry]
        if number >= 0:
            top, hit = _prism_hit(scene, number, x, y, z, lean_x, lean_y)
            if top > best:
                best, thing, face = top, number, hit
                kind = (ROOF if hit >= 0 else WALL) if number < scene.n_buildings else BOX
        elif draw >= 0:
            chance = uniform_of(state, draw + entry - scene.cell_start[cell])
            top = _tree_hit(scene, ~number, x, y, z, lean_x, lean_y, chance)
            if top > best:
                best, kind, thing, face = top, TREE, ~number, -1
    if kind == BOX:
        thing, face = thing - scene.n_buildings, -1
    return best, kind, thing, face


@njit(cache=True, nogil=True)
def _surface(scene: SceneArrays, x: FloatArray, y: FloatArray, z: FloatArray, kind: LabelArray, thing: LabelArray, face: LabelArray) -> None:
    for k in range(len(x)):
        ground = terrain_z(scene, x[k], y[k])
        cell = cell_of(scene, x[k], y[k])
        z[k], kind[k], thing[k], face[k] = first_hit(scene, cell, x[k], y[k], ground, 0.0, 0.0, np.uint64(0), -1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceHits:
    """The true top surface without trees at n places."""

    z: FloatArray
    """(n,) float64, elevation, metres."""
    kind: LabelArray
    """(n,) int32: GROUND, ROOF or BOX."""
    building: LabelArray
    """(n,) int32, number of the building; -1 where there is none."""
    face: LabelArray
    """(n,) int32, number of its roof face; -1 where there is none."""

    @property
    def on_roof(self) -> BoolArray:
        """(n,) bool, True where a building stands."""
        return self.building >= 0


def top_surface(scene: Scene, x: FloatArray, y: FloatArray) -> SurfaceHits:
    """The top surface (terrain, roofs, boxes; no trees) at scene coordinates x, y, each (n,) float64."""
    n = len(x)
    z, kind, thing, face = np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    _surface(scene_arrays(scene), np.ascontiguousarray(x), np.ascontiguousarray(y), z, kind, thing, face)
    return SurfaceHits(z=z, kind=kind, building=np.where(kind == ROOF, thing, -1).astype(np.int32), face=face)
