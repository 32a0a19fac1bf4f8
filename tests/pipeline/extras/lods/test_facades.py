"""Outlines at the facades: where points beneath the eaves show the walls."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.extras.lods.facades import Eave, FacadePoints, eave_of, mean_overhang, walls_beneath
from pipeline.model import FloatArray
from pipeline.prepared_cloud import prepare_cloud
from pipeline.recipe import ReconstructSettings, reconstruct_building
from pipeline.roof.block import block_plane
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.ruler.simulation.als import scan_all
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import SCANNER, sweep

EAVE_Z = 6.0
NONE: FloatArray = np.zeros((0, 3))
EAVES = shapely.box(0.0, 0.0, 12.0, 8.0)
FACADE = ((0.0, 0.0), (12.0, 0.0)), ((12.0, 0.0), (12.0, 8.0)), ((12.0, 8.0), (0.0, 8.0)), ((0.0, 8.0), (0.0, 0.0))
"""The lines of the eaves, south, east, north, west."""


def wall(side: int, overhang: float, number: int = 40, seed: int = 0) -> FloatArray:
    """Points of the wall beneath one of the eaves, with 3 cm of noise, up to half a metre below the eave."""
    random = np.random.default_rng(seed + side)
    (x0, y0), (x1, y1) = FACADE[side]
    length = math.dist((x0, y0), (x1, y1))
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    way, off = random.uniform(0.5, length - 0.5, number), overhang + random.normal(0.0, 0.03, number)
    return np.column_stack(
        (x0 + way * ux - off * uy, y0 + way * uy + off * ux, random.uniform(0.0, EAVE_Z - 0.5, number))
    )


def street(seed: int = 9) -> FloatArray:
    """Ground all around the eaves."""
    random = np.random.default_rng(seed)
    xy = random.uniform((-2.0, -2.0), (14.0, 10.0), (1500, 2))
    xy = xy[~shapely.contains_xy(EAVES, xy[:, 0], xy[:, 1])]
    return np.column_stack((xy, np.zeros(len(xy))))


def facades(*beside: FloatArray) -> FacadePoints:
    """A flat roof over the eaves with points beside it."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.2, 12.0, 0.4), np.arange(0.2, 8.0, 0.4)))
    roof = np.column_stack((x, y, np.full(len(x), EAVE_Z)))
    return FacadePoints.of(np.concatenate(beside), NONE, roof, NONE, 0.0)


def south(points: FacadePoints, reach_m: float = 0.0) -> Eave:
    """The southern line."""
    start, end = np.array(FACADE[0])
    return eave_of(start, end, points, reach_m)


def drawn(points: FacadePoints, usual_m: float = 0.0) -> shapely.MultiPolygon:
    """The outline at the walls, in metres."""
    eaves_mm = shapely.MultiPolygon([shapely.transform(EAVES, lambda xy: xy * 1e3)])
    outline_mm = walls_beneath(eaves_mm, points, 0.0, usual_m).outline_mm
    assert outline_mm.is_valid
    return shapely.transform(outline_mm, lambda xy: xy / 1e3)


def test_every_line_lies_where_its_own_wall_was_hit() -> None:
    points = facades(street(), wall(0, 0.2), wall(1, 0.5), wall(2, 0.35), wall(3, 0.0))
    assert np.allclose(drawn(points).bounds, (0.0, 0.2, 11.5, 7.65), atol=0.03)


def test_walls_that_were_not_hit_take_the_mean_overhang_by_length() -> None:
    bounds = drawn(facades(street(), wall(0, 0.2), wall(1, 0.5))).bounds
    mean = (12.0 * 0.2 + 8.0 * 0.5) / 20.0
    assert np.allclose(bounds, (mean, 0.2, 11.5, 8.0 - mean), atol=0.03)


def test_without_any_facade_points_the_outline_stays_at_the_eaves() -> None:
    assert drawn(facades(street())).equals(shapely.MultiPolygon([EAVES]))
    assert drawn(facades(NONE)).equals(shapely.MultiPolygon([EAVES]))


def test_a_line_along_a_neighbour_stays() -> None:
    ground = street()
    beside = np.column_stack((ground[:, :2], np.where(ground[:, 0] < 0.0, 5.0, 0.0)))
    bounds = drawn(facades(beside, wall(0, 0.4))).bounds
    assert bounds[0] == 0.0
    assert np.allclose(bounds[1:], (0.4, 11.6, 7.6), atol=0.03)


def test_plants_a_row_of_cars_or_a_fence_and_points_of_one_corner_alone_are_not_a_wall() -> None:
    bush = np.random.default_rng(4).uniform((0.5, -1.5, 0.0), (11.5, 0.5, 5.0), (200, 3))
    low = wall(0, 0.3, 80) * (1.0, 1.0, 0.9 / 5.5)
    corner = wall(0, 0.3, 200)
    corner = corner[corner[:, 0] < 2.0]
    assert len(corner) > 10
    for points in (bush, low, corner):
        assert south(facades(street(), points)) == Eave(length_m=12.0, is_open=True, overhang_m=None)


def test_a_courtyard_grows_to_its_walls() -> None:
    hole = shapely.box(4.0, 2.0, 8.0, 6.0)
    random = np.random.default_rng(1)
    x = random.uniform(4.5, 7.5, 40)
    south = np.column_stack((x, np.full(40, 1.6), random.uniform(0.0, 5.5, 40)))
    ground = np.column_stack((random.uniform(4.0, 8.0, 300), random.uniform(2.0, 6.0, 300), np.zeros(300)))
    base = facades(street(), south, ground)
    outside = ~shapely.contains_xy(hole, base.roof[:, 0], base.roof[:, 1])
    points = FacadePoints.of(base.xyz, NONE, base.roof[outside], NONE, 0.0)
    outline = shapely.MultiPolygon([shapely.transform(EAVES.difference(hole), lambda xy: xy * 1e3)])
    result = shapely.transform(walls_beneath(outline, points, 0.0, 0.0).outline_mm, lambda xy: xy / 1e3)
    (yard,) = result.geoms[0].interiors
    assert np.allclose(yard.bounds, (3.6, 1.6, 8.4, 6.4), atol=0.03)
    assert np.allclose(result.bounds, (0.4, 0.4, 11.6, 7.6), atol=0.03)


def test_heights_are_above_the_terrain_of_the_place() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-4.5, 16.5), np.arange(-4.5, 12.5)))
    terrain = np.column_stack((x, y, 0.5 * x))
    points = FacadePoints.of(
        np.array([[10.2, -1.0, 6.0]]), np.array([[99.0, 0.0, 6.0]]), np.array([[0.0, 0.0, 9.0]]), terrain, -2.0
    )
    assert np.allclose(points.height_m, (6.0 - 0.5 * 10.5, 8.0))


def test_the_order_of_the_points_does_not_matter() -> None:
    beside = np.concatenate((street(), wall(0, 0.2), wall(1, 0.5)))
    mixed = beside[np.random.default_rng(2).permutation(len(beside))]
    assert drawn(facades(beside)).wkb == drawn(facades(mixed)).wkb


def test_a_turned_and_moved_building_gives_the_turned_outline() -> None:
    points = facades(street(), wall(0, 0.2), wall(1, 0.5))

    def moved(xyz: FloatArray) -> FloatArray:
        turned = shapely.get_coordinates(shapely.affinity.rotate(shapely.multipoints(xyz[:, :2]), 27.0, origin=(0, 0)))
        return np.column_stack((turned + np.array([31.0, -12.0]), xyz[:, 2]))

    there = FacadePoints.of(moved(points.xyz), NONE, moved(points.roof), NONE, 0.0)
    eaves = shapely.affinity.translate(shapely.affinity.rotate(EAVES, 27.0, origin=(0, 0)), 31.0, -12.0)
    eaves_mm = shapely.MultiPolygon([shapely.transform(eaves, lambda xy: np.rint(xy * 1e3))])
    result = walls_beneath(eaves_mm, there, 0.0, 0.0).outline_mm
    here = shapely.affinity.translate(shapely.affinity.rotate(drawn(points), 27.0, origin=(0, 0)), 31.0, -12.0)
    assert shapely.hausdorff_distance(shapely.transform(result, lambda xy: xy / 1e3), here) < 0.02


def test_a_ring_narrower_than_its_overhangs_stays_at_the_eaves() -> None:
    random = np.random.default_rng(6)
    behind = np.column_stack((random.uniform(-2.0, 14.0, 300), random.uniform(1.3, 2.6, 300), np.zeros(300)))
    for width_m, stays in ((1.2, True), (2.0, False)):
        narrow = shapely.MultiPolygon([shapely.box(0.0, 0.0, 12e3, width_m * 1e3)])
        above = behind + np.array([0.0, width_m - 1.2, 0.0])
        result = walls_beneath(narrow, facades(street(), above, wall(0, 0.7)), 0.0, 0.0).outline_mm
        assert result.is_valid
        assert result.equals(narrow) == stays


def test_the_mean_overhang_is_never_negative() -> None:
    assert mean_overhang([Eave(length_m=3.0, is_open=True, overhang_m=-0.05)])[0] == 0.0


def test_the_mean_overhang_is_the_surer_the_more_walls_are_seen_and_the_more_they_agree() -> None:
    def sigma_of(*overhangs_m: float) -> float:
        return mean_overhang([Eave(length_m=8.0, is_open=True, overhang_m=one) for one in overhangs_m])[1]

    assert sigma_of(0.3, 0.3, 0.3, 0.3) == pytest.approx(sigma_of(0.3) / 2.0)
    assert sigma_of(0.1, 0.5) > sigma_of(0.25, 0.35)
    assert all(math.isnan(value) for value in mean_overhang([Eave(length_m=8.0, is_open=True, overhang_m=None)]))


def test_walls_beneath_a_roof_are_in_the_record_and_its_solid_stays_at_the_eaves() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.2, 12.0, 0.4), np.arange(0.2, 8.0, 0.4)))
    roof = np.column_stack((x, y, np.full(len(x), EAVE_Z)))
    house = dataclasses.replace(
        candidate(roof), ground_z_m=0.0, beside=np.concatenate((street(), wall(0, 0.4), wall(1, 0.4)))
    )
    results = [
        reconstruct_building(house, "arrangement", ReconstructSettings(roof=RoofSettings(wall_outline=asked)))
        for asked in (True, False)
    ]
    with_walls, without = results
    assert without.walls is None
    assert with_walls.footprint == without.footprint
    assert with_walls.walls is not None
    assert with_walls.walls.overhang_m == pytest.approx(0.4, abs=0.05)
    assert 0.0 < with_walls.walls.overhang_sigma_m < 0.1
    assert np.allclose(with_walls.walls.outline.bounds, (0.4, 0.4, 11.6, 7.6), atol=0.06)


def test_the_usual_overhang_is_for_buildings_without_visible_walls() -> None:
    assert np.allclose(drawn(facades(street()), usual_m=0.3).bounds, (0.3, 0.3, 11.7, 7.7))
    seen = facades(street(), wall(0, 0.2))
    assert drawn(seen, usual_m=0.3).equals(drawn(seen))


def test_the_last_of_several_returns_lies_too_far_inside_by_the_reach() -> None:
    hit = wall(0, 0.4)
    later = FacadePoints.of(street(), hit, facades(NONE).roof, NONE, 0.0)
    deep, right = south(later).overhang_m, south(later, reach_m=0.12).overhang_m
    assert deep is not None
    assert right is not None
    assert abs(deep - right - 0.12) < 1e-9
    assert south(facades(street(), hit), reach_m=0.12).overhang_m == deep


@pytest.mark.slow
def test_scanned_buildings_without_overhangs_keep_their_true_area() -> None:
    scene = sweep(seed_of("dev", 1))
    block = scan_all(scene, dataclasses.replace(SCANNER, pulse_density_per_m2=8.0), 3)
    settings, walls, areas = RoofSettings(outline="walls"), 0, []
    for number, building in enumerate(scene.buildings):
        if "row" in building.building_id:
            continue
        x0, y0, x1, y1 = np.array(building.footprint.bounds) + np.tile(scene.origin[:2], 2)
        x, y, _ = block.points.xyz.T
        index = np.flatnonzero((x > x0 - 2.0) & (x < x1 + 2.0) & (y > y0 - 2.0) & (y < y1 + 2.0))
        xyz = np.rint((block.points.xyz[index] - np.floor([x0, y0, 0.0])) * 1e3) / 1e3
        own = (block.building[index] == number) & (block.face[index] >= 0)
        of, order = block.points.return_count[index], block.points.return_number[index]
        floor = float(np.median(xyz[block.building[index] < 0, 2]))
        beside = {"beside": xyz[~own & (of == 1)], "beside_later": xyz[~own & (of > 1) & (order == of)]}
        split = xyz[own & (order == 1) & (of > 1)]
        house = candidate(xyz[own], ground_z_m=floor, split_returns=split, **beside)
        bare = roof_points(prepare_cloud(house), settings)
        labelled = dataclasses.replace(bare, labels=np.zeros(len(bare.points), np.int32))
        planes = [block_plane(bare.points, floor, 70.0)]
        at_eaves = partition_roof(dataclasses.replace(labelled, facades=None), planes, settings).outline_mm
        outline = partition_roof(labelled, planes, settings).outline_mm
        walls += not outline.equals(at_eaves)
        areas.append((outline.area * 1e-6, building.footprint.area))
    drawn_m2, true_m2 = np.array(areas).T
    assert walls > 0.3 * len(areas)
    assert abs(np.median(drawn_m2 / true_m2) - 1.0) < 0.01
    assert abs(drawn_m2.sum() / true_m2.sum() - 1.0) < 0.01


def test_overhangs_under_the_least_one_and_within_their_error_do_not_count() -> None:
    points = facades(street(), wall(0, 0.15), wall(1, 0.4))
    eaves_mm = shapely.MultiPolygon([shapely.transform(EAVES, lambda xy: xy * 1e3)])
    walls = walls_beneath(eaves_mm, points, 0.0, 0.0, 0.2)
    assert np.allclose(shapely.bounds(walls.overhung_mm) / 1e3, (0.25, 0.0, 11.6, 7.75), atol=0.03)
    assert walls.outline_mm.bounds[1] == pytest.approx(150.0, abs=30.0)
    assert walls.counted_m == walls.widest_m == pytest.approx(0.4, abs=0.03)
    # the walls of a line are known to 0.087 m
    assert walls_beneath(eaves_mm, facades(street(), wall(0, 0.07)), 0.0, 0.0, 0.05).counted_m == 0.0


def test_a_ring_that_would_break_loses_the_strips_along_its_lines() -> None:
    # a bridge of 0.6 m between two wings, narrower than its overhangs of 0.4 m on either side
    bridged = shapely.union_all([shapely.box(0, 0, 5, 8), shapely.box(5, 3, 7, 3.6), shapely.box(7, 0, 12, 8)])
    ground = np.random.default_rng(2).uniform((5, 0, 0), (7, 8, 0), (400, 3))
    points = facades(street(), ground)
    eaves_mm = shapely.MultiPolygon([shapely.transform(bridged, lambda xy: xy * 1e3)])
    walls = walls_beneath(eaves_mm, points, 0.0, 0.4, 0.2)
    assert walls.outline_mm.equals(eaves_mm)
    drawn = shapely.transform(walls.overhung_mm, lambda xy: xy / 1e3)
    assert drawn.is_valid
    wanted = shapely.buffer(bridged, -0.4, join_style="mitre")
    assert len(drawn.geoms) == len(wanted.geoms) == 2
    assert shapely.symmetric_difference(drawn, wanted).area < 0.4
