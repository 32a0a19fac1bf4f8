"""The first hits of many rays as arrays; vertical rays see the top surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.ruler.simulation.first_hit import ROOF, WALL, Ray, cell_of, first_hit, terrain_hit
from pipeline.ruler.simulation.scene import Scene
from pipeline.ruler.simulation.scene_arrays import SceneArrays, scene_arrays


@kernel
def _first_hits(
    scene: SceneArrays, rays: FloatArray, states: npt.NDArray[np.uint64], top: FloatArray, hits: LabelArray
) -> None:
    """Move rays (n, 5) to the terrain; write the elevations (n,) and the kind, object and face (n, 3) that they hit."""
    for k in range(len(rays)):
        ray = Ray(rays[k, 0], rays[k, 1], rays[k, 2], rays[k, 3], rays[k, 4])
        ray = terrain_hit(scene.terrain, scene.waves, ray)
        rays[k, 0], rays[k, 1], rays[k, 2] = ray.x, ray.y, ray.z
        cell = cell_of(scene.grid, scene.cells_across, scene.cells_up, ray.x, ray.y)
        state, draw = (states[k], 0) if len(states) > 0 else (np.uint64(0), -1)
        top[k], hits[k, 0], hits[k, 1], hits[k, 2] = first_hit(scene, cell, ray, state, draw)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hits:
    """The first hits of n rays."""

    xyz: FloatArray
    """(n, 3) float64, scene frame, metres."""
    kind: LabelArray
    """(n,) int32: GROUND, ROOF, WALL, TREE or BOX."""
    building: LabelArray
    """(n,) int32, number of the building; -1 for none."""
    face: LabelArray
    """(n,) int32, number of its roof face; -1 for walls and without a building."""

    @property
    def z(self) -> FloatArray:
        """(n,) float64, elevations, metres."""
        return self.xyz[:, 2]

    @property
    def on_roof(self) -> BoolArray:
        """(n,) bool, True where a roof was hit."""
        return np.equal(self.kind, ROOF)


def hits_of_lines(
    arrays: SceneArrays, places: FloatArray, leans: FloatArray, states: npt.NDArray[np.uint64] | None = None
) -> Hits:
    """The first hits of leaning rays.

    Parameters
    ----------
    arrays : SceneArrays
        Made for at least this lean.
    places : ndarray (n, 3)
        Any point of each ray, scene frame, metres.
    leans : ndarray (n, 2)
        Metres east and north per metre up.
    states : ndarray (n,) uint64, optional
        Random states that decide how deep rays sink into crowns; without them crowns are left out.
    """
    rays = np.column_stack([places, leans]).astype(np.float64)
    top, hits = np.empty(len(rays)), np.empty((len(rays), 3), np.int32)
    _first_hits(arrays, rays, np.zeros(0, np.uint64) if states is None else states, top, hits)
    kind, thing, face = (np.ascontiguousarray(column) for column in hits.T)
    building = np.where((kind == ROOF) | (kind == WALL), thing, -1).astype(np.int32)
    up = top - rays[:, 2]
    xyz = np.column_stack([rays[:, 0] + up * rays[:, 3], rays[:, 1] + up * rays[:, 4], top])
    return Hits(xyz=xyz, kind=kind, building=building, face=face)


def top_surface(scene: Scene, x: FloatArray, y: FloatArray) -> Hits:
    """The top surface (terrain, roofs, boxes; no trees) at scene coordinates x, y, each (n,) float64."""
    places = np.column_stack([x, y, scene.terrain.elevation(x, y)])
    return hits_of_lines(scene_arrays(scene), places, np.zeros((len(x), 2)))
