"""The blocks of a city: rows, perimeters with courtyards, halls, towers, churches, detached houses, parks.

Every block draws from its own random state. It is the same in a city of any size and for any tile.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.simulation.additions import can_have_dormers, random_dormers, random_superstructures
from pipeline.ruler.simulation.plots import PlannedBuilding
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Building, Defect, Terrain, WetSpot
from pipeline.ruler.simulation.street_blocks import StreetBlock
from pipeline.ruler.simulation.suburb import tree_at

BLOCK_M = (96.0, 60.0)
"""A block along and across the streets."""
STREET_M = 14.0
"""Width of the streets on all sides."""
CITY_AZIMUTH_DEG = 67.0
"""Direction of the long streets, clockwise from north: borders of tiles cut houses at an angle."""
TALLEST_M = 60.0
"""No object of a block is higher than this above the lowest ground below it."""

_DEPTH_M = 11.5
"""Depth of the houses of a row."""
_INSET_M = 2.0
"""Front gardens of rows."""
_OVERHANGING = 0.25
"""Share of the trees that may hang over a house."""
_STEEP_DEG = 9.0
"""On steeper ground only detached houses and parks stand."""


class BlockKind(StrEnum):
    """What a block is built with."""

    ROWS = "rows"
    PERIMETER = "perimeter"
    COURTYARDS = "courtyards"
    DETACHED = "detached"
    HALL = "hall"
    TOWERS = "towers"
    CHURCH = "church"
    PARK = "park"


_SHARES: Mapping[BlockKind, float] = {
    BlockKind.ROWS: 0.27,
    BlockKind.PERIMETER: 0.22,
    BlockKind.COURTYARDS: 0.07,
    BlockKind.DETACHED: 0.24,
    BlockKind.HALL: 0.08,
    BlockKind.TOWERS: 0.05,
    BlockKind.CHURCH: 0.02,
    BlockKind.PARK: 0.05,
}

_DETACHED = (
    *((RoofShape.GABLE,) * 4),
    *((RoofShape.UNEQUAL_GABLE,) * 2),
    *((RoofShape.HIP,) * 2),
    *((RoofShape.L_SHAPE,) * 2),
    RoofShape.HALF_HIP,
    RoofShape.BENT_HIP,
    RoofShape.PYRAMID,
    RoofShape.MANSARD,
    RoofShape.GAMBREL,
    RoofShape.T_SHAPE,
    RoofShape.CROSS,
    RoofShape.PENT,
    RoofShape.FLAT,
    RoofShape.MULTI_LEVEL_FLAT,
)


class _Chances(NamedTuple):
    """Chances of additions to the roof of a building, 0 to 1."""

    dormers: float = 0.0
    boxes: float = 0.0
    wet: float = 0.02


_NO_CHANCES = _Chances()


class Block(StreetBlock):
    """One block of the city."""

    def __init__(self, name: str, middle: FloatArray, terrain: Terrain, state: tuple[int, ...]) -> None:
        super().__init__(name, middle, CITY_AZIMUTH_DEG, terrain, state)
        self._outlines: list[shapely.Polygon] = []
        self.kind = self._drawn_kind()
        _MAKERS[self.kind](self)
        self._line_kerbs(BLOCK_M, tree_share=0.3, radii_m=(1.5, 3.2), tree_m=3.4)
        self._mark_overhung()

    def _drawn_kind(self) -> BlockKind:
        shares = np.array(list(_SHARES.values()))
        kind = list(_SHARES)[int(np.searchsorted(np.cumsum(shares) / shares.sum(), self.random.random()))]
        corners = [self._place(u, v) for u in (-40.0, 0.0, 40.0) for v in (-25.0, 25.0)]
        if max(self.terrain.slope_deg(x, y) for x, y in corners) > _STEEP_DEG:
            return BlockKind.PARK if kind in {BlockKind.PARK, BlockKind.HALL} else BlockKind.DETACHED
        return kind

    def _build(
        self,
        shape: RoofShape,
        size: RoofDimensions,
        at: tuple[float, float],
        chances: _Chances = _NO_CHANCES,
        *,
        eave_m: float,
        turn_deg: float = 0.0,
        block: str | None = None,
    ) -> Building:
        """Put up a building, with additions to its roof by chance."""
        defects = []
        if can_have_dormers(shape) and self.random.random() < chances.dormers:
            additions = random_dormers(shape, size, self.random)
            size = dataclasses.replace(size, additions=size.additions + additions)
            defects += [Defect.DORMERS] * bool(additions)
        if self.random.random() < chances.boxes:
            additions = random_superstructures(shape, size, self.random, besides=size.additions)
            size = dataclasses.replace(size, additions=size.additions + additions)
            defects += [Defect.SUPERSTRUCTURE] * bool(additions)
        building = self._put_up(shape, size, at, eave_m=eave_m, turn_deg=turn_deg, block=block)
        if self.random.random() < chances.wet:
            building = dataclasses.replace(building, wet_spots=(self._wet_spot(building),))
            defects.append(Defect.WET_SPOT)
        self.buildings[-1] = dataclasses.replace(building, defects=tuple(defects))
        return self.buildings[-1]

    def _wet_spot(self, building: Building) -> WetSpot:
        """A circle over a vertex of the roof's plan, drawn towards the middle of the building."""
        low, high = building.vertices.min(axis=0), building.vertices.max(axis=0)
        corner = building.vertices[int(self.random.integers(len(building.vertices)))]
        share = self._uniform(0.3, 0.7)
        return WetSpot(
            x=building.x + share * float(corner[0] - building.x),
            y=building.y + share * float(corner[1] - building.y),
            radius_m=self._uniform(0.05, 0.15) * float(np.hypot(*(high - low)[:2])),
        )

    def _row(self, along: bool, middle: float, span: float, storeys: int, pitch_deg: float, side: str) -> None:
        """Touching houses over `span` metres, centred on the block's axis, with their middle line at `middle`."""
        at, end = -span / 2, span / 2
        while end - at > 5.5:
            width = self._uniform(6.0, 11.0)
            if end - at - width < 5.5:
                width = end - at
            kind = self.random.random()
            eave = 3.1 * max(1, storeys + int(self.random.integers(-1, 2))) + self._uniform(-0.4, 0.4)
            shape, size = RoofShape.GABLE, RoofDimensions(length_m=width, width_m=_DEPTH_M, pitch_deg=pitch_deg)
            if kind < 0.15:
                shape, size = RoofShape.FLAT, RoofDimensions(length_m=width, width_m=_DEPTH_M)
            elif kind < 0.25:
                size = RoofDimensions(
                    length_m=width, width_m=_DEPTH_M, pitch_deg=62.0, second_pitch_deg=24.0, break_share=0.35
                )
                shape = RoofShape.GAMBREL
            place = (at + width / 2, middle) if along else (middle, at + width / 2)
            is_flat = shape is RoofShape.FLAT
            chances = _Chances(dormers=0.25, boxes=0.4 if is_flat else 0.12, wet=0.1 if is_flat else 0.01)
            turn_deg = 0.0 if along else 270.0
            self._build(shape, size, place, chances, eave_m=eave, turn_deg=turn_deg, block=f"{self.name}-{side}")
            at += width

    def rows(self) -> None:
        """Two rows of touching houses with gardens between them."""
        for side in (-1.0, 1.0):
            self._row(
                True,
                side * (BLOCK_M[1] / 2 - _INSET_M - _DEPTH_M / 2),
                BLOCK_M[0] - 2 * _INSET_M,
                int(self.random.integers(1, 4)),
                self._uniform(30.0, 45.0),
                "row" + "-+"[side > 0],
            )
        self._planted(24, BLOCK_M[0] / 2 - 6.0, BLOCK_M[1] / 2 - _INSET_M - _DEPTH_M - 1.0)

    def perimeter(self) -> None:
        """Four rows around a courtyard with trees and a low shed."""
        storeys, pitch = int(self.random.integers(3, 6)), self._uniform(32.0, 45.0)
        half_u, half_v = BLOCK_M[0] / 2 - _INSET_M, BLOCK_M[1] / 2 - _INSET_M
        for side in (-1.0, 1.0):
            self._row(True, side * (half_v - _DEPTH_M / 2), 2 * half_u, storeys, pitch, "perimeter")
        for side in (-1.0, 1.0):
            self._row(False, side * (half_u - _DEPTH_M / 2), 2 * (half_v - _DEPTH_M), storeys, pitch, "perimeter")
        shed = RoofDimensions(length_m=self._uniform(6.0, 14.0), width_m=self._uniform(4.0, 7.0), pitch_deg=8.0)
        self._build(RoofShape.PENT, shed, (self._uniform(-18.0, 18.0), 0.0), eave_m=2.8)
        self._planted(20, half_u - _DEPTH_M - 3.0, half_v - _DEPTH_M - 3.0)

    def courtyards(self) -> None:
        """Two large buildings: closed around a court, U-shaped, or with a mansard roof."""
        for side in (-1.0, 1.0):
            shape = (RoofShape.COURTYARD, RoofShape.U_SHAPE, RoofShape.MANSARD)[int(self.random.integers(3))]
            area = self._uniform(600.0, 900.0)
            self._fitted(shape, (side * BLOCK_M[0] / 4, 0.0), (44.0, 54.0), area, (3, 6), dormers=0.4)
        self._planted(18, BLOCK_M[0] / 2 - 3.0, BLOCK_M[1] / 2 - 3.0)

    def detached(self) -> None:
        """Eight detached houses of all shapes with gardens."""
        for side in (-1.0, 1.0):
            for k in range(4):
                shape = _DETACHED[int(self.random.integers(len(_DETACHED)))]
                at = ((k - 1.5) * 23.5 + self._uniform(-0.5, 0.5), side * 15.0 + self._uniform(-0.5, 0.5))
                house = self._fitted(shape, at, (19.5, 24.0), self._uniform(70.0, 200.0), (1, 3), dormers=0.3)
                if self.random.random() < 0.3:
                    self._overhanging(house)
        self._planted(44, BLOCK_M[0] / 2 - 2.0, BLOCK_M[1] / 2 - 2.0)

    def hall(self) -> None:
        """A large flat hall with superstructures, and a building of several levels or an office that touches it."""
        length, depth = self._uniform(40.0, 52.0), self._uniform(26.0, 42.0)
        high, block = self._uniform(7.0, 12.0), f"{self.name}-hall"
        hall = RoofDimensions(length_m=length, width_m=depth)
        self._build(RoofShape.FLAT, hall, (-16.0, 0.0), _Chances(boxes=1.0, wet=0.3), eave_m=high, block=block)
        office = RoofDimensions(length_m=self._uniform(9.0, 14.0), width_m=depth)
        at = -16.0 + length / 2 + office.length_m / 2
        self._build(RoofShape.FLAT, office, (at, 0.0), _Chances(boxes=0.5, wet=0.1), eave_m=high - 3.4, block=block)
        self._fitted(RoofShape.MULTI_LEVEL_FLAT, (BLOCK_M[0] / 2 - 10.0, 0.0), (16.0, 50.0), 220.0, (1, 3), boxes=0.5)
        self._planted(14, BLOCK_M[0] / 2 - 2.0, BLOCK_M[1] / 2 - 2.0)

    def towers(self) -> None:
        """Two slabs of 6 to 12 storeys with lift shafts, and a low pavilion."""
        for side in (-1.0, 1.0):
            size = RoofDimensions(length_m=self._uniform(22.0, 34.0), width_m=self._uniform(12.0, 16.0))
            storeys = int(self.random.integers(6, 13))
            turn_deg, eave_m = 90.0 * int(self.random.integers(0, 2)), 2.9 * storeys + 1.0
            chances = _Chances(boxes=1.0, wet=0.3)
            self._build(RoofShape.FLAT, size, (side * 26.0, side * 8.0), chances, eave_m=eave_m, turn_deg=turn_deg)
        self._fitted(RoofShape.MULTI_LEVEL_FLAT, (0.0, 0.0), (14.0, 22.0), 160.0, (1, 2))
        self._planted(40, BLOCK_M[0] / 2 - 3.0, BLOCK_M[1] / 2 - 3.0)

    def church(self) -> None:
        """A steep nave with transepts, and a tower with a pyramid that touches its western end."""
        block = f"{self.name}-church"
        nave = RoofDimensions(
            length_m=self._uniform(30.0, 40.0),
            width_m=self._uniform(11.0, 14.0),
            pitch_deg=self._uniform(48.0, 58.0),
            wing_width_m=self._uniform(8.0, 10.0),
            wing_length_m=self._uniform(4.0, 7.0),
            wing_offset_m=6.0,
        )
        self._build(RoofShape.CROSS, nave, (4.0, 0.0), eave_m=self._uniform(9.0, 12.0), block=block)
        side = self._uniform(6.0, 8.0)
        tower = RoofDimensions(length_m=side, width_m=side, pitch_deg=self._uniform(55.0, 68.0))
        west = 4.0 - nave.length_m / 2 - side / 2
        self._build(RoofShape.PYRAMID, tower, (west, 0.0), eave_m=self._uniform(22.0, 32.0), block=block)
        self._planted(40, BLOCK_M[0] / 2 - 3.0, BLOCK_M[1] / 2 - 3.0)

    def park(self) -> None:
        """Trees and a kiosk."""
        kiosk = RoofDimensions(length_m=5.0, width_m=5.0, pitch_deg=25.0)
        self._build(RoofShape.PYRAMID, kiosk, (0.0, 0.0), eave_m=2.6)
        self._planted(60, BLOCK_M[0] / 2 - 4.0, BLOCK_M[1] / 2 - 4.0)

    def _fitted(
        self,
        shape: RoofShape,
        at: tuple[float, float],
        lot_m: tuple[float, float],
        area_m2: float,
        storeys: tuple[int, int],
        dormers: float = 0.0,
        boxes: float = 0.12,
    ) -> Building:
        """A building of a shape about `at`, made smaller until it fits a lot."""
        quarter = 90.0 * int(self.random.integers(0, 4))
        while True:
            size = random_dimensions(shape, self.random, area_m2=area_m2)
            # In the block's frame u runs to azimuth 90 and v to azimuth 0 of a plan whose ridge points to 90 - turn.
            low, high = PlannedBuilding(shape=shape, dimensions=size, azimuth_deg=90.0 + quarter, margin_m=0.0).bounds
            if (high - low <= np.array(lot_m)).all():
                break
            quarter += 90.0
            area_m2 *= 0.93
        eave = 2.9 * int(self.random.integers(*storeys)) + self._uniform(0.2, 0.8)
        flat = shape in {RoofShape.FLAT, RoofShape.MULTI_LEVEL_FLAT}
        place = (at[0] - float(low[0] + high[0]) / 2, at[1] - float(low[1] + high[1]) / 2)
        chances = _Chances(dormers=dormers, boxes=boxes, wet=0.1 if flat else 0.02)
        return self._build(shape, size, place, chances, eave_m=eave, turn_deg=quarter)

    def _overhanging(self, house: Building) -> None:
        """A tree whose crown hangs over a house."""
        outline = house.footprint.exterior
        at = outline.interpolate(self._uniform(0.0, outline.length))
        away = np.array([at.x - house.x, at.y - house.y])
        away /= max(float(np.hypot(*away)), 1e-9)
        radius = self._uniform(2.0, 3.8)
        x, y = np.array([at.x, at.y]) + away * radius * self._uniform(0.35, 0.7)
        height = max(2.4 * radius, house.eave_z_m - house.floor_z_m + self._uniform(1.0, 4.0))
        if (self._distances(float(x), float(y)) > 0.35 * radius).all():
            self.trees.append(tree_at(float(x), float(y), radius, height, self.terrain))

    def _planted(self, count: int, half_length_m: float, half_width_m: float) -> None:
        """Trees and shrubs in a rectangle; the crowns of some hang over a house."""
        for _ in range(count):
            u, v = self._uniform(-half_length_m, half_length_m), self._uniform(-half_width_m, half_width_m)
            radius = self._uniform(0.6, 4.8)
            height = radius * self._uniform(2.2, 3.0)
            reach = radius * (0.4 if self.random.random() < _OVERHANGING else 1.0)
            x, y = self._place(u, v)
            if (self._distances(x, y) > reach).all():
                self.trees.append(tree_at(x, y, radius, height, self.terrain))

    def _distances(self, x: float, y: float) -> FloatArray:
        """From a place to the outline of every building in plan; 0 inside."""
        self._outlines += [building.footprint for building in self.buildings[len(self._outlines) :]]
        return np.asarray(shapely.distance(self._outlines, shapely.Point(x, y)))

    def _mark_overhung(self) -> None:
        """Mark the houses with a crown over their roof: one that rises over the eave where it crosses the outline."""
        for tree in self.trees:
            away = self._distances(tree.x, tree.y) / tree.crown_radius_m
            for k in np.flatnonzero(away < 1.0).tolist():
                house = self.buildings[k]
                top_z_m = tree.crown_z_m + tree.crown_half_height_m * math.sqrt(1.0 - float(away[k]) ** 2)
                if top_z_m > house.eave_z_m and Defect.OVERHANGING_TREE not in house.defects:
                    defects = (*house.defects, Defect.OVERHANGING_TREE)
                    self.buildings[k] = dataclasses.replace(house, defects=defects)


_MAKERS: Mapping[BlockKind, Callable[[Block], None]] = {
    BlockKind.ROWS: Block.rows,
    BlockKind.PERIMETER: Block.perimeter,
    BlockKind.COURTYARDS: Block.courtyards,
    BlockKind.DETACHED: Block.detached,
    BlockKind.HALL: Block.hall,
    BlockKind.TOWERS: Block.towers,
    BlockKind.CHURCH: Block.church,
    BlockKind.PARK: Block.park,
}
