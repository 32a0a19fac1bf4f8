"""Low small buildings: sheds, garages and carports of 7 to 25 m2, roofs 0.5 to 2.5 m above ground, some at houses.

They are made for given outlines: their points alone do not show whether such an object is a building. All are closed to
the ground, carports too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from pipeline.ruler.simulation.plots import PlannedBuilding, Plot, packed_plots
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Building, Scene, Terrain, Tree, place_building, undulating_terrain
from pipeline.ruler.simulation.strips import ScannerSettings
from pipeline.ruler.simulation.suburb import tree_at
from pipeline.ruler.simulation.sweep import Cell

SHAPES = (RoofShape.FLAT, RoofShape.PENT, RoofShape.GABLE)
OF_EACH = 24
"""Low buildings of each shape: a third share a wall with a house, a third are a gap away from one, a third are free."""
AREA_M2 = (7.0, 25.0)
HEIGHT_M = (0.5, 2.5)
"""Lowest eave and highest ridge above the highest ground at the outline."""
CELLS = tuple(Cell(density_per_m2=density, noise_m=0.03) for density in (5.0, 10.0, 15.0))
SCANNER = ScannerSettings(altitude_m=800.0, strip_spacing_m=100.0, strip_overlap=0.1)

_MARGIN_M = 3.0
_PITCH_DEG = {RoofShape.FLAT: (0.0, 0.0), RoofShape.PENT: (4.0, 20.0), RoofShape.GABLE: (12.0, 35.0)}
_GAP_M = (0.6, 2.0)
_HOUSE = RoofDimensions(length_m=9.0, width_m=8.0, pitch_deg=35.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Lot:
    """A low building, and beside it, along its ridge, perhaps a house."""

    number: int
    shape: RoofShape
    size: RoofDimensions
    azimuth_deg: float
    gap_m: float | None
    """Distance to the house, 0 for a common wall; None without a house."""

    @property
    def length_m(self) -> float:
        """Along the ridge."""
        return self.size.length_m + (0.0 if self.gap_m is None else self.gap_m + _HOUSE.length_m)

    @property
    def planned(self) -> PlannedBuilding:
        """The rectangle around it."""
        width = self.size.width_m if self.gap_m is None else max(self.size.width_m, _HOUSE.width_m)
        around = RoofDimensions(length_m=self.length_m, width_m=width)
        return PlannedBuilding(
            shape=RoofShape.FLAT, dimensions=around, azimuth_deg=self.azimuth_deg, margin_m=_MARGIN_M
        )

    def built(self, plot: Plot, terrain: Terrain, random: np.random.Generator) -> Iterator[Building]:
        """The low building, then the house."""
        name = f"low-{self.number:03d}-{self.shape}"
        vertical = HEIGHT_M[1] - HEIGHT_M[0] - _rise_m(self.shape, self.size)
        yield place_building(
            name,
            self.shape,
            self.size,
            at=self.place(plot, (self.size.length_m - self.length_m) / 2),
            azimuth_deg=self.azimuth_deg,
            eave_height_m=HEIGHT_M[0] + float(random.uniform(0.0, vertical)),
            terrain=terrain,
        )
        if self.gap_m is not None:
            yield place_building(
                f"house-{self.number:03d}",
                RoofShape.GABLE,
                _HOUSE,
                at=self.place(plot, (self.length_m - _HOUSE.length_m) / 2),
                azimuth_deg=self.azimuth_deg,
                eave_height_m=float(random.uniform(3.0, 6.0)),
                terrain=terrain,
                block_id=None if self.gap_m else name,
            )

    def place(self, plot: Plot, along_m: float) -> tuple[float, float]:
        """A place on the line of the ridges, metres from the middle."""
        azimuth = math.radians(self.azimuth_deg)
        return plot.x + along_m * math.sin(azimuth), plot.y + along_m * math.cos(azimuth)


def low_buildings(seed: int) -> Scene:
    """Seventy-two low buildings, the houses beside two thirds of them, and a bush at each of the others."""
    random = np.random.default_rng([seed, 0x10])
    lots = [_lot(number, random) for number in range(OF_EACH * len(SHAPES))]
    plots, extent = packed_plots([lot.planned for lot in lots], SCANNER.strip_spacing_m, 1)
    terrain = undulating_terrain(12.0, 1.5, float(random.uniform(0, 360)), 0.6, 120.0, random)
    buildings: list[Building] = []
    trees: list[Tree] = []
    for lot, plot in zip(lots, plots, strict=True):
        buildings += lot.built(plot, terrain, random)
        if lot.gap_m is None:
            radius = float(random.uniform(0.5, 1.0))
            x, y = lot.place(plot, lot.length_m / 2 + radius + 0.3)
            trees.append(tree_at(x, y, radius, 2.0 * radius, terrain, 0.15))
    return Scene(
        name="low_buildings",
        origin=(568_000.0, 5_937_000.0, 0.0),
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=tuple(buildings),
        trees=tuple(trees),
    )


def _lot(number: int, random: np.random.Generator) -> _Lot:
    shape = SHAPES[number % len(SHAPES)]
    gaps = (0.0, float(random.uniform(*_GAP_M)), None)
    area = float(random.uniform(*AREA_M2))
    width = math.sqrt(area / float(random.uniform(1.0, 2.2)))
    size = RoofDimensions(length_m=area / width, width_m=width, pitch_deg=float(random.uniform(*_PITCH_DEG[shape])))
    return _Lot(
        number=number,
        shape=shape,
        size=size,
        azimuth_deg=float(random.uniform(0.0, 360.0)),
        gap_m=gaps[number // len(SHAPES) % len(gaps)],
    )


def _rise_m(shape: RoofShape, size: RoofDimensions) -> float:
    """Height of the ridge above the eave."""
    run = size.width_m if shape is RoofShape.PENT else size.width_m / 2
    return run * math.tan(math.radians(size.pitch_deg))
