"""Slits between outlines that touch: which there are, and which outline takes them."""

import numpy as np
import pytest
import shapely
from shapely import MultiPolygon, Polygon
from shapely.affinity import rotate

from pipeline.roof.slits import between, closed, slits, united

EVERYWHERE = shapely.box(-1e6, -1e6, 1e6, 1e6)


def outline(x0: float, y0: float, x1: float, y1: float) -> MultiPolygon:
    """A box of metres, in integer millimetres."""
    return MultiPolygon([shapely.transform(shapely.box(x0, y0, x1, y1), lambda xy: np.rint(xy * 1e3))])


def turned(area: MultiPolygon, degrees: float) -> MultiPolygon:
    return MultiPolygon([shapely.transform(rotate(area, degrees, origin=(0, 0)).geoms[0], np.rint)])


def corners(area: shapely.Geometry) -> int:
    return shapely.get_num_coordinates(shapely.simplify(area, 3.0)) - 1


@pytest.mark.parametrize("degrees", range(0, 180, 13))
def test_the_smaller_one_moves_its_front_up_to_the_larger_one(degrees: int) -> None:
    house, shed = turned(outline(0, 0, 10, 8), degrees), turned(outline(10.4, 3, 14, 10), degrees)
    (slit,) = slits((house, shed), between(house, shed), EVERYWHERE, (), ())
    assert slit.area_mm.area == pytest.approx(0.4 * 5.0 * 1e6, rel=0.01)
    of_house, of_shed = closed(house, shed, [slit])
    assert of_house == []
    moved = shapely.union_all([shed, *of_shed], grid_size=1.0)
    assert corners(moved) == 4  # also where the house ends before the shed does
    assert moved.area == pytest.approx(4.0 * 7.0 * 1e6, rel=0.01)
    assert shapely.intersection(moved, house).area < 3e3
    assert shapely.distance(moved, house) <= 1.0


def test_an_alley_and_a_corner_are_no_slits() -> None:
    house = outline(0, 0, 10, 8)
    assert between(house, outline(11.1, 0, 14, 8)) == []
    beside_a_corner = outline(10.4, 8.3, 14, 12)
    assert slits((house, beside_a_corner), between(house, beside_a_corner), EVERYWHERE, (), ()) == []


def test_a_slit_of_three_is_taken_once() -> None:
    left, right, above = outline(0, 0, 5, 8), outline(5, 0, 10, 8), outline(1, 8.4, 9, 12)
    areas = [between(left, above), between(right, above)]
    found = [
        slits((first, above), areas[k], EVERYWHERE, (third,), areas[1 - k])
        for k, (first, third) in enumerate(((left, right), (right, left)))
    ]
    pieces = [slit.area_mm for one in found for slit in one]
    assert len(pieces) == 2
    assert shapely.intersection(*pieces).area == 0.0
    assert sum(piece.area for piece in pieces) == pytest.approx(8.0 * 0.4 * 1e6, rel=0.01)
    # a strip never reaches in front of the third one
    assert all(strip.area < 1.1 * slit.area_mm.area for one in found for slit in one for strip in slit.strips_mm)


def test_what_others_cover_is_no_slit_and_nothing_is_closed_beyond_what_is_known() -> None:
    house, shed = outline(0, 0, 10, 8), outline(10.4, 0, 14, 8)
    areas = between(house, shed)
    pillar = outline(10, 3, 10.4, 5)
    pieces = [slit.area_mm for slit in slits((house, shed), areas, EVERYWHERE, (pillar,), ())]
    assert len(pieces) == 2
    assert not any(shapely.intersection(piece, pillar).area for piece in pieces)
    assert slits((house, shed), areas, shapely.box(0, 0, 20_000, 7_000), (), ()) == []


def test_an_offset_that_crosses_itself_is_mended() -> None:
    """The mitred offset of these two, inwards, is an invalid polygon."""
    first = [(19630, -7857), (10830, -14019), (7200, -8834), (16000, -2672)]
    second = [
        (0, 0), (1738, 12544), (7032, 11811), (6325, 6708), (18898, 4966), (20117, 13769), (31089, 12250),
        (28839, -3995),
    ]  # fmt: skip
    pieces = between(MultiPolygon([Polygon(first)]), MultiPolygon([Polygon(second)]))
    assert len(pieces) == 1
    assert all(piece.is_valid and piece.area < 8e6 for piece in pieces)


def test_a_slit_around_a_corner_moves_no_edge_across_the_court() -> None:
    wings = MultiPolygon([outline(-5, -5, 0, 3.3).geoms[0].union(outline(-5, -5, 6.9, 0).geoms[0])])
    shed = outline(0.5, 0.6, 4.5, 3.5)
    (slit,) = slits((wings, shed), between(wings, shed), EVERYWHERE, (), ())
    taken = [part for side in closed(wings, shed, [slit]) for part in side]
    assert shapely.union_all(taken).difference(slit.area_mm).area < 1e3


def test_an_outline_and_what_it_takes_are_on_the_grid_without_hairlines() -> None:
    house, shed = turned(outline(0, 0, 10, 8), 17.0), turned(outline(10.4, 3, 14, 10), 17.0)
    (slit,) = slits((house, shed), between(house, shed), EVERYWHERE, (), ())
    grown = united(shed, [slit.area_mm])
    places = shapely.get_coordinates(grown)
    assert (places == np.rint(places)).all()
    assert (np.hypot(*np.diff(places, axis=0).T) > 0.0).all()
    assert grown.area == pytest.approx(shed.area + slit.area_mm.area, rel=1e-3)


def test_a_slit_all_around_a_shed_in_a_court_is_closed() -> None:
    house = MultiPolygon([outline(0, 0, 20, 20).geoms[0].difference(outline(6, 6, 12, 11).geoms[0])])
    shed = outline(6.4, 6.3, 11.5, 10.6)
    (slit,) = slits((house, shed), between(house, shed), EVERYWHERE, (), ())
    both = [united(one, pieces) for one, pieces in zip((house, shed), closed(house, shed, [slit]), strict=True)]
    assert shapely.union_all(both).area == pytest.approx(400e6, rel=1e-3)
    assert shapely.intersection(*both).area < 3e3
