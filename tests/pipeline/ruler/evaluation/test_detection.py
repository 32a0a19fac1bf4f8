"""Detection by area against a plain raster with scipy's morphology, by object by hand, and under known damage."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely
from roofs_by_hand import points_of
from scipy import ndimage

from pipeline.model import BoolArray, FloatArray, RoofType
from pipeline.ruler.evaluation.building_raster import (
    CELL_M,
    CellWindow,
    PlanRaster,
    PointRaster,
    outlines_of,
)
from pipeline.ruler.evaluation.detection_scores import DEFINITIONS, Detection, detect, detection_measures
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.subsets import subsets

CROSS = ndimage.generate_binary_structure(2, 1)


def model(name: str, footprint: shapely.Polygon, *, edge: bool = False) -> RoofModel:
    return RoofModel(
        building_id=name, footprint=footprint, roof_type=RoofType.FLAT, surfaces=(), touches_data_edge=edge
    )


def truth_of(buildings: Sequence[RoofModel], extent: shapely.Polygon | None) -> Reference:
    return by_hand.reference(buildings, extent=extent)


def classified(xyz: FloatArray, is_building: BoolArray, name: str = "t") -> Callable[[], ReferencePoints]:
    points = points_of(xyz, np.where(is_building, 6, 2), name, is_roof=is_building)
    return lambda: points


def figures(rows: Detection, reference: Reference) -> dict[str, Measure]:
    return {m.name.removeprefix("detection."): m for m in detection_measures(rows, subsets(reference)[0])}


def squares(n: int, side: float = 10.0, at: tuple[float, float] = (1000.0, 2000.0)) -> list[RoofModel]:
    """Square buildings, 20 m apart, their sides on whole metres."""
    return [model(f"b{k}", shapely.box(at[0] + 20 * k, at[1], at[0] + 20 * k + side, at[1] + side)) for k in range(n)]


FAR = np.array([500_000.0, 5_400_000.0])
FAR_HOUSE = shapely.Polygon([(500_050.1, 5_400_040.2), (500_062, 5_400_043), (500_055, 5_400_055.3)])
EXTENT = shapely.box(980, 1980, 1300, 2100)


# ------------------------------------------------------------------------------------------------------------ raster


def plain_raster(xyz: FloatArray, is_building: BoolArray, window: CellWindow) -> BoolArray:
    """Twin: all cells at once, counted one by one, cleaned by scipy far from any border."""
    margin = 20
    wide = window.grown(margin)
    every = np.zeros((wide.rows, wide.columns), int)
    building = every.copy()
    for (x, y, _), flag in zip(xyz, is_building, strict=True):
        r, c = math.floor(y / CELL_M) - wide.row, math.floor(x / CELL_M) - wide.column
        every[r, c] += 1
        building[r, c] += flag
    cells = ndimage.binary_closing(building * 2 > every, CROSS, iterations=2)
    return ndimage.binary_opening(cells, CROSS)[margin:-margin, margin:-margin]


@pytest.mark.parametrize("tiles", [1, 3])
def test_the_raster_of_points_is_that_of_a_plain_count(tiles: int) -> None:
    """Across the borders of windows (250 m), and whatever the tiles are."""
    rng = np.random.default_rng(7)
    centre = np.array([4000.0, -750.0])  # where four windows meet
    xyz = np.column_stack((centre + rng.uniform(-25, 25, (30_000, 2)), rng.uniform(0, 9, 30_000)))
    in_house = np.hypot(xyz[:, 0] - 4003, xyz[:, 1] + 748) < 12
    is_building = np.where(in_house, rng.random(len(xyz)) < 0.8, rng.random(len(xyz)) < 0.15)
    raster = PointRaster()
    parts = np.array_split(np.argsort(xyz[:, 0]), tiles)
    bounds = [(*xyz[part, :2].min(axis=0), *xyz[part, :2].max(axis=0)) for part in parts]
    for k, part in enumerate(parts):
        raster.add(xyz[part], is_building[part])
        raster.finish(bounds[k + 1 :])
    window = CellWindow(row=-1580, column=7920, rows=160, columns=160)
    expected = plain_raster(xyz, is_building, window)
    assert 1000 < expected.sum() < 3000
    assert (raster.window(window) == expected).all()


def test_outlines_are_the_exact_borders_of_what_hangs_together() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        cells = rng.random((25, 30)) < 0.55
        rows, columns = np.nonzero(cells)
        runs = np.column_stack((rows, columns, columns + 1))  # cells one by one: they abut
        outlines = outlines_of(runs.astype(np.int64))
        labels, n = ndimage.label(cells, CROSS)
        assert len(outlines) == n
        assert all(outline.is_valid and outline.geom_type == "Polygon" for outline in outlines)
        back = PlanRaster(outlines).window(CellWindow(row=0, column=0, rows=25, columns=30))
        assert (back == cells).all()
        assert sorted(o.area / CELL_M**2 for o in outlines) == sorted(np.bincount(labels.ravel())[1:].tolist())


@pytest.mark.parametrize("seed", range(4))
def test_a_polygon_fills_the_cells_whose_centre_it_holds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shapes = []
    for _ in range(6):
        shape = shapely.affinity.rotate(shapely.box(0, 0, *rng.uniform(3, 20, 2)), rng.uniform(0, 90))
        shape = shapely.affinity.translate(shape, *rng.uniform(0, 40, 2) + FAR)
        shapes.append(shape.difference(shape.centroid.buffer(1.0)))
    shapes.append(shapely.multipolygons([shapely.box(500_040, 5_400_000, 500_044, 5_400_003), FAR_HOUSE]))
    window = CellWindow(row=10_799_990, column=999_990, rows=150, columns=150)
    x0, y0, _, _ = window.bounds
    x, y = np.meshgrid(x0 + (np.arange(150) + 0.5) * CELL_M, y0 + (np.arange(150) + 0.5) * CELL_M)
    expected = np.any([shapely.contains_xy(shape, x, y) for shape in shapes], axis=0)
    assert (PlanRaster(shapes).window(window) == expected).all()
    assert not PlanRaster([]).window(window).any()


# ----------------------------------------------------------------------------------------------------------- by area


def test_the_truth_against_itself_is_perfect() -> None:
    truth = squares(5)
    reference = truth_of(truth, EXTENT)
    rows = detect(truth, reference)
    measured = figures(rows, reference)
    assert sorted(f"detection.{name}" for name in measured) == sorted(d.name for d in DEFINITIONS)
    for name, measure in measured.items():
        assert measure.value == 1.0, name
        assert 0.1 < measure.low < measure.high == 1.0, name  # two blocks, or five buildings, prove no more
    assert measured["area_completeness"].n == 5 * 400
    # a square of 20 x 20 cells has 80 cells outside its border (no corners) and 76 inside
    assert measured["area_completeness_without_ring"].n == 5 * 18 * 18


def test_footprints_shrunk_by_half_a_metre_lose_exactly_the_ring() -> None:
    truth = squares(4)
    reference = truth_of(truth, EXTENT)
    shrunk = [dataclasses.replace(t, footprint=t.footprint.buffer(-0.5, join_style="mitre")) for t in truth]
    measured = figures(detect(shrunk, reference), reference)
    assert measured["area_completeness"].value == pytest.approx(18 * 18 / 400)
    assert measured["area_correctness"].value == 1.0
    assert measured["area_quality"].value == pytest.approx(18 * 18 / 400)
    assert measured["area_quality_without_ring"].value == 1.0
    grown = [dataclasses.replace(t, footprint=t.footprint.buffer(0.5, join_style="mitre")) for t in truth]
    measured = figures(detect(grown, reference), reference)
    assert measured["area_completeness"].value == 1.0
    assert measured["area_correctness"].value == pytest.approx(400 / (22 * 22))
    # the four corners of each are no part of the ring of the cross
    assert measured["area_correctness_without_ring"].value == pytest.approx(18 * 18 / (18 * 18 + 4))


def test_a_building_dropped_and_one_invented_move_every_figure_by_their_share() -> None:
    truth = squares(5)
    reference = truth_of(truth, EXTENT)
    invented = model("x", shapely.box(1000, 2030, 1010, 2040))
    measured = figures(detect([*truth[1:], invented], reference), reference)
    for kind in ("area", "object"):
        assert measured[f"{kind}_completeness"].value == pytest.approx(4 / 5)
        assert measured[f"{kind}_correctness"].value == pytest.approx(4 / 5)
        assert measured[f"{kind}_quality"].value == pytest.approx(4 / 6)


def test_what_lies_outside_the_extent_is_neither_right_nor_wrong() -> None:
    truth = squares(3)
    reference = truth_of(truth, EXTENT)
    elsewhere = [model("far", shapely.box(5000, 2000, 5010, 2010)), model("over", shapely.box(970, 2050, 990, 2060))]
    measured = figures(detect([*truth, *elsewhere], reference), reference)
    assert measured["object_correctness"].value == 1.0
    assert measured["object_correctness"].n == 3
    assert measured["area_correctness"].n == 3 * 400 + 400


def test_moving_the_world_by_whole_cells_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    truth = [
        model(f"b{k}", shapely.affinity.rotate(shapely.box(1000 + 18 * k, 2000, 1011 + 18 * k, 2008), 7 * k))
        for k in range(12)
    ]
    made = [model(f"m{k}", shapely.affinity.translate(t.footprint, *rng.normal(0, 1, 2))) for k, t in enumerate(truth)]
    before = detect(made, truth_of(truth, EXTENT))
    shift = (123_456.5, 5_000_000.0)

    def moved(of: RoofModel) -> RoofModel:
        return dataclasses.replace(of, footprint=shapely.affinity.translate(of.footprint, *shift))

    there = truth_of([moved(t) for t in truth], shapely.affinity.translate(EXTENT, *shift))
    after = detect([moved(m) for m in made], there)
    here, gone = figures(before, truth_of(truth, EXTENT)), figures(after, there)
    for name, measure in here.items():
        assert gone[name].value == pytest.approx(measure.value), name
        assert 0.0 < measure.value <= 1.0


def test_given_footprints_of_a_part_give_completeness_inside_them_only() -> None:
    rng = np.random.default_rng(2)
    xyz = np.column_stack((rng.uniform((990, 1990), (1060, 2030), (60_000, 2)), np.zeros(60_000)))
    # two houses are built, the footprint of one is given; the points of the other prove nothing wrong
    built = shapely.union_all([shapely.box(1000, 2000, 1010, 2010), shapely.box(1030, 2000, 1040, 2010)])
    tiles = (classified(xyz, shapely.contains_xy(built, xyz[:, 0], xyz[:, 1])),)
    reference = dataclasses.replace(truth_of(squares(1), None), kind="points", outlines="given", tiles=tiles)
    half = [model("m", shapely.box(1000, 2000, 1005, 2010)), model("other", shapely.box(1020, 2000, 1025, 2005))]
    measured = figures(detect(half, reference), reference)
    assert set(measured) == {
        "area_completeness",
        "area_completeness_without_ring",
        "object_completeness",
        "object_completeness_10m2",
        "object_completeness_50m2",
    }
    # the cross rounds off one cell at each corner
    assert measured["area_completeness"].n == 396
    assert measured["area_completeness"].value == pytest.approx(0.5)
    assert measured["object_completeness"].value == 1.0


# --------------------------------------------------------------------------------------------------------- by object


def test_half_of_the_area_decides_whatever_the_number_of_models() -> None:
    truth = squares(3)
    parts = [
        model("left", shapely.box(1000, 2000, 1004, 2010)),
        model("middle", shapely.box(1003, 2000, 1006, 2010)),  # overlaps the first: together 6 m of 10
        model("less", shapely.box(1020, 2000, 1024.9, 2010)),
        model("wide", shapely.box(1040, 2000, 1062, 2010)),  # 10 of 22 m
    ]
    rows = detect(parts, truth_of(truth, EXTENT))
    assert rows.buildings["overlap"].round(3).tolist() == [0.6, 0.49, 1.0]
    assert (rows.buildings["overlap"] >= 0.5).tolist() == [True, False, True]
    assert (rows.models["overlap"] >= 0.5).tolist() == [True, True, True, False]
    assert rows.models["building"].tolist() == [0, 0, 1, 2]
    measured = figures(rows, truth_of(truth, EXTENT))
    assert measured["object_completeness"].value == pytest.approx(2 / 3)
    assert measured["object_correctness"].value == pytest.approx(3 / 4)
    assert measured["object_quality"].value == pytest.approx(1 / (3 / 2 + 4 / 3 - 1))


def test_small_objects_count_only_in_the_figures_of_all() -> None:
    truth = [
        *squares(1),
        model("shed", shapely.box(1020, 2000, 1022, 2004)),
        model("hut", shapely.box(1040, 2000, 1046, 2005)),
    ]
    reference = truth_of(truth, EXTENT)
    made = [truth[0], model("box", shapely.box(1100, 2000, 1103, 2003))]
    measured = figures(detect(made, reference), reference)
    shares = {name: (m.value, m.n) for name, m in measured.items() if name.startswith("object_co")}
    assert shares["object_completeness"] == (pytest.approx(1 / 3), 3)
    assert shares["object_completeness_10m2"] == (pytest.approx(1 / 2), 2)
    assert shares["object_completeness_50m2"] == (1.0, 1)
    assert shares["object_correctness"] == (0.5, 2)
    assert shares["object_correctness_10m2"] == (1.0, 1)


def test_objects_at_the_edge_of_the_data_are_left_out_on_both_sides() -> None:
    truth = [*squares(2), model("cut", shapely.box(980, 2050, 990, 2060), edge=True)]
    reference = truth_of(truth, EXTENT)
    made = [
        *truth[:2],
        model("of the cut one", shapely.box(981, 2050, 990, 2060)),
        model("x", shapely.box(1289, 2000, 1299, 2010), edge=True),
    ]
    measured = figures(detect(made, reference), reference)
    assert (measured["object_completeness"].value, measured["object_completeness"].n) == (1.0, 2)
    assert (measured["object_correctness"].value, measured["object_correctness"].n) == (1.0, 2)


def test_no_model_is_excused_by_what_it_says_of_itself_or_by_its_size() -> None:
    reference = truth_of(squares(2), EXTENT)
    made = [
        *squares(2),
        model("y", shapely.box(1200, 2000, 1210, 2010), edge=True),
        model("z", EXTENT.buffer(1_000.0)),
    ]
    measured = figures(detect(made, reference), reference)
    assert (measured["object_correctness"].value, measured["object_correctness"].n) == (0.5, 4)


def test_cells_beyond_what_is_known_cost_nothing() -> None:
    reference = truth_of(squares(2), EXTENT)
    stray = model("stray", shapely.box(0, 0, 4e7, 4e7))  # as with a vertex at (0, 0): billions of cells
    measured = figures(detect([stray], reference), reference)
    assert measured["area_completeness"].value == 1.0
    assert measured["area_correctness"].n == round(EXTENT.area / 0.25)
    far = model("far", shapely.box(1e7, 1e7, 1e7 + 10, 1e7 + 10))
    assert figures(detect([far], reference), reference)["area_completeness"].value == 0.0


def test_a_footprint_that_crosses_itself_counts_with_the_area_that_it_encloses() -> None:
    truth = squares(1)
    bow_tie = model("x", shapely.Polygon([(1000, 2000), (1010, 2010), (1010, 2000), (1000, 2010)]))
    rows = detect([bow_tie], truth_of(truth, EXTENT))
    assert rows.buildings["overlap"][0] == pytest.approx(0.5)
    assert rows.blocks["found"].sum() == pytest.approx(200, abs=20)


def test_without_models_nothing_is_found_and_nothing_is_wrong() -> None:
    reference = truth_of(squares(3), EXTENT)
    measured = figures(detect([], reference), reference)
    assert measured["area_completeness"].value == 0.0
    assert measured["object_completeness"].value == 0.0
    assert math.isnan(measured["area_correctness"].value)
    assert math.isnan(measured["object_correctness"].value)
    assert figures(detect([], dataclasses.replace(reference, buildings=())), reference)["object_completeness"].n == 0
