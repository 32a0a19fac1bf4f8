"""Layout of a city of any size that is never in memory as a whole: each tile makes the blocks that it can see."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

from pipeline.model import FloatArray
from pipeline.ruler.simulation.city_blocks import BLOCK_M, CITY_AZIMUTH_DEG, STREET_M, TALLEST_M, Block
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain, turned, undulating_terrain
from pipeline.ruler.simulation.street_blocks import in_street_frame
from pipeline.ruler.simulation.strips import ScannerSettings, reach_m

Extent = tuple[float, float, float, float]
"""Smallest x, smallest y, largest x, largest y in the scene frame."""

TILE_M = 500.0
"""Edge of the tiles in which a city is scanned and written."""
STEEPEST_DEG = 29.0
"""Slope of the hillside; the gentle waves over it add less than a degree."""
_HILL_LENGTH_M, _HILL_MIDDLE_M, _HILL_AZIMUTH_DEG = 3200.0, 1000.0, 80.0
_BASE_Z_M = 260.0
_WAVE_M, _WAVE_LENGTH_M = 0.3, 190.0
_BLOCK_REACH_M = math.hypot(BLOCK_M[0] + STREET_M, BLOCK_M[1] + STREET_M) / 2 + 5.0
_BLOCKS_KEPT = 600

CITY_SCANNER = ScannerSettings(
    pulse_density_per_m2=8.0,
    range_noise_m=0.03,
    altitude_m=1500.0,
    strip_spacing_m=400.0,
    strip_overlap=0.15,
    flight_azimuth_deg=90.0,
    strip_shift_m=0.06,
    strip_lift_m=0.02,
    wrong_row_share=0.0005,
    wrong_row_lift_m=0.6,
)
"""Strips with their own shift and lift, and an occasional wrong scan row."""


def city_terrain(seed: int) -> Terrain:
    """A plain, a hillside of up to 30 deg about 1 km to the east, a plateau behind it, and so on; gentle waves over it.

    Along the hill's axis the slope is that of cos^5, whose Fourier series has three terms: the ground is level for
    more than a third of the way.
    """
    random = np.random.default_rng([seed, 0xC0])
    steepest, number = math.tan(math.radians(STEEPEST_DEG)), 2 * math.pi / _HILL_LENGTH_M
    azimuth = math.radians(_HILL_AZIMUTH_DEG)
    waves = np.zeros((5, 4))
    for k, (order, share) in enumerate(((1, 10 / 16), (3, 5 / 16), (5, 1 / 16))):
        own = order * number
        waves[k] = steepest * share / own, own * math.sin(azimuth), own * math.cos(azimuth), -own * _HILL_MIDDLE_M
    for k, (amplitude, length) in enumerate(((0.9, 430.0), (0.25, 190.0)), start=3):
        direction, phase = random.uniform(0, 2 * math.pi, 2)
        own = 2 * math.pi / length
        waves[k] = amplitude, own * math.cos(direction), own * math.sin(direction), phase
    return Terrain(base_z_m=_BASE_Z_M, waves=waves)


def hillside(seed: int, slope_deg: float) -> Terrain:
    """A plane of one slope (0 to `STEEPEST_DEG` + 1), its aspect drawn, with waves that add less than a degree."""
    random = np.random.default_rng([seed, 0xC2])
    aspect_deg = float(random.uniform(0.0, 360.0))
    return undulating_terrain(_BASE_Z_M, slope_deg, aspect_deg, _WAVE_M, _WAVE_LENGTH_M, random)


class CityPlan:
    """A city that is made tile by tile; its survey determines how far a tile can see.

    A larger city contains the smaller one unchanged, except at the edge of the smaller one. The ground is that of
    `city_terrain` by default.
    """

    def __init__(
        self,
        seed: int,
        size_m: tuple[float, float],
        settings: ScannerSettings = CITY_SCANNER,
        name: str = "city",
        terrain: Terrain | None = None,
    ) -> None:
        self.seed = seed
        self.size_m = size_m
        self.settings = settings
        self.name = name
        self.terrain = city_terrain(seed) if terrain is None else terrain
        self._blocks: OrderedDict[tuple[int, int], Block] = OrderedDict()

    @property
    def whole(self) -> Extent:
        """Extent of the city."""
        return 0.0, 0.0, *self.size_m

    def part(self, extent: Extent) -> Scene:
        """The scene of one tile: everything that can change a return of a pulse that aims into the extent."""
        reach = reach_m(self.terrain, extent, self.settings, TALLEST_M)
        seen = (extent[0] - reach, extent[1] - reach, extent[2] + reach, extent[3] + reach)
        blocks = list(self._blocks_over(seen))
        return Scene(
            name=self.name,
            origin=(564_000.0, 5_938_000.0, 0.0),
            extent=extent,
            terrain=self.terrain,
            buildings=tuple(
                one
                for block in blocks
                for one in block.buildings
                if _meets(one.vertices, seen) and _meets(one.vertices, self.whole)
            ),
            trees=tuple(
                one
                for block in blocks
                for one in block.trees
                if 0.0 <= one.x < self.size_m[0]
                and 0.0 <= one.y < self.size_m[1]
                and seen[0] < one.x + one.crown_radius_m
                and seen[1] < one.y + one.crown_radius_m
                and one.x - one.crown_radius_m < seen[2]
                and one.y - one.crown_radius_m < seen[3]
            ),
            boxes=tuple(
                one
                for block in blocks
                for one in block.boxes
                if _meets(one.corners, seen) and _meets(one.corners, self.whole)
            ),
            survey_extent=self.whole,
        )

    def _blocks_over(self, extent: Extent) -> Iterator[Block]:
        """The blocks that reach into an extent, row by row; recent ones are cached."""
        step = np.array([BLOCK_M[0] + STREET_M, BLOCK_M[1] + STREET_M])
        x0, y0, x1, y1 = extent
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        local = in_street_frame(corners, CITY_AZIMUTH_DEG)
        first = np.floor((local.min(axis=0) - _BLOCK_REACH_M) / step).astype(int)
        last = np.ceil((local.max(axis=0) + _BLOCK_REACH_M) / step).astype(int)
        for row in range(first[1], last[1] + 1):
            for column in range(first[0], last[0] + 1):
                middle = turned((np.array([(column, row)]) + 0.5) * step, 0.0, 0.0, CITY_AZIMUTH_DEG)[0]
                away = np.hypot(max(x0 - middle[0], 0.0, middle[0] - x1), max(y0 - middle[1], 0.0, middle[1] - y1))
                if away < _BLOCK_REACH_M:
                    yield self._block(column, row, middle)

    def _block(self, column: int, row: int, middle: FloatArray) -> Block:
        key = column, row
        if key in self._blocks:
            self._blocks.move_to_end(key)
            return self._blocks[key]
        state = (self.seed, 0xC1, column + 2**20, row + 2**20)
        block = Block(f"{self.name}-{column}_{row}", middle, self.terrain, state)
        self._blocks[key] = block
        while len(self._blocks) > _BLOCKS_KEPT:
            self._blocks.popitem(last=False)
        return block


def city(seed: int, size_m: tuple[float, float] = (1000.0, 1000.0), name: str = "city") -> Scene:
    """A whole small city in memory. A square kilometre has about 1,500 buildings."""
    plan = CityPlan(seed, size_m, name=name)
    return plan.part(plan.whole)


def _meets(corners: FloatArray, extent: Extent) -> bool:
    """Whether the bounding box of points (n, 2 or more) reaches into an extent."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    return bool(high[0] > extent[0] and high[1] > extent[1] and low[0] < extent[2] and low[1] < extent[3])
