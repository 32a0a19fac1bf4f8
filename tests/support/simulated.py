"""Buildings and scenes for several tests of the simulation, and the first hits of many rays in them as arrays."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.ruler.simulation.first_hit import ROOF, WALL, Ray, cell_of, first_hit, terrain_hit
from pipeline.ruler.simulation.roofs import FlatPart, RoofDimensions, RoofShape
from pipeline.ruler.simulation.scene_arrays import SceneArrays, scene_arrays
from pipeline.ruler.simulation.simulated_scene import Building, Scene, Terrain, place_building

TWO_LEVELS = RoofDimensions(
    length_m=20.0,
    width_m=10.0,
    levels=(
        FlatPart(u_m=-5.0, v_m=0.0, length_m=10.0, width_m=10.0, height_m=3.0),
        FlatPart(u_m=5.0, v_m=-1.0, length_m=10.0, width_m=8.0, height_m=0.0),
    ),
)


def placed(shape: RoofShape, size: RoofDimensions, **more: Any) -> Building:
    """A building with its eave 4 m over level ground at 30 m, unless stated otherwise."""
    given = {"at": (51.3, 47.9), "azimuth_deg": 33.0, "eave_height_m": 4.0, "terrain": Terrain(base_z_m=30.0)}
    return place_building("a", shape, size, **{**given, **more})


def scene_on(terrain: Terrain, side_m: float, *buildings: Building, **more: Any) -> Scene:
    """A square scene at the origin, without a CRS."""
    given = {"name": "one", "origin": (0, 0, 0), "crs": None, "extent": (0, 0, side_m, side_m)}
    return Scene(terrain=terrain, buildings=buildings, **{**given, **more})


class Hits(NamedTuple):
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


def hits_of_lines(
    arrays: SceneArrays, places: FloatArray, leans: FloatArray, states: npt.NDArray[np.uint64] | None = None
) -> Hits:
    """The first hits of leaning rays in a scene made for at least this lean.

    Each ray passes through its place (n, 3), in metres of the scene frame, and leans (n, 2) metres east and north per
    metre up. The random states (n,) decide how deep rays sink into crowns; without them crowns are left out.
    """
    rays = np.column_stack([places, leans]).astype(np.float64)
    top, hits = np.empty(len(rays)), np.empty((len(rays), 3), np.int32)
    _first_hits(arrays, rays, np.zeros(0, np.uint64) if states is None else states, top, hits)
    kind, thing, face = (np.ascontiguousarray(column) for column in hits.T)
    building = np.where((kind == ROOF) | (kind == WALL), thing, -1).astype(np.int32)
    up = top - rays[:, 2]
    xyz = np.column_stack([rays[:, 0] + up * rays[:, 3], rays[:, 1] + up * rays[:, 4], top])
    return Hits(xyz, kind, building, face)


def top_surface(scene: Scene, x: FloatArray, y: FloatArray) -> Hits:
    """The top surface (terrain, roofs, boxes; no trees) at scene coordinates x, y, each (n,) float64."""
    places = np.column_stack([x, y, scene.terrain.elevation(x, y)])
    return hits_of_lines(scene_arrays(scene), places, np.zeros((len(x), 2)))
