"""What lines hit, against independent and slow ways to find it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from pipeline.synthetic.first_hit import (
    BOX,
    GROUND,
    ROOF,
    TREE,
    WALL,
    cell_of,
    first_hit,
    mixed_bits,
    terrain_hit,
    top_surface,
    uniform_of,
)
from pipeline.synthetic.scene import Scene, Terrain, Tree
from pipeline.synthetic.scene_arrays import scene_arrays
from pipeline.synthetic.solids import building_solid
from pipeline.synthetic.suites import SUITES

SUBURB = SUITES["suburb"].make(2, (120.0, 120.0))
TOWN = SUITES["town"].make(2, (120.0, 120.0))


@pytest.mark.parametrize("scene", [SUBURB, TOWN], ids=["suburb", "town"])
def test_the_surface_is_that_of_the_solids_faces(scene: Scene) -> None:
    """The twin looks for each place in the polygons of the rounded solids, by shapely."""
    x, y = np.random.default_rng(1).uniform(0, 120, (2, 6000))
    places = shapely.points(x, y)
    expected = scene.terrain.elevation(x, y)
    owner, owner_face, near_border = np.full(6000, -1), np.full(6000, -1), np.zeros(6000, bool)
    for number, building in enumerate(scene.buildings):
        solid = building_solid(building)
        for face in solid.faces:
            if face.plane < 0:
                continue
            corners = solid.vertices[list(face.rings[0])]
            polygon = shapely.Polygon(corners[:, :2])
            inside = shapely.contains(polygon, places)
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            offset = corners[0] @ normal
            z = (offset - normal[0] * x[inside] - normal[1] * y[inside]) / normal[2]
            expected[inside], owner[inside], owner_face[inside] = z, number, face.plane
            near_border |= shapely.distance(polygon.exterior, places) < 0.003
    hits = top_surface(scene, x, y)
    clear = ~near_border & (hits.kind != BOX)
    assert clear.sum() > 5500
    assert np.abs(hits.z - expected)[clear].max() < 0.004
    assert np.array_equal(hits.building[clear], owner[clear])
    assert np.array_equal(hits.face[clear], owner_face[clear])
    assert {GROUND, ROOF} <= set(hits.kind.tolist())
    assert np.array_equal(hits.on_roof, hits.kind == ROOF)


@pytest.mark.parametrize("scene", [SUBURB, TOWN], ids=["suburb", "town"])
def test_a_leaning_line_hits_where_walking_down_along_it_ends(scene: Scene) -> None:
    """The twin walks down in steps of 4 mm until the surface is above it."""
    random, kinds, step = np.random.default_rng(4), set(), 0.004
    arrays = scene_arrays(scene, max_lean=0.45)
    buildings = [b for b in scene.buildings if 25 < b.x < 95 and 25 < b.y < 95]
    for _ in range(120):
        target = buildings[int(random.integers(len(buildings)))]
        lean_x, lean_y = random.uniform(-0.3, 0.3, 2)
        start_x, start_y = random.uniform(-9, 9, 2) + np.array([target.x, target.y])
        x, y, z = terrain_hit(arrays, start_x, start_y, arrays.terrain[0], lean_x, lean_y)
        assert scene.terrain.elevation(np.array([x]), np.array([y]))[0] == pytest.approx(z, abs=1e-5)
        got, kind, _, _ = first_hit(arrays, cell_of(arrays, x, y), x, y, z, lean_x, lean_y, np.uint64(0), -1)
        heights = np.arange(25.0, -0.1, -step)
        top = top_surface(scene, x + heights * lean_x, y + heights * lean_y).z
        walked = z + heights[np.argmax(top >= z + heights)]
        assert got == pytest.approx(walked, abs=0.05 if kind == GROUND else step * 2.5)
        kinds.add(kind)
    assert {GROUND, ROOF, WALL} <= kinds


def test_a_crown_lets_beams_pass_as_the_law_of_attenuation_says() -> None:
    tree = Tree(x=10.0, y=10.0, crown_z_m=8.0, crown_radius_m=3.0, crown_half_height_m=2.0, free_path_m=2.5)
    scene = Scene(
        name="tree",
        origin=(0, 0, 0),
        crs=None,
        extent=(0, 0, 20, 20),
        terrain=Terrain(base_z_m=0.0),
        buildings=(),
        trees=(tree,),
    )
    arrays = scene_arrays(scene)
    cell, tries = cell_of(arrays, 10.0, 10.0), 20_000
    hits = [
        first_hit(arrays, cell, 10.0, 10.0, 0.0, 0.0, 0.0, np.uint64(mixed_bits(np.uint64(k))), 0) for k in range(tries)
    ]
    depth = 10.0 - np.array([z for z, kind, _, _ in hits if kind == TREE])
    assert len(depth) / tries == pytest.approx(1 - math.exp(-4.0 / 2.5), abs=0.015)
    assert depth.min() >= 0
    assert depth.max() <= 4.0
    expected = 2.5 - 4.0 * math.exp(-1.6) / (1 - math.exp(-1.6))  # mean of an exponential cut at the chord
    assert depth.mean() == pytest.approx(expected, abs=0.05)


def test_random_numbers_are_uniform_and_independent_of_one_another() -> None:
    states = [np.uint64(mixed_bits(np.uint64(k))) for k in range(2000)]
    draws = np.array([[uniform_of(state, draw) for draw in range(6)] for state in states])
    assert draws.min() > 0
    assert draws.max() < 1
    assert np.abs(draws.mean(axis=0) - 0.5).max() < 0.03
    assert np.abs(draws.std(axis=0) - math.sqrt(1 / 12)).max() < 0.02
    assert np.abs(np.corrcoef(draws.T) - np.eye(6)).max() < 0.08
    assert np.abs(np.corrcoef(draws[:-1, 0], draws[1:, 0])[0, 1]) < 0.08
