"""A scene as flat arrays with a grid of its objects: what the kernels read."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.model import FloatArray, LabelArray
from pipeline.synthetic.scene import Scene

CELL_M = 5.0
"""Edge of the grid's cells."""


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
    ring_start: LabelArray
    """(faces + 1,) int32, first vertex of each face."""
    ring_x: FloatArray
    """(vertices,) float64."""
    ring_y: FloatArray
    """(vertices,) float64."""
    planes: FloatArray
    """(faces, 3) float64: a, b, c."""
    circles: FloatArray
    """(prisms, 4) float64, circle around each prism: x, y, radius; and its highest elevation."""
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
    circles: list[tuple[float, float, float, float]] = []
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
        circles.append(_circle(building.vertices[:, :2], building.ridge_z_m))
    for box in scene.boxes:
        rings.append(box.corners)
        planes.append((0.0, 0.0, box.top_z_m))
        ring_start.append(ring_start[-1] + len(box.corners))
        face_start.append(len(planes))
        bounds.append(_reach(box.corners.min(axis=0), box.corners.max(axis=0), 5.0 * max_lean + margin_m))
        circles.append(_circle(box.corners, box.top_z_m))
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
        circles=np.array(circles, dtype=np.float64).reshape(-1, 4),
        trees=trees,
        grid=grid,
        cells_across=across,
        cells_up=up,
        cell_start=cell_start,
        cell_entries=cell_entries,
    )


def _reach(low: FloatArray, high: FloatArray, reach_m: float) -> tuple[float, float, float, float]:
    return (low[0] - reach_m, low[1] - reach_m, high[0] + reach_m, high[1] + reach_m)


def _circle(corners: FloatArray, top_z_m: float) -> tuple[float, float, float, float]:
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = np.hypot(*(corners - middle).T).max()
    return float(middle[0]), float(middle[1]), float(radius), top_z_m


def _cells(
    extent: tuple[float, float, float, float], bounds: FloatArray, numbers: list[int]
) -> tuple[FloatArray, int, int, LabelArray, LabelArray]:
    """The grid: each object's number in every cell that its bounds touch, in the order of the objects."""
    pad = 50.0  # pulses may start outside the extent; beyond the grid nothing stands
    low = np.array(extent[:2]) - pad
    across = math.ceil((extent[2] - extent[0] + 2 * pad) / CELL_M)
    up = math.ceil((extent[3] - extent[1] + 2 * pad) / CELL_M)
    cells: list[npt.NDArray[np.int64]] = [np.zeros(0, np.int64)]
    entries: list[npt.NDArray[np.int64]] = [np.zeros(0, np.int64)]
    for bound, number in zip(bounds, numbers, strict=True):
        first = np.clip(np.floor((bound[:2] - low) / CELL_M).astype(int), 0, [across - 1, up - 1])
        last = np.clip(np.floor((bound[2:] - low) / CELL_M).astype(int), 0, [across - 1, up - 1])
        rows, columns = np.mgrid[first[1] : last[1] + 1, first[0] : last[0] + 1]
        cells.append((rows * across + columns).ravel())
        entries.append(np.full(rows.size, number))
    flat, values = np.concatenate(cells), np.concatenate(entries)
    order = np.argsort(flat, kind="stable")
    start = np.zeros(across * up + 1, np.int32)
    start[1:] = np.cumsum(np.bincount(flat, minlength=across * up))
    return low, across, up, start, values[order].astype(np.int32)
