"""Layout of a town of any size: blocks between streets, rows of touching houses, courtyards, halls and parks.

Every block has a random state of its own, so a larger town holds the smaller one unchanged.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.model import FloatArray
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Box, Building, Scene, Terrain, Tree, turned, undulating_terrain
from pipeline.ruler.simulation.street_blocks import StreetBlock, in_street_frame
from pipeline.ruler.simulation.suburb import house_size, tree_at

BLOCK_M = (84.0, 52.0)
"""A block along and across the streets."""
STREET_M = 12.0
"""Width of the streets on all sides."""
TOWN_AZIMUTH_DEG = 62.0
"""Direction of the long streets, clockwise from north: borders of tiles cut houses at an angle."""
_ROW_INSET_M = 2.0
_ROW_DEPTH_M = 11.0


def town(seed: int, size_m: tuple[float, float] = (400.0, 400.0), name: str = "town") -> Scene:
    """A town on gentle terrain with about 2,300 buildings per square kilometre.

    Buildings that touch share a block_id; some stand across the end of the data.
    """
    random = np.random.default_rng([seed, 0x70])
    terrain = undulating_terrain(42.0, 1.2, random.uniform(0, 360), 2.5, 420.0, random)
    step = np.array([BLOCK_M[0] + STREET_M, BLOCK_M[1] + STREET_M])
    corners = np.array([(0.0, 0.0), (size_m[0], 0.0), size_m, (0.0, size_m[1])])
    local = in_street_frame(corners, TOWN_AZIMUTH_DEG)
    first, last = np.floor(local.min(axis=0) / step).astype(int), np.ceil(local.max(axis=0) / step).astype(int)
    buildings: list[Building] = []
    trees: list[Tree] = []
    boxes: list[Box] = []
    for row in range(first[1], last[1] + 1):
        for column in range(first[0], last[0] + 1):
            middle = turned((np.array([(column, row)]) + 0.5) * step, 0.0, 0.0, TOWN_AZIMUTH_DEG)[0]
            if not (-60.0 < middle[0] < size_m[0] + 60.0 and -60.0 < middle[1] < size_m[1] + 60.0):
                continue
            block = _Block(f"{name}-{column}_{row}", middle, terrain, (seed, 0x71, column + 2**20, row + 2**20))
            buildings += [one for one in block.buildings if _is_inside(one.vertices, size_m)]
            trees += [one for one in block.trees if 0 <= one.x < size_m[0] and 0 <= one.y < size_m[1]]
            boxes += [one for one in block.boxes if _is_inside(one.corners, size_m)]
    return Scene(
        name=name,
        origin=(566_000.0, 5_935_000.0, 0.0),
        extent=(0.0, 0.0, *size_m),
        terrain=terrain,
        buildings=tuple(buildings),
        trees=tuple(trees),
        boxes=tuple(boxes),
    )


def _is_inside(vertices: FloatArray, size_m: tuple[float, float]) -> bool:
    """Whether any part reaches into the extent."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return bool(high[0] > 0 and high[1] > 0 and low[0] < size_m[0] and low[1] < size_m[1])


class _Block(StreetBlock):
    """One block of the town."""

    def __init__(self, name: str, middle: FloatArray, terrain: Terrain, state: tuple[int, ...]) -> None:
        super().__init__(name, middle, TOWN_AZIMUTH_DEG, terrain, state)
        kind = self.random.random()
        if kind < 0.55:
            self._rows()
        elif kind < 0.82:
            self._detached()
        elif kind < 0.92:
            self._hall()
        else:
            self._planted(14, BLOCK_M[0] / 2 - 5.0, BLOCK_M[1] / 2 - 5.0)
        self._line_kerbs(BLOCK_M, tree_share=0.15, radii_m=(1.5, 2.8), tree_m=1.5)

    def _rows(self) -> None:
        """Two rows of touching houses, 2 to 4 storeys, and trees in the court between them."""
        for side in (-1.0, 1.0):
            u, end = -BLOCK_M[0] / 2 + _ROW_INSET_M, BLOCK_M[0] / 2 - _ROW_INSET_M
            storeys = int(self.random.integers(2, 5))
            pitch = self._uniform(30.0, 45.0)
            while end - u > 5.5:
                width = self._uniform(6.0, 9.0)
                if end - u - width < 5.5:
                    width = end - u
                flat = self.random.random() < 0.2
                eave = 3.1 * max(2, storeys + int(self.random.integers(-1, 2))) + self._uniform(-0.4, 0.4)
                size = RoofDimensions(length_m=width, width_m=_ROW_DEPTH_M, pitch_deg=0.0 if flat else pitch)
                shape = RoofShape.FLAT if flat else RoofShape.GABLE
                v = side * (BLOCK_M[1] / 2 - _ROW_INSET_M - _ROW_DEPTH_M / 2)
                self._put_up(shape, size, (u + width / 2, v), eave_m=eave, block=f"{self.name}-row{'-+'[side > 0]}")
                u += width
        self._planted(5, BLOCK_M[0] / 2 - 6.0, BLOCK_M[1] / 2 - _ROW_INSET_M - _ROW_DEPTH_M - 5.0)

    def _detached(self) -> None:
        """Eight detached houses of all shapes."""
        shapes = [RoofShape.FLAT, RoofShape.PENT, RoofShape.GABLE, RoofShape.HIP, RoofShape.L_SHAPE]
        for side in (-1.0, 1.0):
            for k in range(4):
                shape = shapes[int(self.random.integers(len(shapes)))]
                turn = (0.0 if side > 0 else 180.0) + self._uniform(-2.0, 2.0)
                eave = 2.9 * int(self.random.integers(1, 3)) + self._uniform(0.2, 0.8)
                # The wing of an L stands out to the left of the ridge: turned so that this is the court.
                size = house_size(shape, self.random)
                self._put_up(shape, size, ((k - 1.5) * 20.5, side * 15.5), eave_m=eave, turn_deg=turn + 180.0)
        self._planted(4, BLOCK_M[0] / 2 - 6.0, 2.0)

    def _hall(self) -> None:
        """A large flat hall with a lower flat part that touches it."""
        length, depth = self._uniform(42.0, 56.0), self._uniform(24.0, 34.0)
        high = self._uniform(7.0, 11.0)
        block = f"{self.name}-hall"
        hall = RoofDimensions(length_m=length, width_m=depth)
        self._put_up(RoofShape.FLAT, hall, (-8.0, 0.0), eave_m=high, block=block)
        office = RoofDimensions(length_m=12.0, width_m=depth)
        self._put_up(RoofShape.FLAT, office, (-8.0 + length / 2 + 6.0, 0.0), eave_m=high - 3.4, block=block)
        self._planted(2, BLOCK_M[0] / 2 - 2.0, BLOCK_M[1] / 2 - 2.0)

    def _planted(self, count: int, half_length_m: float, half_width_m: float) -> None:
        """Trees in a rectangle, none with its trunk in a house."""
        for _ in range(count):
            u, v = self._uniform(-half_length_m, half_length_m), self._uniform(-half_width_m, half_width_m)
            radius = self._uniform(2.0, 4.2)
            height = radius * self._uniform(2.2, 3.0)
            x, y = self._place(u, v)
            if not any(_stands_in(one, x, y, 0.6 * radius) for one in self.buildings):
                self.trees.append(tree_at(x, y, radius, height, self.terrain))


def _stands_in(building: Building, x: float, y: float, margin_m: float) -> bool:
    """Whether a place lies in the bounding circle of a building's main rectangle and within its turned bounds."""
    azimuth = math.radians(building.azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    u = (x - building.x) * east + (y - building.y) * north
    v = (y - building.y) * east - (x - building.x) * north
    size = building.dimensions
    right, left = size.width_m / 2 + margin_m, size.width_m / 2 + size.wing_length_m + margin_m
    return abs(u) < size.length_m / 2 + margin_m and -right < v < left
