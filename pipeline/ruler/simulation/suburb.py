"""Layout of a suburb: parallel streets, lots on both sides, detached houses, gardens, cars."""

from __future__ import annotations

import math

import numpy as np
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    Box,
    Building,
    Scene,
    Terrain,
    Tree,
    place_building,
    turned,
    undulating_terrain,
)

STREET_M = 10.0
"""Width of a street between the lots."""
LOT_WIDTH_M = 21.0
"""Along the street."""
LOT_DEPTH_M = 27.0
"""Away from the street."""
EDGE_M = 8.0
"""Smallest distance of a building to the end of the data."""
CLEARANCE_M = 2.5
"""Smallest distance of two buildings."""

_MIX = (
    *((RoofShape.GABLE,) * 5),
    *((RoofShape.HIP,) * 3),
    *((RoofShape.L_SHAPE,) * 3),
    *((RoofShape.FLAT,) * 2),
    *((RoofShape.PENT,) * 2),
)
"""Shares of the shapes: every fifteen houses contain all of them."""


def house_size(shape: RoofShape, random: np.random.Generator) -> RoofDimensions:
    """A likely size of a detached house."""
    width, pitch = random.uniform(7.5, 10.0), random.uniform(28.0, 45.0)
    length = width * random.uniform(1.15, 1.55)
    if shape is RoofShape.FLAT:
        return RoofDimensions(length_m=length + 1.0, width_m=width)
    if shape is RoofShape.PENT:
        return RoofDimensions(length_m=length, width_m=width * 0.85, pitch_deg=random.uniform(10.0, 20.0))
    if shape is RoofShape.L_SHAPE:
        wing = width * random.uniform(0.65, 0.85)
        return RoofDimensions(
            length_m=length + 2.0,
            width_m=width,
            pitch_deg=pitch,
            wing_width_m=wing,
            wing_length_m=random.uniform(3.5, 6.0),
        )
    if shape is RoofShape.HIP:
        return RoofDimensions(
            length_m=width * random.uniform(1.2, 1.6), width_m=width, pitch_deg=random.uniform(25.0, 38.0)
        )
    return RoofDimensions(length_m=length, width_m=width, pitch_deg=pitch)


def tree_at(
    x: float, y: float, radius_m: float, height_m: float, terrain: Terrain, free_path_share: float = 0.28
) -> Tree:
    """A tree of a total height, with a bare trunk over the lowest fifth (under 2 m: a shrub down to the ground)."""
    ground = terrain.at(x, y)
    base = 0.2 * height_m if height_m > 2.0 else 0.0
    half = (height_m - base) / 2
    return Tree(
        x=x,
        y=y,
        crown_z_m=ground + base + half,
        crown_radius_m=radius_m,
        crown_half_height_m=half,
        free_path_m=2 * half * free_path_share,
    )


def car_at(x: float, y: float, azimuth_deg: float, terrain: Terrain, random: np.random.Generator) -> Box:
    """A parked car."""
    length, width, height = random.uniform(3.8, 4.9), random.uniform(1.7, 1.9), random.uniform(1.4, 1.7)
    corners = np.array([(-length, -width), (length, -width), (length, width), (-length, width)]) / 2
    ground = terrain.at(x, y)
    return Box(corners=turned(corners, x, y, azimuth_deg), top_z_m=ground + height)


def suburb(seed: int, size_m: tuple[float, float] = (200.0, 200.0), name: str = "suburb") -> Scene:
    """A suburb of detached houses on gentle terrain; 200 x 200 m hold about 35 houses."""
    random = np.random.default_rng([seed, 0x5B])
    terrain = undulating_terrain(86.0, random.uniform(1.0, 3.0), random.uniform(0, 360), 0.8, 110.0, random)
    azimuth = random.uniform(5.0, 40.0)
    middle = np.array(size_m) / 2
    reach = float(np.hypot(*size_m)) / 2
    rows = math.ceil(reach / (2 * LOT_DEPTH_M + STREET_M)) + 1
    columns = math.ceil(reach / LOT_WIDTH_M) + 1
    buildings: list[Building] = []
    outlines: list[shapely.Polygon] = []
    back_to_back = 4 * columns + 2  # houses of two rows: no other one can be near
    trees: list[Tree] = []
    boxes: list[Box] = []
    mix: list[RoofShape] = []
    inside = shapely.box(EDGE_M, EDGE_M, size_m[0] - EDGE_M, size_m[1] - EDGE_M)
    for row in range(-rows, rows + 1):
        street = row * (2 * LOT_DEPTH_M + STREET_M)
        for side in (-1.0, 1.0):
            for column in range(-columns, columns + 1):
                lot = np.array([(column * LOT_WIDTH_M, street + side * (STREET_M / 2 + LOT_DEPTH_M * 0.45))])
                centre = turned(lot, float(middle[0]), float(middle[1]), azimuth)[0]
                if not inside.contains(shapely.Point(centre)):
                    continue
                if random.random() < 0.1:
                    trees += _grove(centre, terrain, random)
                    continue
                if not mix:
                    mix = [_MIX[k] for k in random.permutation(len(_MIX))]
                house = _house(f"{name}-{len(buildings):05d}", mix[-1], centre, azimuth, side, terrain, random)
                footprint = house.footprint
                if not inside.contains(footprint) or _near(footprint, outlines[-back_to_back:], CLEARANCE_M):
                    continue
                mix.pop()
                buildings.append(house)
                outlines.append(footprint)
                trees += _garden(house, footprint, terrain, random)
                if random.random() < 0.5:
                    boxes += _parked(lot[0], street, side, middle, azimuth, terrain, outlines[-back_to_back:], random)
    footprints = shapely.STRtree(outlines)
    trees = [tree for tree in trees if _tree_stands_free(tree, footprints)]
    return Scene(
        name=name,
        origin=(565_000.0, 5_934_000.0, 0.0),
        extent=(0.0, 0.0, *size_m),
        terrain=terrain,
        buildings=tuple(buildings),
        trees=tuple(trees),
        boxes=tuple(boxes),
    )


def _near(footprint: shapely.Polygon, others: list[shapely.Polygon], distance_m: float) -> bool:
    """Whether one of the others is too close."""
    return bool(others) and bool((shapely.distance(footprint, others) < distance_m).any())


def _house(
    building_id: str,
    shape: RoofShape,
    centre: FloatArray,
    street_azimuth: float,
    side: float,
    terrain: Terrain,
    random: np.random.Generator,
) -> Building:
    """A house on its lot: ridge along the street or gable to the street, wings to the garden."""
    size = house_size(shape, random)
    turn = 0.0 if side > 0 else 180.0
    if shape in {RoofShape.GABLE, RoofShape.PENT} and random.random() < 0.4:
        turn += 90.0
    shift = random.uniform(-1.0, 1.0, 2)
    storeys = 1 if random.random() < 0.6 else 2
    return place_building(
        building_id,
        shape,
        size,
        at=(float(centre[0] + shift[0]), float(centre[1] + shift[1])),
        azimuth_deg=(street_azimuth + turn + random.uniform(-2.0, 2.0)) % 360.0,
        eave_height_m=2.9 * storeys + random.uniform(0.2, 0.9),
        terrain=terrain,
    )


def _garden(house: Building, footprint: shapely.Polygon, terrain: Terrain, random: np.random.Generator) -> list[Tree]:
    """Trees and shrubs around a house; on a third of the lots one crown reaches over the eave."""
    trees = []
    half = math.hypot(house.dimensions.length_m, house.dimensions.width_m) / 2
    for _ in range(int(random.integers(1, 4))):
        direction, distance = random.uniform(0, 2 * math.pi), half + random.uniform(2.5, 8.0)
        x, y = house.x + distance * math.cos(direction), house.y + distance * math.sin(direction)
        radius = random.uniform(1.3, 3.6)
        trees.append(tree_at(x, y, radius, radius * random.uniform(2.2, 3.2) + 1.0, terrain))
    if random.random() < 0.35:
        line = footprint.exterior.interpolate(random.uniform(0, footprint.exterior.length))
        away = np.array([line.x - house.x, line.y - house.y])
        away /= float(np.hypot(*away))
        radius = random.uniform(2.0, 3.5)
        place = np.array([line.x, line.y]) + away * radius * random.uniform(0.6, 1.0)
        trees.append(tree_at(float(place[0]), float(place[1]), radius, radius * random.uniform(2.4, 3.4), terrain))
    for _ in range(int(random.integers(0, 4))):
        direction, distance = random.uniform(0, 2 * math.pi), half + random.uniform(1.5, 6.0)
        x, y = house.x + distance * math.cos(direction), house.y + distance * math.sin(direction)
        trees.append(tree_at(x, y, random.uniform(0.5, 1.1), random.uniform(0.8, 1.8), terrain, 0.15))
    return trees


def _grove(centre: FloatArray, terrain: Terrain, random: np.random.Generator) -> list[Tree]:
    """An empty lot: a playground with some trees."""
    places = centre + random.uniform(-8.0, 8.0, (int(random.integers(3, 7)), 2))
    radii = random.uniform(2.0, 4.0, len(places))
    return [
        tree_at(float(x), float(y), float(radius), float(radius * random.uniform(2.3, 3.2)), terrain)
        for (x, y), radius in zip(places, radii, strict=True)
    ]


def _parked(
    lot: FloatArray,
    street: float,
    side: float,
    middle: FloatArray,
    azimuth: float,
    terrain: Terrain,
    outlines: list[shapely.Polygon],
    random: np.random.Generator,
) -> list[Box]:
    """A car at the kerb in front of the lot."""
    place = np.array([(lot[0] + random.uniform(-5.0, 5.0), street + side * (STREET_M / 2 - 1.5))])
    x, y = turned(place, float(middle[0]), float(middle[1]), azimuth)[0]
    car = car_at(float(x), float(y), azimuth, terrain, random)
    return [] if _near(shapely.Polygon(car.corners), outlines, 0.5) else [car]


def _tree_stands_free(tree: Tree, footprints: shapely.STRtree) -> bool:
    """Whether the trunk stands outside of all houses, and the crown does not sink deep into one."""
    trunk = shapely.Point(tree.x, tree.y)
    return len(footprints.query(trunk, predicate="dwithin", distance=0.55 * tree.crown_radius_m)) == 0
