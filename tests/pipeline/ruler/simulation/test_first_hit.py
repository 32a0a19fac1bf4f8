"""What lines hit, against independent and slow ways to find it."""

import math

import numpy as np
import pytest
import shapely
from simulated import hits_of_lines, scene_on, top_surface

from pipeline.ruler.simulation.first_hit import BOX, GROUND, ROOF, TREE, WALL, mixed_bits, uniform_of
from pipeline.ruler.simulation.scene import Scene, Terrain, Tree
from pipeline.ruler.simulation.scene_arrays import scene_arrays
from pipeline.ruler.simulation.solids import building_solid
from pipeline.ruler.simulation.suites import SUITES

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


@pytest.mark.slow
@pytest.mark.parametrize("scene", [SUBURB, TOWN], ids=["suburb", "town"])
def test_a_leaning_line_hits_where_walking_down_along_it_ends(scene: Scene) -> None:
    """The twin walks down in steps of 4 mm until the surface is above it."""
    random, step = np.random.default_rng(4), 0.004
    buildings = [b for b in scene.buildings if 25 < b.x < 95 and 25 < b.y < 95]
    targets = [buildings[int(random.integers(len(buildings)))] for _ in range(120)]
    leans = random.uniform(-0.3, 0.3, (120, 2))
    starts = random.uniform(-9, 9, (120, 2)) + np.array([(b.x, b.y) for b in targets])
    places = np.column_stack([starts, np.full(120, scene.terrain.base_z_m)])
    hits = hits_of_lines(scene_arrays(scene, max_lean=0.45), places, leans)
    for start, (lean_x, lean_y), z, kind in zip(places, leans, hits.z, hits.kind, strict=True):
        heights = np.arange(28.0, -4.0, -step)
        x, y = start[0] + heights * lean_x, start[1] + heights * lean_y
        walked = start[2] + heights[np.argmax(top_surface(scene, x, y).z >= start[2] + heights)]
        assert z == pytest.approx(walked, abs=0.05 if kind == GROUND else step * 2.5)
    assert {GROUND, ROOF, WALL} <= set(hits.kind.tolist())


def test_a_crown_lets_beams_pass_as_the_law_of_attenuation_says() -> None:
    tree = Tree(x=10.0, y=10.0, crown_z_m=8.0, crown_radius_m=3.0, crown_half_height_m=2.0, free_path_m=2.5)
    scene = scene_on(Terrain(base_z_m=0.0), 20, trees=(tree,))
    tries = 20_000
    states = np.array([mixed_bits(np.uint64(k)) for k in range(tries)], np.uint64)
    places = np.tile([10.0, 10.0, 0.0], (tries, 1))
    hits = hits_of_lines(scene_arrays(scene), places, np.zeros((tries, 2)), states)
    depth = 10.0 - hits.z[hits.kind == TREE]
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
