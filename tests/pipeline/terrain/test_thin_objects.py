"""Low, thin objects between ground on both sides."""

import math

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.model import BoolArray, IntArray
from pipeline.terrain.facets import SceneVertices, VertexKind
from pipeline.terrain.thin_objects import are_thin, thin_between

WIDTH_MM = 1500


def lattice(side_m: float, seed: int = 0) -> IntArray:
    """Points of a jittered lattice of half a metre, millimetres, sorted by (x, y)."""
    axis = np.arange(-side_m, side_m, 0.5)
    places = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    places += np.random.default_rng(seed).uniform(-0.1, 0.1, places.shape)
    found = np.rint(1000 * places).astype(np.int64)
    return found[np.lexsort((found[:, 1], found[:, 0]))]


def thin(points: IntArray, ground: IntArray, width_mm: int = WIDTH_MM) -> BoolArray:
    x, y = (np.ascontiguousarray(points[:, k]) for k in range(2))
    gx, gy = (np.ascontiguousarray(ground[:, k]) for k in range(2))
    return thin_between(x, y, np.ones(len(x), np.bool_), gx, gy, width_mm)


def slow_twin(points: IntArray, ground: IntArray) -> list[bool]:
    """The nearest ground of each point by sorting; then any ground seen at 135 degrees and more from it."""
    found = []
    for point in points.tolist():
        around = sorted((math.dist(place, point), tuple(place)) for place in ground.tolist())
        near, (gx, gy) = around[0]
        toward = math.atan2(gy - point[1], gx - point[0])
        found.append(
            near < WIDTH_MM
            and around[7][0] < WIDTH_MM
            and any(
                near + far <= WIDTH_MM
                and abs(math.remainder(math.atan2(y - point[1], x - point[0]) - toward, math.tau))
                >= math.radians(135) - 1e-12
                for far, (x, y) in around
            )
        )
    return found


def test_it_agrees_with_a_slow_twin() -> None:
    random = np.random.default_rng(1)
    points = random.integers(-6000, 6000, (300, 2))
    ground = random.integers(-5000, 5000, (200, 2))
    ground = ground[np.lexsort((ground[:, 1], ground[:, 0]))]
    found = thin(points, ground)
    assert found.tolist() == slow_twin(points, ground)
    assert 0.1 < found.mean() < 0.9


@pytest.mark.parametrize(("width_m", "is_thin"), [(0.4, True), (2.0, False)])
@pytest.mark.parametrize("turn_deg", [0, 30, 90, 160])
def test_a_hedge_is_thin_and_a_shed_is_not(width_m: float, turn_deg: float, *, is_thin: bool) -> None:
    angle = math.radians(turn_deg)
    across = lattice(8.0) @ np.array([-math.sin(angle), math.cos(angle)])
    along = lattice(8.0) @ np.array([math.cos(angle), math.sin(angle)])
    on = np.abs(across) < 500 * width_m
    inner = (np.abs(across) < 150) & (np.abs(along) < 5000)
    assert (thin(lattice(8.0)[inner], lattice(8.0)[~on]) == is_thin).all()


def test_the_edges_and_tips_of_a_shed_stay_with_it() -> None:
    places = lattice(6.0)
    x, y = (np.ascontiguousarray(places[:, k]) for k in range(2))
    shed = (np.abs(x) < 1600) & (np.abs(y) < 1600)
    wall = (x > 1600) & (np.abs(y) < 300)
    stands = shed | wall
    height = np.where(stands, 1800, 0)
    vertices = SceneVertices(
        x_mm=x,
        y_mm=y,
        z_mm=height,
        height_mm=height,
        kind=np.where(stands, VertexKind.OBJECT, VertexKind.GROUND).astype(np.int8),
        planar=np.ones(len(x), np.int8),
    )
    tips = thin(places[shed], places[~stands])
    assert tips.any()
    found = are_thin(x, y, stands, vertices, 2000, WIDTH_MM)
    assert not found[shed].any()
    assert found[wall & (x > 2600) & (x < 5500)].all()
    # what is as high as a building is none
    assert not are_thin(x, y, stands, vertices._replace(height_mm=height + 500), 2000, WIDTH_MM).any()
    assert not are_thin(x, y, stands, vertices, 2000, 0).any()


def test_only_wanted_points_are_looked_at_and_a_width_of_0_finds_none() -> None:
    places = lattice(4.0)
    on = np.abs(places[:, 0]) < 300
    x, y = (np.ascontiguousarray(places[on, k]) for k in range(2))
    gx, gy = (np.ascontiguousarray(places[~on, k]) for k in range(2))
    wanted: npt.NDArray[np.bool_] = np.arange(len(x)) % 2 == 0
    whole = thin_between(x, y, np.ones(len(x), np.bool_), gx, gy, WIDTH_MM)
    assert whole.any()
    np.testing.assert_array_equal(thin_between(x, y, wanted, gx, gy, WIDTH_MM), whole & wanted)
    assert not thin_between(x, y, wanted, gx, gy, 0).any()
    assert not thin_between(x, y, wanted, gx[:0], gy[:0], WIDTH_MM).any()
