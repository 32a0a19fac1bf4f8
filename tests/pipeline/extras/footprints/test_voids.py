"""Places of a given outline without a roof point nearby."""

import numpy as np
import pytest
import shapely
from shapely import MultiPolygon

from pipeline.extras.footprints.voids import without_voids
from pipeline.model import FloatArray
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.roof_settings import RoofSettings

SETTINGS = RoofSettings()
TURN = 23.0


def turned(area: shapely.Geometry) -> shapely.Geometry:
    return shapely.affinity.rotate(area, TURN, origin=(0, 0))


def strewn(area: shapely.Geometry, density: float) -> FloatArray:
    west, south, east, north = area.bounds
    rng = np.random.default_rng(4)
    xy = rng.uniform((west, south), (east, north), (round(density * (east - west) * (north - south)), 2))
    xy = xy[shapely.contains_xy(area, xy[:, 0], xy[:, 1])]
    return np.column_stack((xy, np.full(len(xy), 6.0)))


def drawn(outline: shapely.Geometry, roof: shapely.Geometry, density: float) -> tuple[MultiPolygon, MultiPolygon]:
    """The given outline and what is left of it, integer millimetres."""
    given = footprint_in_mm(outline)
    return given, without_voids(given, strewn(roof, density), density**-0.5, SETTINGS)


@pytest.mark.parametrize(("density", "off_m"), [(10.0, 0.8), (2.0, 2.0)])
def test_a_courtyard_missing_in_the_outline_is_found_where_it_lies(density: float, off_m: float) -> None:
    outline, yard = turned(shapely.box(0, 0, 32, 26)), turned(shapely.box(9, 7, 23, 18))
    given, left = drawn(outline, outline.difference(yard), density)
    void = shapely.difference(given, left)
    assert left.is_valid
    assert len(left.geoms) == 1
    assert len(left.geoms[0].interiors) == 1
    assert shapely.hausdorff_distance(void, shapely.transform(yard, lambda xy: xy * 1e3)) < off_m * 1e3 * 1.5
    assert void.area * 1e-6 == pytest.approx(yard.area, abs=off_m * yard.length / 2)


def test_an_end_of_the_outline_without_a_roof_is_cut_off_square() -> None:
    outline = turned(shapely.box(0, 0, 24, 6))
    given, left = drawn(outline, turned(shapely.box(0, 0, 14, 6)), 10.0)
    assert left.area * 1e-6 == pytest.approx(14 * 6, abs=6.0)
    assert len(left.geoms) == 1
    assert len(left.geoms[0].exterior.coords) == 5
    assert shapely.contains(given, shapely.buffer(left, -2.0))


@pytest.mark.parametrize("width_m", [0.0, 3.0, 6.0])
def test_a_gap_whose_places_all_have_a_point_near_is_roof(width_m: float) -> None:
    outline = turned(shapely.box(0, 0, 30, 20))
    gap = turned(shapely.box(14, 4, 14 + width_m, 16))
    given, left = drawn(outline, outline.difference(gap) if width_m else outline, 10.0)
    assert left is given


def test_an_outline_without_any_point_stays_as_it_is() -> None:
    given = footprint_in_mm(shapely.box(0, 0, 20, 20))
    assert without_voids(given, np.zeros((0, 3)), 0.5, SETTINGS) is given


def test_the_order_of_the_points_does_not_matter() -> None:
    outline = turned(shapely.box(0, 0, 32, 26))
    points = strewn(outline.difference(turned(shapely.box(9, 7, 23, 18))), 6.0)
    given = footprint_in_mm(outline)
    first = without_voids(given, points, 0.4, SETTINGS)
    order = np.random.default_rng(1).permutation(len(points))
    assert without_voids(given, np.ascontiguousarray(points[order]), 0.4, SETTINGS).wkb == first.wkb
