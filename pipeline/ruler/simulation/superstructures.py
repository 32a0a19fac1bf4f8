"""Houses with chimneys, roof units and dormers, and clean ones under trees, wires and aerials.

The id is `with-N` or `clean-N`. Every third clean house stands under a crown, every third under a wire, and every
second carries an aerial.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.simulation.additions import (
    can_have_dormers,
    plan_rectangle,
    random_dormers,
    random_superstructures,
)
from pipeline.ruler.simulation.plots import PlannedBuilding, packed_plots
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roof_dimensions import Addition, AdditionKind
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Building, Scene, Terrain, Tree, turned, undulating_terrain
from pipeline.ruler.simulation.suburb import tree_at

OF_EACH = 8
"""Houses of each shape, with additions and without."""
SHAPES = (RoofShape.GABLE, RoofShape.HIP, RoofShape.L_SHAPE, RoofShape.PENT, RoofShape.FLAT)
CHIMNEY_M = 0.6
"""Least side of a chimney that counts."""
_STRIP_M, _MARGIN_M = 130.0, 5.0
_WIRE_M, _BEAD_M = 0.02, 0.05
"""Radius of a wire, or of a rod of an aerial, and the distance of the beads that it is made of."""
_OPAQUE_M = 1e-3
"""Depth that a beam sinks into it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrueSuperstructure:
    """What stands on a roof."""

    kind: AdditionKind
    outline: shapely.Polygon
    """In plan, scene frame."""
    sides_m: tuple[float, float]
    """Short and long side."""
    top_z_m: float
    """Elevation of its roof over its middle, scene frame."""


def true_superstructures(buildings: tuple[Building, ...]) -> Iterator[TrueSuperstructure]:
    """The additions of all buildings."""
    for building in buildings:
        for one in building.dimensions.additions:
            corners = turned(np.array(plan_rectangle(one)), building.x, building.y, building.azimuth_deg)
            sides = sorted((one.length_m, one.width_m))
            outline = shapely.Polygon(corners)
            yield TrueSuperstructure(
                kind=one.kind,
                outline=outline,
                sides_m=(sides[0], sides[1]),
                top_z_m=_roof_z_m(building, outline.centroid),
            )


def _roof_z_m(building: Building, place: shapely.Point) -> float:
    """Elevation of a roof at a place."""
    return max(
        float(plane.a * place.x + plane.b * place.y + plane.c)
        for plane, face in zip(building.planes, building.roof_polygons(), strict=True)
        if shapely.force_2d(face).intersects(place)
    )


def _with_additions(shape: RoofShape, size: RoofDimensions, random: np.random.Generator) -> RoofDimensions:
    """A bare roof with one to three boxes, and every second time with dormers."""
    added: tuple[Addition, ...] = ()
    if can_have_dormers(shape) and random.random() < 0.5:
        added = random_dormers(shape, size, random)
    added += random_superstructures(shape, size, random, besides=added)
    return dataclasses.replace(size, additions=added)


def _rod(start: FloatArray, end: FloatArray) -> list[Tree]:
    """A straight thin line (3,) to (3,) in the air, of opaque beads."""
    count = max(2, math.ceil(math.dist(start, end) / _BEAD_M))
    half_m = max(_WIRE_M, abs(float(end[2] - start[2])) / count)
    return [
        Tree(
            x=float(x),
            y=float(y),
            crown_z_m=float(z),
            crown_radius_m=_WIRE_M,
            crown_half_height_m=half_m,
            free_path_m=_OPAQUE_M,
        )
        for x, y, z in np.linspace(start, end, count)
    ]


def _aerial(house: Building, random: np.random.Generator) -> list[Tree]:
    """A mast of 1 to 2.5 m with three cross rods, on the highest part of a roof."""
    top = house.vertices[int(np.argmax(house.vertices[:, 2]))]
    foot = top + 0.15 * (np.array([house.x, house.y, top[2]]) - top)
    foot[2] = top[2] - 0.3
    height, azimuth = float(random.uniform(1.0, 2.5)), float(random.uniform(0.0, math.pi))
    found = _rod(foot, foot + np.array([0.0, 0.0, height + 0.3]))
    across = 0.5 * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    for share in (0.7, 0.85, 1.0):
        middle = foot + np.array([0.0, 0.0, 0.3 + share * height])
        found += _rod(middle - across, middle + across)
    return found


def _wire(house: Building, random: np.random.Generator) -> list[Tree]:
    """A level wire across a house, 0.6 to 3 m above its ridge."""
    azimuth, half_m = float(random.uniform(0.0, math.pi)), 12.0
    along = half_m * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    middle = np.array([house.x, house.y, house.ridge_z_m + float(random.uniform(0.6, 3.0))])
    return _rod(middle - along, middle + along)


def _crown(house: Building, terrain: Terrain, random: np.random.Generator) -> Tree:
    """A tree beside a house whose crown hangs over it, as in the city."""
    outline = house.footprint.exterior
    at = outline.interpolate(float(random.uniform(0.0, outline.length)))
    away = np.array([at.x - house.x, at.y - house.y])
    away /= max(float(np.hypot(*away)), 1e-9)
    radius = float(random.uniform(2.0, 3.8))
    x, y = np.array([at.x, at.y]) + away * radius * float(random.uniform(0.35, 0.7))
    height = max(2.4 * radius, house.eave_z_m - house.floor_z_m + float(random.uniform(1.0, 4.0)))
    return tree_at(float(x), float(y), radius, height, terrain)


def superstructures(seed: int) -> Scene:
    """Houses of all shapes on plots of their own, first those with additions."""
    random = np.random.default_rng([seed, 0x5C])
    planned: list[tuple[str, PlannedBuilding]] = []
    for group in ("with", "clean"):
        for number in range(OF_EACH * len(SHAPES)):
            shape = SHAPES[number % len(SHAPES)]
            size = random_dimensions(shape, random, area_m2=float(random.uniform(70.0, 200.0)))
            if group == "with":
                size = _with_additions(shape, size, random)
            azimuth_deg = float(random.uniform(0.0, 360.0))
            one = PlannedBuilding(shape=shape, dimensions=size, azimuth_deg=azimuth_deg, margin_m=_MARGIN_M)
            planned.append((f"{group}-{number}", one))
    plots, extent = packed_plots([one for _, one in planned], _STRIP_M, 1)
    terrain = undulating_terrain(40.0, 1.0, float(random.uniform(0.0, 360.0)), 0.4, 150.0, random)
    buildings = tuple(
        one.built(name, plot, float(random.uniform(3.0, 7.0)), terrain)
        for (name, one), plot in zip(planned, plots, strict=True)
    )
    above: list[Tree] = []
    for number, house in enumerate(house for house in buildings if house.building_id.startswith("clean")):
        if number % 3 == 0:
            above.append(_crown(house, terrain, random))
        if number % 3 == 1:
            above += _wire(house, random)
        if number % 2 == 0:
            above += _aerial(house, random)
    return Scene(
        name="superstructures",
        origin=(572_000.0, 5_941_000.0, 0.0),
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=buildings,
        trees=tuple(above),
    )
