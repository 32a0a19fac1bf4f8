"""Points against models: counted by hand, by a slow twin with shapely, and as damage moves the figures."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely
from roofs_by_hand import lifted, moved, points_of, tally_rows, with_face
from scipy.spatial import cKDTree

from pipeline.model import FloatArray, LabelArray, RoofType
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.residual_scores import (
    DEFINITIONS,
    EDGES_M,
    Residuals,
    building_residuals,
    residual_measures,
    top_surface_of,
)
from pipeline.ruler.evaluation.subsets import subsets

Bounds = tuple[float, float, float, float]


def house(name: str, x: float, y: float, *, length: float = 10.0, edge: bool = False) -> RoofModel:
    """A gable roof of 8 m width, its ridge along x at 10 m, its eaves at 8 m."""
    halves = (shapely.box(x, y, x + length, y + 4), shapely.box(x, y + 4, x + length, y + 8))
    return RoofModel(
        building_id=name,
        footprint=shapely.box(x, y, x + length, y + 8),
        roof_type=RoofType.GABLE,
        surfaces=tuple(
            RoofSurface(polygon=half, coefficients=(0.0, slope, 10.0), origin=(x, y + 4.0, 0.0), plane_id=k)
            for k, (half, slope) in enumerate(zip(halves, (0.5, -0.5), strict=True))
        ),
        touches_data_edge=edge,
    )


def tile(xyz: FloatArray, building: LabelArray, name: str = "t") -> ReferencePoints:
    return points_of(xyz, 6, name, building=building, face=0, is_roof=building >= 0)


def reader(points: ReferencePoints) -> Callable[[], ReferencePoints]:
    return lambda: points


def reference_of(
    buildings: Sequence[RoofModel], parts: Sequence[ReferencePoints], bounds: Sequence[Bounds] = ()
) -> Reference:
    tiles = tuple(reader(part) for part in parts)
    return dataclasses.replace(by_hand.reference(buildings, extent=None), tiles=tiles, bounds=tuple(bounds))


def lattice(model: RoofModel, step: float, noise: float = 0.0, seed: int = 0) -> FloatArray:
    """Points of the model's roof at the centres of a lattice."""
    x0, y0, x1, y1 = model.footprint.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step)))
    return np.column_stack((x, y, model.top(x, y) + np.random.default_rng(seed).normal(0.0, noise, len(x))))


def one_house(step: float) -> Reference:
    """One house at the origin with its lattice."""
    truth = house("a", 0, 0)
    xyz = lattice(truth, step)
    return reference_of([truth], [tile(xyz, zeros(len(xyz)))])


def figures(rows: Residuals, reference: Reference) -> dict[str, Measure]:
    return {m.name.removeprefix("residuals."): m for m in residual_measures(rows, subsets(reference)[0])}


def test_a_handful_of_points_counts_as_by_hand() -> None:
    model = house("a", 0, 0)
    # eave at 8, ridge at 10: the roof at y = 2 is 9 m high
    xyz = np.array([(1, 2, 9.1), (2, 2, 8.9), (3, 2, 9.4), (4, 2, 9.0), (12, 2, 9.0)], float)
    reference = reference_of([dataclasses.replace(model, footprint=shapely.box(0, 0, 13, 8))], [tile(xyz, zeros(5))])
    residuals = building_residuals([model], reference)
    (tally,) = tally_rows(residuals.all_points)
    assert (tally.n_points, tally.n_covered, tally.n_within) == (5, 4, 3)
    assert tally.sum_m == pytest.approx(0.4)
    assert tally.rmse_m == pytest.approx(math.sqrt((0.01 + 0.01 + 0.16) / 4))
    assert tally.share_within == 0.6
    assert tally.coverage == 0.8
    measured = figures(residuals, reference)
    assert measured["within_0_2m"].value == 0.6
    assert measured["coverage"].value == 0.8
    assert measured["rmse"].value == pytest.approx(tally.rmse_m)
    assert measured["building_rmse"].value == pytest.approx(tally.rmse_m)
    assert measured["bias"].value == pytest.approx(0.1)
    assert (measured["coverage"].n, measured["rmse"].n) == (5, 4)


def test_points_on_facades_and_below_roofs_are_counted_apart() -> None:
    truth = house("a", 0, 0)
    roof = lattice(truth, 0.5)
    below = roof[::4] - np.array([0.0, 0.0, 2.0])
    reference = reference_of([truth], [tile(np.vstack((roof, below)), zeros(len(roof) + len(below)))])
    measured = figures(building_residuals([truth], reference), reference)
    assert measured["below_roof"].value == pytest.approx(len(below) / (len(roof) + len(below)))
    assert measured["below_roof"].n == len(roof) + len(below)
    assert measured["within_0_2m_top_visible"].value == 1.0
    assert measured["within_0_2m"].value == pytest.approx(1.0 - measured["below_roof"].value)


def zeros(n: int) -> LabelArray:
    return np.zeros(n, np.int32)


def random_world(seed: int, n: int = 4000) -> tuple[list[RoofModel], Reference, FloatArray, LabelArray]:
    """Houses beside one another at large coordinates, models that are off, and noisy points with facades below."""
    rng = np.random.default_rng(seed)
    corner = np.array([685_000.0, 5_334_000.0])
    truth = [house(f"b{k}", corner[0] + 10 * k, corner[1] + 3 * (k % 3)) for k in range(6)]
    models = []
    for model in truth:
        surfaces = []
        for s in model.surfaces:
            polygon = shapely.affinity.rotate(s.polygon, rng.uniform(-9, 9))
            surfaces.append(dataclasses.replace(lifted(s, rng.normal(0, 0.2)), polygon=polygon))
        models.append(dataclasses.replace(model, surfaces=tuple(surfaces)))
    x, y = corner[0] + rng.uniform(0, 60, n), corner[1] + rng.uniform(-1, 14, n)
    building = np.full(n, -1, np.int32)
    z = np.zeros(n)
    for k, model in enumerate(truth):
        inside = shapely.contains_xy(model.footprint, x, y)
        building[inside] = k
        z[inside] = model.top(x[inside], y[inside]) - np.where(rng.random(inside.sum()) < 0.2, 3.0, 0.0)
    z += rng.normal(0, 0.1, n)
    xyz = np.round(np.column_stack((x, y, z)), 3)
    return models, reference_of(truth, [tile(xyz, building)]), xyz, building


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_those_of_a_slow_twin_point_by_point(seed: int) -> None:
    models, reference, xyz, building = random_world(seed)
    rows = building_residuals(models, reference)
    surfaces = [surface for model in models for surface in model.surfaces]
    tree = cKDTree(xyz[:, :2])
    for number, tallies in enumerate(zip(tally_rows(rows.all_points), tally_rows(rows.top_visible), strict=True)):
        own = np.flatnonzero(building == number)
        residuals, seen = [], []
        for i in own:
            x, y, z = xyz[i]
            apart = [s.polygon.distance(shapely.Point(x, y)) for s in surfaces]
            # a gap of up to 1 mm is one of rounding
            limit = 0.0 if min(apart) == 0.0 else 0.001
            tops = [
                float(s.elevation(np.array([x]), np.array([y]))[0])
                for s, distance in zip(surfaces, apart, strict=True)
                if distance <= limit
            ]
            residuals.append(z - max(tops) if tops else math.nan)
            near = [j for j in tree.query_ball_point((x, y), 0.5) if building[j] == number]
            seen.append(bool(np.all(xyz[near, 2] <= z + 1.1 + 1e-6)))
        for tally, chosen in zip(tallies, (np.ones(len(own), bool), np.array(seen)), strict=True):
            all_of = np.array(residuals)[chosen]
            of = all_of[~np.isnan(all_of)]
            assert (tally.n_points, tally.n_covered) == (len(all_of), len(of))
            assert tally.n_within == np.sum(np.abs(of) <= 0.2)
            assert tally.sum_m == pytest.approx(of.sum(), abs=1e-6)
            assert tally.sum_squares_m2 == pytest.approx((of**2).sum(), rel=1e-6)
            # bins of 5 mm up to 1 m, of 50 mm beyond; residuals at the very border of two may fall to either
            assert np.abs(tally.histogram - np.histogram(np.abs(of), EDGES_M)[0]).sum() <= 2
            for share, found in ((0.5, tally.median_m), (0.95, tally.p95_m)):
                low, high = (np.quantile(np.abs(of), share, method=end) for end in ("lower", "higher"))
                width = 0.005 if high < 1.0 else 0.05
                assert low - width <= found <= high + width


def test_a_face_moved_by_0_3_m_or_dropped_is_half_of_the_points() -> None:
    reference = one_house(0.1)
    (true,) = reference.buildings
    raised = with_face(true, 0, lifted(true.surfaces[0], 0.3))
    measured = figures(building_residuals([raised], reference), reference)
    assert measured["within_0_2m"].value == 0.5
    assert measured["rmse"].value == pytest.approx(0.3 / math.sqrt(2.0))
    assert measured["bias"].value == pytest.approx(-0.15)
    measured = figures(building_residuals([with_face(true, 0, None)], reference), reference)
    assert (measured["within_0_2m"].value, measured["coverage"].value) == (0.5, 0.5)


def test_a_face_turned_by_5_deg_is_off_in_proportion_to_the_distance_from_its_axis() -> None:
    reference = one_house(0.05)
    (true,) = reference.buildings
    tilt = math.tan(math.atan(0.5) + math.radians(5.0)) - 0.5
    turned = tuple(
        dataclasses.replace(s, coefficients=(0.0, (0.5 + tilt) * sign, 10.0))
        for s, sign in zip(true.surfaces, (1, -1), strict=True)
    )
    measured = figures(building_residuals([dataclasses.replace(true, surfaces=turned)], reference), reference)
    # dz = tilt |y - 4|, evenly spread between 0 and 4 m from the ridge
    assert measured["rmse"].value == pytest.approx(tilt * 4 / math.sqrt(3.0), rel=1e-3)
    assert measured["median"].value == pytest.approx(tilt * 2, abs=0.006)
    assert measured["p95"].value == pytest.approx(tilt * 3.8, abs=0.01)
    assert measured["within_0_2m"].value == pytest.approx(0.2 / tilt / 4, abs=0.01)


def test_of_several_models_over_a_point_the_highest_counts() -> None:
    reference = one_house(0.5)
    (low,) = reference.buildings
    measured = figures(building_residuals([low, moved(low, 0.0, 0.0, 2.0)], reference), reference)
    assert measured["bias"].value == pytest.approx(-2.0)


@pytest.mark.parametrize("cut", [685_023.4, 685_030.0])
def test_tiles_that_cut_buildings_change_nothing(cut: float) -> None:
    models, whole, xyz, building = random_world(21)
    west = xyz[:, 0] < cut
    parts = [tile(xyz[side], building[side]) for side in (west, ~west)]
    bounds = [(*xyz[side, :2].min(axis=0), *xyz[side, :2].max(axis=0)) for side in (west, ~west)]
    split = reference_of(whole.buildings, parts, bounds)
    one, two = building_residuals(models, whole), building_residuals(models, split)
    for a, b in ((one.all_points, two.all_points), (one.top_visible, two.top_visible)):
        assert (a.counts == b.counts).all()
        assert (a.histogram == b.histogram).all()
        assert a.sums == pytest.approx(b.sums)
    assert one.top_visible.counts[:, 0].sum() < (building >= 0).sum()


def test_buildings_at_the_edge_of_the_data_need_not_be_found() -> None:
    truth = [house("a", 0, 0), house("cut", 20, 0, edge=True)]
    xyz = np.concatenate([lattice(model, 0.5) for model in truth])
    building = np.repeat(np.arange(2, dtype=np.int32), len(xyz) // 2)
    reference = reference_of(truth, [tile(xyz, building)])
    assert figures(building_residuals(truth[:1], reference), reference)["coverage"].value == 1.0
    # outlines of the raster that are cut hold most points of a dense town: they count
    raster = dataclasses.replace(reference, outlines="raster")
    assert figures(building_residuals(truth[:1], raster), raster)["coverage"].value == 0.5


def test_without_models_all_is_missed_and_without_points_nothing_is_measured() -> None:
    reference = one_house(0.5)
    measured = figures(building_residuals([], reference), reference)
    assert (measured["coverage"].value, measured["within_0_2m"].value) == (0.0, 0.0)
    assert math.isnan(measured["rmse"].value)
    assert math.isnan(measured["building_rmse"].value)
    assert sorted(f"residuals.{name}" for name in measured) == sorted(definition.name for definition in DEFINITIONS)
    empty = dataclasses.replace(reference, tiles=())
    assert figures(building_residuals(empty.buildings, empty), empty) == {}


def test_a_model_at_a_wrong_place_in_the_world_changes_no_residual_and_no_index() -> None:
    true = [house("a", 0.0, 0.0), house("b", 30.0, 0.0)]
    near = top_surface_of(true, near=true)
    astray = dataclasses.replace(house("far", 1e7, 1e7), building_id="far")
    lid = RoofSurface(polygon=shapely.box(-1e6, -1e6, 1e6, 1e6), coefficients=(0.0, 0.0, 3.0))
    wide = dataclasses.replace(house("wide", 0.0, 0.0), surfaces=(lid,))
    x, y = np.meshgrid(np.arange(-9.7, 49.0, 0.5), np.arange(-9.7, 17.0, 0.5))
    both = top_surface_of([*true, astray, wide], near=true)
    facts = near.elevation(x.ravel(), y.ravel())
    assert both.elevation(x.ravel(), y.ravel()) == pytest.approx(np.where(np.isnan(facts), 3.0, facts))
    assert np.isnan(top_surface_of([astray], near=true).elevation(np.array([5.0]), np.array([4.0]))).all()


def test_the_median_of_the_buildings_lies_in_its_interval() -> None:
    true = [house(str(k), 30.0 * k, 0.0) for k in range(40)]
    xyz, building = [], []
    for k, one in enumerate(true):
        x, y = np.array([2.0, 5.0, 8.0]) + 30.0 * k, np.array([1.0, 2.0, 3.0])
        xyz.append(np.column_stack((x, y, one.top(x, y) + 0.0652)))
        building += [k] * 3
    points = tile(np.concatenate(xyz), np.array(building, np.int32))
    reference = reference_of(true, [points])
    found = residual_measures(building_residuals(true, reference), subsets(reference)[0])
    rmse = next(one for one in found if one.name == "residuals.building_rmse")
    assert (rmse.low, rmse.value, rmse.high) == pytest.approx((0.0652, 0.0652, 0.0652))
