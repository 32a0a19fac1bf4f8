"""What many lines hit first, as arrays; among them the vertical ones, which see the top surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.ruler.simulation.first_hit import ROOF, WALL, cell_of, first_hit, terrain_hit
from pipeline.ruler.simulation.scene import Scene
from pipeline.ruler.simulation.scene_arrays import SceneArrays, scene_arrays


@kernel
def _first_hits(
    scene: SceneArrays,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    lean_x: FloatArray,
    lean_y: FloatArray,
    states: npt.NDArray[np.uint64],
    kind: LabelArray,
    thing: LabelArray,
    face: LabelArray,
) -> None:
    """The first hits of lines through terrain points; z is replaced by the elevation of the hit."""
    for k in range(len(x)):
        z[k], kind[k], thing[k], face[k] = first_hit(
            scene,
            cell_of(scene.grid, scene.cells_across, scene.cells_up, x[k], y[k]),
            x[k],
            y[k],
            z[k],
            lean_x[k],
            lean_y[k],
            states[k] if len(states) > 0 else np.uint64(0),
            0 if len(states) > 0 else -1,
        )


@kernel
def _landings(
    scene: SceneArrays, x: FloatArray, y: FloatArray, z: FloatArray, lean_x: FloatArray, lean_y: FloatArray
) -> None:
    """Move points (x, y, z) along their lines to the terrain."""
    for k in range(len(x)):
        x[k], y[k], z[k] = terrain_hit(scene.terrain, scene.waves, x[k], y[k], z[k], lean_x[k], lean_y[k])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hits:
    """What n lines hit first."""

    xyz: FloatArray
    """(n, 3) float64, scene frame, metres."""
    kind: LabelArray
    """(n,) int32: GROUND, ROOF, WALL, TREE or BOX."""
    building: LabelArray
    """(n,) int32, number of the building; -1 where there is none."""
    face: LabelArray
    """(n,) int32, number of its roof face; -1 for walls and where there is no building."""

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
    """What leaning lines hit first.

    Parameters
    ----------
    arrays : SceneArrays
        Made for at least this lean.
    places : ndarray (n, 3)
        Any place of each line, scene frame.
    leans : ndarray (n, 2)
        Metres east and north per metre up.
    states : ndarray (n,) uint64, optional
        Random states that decide how deep lines sink into crowns; without them crowns are left out.
    """
    x, y, z = (np.array(column, dtype=np.float64) for column in places.T)
    lean_x, lean_y = (np.array(column, dtype=np.float64) for column in leans.T)
    _landings(arrays, x, y, z, lean_x, lean_y)
    top, kind, thing, face = z.copy(), *(np.empty(len(x), np.int32) for _ in range(3))
    states = np.zeros(0, np.uint64) if states is None else states
    _first_hits(arrays, x, y, top, lean_x, lean_y, states, kind, thing, face)
    building = np.where((kind == ROOF) | (kind == WALL), thing, -1).astype(np.int32)
    xyz = np.column_stack([x + (top - z) * lean_x, y + (top - z) * lean_y, top])
    return Hits(xyz=xyz, kind=kind, building=building, face=face)


def top_surface(scene: Scene, x: FloatArray, y: FloatArray) -> Hits:
    """The top surface (terrain, roofs, boxes; no trees) at scene coordinates x, y, each (n,) float64."""
    places = np.column_stack([x, y, scene.terrain.elevation(x, y)])
    return hits_of_lines(scene_arrays(scene), places, np.zeros((len(x), 2)))
