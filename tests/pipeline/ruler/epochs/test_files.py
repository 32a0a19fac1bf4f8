"""What is written, what is refused: GeoParquet, GeoJSON, sums, reference systems, settings."""

import json
from pathlib import Path
from typing import Any

import geopandas
import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from command_line import app
from epochs_by_hand import EXTENT, UTM, house, write_epoch
from typer.testing import CliRunner

from pipeline.errors import CrsError, RunError, SettingsError
from pipeline.io import storage_at
from pipeline.io.crs_units import with_vertical_unit
from pipeline.ruler.epochs.change_records import CHANGES, COLUMNS, DOUBTS, INCOMPARABLE, RELATIONS, Change
from pipeline.ruler.epochs.diff import DiffRequest, diff
from pipeline.ruler.epochs.epoch_settings import DiffSettings, read_settings
from pipeline.runtime.manifest import RunStatus


@pytest.fixture
def pair(tmp_path: Path) -> tuple[str, str]:
    """Two runs: one house unchanged, one raised, one gone, one new."""
    old = [house("a1"), house("b1", 40.0), house("c1", 80.0)]
    new = [house("a2"), house("b2", 40.0, eave=8.0), house("d2", 0.0, 60.0)]
    return str(write_epoch(tmp_path / "old", old)), str(write_epoch(tmp_path / "new", new))


def run(pair: tuple[str, str], out: Path, **how: Any) -> dict[str, Any]:
    made = diff(DiffRequest(old=pair[0], new=pair[1], out=str(out), **how))
    document: dict[str, Any] = json.loads((out / "changes.json").read_text())
    assert document == made.as_dict()
    return document


def test_the_table_is_valid_geoparquet_that_others_read(pair: tuple[str, str], tmp_path: Path) -> None:
    run(pair, tmp_path / "out")
    path = tmp_path / "out" / "changes.parquet"
    judged = geoparquet_validator.check_bytes("changes.parquet", path.read_bytes())
    assert geoparquet_validator.failed(judged) == []
    table = geopandas.read_parquet(path)
    assert table.crs.name == "ETRS89 / UTM zone 32N + DHHN2016 height"
    assert set(table["change"]) == {"unchanged", "raised", "gone", "new"}
    geo = json.loads(pq.read_schema(path).metadata[b"geo"])["columns"]["geometry"]
    assert geo["bbox"] == pytest.approx(table.total_bounds.tolist())
    assert geo["geometry_types"] == ["Polygon"]
    assert [name for name, _, _ in COLUMNS] == [name for name in pq.read_schema(path).names if name != "bbox"]


def test_the_geometry_is_that_of_the_newer_epoch_or_of_the_older_where_it_is_gone(
    pair: tuple[str, str], tmp_path: Path
) -> None:
    run(pair, tmp_path / "out")
    rows = {row["change"]: row for row in pq.read_table(tmp_path / "out" / "changes.parquet").to_pylist()}
    for change, which, name in (("raised", 1, "b2"), ("gone", 0, "c1"), ("new", 1, "d2")):
        table = pq.read_table(f"{pair[which]}/buildings", columns=["building_id", "geometry"])
        held = dict(zip(table["building_id"].to_pylist(), table["geometry"].to_pylist(), strict=True))
        assert rows[change]["geometry"] == held[name]


def test_geojson_is_in_degrees_and_holds_what_was_asked_for(pair: tuple[str, str], tmp_path: Path) -> None:
    for how, count in (("changed", 3), ("all", 4)):
        run(pair, tmp_path / how, geojson=how)
        document = json.loads((tmp_path / how / "changes.geojson").read_text())
        assert len(document["features"]) == count
        identities = [feature["id"] for feature in document["features"]]
        assert len(set(identities)) == count
        table = geopandas.read_parquet(tmp_path / how / "changes.parquet").set_index("change_id").to_crs("OGC:CRS84")
        for feature in document["features"]:
            shape = shapely.from_geojson(json.dumps(feature["geometry"]))
            assert shapely.hausdorff_distance(shape, table.geometry[feature["id"]]) < 1e-7
            assert shapely.is_ccw(shapely.get_exterior_ring(shape))
            assert feature["properties"]["change"] == table["change"][feature["id"]]
    run(pair, tmp_path / "all", geojson="none")
    assert not (tmp_path / "all" / "changes.geojson").exists()


def test_without_a_crs_there_is_a_warning_and_no_geojson(tmp_path: Path) -> None:
    runs = [write_epoch(tmp_path / name, [house("a1")], crs=None) for name in ("old", "new")]
    out = tmp_path / "out"
    out.mkdir()
    (out / "changes.geojson").write_text("of an earlier comparison")
    found = run((str(runs[0]), str(runs[1])), out)
    assert not (out / "changes.geojson").exists()
    assert any("RFC 7946" in warning for warning in found["warnings"])
    assert any("unknown" in warning for warning in found["warnings"])
    assert geopandas.read_parquet(out / "changes.parquet").crs is None


def test_sums_are_those_of_the_rows(pair: tuple[str, str], tmp_path: Path) -> None:
    found = run(pair, tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "changes.parquet").to_pylist()
    for change in Change:
        own = [row for row in rows if row["change"] == change.value]
        sums = found["changes"][change.value]
        assert sums["rows"] == len(own)
        assert sums["old_buildings"] == sum(len(row["old_ids"]) for row in own)
        for name in ("added_m2", "gained_m3", "lost_m3"):
            assert sums[name] == pytest.approx(sum(row[name] or 0.0 for row in own), abs=0.06)
    assert found["level"] == {"median_m": 0.0, "spread_m": 0.0, "unchanged_roofs": 1}
    assert (found["old"]["buildings"], found["new"]["buildings"]) == (3, 3)


def test_the_same_comparison_writes_the_same_bytes(pair: tuple[str, str], tmp_path: Path) -> None:
    for name in "ab":
        run(pair, tmp_path / name)
    for file in ("changes.parquet", "changes.geojson", "changes.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_runs_without_buildings_give_an_empty_table(tmp_path: Path) -> None:
    runs = [str(write_epoch(tmp_path / name, [])) for name in ("old", "new")]
    found = run((runs[0], runs[1]), tmp_path / "out")
    assert sum(sums["rows"] for sums in found["changes"].values()) == 0
    assert pq.read_table(tmp_path / "out" / "changes.parquet").num_rows == 0
    assert json.loads((tmp_path / "out" / "changes.geojson").read_text())["features"] == []
    assert (
        geoparquet_validator.failed(
            geoparquet_validator.check_bytes("x.parquet", (tmp_path / "out" / "changes.parquet").read_bytes())
        )
        == []
    )


def test_surveys_that_do_not_agree_in_height_give_a_warning_with_the_shift(tmp_path: Path) -> None:
    runs = [
        write_epoch(tmp_path / name, [house(f"h{k}", 40.0 * k, eave=eave) for k in range(5)])
        for name, eave in (("old", 5.0), ("new", 5.4))
    ]
    found = run((str(runs[0]), str(runs[1])), tmp_path / "out")
    assert found["level"]["median_m"] == pytest.approx(0.4, abs=2e-3)
    assert any("vertical_shift_m to 0.400" in warning for warning in found["warnings"])


def test_other_settings_methods_and_versions_give_warnings(tmp_path: Path) -> None:
    old = write_epoch(tmp_path / "old", [house("a1")], settings={"roof": {"x": 1.0}}, settings_hash="cd")
    new = write_epoch(tmp_path / "new", [house("a2")], settings={"roof": {"x": 2.0}}, engine_version="9")
    found = run((str(old), str(new)), tmp_path / "out")
    assert "the settings differ: [roof] x 1.0 / 2.0" in found["warnings"]
    assert "the versions differ: OLD is of 0, NEW of 9" in found["warnings"]
    assert any(warning.startswith("other versions and settings may draw outlines") for warning in found["warnings"])
    other = write_epoch(tmp_path / "other", [house("a2")], method="kmeans", request={"footprints": "f.gpkg"})
    found = run((str(old), str(other)), tmp_path / "out2")
    assert any("methods differ: OLD is of arrangement, NEW of kmeans" in warning for warning in found["warnings"])
    assert any("NEW was modelled in given footprints" in warning for warning in found["warnings"])


def test_runs_that_do_not_record_where_their_data_lie_are_compared_with_a_warning(tmp_path: Path) -> None:
    old = write_epoch(tmp_path / "old", [house("a1")], extent=None)
    new = write_epoch(tmp_path / "new", [house("a2"), house("b2", 3000.0)])
    found = run((str(old), str(new)), tmp_path / "out")
    assert found["changes"]["new"]["rows"] == 1
    assert any(warning.startswith("OLD: run.json does not record where its data lie") for warning in found["warnings"])


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:25833+7837", "its CRS is 'ETRS89 / UTM zone 33N"),
        ("EPSG:25832+5773", "its elevations are of"),
        ("EPSG:25832+8228", "its vertical unit is 0.3048 m, that of"),
        ("EPSG:2263", "its horizontal unit is 0.304801 m"),
    ],
)
def test_runs_of_other_reference_systems_or_units_are_refused(tmp_path: Path, crs: str, words: str) -> None:
    old = write_epoch(tmp_path / "old", [house("a1")], crs=UTM)
    new = write_epoch(tmp_path / "new", [house("a2")], crs=crs)
    with pytest.raises(CrsError, match=words):
        diff(DiffRequest(old=str(old), new=str(new), out=str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


def test_a_vertical_part_that_states_a_unit_alone_is_no_other_datum(tmp_path: Path) -> None:
    feet = with_vertical_unit(pyproj.CRS("EPSG:25832"), 0.3048)
    old = write_epoch(tmp_path / "old", [house("a1")], crs="EPSG:25832+8228")
    new = write_epoch(tmp_path / "new", [house("a2")], crs=feet.to_wkt())
    found = run((str(old), str(new)), tmp_path / "out")
    assert "the vertical reference system of NEW is unknown: taken as that of the other" in found["warnings"]


def test_what_is_no_ended_run_is_refused_and_the_runs_themselves_are_no_place_for_results(
    pair: tuple[str, str], tmp_path: Path
) -> None:
    under_way = write_epoch(tmp_path / "running", [house("a1")], status=RunStatus.RUNNING)
    for old, out, words in (
        (str(under_way), tmp_path / "out", "is running: compare runs that ended"),
        (str(tmp_path), tmp_path / "out", "does not exist"),
        (pair[0], Path(pair[1]), "is one of the runs that are compared"),
    ):
        with pytest.raises(RunError, match=words):
            diff(DiffRequest(old=old, new=pair[1], out=str(out)))


def test_a_damaged_table_is_named_and_nothing_half_is_left(pair: tuple[str, str], tmp_path: Path) -> None:
    (planes,) = Path(pair[1]).glob("planes/*/*.parquet")
    planes.write_bytes(planes.read_bytes()[:-40])
    with pytest.raises(RunError, match=r"planes.*cannot be read as Parquet"):
        run(pair, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == []


def test_settings_come_from_a_file_and_from_options_and_all_faults_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "diff.toml"
    path.write_text("[diff]\nmin_height_change_m = 1\nedge_m = 5.0\n")
    assert read_settings(str(path), {"edge_m": 7.0, "min_width_m": None}) == DiffSettings(
        min_height_change_m=1.0, edge_m=7.0
    )
    path.write_text('[diff]\nmin_height_change_m = -1.0\ncolour = "red"\n')
    with pytest.raises(SettingsError) as caught:
        read_settings(str(path), {"min_iou": 4.0})
    assert len(caught.value.faults) == 3
    path.write_text("[settings]\n")
    with pytest.raises(SettingsError, match=r"has no \[diff\] table; it has settings"):
        read_settings(str(path), {})


def test_every_word_of_a_closed_list_has_a_meaning() -> None:
    for table in (CHANGES, RELATIONS, INCOMPARABLE, DOUBTS):
        kind = type(next(iter(table)))
        assert list(table) == list(kind)
        assert all(table.values())
    assert all(meaning for _, _, meaning in COLUMNS)
    assert np.isfinite(EXTENT).all()


@pytest.mark.slow
def test_runs_may_lie_in_an_object_store_and_the_results_too(
    pair: tuple[str, str], tmp_path: Path, bucket: str
) -> None:
    for place in pair:
        for path in Path(place).rglob("*"):
            if path.is_file():
                key = path.relative_to(place).as_posix()
                storage_at(f"{bucket}/{Path(place).name}").put(key, path.read_bytes())
    urls = [f"{bucket}/{Path(place).name}" for place in pair]
    here = CliRunner().invoke(app, ["batch", "diff", *pair, "--out", str(tmp_path / "here"), "--json"])
    there = CliRunner().invoke(app, ["batch", "diff", *urls, "--out", f"{bucket}/found", "--json"])
    assert (here.exit_code, there.exit_code) == (0, 0), there.stderr
    found = json.loads(there.stdout)
    assert found["changes"] == json.loads(here.stdout)["changes"]
    assert found["old"]["run"] == urls[0]
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert found["written"] == [f"{bucket}/found/{Path(place).name}" for place in json.loads(here.stdout)["written"]]
    assert sorted(storage_at(f"{bucket}/found").keys()) == names
    got = pq.read_table(pa.BufferReader(storage_at(f"{bucket}/found").get("changes.parquet")))
    assert got.equals(pq.read_table(tmp_path / "here" / "changes.parquet"))


def test_what_fails_puts_nothing_into_a_store(pair: tuple[str, str], bucket: str) -> None:
    words = ["batch", "diff", pair[0], f"{bucket}/nowhere", "--out", f"{bucket}/found"]
    assert CliRunner().invoke(app, words).exit_code == 4
    for path in Path(pair[0]).rglob("*.*"):
        storage_at(f"{bucket}/run").put(path.relative_to(pair[0]).as_posix(), path.read_bytes())
    words = ["batch", "diff", pair[0], f"{bucket}/run", "--out", f"{bucket}/run/"]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 4
    assert "is one of the runs that are compared" in refused.stderr
    assert storage_at(f"{bucket}/found").keys() == []
