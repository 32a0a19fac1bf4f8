"""What lies beside an outline: places without points, and ground as high as the roof."""

import numpy as np
import pytest
import shapely
from faces_by_hand import level, plane

from pipeline.model import FloatArray, Plane, RoofFace
from pipeline.quality.unseen_sides import level_side_share, unseen_beside_m2

PENT = plane(0.0, 0.5, 3.0)
"""It rises to the north."""


def face(over: Plane, x0: float, y0: float, x1: float, y1: float) -> RoofFace:
    flat = shapely.box(x0, y0, x1, y1)
    ring = [(x, y, over.a * x + over.b * y + over.c) for x, y in flat.exterior.coords]
    return RoofFace(plane=0, polygon=shapely.Polygon(ring))


def cells(x0: int, y0: int, x1: int, y1: int) -> FloatArray:
    """Centres of the cells of 1 m of a box, at elevation 0."""
    x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    return np.column_stack((x.ravel(), y.ravel(), 0.0 * x.ravel()))


def beside(over: Plane, voids: FloatArray, spacing_m: float = 0.4) -> float:
    """Of a roof of 12 m by 4 m."""
    one = face(over, 0.0, 0.0, 12.0, 4.0)
    return unseen_beside_m2(shapely.box(0.0, 0.0, 12.0, 4.0), [one], [over], voids, spacing_m)


def test_the_area_beyond_the_upper_end_of_a_slope_counts_and_that_beyond_its_eave_does_not() -> None:
    assert beside(PENT, cells(0, 4, 12, 8)) == pytest.approx(48.0)
    assert beside(PENT, cells(0, 5, 12, 8)) == pytest.approx(36.0)
    assert beside(PENT, cells(0, -4, 12, 0)) == 0.0
    assert beside(plane(0.0, -0.5, 5.0), cells(0, -4, 12, 0)) == pytest.approx(48.0)
    assert beside(PENT, cells(12, 0, 15, 4)) == pytest.approx(12.0)
    assert beside(level(3.0), cells(0, 4, 12, 8)) == 0.0
    assert beside(PENT, np.zeros((0, 3))) == 0.0


def test_an_area_that_begins_farther_from_an_outline_does_not_count() -> None:
    assert beside(PENT, cells(0, 6, 12, 9)) == 0.0
    # where points are sparse, outlines are known less well
    assert beside(PENT, cells(0, 6, 12, 9), spacing_m=1.6) == pytest.approx(36.0)


def test_a_slope_that_has_hardly_begun_to_fall_may_go_on() -> None:
    planes = [PENT, plane(0.0, -0.5, 7.0)]
    faces = [face(PENT, 0.0, 0.0, 12.0, 4.0), face(planes[1], 0.0, 4.0, 12.0, 4.5)]
    faces[1] = RoofFace(plane=1, polygon=faces[1].polygon)
    voids = cells(0, 5, 12, 8)
    assert unseen_beside_m2(shapely.box(0.0, 0.0, 12.0, 4.5), faces, planes, voids, 0.4) == pytest.approx(36.0)


@pytest.mark.parametrize("turned", [False, True])
def test_the_direction_of_a_ring_does_not_matter(turned: bool) -> None:
    outline = shapely.box(0.0, 0.0, 12.0, 4.0, ccw=turned)
    one = face(PENT, 0.0, 0.0, 12.0, 4.0)
    assert unseen_beside_m2(outline, [one], [PENT], cells(0, 4, 12, 6), 0.4) == pytest.approx(24.0)


def share_of_level(over: Plane, ground_z: FloatArray) -> float:
    """Of a roof of 12 m by 4 m, with the terrain at cells from -4 to 16 m and -4 to 8 m."""
    ground = cells(-4, -4, 16, 8)
    ground[:, 2] = np.broadcast_to(ground_z, len(ground))
    one = face(over, 0.0, 0.0, 12.0, 4.0)
    return level_side_share(shapely.box(0.0, 0.0, 12.0, 4.0), [one], [over], ground)


def test_a_level_roof_is_compared_with_the_ground_at_each_side() -> None:
    y = cells(-4, -4, 16, 8)[:, 1]
    assert share_of_level(level(3.0), np.array(0.0)) == 0.0
    assert share_of_level(level(3.0), np.where(y > 4.0, 3.0, 0.0)) == pytest.approx(12.0 / 32.0, abs=0.03)
    assert share_of_level(level(3.0), np.where(y > 4.0, 2.5, 0.0)) == 0.0
    assert share_of_level(level(3.0), np.where(y > 4.0, 9.0, 0.0)) == pytest.approx(12.0 / 32.0, abs=0.03)
    corner = (y > 4.0) & (cells(-4, -4, 16, 8)[:, 0] < 2.0)
    assert share_of_level(level(3.0), np.where(corner, 3.0, 0.0)) == 0.0
    assert share_of_level(PENT, np.where(y > 4.0, 5.0, 0.0)) == 0.0
    assert level_side_share(shapely.box(0, 0, 1, 1), [], [], np.zeros((0, 3))) == 0.0
