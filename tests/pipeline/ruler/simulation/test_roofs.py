"""Every shape of roof against slow formulas of its own, and sizes drawn at random."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from simulated import placed

from pipeline.model import FloatArray
from pipeline.roof.roof_settings import RoofTypeSettings
from pipeline.roof.roof_type import roof_type
from pipeline.ruler.simulation.additions import can_have_dormers, plan_rectangle, random_dormers, random_superstructures
from pipeline.ruler.simulation.random_dimensions import SHORTEST_SIDE_M, random_dimensions
from pipeline.ruler.simulation.roofs import (
    ROOF_TYPES,
    ROOFS,
    Addition,
    AdditionKind,
    FlatPart,
    RoofDimensions,
    RoofFaces,
    RoofShape,
)
from pipeline.ruler.simulation.solids import truth_record

SHAPES = list(RoofShape)
WITH_STEPS = {RoofShape.MULTI_LEVEL_FLAT}


def drawn(shape: RoofShape, seed: int) -> RoofDimensions:
    return random_dimensions(shape, np.random.default_rng([seed, SHAPES.index(shape)]))


def furnished(shape: RoofShape, seed: int) -> RoofDimensions:
    """A roof with dormers and boxes."""
    random = np.random.default_rng([seed, SHAPES.index(shape), 7])
    size = random_dimensions(shape, random)
    dormers = random_dormers(shape, size, random)
    return dataclasses.replace(size, additions=dormers + random_superstructures(shape, size, random, besides=dormers))


def slope_of(pitch_deg: float) -> float:
    return math.tan(math.radians(pitch_deg))


def slow_height(shape: RoofShape, size: RoofDimensions, u: FloatArray, v: FloatArray) -> FloatArray:
    """Heights by what the shape is called, from distances to eaves; nan outside."""
    length, width = size.length_m, size.width_m
    slope, second = slope_of(size.pitch_deg), slope_of(size.second_pitch_deg)
    side, end = width / 2 - np.abs(v), length / 2 - np.abs(u)
    inside = np.minimum(side, end) >= 0
    out = size.break_share * width / 2
    eave = np.minimum(side, end)

    def wing(offset: float, low: float, high: float) -> FloatArray:
        across = size.wing_width_m / 2 - np.abs(u - offset)
        return np.where((across >= 0) & (v >= low) & (v <= high), slope * across, np.nan)

    def bent(distance: FloatArray, below: float, above: float) -> FloatArray:
        return below * np.minimum(distance, out) + above * np.maximum(distance - out, 0.0)

    gable = np.where(inside, slope * side, np.nan)
    at_end, reach = length / 2 - size.wing_width_m / 2, width / 2 + size.wing_length_m
    second_reach = width / 2 + (size.second_wing_length_m or size.wing_length_m)
    match shape:
        case RoofShape.FLAT:
            z = 0.0 * u
        case RoofShape.PENT:
            z = slope * (v + width / 2)
        case RoofShape.GABLE:
            z = gable
        case RoofShape.HIP:
            z = slope * eave
        case RoofShape.HALF_HIP:
            z = np.minimum(slope * side, (1 - size.break_share) * width / 2 * slope + slope * end)
        case RoofShape.BENT_HIP:
            z = bent(eave, second, slope)
        case RoofShape.PYRAMID:
            z = slope * width / 2 * (1 - np.maximum(np.abs(u) * 2 / length, np.abs(v) * 2 / width))
        case RoofShape.UNEQUAL_GABLE:
            z = np.minimum(slope * (width / 2 + v), second * (width / 2 - v))
        case RoofShape.MANSARD:
            z = bent(eave, slope, second)
        case RoofShape.GAMBREL:
            z = bent(side, slope, second)
        case RoofShape.L_SHAPE:
            return np.fmax(gable, wing(at_end, 0.0, reach))
        case RoofShape.T_SHAPE:
            return np.fmax(gable, wing(size.wing_offset_m, 0.0, reach))
        case RoofShape.U_SHAPE:
            return np.fmax(gable, np.fmax(wing(at_end, 0.0, reach), wing(-at_end, 0.0, second_reach)))
        case RoofShape.CROSS:
            return np.fmax(gable, wing(size.wing_offset_m, -reach, reach))
        case RoofShape.COURTYARD:
            court = np.maximum(np.abs(u) - length / 2, np.abs(v) - width / 2) + size.wing_width_m
            return np.where(inside & (court >= 0), slope * np.minimum(eave, court), np.nan)
        case RoofShape.MULTI_LEVEL_FLAT:
            z = np.full(u.shape, np.nan)
            for level in size.levels:
                on = (np.abs(u - level.u_m) <= level.length_m / 2) & (np.abs(v - level.v_m) <= level.width_m / 2)
                z = np.where(on, np.fmax(z, level.height_m), z)
            return z
    return np.where(inside, z, np.nan)


def polygons_of(roof: RoofFaces) -> list[shapely.Polygon]:
    plan = roof.vertices
    return [shapely.Polygon(plan[list(rings[0])], [plan[list(hole)] for hole in rings[1:]]) for rings in roof.faces]


def heights_of(roof: RoofFaces, u: FloatArray, v: FloatArray) -> FloatArray:
    """Heights of the faces at places; nan where there is none."""
    z = np.full(len(u), np.nan)
    places = shapely.points(u, v)
    for polygon, rings in zip(polygons_of(roof), roof.faces, strict=True):
        on = shapely.intersects(polygon, places)
        corners = roof.vertices[list(rings[0])]
        design = np.column_stack([corners[:, :2], np.ones(len(corners))])
        a, b, c = np.linalg.lstsq(design, corners[:, 2], rcond=None)[0]
        z[on] = np.fmax(z[on], a * u[on] + b * v[on] + c)
    return z


def area_of(shape: RoofShape, size: RoofDimensions) -> float:
    """Footprint by arithmetic."""
    main, wing = size.length_m * size.width_m, size.wing_width_m
    if shape in {RoofShape.L_SHAPE, RoofShape.T_SHAPE}:
        return main + wing * size.wing_length_m
    if shape is RoofShape.U_SHAPE:
        return main + wing * (size.wing_length_m + (size.second_wing_length_m or size.wing_length_m))
    if shape is RoofShape.CROSS:
        return main + 2 * wing * size.wing_length_m
    if shape is RoofShape.COURTYARD:
        return main - (size.length_m - 2 * wing) * (size.width_m - 2 * wing)
    if shape is RoofShape.MULTI_LEVEL_FLAT:
        return sum(level.length_m * level.width_m for level in size.levels)
    return main


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(3))
def test_the_faces_lie_where_the_formula_of_the_shape_says(shape: RoofShape, seed: int) -> None:
    size = drawn(shape, seed)
    roof = ROOFS[shape](size)
    u, v = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 2000)) * np.abs(roof.vertices[:, :2]).max() * 1.1
    borders = shapely.union_all([polygon.boundary for polygon in polygons_of(roof)])
    clear = ~shapely.dwithin(borders, shapely.points(u, v), 1e-6)
    found, expected = heights_of(roof, u, v)[clear], slow_height(shape, size, u, v)[clear]
    assert np.isfinite(expected).sum() > 400
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 1e-6


@pytest.mark.parametrize("shape", SHAPES)
def test_faces_cover_the_footprint_exactly_once(shape: RoofShape) -> None:
    for make in (drawn, furnished):
        for seed in range(3):
            size = make(shape, seed)
            roof = ROOFS[shape](size)
            polygons = polygons_of(roof)
            footprint = shapely.union_all([shapely.force_2d(polygon) for polygon in polygons])
            assert isinstance(footprint, shapely.Polygon)
            assert len(footprint.interiors) == (shape is RoofShape.COURTYARD)
            assert sum(polygon.area for polygon in polygons) == pytest.approx(footprint.area, abs=1e-6)
            assert footprint.area == pytest.approx(area_of(shape, size), abs=1e-6)
            assert all(polygon.is_valid and polygon.exterior.is_ccw for polygon in polygons)


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape not in WITH_STEPS])
def test_bare_roofs_are_continuous(shape: RoofShape) -> None:
    """No two vertices over one place, and every inner edge has a face on both sides."""
    for seed in range(5):
        roof = ROOFS[shape](drawn(shape, seed))
        assert len(np.unique(roof.vertices[:, :2].round(5), axis=0)) == len(roof.vertices)
        edges = {(ring[k - 1], ring[k]) for rings in roof.faces for ring in rings for k in range(len(ring))}
        outline = [(a, b) for a, b in edges if (b, a) not in edges]
        boundary = shapely.union_all(polygons_of(roof)).boundary
        middles = [shapely.Point((roof.vertices[a, :2] + roof.vertices[b, :2]) / 2) for a, b in outline]
        assert max(shapely.distance(boundary, middles)) < 1e-6
        length = sum(math.dist(roof.vertices[a, :2], roof.vertices[b, :2]) for a, b in outline)
        assert length == pytest.approx(boundary.length, abs=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_turning_the_building_turns_its_planes(shape: RoofShape) -> None:
    size = furnished(shape, 1)
    here, there = (placed(shape, size, azimuth_deg=azimuth_deg) for azimuth_deg in (10.0, 83.0))
    assert here.faces == there.faces
    assert here.groups == there.groups
    for plane, turned_plane in zip(here.planes, there.planes, strict=True):
        assert turned_plane.slope_deg == pytest.approx(plane.slope_deg, abs=1e-9)
        if plane.slope_deg > 0:
            assert (turned_plane.aspect_deg - plane.aspect_deg) % 360.0 == pytest.approx(73.0, abs=1e-6)


@pytest.mark.parametrize(
    ("shape", "faces", "groups"),
    [
        *((RoofShape.HALF_HIP, 4, 4), (RoofShape.BENT_HIP, 8, 4), (RoofShape.PYRAMID, 4, 4)),
        *((RoofShape.UNEQUAL_GABLE, 2, 2), (RoofShape.GAMBREL, 4, 4), (RoofShape.GABLE, 2, 2)),
        *((RoofShape.L_SHAPE, 4, 4), (RoofShape.COURTYARD, 8, 8)),
    ],
)
def test_faces_and_groups_are_as_many_as_the_shape_has(shape: RoofShape, faces: int, groups: int) -> None:
    for seed in range(4):
        roof = ROOFS[shape](drawn(shape, seed))
        assert len(roof.faces) == len(roof.groups) == faces
        assert sorted(set(roof.groups)) == list(range(groups))


@pytest.mark.parametrize(("shape", "groups"), [(RoofShape.T_SHAPE, 4), (RoofShape.U_SHAPE, 6), (RoofShape.CROSS, 4)])
def test_faces_that_a_wing_of_equal_width_cuts_in_two_stay_one_group(shape: RoofShape, groups: int) -> None:
    size = dataclasses.replace(drawn(shape, 1), wing_offset_m=0.0)
    lower, equal = (
        ROOFS[shape](dataclasses.replace(size, wing_width_m=width)) for width in (0.8 * size.width_m, size.width_m)
    )
    assert len(set(lower.groups)) == len(set(equal.groups)) == groups
    assert len(equal.faces) > groups or shape is RoofShape.U_SHAPE


def test_a_mansard_ends_flat_or_in_a_low_hip() -> None:
    size = RoofDimensions(length_m=14.0, width_m=10.0, pitch_deg=65.0, break_share=0.3)
    assert len(ROOFS[RoofShape.MANSARD](size).faces) == 5
    assert len(ROOFS[RoofShape.MANSARD](dataclasses.replace(size, second_pitch_deg=15.0)).faces) == 8


GABLE = RoofDimensions(length_m=14.0, width_m=10.0, pitch_deg=40.0)


def on_gable(kind: AdditionKind, v_m: float = -2.5, **sizes: float) -> RoofDimensions:
    given = {"length_m": 2.0, "width_m": 2.4, "height_m": 1.2, **sizes}
    return dataclasses.replace(GABLE, additions=(Addition(kind=kind, u_m=1.0, v_m=v_m, **given),))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_pent_dormer_stands_over_its_front_and_runs_into_the_roof_at_its_back(side: float) -> None:
    slope = slope_of(40.0)
    roof = ROOFS[RoofShape.GABLE](on_gable(AdditionKind.PENT_DORMER, side * 2.5))
    assert len(roof.faces) == 3
    (front, inside, back, beyond) = heights_of(roof, np.full(4, 1.0), side * np.array([3.699, 2.5, 1.301, 1.299]))
    eave = 5.0 - 3.7
    assert front == pytest.approx(eave * slope + 1.2, abs=2e-3)
    assert back == pytest.approx(beyond, abs=4e-3)
    assert inside == pytest.approx((front + back) / 2, abs=1e-3)
    assert heights_of(roof, np.array([1.0]), np.array([side * 3.701]))[0] == pytest.approx(eave * slope, abs=2e-3)


def test_a_gable_dormer_has_a_ridge_that_runs_level_into_the_roof() -> None:
    roof = ROOFS[RoofShape.GABLE](on_gable(AdditionKind.GABLE_DORMER))
    assert len(roof.faces) == 4
    v = np.linspace(-3.69, -1.31, 20)
    ridge = heights_of(roof, np.full(20, 1.0), v)
    assert np.ptp(ridge) < 1e-9
    assert ridge[0] == pytest.approx((5.0 - 1.3) * slope_of(40.0))
    left, right = (heights_of(roof, np.full(20, 1.0 + aside), v) for aside in (-0.4, 0.4))
    assert np.allclose(left, right)
    eave = heights_of(roof, np.array([0.001]), np.array([-3.69]))[0]
    assert eave == pytest.approx(1.3 * slope_of(40.0) + 1.2, abs=5e-3)


def test_a_box_on_a_ridge_stands_over_its_highest_part() -> None:
    roof = ROOFS[RoofShape.GABLE](on_gable(AdditionKind.BOX, 0.1, width_m=1.0))
    tops = [rings for rings in roof.faces if np.ptp(roof.vertices[list(rings[0]), 2]) == 0]
    assert len(tops) == 1
    assert roof.vertices[tops[0][0][0], 2] == pytest.approx(5.0 * slope_of(40.0) + 1.2)


def test_dormers_on_hipped_ends_look_along_the_ridge() -> None:
    dormer = Addition(kind=AdditionKind.PENT_DORMER, u_m=-5.5, v_m=0.0, length_m=2.4, width_m=1.6, height_m=1.2)
    size = RoofDimensions(length_m=16.0, width_m=12.0, pitch_deg=40.0, additions=(dormer,))
    building = placed(RoofShape.HIP, size, azimuth_deg=90.0)  # the rear end looks west
    slopes = [(plane.slope_deg, plane.aspect_deg) for plane in building.planes]
    assert slopes[-1][0] < 30.0
    assert slopes[-1][1] == pytest.approx(270.0)


@pytest.mark.parametrize(
    ("shape", "size", "message"),
    [
        (RoofShape.GABLE, on_gable(AdditionKind.BOX, 4.9), "hangs over the outline"),
        (RoofShape.GABLE, on_gable(AdditionKind.PENT_DORMER, 0.5), "stands on 2 faces"),
        (RoofShape.GABLE, on_gable(AdditionKind.GABLE_DORMER, width_m=1.0), "does not run into the roof"),
        (
            RoofShape.GABLE,
            dataclasses.replace(on_gable(AdditionKind.PENT_DORMER), pitch_deg=0.0),
            "does not run into the roof",
        ),
        (RoofShape.HALF_HIP, RoofDimensions(length_m=6, width_m=8, pitch_deg=30, break_share=0.9), "leave a ridge"),
        (RoofShape.BENT_HIP, RoofDimensions(length_m=9, width_m=8, pitch_deg=30, second_pitch_deg=40), "flatter"),
        (RoofShape.GAMBREL, RoofDimensions(length_m=9, width_m=8, pitch_deg=30, second_pitch_deg=40), "steeper"),
        (RoofShape.HIP, RoofDimensions(length_m=5, width_m=6, pitch_deg=30), "has no ridge"),
        (RoofShape.L_SHAPE, RoofDimensions(length_m=9, width_m=6, wing_width_m=6, wing_length_m=3), "does not fit"),
        (RoofShape.T_SHAPE, RoofDimensions(length_m=9, width_m=8, wing_width_m=9, wing_length_m=3), "does not fit"),
        (RoofShape.U_SHAPE, RoofDimensions(length_m=12, width_m=8, wing_width_m=6, wing_length_m=3), "no court"),
        (RoofShape.COURTYARD, RoofDimensions(length_m=12, width_m=8, wing_width_m=4), "leave no court"),
        (RoofShape.MULTI_LEVEL_FLAT, RoofDimensions(length_m=12, width_m=8), "two or more"),
    ],
)
def test_impossible_roofs_are_refused(shape: RoofShape, size: RoofDimensions, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ROOFS[shape](size)


def test_sizes_that_make_no_roof_are_refused() -> None:
    with pytest.raises(ValueError, match="no area"):
        RoofDimensions(length_m=0.0, width_m=5.0)
    with pytest.raises(ValueError, match="pitch_deg is 80"):
        RoofDimensions(length_m=5.0, width_m=5.0, pitch_deg=80.0)
    with pytest.raises(ValueError, match="has no body"):
        Addition(kind=AdditionKind.BOX, u_m=0.0, v_m=0.0, length_m=1.0, width_m=1.0, height_m=0.0)


def test_levels_that_do_not_touch_are_refused() -> None:
    levels = tuple(
        FlatPart(u_m=u, v_m=0.0, length_m=4.0, width_m=4.0, height_m=height) for u, height in ((-4.0, 0.0), (4.0, 2.0))
    )
    with pytest.raises(ValueError, match="2 separate outlines"):
        placed(RoofShape.MULTI_LEVEL_FLAT, RoofDimensions(length_m=12.0, width_m=4.0, levels=levels))


@pytest.mark.parametrize("shape", SHAPES)
def test_drawn_sizes_are_plausible_and_hold_the_wanted_area_and_pitch(shape: RoofShape) -> None:
    random = np.random.default_rng(5)
    for _ in range(25):
        size = random_dimensions(shape, random)
        assert 59.0 < area_of(shape, size) < 1210.0
        assert min(size.length_m, size.width_m) >= SHORTEST_SIDE_M
        assert size.wing_width_m == 0.0 or size.wing_width_m >= 2.5
        area = float(random.uniform(90.0, 500.0))
        wanted = random_dimensions(shape, random, area_m2=area, pitch_deg=38.0)
        assert area_of(shape, wanted) == pytest.approx(area, rel=0.02)
        assert wanted.pitch_deg == (0.0 if shape in {RoofShape.FLAT, RoofShape.MULTI_LEVEL_FLAT} else 38.0)
        assert len(ROOFS[shape](wanted).faces) > 0


def test_the_same_seed_draws_the_same_and_too_small_areas_are_refused() -> None:
    assert furnished(RoofShape.CROSS, 4) == furnished(RoofShape.CROSS, 4) != furnished(RoofShape.CROSS, 5)
    smallest = random_dimensions(RoofShape.GABLE, np.random.default_rng(0), area_m2=16.0)
    assert (smallest.length_m, smallest.width_m) == (4.0, 4.0)
    for shape in (RoofShape.GABLE, RoofShape.U_SHAPE):
        with pytest.raises(ValueError, match="area_m2 is 15: too small"):
            random_dimensions(shape, np.random.default_rng(0), area_m2=15.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_drawn_additions_stand_clear_of_each_other_on_the_roof(shape: RoofShape) -> None:
    found = 0
    for seed in range(6):
        size = furnished(shape, seed)
        outline = shapely.union_all(polygons_of(ROOFS[shape](dataclasses.replace(size, additions=()))))
        taken = [shapely.Polygon(plan_rectangle(one)) for one in size.additions]
        kinds = {one.kind for one in size.additions}
        assert AdditionKind.BOX in kinds
        found += len(kinds) > 1
        assert all(outline.buffer(-0.29).contains(one) for one in taken)
        assert all(a.distance(b) >= 0.5 for k, a in enumerate(taken) for b in taken[:k])
        alone = random_superstructures(shape, drawn(shape, seed), np.random.default_rng(seed), at_most=1)
        assert len(alone) == 1
    assert found >= 5 if can_have_dormers(shape) else found == 0


@pytest.mark.parametrize("shape", list(RoofShape))
def test_the_rule_of_the_records_calls_the_exact_roof_as_the_table_does(shape: RoofShape) -> None:
    for seed in range(5):
        record = truth_record(placed(shape, drawn(shape, seed)), (0.0, 0.0, 0.0))
        assert record.roof_type is ROOF_TYPES[shape]
        assert roof_type(record.planes, record.faces, record.solids, RoofTypeSettings()) is ROOF_TYPES[shape]
