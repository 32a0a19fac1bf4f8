"""A city made tile by tile is the city made at once, and grows at its edges only."""

import dataclasses
import json
from collections import Counter
from pathlib import Path

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from labels import labels_of
from measured import printed_with_peak

from pipeline.errors import SettingsError
from pipeline.model import FloatArray
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.als import ScanBlock, scan_all
from pipeline.ruler.simulation.city import CITY_SCANNER, CityPlan, city
from pipeline.ruler.simulation.dataset import ScenePaths, simulate, tile_extents
from pipeline.ruler.simulation.simulated_scene import Defect, Scene
from pipeline.ruler.simulation.strips import reached
from pipeline.ruler.simulation.suites import SUITES
from pipeline.ruler.simulation.truth_files import write_models

SIZE = (300.0, 220.0)
SPARSE = dataclasses.replace(CITY_SCANNER, pulse_density_per_m2=1.0)
TILE_M = 150.0
SPARSE_CITY = dataclasses.replace(SUITES["city"], scanner=SPARSE, tile_m=TILE_M)


@pytest.fixture(scope="module")
def whole() -> Scene:
    return city(1_005, size_m=SIZE)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> ScenePaths:
    return simulate(SPARSE_CITY, tmp_path_factory.mktemp("city"), 1_005, size_m=SIZE)


def in_order(xyz: FloatArray) -> FloatArray:
    return xyz[np.lexsort(xyz.T)]


@pytest.mark.slow
def test_the_tiles_together_hold_exactly_the_points_of_the_whole_scan(whole: Scene, made: ScenePaths) -> None:
    block: ScanBlock = scan_all(whole, SPARSE, 1_005)
    tiles = np.concatenate([laspy.read(path).xyz for path in sorted((made.laz).iterdir())])
    assert made.tiles == 4
    assert len(tiles) == len(block) == made.points
    assert np.allclose(in_order(tiles), in_order(block.points.xyz), atol=1e-6)


def test_every_building_has_one_owner_and_all_are_there(whole: Scene, made: ScenePaths) -> None:
    expected = sorted(one.building_id for one in whole.buildings)
    assert sorted(model.building_id for model in read_models(made.truth).models) == expected
    assert pq.read_table(made.truth / "conditions.parquet")["building_id"].to_pylist() == expected
    manifest = json.loads((made.truth / "scene.json").read_text())
    counts = (manifest["buildings"], manifest["trees"], manifest["cars"])
    assert counts == (len(whole.buildings), len(whole.trees), len(whole.boxes))
    assert manifest["extent"][2] - manifest["extent"][0] == SIZE[0]


def test_a_tile_holds_the_buildings_whose_middle_lies_in_it(whole: Scene, made: ScenePaths) -> None:
    extents = dict(tile_extents(SIZE, TILE_M))
    middles = {one.building_id: (one.x, one.y) for one in whole.buildings}
    for key, (x0, y0, x1, y1) in extents.items():
        rows = pq.read_table(made.truth / "buildings" / f"tile={key}" / "part-0.parquet")["building_id"].to_pylist()
        assert rows
        for name in rows:
            x, y = middles[name]
            assert x0 <= x < x1 or not 0 <= x < SIZE[0]
            assert y0 <= y < y1 or not 0 <= y < SIZE[1]


@pytest.mark.slow
def test_a_smaller_city_in_the_same_folder_leaves_nothing_of_the_larger_one(tmp_path: Path) -> None:
    tiled = dataclasses.replace(SPARSE_CITY, tile_m=50.0)
    assert simulate(tiled, tmp_path, 7, size_m=(90.0, 50.0)).tiles == 2
    again = simulate(tiled, tmp_path, 7, size_m=(50.0, 50.0))
    assert [path.name for path in (tmp_path / "tiles").iterdir()] == ["city_x0_y0.laz"]
    assert len(read_models(again.truth).models) == again.buildings
    assert len(labels_of(again.truth)["class"]) == again.points


@pytest.mark.slow
def test_a_larger_city_holds_the_smaller_one_unchanged(whole: Scene) -> None:
    larger = city(1_005, size_m=(SIZE[0] + 60.0, SIZE[1] + 30.0))
    known = {one.building_id: one for one in larger.buildings}
    for one in whole.buildings:
        assert np.array_equal(one.vertices, known[one.building_id].vertices)
    assert set(whole.trees) < set(larger.trees)


def test_a_house_counts_as_overhung_only_where_a_crown_is_over_its_eave(whole: Scene) -> None:
    """A shrub beside a wall covers no roof, however near it stands."""
    index = shapely.STRtree([one.footprint for one in whole.buildings])
    beside: set[int] = set()
    over: set[int] = set()
    for tree in whole.trees:
        place = shapely.Point(tree.x, tree.y)
        for k in index.query(place, predicate="dwithin", distance=tree.crown_radius_m).tolist():
            share = whole.buildings[k].footprint.distance(place) / tree.crown_radius_m
            top_z_m = tree.crown_z_m + tree.crown_half_height_m * np.sqrt(1.0 - share**2)
            (over if top_z_m > whole.buildings[k].eave_z_m else beside).add(k)
    inside = {k for k, one in enumerate(whole.buildings) if one.vertices[:, :2].min() > 20.0}
    inside &= {
        k for k, one in enumerate(whole.buildings) if (one.vertices[:, :2].max(axis=0) < np.array(SIZE) - 20.0).all()
    }
    marked = {k for k, one in enumerate(whole.buildings) if Defect.OVERHANGING_TREE in one.defects}
    assert marked & inside == over & inside
    assert len(marked & inside) > 3
    assert (beside - over) & inside


@pytest.mark.slow
def test_buildings_behind_the_last_beam_on_high_ground_touch_the_edge_of_the_data(tmp_path: Path) -> None:
    """The plateau lies 150 m over the base that pulses aim at: points end up to 20 m before the extent does."""
    plan = CityPlan(1_000, (2_000.0, 790.0))
    scene = plan.part((1_500.0, 0.0, 1_850.0, 100.0))
    xyz = scan_all(scene, CITY_SCANNER, 1_000).points.xyz[:, :2] - np.array(scene.origin[:2])
    points = shapely.STRtree(shapely.points(xyz))
    rows = write_models(scene.buildings, scene, CITY_SCANNER, tmp_path, "part")
    is_cut = {one.building_id: row["touches_data_edge"] for one, row in zip(scene.buildings, rows, strict=True)}
    inside = [one for one in scene.buildings if shapely.box(1_530.0, 0.0, 1_820.0, 60.0).contains(one.footprint)]
    known = [is_cut[one.building_id] for one in inside]
    densities = [len(points.query(one.footprint, predicate="contains")) / one.footprint.area for one in inside]
    assert known == [not reached(one.vertices, scene, CITY_SCANNER).all() for one in inside]
    assert min(density for density, cut in zip(densities, known, strict=True) if not cut) > 5.0
    assert min(densities) == 0.0
    assert 3 < sum(known) < len(known)


@pytest.mark.slow
def test_a_square_kilometre_has_all_kinds_of_things_and_a_steep_hillside() -> None:
    scene = city(1_000)
    shapes = Counter(str(one.shape) for one in scene.buildings)
    assert len(shapes) == 16
    assert 1_000 < len(scene.buildings) < 2_000
    assert {str(defect) for one in scene.buildings for defect in one.defects} == {
        "wet_spot",
        "dormers",
        "superstructure",
        "overhanging_tree",
    }
    slopes = np.array([scene.terrain.slope_deg(one.x, one.y) for one in scene.buildings])
    assert 25.0 < slopes.max() < 30.0
    assert np.median(slopes) < 5.0
    assert len(scene.trees) > 1_000
    assert len(scene.boxes) > 1_000


@pytest.mark.slow
def test_a_city_is_written_in_bounded_memory(tmp_path: Path) -> None:
    """Measured in a process of its own: four times the tiles, about the same peak."""
    program = (
        "import sys\n"
        "from pipeline.ruler.simulation.dataset import simulate\n"
        "made = simulate('city', sys.argv[1], 1000, size_m=(float(sys.argv[2]),) * 2, density_per_m2=6.0)\n"
        "print(made.points)\n"
    )
    found = (map(int, printed_with_peak(program, tmp_path / f"{m}", m)) for m in (500, 1000))
    (few, small_kb), (many, large_kb) = found
    assert many > 3.6 * few
    assert large_kb - small_kb < 100_000
    assert large_kb < 1_500_000


@pytest.mark.parametrize("slope_deg", [0.0, 20.0, 30.0])
def test_a_city_on_a_hillside_has_one_slope_all_over(tmp_path: Path, slope_deg: float) -> None:
    made = simulate(SPARSE_CITY, tmp_path, 9, size_m=(90.0, 80.0), slope_deg=slope_deg)
    table = pq.read_table(made.truth / "conditions.parquet")
    slopes = np.array(table["terrain_slope_deg"].to_pylist())
    assert len(slopes) > 2
    assert np.abs(slopes - slope_deg).max() < 1.0
    ground = laspy.read(made.laz / "city_x0_y0.laz").xyz[labels_of(made.truth)["class"] == 2]
    fitted = np.linalg.lstsq(np.column_stack((ground[:, :2] - ground[0, :2], np.ones(len(ground)))), ground[:, 2])[0]
    assert np.degrees(np.arctan(np.hypot(*fitted[:2]))) == pytest.approx(slope_deg, abs=1.0)


@pytest.mark.parametrize(
    ("suite", "slope_deg", "problem"), [("suburb", 10.0, "ground of its own"), ("city", 31.0, "slope_deg is 31")]
)
def test_a_slope_that_cannot_be_is_refused(tmp_path: Path, suite: str, slope_deg: float, problem: str) -> None:
    with pytest.raises(SettingsError, match=problem):
        simulate(suite, tmp_path, slope_deg=slope_deg)
