"""Houses seen well, half, or through glass, bridges and decks: small scenes of one kind each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.ruler.simulation.bridges_and_vans import BRIDGES, bridges_and_vans
from pipeline.ruler.simulation.plots import PlannedBuilding, packed_plots
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    Box,
    Building,
    Defect,
    Scene,
    Terrain,
    Tree,
    WetSpot,
    place_building,
    turned,
    undulating_terrain,
)
from pipeline.ruler.simulation.trust_trees import ORIGIN, grown

_MARGIN_M = 4.0
_EDGE_M = 6.0
"""Free ground at the edge of the data."""
_LARGE = {RoofShape.COURTYARD, RoofShape.MULTI_LEVEL_FLAT}
_SLOPING = (
    RoofShape.GABLE, RoofShape.GABLE, RoofShape.HIP, RoofShape.PENT, RoofShape.L_SHAPE, RoofShape.T_SHAPE,
    RoofShape.HALF_HIP, RoofShape.UNEQUAL_GABLE,
)  # fmt: skip
_SPOT_M, _SPOT_STEP_M = 0.5, 0.6
"""Radius of the circles that make a part of a roof wet, and their distance: together they leave no gap."""

_FLIGHT_M, _ROW_M = 45.0, 24.0
"""Scenes with shadows: easting of the flight line, and the depth of a row of lots."""


def _terrain(random: np.random.Generator, slope_deg: float = 3.0) -> Terrain:
    slope, aspect = float(random.uniform(0.0, slope_deg)), float(random.uniform(0, 360))
    return undulating_terrain(50.0, slope, aspect, 0.4, 90.0, random)


def _packed(sized: Sequence[tuple[RoofShape, RoofDimensions]], side_m: float, random: np.random.Generator) -> Scene:
    """Buildings on plots of their own, as wide as a scene or as the widest plot."""
    planned = [
        PlannedBuilding(shape=shape, dimensions=size, azimuth_deg=float(random.uniform(0.0, 360.0)), margin_m=_MARGIN_M)
        for shape, size in sized
    ]
    widest = max(float(high[0] - low[0]) for low, high in (one.bounds for one in planned)) + 2 * _MARGIN_M
    plots, (east, north) = packed_plots(planned, max(side_m, math.ceil(widest)), 1)
    terrain = _terrain(random)
    buildings = []
    for number, (plan, plot) in enumerate(zip(planned, plots, strict=True)):
        eave_m = 2.7 * int(random.integers(1, 4)) + float(random.uniform(0.0, 0.6))
        buildings.append(plan.built(f"house-{number:02d}-{plan.shape}", plot, eave_m, terrain))
    extent = (-_EDGE_M, -_EDGE_M, east + _EDGE_M, north + _EDGE_M)
    return Scene(name="houses", origin=ORIGIN, extent=extent, terrain=terrain, buildings=tuple(buildings))


def houses(random: np.random.Generator, side_m: float) -> Scene:
    """Eight houses in the open, each of another shape; four in a small scene, none of them large."""
    shapes = [shape for shape in RoofShape if side_m > 60.0 or shape not in _LARGE]
    drawn = [shapes[k] for k in random.permutation(len(shapes))[: 8 if side_m > 60.0 else 4]]
    return _packed([(shape, random_dimensions(shape, random)) for shape in drawn], side_m, random)


def trees_at_houses(random: np.random.Generator, side_m: float) -> Scene:
    """Houses with one to four dense trees at each; the crowns keep off by up to a radius or reach over the eave."""
    scene = houses(random, side_m)
    trees: list[Tree] = []
    for house in scene.buildings:
        for _ in range(int(random.integers(1, 5))):
            trees += _tree_beside(house, scene.terrain, random, reach=float(random.uniform(-1.0, 0.5)))
    return dataclasses.replace(scene, trees=tuple(trees))


def _tree_beside(house: Building, terrain: Terrain, random: np.random.Generator, *, reach: float) -> list[Tree]:
    """A dense tree at the outline of a house; its crown reaches over it by a share of its radius, or keeps off."""
    ring = house.footprint.exterior
    place = ring.interpolate(float(random.uniform(0.0, ring.length)))
    away = np.array([place.x - house.x, place.y - house.y])
    away /= max(float(np.hypot(*away)), 1e-6)
    radius = float(random.uniform(2.0, 4.5))
    x, y = np.array([place.x, place.y]) + away * radius * (1.0 - reach)
    height = max(float(random.uniform(5.0, 16.0)), 2.0 * radius)
    free_path = float(random.uniform(0.004, 0.1))
    return grown(float(x), float(y), radius, height, terrain, free_path_share=free_path, lumps=3, random=random)


def half_seen_when_wet(random: np.random.Generator, side_m: float) -> Scene:
    """Houses with sloping roofs: wet is one face, a part of one, or all faces on one side of a line."""
    count = 8 if side_m > 60.0 else 4
    shapes = [_SLOPING[int(k)] for k in random.integers(0, len(_SLOPING), count)]
    scene = _packed([(shape, random_dimensions(shape, random)) for shape in shapes], side_m, random)
    wet = []
    for house in scene.buildings:
        spots = _spots(_wet_part(house, random))
        wet.append(dataclasses.replace(house, wet_spots=spots, defects=(Defect.WET_SPOT,) if spots else ()))
    return dataclasses.replace(scene, buildings=tuple(wet))


def _wet_part(house: Building, random: np.random.Generator) -> shapely.Geometry:
    """The part of a roof that returns no pulses, in plan."""
    faces = [shapely.force_2d(polygon) for polygon in house.roof_polygons()]
    chosen = faces[int(random.integers(len(faces)))]
    azimuth, way = house.azimuth_deg + 90.0 * int(random.integers(4)), random.random()
    share = float(random.uniform(-0.1, 0.5))
    if way < 0.4:
        return chosen
    reach = 100.0
    if way < 0.75:
        middle, inside = chosen.centroid, chosen
    else:
        middle, inside = shapely.Point(house.x, house.y), house.footprint
    local = np.array([(share * 8.0, -reach), (reach, -reach), (reach, reach), (share * 8.0, reach)])
    beyond = shapely.Polygon(turned(local, middle.x, middle.y, azimuth))
    return shapely.intersection(inside, beyond)


def _spots(part: shapely.Geometry) -> tuple[WetSpot, ...]:
    """Circles that cover a part of a roof and reach beyond it by less than their radius."""
    if part.is_empty:
        return ()
    x0, y0, x1, y1 = part.bounds
    x, y = np.meshgrid(np.arange(x0, x1 + _SPOT_STEP_M, _SPOT_STEP_M), np.arange(y0, y1 + _SPOT_STEP_M, _SPOT_STEP_M))
    inside = shapely.contains_xy(part, x, y)
    return tuple(
        WetSpot(x=float(east), y=float(north), radius_m=_SPOT_M)
        for east, north in zip(x[inside], y[inside], strict=True)
    )


def half_seen_in_shadow(random: np.random.Generator, side_m: float) -> Scene:
    """Houses in two rows along a flight line that runs north through the middle; most of each is hidden by something.

    It is a tower or a row of tall dense trees on the side of the flight line, or two dense crowns over the roof.
    """
    terrain = _terrain(random, 1.0)
    rows = int(side_m / _ROW_M)
    buildings: list[Building] = []
    trees: list[Tree] = []
    for number in range(2 * rows):
        side = 1.0 if number % 2 else -1.0
        shape = _SLOPING[int(random.integers(3))]
        size = random_dimensions(shape, random, area_m2=float(random.uniform(80.0, 150.0)))
        house = place_building(
            f"house-{number:02d}-{shape}",
            shape,
            dataclasses.replace(size, length_m=min(size.length_m, 17.0)),
            at=(_FLIGHT_M + side * 31.0, (number // 2 + 0.5) * _ROW_M),
            azimuth_deg=float(random.choice([0.0, 90.0])) + float(random.uniform(-8.0, 8.0)),
            eave_height_m=float(random.uniform(3.0, 6.0)),
            terrain=terrain,
        )
        towers, crowns = _in_front(house, side, terrain, random)
        buildings += [house, *towers]
        trees += crowns
    extent = (0.0, -_EDGE_M, 2 * _FLIGHT_M, rows * _ROW_M + _EDGE_M)
    scene = Scene(name="houses", origin=ORIGIN, extent=extent, terrain=terrain, buildings=tuple(buildings))
    return dataclasses.replace(scene, trees=tuple(trees))


def _in_front(
    house: Building, side: float, terrain: Terrain, random: np.random.Generator
) -> tuple[list[Building], list[Tree]]:
    """What hides a house east (`side` 1) or west (-1) of the flight line."""
    west, _, east, _ = house.footprint.bounds
    edge, way = (west if side > 0 else east), random.random()
    trees: list[Tree] = []
    if way < 0.4:
        tower = place_building(
            house.building_id.replace("house", "tower"),
            RoofShape.FLAT,
            RoofDimensions(length_m=20.0, width_m=8.0),
            at=(edge - side * float(random.uniform(5.0, 7.0)), house.y),
            azimuth_deg=0.0,
            eave_height_m=float(random.uniform(22.0, 45.0)),
            terrain=terrain,
        )
        return [tower], []
    if way < 0.7:
        height = float(random.uniform(16.0, 30.0))
        for k in range(-3, 4):
            place = (edge - side * 4.0, house.y + 2.8 * k)
            trees += grown(*place, 3.0, height, terrain, free_path_share=0.01, lumps=3, random=random)
        return [], trees
    for _ in range(2):
        trees += _tree_beside(house, terrain, random, reach=float(random.uniform(0.6, 1.0)))
    return [], trees


def small_bridges(random: np.random.Generator, side_m: float) -> Scene:
    """The bridges of a part of the suite of bridges and vehicles, without the vehicles."""
    scene = bridges_and_vans(int(random.integers(2**31)))
    x0, y0, _, _ = scene.extent
    extent = (x0, y0, x0 + 2 * side_m, y0 + side_m)
    return dataclasses.replace(scene, origin=ORIGIN, extent=extent, boxes=scene.boxes[:BRIDGES])


def terraces(random: np.random.Generator, side_m: float) -> Scene:
    """Decks on a slope, level with the ground on the upper side: no building."""
    fall_deg, aspect = float(random.uniform(12.0, 22.0)), float(random.uniform(0.0, 360.0))
    terrain = undulating_terrain(60.0, fall_deg, aspect, 0.2, 60.0, random)
    boxes = []
    for east in np.arange(14.0, side_m - 10.0, 22.0):
        for north in np.arange(14.0, side_m - 10.0, 22.0):
            rise = float(random.uniform(2.2, 4.2))
            depth, length = rise / math.tan(math.radians(fall_deg)), float(random.uniform(6.0, 15.0))
            local = np.array([(0.0, -length / 2), (depth, -length / 2), (depth, length / 2), (0.0, length / 2)])
            corners = turned(local, float(east), float(north), aspect + float(random.uniform(-6.0, 6.0)))
            upper = corners[[0, 3]]
            top = float(terrain.elevation(upper[:, 0], upper[:, 1]).mean())
            boxes.append(Box(corners=corners, top_z_m=top))
    extent = (0.0, 0.0, side_m, side_m)
    return Scene(name="houses", origin=ORIGIN, extent=extent, terrain=terrain, boxes=tuple(boxes))


def glass_houses(random: np.random.Generator, side_m: float) -> Scene:
    """Greenhouses whose roofs let 20 to 70 % of the pulses through, and two ordinary houses."""
    sized = []
    for _ in range(4 if side_m > 60.0 else 2):
        shape = (RoofShape.GABLE, RoofShape.GABLE, RoofShape.FLAT, RoofShape.PENT)[int(random.integers(4))]
        length, width = float(random.uniform(14.0, 32.0)), float(random.uniform(7.0, 13.0))
        pitch = 0.0 if shape is RoofShape.FLAT else float(random.uniform(8.0, 27.0))
        sized.append((shape, RoofDimensions(length_m=length, width_m=width, pitch_deg=pitch)))
    count = len(sized)
    sized += [(shape, random_dimensions(shape, random)) for shape in (RoofShape.GABLE, RoofShape.HIP)]
    scene = _packed(sized, side_m, random)
    glass = tuple(
        dataclasses.replace(house, glass_share=float(random.uniform(0.2, 0.7))) for house in scene.buildings[:count]
    )
    return dataclasses.replace(scene, buildings=glass + scene.buildings[count:])
