"""Steps between two levels are straight, along the outline where the points do not demand another direction."""

import itertools
import math

import numpy as np
import pytest
import shapely
from shapely import LineString, Polygon, affinity

from pipeline.geometry import point_spacing_m
from pipeline.model import FloatArray
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.raster_labels import Raster
from pipeline.roof.arrangement.step_lines import border_places, chains_of
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.roof_settings import ArrangementSettings

TURN_DEG = 17.0
ROOF = shapely.box(0, 0, 20, 14)
STRAIGHT = shapely.box(9, 0, 20, 14)
OBLIQUE = Polygon([(9, 0), (20, 0), (20, 14), (9 + 14 * math.tan(math.radians(25)), 14)])
CORNER = shapely.box(9, 0, 20, 7)
SPACINGS = [0.3, 0.5, 1.0]


def step_of(upper: Polygon, spacing_m: float, seed: int) -> FloatArray:
    """Vertices of the border that is drawn between two levels, metres, in the frame in which the roof is not turned."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(0.5 * spacing_m, 20, spacing_m), np.arange(0.5 * spacing_m, 14, spacing_m))
    xy = np.column_stack((x.ravel(), y.ravel())) + rng.uniform(-0.5, 0.5, (x.size, 2)) * spacing_m
    xy = xy[shapely.intersects_xy(ROOF, *xy.T)]
    labels = shapely.intersects_xy(upper, *xy.T).astype(np.int32)
    turned = shapely.get_coordinates(affinity.rotate(shapely.MultiPoint(xy), TURN_DEG, origin=(0, 0)))
    points = np.column_stack((np.rint(turned * 1e3) / 1e3, 6.0 + labels + rng.normal(0.0, 0.03, len(xy))))
    order = np.lexsort((points[:, 1], points[:, 0]))
    points = points[order]
    outline = footprint_in_mm(affinity.rotate(ROOF, TURN_DEG, origin=(0, 0)))
    levels = np.array([(0.0, 0.0, 6.0), (0.0, 0.0, 7.0)])
    drawn = arrange(points, labels[order], levels, outline, point_spacing_m(points), ArrangementSettings())
    return border_between(drawn)


def border_between(drawn: RoofPartition) -> FloatArray:
    """Vertices of the one line between two faces, in the frame in which the roof is not turned."""
    low, high = drawn.polygons
    shared = shapely.intersection(low.boundary, high.boundary)
    line = shared if isinstance(shared, LineString) else shapely.line_merge(shared)
    assert isinstance(line, LineString)
    vertices: FloatArray = shapely.get_coordinates(affinity.rotate(line, -TURN_DEG, origin=(0, 0))) * 1e-3
    return vertices


def directions_deg(vertices: FloatArray) -> list[float]:
    """Of the edges, modulo half a turn."""
    along = np.diff(vertices, axis=0)
    return [float(angle) % 180.0 for angle in np.degrees(np.arctan2(along[:, 1], along[:, 0]))]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("spacing_m", SPACINGS)
def test_a_straight_step_is_one_edge_parallel_to_the_outline(spacing_m: float, seed: int) -> None:
    step = step_of(STRAIGHT, spacing_m, seed)
    assert directions_deg(step) == pytest.approx([90.0], abs=0.05)
    assert abs(step[:, 0] - 9.0).max() < 0.15 * spacing_m


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("spacing_m", SPACINGS)
def test_an_oblique_step_stays_oblique(spacing_m: float, seed: int) -> None:
    step = step_of(OBLIQUE, spacing_m, seed)
    long = np.hypot(*np.diff(step, axis=0).T) > 2.0
    assert np.array(directions_deg(step))[long] == pytest.approx([65.0], abs=3.0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("spacing_m", SPACINGS)
def test_a_step_around_a_corner_has_one_inner_corner(spacing_m: float, seed: int) -> None:
    step = step_of(CORNER, spacing_m, seed)
    assert sorted(min(angle, 180.0 - angle) for angle in directions_deg(step)) == pytest.approx([0.0, 90.0], abs=0.2)
    assert step[1] == pytest.approx([9.0, 7.0], abs=0.25 * spacing_m)


def test_places_follow_each_other_around_an_island_and_up_to_a_fork() -> None:
    labels = np.zeros((8, 9), np.int32)
    labels[1:3, 1:3] = 1
    labels[4:, 5:] = 1
    labels[6:, 5:] = 2
    number = np.arange(labels.size, dtype=np.int32)
    raster = Raster(0.0, 0.0, 1.0, 9, 8, number, number)
    border = border_places(labels.ravel(), raster, 3)
    at = np.zeros((border.corners, 3), np.int64)
    members = np.flatnonzero(border.pairs == 1)
    order, starts = chains_of(border, members, at)
    chains = [order[a:b] for a, b in itertools.pairwise(starts)]
    assert sorted(map(len, chains)) == [6, 8]
    assert sorted(order) == members.tolist()
    assert not at.any()
    for chain in chains:
        apart = np.hypot(*np.diff(border.places[chain], axis=0).T)
        assert apart.max() <= 1.0
