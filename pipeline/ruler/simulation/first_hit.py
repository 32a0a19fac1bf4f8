"""The first hit of a ray from above: exact, over flat arrays and a grid of objects.

A ray is given by its point on the terrain and its lean (metres east and north per metre up). The first hit from above
is then the highest one, so elevation itself is the parameter along the ray and no ray marching is needed.

The inner kernels take the arrays that they read one by one: passing a whole `SceneArrays` would count references to
each of its arrays, which costs several times as much as a hit.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.ruler.simulation.scene_arrays import CELL_M, SceneArrays

GROUND, ROOF, WALL, TREE, BOX = 0, 1, 2, 3, 4
"""Kinds of hits."""

# Numerical guards, not settings: metres that rounding may move a point, and iterations that always suffice.
_ON_ROOF_M = 1e-6
_ON_TERRAIN_M = 1e-7
_STEPS = 40
_SLOW = 0.05
"""A fixed-point step that leaves more of the error than this is followed by a secant step."""
_ROUNDING_M = 1e-6
"""Bounds are widened by this."""


class Ray(NamedTuple):
    """A straight line through a point (x, y, z) in metres, scene frame."""

    x: float
    """Easting."""
    y: float
    """Northing."""
    z: float
    """Elevation."""
    lean_x: float
    """Metres east per metre up."""
    lean_y: float
    """Metres north per metre up."""


@kernel
def mixed_bits(value: np.uint64) -> np.uint64:
    """The finaliser of splitmix64 (Steele, Lea, Flood 2014): 64 bits in, 64 well mixed bits out."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@kernel
def uniform_of(state: np.uint64, draw: int) -> float:
    """The draw-th uniform number in (0, 1) of a state: a pure function, so order and chunks cannot matter."""
    bits = mixed_bits(state + np.uint64(draw) * np.uint64(0x9E3779B97F4A7C15))
    return float((bits >> np.uint64(11)) + np.uint64(1)) / 9007199254740994.0


@kernel
def terrain_z(terrain: FloatArray, waves: FloatArray, x: float, y: float) -> float:
    """Elevation of the terrain."""
    z: float = terrain[0] + terrain[1] * x + terrain[2] * y
    for k in range(len(waves)):
        z += waves[k, 0] * math.sin(waves[k, 1] * x + waves[k, 2] * y + waves[k, 3])
    return z


@kernel
def terrain_hit(terrain: FloatArray, waves: FloatArray, ray: Ray) -> Ray:
    """The same ray, given by its point on the terrain.

    Each fixed-point step shrinks the error by slope * lean; secant steps help where that is slow, and bisection where
    both fail. `scene_arrays` ensures that slope * lean is less than 1, so there is exactly one such point.
    """
    x, y, z, lean_x, lean_y = ray
    start_x, start_y, start_z = x, y, z
    up, rise_before = 0.0, np.inf
    for _ in range(_STEPS):
        ground = terrain_z(terrain, waves, x, y)
        rise = ground - z
        if abs(rise) < _ON_TERRAIN_M:
            return Ray(x, y, z, lean_x, lean_y)
        if abs(rise) > _SLOW * abs(rise_before):
            up *= rise / (rise_before - rise)
            z += up
        else:
            up = rise
            z = ground
        x += up * lean_x
        y += up * lean_y
        rise_before = rise
    low, high = -1.0, 1.0
    while terrain_z(terrain, waves, start_x + low * lean_x, start_y + low * lean_y) < start_z + low:
        low *= 2.0
    while terrain_z(terrain, waves, start_x + high * lean_x, start_y + high * lean_y) > start_z + high:
        high *= 2.0
    while high - low > _ON_TERRAIN_M:
        up = 0.5 * (low + high)
        if terrain_z(terrain, waves, start_x + up * lean_x, start_y + up * lean_y) > start_z + up:
            low = up
        else:
            high = up
    return Ray(start_x + high * lean_x, start_y + high * lean_y, start_z + high, lean_x, lean_y)


@kernel
def _inside(edges: FloatArray, start: int, stop: int, x: float, y: float) -> bool:
    """Point in polygon by crossings of the edges (n, 4) of all rings; border points may count as inside or outside."""
    inside = False
    for k in range(start, stop):
        y1, y2 = edges[k, 1], edges[k, 3]
        if (y1 > y) != (y2 > y):
            x1, x2 = edges[k, 0], edges[k, 2]
            if x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
                inside = not inside
    return inside


@kernel
def _passes_by(circles: FloatArray, prism: int, ray: Ray, lean: float, radius: float) -> bool:
    """Whether a ray stays outside the circle around a prism by more than a radius; most do."""
    away_x, away_y = ray.x - circles[prism, 0], ray.y - circles[prism, 1]
    reach = circles[prism, 2] + max(0.0, circles[prism, 3] - ray.z) * lean + radius
    return bool(away_x * away_x + away_y * away_y > reach * reach)


@kernel
def _near_bounds(faces: FloatArray, face: int, x1: float, y1: float, x2: float, y2: float, distance: float) -> bool:
    """Whether the rectangle around two points comes within a distance in metres of the bounds of a face."""
    reach = distance + _ROUNDING_M
    return bool(
        max(x1, x2) > faces[face, 3] - reach
        and min(x1, x2) < faces[face, 5] + reach
        and max(y1, y2) > faces[face, 4] - reach
        and min(y1, y2) < faces[face, 6] + reach
    )


@kernel
def _meets_crown(trees: FloatArray, tree: int, ray: Ray, radius: float) -> bool:
    """Whether a ray enters a crown that is enlarged by a radius in metres."""
    wide, tall = trees[tree, 3] + radius, trees[tree, 4] + radius
    from_x, from_y = (ray.x - trees[tree, 0]) / wide, (ray.y - trees[tree, 1]) / wide
    from_z = (ray.z - trees[tree, 2]) / tall
    to_x, to_y, to_z = ray.lean_x / wide, ray.lean_y / wide, 1.0 / tall
    linear = from_x * to_x + from_y * to_y + from_z * to_z
    square = to_x * to_x + to_y * to_y + to_z * to_z
    return bool(linear * linear > square * (from_x * from_x + from_y * from_y + from_z * from_z - 1.0))


@kernel
def is_clear(scene: SceneArrays, cell: int, ray: Ray, radius: float) -> bool:
    """Whether a beam with a radius in metres around a ray meets no edge of a roof face and no crown.

    Each face is tested in its own plane, whether it is hit or hidden, so a beam past an eave is not clear. Vertical
    edges, the corners of walls, are not tested.
    """
    x, y, z, lean_x, lean_y = ray
    face_start, edge_start, circles = scene.face_start, scene.edge_start, scene.circles
    faces, edges, trees = scene.faces, scene.edges, scene.trees
    lean = math.sqrt(lean_x * lean_x + lean_y * lean_y)
    for entry in range(scene.cell_start[cell], scene.cell_start[cell + 1]):
        number = scene.entries[entry, 0]
        if number < 0:
            if _meets_crown(trees, ~number, ray, radius):
                return False
            continue
        if _passes_by(circles, number, ray, lean, radius):
            continue
        for face in range(face_start[number], face_start[number + 1]):
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            leaning = 1.0 - a * lean_x - b * lean_y
            if leaning <= 1e-9:
                return False
            up = (a * x + b * y + c - z) / leaning
            at_x, at_y = x + up * lean_x, y + up * lean_y
            if not _near_bounds(faces, face, at_x, at_y, at_x, at_y, radius):
                continue
            for k in range(edge_start[face], edge_start[face + 1]):
                x1, y1 = edges[k, 0], edges[k, 1]
                edge_x, edge_y = edges[k, 2] - x1, edges[k, 3] - y1
                along = ((at_x - x1) * edge_x + (at_y - y1) * edge_y) / (edge_x * edge_x + edge_y * edge_y)
                along = min(1.0, max(0.0, along))
                off_x, off_y = at_x - x1 - along * edge_x, at_y - y1 - along * edge_y
                if off_x * off_x + off_y * off_y < radius * radius:
                    return False
    return True


@kernel
def _prism_hit(
    face_start: LabelArray,
    edge_start: LabelArray,
    circles: FloatArray,
    faces: FloatArray,
    edges: FloatArray,
    prism: int,
    ray: Ray,
) -> Any:
    """Highest hit of a ray with the prisms under the faces: elevation (-inf for none), face or -1 for a wall.

    Where two faces share an edge in plan but not in height, the ray enters the prism of the higher one through its
    side, the wall of the step edge. The part of that side under the lower face is hidden in the other prism.
    """
    x, y, z, lean_x, lean_y = ray
    best, hit = -np.inf, -1
    if _passes_by(circles, prism, ray, math.sqrt(lean_x * lean_x + lean_y * lean_y), 0.0):
        return best, hit
    first = face_start[prism]
    for face in range(first, face_start[prism + 1]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        leaning = 1.0 - a * lean_x - b * lean_y
        if leaning > 1e-9:
            top = (a * (x - z * lean_x) + b * (y - z * lean_y) + c) / leaning
            if top <= best:
                continue  # any hit with the sides lies below
            at_x, at_y = x + (top - z) * lean_x, y + (top - z) * lean_y
            if not _near_bounds(faces, face, at_x, at_y, x, y, 0.0):
                continue
            if _inside(edges, edge_start[face], edge_start[face + 1], at_x, at_y):
                best, hit = top, face - first
                continue
        if lean_x == 0.0 and lean_y == 0.0:
            continue
        for k in range(edge_start[face], edge_start[face + 1]):
            x1, y1 = edges[k, 0], edges[k, 1]
            edge_x, edge_y = edges[k, 2] - x1, edges[k, 3] - y1
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


@kernel
def _tree_hit(trees: FloatArray, tree: int, ray: Ray, chance: float) -> float:
    """Elevation where a ray ends in a crown, -inf if it passes: depth = -ln(chance) * free path along the chord."""
    x, y, z, lean_x, lean_y = ray
    radius, half_height = trees[tree, 3], trees[tree, 4]
    from_x = (x - trees[tree, 0]) / radius
    from_y = (y - trees[tree, 1]) / radius
    from_z = (z - trees[tree, 2]) / half_height
    to_x, to_y, to_z = lean_x / radius, lean_y / radius, 1.0 / half_height
    square = to_x * to_x + to_y * to_y + to_z * to_z
    linear = from_x * to_x + from_y * to_y + from_z * to_z
    root = linear * linear - square * (from_x * from_x + from_y * from_y + from_z * from_z - 1.0)
    if root <= 0.0:
        return -np.inf
    length = math.sqrt(1.0 + lean_x * lean_x + lean_y * lean_y)
    depth = -math.log(chance) * trees[tree, 5]
    up = (-linear + math.sqrt(root)) / square - depth / length
    if up <= (-linear - math.sqrt(root)) / square or up <= 0.0:
        return -np.inf
    return float(z + up)


@kernel
def cell_of(grid: FloatArray, across: int, up: int, x: float, y: float) -> int:
    """Number of the grid cell at (x, y); -1 outside the grid."""
    column = math.floor((x - grid[0]) / CELL_M)
    row = math.floor((y - grid[1]) / CELL_M)
    if column < 0 or row < 0 or column >= across or row >= up:
        return -1
    cell: int = row * across + column
    return cell


@kernel
def first_hit(scene: SceneArrays, cell: int, ray: Ray, state: np.uint64, draw: int) -> Any:
    """Highest hit of a ray given by its terrain point: elevation, kind, object, roof face.

    The chance of a crown is drawn from the state at draw + the number of its entry; draw < 0 leaves crowns out.
    """
    best, kind, thing, face = ray.z, GROUND, -1, -1
    if cell < 0:
        return best, kind, thing, face
    entries, n_buildings = scene.entries, scene.n_buildings
    face_start, edge_start, circles = scene.face_start, scene.edge_start, scene.circles
    faces, edges, trees = scene.faces, scene.edges, scene.trees
    for entry in range(scene.cell_start[cell], scene.cell_start[cell + 1]):
        number = entries[entry, 0]
        if number >= 0:
            top, hit = _prism_hit(face_start, edge_start, circles, faces, edges, number, ray)
            if top > best:
                best, thing, face = top, number, hit
                kind = (ROOF if hit >= 0 else WALL) if number < n_buildings else BOX
        elif draw >= 0:
            chance = uniform_of(state, draw + entries[entry, 1])
            top = _tree_hit(trees, ~number, ray, chance)
            if top > best:
                best, kind, thing, face = top, TREE, ~number, -1
    if kind == BOX:
        thing, face = thing - n_buildings, -1
    return best, kind, thing, face


@kernel(inline="always")
def is_wet(spot_start: LabelArray, spots: FloatArray, building: int, x: float, y: float) -> bool:
    """Whether (x, y) on the roof of a building lies in one of its wet spots (x, y, squared radius)."""
    for spot in range(spot_start[building], spot_start[building + 1]):
        away_x, away_y = x - spots[spot, 0], y - spots[spot, 1]
        if away_x * away_x + away_y * away_y < spots[spot, 2]:
            return True
    return False
