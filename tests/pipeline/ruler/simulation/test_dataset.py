"""Simulated tiles on disk: read back by others, aligned with their truth, the same bytes again."""

import hashlib
import json
from pathlib import Path

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from labels import labels_of
from measured import printed_with_peak

from pipeline.errors import InputError, SettingsError
from pipeline.io import open_source
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.dataset import Output, ScenePaths, simulate
from pipeline.ruler.simulation.suites import SUITES
from pipeline.ruler.simulation.truth_files import CONDITIONS

SIZE = (110.0, 90.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> ScenePaths:
    return simulate("suburb", tmp_path_factory.mktemp("suburb"), 5, size_m=SIZE)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_tile_reads_back_with_counts_crs_and_units(made: ScenePaths) -> None:
    tile = laspy.read(made.laz)
    assert made.laz.name == "suburb.laz"
    assert (tile.header.version.major, tile.header.version.minor, tile.header.point_format.id) == (1, 4, 6)
    assert len(tile) == tile.header.point_count == made.points == sum(tile.header.number_of_points_by_return)
    assert tile.header.global_encoding.wkt
    assert tile.header.scales.tolist() == [0.001] * 3
    crs = tile.header.parse_crs()
    assert crs.is_compound
    assert [part.to_epsg() for part in crs.sub_crs_list] == [25832, 7837]
    assert tile.header.mins[0] >= 565_000 - 1
    assert tile.header.maxs[1] <= 5_934_090 + 1
    assert 7 < len(tile) / (SIZE[0] * SIZE[1]) < 9


def test_the_tile_is_read_by_our_own_reader(made: ScenePaths) -> None:
    info = open_source(str(made.laz)).info
    assert info.reference.horizontal_unit_m == info.reference.vertical_unit_m == 1.0
    assert info.point_count == made.points
    assert info.acquired_from is not None
    assert info.acquired_from.date().isoformat() == "2025-04-01"
    assert info.warnings == ()


def test_the_tile_is_raw_and_holds_classes_only_when_asked(made: ScenePaths, tmp_path: Path) -> None:
    assert set(np.asarray(laspy.read(made.laz).classification).tolist()) == {1}
    classified = simulate("suburb", tmp_path, 5, size_m=SIZE, output=Output(with_classes=True))
    assert np.array_equal(np.asarray(laspy.read(classified.laz).classification), labels_of(classified.truth)["class"])


def test_labels_stand_in_the_order_of_the_points(made: ScenePaths) -> None:
    xyz = laspy.read(made.laz).xyz
    labels = labels_of(made.truth)
    assert len(labels["class"]) == len(xyz)
    models = {model.building_id: model for model in read_models(made.truth).models}
    assert set(models) == set(labels["building_id"]) - {None}
    for name, model in models.items():
        mine = (labels["building_id"] == name) & (labels["face"] >= 0) & ~labels["mixed"]
        x, y, z = xyz[mine].T
        assert np.nanstd(z - model.top(x, y)) < 0.06, name
    assert (labels["building_id"].astype(bool) & (labels["face"] < 0)).any()  # walls
    scene = json.loads((made.truth / "scene.json").read_text())
    assert (scene["suite"], scene["seed"], scene["crs"]) == ("suburb", 5, "EPSG:25832+7837")
    assert scene["extent"] == [565_000.0, 5_934_000.0, 565_110.0, 5_934_090.0]


def test_the_truth_is_a_run_directory_of_the_exact_models(made: ScenePaths) -> None:
    scene = SUITES["suburb"].make(5, SIZE)
    models = read_models(made.truth).models
    assert made.buildings == len(models) == len(scene.buildings)
    for model, building in zip(models, sorted(scene.buildings, key=lambda b: b.building_id), strict=True):
        outline = shapely.transform(building.footprint, lambda xy: xy + np.array(scene.origin[:2]))
        assert shapely.hausdorff_distance(model.footprint, outline) < 0.002
        assert model.roof_type is building.roof_type
        assert len(model.surfaces) == len(building.planes)
    lines = (made.truth / "cityjson" / "tile=part00000" / "part-0.city.jsonl").read_text().splitlines()
    assert len(lines) == 1 + len(models)
    assert (made.truth / "meshes" / "part00000" / "part00000.obj").read_text().count("\no ") == len(models)


def test_the_conditions_tell_shape_slope_and_the_groups_of_the_faces(made: ScenePaths) -> None:
    scene = SUITES["suburb"].make(5, SIZE)
    table = pq.read_table(made.truth / "conditions.parquet")
    assert table.schema.equals(CONDITIONS)
    rows = table.to_pylist()
    assert [row["building_id"] for row in rows] == sorted(one.building_id for one in scene.buildings)
    buildings = {one.building_id: one for one in scene.buildings}
    for row in rows:
        building = buildings[row["building_id"]]
        assert (row["shape"], row["roof_type"], row["good"]) == (str(building.shape), str(building.roof_type), True)
        assert row["groups"] == list(range(len(building.planes)))
        assert row["pitch_deg"] == building.dimensions.pitch_deg
        ahead = scene.terrain.elevation(building.x + np.array([0.0, 1.0, 0.0]), building.y + np.array([0.0, 0.0, 1.0]))
        slope = np.degrees(np.arctan(np.hypot(ahead[1] - ahead[0], ahead[2] - ahead[0])))
        assert row["terrain_slope_deg"] == pytest.approx(float(slope), abs=0.1)


def test_the_manifest_lists_the_tile_with_its_points_and_bounds(made: ScenePaths) -> None:
    manifest = json.loads((made.truth / "scene.json").read_text())
    (tile,) = manifest["tiles"]
    header = laspy.open(made.laz).header
    assert (made.truth / tile["laz"]).resolve() == made.laz.resolve()
    assert made.truth / tile["labels"] == made.labels
    assert tile["points"] == manifest["points"] == header.point_count
    assert tile["bounds"] == pytest.approx([*header.mins[:2], *header.maxs[:2]], abs=1e-6)
    assert manifest["split"] is None


def test_the_same_call_gives_the_same_bytes_whatever_the_chunks(made: ScenePaths, tmp_path: Path) -> None:
    again = simulate("suburb", tmp_path / "again", 5, size_m=SIZE)
    small = simulate("suburb", tmp_path / "small", 5, size_m=SIZE, output=Output(chunk_points=7_000))
    assert digest(again.laz) == digest(small.laz) == digest(made.laz)
    assert digest(again.labels) == digest(made.labels)
    assert pq.ParquetFile(small.labels).num_row_groups > 3
    ours, theirs = labels_of(small.truth), labels_of(made.truth)
    assert all(np.array_equal(ours[name], theirs[name]) for name in ("building_id", "face"))


def test_density_and_noise_can_be_chosen(tmp_path: Path) -> None:
    found: list[int] = []
    output = Output(chunk_points=5_000, on_points=found.append)
    paths = simulate("gable", tmp_path, 2, density_per_m2=20.0, noise_m=0.0, output=output)
    assert paths.points / 1600 == pytest.approx(20.0, rel=0.25)
    assert found[-1] == paths.points
    assert found == sorted(found)
    assert len(found) > 2
    labels, models = labels_of(paths.truth), read_models(paths.truth).models
    roof = (labels["face"] >= 0) & ~labels["mixed"]
    x, y, z = laspy.read(paths.laz).xyz[roof].T
    assert np.nanmedian(np.abs(z - models[0].top(x, y))) < 0.001
    assert json.loads((paths.truth / "scene.json").read_text())["scanner"]["range_noise_m"] == 0.0


def test_buildings_cut_by_the_end_of_the_data_are_marked(tmp_path: Path) -> None:
    paths = simulate("town", tmp_path, 11, size_m=(120.0, 100.0), density_per_m2=1.0)
    edge = shapely.box(566_000, 5_935_000, 566_120, 5_935_100)
    models = read_models(paths.truth).models
    assert {m.touches_data_edge for m in models} == {True, False}
    for model in models:
        assert model.touches_data_edge != edge.contains(model.footprint)


def test_a_tile_without_a_crs_says_so(tmp_path: Path) -> None:
    paths = simulate("cube", tmp_path)
    header = laspy.open(paths.laz).header
    assert header.parse_crs() is None
    assert [vlr.record_id for vlr in header.vlrs if vlr.user_id == "LASF_Projection"] == []


def test_unknown_suites_and_impossible_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"suite is 'subrub': use one of suburb, town, cube, hofmann310, sweep, "):
        simulate("subrub", tmp_path)
    with pytest.raises(SettingsError, match=r"size is 5 m.*; seed is -1"):
        simulate("suburb", tmp_path, -1, size_m=(5.0, 100.0))
    with pytest.raises(SettingsError, match="pulse_density_per_m2 is 0"):
        simulate("suburb", tmp_path, density_per_m2=0.0)
    assert list(tmp_path.iterdir()) == []


def test_another_suite_in_the_same_folder_leaves_no_points_of_the_first(tmp_path: Path) -> None:
    simulate("cube", tmp_path)
    (tmp_path / "survey.laz").write_bytes(b"of another program")
    simulate("city", tmp_path, 7, size_m=(50.0, 50.0), density_per_m2=1.0)
    simulate("gable", tmp_path, density_per_m2=1.0)
    assert sorted(path.name for path in tmp_path.rglob("*.laz")) == ["gable.laz", "survey.laz"]


def test_a_truth_that_simulate_did_not_write_is_left_alone(tmp_path: Path) -> None:
    theirs = tmp_path / "truth" / "buildings" / "surveyed.gpkg"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("by hand")
    with pytest.raises(InputError, match=r"holds buildings that simulate did not write.*Give another --out"):
        simulate("cube", tmp_path)
    assert theirs.read_text() == "by hand"
    assert not (tmp_path / "cube.laz").exists()


def test_a_call_that_was_interrupted_can_be_made_again(tmp_path: Path) -> None:
    def stop(points: int) -> None:
        raise KeyboardInterrupt

    simulate("cube", tmp_path)
    with pytest.raises(KeyboardInterrupt):
        simulate("cube", tmp_path, output=Output(on_points=stop))
    assert not (tmp_path / "truth" / "scene.json").exists()
    (tmp_path / "truth" / "labels").mkdir()  # of tiles that were written before it stopped
    assert simulate("cube", tmp_path).points > 0
    assert not (tmp_path / "truth" / ".scene.json").exists()


def test_a_folder_that_cannot_be_one_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: cannot be written \(Not a directory\)"):
        simulate("cube", tmp_path / "file")
    with pytest.raises(SettingsError, match=r"out is s3://bucket/scene: simulate writes to a folder of this machine"):
        simulate("cube", "s3://bucket/scene")


@pytest.mark.slow
def test_ten_million_points_are_streamed_in_bounded_memory(tmp_path: Path) -> None:
    """Measured in a process of its own: the peak may not grow with the number of points."""
    program = (
        "import sys\n"
        "from pipeline.ruler.simulation.dataset import Output, simulate\n"
        "made = simulate('town', sys.argv[1], size_m=(float(sys.argv[2]),) * 2, output=Output(chunk_points=500_000))\n"
        "print(made.points)\n"
    )
    (few, small_kb), (many, large_kb) = (map(int, printed_with_peak(program, tmp_path, size)) for size in (350, 1100))
    assert few < 1_200_000
    assert many > 9_000_000
    assert large_kb - small_kb < 300_000
