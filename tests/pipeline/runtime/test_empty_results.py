"""Empty results and half-understood inputs of a run: an error, or a warning before all figures."""

import json
import struct
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pytest
import shapely
from las_files import write_las
from run_tables import rows, rows_by_id, write_footprints
from shapely import Polygon

from pipeline.errors import CrsError, EmptyInputError, SettingsError, UnreadableInputError
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.inspection import inspect
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.stages.ingested import without_roofs


@pytest.fixture(scope="module")
def houses(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Polygon]:
    """Outlines of the suburb's houses, by a run without footprints, from south-west to north-east."""
    out = str(tmp_path_factory.mktemp("found") / "run")
    run(RunRequest(inputs=(str(suburb),), out=out, resources=SERIAL))
    return sorted((shapely.from_wkb(row["geometry"]).envelope for row in rows(out)), key=lambda outline: outline.bounds)


def of_class(suburb: Path, path: Path, *codes: int) -> Path:
    """The suburb with all points in some classes, one after the other."""
    las = laspy.read(suburb)
    las.classification = np.resize(np.array(codes, np.uint8), len(las.points))
    las.write(path)
    return path


@pytest.mark.parametrize(("codes", "named"), [((2,), "class 2 (ground)"), ((2, 5, 3), "classes 2, 3 and 5")])
def test_points_that_can_be_no_roof_by_their_classes_are_named_before_all_other_warnings(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path, codes: tuple[int, ...], named: str
) -> None:
    path = of_class(suburb, tmp_path / "a.laz", *codes)
    given = write_footprints(tmp_path / "a.geojson", {"A": houses[0]})
    for footprints in (None, str(given)):
        events: list[Any] = []
        summary = reconstruct(path, footprints=footprints, on_event=events.append)
        assert f"points are of {named}, so none can be a roof: give --classes ignore" in summary.headline
        assert summary.warnings[0] == summary.headline == read_manifest(summary.run_dir).headline
        assert [event.message for event in events if event.kind == "warning"].count(summary.headline) == 1
    assert inspect(path, None, lambda _done, _total: None).warnings[0] == summary.headline
    ignored = reconstruct(path, settings={"classes": "ignore"})
    assert (ignored.headline, ignored.statuses.get("ok", 0) > 0) == ("", True)


def test_one_point_of_an_undecided_class_or_of_class_6_is_no_reason_for_the_warning() -> None:
    for code in (0, 1, 6, 12, 67):
        assert without_roofs({2: 10_000, code: 1}, trust=True) == ""
    assert without_roofs({}, trust=True) == without_roofs({5: 100}, trust=True) == ""


def test_a_run_that_finds_no_building_says_so_first(reconstruct: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    flat = np.column_stack(
        (rng.uniform(400_000, 400_040, 8_000), rng.uniform(5_000_000, 5_000_040, 8_000), rng.normal(100, 0.01, 8_000))
    )
    summary = reconstruct(write_las(tmp_path / "a.laz", flat, crs="EPSG:25832"))
    assert summary.headline == "no building was found in 8000 points"
    assert summary.warnings[0] == summary.headline


def test_scattered_points_that_are_all_outliers_are_named(reconstruct: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    few = np.column_stack((rng.uniform(400_000, 403_000, (60, 2)), rng.uniform(100, 300, 60)))
    summary = reconstruct(write_las(tmp_path / "a.laz", few, crs="EPSG:32632"), allow_outside_area_of_use=True)
    assert "no building was found in 60 points, 60 of which are outliers" in summary.headline


def test_overrides_of_which_none_takes_effect_are_named_first(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    x, y = houses[0].centroid.coords[0]
    far, near, farther = (f'[[building]]\npoint = [{x + d}, {y}]\naction = "reject"\n' for d in (5_000.0, 0.0, 6_000.0))
    for text, headline in (
        (far + farther, "overrides: none of 2 took effect; overrides.json says why"),
        (far + near, ""),
    ):
        (tmp_path / "o.toml").write_text(text)
        summary = reconstruct(suburb, overrides=str(tmp_path / "o.toml"))
        assert summary.headline.startswith(headline)
        assert bool(summary.headline) == bool(headline)
    (tmp_path / "o.toml").write_text(far)
    rerun(RerunRequest(run_dir=summary.run_dir, overrides=str(tmp_path / "o.toml"), resources=SERIAL))
    assert (
        read_manifest(summary.run_dir).headline == "overrides: none of 1 took effect; overrides.json says why of each"
    )
    (tmp_path / "o.toml").write_text(near)
    rerun(RerunRequest(run_dir=summary.run_dir, overrides=str(tmp_path / "o.toml"), resources=SERIAL))
    manifest = read_manifest(summary.run_dir)
    assert manifest.headline == ""
    assert not [warning for warning in manifest.warnings if "took effect" in warning]


def test_a_run_with_buildings_has_no_such_line(suburb: Path, reconstruct: Any) -> None:
    summary = reconstruct(suburb)
    assert summary.headline == read_manifest(summary.run_dir).headline == ""


def test_a_tile_of_which_no_point_would_be_used_is_inspected_with_a_warning(suburb: Path, tmp_path: Path) -> None:
    found = inspect(of_class(suburb, tmp_path / "a.laz", 7), None, lambda _done, _total: None)
    assert found.warnings[0].startswith("a run would use none of its points (")
    assert (dict(found.rows())["elevation"], dict(found.rows())["extent"]) == ("unknown", "unknown")


def test_the_extent_of_a_tile_is_that_of_its_points_whatever_its_header_says(suburb: Path, tmp_path: Path) -> None:
    las = laspy.read(suburb)
    wanted = f"{np.ptp(las.x):.1f} x {np.ptp(las.y):.1f} m"
    raw = bytearray(suburb.read_bytes())
    for place, value in ((179, las.x.max() + 900.0), (187, las.x.min() - 900.0)):
        struct.pack_into("<d", raw, place, value)
    (tmp_path / "wide.laz").write_bytes(raw)
    for path in (suburb, tmp_path / "wide.laz"):
        assert dict(inspect(path, None, lambda _done, _total: None).rows())["extent"] == wanted


def test_footprints_of_which_none_lies_on_the_data_end_the_run_and_leave_nothing(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    far = write_footprints(tmp_path / "far.geojson", {"A": shapely.transform(houses[0], lambda xy: xy + 5_000.0)})
    with pytest.raises(EmptyInputError, match="none of its footprints lies on the data: they lie at x"):
        reconstruct(suburb, footprints=str(far), out=str(out))
    degrees = tmp_path / "degrees.geojson"
    document = json.loads(write_footprints(tmp_path / "a.geojson", {"A": houses[0]}).read_text())
    degrees.write_text(json.dumps({name: value for name, value in document.items() if name != "crs"}))
    with pytest.raises(CrsError, match=r"in degrees, which x .* cannot be"):
        reconstruct(suburb, footprints=str(degrees), out=str(out))
    swapped = geopandas.GeoSeries([houses[0]], crs="EPSG:25832").to_crs("EPSG:4326")
    swapped = swapped.map(lambda polygon: shapely.transform(polygon, lambda xy: xy[:, ::-1]))
    geopandas.GeoDataFrame({"id": ["A"]}, geometry=swapped).to_file(tmp_path / "swapped.geojson")
    with pytest.raises(EmptyInputError, match="longitude before latitude: the footprints have them swapped"):
        reconstruct(suburb, footprints=str(tmp_path / "swapped.geojson"), out=str(out))
    assert not out.exists()


def test_areas_that_hold_no_point_end_the_run(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    far = write_footprints(tmp_path / "far.geojson", {"A": shapely.transform(houses[0], lambda xy: xy + 5_000.0)})
    with pytest.raises(EmptyInputError, match=r"no usable point is left \(\d+ outside\)"):
        reconstruct(suburb, aoi=str(far))
    with pytest.raises(EmptyInputError, match=r"no usable point is left \(\d+ outside\)"):
        reconstruct(suburb, bbox=(0.0, 0.0, 10.0, 10.0))


def test_a_house_under_a_larger_footprint_fails_with_the_name_of_that_one(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    larger = houses[0].buffer(1.0, join_style="mitre")
    given = write_footprints(tmp_path / "a.geojson", {"house": houses[0], "larger": larger, "other": houses[1]})
    summary = reconstruct(suburb, footprints=str(given))
    found = {row["source_id"]: row for row in rows(summary.run_dir)}
    assert (found["house"]["status"], found["house"]["reason"]) == ("failed", "too_few_points")
    assert found["house"]["reason_detail"].endswith("footprint larger covers 100% of it, and has the points there")
    covered = "footprint house: footprint larger covers 100% of it, and has the points there: used without them"
    assert covered in summary.warnings
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    assert [(issue["source_id"], issue["problem"]) for issue in report["issues"]] == [("house", "overlap")]
    # neighbours that overlap by a hand's breadth are nothing to speak of
    beside = shapely.box(
        houses[0].bounds[2] - 0.02, houses[0].bounds[1], houses[0].bounds[2] + 4.0, houses[0].bounds[3]
    )
    plain = reconstruct(suburb, footprints=str(write_footprints(tmp_path / "b.geojson", {"a": houses[0], "b": beside})))
    assert not [warning for warning in plain.warnings if "covers" in warning]


def test_the_name_of_the_larger_one_does_not_depend_on_tiles_or_order(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    outlines = {"house": houses[0], "larger": houses[0].buffer(1.0, join_style="mitre"), "other": houses[1]}
    one = write_footprints(tmp_path / "a.geojson", outlines)
    other = write_footprints(tmp_path / "b.geojson", dict(reversed(outlines.items())))
    digests = {reconstruct(suburb, footprints=str(one)).digest}
    digests.add(reconstruct(suburb, footprints=str(other), settings={"tile_size_m": 30.0}).digest)
    assert len(digests) == 1


def write_repeated(path: Path, outlines: list[tuple[str, Polygon]]) -> str:
    names, polygons = zip(*outlines, strict=True)
    geopandas.GeoDataFrame({"id": names}, geometry=list(polygons), crs="EPSG:25832").to_file(path)
    return str(path)


def test_repeated_ids_stay_as_given_and_an_override_by_one_is_not_guessed(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    x, y = houses[0].bounds[2] + 0.5, houses[0].bounds[3] + 0.5
    bare = shapely.box(x, y, x + 0.01, y + 0.01)  # holds no point
    yard = shapely.box(x + 1.0, y, x + 3.0, y + 2.0)
    outlines = [("A", houses[0]), ("B", houses[1]), ("B", bare), ("B", bare), ("C", houses[2]), ("D", yard)]
    overrides = tmp_path / "overrides.toml"
    overrides.write_text('[[building]]\nsource_id = "B"\naction = "reject"\n')
    given = write_repeated(tmp_path / "a.gpkg", outlines)
    summary = reconstruct(suburb, footprints=given, overrides=str(overrides))
    found = rows_by_id(summary.run_dir)
    assert sorted(row["source_id"] for row in found.values()) == ["A", "B", "B", "B", "C", "D"]
    assert any(warning.startswith("column 'id' holds 'B' 3 times") for warning in summary.warnings)
    assert any("3 footprints have this source_id: name the building by its building_id" in w for w in summary.warnings)


def test_an_outline_of_an_override_by_a_repeated_id_is_refused(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    write_repeated(
        tmp_path / "a.gpkg", [("A", houses[0]), ("A", houses[1]), ("B", houses[2]), ("C", houses[2].buffer(1))]
    )
    (tmp_path / "o.toml").write_text('[[building]]\nsource_id = "B"\nfootprint = { file = "a.gpkg", id = "A" }\n')
    with pytest.raises(SettingsError, match="2 of its polygons have the id 'A'"):
        reconstruct(suburb, footprints=str(tmp_path / "a.gpkg"), overrides=str(tmp_path / "o.toml"))


def test_the_layer_of_footprints_is_chosen_stored_and_used_again(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = tmp_path / "a.gpkg"
    for layer, outline in (("houses", houses[0]), ("sheds", houses[1])):
        geopandas.GeoDataFrame({"id": [layer]}, geometry=[outline], crs="EPSG:25832").to_file(path, layer=layer)
    with pytest.raises(UnreadableInputError, match="Name one of its layers with --layer: houses, sheds"):
        reconstruct(suburb, footprints=str(path))
    with pytest.raises(SettingsError, match="--layer sheds names a layer of footprints, and none are given"):
        reconstruct(suburb, footprints_layer="sheds")
    summary = reconstruct(suburb, footprints=str(path), footprints_layer="sheds")
    (row,) = rows(summary.run_dir)
    assert row["source_id"] == "sheds"
    assert read_manifest(summary.run_dir).request["footprints_layer"] == "sheds"
    again = rerun(RerunRequest(run_dir=summary.run_dir, only=(row["building_id"],), resources=SERIAL))
    assert again.digest == summary.digest


def test_a_run_that_was_written_before_there_were_layers_and_first_lines_still_reads(
    suburb: Path, reconstruct: Any
) -> None:
    summary = reconstruct(suburb)
    path = Path(summary.run_dir) / "run.json"
    document = json.loads(path.read_text())
    del document["headline"], document["request"]["footprints_layer"]
    path.write_text(json.dumps(document))
    assert read_manifest(summary.run_dir).headline == ""
    name = rows(summary.run_dir)[0]["building_id"]
    assert rerun(RerunRequest(run_dir=summary.run_dir, only=(name,), resources=SERIAL)).digest == summary.digest
