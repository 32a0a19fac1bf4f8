"""What a line from above hits first: exact, over flat arrays and a grid of objects.

A line is given by its point on the terrain and its lean (metres east and north per metre up). The first hit from above
is then the highest one, so elevation itself is the parameter along the line and no ray marching is needed.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numba import njit

from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.synthetic.scene import Scene
from pipeline.synthetic.scene_arrays import CELL_M, SceneArrays, scene_arrays

GROUND, ROOF, WALL, TREE, BOX = 0, 1, 2, 3, 4
"""Kinds of hits."""

_ON_ROOF_M = 1e-6


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
    z: float = scene.terrain[0] + scene.terrain[1] * x + scene.terrain[2] * y
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
def _passes_by(scene: SceneArrays, prism: int, x: float, y: float, z: float, lean: float, radius: float) -> bool:
    """Whether a line stays out of the circle around a prism by more than a radius: most do."""
    away_x, away_y = x - scene.circles[prism, 0], y - scene.circles[prism, 1]
    reach = scene.circles[prism, 2] + max(0.0, scene.circles[prism, 3] - z) * lean + radius
    return bool(away_x * away_x + away_y * away_y > reach * reach)


@njit(cache=True, nogil=True)
def is_clear(
    scene: SceneArrays, cell: int, x: float, y: float, z: float, lean_x: float, lean_y: float, radius: float
) -> bool:
    """Whether a beam of a radius around a line meets no edge of a roof face and no crown.

    Each face is looked at in its own plane, whether it is hit or hidden, so a beam past an eave is not clear. Edges of
    walls alone (the vertical corners of a house) are not looked at.
    """
    lean = math.sqrt(lean_x * lean_x + lean_y * lean_y)
    for entry in range(scene.cell_start[cell], scene.cell_start[cell + 1]):
        number = scene.cell_entries[entry]
        if number < 0:
            tree = ~number
            wide, tall = scene.trees[tree, 3] + radius, scene.trees[tree, 4] + radius
            from_x, from_y = (x - scene.trees[tree, 0]) / wide, (y - scene.trees[tree, 1]) / wide
            from_z = (z - scene.trees[tree, 2]) / tall
            to_x, to_y, to_z = lean_x / wide, lean_y / wide, 1.0 / tall
            linear = from_x * to_x + from_y * to_y + from_z * to_z
            square = to_x * to_x + to_y * to_y + to_z * to_z
            if linear * linear > square * (from_x * from_x + from_y * from_y + from_z * from_z - 1.0):
                return False
            continue
        if _passes_by(scene, number, x, y, z, lean, radius):
            continue
        for face in range(scene.face_start[number], scene.face_start[number + 1]):
            a, b, c = scene.planes[face, 0], scene.planes[face, 1], scene.planes[face, 2]
            leaning = 1.0 - a * lean_x - b * lean_y
            if leaning <= 1e-9:
                return False
            up = (a * x + b * y + c - z) / leaning
            at_x, at_y = x + up * lean_x, y + up * lean_y
            before = scene.ring_start[face + 1] - 1
            for k in range(scene.ring_start[face], scene.ring_start[face + 1]):
                x1, y1 = scene.ring_x[before], scene.ring_y[before]
                edge_x, edge_y = scene.ring_x[k] - x1, scene.ring_y[k] - y1
                before = k
                along = ((at_x - x1) * edge_x + (at_y - y1) * edge_y) / (edge_x * edge_x + edge_y * edge_y)
                along = min(1.0, max(0.0, along))
                off_x, off_y = at_x - x1 - along * edge_x, at_y - y1 - along * edge_y
                if off_x * off_x + off_y * off_y < radius * radius:
                    return False
    return True


@njit(cache=True, nogil=True)
def _prism_hit(scene: SceneArrays, prism: int, x: float, y: float, z: float, lean_x: float, lean_y: float) -> Any:
    """Highest hit of a line with the prisms under the faces: elevation (-inf for none), face or -1 for a wall."""
    best, hit = -np.inf, -1
    if _passes_by(scene, prism, x, y, z, math.sqrt(lean_x * lean_x + lean_y * lean_y), 0.0):
        return best, hit
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
    return float(z + up)


@njit(cache=True, nogil=True)
def cell_of(scene: SceneArrays, x: float, y: float) -> int:
    """Number of the grid's cell, -1 outside."""
    column = math.floor((x - scene.grid[0]) / CELL_M)
    row = math.floor((y - scene.grid[1]) / CELL_M)
    if column < 0 or row < 0 or column >= scene.cells_across or row >= scene.cells_up:
        return -1
    cell: int = row * scene.cells_across + column
    return cell


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
def _surface(
    scene: SceneArrays,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    kind: LabelArray,
    thing: LabelArray,
    face: LabelArray,
) -> None:
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
