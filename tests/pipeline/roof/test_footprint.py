"""Given footprints, clipping, and the fallback block over any of them."""

import contextlib
import math

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.errors import BuildingError
from pipeline.model import FaceKind, Reason
from pipeline.quality.validity import check_solid
from pipeline.roof.block import block_forms, block_plane
from pipeline.roof.footprint import hull_of_points, outline
from pipeline.roof.footprint_in_mm import footprint_in_mm, simpler_outlines
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart
from pipeline.roof.traced_forms import clip_partition

SQUARE = RoofPartition(polygons=(shapely.box(0, 0, 10_000, 10_000),), labels=np.array([0], np.int32))
PLANE = block_plane(np.full((3, 3), 5.0), 0.0, 50.0)


def test_a_bow_tie_footprint_is_made_valid() -> None:
    bow = shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    cleaned = footprint_in_mm(bow)
    assert cleaned.is_valid
    assert cleaned.area * 1e-6 == pytest.approx(8.0)


def test_repeated_vertices_and_elevations_go() -> None:
    ring = [(0, 0, 1), (4, 0, 1), (4.002, 0.001, 1), (4, 4, 1), (0, 4, 1)]
    cleaned = footprint_in_mm(shapely.Polygon(ring))
    assert not cleaned.has_z
    assert shapely.get_num_coordinates(cleaned) == 5


def test_a_footprint_without_area_is_refused() -> None:
    with pytest.raises(BuildingError) as caught:
        footprint_in_mm(shapely.Polygon([(0, 0), (1, 0), (2, 0)]))
    assert caught.value.reason is Reason.NO_FOOTPRINT


def test_clipping_cuts_faces_and_small_pieces_join_their_neighbour() -> None:
    left = shapely.Polygon([(0, 0), (5000, 0), (5000, 5000), (0, 5000)])
    right = shapely.Polygon([(5000, 0), (9000, 0), (9000, 5000), (5000, 5000)])
    coverage = RoofPartition(polygons=(left, right), labels=np.array([0, 1], np.int32))
    footprint = shapely.MultiPolygon([shapely.box(1000, 1000, 5100, 4000)])
    clipped = clip_partition(coverage, footprint, 1.0)
    assert clipped.labels.tolist() == [0]
    assert clipped.polygons[0].equals(footprint.geoms[0])
    both = clip_partition(coverage, footprint, 0.1)
    assert both.labels.tolist() == [0, 1]
    assert sum(p.area for p in both.polygons) == footprint.area


def test_a_face_that_a_footprint_cuts_apart_becomes_two() -> None:
    footprint = shapely.box(-1000, 2000, 11_000, 8000).difference(shapely.box(4000, 0, 6000, 20_000))
    clipped = clip_partition(SQUARE, footprint, 1.0)
    assert clipped.labels.tolist() == [0, 0]


def test_nothing_inside_the_footprint_is_an_error() -> None:
    with pytest.raises(BuildingError, match="no roof face lies inside"):
        clip_partition(SQUARE, shapely.MultiPolygon([shapely.box(20_000, 0, 30_000, 1000)]), 1.0)


def test_collinear_points_have_no_hull() -> None:
    assert hull_of_points(np.array([[0.0, 0, 0], [1, 1, 5], [2, 2, 9]])) is None
    assert hull_of_points(np.zeros((0, 3))) is None


def test_a_block_reaches_the_percentile_of_the_points_and_never_the_floor() -> None:
    points = np.column_stack((np.zeros(10), np.zeros(10), np.arange(10.0)))
    assert block_plane(points, 0.0, 70.0).c == 7.0
    assert block_plane(points, 20.0, 70.0).c == 20.1


def first_sound_blocks(
    footprint_mm: shapely.MultiPolygon, tolerance_m: float, min_area_m2: float = 1.0
) -> list[SolidPart]:
    for form in block_forms(footprint_mm, PLANE, 0.0, tolerance_m, min_area_m2):
        with contextlib.suppress(BuildingError):
            parts = form()
            if not any(check_solid(part.solid) for part in parts):
                return parts
    return []


def test_a_block_with_a_courtyard_has_ten_faces() -> None:
    ring = shapely.box(0, 0, 9000, 9000).difference(shapely.box(3000, 3000, 6000, 6000))
    (part,) = first_sound_blocks(shapely.MultiPolygon([ring]), 0.0, 4.0)
    assert check_solid(part.solid) == ()
    assert [sum(f.kind is kind for f in part.solid.faces) for kind in FaceKind] == [1, 8, 1, 0, 0]


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 1.0]))
@example(7283152, 0.0)  # a hole that touches the outline
@settings(max_examples=examples(80), deadline=None)
def test_a_block_is_valid_over_any_footprint(seed: int, tolerance_m: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 30))
    angle = np.sort(rng.uniform(0, math.tau, n))
    radius = rng.uniform(0.5, 15.0, n)
    star = shapely.Polygon(np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))).buffer(0)
    hole = shapely.Point(*rng.uniform(-3, 3, 2)).buffer(rng.uniform(0.01, 3), quad_segs=2)
    pinch = shapely.box(0, 0, 4, 4).union(shapely.box(4, 4, 8, 8))
    shape = star.difference(hole) if rng.uniform() < 0.7 else pinch.union(star)
    if shape.area < 1.0:
        return
    assert first_sound_blocks(footprint_in_mm(shape), tolerance_m)


@pytest.mark.parametrize("corners", [4, 5, 64, 256])
def test_a_block_stands_on_the_very_footprint_where_that_is_sound(corners: int) -> None:
    angle = np.linspace(0.0, math.tau, corners, endpoint=False)
    around = footprint_in_mm(shapely.Polygon(6.0 * np.column_stack((np.cos(angle), np.sin(angle)))))
    (part,) = first_sound_blocks(around, 0.3)
    metres = shapely.transform(around, lambda xy: xy * 1e-3)
    assert shapely.equals_exact(shapely.MultiPolygon([part.footprint]), metres, 1e-9, normalize=True)


def test_a_block_is_drawn_back_where_its_courtyard_touches_the_outline() -> None:
    whole, court = shapely.box(0, 0, 9000, 9000), shapely.Polygon([(0, 4000), (3000, 3000), (3000, 5000)])
    parts = first_sound_blocks(shapely.MultiPolygon([whole.difference(court)]), 0.0)
    area_m2 = sum(part.footprint.area for part in parts)
    assert 78.0 * 0.99 < area_m2 < 78.0


def test_a_block_without_an_area_is_an_error() -> None:
    for form in block_forms(shapely.MultiPolygon(), PLANE, 0.0, 0.3, 1.0):
        with pytest.raises(BuildingError, match="has an area of 0 m2"):
            form()


def rounded_hall() -> shapely.MultiPolygon:
    """A hall with a half-round end and a round courtyard, both of short edges."""
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 80)
    apse = [(12.0 + 4.0 * math.cos(a), 4.0 + 4.0 * math.sin(a)) for a in angle.tolist()]
    hall = shapely.Polygon([(0.0, 0.0), *apse, (0.0, 8.0)])
    return footprint_in_mm(hall.difference(shapely.Point(5.0, 4.0).buffer(2.0, quad_segs=32)))


def test_a_simpler_outline_has_the_same_area_and_lies_near() -> None:
    before = rounded_hall()
    simpler = list(simpler_outlines(before))
    assert len(simpler) == 2
    counts = [int(shapely.get_num_coordinates(one)) for one in (before, *simpler)]
    assert counts[0] > 1.5 * counts[1] > 2.25 * counts[2]
    for one, reach_mm in zip(simpler, (5.0, 20.0), strict=True):
        assert one.is_valid
        assert (shapely.get_coordinates(one) % 1.0 == 0.0).all()
        assert one.area == pytest.approx(before.area, rel=1e-4)
        assert shapely.hausdorff_distance(one, before, densify=0.05) < 1.5 * reach_mm
        assert {(0.0, 0.0), (0.0, 8000.0)} <= {tuple(xy) for xy in shapely.get_coordinates(one).tolist()}


@pytest.mark.parametrize("shape", [shapely.box(0, 0, 9, 6), shapely.Point(0, 0).buffer(20.0, quad_segs=16)])
def test_an_outline_of_long_edges_has_no_simpler_one(shape: shapely.Polygon) -> None:
    assert list(simpler_outlines(footprint_in_mm(shape))) == []


def test_a_partition_with_a_border_that_crosses_itself_has_an_outline_all_the_same() -> None:
    knot = shapely.Polygon([(0, 0), (4_000, 0), (4_000, 3_000), (2_000, 3_100), (2_010, 2_900), (0, 3_000)])
    crossed = shapely.Polygon([(0, 3_000), (2_010, 2_900), (2_000, 3_100), (4_000, 3_000), (4_000, 6_000), (0, 6_000)])
    bow = shapely.Polygon([(4_000, 0), (8_000, 0), (8_000, 6_000), (3_990, 3_050), (4_010, 3_040), (4_000, 6_000)])
    partition = RoofPartition(polygons=(knot, crossed, bow), labels=np.arange(3, dtype=np.int32))
    assert not shapely.is_valid(np.array(partition.polygons, dtype=object)).all()
    found, mended = outline(partition), shapely.union_all(shapely.make_valid(np.array(partition.polygons)))
    assert found.is_valid
    assert found.area == pytest.approx(mended.area, rel=1e-3)
