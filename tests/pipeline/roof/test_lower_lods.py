"""LoD1.2 and LoD1.3 from roof faces: closed, on the same outline, joined where steps are low."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import shapely
from faces_by_hand import assert_closed, level, partition_of, plane
from shapely import Polygon

from pipeline.extras.lods.lower_lods import level_forms, lower_lods
from pipeline.model import FaceKind, FloatArray, Plane, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.simplification import without_idle_vertices
from pipeline.roof.solid import LodParts, solid_parts

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

SETTINGS = RoofSettings()
KINDS = ["flat", "pent", "gable", "hip", "l", "stepped", "courtyard", "dormer", "tower"]
LODS = ("1.2", "1.3", "2.2")


def sampled(polygons: Sequence[Polygon], planes: Sequence[Plane], pitch: float = 0.5) -> FloatArray:
    """Points on a roof, on a lattice amid its faces."""
    rows = []
    for polygon, own in zip(polygons, planes, strict=True):
        (x0, y0, x1, y1), half = polygon.bounds, pitch / 2
        axes = np.meshgrid(np.arange(x0 + half, x1, pitch), np.arange(y0 + half, y1, pitch))
        x, y = (axis.ravel() for axis in axes)
        inside = shapely.contains_xy(polygon, x, y)
        rows.append(np.column_stack((x, y, own.a * x + own.b * y + own.c))[inside])
    return np.concatenate(rows)


def built(polygons: Sequence[Polygon], planes: Sequence[Plane]) -> LodParts:
    """Roof faces as LoD2.2, the floor at 0."""
    return LodParts(lod="2.2", parts=solid_parts(partition_of(polygons), planes, 0.0), planes=list(planes))


def lower(detailed: LodParts, points: FloatArray, lods: Sequence[str] = LODS, **changes: Any) -> list[LodParts]:
    return lower_lods(detailed, points, 0.0, RoofSettings(**changes), lods, lambda solid: not check_solid(solid))


def house_with_annexe(annexe_z: float) -> tuple[list[Polygon], list[Plane]]:
    """A gable of 10 m by 8 m, eaves at 5 m and the ridge at 8 m, with a flat annexe along one eave."""
    sides = [shapely.box(0, 0, 10, 4), shapely.box(0, 4, 10, 8)]
    return [*sides, shapely.box(0, -3, 10, 0)], [plane(0.0, 0.75, 5.0), plane(0.0, -0.75, 11.0), level(annexe_z)]


def heights(model: LodParts) -> list[float]:
    return sorted(model.planes[face.plane].c for part in model.parts for face in part.faces)


def test_faces_with_a_high_step_between_them_are_level_parts_of_their_own(volume: Volume) -> None:
    polygons, planes = house_with_annexe(2.5)
    points = sampled(polygons, planes)
    detailed, levels, block = lower(built(polygons, planes), points)
    assert [model.lod for model in (detailed, levels, block)] == ["2.2", "1.3", "1.2"]
    gable = np.sort(points[points[:, 1] > 0.0, 2])
    assert heights(levels) == [2.5, round(float(gable[int(0.7 * len(gable))]), 3)]
    everything = np.sort(points[:, 2])
    assert heights(block) == [round(float(everything[int(0.7 * len(everything))]), 3)]
    (part,) = levels.parts
    assert volume(part.solid) == pytest.approx(30.0 * heights(levels)[0] + 80.0 * heights(levels)[1])
    assert volume(block.parts[0].solid) == pytest.approx(110.0 * heights(block)[0])


def test_faces_with_a_low_step_between_them_are_one_level_part() -> None:
    polygons, planes = house_with_annexe(3.5)
    _, levels, block = lower(built(polygons, planes), sampled(polygons, planes))
    assert heights(levels) == heights(block)
    _, levels, _ = lower(built(polygons, planes), sampled(polygons, planes), level_step_m=1.4)
    assert len(heights(levels)) == 2


def test_neighbouring_levels_differ_by_the_step_at_least() -> None:
    # a pent roof from 3 m to 9 m beside a flat one at 6.5 m: the mean step is 1.5 m, yet the levels differ by 0.7 m
    polygons = [shapely.box(0, 0, 6, 6), shapely.box(6, 0, 12, 6)]
    planes = [plane(0.0, 1.0, 3.0), level(6.5)]
    (levels,) = lower(built(polygons, planes), sampled(polygons, planes), ["1.3"], level_step_m=1.2)
    assert len(heights(levels)) == 1


def test_a_small_tower_joins_the_roof_around_it() -> None:
    tower = shapely.box(4, 3, 5.5, 5)
    polygons = [shapely.Polygon(shapely.box(0, 0, 10, 8).exterior, [tower.exterior]), tower]
    planes = [level(6.0), level(12.0)]
    (levels,) = lower(built(polygons, planes), sampled(polygons, planes), ["1.3"])
    assert heights(levels) == [6.0]
    (levels,) = lower(built(polygons, planes), sampled(polygons, planes), ["1.3"], min_part_area_m2=2.0)
    assert heights(levels) == [6.0, 12.0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_every_level_of_detail_is_valid_on_the_same_outline(exact_roof: ExactRoofs, kind: str, turn_deg: float) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg)
    _, points, _ = roof.partition()
    parts = roof.parts()
    models = lower(LodParts(lod="2.2", parts=parts, planes=list(roof.planes)), points.points)
    assert [model.lod for model in models] == ["2.2", "1.3", "1.2"]
    for model in models:
        assert [check_solid(part.solid) for part in model.parts] == [()] * len(parts)
        for part, own in zip(model.parts, parts, strict=True):
            assert shapely.symmetric_difference(part.footprint, own.footprint).area < 2e-3 * own.footprint.length
            assert_closed(ring for face in part.solid.faces for ring in face.rings)


def test_level_parts_share_one_wall_between_them() -> None:
    polygons, planes = house_with_annexe(2.5)
    (levels,) = lower(built(polygons, planes), sampled(polygons, planes), ["1.3"])
    solid = levels.parts[0].solid
    walls = [solid.vertices[list(face.rings[0])] for face in solid.faces if face.kind is FaceKind.WALL]
    (inner,) = [wall for wall in walls if (wall[:, 1] == 0.0).all()]
    assert set(inner[:, 2].tolist()) == set(heights(levels))


def test_levels_that_meet_at_a_corner_only_are_joined_until_the_solid_is_sound() -> None:
    # high and low quarters: walls of four faces would meet in one edge
    polygons = [shapely.box(0, 0, 5, 5), shapely.box(5, 0, 10, 5), shapely.box(5, 5, 10, 10), shapely.box(0, 5, 5, 10)]
    planes = [level(9.0), level(3.0), level(9.0), level(3.0)]
    detailed = built(polygons, planes)
    (part,) = detailed.parts
    assert check_solid(part.solid)
    (levels,) = lower(detailed, sampled(polygons, planes), ["1.3"])
    assert check_solid(levels.parts[0].solid) == ()
    forms = list(level_forms(part, sampled(polygons, planes), planes[0], 0.0, SETTINGS))
    assert len(forms[0].solid_part.faces) == 4
    assert len(forms[-1].solid_part.faces) == 1


def test_a_part_without_points_takes_the_height_of_the_whole() -> None:
    polygons = [shapely.box(0, 0, 6, 6), shapely.box(20, 0, 26, 6)]
    planes = [level(5.0), level(7.0)]
    levels, block = lower(built(polygons, planes), sampled(polygons[:1], planes[:1]), ["1.2", "1.3"])
    assert heights(levels) == heights(block) == [5.0, 5.0]
    assert [len(model.parts) for model in (levels, block)] == [2, 2]


def test_only_what_is_asked_for_is_made_and_unsound_levels_are_left_out() -> None:
    polygons, planes = house_with_annexe(2.5)
    detailed, points = built(polygons, planes), sampled(polygons, planes)
    assert [model.lod for model in lower(detailed, points, ["1.2"])] == ["1.2"]
    assert [model.lod for model in lower(detailed, points, ["2.2"])] == ["2.2"]
    assert lower_lods(detailed, points, 0.0, SETTINGS, ["1.2", "1.3"], lambda _: False) == []


def test_levels_do_not_depend_on_the_order_of_the_points() -> None:
    polygons, planes = house_with_annexe(2.5)
    points = sampled(polygons, planes)
    turned = points[np.random.default_rng(3).permutation(len(points))]
    first, second = (lower(built(polygons, planes), p, ["1.3"])[0] for p in (points, turned))
    assert first.parts[0].solid.vertices.tobytes() == second.parts[0].solid.vertices.tobytes()
    assert heights(first) == heights(second)


def test_vertices_on_straight_borders_go_from_both_sides_and_corners_stay() -> None:
    left = Polygon([(0, 0), (500, 0), (500, 400), (501, 800), (500, 1200), (0, 1200)])
    right = Polygon([(500, 0), (1000, 0), (1000, 300), (1003, 600), (1000, 1200), (500, 1200), (501, 800), (500, 400)])
    thinned = without_idle_vertices([left, right])
    assert thinned[0].equals(shapely.box(0, 0, 500, 1200))
    # of the bend by 3 mm the outermost vertex stays
    assert thinned[1].equals(Polygon([(500, 0), (1000, 0), (1003, 600), (1000, 1200), (500, 1200)]))
    assert [len(polygon.exterior.coords) for polygon in thinned] == [5, 6]


def test_many_vertices_that_bend_a_line_little_by_little_keep_their_bend() -> None:
    arc = [(x, round(x * x / 40_000)) for x in range(0, 1001, 50)]
    (thinned,) = without_idle_vertices([Polygon([*arc, (1000, 900), (0, 900)])])
    before = shapely.LineString(arc)
    after = shapely.LineString([xy for xy in thinned.exterior.coords[:-1] if xy[1] < 800])
    assert len(after.coords) < len(arc) / 2
    assert shapely.hausdorff_distance(before, after, densify=0.1) < 3.0


def with_dormers(*dormers: tuple[Polygon, Plane]) -> LodParts:
    """A gable of 10 m by 8 m, eaves at 5 m and the ridge at 8 m, with faces on it."""
    planes = [plane(0.0, 0.75, 5.0), plane(0.0, -0.75, 11.0), *(own for _, own in dormers)]
    over = shapely.union_all([polygon for polygon, _ in dormers])
    sides = [shapely.box(0, 0, 10, 4) - over, shapely.box(0, 4, 10, 8) - over]
    return built([*sides, *(polygon for polygon, _ in dormers)], planes)


def main_roof(detailed: LodParts) -> LodParts:
    points = sampled([shapely.box(0, 0, 10, 4)], [level(6.0)])
    (main,) = lower(detailed, points, ("2.0",))
    return main


def test_a_dormer_of_two_faces_belongs_to_the_face_that_it_stands_on(volume: Volume) -> None:
    left, right = shapely.box(4, 1, 5, 3), shapely.box(5, 1, 6, 3)
    detailed = with_dormers((left, plane(0.5, 0.0, 5.3)), (right, plane(-0.5, 0.0, 10.3)))
    main = main_roof(detailed)
    assert main.planes == detailed.planes
    (part,) = main.parts
    assert sorted(face.plane for face in part.faces) == [0, 1]
    assert_closed(ring for face in part.solid.faces for ring in face.rings)
    assert volume(part.solid) == pytest.approx(10 * 8 * 6.5)
    assert volume(detailed.parts[0].solid) > volume(part.solid) + 2.0


def test_a_low_place_a_large_face_and_an_annexe_are_main_roof() -> None:
    terrace = shapely.box(4, 1, 6, 3), level(4.5)
    large = shapely.box(1, 0.5, 9, 3.5), level(8.0)
    for dormer in (terrace, large):
        assert sorted(face.plane for face in main_roof(with_dormers(dormer)).parts[0].faces) == [0, 1, 2]
    polygons, planes = house_with_annexe(2.5)
    assert sorted(face.plane for face in main_roof(built(polygons, planes)).parts[0].faces) == [0, 1, 2]
