"""Every roof shape under every survey: the same buildings, points from sparse to dense and from clean to noisy."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import shapely

from pipeline.errors import SettingsError
from pipeline.ruler.simulation.additions import can_have_dormers, random_dormers, random_superstructures
from pipeline.ruler.simulation.plots import PlannedBuilding, packed_plots
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    Building,
    Defect,
    Scene,
    Terrain,
    Tree,
    place_building,
    undulating_terrain,
)
from pipeline.ruler.simulation.strips import Returns, ScannerSettings
from pipeline.ruler.simulation.suburb import tree_at

DENSITIES_PER_M2 = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 50.0)
NOISES_M = (0.02, 0.05, 0.10)
PLAIN_OF_EACH = 3
"""Buildings of each shape with a bare roof; one more carries dormers or superstructures."""
ROWS = 2
"""Rows of touching houses."""
_STRIP_M = 150.0
_MARGIN_M = 5.0

SCANNER = ScannerSettings(altitude_m=800.0, strip_spacing_m=_STRIP_M, strip_overlap=0.1, flight_azimuth_deg=0.0)


def cell_name(density_per_m2: float, noise_m: float) -> str:
    """Folder of a cell.

    >>> cell_name(0.5, 0.1), cell_name(8.0, 0.005)
    ('d0.5_n0.10', 'd8_n0.005')
    """
    return f"d{density_per_m2:g}_n{max(f'{noise_m:.2f}', f'{noise_m:g}', key=len)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """One survey of a suite of several, over the scene of all or over one of its own."""

    density_per_m2: float
    """Pulses per square metre of one strip."""
    noise_m: float
    """Standard deviation along the beam."""
    returns: Returns = Returns.ALL
    """The returns of a pulse that the instrument records."""
    with_classes: bool = False
    """Whether the points have their true classes."""
    strip_step_m: float = 0.0
    """By how much every second strip is too high."""
    kind: str = ""
    """The kind of its own scene; empty if all cells survey one scene."""
    settings: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Further settings of the scanner that differ from those of the suite."""

    @property
    def survey(self) -> str:
        """Density and returns, in words of a folder."""
        step = f"_z{self.strip_step_m:g}" if self.strip_step_m else ""
        return f"d{self.density_per_m2:g}_{self.returns}{step}"

    @property
    def key(self) -> str:
        """Name of its folder."""
        return f"{self.kind}-{self.survey}" if self.kind else cell_name(self.density_per_m2, self.noise_m)

    def scanner(self, usual: ScannerSettings) -> ScannerSettings:
        """The survey, from the usual one of the suite."""
        own = {"pulse_density_per_m2": self.density_per_m2, "range_noise_m": self.noise_m}
        return dataclasses.replace(usual, **own, strip_step_m=self.strip_step_m, **self.settings)


CELLS = tuple(Cell(density_per_m2=density, noise_m=noise) for density in DENSITIES_PER_M2 for noise in NOISES_M)


def chosen_cells(cells: tuple[Cell, ...], density_per_m2: float | None, noise_m: float | None) -> tuple[Cell, ...]:
    """The cells of a density, of a noise, or of both; all where neither is given. A SettingsError lists what exists."""
    chosen = tuple(
        cell
        for cell in cells
        if (density_per_m2 is None or math.isclose(cell.density_per_m2, density_per_m2))
        and (noise_m is None or math.isclose(cell.noise_m, noise_m))
    )
    if not chosen:
        densities = ", ".join(f"{value:g}" for value in dict.fromkeys(cell.density_per_m2 for cell in cells))
        noises = ", ".join(f"{value:g}" for value in dict.fromkeys(cell.noise_m for cell in cells))
        asked = [f"density is {density_per_m2:g}"] if density_per_m2 is not None else []
        asked += [f"noise is {noise_m:g}"] if noise_m is not None else []
        raise SettingsError([f"{' and '.join(asked)}: the cells have densities of {densities} and noises of {noises}"])
    return chosen


def sweep(seed: int) -> Scene:
    """All shapes in random sizes and directions on plots with some trees, and rows of touching houses."""
    random = np.random.default_rng([seed, 0x5E])
    planned: list[PlannedBuilding] = []
    defects: list[tuple[Defect, ...]] = []
    for shape in RoofShape:
        for _ in range(PLAIN_OF_EACH):
            planned.append(_planned(shape, random_dimensions(shape, random), random))
            defects.append(())
        size = random_dimensions(shape, random)
        if can_have_dormers(shape):
            additions, defect = random_dormers(shape, size, random), Defect.DORMERS
        else:
            additions, defect = random_superstructures(shape, size, random), Defect.SUPERSTRUCTURE
        planned.append(_planned(shape, dataclasses.replace(size, additions=size.additions + additions), random))
        defects.append((defect,) if additions else ())
    rows = [random_row(random) for _ in range(ROWS)]
    planned += [row.as_one for row in rows]
    order = random.permutation(len(planned))
    plots, extent = packed_plots([planned[k] for k in order], _STRIP_M, 2)
    terrain = undulating_terrain(60.0, 1.5, float(random.uniform(0, 360)), 1.0, 150.0, random)
    buildings: list[Building] = []
    for number, plot in zip((int(k) for k in order), plots, strict=True):
        plan = planned[number]
        if number >= len(defects):
            buildings += rows[number - len(defects)].houses(
                f"sweep-row{number - len(defects)}", plot.x, plot.y, terrain
            )
            continue
        eave_m = 2.9 * int(random.integers(1, 4)) + float(random.uniform(0.0, 0.6))
        building = plan.built(f"sweep-{number:03d}-{plan.shape}", plot, eave_m, terrain)
        buildings.append(dataclasses.replace(building, defects=defects[number]))
    return Scene(
        name="sweep",
        origin=(567_000.0, 5_936_000.0, 0.0),
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=tuple(buildings),
        trees=tuple(_trees(buildings, extent, terrain, random)),
    )


def _planned(shape: RoofShape, size: RoofDimensions, random: np.random.Generator) -> PlannedBuilding:
    return PlannedBuilding(
        shape=shape, dimensions=size, azimuth_deg=float(random.uniform(0.0, 360.0)), margin_m=_MARGIN_M
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """Houses wall to wall, each with its own eave."""

    widths_m: tuple[float, ...]
    eaves_m: tuple[float, ...]
    depth_m: float
    pitch_deg: float
    azimuth_deg: float

    @property
    def as_one(self) -> PlannedBuilding:
        """The rectangle that the row covers."""
        size = RoofDimensions(length_m=sum(self.widths_m), width_m=self.depth_m)
        return PlannedBuilding(shape=RoofShape.FLAT, dimensions=size, azimuth_deg=self.azimuth_deg, margin_m=_MARGIN_M)

    def houses(self, name: str, x: float, y: float, terrain: Terrain) -> list[Building]:
        """The houses of the row about its middle."""
        azimuth = math.radians(self.azimuth_deg)
        along, built = -sum(self.widths_m) / 2, []
        for k, (width, eave) in enumerate(zip(self.widths_m, self.eaves_m, strict=True)):
            middle = along + width / 2
            along += width
            built.append(
                place_building(
                    f"{name}-{k}",
                    RoofShape.GABLE,
                    RoofDimensions(length_m=width, width_m=self.depth_m, pitch_deg=self.pitch_deg),
                    at=(x + middle * math.sin(azimuth), y + middle * math.cos(azimuth)),
                    azimuth_deg=self.azimuth_deg,
                    eave_height_m=eave,
                    terrain=terrain,
                    block_id=name,
                )
            )
        return built


def random_row(random: np.random.Generator) -> Row:
    """Four to six houses."""
    count = int(random.integers(4, 7))
    return Row(
        widths_m=tuple(float(width) for width in random.uniform(5.5, 8.5, count)),
        eaves_m=tuple(5.6 + float(step) for step in random.uniform(0.0, 1.6, count)),
        depth_m=float(random.uniform(9.0, 12.0)),
        pitch_deg=float(random.uniform(30.0, 42.0)),
        azimuth_deg=float(random.uniform(0.0, 360.0)),
    )


def _trees(
    buildings: list[Building], size: tuple[float, float], terrain: Terrain, random: np.random.Generator
) -> list[Tree]:
    """About one tree per building, none with its crown over a roof."""
    index = shapely.STRtree([building.footprint for building in buildings])
    trees = []
    for _ in range(2 * len(buildings)):
        x, y, radius = float(random.uniform(0, size[0])), float(random.uniform(0, size[1])), random.uniform(1.0, 3.5)
        radius = float(radius)
        height = radius * float(random.uniform(2.2, 3.0))
        if len(index.query(shapely.Point(x, y), predicate="dwithin", distance=radius + 0.5)) == 0:
            trees.append(tree_at(x, y, radius, height, terrain))
    return trees
