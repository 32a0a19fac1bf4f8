"""A scene as flat arrays with a grid of its objects, for the kernels."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from pipeline.errors import SettingsError
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.ruler.simulation.roofs import FaceRings
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain

CELL_M = 5.0
"""Edge of the grid's cells."""
_PAD_M = 50.0
"""The grid reaches at least this far beyond the extent, farther if rays that aim into it land farther out."""
_BOX_HEIGHT_M = 5.0
"""Upper bound of the height of a box over the terrain."""
_CLEARANCE = 2.0
"""In beam radii: objects farther from a beam do not affect it."""
_DRAWS_PER_TREE = 32_768
"""Random numbers that every tree of a survey reserves for the rays of one beam."""


class SceneArrays(NamedTuple):
    """A scene for the kernels. Prisms are buildings, then boxes; the grid's entries >= 0 are prisms, < 0 trees (~i)."""

    terrain: FloatArray
    """(3,) float64: base elevation, slope east, slope north."""
    waves: FloatArray
    """(k, 4) float64, as `Terrain.waves`."""
    n_buildings: int
    """Prisms below this number are buildings."""
    face_start: LabelArray
    """(prisms + 1,) int32, first face of each prism."""
    edge_start: LabelArray
    """(faces + 1,) int32, first edge of each face."""
    edges: FloatArray
    """(edges, 4) float64: x, y of the start, x, y of the end; the face lies to the left, also of the edges of holes."""
    faces: FloatArray
    """(faces, 7) float64: a, b, c of the plane; smallest x, smallest y, largest x, largest y."""
    circles: FloatArray
    """(prisms, 4) float64, circle around each prism: x, y, radius; and its highest elevation."""
    spot_start: LabelArray
    """(prisms + 1,) int32, first wet spot of each prism."""
    spots: FloatArray
    """(spots, 3) float64: x, y, radius squared."""
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
    entries: IntArray
    """(entries, 2) int64: the object, and which random number of a ray decides how deep it sinks into that crown."""


def steepest_slope(terrain: Terrain) -> float:
    """A slope (rise per metre) that the terrain exceeds nowhere."""
    wave_slopes = np.abs(terrain.waves[:, 0]) * np.hypot(terrain.waves[:, 1], terrain.waves[:, 2])
    return math.hypot(terrain.slope_x, terrain.slope_y) + float(wave_slopes.sum())


def landing_m(terrain: Terrain, extent: tuple[float, float, float, float], max_lean: float) -> float:
    """How far outside an extent rays land that aim into it at the base elevation of the terrain, metres.

    Raises SettingsError if the terrain is as steep as the flattest ray, which would meet it more than once, or never.
    """
    closeness = steepest_slope(terrain) * max_lean
    if closeness >= 0.95:
        beam, ground = (math.degrees(math.atan(tangent)) for tangent in (max_lean, steepest_slope(terrain)))
        fault = f"beams that lean {beam:.0f} deg graze terrain of up to {ground:.0f} deg: "
        raise SettingsError([fault + "raise altitude_m, or lower strip_spacing_m or strip_overlap"])
    x0, y0, x1, y1 = extent
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    rise = np.abs(corners @ (terrain.slope_x, terrain.slope_y)).max() + np.abs(terrain.waves[:, 0]).sum()
    return float(rise) * max_lean / (1.0 - closeness)


def scene_arrays(scene: Scene, max_lean: float = 0.0, margin_m: float = 0.5, beam_radius_m: float = 0.0) -> SceneArrays:
    """Flatten a scene for rays up to a lean; raises SettingsError as `landing_m` does.

    Objects are entered into all cells from whose terrain they can be hit. `margin_m` is added to the reach, for beams
    with a footprint of `beam_radius_m`.
    """
    pad_m = max(_PAD_M, CELL_M * math.ceil((landing_m(scene.terrain, scene.extent, max_lean) + margin_m) / CELL_M))
    slope = steepest_slope(scene.terrain)
    # Downhill a ray continues below the level of the floor, by slope * lean of the rest.
    lean, clearance = max_lean / (1.0 - slope * max_lean), _CLEARANCE * beam_radius_m

    def reach(height_m: float) -> float:
        return max(height_m * max_lean + margin_m, height_m * lean + clearance)

    face_start, edge_start, spot_start = [0], [0], [0]
    edges: list[FloatArray] = [np.zeros((0, 4))]
    planes: list[tuple[float, float, float]] = []
    spots: list[tuple[float, float, float]] = []
    circles: list[tuple[float, float, float, float]] = []
    reaches: list[tuple[float, float, float, float]] = []
    for building in scene.buildings:
        low, high = building.vertices.min(axis=0), building.vertices.max(axis=0)
        for face, plane in zip(building.faces, building.planes, strict=True):
            edges.append(_edges(building.vertices[:, :2], face))
            planes.append(plane.coefficients)
            edge_start.append(edge_start[-1] + len(edges[-1]))
        face_start.append(len(planes))
        spots += [(spot.x, spot.y, spot.radius_m * spot.radius_m) for spot in building.wet_spots]
        spot_start.append(len(spots))
        reaches.append(_widened(low, high, reach(high[2] - building.floor_z_m)))
        circles.append(_circle(building.vertices[:, :2], building.ridge_z_m))
    for box in scene.boxes:
        edges.append(_edges(box.corners, (tuple(range(len(box.corners))),)))
        planes.append((0.0, 0.0, box.top_z_m))
        edge_start.append(edge_start[-1] + len(edges[-1]))
        face_start.append(len(planes))
        spot_start.append(len(spots))
        reaches.append(_widened(box.corners.min(axis=0), box.corners.max(axis=0), reach(_BOX_HEIGHT_M)))
        circles.append(_circle(box.corners, box.top_z_m))
    trees = np.array([dataclasses.astuple(tree) for tree in scene.trees]).reshape(-1, 6)
    ground = scene.terrain.elevation(trees[:, 0], trees[:, 1])
    for row, z in zip(trees, ground, strict=True):
        height_m = max(0.0, row[2] + row[4] - z)
        far = row[3] + max(height_m * max_lean * 1.5 + margin_m, (height_m + slope * row[3]) * lean + clearance)
        reaches.append((row[0] - far, row[1] - far, row[0] + far, row[1] + far))
    numbers = [*range(len(scene.buildings) + len(scene.boxes)), *(~k for k in range(len(trees)))]
    grid, across, up, start, objects = _cells(scene.extent, pad_m, np.array(reaches).reshape(-1, 4), numbers)
    terrain, all_edges, starts = scene.terrain, np.concatenate(edges), np.array(edge_start, dtype=np.int32)
    return SceneArrays(
        terrain=np.array([terrain.base_z_m, terrain.slope_x, terrain.slope_y]),
        waves=np.ascontiguousarray(terrain.waves, dtype=np.float64),
        n_buildings=len(scene.buildings),
        face_start=np.array(face_start, dtype=np.int32),
        edge_start=starts,
        edges=all_edges,
        faces=np.hstack([np.array(planes, dtype=np.float64).reshape(-1, 3), _face_bounds(all_edges, starts)]),
        circles=np.array(circles, dtype=np.float64).reshape(-1, 4),
        spot_start=np.array(spot_start, dtype=np.int32),
        spots=np.array(spots, dtype=np.float64).reshape(-1, 3),
        trees=trees,
        grid=grid,
        cells_across=across,
        cells_up=up,
        cell_start=start,
        entries=np.column_stack([objects, _crown_draws(start, objects, trees, scene.survey_extent is not None)]),
    )


def _edges(plan: FloatArray, rings: FaceRings) -> FloatArray:
    """The edges (n, 4) of all rings, the closing edge of each first, without edges of length 0."""
    edges = []
    for ring in rings:
        ends = plan[list(ring)]
        edges.append(np.hstack([np.roll(ends, 1, axis=0), ends]))
    joined: FloatArray = np.concatenate(edges)
    has_length = (joined[:, 0] != joined[:, 2]) | (joined[:, 1] != joined[:, 3])
    return np.compress(has_length, joined, axis=0)


def _face_bounds(edges: FloatArray, start: LabelArray) -> FloatArray:
    """Bounds (faces, 4) of the edges of each face."""
    if len(start) == 1:
        return np.zeros((0, 4))
    low, high = np.minimum.reduceat(edges[:, :2], start[:-1]), np.maximum.reduceat(edges[:, :2], start[:-1])
    return np.hstack([low, high])


def _widened(low: FloatArray, high: FloatArray, reach_m: float) -> tuple[float, float, float, float]:
    return (low[0] - reach_m, low[1] - reach_m, high[0] + reach_m, high[1] + reach_m)


def _circle(corners: FloatArray, top_z_m: float) -> tuple[float, float, float, float]:
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = np.hypot(*(corners - middle).T).max()
    return float(middle[0]), float(middle[1]), float(radius), top_z_m


def _cells(
    extent: tuple[float, float, float, float], pad_m: float, reaches: FloatArray, numbers: list[int]
) -> tuple[FloatArray, int, int, LabelArray, IntArray]:
    """The grid: the number of each object in every cell that its reach touches, in the order of the objects."""
    low = np.array(extent[:2]) - pad_m
    across = math.ceil((extent[2] - extent[0] + 2 * pad_m) / CELL_M)
    up = math.ceil((extent[3] - extent[1] + 2 * pad_m) / CELL_M)
    first = np.clip(np.floor((reaches[:, :2] - low) / CELL_M).astype(np.int64), 0, [across - 1, up - 1])
    last = np.clip(np.floor((reaches[:, 2:] - low) / CELL_M).astype(np.int64), 0, [across - 1, up - 1])
    columns, rows = (last - first + 1).T
    counts = columns * rows
    owner = np.repeat(np.arange(len(numbers)), counts)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    flat = (first[owner, 1] + rank // columns[owner]) * across + first[owner, 0] + rank % columns[owner]
    order = np.argsort(flat, kind="stable")
    start = np.zeros(across * up + 1, np.int32)
    start[1:] = np.cumsum(np.bincount(flat, minlength=across * up))
    return low, across, up, start, np.array(numbers, dtype=np.int64)[owner[order]]


def _crown_draws(start: LabelArray, objects: IntArray, trees: FloatArray, is_tile: bool) -> IntArray:
    """The place of each entry in its cell. For the tiles of a survey, whose cells differ, a hash of its position."""
    if not is_tile:
        return np.arange(len(objects)) - np.repeat(start[:-1], np.diff(start)).astype(np.int64)
    bits = np.ascontiguousarray(trees[:, :2]).view(np.uint64)
    hashed = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15) ^ (bits[:, 1] * np.uint64(0xD1B54A32D192ED03)) >> np.uint64(7)
    hashed = (hashed ^ (hashed >> np.uint64(31))) * np.uint64(0x94D049BB133111EB)
    draws = ((hashed >> np.uint64(33)) * np.uint64(_DRAWS_PER_TREE)).astype(np.int64)
    result = np.zeros(len(objects), np.int64)
    result[objects < 0] = draws[~objects[objects < 0]]
    return result
