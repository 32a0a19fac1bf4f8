"""A block between streets, in its own frame: the base of the blocks of towns and cities."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipeline.model import FloatArray
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Box, Building, Terrain, Tree, place_building, turned
from pipeline.ruler.simulation.suburb import car_at, tree_at


def in_street_frame(places: FloatArray, azimuth_deg: float) -> FloatArray:
    """Scene coordinates (n, 2) in the frame of the streets: the inverse of `turned` about the origin."""
    azimuth = math.radians(azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    return np.column_stack([places[:, 0] * east + places[:, 1] * north, places[:, 1] * east - places[:, 0] * north])


class StreetBlock:
    """The buildings, trees and cars of one block, all drawn from its own random state.

    Places are given by u along the long streets, which run to `azimuth_deg`, and v across them, metres from the middle
    (2,) of the block. Names of buildings begin with that of the block; `state` is the seed of its random numbers.
    """

    def __init__(
        self, name: str, middle: FloatArray, azimuth_deg: float, terrain: Terrain, state: Sequence[int]
    ) -> None:
        self.name = name
        self.middle = middle
        self.azimuth_deg = azimuth_deg
        self.terrain = terrain
        self.random = np.random.default_rng(list(state))
        self.buildings: list[Building] = []
        self.trees: list[Tree] = []
        self.boxes: list[Box] = []

    def _uniform(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def _place(self, u: float, v: float) -> tuple[float, float]:
        x, y = turned(np.array([(u, v)]), float(self.middle[0]), float(self.middle[1]), self.azimuth_deg)[0]
        return float(x), float(y)

    def _put_up(
        self,
        shape: RoofShape,
        size: RoofDimensions,
        at: tuple[float, float],
        *,
        eave_m: float,
        turn_deg: float = 0.0,
        block: str | None = None,
    ) -> Building:
        """Add a building with its ridge turned by `turn_deg` from the long streets."""
        building = place_building(
            f"{self.name}-{len(self.buildings):02d}",
            shape,
            size,
            at=self._place(*at),
            azimuth_deg=(self.azimuth_deg + turn_deg) % 360.0,
            eave_height_m=eave_m,
            terrain=self.terrain,
            block_id=block,
        )
        self.buildings.append(building)
        return building

    def _line_kerbs(
        self, block_m: tuple[float, float], tree_share: float, radii_m: tuple[float, float], tree_m: float
    ) -> None:
        """Cars (45 %) and trees at the kerbs of the long sides; trees stand `tree_m` outside the block."""
        for side in (-1.0, 1.0):
            for u in np.arange(-block_m[0] / 2 + 4.0, block_m[0] / 2 - 4.0, 7.5):
                kind, shift = self.random.random(), self._uniform(-1.0, 1.0)
                if kind < 0.45:
                    x, y = self._place(float(u) + shift, side * (block_m[1] / 2 + 1.3))
                    self.boxes.append(car_at(x, y, self.azimuth_deg, self.terrain, self.random))
                elif kind < 0.45 + tree_share:
                    x, y = self._place(float(u) + shift, side * (block_m[1] / 2 + tree_m))
                    radius = self._uniform(*radii_m)
                    self.trees.append(tree_at(x, y, radius, radius * 2.8, self.terrain))
