"""Roof faces within an outline that others touch: nothing outside, and hardly anything lost."""

import itertools

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon
from shapely.affinity import rotate

from pipeline.errors import BuildingError
from pipeline.model import Reason, Status
from pipeline.recipe import ReconstructSettings, reconstruct_building
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.within_outline import within_outline

L_SHAPE = Polygon([(0, 0), (12_000, 0), (12_000, 9_000), (5_000, 9_000), (5_000, 6_000), (0, 6_000)])


def outlined(shape: Polygon) -> MultiPolygon:
    return MultiPolygon(polygons_of(shapely.set_precision(shape, 1.0)))


def faces(*polygons: Polygon) -> RoofPartition:
    return RoofPartition(polygons=polygons, labels=np.arange(len(polygons), dtype=np.int32))


def lost_mm2(partition: RoofPartition, outline_mm: MultiPolygon) -> float:
    """The area of the outline that no face covers; the faces are a coverage within the outline."""
    assert shapely.covers(outline_mm, partition.polygons).all()
    assert shapely.is_valid(partition.polygons).all()
    assert shapely.coverage_is_valid(partition.polygons)
    assert len(partition.labels) == len(partition.polygons)
    xy = shapely.get_coordinates(partition.polygons)
    assert (xy == np.rint(xy)).all()
    return float(outline_mm.area - shapely.area(partition.polygons).sum())


def test_faces_within_an_outline_stay_as_they_are() -> None:
    outline_mm = outlined(L_SHAPE)
    inside = faces(L_SHAPE)
    assert within_outline(inside, outline_mm) is inside


def test_a_missing_corner_that_bends_inward_comes_back() -> None:
    square = shapely.box(0, 0, 8_000, 8_000)
    bent = MultiPolygon([Polygon([(0, 0), (8_000, 0), (8_000, 8_000), (0, 8_000), (1, 3_000)])])
    left, right = shapely.box(0, 0, 4_000, 8_000), shapely.box(4_000, 0, 8_000, 8_000)
    assert lost_mm2(within_outline(faces(square), bent), bent) == 0.0
    assert lost_mm2(within_outline(faces(left, right), bent), bent) == 0.0


def test_a_corner_that_was_united_with_another_vertex_comes_back() -> None:
    outline_mm = outlined(L_SHAPE)
    moved = Polygon([(12_000, 0), (12_000, 9_000), (5_000, 9_000), (4_993, 6_000), (0, 6_000), (0, 0)])
    assert lost_mm2(within_outline(faces(moved), outline_mm), outline_mm) == 0.0


def test_a_needle_that_reaches_far_outside_goes() -> None:
    outline_mm = MultiPolygon([shapely.box(0, 0, 8_000, 8_000)])
    needle = Polygon([(0, 0), (8_000, 0), (9_000, 4_000), (8_000, 1), (8_000, 8_000), (0, 8_000)])
    assert lost_mm2(within_outline(faces(needle), outline_mm), outline_mm) == 0.0


def test_faces_that_reach_far_beyond_are_cut() -> None:
    outline_mm = outlined(rotate(L_SHAPE, 20.0))
    west, south, east, north = outline_mm.bounds
    middle = round(0.5 * (west + east))
    halves = shapely.box(west - 3_000, south, middle, north), shapely.box(middle, south, east + 500, north + 9_000)
    assert lost_mm2(within_outline(faces(*halves), outline_mm), outline_mm) < 2.0 * outline_mm.length
    with pytest.raises(BuildingError, match="leave the outline"):
        within_outline(faces(shapely.box(east + 10, south, east + 900, north)), outline_mm)


@settings(max_examples=examples(80), deadline=None)
@given(
    turn=st.floats(0, 90),
    shares=st.lists(st.floats(0.02, 0.98), min_size=2, max_size=6),
    bends=st.lists(st.tuples(st.floats(0.05, 0.95), st.sampled_from([-1, 1])), max_size=6),
)
def test_rounding_and_dropped_corners_lead_no_face_outside(
    turn: float, shares: list[float], bends: list[tuple[float, int]]
) -> None:
    plain = outlined(rotate(L_SHAPE, turn))
    corners = shapely.get_coordinates(plain)[:-1]
    # others have corners amid its edges, a millimetre off
    places = [plain.geoms[0].exterior.interpolate(share, normalized=True).coords[0] for share, _ in bends]
    extra = np.rint(np.array(places).reshape(-1, 2)) + np.array([(by, 0) for _, by in bends]).reshape(-1, 2)
    order = np.argsort([plain.geoms[0].exterior.project(shapely.Point(xy)) for xy in (*corners, *extra)])
    bent = Polygon(np.concatenate((corners, extra))[order])
    if not bent.is_valid or shapely.hausdorff_distance(bent, plain) > 2.0:
        return
    outline_mm = MultiPolygon([bent])
    west, south, east, north = plain.bounds
    edges = [west - 1, *sorted({round(west + share * (east - west)) for share in shares}), east + 1]
    strips = [shapely.box(a, south - 1, b, north + 1) for a, b in itertools.pairwise(edges)]
    net = shapely.union_all(shapely.boundary([plain, *strips]), grid_size=1.0)
    cells = polygons_of(shapely.polygonize(shapely.get_parts(net)))
    inside = [cell for cell in cells if shapely.contains(plain, shapely.point_on_surface(cell)) and cell.area > 1e4]
    assert lost_mm2(within_outline(faces(*inside), outline_mm), outline_mm) < 3.0 * outline_mm.length + 1e4 * len(cells)


def test_a_building_whose_outline_others_took_has_no_model() -> None:
    random = np.random.default_rng(2)
    points = np.column_stack((random.uniform(0, 8, (200, 2)).round(3), np.full(200, 6.0)))
    one = candidate(points, origin=(0.0, 0.0, 0.0), outline=MultiPolygon())
    result = reconstruct_building(one, "arrangement", ReconstructSettings())
    assert (result.status, result.reason) == (Status.FAILED, Reason.NO_FOOTPRINT)
    assert "others" in result.reason_detail


def test_a_needle_whose_corners_become_one_leaves_and_the_others_stay() -> None:
    outline = MultiPolygon([Polygon([(0, 0), (4000, 1), (8000, 0), (8000, 8000), (0, 8000)])])
    left = [(0, 0), (3992, 0), (4000, 4000), (4000, 8000), (0, 8000)]
    right = [(4008, 0), (8000, 0), (8000, 8000), (4000, 8000), (4000, 4000)]
    needle = [(3992, 0), (4000, 4000), (4008, 0)]
    for k in range(3):
        faces = tuple(map(Polygon, (left, needle[k:] + needle[:k], right)))
        drawn = within_outline(RoofPartition(polygons=faces, labels=np.arange(3, dtype=np.int32)), outline)
        assert shapely.covers(outline, drawn.polygons).all()
        assert shapely.area(drawn.polygons).sum() > 0.999 * outline.area


def test_a_face_of_which_nothing_is_left_is_no_fault() -> None:
    outline = MultiPolygon([Polygon([(0, 0), (4000, 1), (8000, 0), (8000, 8000), (0, 8000)])])
    crumb = RoofPartition(polygons=(Polygon([(4000, 0), (4001, 0), (4000, 1)]),), labels=np.zeros(1, np.int32))
    with pytest.raises(BuildingError, match="leave the outline"):
        within_outline(crumb, outline)
