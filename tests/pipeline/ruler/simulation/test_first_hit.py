"""What lines hit, against independent and slow ways to find it."""

import math

import numpy as np
import pytest
from simulated import hits_of_lines, scene_on, top_surface

from pipeline.ruler.simulation.first_hit import GROUND, ROOF, TREE, WALL, mixed_bits, uniform_of
from pipeline.ruler.simulation.scene_arrays import scene_arrays
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain, Tree
from pipeline.ruler.simulation.suites import SUITES

SUBURB = SUITES["suburb"].make(2, (120.0, 120.0))
TOWN = SUITES["town"].make(2, (120.0, 120.0))


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
