"""The 310 buildings of Hofmann, Maas and Streilein (2003), made again: their roof types, sizes, spacing and nuisances.

Every seed reproduces the figures of the paper exactly: the counts of the roof types (its table 4-1), how many of each
are "expected to have good results" (its table 4-2), and that 16 % suffer from the borders of strips or from wrong scan
rows. The other defects (dormers, superstructures, wet spots, trees) and all sizes are drawn at random.

Source: Hofmann, A. D., Maas, H.-G., Streilein, A. (2003): Derivation of roof types by cluster analysis in parameter
spaces of airborne laserscanner point clouds. IAPRS 34, 3/W13, 112-117.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from statistics import NormalDist

import numpy as np
import shapely

from pipeline.model import FloatArray, RoofType
from pipeline.ruler.roof_families import family_of
from pipeline.ruler.simulation.additions import can_have_dormers, random_dormers, random_superstructures
from pipeline.ruler.simulation.als import ScannerSettings
from pipeline.ruler.simulation.plots import PlannedBuilding, Plot, packed_plots
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import ROOF_TYPES, RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    Building,
    Defect,
    FaultKind,
    Scene,
    SurveyFault,
    Terrain,
    Tree,
    WetSpot,
)
from pipeline.ruler.simulation.suburb import tree_at

SHAPES: Mapping[RoofShape, int] = {
    RoofShape.FLAT: 3,
    RoofShape.PENT: 17,
    RoofShape.GABLE: 167,
    RoofShape.UNEQUAL_GABLE: 72,
    RoofShape.HIP: 9,
    RoofShape.BENT_HIP: 9,
    RoofShape.L_SHAPE: 12,
    RoofShape.T_SHAPE: 8,
    RoofShape.U_SHAPE: 3,
    RoofShape.CROSS: 4,
    RoofShape.MANSARD: 3,
    RoofShape.GAMBREL: 3,
}
"""Buildings of each shape: 3 flat, 17 pent, 239 gable (30 % of two pitches), 18 hip (half bent), 33 others."""
GOOD: Mapping[RoofType, int] = {
    RoofType.FLAT: 0,
    RoofType.PENT: 13,
    RoofType.GABLE: 157,
    RoofType.HIP: 4,
    RoofType.COMBINATION: 23,
}
"""Buildings of each roof type that nothing makes hard: 197 of 310."""
STRIP_FAULTS, ROW_FAULTS = 35, 15
"""Buildings on the border of two strips, and with wrong scan rows: together 16 %."""

MEAN_AREA_M2 = 160.0
_AREA_SPREAD = 0.6
"""Standard deviation of the footprint's logarithm."""
_GABLE_PITCH_DEG = (25.0, 45.0)
_UNEQUAL_DEG = 5.0
_FREE_GROUND_M = (3.0, 10.0)
"""Smallest and largest distance from a building to its neighbours."""
_TREE_TRIES = 40
_STRIP_M = 100.0
_STRIPS = 7
_BASE_Z_M = 430.0

SCANNER = ScannerSettings(
    pulse_density_per_m2=1.0 / 1.2**2,
    range_noise_m=0.065,
    altitude_m=900.0,
    strip_spacing_m=_STRIP_M,
    strip_overlap=0.02,
    beam_radius_m=0.15,
    strip_shift_m=0.30,
    strip_lift_m=0.20,
)
"""1.2 m between points. The errors of the paper (0.3 m in plan, 0.2 m in height) are correlated within a building: they
are the shift of the strips, and the errors between points of one building are small."""


def hofmann310(seed: int) -> Scene:
    """The 310 buildings on plots, each free of its neighbours."""
    random = np.random.default_rng([seed, 0x310])
    shapes = [shape for shape, count in SHAPES.items() for _ in range(count)]
    shapes = [shapes[k] for k in random.permutation(len(shapes))]
    planned, defects = [], []
    for shape, area, wanted in zip(shapes, _areas(shapes, random), _drawn_defects(shapes, random), strict=True):
        plan, realised = _planned(shape, float(area), wanted, random)
        planned.append(plan)
        defects.append(realised)
    plots, size = packed_plots(planned, _STRIP_M, _STRIPS, gap_m=2.0)
    terrain = _terrain(random)
    buildings = [
        _built(f"hofmann310-{k:03d}", plan, plot, wanted, terrain, random)
        for k, (plan, plot, wanted) in enumerate(zip(planned, plots, defects, strict=True))
    ]
    return Scene(
        name="hofmann310",
        origin=(563_000.0, 5_931_000.0, 0.0),
        extent=(0.0, 0.0, *size),
        terrain=terrain,
        buildings=tuple(buildings),
        trees=tuple(_trees(buildings, size, terrain, random)),
        survey_faults=_all_faults(buildings, plots, random),
    )


def _areas(shapes: list[RoofShape], random: np.random.Generator) -> FloatArray:
    """Footprint areas: quantiles of a log-normal distribution; compound roofs tend to get the larger ones."""
    n, normal = len(shapes), NormalDist()
    deviates = np.array([normal.inv_cdf((k + 0.5) / n) for k in range(n)])
    areas = np.exp(_AREA_SPREAD * deviates)
    areas *= MEAN_AREA_M2 / areas.mean()
    lift = {RoofType.COMBINATION: 1.2, RoofType.FLAT: 0.5, RoofType.PENT: -0.5}
    rank = np.argsort(
        np.argsort(random.normal(size=n) + [lift.get(family_of(ROOF_TYPES[shape]), 0.0) for shape in shapes])
    )
    return np.asarray(areas[rank])


def _drawn_defects(shapes: list[RoofShape], random: np.random.Generator) -> list[tuple[Defect, ...]]:
    """The defects of each building: none for as many of each roof type as the paper expected to be good."""
    types = [family_of(ROOF_TYPES[shape]) for shape in shapes]
    hard: list[int] = []
    for roof_type, good in GOOD.items():
        mine = [k for k, one in enumerate(types) if one is roof_type]
        hard += [mine[k] for k in random.permutation(len(mine))[: len(mine) - good]]
    drawn: list[tuple[Defect, ...]] = [()] * len(shapes)
    for place, number in enumerate(int(hard[k]) for k in random.permutation(len(hard))):
        if place < STRIP_FAULTS:
            drawn[number] = (Defect.STRIP_SHIFT,)
        elif place < STRIP_FAULTS + ROW_FAULTS:
            drawn[number] = (Defect.WRONG_ROWS,)
        else:
            fitting = [Defect.SUPERSTRUCTURE, Defect.WET_SPOT, Defect.OVERHANGING_TREE]
            if can_have_dormers(shapes[number]):
                fitting += [Defect.DORMERS] * 2
            one = fitting[int(random.integers(len(fitting)))]
            also = fitting[int(random.integers(len(fitting)))]
            drawn[number] = (one, also) if random.random() < 0.25 and also is not one else (one,)
    return drawn


def _planned(
    shape: RoofShape, area_m2: float, wanted: tuple[Defect, ...], random: np.random.Generator
) -> tuple[PlannedBuilding, tuple[Defect, ...]]:
    """A building with the additions on its roof, and its defects. A tree replaces an addition that finds no room."""
    is_gable = family_of(ROOF_TYPES[shape]) is RoofType.GABLE
    pitch = float(random.uniform(*_GABLE_PITCH_DEG)) if is_gable else None
    size = random_dimensions(shape, random, area_m2=area_m2, pitch_deg=pitch)
    if shape is RoofShape.UNEQUAL_GABLE:
        second = size.pitch_deg
        while abs(second - size.pitch_deg) < _UNEQUAL_DEG:
            second = float(random.uniform(*_GABLE_PITCH_DEG))
        size = dataclasses.replace(size, second_pitch_deg=second)
    defects: dict[Defect, None] = {}
    for defect in wanted:
        additions = size.additions
        if defect is Defect.DORMERS:
            additions += random_dormers(shape, size, random, besides=additions)
        elif defect is Defect.SUPERSTRUCTURE:
            additions += random_superstructures(shape, size, random, besides=additions)
        is_missing = defect in {Defect.DORMERS, Defect.SUPERSTRUCTURE} and additions == size.additions
        defects[Defect.OVERHANGING_TREE if is_missing else defect] = None
        size = dataclasses.replace(size, additions=additions)
    least, most = _FREE_GROUND_M[0] / 2, _FREE_GROUND_M[1] / 2
    plan = PlannedBuilding(
        shape=shape,
        dimensions=size,
        azimuth_deg=float(random.uniform(0.0, 360.0)),
        margin_m=float(random.uniform(4.0 if Defect.OVERHANGING_TREE in defects else least, most)),
    )
    return plan, tuple(defects)


def _terrain(random: np.random.Generator) -> Terrain:
    """Waves whose slopes add up to less than 15 deg wherever they meet; some places are level."""
    waves = np.zeros((2, 4))
    direction = random.uniform(0.0, 2 * math.pi)
    for k, (steepest, length) in enumerate(((0.19, 230.0), (0.18, 310.0))):
        number = 2 * math.pi / length
        east, north = math.cos(direction + k * math.pi / 2), math.sin(direction + k * math.pi / 2)
        waves[k] = steepest / number, number * east, number * north, random.uniform(0.0, 2 * math.pi)
    return Terrain(base_z_m=_BASE_Z_M, waves=waves)


def _built(
    building_id: str,
    plan: PlannedBuilding,
    plot: Plot,
    defects: tuple[Defect, ...],
    terrain: Terrain,
    random: np.random.Generator,
) -> Building:
    """A building on its plot."""
    building = plan.built(building_id, plot, _eave_height_m(plan.dimensions, random), terrain)
    wet_spots = _wet_spots(building, random) if Defect.WET_SPOT in defects else ()
    return dataclasses.replace(building, defects=defects, wet_spots=wet_spots)


def _eave_height_m(size: RoofDimensions, random: np.random.Generator) -> float:
    """One storey for the small, one to three for the large."""
    storeys = 1 if size.width_m < 6.0 else int(random.integers(1, 4 if size.width_m > 10.0 else 3))
    return 2.7 * storeys + float(random.uniform(0.0, 0.8))


def _wet_spots(building: Building, random: np.random.Generator) -> tuple[WetSpot, ...]:
    """One or two circles, together a tenth to a third of the largest face."""
    polygons = [shapely.force_2d(polygon) for polygon in building.roof_polygons()]
    largest = max(polygons, key=lambda polygon: polygon.area)
    count = int(random.integers(1, 3))
    x0, y0, x1, y1 = largest.bounds
    spots: list[WetSpot] = []
    while len(spots) < count:
        x, y = float(random.uniform(x0, x1)), float(random.uniform(y0, y1))
        if largest.contains(shapely.Point(x, y)):
            area = largest.area * float(random.uniform(0.1, 0.33)) / count
            spots.append(WetSpot(x=x, y=y, radius_m=math.sqrt(area / math.pi)))
    return tuple(spots)


def _all_faults(buildings: list[Building], plots: list[Plot], random: np.random.Generator) -> tuple[SurveyFault, ...]:
    """The errors of the survey over all plots; each pair of strips that do not fit has a second strip of its own."""
    found: list[SurveyFault] = []
    others = 0
    for building, plot in zip(buildings, plots, strict=True):
        for fault in _faults(building, plot, random):
            if Defect.STRIP_SHIFT in building.defects:
                found.append(dataclasses.replace(fault, other_strip=others))
                others += 1
            else:
                found.append(fault)
    return tuple(found)


def _faults(building: Building, plot: Plot, random: np.random.Generator) -> list[SurveyFault]:
    """The errors of the survey over a plot."""
    found = []
    if Defect.STRIP_SHIFT in building.defects:
        # Two strips, each with its own error: the difference is larger than either.
        plan = random.normal(0.0, math.sqrt(2.0) * SCANNER.strip_shift_m, 2)
        up = float(random.uniform(1.0, 2.5)) * SCANNER.strip_lift_m * (1.0 if random.random() < 0.5 else -1.0)
        shift = (float(plan[0]), float(plan[1]), up)
        if random.random() < 0.5:
            azimuth = float(random.uniform(0.0, 360.0))
            fault = SurveyFault(extent=plot.extent, kind=FaultKind.STRIP_SHIFT, shift=shift, azimuth_deg=azimuth)
        else:  # the strips overlap: about every second row over the plot belongs to the other one
            fault = SurveyFault(extent=plot.extent, kind=FaultKind.WRONG_ROWS, shift=shift, share=0.5)
        found.append(fault)
    if Defect.WRONG_ROWS in building.defects:
        up = float(random.uniform(0.5, 1.5)) * (1.0 if random.random() < 0.5 else -1.0)
        # One or two rows through the middle of the building: rows chosen at random might miss a small house.
        half = SCANNER.pulse_spacing_m * (0.5 if random.random() < 0.5 else 1.0)
        extent = (plot.extent[0], building.y - half, plot.extent[2], building.y + half)
        found.append(SurveyFault(extent=extent, kind=FaultKind.WRONG_ROWS, shift=(0.0, 0.0, up), share=1.0))
    return found


def _trees(
    buildings: list[Building], size: tuple[float, float], terrain: Terrain, random: np.random.Generator
) -> list[Tree]:
    """Trees that stand free of all buildings, and those whose crowns hang over one."""
    footprints = [building.footprint for building in buildings]
    index = shapely.STRtree(footprints)
    trees: list[Tree] = []
    for building, footprint in zip(buildings, footprints, strict=True):
        if Defect.OVERHANGING_TREE in building.defects:
            trees += [
                _overhanging(building, footprint, index, terrain, random) for _ in range(int(random.integers(1, 3)))
            ]
        free = float(random.uniform(*_FREE_GROUND_M))
        reach = math.sqrt(footprint.area) / 2 + free
        for _ in range(int(random.integers(0, 4))):
            direction, distance = random.uniform(0.0, 2 * math.pi), reach + random.uniform(2.0, 6.0)
            radius = float(random.uniform(0.6, 3.2))
            x = building.x + float(distance * math.cos(direction))
            y = building.y + float(distance * math.sin(direction))
            place = shapely.Point(x, y)
            inside = radius < x < size[0] - radius and radius < y < size[1] - radius
            near = index.query(place, predicate="dwithin", distance=radius + _FREE_GROUND_M[0])
            if inside and len(near) == 0 and footprint.distance(place) >= radius + free:
                trees.append(tree_at(x, y, radius, radius * float(random.uniform(2.2, 3.0)), terrain))
    return trees


def _overhanging(
    building: Building,
    footprint: shapely.Polygon,
    index: shapely.STRtree,
    terrain: Terrain,
    random: np.random.Generator,
) -> Tree:
    """A tree beside a wall, higher than the eave, with a third to two thirds of its crown's radius over the roof.

    It shrinks until its trunk stands outside (away from the middle of an L can lead into its wing) and clear of the
    neighbours. The last try is kept in any case.
    """
    height = building.eave_z_m - building.floor_z_m + float(random.uniform(2.0, 5.0))
    for left in range(_TREE_TRIES, -1, -1):
        line = footprint.exterior.interpolate(float(random.uniform(0.0, footprint.exterior.length)))
        away = np.array([line.x - building.x, line.y - building.y])
        away /= max(float(np.hypot(*away)), 1e-9)
        share = left / _TREE_TRIES
        radius = 1.8 + share * float(random.uniform(0.0, 2.2))
        x, y = np.array([line.x, line.y]) + away * radius * (0.35 + share * float(random.uniform(0.0, 0.3)))
        crown = radius + _FREE_GROUND_M[0]
        place = shapely.Point(x, y)
        if footprint.distance(place) > 0.0 and len(index.query(place, predicate="dwithin", distance=crown)) <= 1:
            break
    return tree_at(float(x), float(y), radius, max(height, 2.4 * radius), terrain)
