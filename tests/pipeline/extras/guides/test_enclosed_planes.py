"""Planes of the regions that guides enclose: found where points are few, and only where they explain more."""

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.extras.guides.enclosed_planes import with_enclosed_planes
from pipeline.model import FloatArray
from pipeline.roof.roof_settings import ArrangementSettings

HOUSE_MM = MultiPolygon([shapely.box(0, 0, 10_000, 6_000)])
LEFT = (0.5, 0.0, 5.0)
"""Rises to the east up to x = 4, where a level part begins."""
RIGHT = (0.0, 0.0, 7.0)
GUIDE = np.array([[4.0, 0.2, 4.0, 5.8]])


def house() -> tuple[FloatArray, FloatArray]:
    """Points 1 m apart, and which of them are on the left."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.5, 10.0), np.arange(0.5, 6.0), indexing="ij"))
    left = x < 4.0
    return np.column_stack((x, y, np.where(left, 0.5 * x + 5.0, 7.0))), left


def enclosed(points: FloatArray, pieces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """With the plane on the right alone found before."""
    labels = np.where(np.abs(points[:, 2] - 7.0) < 0.01, 0, -1).astype(np.int32)
    return with_enclosed_planes(points, labels, np.array([RIGHT]), pieces, HOUSE_MM, ArrangementSettings())


def test_a_region_without_a_plane_of_its_own_gets_one_with_its_points() -> None:
    points, left = house()
    planes, labels = enclosed(points, GUIDE)
    assert np.allclose(planes, [RIGHT, LEFT])
    assert ((labels == 1) == left).all()


def test_without_guides_or_where_the_planes_explain_all_nothing_is_added() -> None:
    points, left = house()
    assert len(enclosed(points, np.empty((0, 4)))[0]) == 1
    flat = points.copy()
    flat[:, 2] = 7.0
    assert len(enclosed(flat, GUIDE)[0]) == 1
    # four points determine a plane, and nothing confirms it
    few = np.flatnonzero(left)[[0, 5, 18, 23]]
    assert len(enclosed(np.delete(points, np.setdiff1d(np.flatnonzero(left), few), axis=0), GUIDE)[0]) == 1


def test_points_that_lie_elsewhere_do_not_turn_the_plane_of_a_region() -> None:
    points, left = house()
    points[np.flatnonzero(left)[[2, 9]], 2] += 3.0
    planes, labels = enclosed(points, GUIDE)
    assert np.allclose(planes[1], LEFT)
    assert np.count_nonzero(labels == 1) == np.count_nonzero(left) - 2


def test_a_guide_that_ends_short_of_the_outline_encloses_all_the_same() -> None:
    points, _ = house()
    assert len(enclosed(points, np.array([[4.0, 0.5, 4.0, 5.5]]))[0]) == 2
    assert len(enclosed(points, np.array([[4.0, 2.0, 4.0, 4.0]]))[0]) == 1
