"""Contacts of walls against closed forms: boxes, gables, wedges, walls with holes; moved, turned, mirrored, renamed."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.extras.party_walls.contacts import Contacts, Walls, contacts, wall_areas
from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings

Wall = shapely.Polygon
Ring = Sequence[tuple[float, float]]


def upright(ring: Ring, floor_z: float, top_z: float) -> list[Wall]:
    """The walls of a prism over a counter-clockwise ring."""
    ends = zip(ring, [*ring[1:], ring[0]], strict=True)
    return [Wall([(*a, floor_z), (*b, floor_z), (*b, top_z), (*a, top_z)]) for a, b in ends]


def box(x0: float, y0: float, x1: float, y1: float, floor_z: float, top_z: float) -> list[Wall]:
    """The walls of a box: south, east, north, west."""
    return upright([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], floor_z, top_z)


def walls(*solids: tuple[str, list[Wall]]) -> Walls:
    """The walls of solids by building; faces are numbered within it."""
    names = [name for name, faces in solids for _ in faces]
    parts = [[other for other, _ in solids[:k]].count(name) for k, (name, faces) in enumerate(solids) for _ in faces]
    return Walls(
        polygons=np.array([face for _, faces in solids for face in faces], dtype=object),
        building=np.array(names, dtype=str),
        part=np.array(parts),
        face=np.array([names[:k].count(name) for k, name in enumerate(names)]),
    )


def found(of: Walls, **tolerances: float) -> Contacts:
    return contacts(of, np.ones(len(of), bool), PartyWallSettings(**tolerances))


def named(of: Walls, pairs: Contacts) -> list[tuple[str, int, str, int]]:
    """Building and face of both walls of each contact."""
    a, b = pairs.first, pairs.second
    return list(zip(of.building[a], of.face[a], of.building[b], of.face[b], strict=True))


def turned(of: Walls, angle: float, shift: tuple[float, float]) -> Walls:
    """The walls turned in plan about the origin, then moved."""
    c, s = math.cos(angle), math.sin(angle)

    def move(xyz: np.ndarray) -> np.ndarray:
        x, y, z = xyz.T
        return np.column_stack((c * x - s * y + shift[0], s * x + c * y + shift[1], z))

    return dataclasses.replace(of, polygons=shapely.transform(of.polygons, move, include_z=True))


def test_two_boxes_share_the_overlap_of_their_walls() -> None:
    of = walls(("a", box(0, 0, 10, 8, 0, 6)), ("b", box(10, 3, 20, 15, 1, 4)))
    pairs = found(of)
    assert named(of, pairs) == [("a", 1, "b", 3)]
    assert pairs.area_m2.tolist() == [15.0]
    assert (pairs.distance_m[0], pairs.angle_deg[0]) == (0.0, 0.0)
    shared = Wall([(10, 3, 1), (10, 8, 1), (10, 8, 4), (10, 3, 4)])
    assert shapely.get_coordinates(pairs.polygons[0], include_z=True)[:4].tolist() == [
        list(corner) for corner in shared.exterior.coords[:4]
    ]
    areas = wall_areas(of, pairs)
    assert areas.whole_m2.tolist() == [60, 48, 60, 48, 30, 36, 30, 36]
    assert areas.shared_m2.tolist() == [0, 15, 0, 0, 0, 0, 0, 15]
    assert not areas.inner_m2.any()


lengths = st.floats(1.0, 30.0)
places = st.floats(-20.0, 20.0)


@settings(max_examples=examples(60), deadline=None)
@given(
    sizes=st.tuples(lengths, lengths, lengths, lengths),
    offset=places,
    floor_m=places,
    gap_m=st.floats(-0.1, 0.1),
    angle=st.floats(0.0, 2.0 * math.pi),
    shift=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 6e6)),
)
def test_boxes_anywhere_share_length_times_height_whatever_their_names(
    sizes: tuple[float, float, float, float],
    offset: float,
    floor_m: float,
    gap_m: float,
    angle: float,
    shift: tuple[float, float],
) -> None:
    long_a, high_a, long_b, high_b = sizes
    a = box(0, 0, 10, long_a, 0, high_a)
    b = box(10 + gap_m, offset, 20, offset + long_b, floor_m, floor_m + high_b)
    length = max(0.0, min(long_a, offset + long_b) - max(0.0, offset))
    height = max(0.0, min(high_a, floor_m + high_b) - max(0.0, floor_m))
    for names in (("a", "b"), ("b", "a")):
        of = turned(walls((names[0], a), (names[1], b)), angle, shift)
        pairs = found(of, min_area_m2=0.01)
        # an overlap of both boxes may also be near to their short sides, which do not face each other
        area = float(pairs.area_m2.sum())
        expected = length * height
        assert area == pytest.approx(expected if expected > 0.011 else 0.0, abs=0.011 if expected < 0.011 else 1e-5)
        if area:
            assert named(of, pairs) == [("a", 1, "b", 3) if names[0] == "a" else ("a", 3, "b", 1)]
            assert pairs.distance_m[0] == pytest.approx(gap_m, abs=1e-6)
            assert shapely.force_2d(pairs.polygons[0]).length / 2.0 == pytest.approx(length, rel=1e-6)
        areas = wall_areas(of, pairs)
        assert areas.shared_m2.sum() == pytest.approx(2.0 * area, abs=1e-6)


def test_walls_that_are_too_far_apart_or_look_the_same_way_do_not_touch() -> None:
    a = box(0, 0, 10, 8, 0, 6)
    assert len(found(walls(("a", a), ("b", box(10.11, 0, 20, 8, 0, 6)))).first) == 0
    assert len(found(walls(("a", a), ("b", box(9.89, 0, 20, 8, 0, 6)))).first) == 0
    assert len(found(walls(("a", a), ("b", box(10.11, 0, 20, 8, 0, 6))), max_distance_m=0.2).first) == 1
    # exactly at the limit they do
    assert len(found(walls(("a", a), ("b", box(10.1, 0, 20, 8, 0, 6)))).first) == 1
    # one box within another, wall at wall: both look outward
    assert len(found(walls(("a", a), ("b", box(2, 2, 10, 6, 0, 5)))).first) == 0
    # corner at corner, and one on top of the other
    assert len(found(walls(("a", a), ("b", box(10, 8, 20, 16, 0, 6)))).first) == 0
    assert len(found(walls(("a", a), ("b", box(10, 0, 20, 8, 6, 9)))).first) == 0


@pytest.mark.parametrize("angle_deg", [1.0, 3.0, 4.9])
def test_of_a_wedge_the_part_within_the_distance_counts(angle_deg: float) -> None:
    half = math.radians(angle_deg) / 2.0
    # two long walls meet in the origin and open upwards, symmetric about the y axis
    left = [(0.0, 0.0), (-30.0 * math.sin(half), 30.0 * math.cos(half)), (-20.0, 20.0)]
    right = [(0.0, 0.0), (20.0, 20.0), (30.0 * math.sin(half), 30.0 * math.cos(half))]
    of = walls(("a", upright(left, 0, 5)), ("b", upright(right, 0, 5)))
    pairs = found(of, min_area_m2=0.0)
    assert named(of, pairs) == [("a", 0, "b", 2)]
    reach = 0.1 / (2.0 * math.tan(half))
    assert pairs.area_m2[0] == pytest.approx(5.0 * reach, rel=1e-4)
    assert pairs.distance_m[0] == pytest.approx(0.05, abs=1e-5)
    assert pairs.angle_deg[0] == pytest.approx(angle_deg)
    assert len(found(of, max_angle_deg=angle_deg - 0.01).first) == 0


HALF = math.radians(14.99)
"""Half the angle of a wedge, of nearly the largest angle that settings allow."""


@pytest.mark.parametrize("names", ["ab", "ba"])
@pytest.mark.parametrize(("limit_m", "exposed_m"), [(1.0, 9.0 - 1.0 / (2.0 * math.sin(HALF))), (5.0, 0.0)])
def test_walls_share_their_own_area_where_a_wide_wedge_is_between_them(
    names: str, limit_m: float, exposed_m: float
) -> None:
    half = HALF
    left = [(0.0, 0.0), (-9.0 * math.sin(half), 9.0 * math.cos(half)), (-20.0, 20.0)]
    right = [(-x, y) for x, y in reversed(left)]
    of = turned(walls((names[0], upright(left, 0, 5)), (names[1], upright(right, 0, 5))), 0.7, (1e5, 4e6))
    pairs = found(of, max_distance_m=limit_m, max_angle_deg=30.0)
    areas = wall_areas(of, pairs)
    exposed_m2 = areas.whole_m2 - areas.shared_m2
    facing = [int(pairs.first[0]), int(pairs.second[0])]
    assert len(pairs.first) == 1
    assert exposed_m2[facing] == pytest.approx([5.0 * exposed_m] * 2, abs=1e-4)
    assert areas.shared_m2[facing[0]] == pytest.approx(areas.shared_m2[facing[1]], abs=1e-6)
    # half-way between them it is smaller
    assert areas.shared_m2[facing[0]] * math.cos(half) == pytest.approx(pairs.area_m2[0], abs=1e-4)


def test_a_gable_shares_what_the_lower_neighbour_covers() -> None:
    gable = Wall([(10, 0, 0), (10, 8, 0), (10, 8, 3), (10, 4, 6), (10, 0, 3)])
    of = walls(("a", [gable]), ("b", box(10, 0, 20, 8, 0, 4.5)))
    pairs = found(of)
    assert pairs.area_m2.tolist() == [24.0 + 9.0]
    assert wall_areas(of, pairs).whole_m2[0] == 36.0


def test_what_leaves_two_pieces_is_one_row() -> None:
    notched = Wall([(10, 0, 0), (10, 9, 0), (10, 9, 6), (10, 6, 6), (10, 6, 2), (10, 3, 2), (10, 3, 6), (10, 0, 6)])
    of = walls(("a", [notched]), ("b", box(10, 0, 20, 9, 3, 9)))
    pairs = found(of)
    assert pairs.area_m2.tolist() == [18.0]
    assert pairs.polygons[0].geom_type == "MultiPolygon"


def test_an_opening_in_a_wall_touches_nothing() -> None:
    holed = Wall([(10, 0, 0), (10, 8, 0), (10, 8, 6), (10, 0, 6)], [[(10, 2, 1), (10, 2, 3), (10, 4, 3), (10, 4, 1)]])
    of = walls(("a", [holed]), ("b", box(10, 0, 20, 8, 0, 6)))
    pairs = found(of)
    assert pairs.area_m2.tolist() == [44.0]
    assert wall_areas(of, pairs).whole_m2[0] == 44.0
    assert shapely.get_num_interior_rings(pairs.polygons[0]) == 1


def test_what_touches_two_neighbours_counts_once_and_small_contacts_not_at_all() -> None:
    both = ("b", box(10, 0, 20, 5, 0, 6)), ("c", box(10.05, 4, 20, 8, 0, 6))
    of = walls(("a", box(0, 0, 10, 12, 0, 6)), *both)
    pairs = found(of)
    of_a = [area for (name, *_), area in zip(named(of, pairs), pairs.area_m2, strict=True) if name == "a"]
    assert of_a == pytest.approx([30.0, 24.0])
    assert wall_areas(of, pairs).shared_m2[1] == pytest.approx(48.0)
    assert len(found(of, min_area_m2=30.5).first) == 0


def test_walls_between_solids_of_one_building_are_inner_ones() -> None:
    of = walls(("a", box(0, 0, 10, 8, 0, 6)), ("a", box(10, 0, 20, 8, 0, 9)), ("b", box(10, 8, 20, 16, 0, 9)))
    pairs = found(of)
    areas = wall_areas(of, pairs)
    assert areas.inner_m2.tolist() == [0, 48, 0, 0, 0, 0, 0, 48, 0, 0, 0, 0]
    assert areas.shared_m2.tolist() == [0, 0, 0, 0, 0, 0, 90, 0, 90, 0, 0, 0]


def test_only_pairs_with_a_wall_of_ones_own_are_looked_for() -> None:
    of = walls(*((name, box(x, 0, x + 10, 8, 0, 6)) for name, x in (("a", 0), ("b", 10), ("c", 20), ("d", 30))))
    own = of.building == "b"
    pairs = contacts(of, own, PartyWallSettings())
    assert named(of, pairs) == [("a", 1, "b", 3), ("b", 1, "c", 3)]
    every = found(of)
    assert named(of, every)[:2] == named(of, pairs)
    assert every.area_m2[:2].tolist() == pairs.area_m2.tolist()


def test_no_walls_have_no_contacts() -> None:
    of = walls()
    pairs = found(of)
    assert len(pairs.first) == len(wall_areas(of, pairs).whole_m2) == 0
