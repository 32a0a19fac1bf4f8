"""Outputs of a finished run: merged over the tiles, judged by other programs, the same twice."""

import hashlib
import json
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import cityjson_rules
import duckdb
import finished_runs as runs
import geopandas
import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import small_buildings as small
from measured import printed_with_peak

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.runtime.manifest import RunStatus
from service.errors import NoSuchOutputError
from service.outputs import OUTPUTS, merged_table, output_file, read_catalogue, write_outputs
from service.outputs.assemble import published_tiles
from service.outputs.kinds import ON_REQUEST

CRSES = [7415, 2225, None]
TABLES = ("buildings", "planes", "rejected")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four tiles."""
    folder = tmp_path_factory.mktemp("run") / "run"
    return runs.write_run(folder, failed_tile="x852_y4470", tiles_without_points=("x850_y4470",))


@pytest.fixture(scope="module")
def out_dir(run_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its outputs."""
    out = tmp_path_factory.mktemp("out")
    write_outputs(run_dir, out)
    return out


def parsed_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a file with one a line."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- the catalogue ---------------------------------------------------------------------------------------------------


def test_the_catalogue_lists_every_output_with_its_size_and_sha256(out_dir: Path) -> None:
    stored = read_catalogue(out_dir).outputs
    assert list(stored) == [name for name in OUTPUTS if name not in ON_REQUEST]
    for name, entry in stored.items():
        data = output_file(out_dir, name).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (entry.size_bytes, entry.sha256)


def test_doing_it_again_gives_the_same_bytes_and_leaves_nothing_beside(
    run_dir: Path, out_dir: Path, tmp_path: Path
) -> None:
    write_outputs(run_dir, tmp_path)
    first = contents(tmp_path)
    assert first == contents(out_dir)
    write_outputs(run_dir, tmp_path)
    assert contents(tmp_path) == first
    made = [kind.filename for name, kind in OUTPUTS.items() if name not in ON_REQUEST]
    assert set(first) == {"outputs.json", "rows.sqlite", *made}


def test_only_the_wanted_outputs_are_offered(run_dir: Path, tmp_path: Path) -> None:
    write_outputs(run_dir, tmp_path, ("report", "planes"))
    assert list(read_catalogue(tmp_path).outputs) == ["planes", "report"]
    with pytest.raises(NoSuchOutputError, match=r"left out geojson.*it has: planes, report"):
        output_file(tmp_path, "geojson")
    with pytest.raises(NoSuchOutputError, match=r"no output 'everything'.*planes, report"):
        output_file(tmp_path, "everything")
    assert {"meshes.zip", "buildings.parquet", "buildings.city.jsonl"}.isdisjoint(contents(tmp_path))


def test_an_unknown_output_is_refused_before_anything_is_written(run_dir: Path, tmp_path: Path) -> None:
    with pytest.raises(NoSuchOutputError, match="no output colours: use buildings, planes"):
        write_outputs(run_dir, tmp_path / "out", ("colours",))
    assert not (tmp_path / "out").exists()


def test_work_that_is_stopped_leaves_no_file(run_dir: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_outputs(run_dir, tmp_path, None, stop)
    assert contents(tmp_path) == {}
    with pytest.raises(NoSuchOutputError, match="no longer in the state folder"):
        read_catalogue(tmp_path)


def test_progress_counts_the_tiles_of_each_file(run_dir: Path, tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    write_outputs(run_dir, tmp_path, None, lambda done, total: steps.append((done, total)))
    assert steps == [(done, 24) for done in range(25)]


@pytest.mark.parametrize("status", [RunStatus.RUNNING, RunStatus.FAILED])
def test_a_run_that_did_not_end_is_refused(tmp_path: Path, status: RunStatus) -> None:
    run_dir = runs.write_run(tmp_path / "run", status=status)
    with pytest.raises(RunError, match=f"is {status.value}: outputs need a finished run"):
        write_outputs(run_dir, tmp_path / "out")


def test_a_damaged_tile_is_named_by_its_file(tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "run")
    (run_dir / "planes/tile=x850_y4471/part-0.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(RunError, match=r"planes/tile=x850_y4471/part-0\.parquet cannot be read"):
        write_outputs(run_dir, tmp_path / "out")


def test_what_an_unfinished_tile_left_is_in_no_output(tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "run")
    state = {"tile": "x851_y4470", "state": "failed", "error": "OSError: disk full", "files": {}}
    (run_dir / "state/x851_y4470.json").write_text(json.dumps(state))
    write_outputs(run_dir, tmp_path / "out")
    lost = runs.ident("two_parts")
    assert lost in {entry.stem for entry in (run_dir / "meshes").rglob("*.obj")}
    for name in ("geojson", "cityjson", "report"):
        assert lost not in output_file(tmp_path / "out", name).read_text()
    assert lost not in pq.read_table(tmp_path / "out/buildings.parquet")["building_id"].to_pylist()
    assert all(lost not in name for name in zipfile.ZipFile(tmp_path / "out/meshes.zip").namelist())
    report = json.loads(output_file(tmp_path / "out", "report").read_text())["tiles"]
    assert report == {
        "planned": 4,
        "failed": [{"tile": "x851_y4470", "reason": "OSError: disk full"}],
        "without_points": [],
        "without_terrain": [],
    }


def test_tiles_come_along_a_curve_that_keeps_neighbours_together(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    for x in range(-2, 2):
        for y in range(-2, 2):
            state = {"tile": f"x{x}_y{y}", "state": "done", "error": "", "files": {"a": "b"}}
            (tmp_path / f"state/x{x}_y{y}.json").write_text(json.dumps(state))
    keys = [tile.key for tile in published_tiles(tmp_path)[0]]
    assert len(keys) == 16
    assert set(keys[:4]) == {"x-2_y-2", "x-1_y-2", "x-2_y-1", "x-1_y-1"}
    assert set(keys[-4:]) == {"x0_y0", "x1_y0", "x0_y1", "x1_y1"}


# --- tables ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("epsg", CRSES)
def test_the_merged_tables_are_valid_geoparquet(tmp_path: Path, epsg: int | None) -> None:
    write_outputs(runs.write_run(tmp_path / "run", epsg=epsg), tmp_path / "out")
    for name in TABLES:
        data = output_file(tmp_path / "out", name).read_bytes()
        judged = geoparquet_validator.check_bytes(f"{name}.parquet", data)
        passed = {outcome["id"] for outcome in judged["outcomes"] if outcome["status"] == "pass"}
        assert any("/covering/" in rule for rule in passed)
        assert geoparquet_validator.failed(judged) == []


@pytest.mark.parametrize("name", TABLES)
def test_a_merged_table_holds_every_row_of_every_tile_and_no_other(run_dir: Path, out_dir: Path, name: str) -> None:
    merged = pq.read_table(output_file(out_dir, name))
    tiles = read_table(str(run_dir), name)
    key = tiles.schema.names[0]
    order = [(key, "ascending")] + ([("plane_id", "ascending")] if name == "planes" else [])
    assert merged.sort_by(order).select(tiles.schema.names).cast(tiles.schema).equals(tiles.sort_by(order))
    assert merged.schema.names == tiles.schema.names
    assert merged.schema.field("tile") == pa.field("tile", pa.string(), nullable=False)


def test_row_groups_have_one_size_wherever_the_tiles_end(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merged_table, "ROWS_PER_GROUP", 2)
    write_outputs(run_dir, tmp_path, ("planes", "rejected"))
    for name, rows in (("planes", 10), ("rejected", 4)):
        file = pq.ParquetFile(tmp_path / f"{name}.parquet")
        assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [2] * (rows // 2)


def test_geopandas_and_duckdb_read_the_buildings_with_crs_and_window(out_dir: Path) -> None:
    path = output_file(out_dir, "buildings")
    frame = geopandas.read_parquet(path)
    assert frame.crs.to_epsg() == 7415
    assert len(frame) == 6
    assert frame.geometry.isna().sum() == 1
    assert frame.set_geometry("solid").crs.to_epsg() == 7415
    assert frame["solid"].isna().tolist() == frame["lod"].isna().tolist()
    window = geopandas.read_parquet(path, bbox=(84_990.0, 446_990.0, 85_011.0, 447_011.0))
    assert list(window.building_id) == [runs.ident("gable")]
    with duckdb.connect() as database:
        found = database.execute(
            "SELECT tile, count(*) FROM read_parquet(?) WHERE bbox.xmin > 85_100 OR bbox.ymin > 447_100"
            " GROUP BY tile ORDER BY tile",
            [str(path)],
        ).fetchall()
    assert found == [("x850_y4471", 2), ("x851_y4470", 1)]


@pytest.mark.parametrize("tiles", [{}, {"x1_y1": []}])
def test_a_run_that_found_nothing_has_whole_outputs_without_rows(tmp_path: Path, tiles: dict[str, list[Any]]) -> None:
    write_outputs(runs.write_run(tmp_path / "run", tiles), tmp_path / "out")
    for name in TABLES:
        table = pq.read_table(output_file(tmp_path / "out", name))
        assert table.num_rows == (len(tiles) if name == "rejected" else 0)
    assert geopandas.read_parquet(tmp_path / "out/buildings.parquet").crs.to_epsg() == 7415
    assert cityjson_rules.faults(parsed_lines(output_file(tmp_path / "out", "cityjson"))) == []
    assert json.loads(output_file(tmp_path / "out", "geojson").read_text())["features"] == []
    assert zipfile.ZipFile(output_file(tmp_path / "out", "meshes")).namelist() == []


def test_tiles_of_two_runs_in_one_directory_are_refused(tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "run")
    other = runs.write_run(tmp_path / "other", epsg=25832)
    name = "rejected/tile=x851_y4470/part-0.parquet"
    (run_dir / name).write_bytes((other / name).read_bytes())
    with pytest.raises(RunError, match="more than one CRS"):
        write_outputs(run_dir, tmp_path / "out")


# --- CityJSON --------------------------------------------------------------------------------------------------------


def corners(lines: list[dict[str, Any]]) -> dict[str, list[list[float]]]:
    """Every building's vertices in the CRS, to the millimetre."""
    transform = lines[0]["transform"]
    return {
        line["id"]: [
            [round(v * s + t, 4) for v, s, t in zip(xyz, transform["scale"], transform["translate"], strict=True)]
            for xyz in line["vertices"]
        ]
        for line in lines[1:]
    }


@pytest.mark.parametrize("epsg", CRSES)
def test_the_city_objects_of_all_tiles_stand_where_they_stood_under_one_header(
    tmp_path: Path, epsg: int | None
) -> None:
    run_dir = runs.write_run(tmp_path / "run", epsg=epsg)
    write_outputs(run_dir, tmp_path / "out", ("cityjson",))
    lines = parsed_lines(output_file(tmp_path / "out", "cityjson"))
    assert cityjson_rules.faults(lines) == []
    assert [line["type"] for line in lines] == ["CityJSON"] + 6 * ["CityJSONFeature"]
    tiles = [parsed_lines(path) for path in sorted((run_dir / "cityjson").rglob("*.jsonl"))]
    # the premise: their tiles count from corners of their own
    assert len({tuple(tile[0]["transform"]["translate"]) for tile in tiles if len(tile) > 1}) == 3
    assert corners(lines) == {name: xyz for tile in tiles for name, xyz in corners(tile).items()}
    everything = np.array([xyz for vertices in corners(lines).values() for xyz in vertices])
    extent = lines[0]["metadata"]["geographicalExtent"]
    assert extent == pytest.approx([*everything.min(axis=0), *everything.max(axis=0)], abs=1e-4)
    assert min(v for line in lines[1:] for xyz in line["vertices"] for v in xyz) >= 0


def test_cjio_reads_the_merged_city_objects(out_dir: Path) -> None:
    command = [sys.executable, "-c", "from cjio.cjio import cli; cli()", "stdin", "info"]
    with output_file(out_dir, "cityjson").open() as stream:
        checked = subprocess.run(command, stdin=stream, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert "Building" in checked.stdout
    assert "7415" in checked.stdout


# --- GeoJSON ---------------------------------------------------------------------------------------------------------


def test_the_footprints_are_rfc_7946_with_all_columns_and_all_buildings(out_dir: Path) -> None:
    found = json.loads(output_file(out_dir, "geojson").read_text())
    table = pq.read_table(output_file(out_dir, "buildings"))
    assert found["type"] == "FeatureCollection"
    assert "coordRefSys" not in found
    assert sorted(feature["id"] for feature in found["features"]) == sorted(table["building_id"].to_pylist())
    columns = set(table.schema.names) - {"geometry", "bbox", *SHAPE_COLUMNS}
    for feature in found["features"]:
        assert set(feature["properties"]) == columns
        if feature["geometry"] is None:
            assert feature["properties"]["status"] == "failed"
            continue
        shape = shapely.geometry.shape(feature["geometry"])
        assert shape.is_valid
        assert 4.36 < shape.centroid.x < 4.38
        assert 52.0 < shape.centroid.y < 52.02
        assert shape.exterior.is_ccw
        assert all(not hole.is_ccw for hole in shape.interiors)
    statuses = Counter(feature["properties"]["status"] for feature in found["features"])
    assert statuses == {"ok": 4, "fallback": 1, "failed": 1}


@pytest.mark.parametrize("epsg", [7415, 2225])  # metres; feet, also of elevations
def test_footprints_come_back_to_the_millimetre(tmp_path: Path, epsg: int) -> None:
    write_outputs(runs.write_run(tmp_path / "run", epsg=epsg), tmp_path / "out", ("geojson", "buildings"))
    own = geopandas.read_parquet(tmp_path / "out/buildings.parquet").set_index("building_id")
    degrees = geopandas.read_file(tmp_path / "out/buildings.geojson").set_index("building_id").to_crs(own.crs.to_2d())
    for name in own.index[own.geometry.notna()]:
        assert shapely.hausdorff_distance(degrees.geometry[name], own.geometry[name]) < 1e-3


@pytest.mark.parametrize(
    ("epsg", "easting", "northing", "degrees"),
    [
        (7415, 155_000.0, 463_000.0, (5.38721, 52.15517)),  # the tower at Amersfoort, origin of the Dutch grid
        (3035, 4_321_000.0, 3_210_000.0, (10.0, 52.0)),  # the centre of a projection that names northing first
    ],
)
def test_a_known_point_lies_where_the_survey_says(
    tmp_path: Path, epsg: int, easting: float, northing: float, degrees: tuple[float, float]
) -> None:
    there = runs.placed(small.pent(), "there", easting - small.ORIGIN[0], northing - small.ORIGIN[1])
    write_outputs(runs.write_run(tmp_path / "run", {"x1_y1": [there]}, epsg=epsg), tmp_path / "out")
    (feature,) = json.loads(output_file(tmp_path / "out", "geojson").read_text())["features"]
    assert shapely.geometry.shape(feature["geometry"]).bounds[:2] == pytest.approx(degrees, abs=2e-5)


def test_footprints_and_report_state_the_unit_of_elevations(tmp_path: Path) -> None:
    for epsg, unit_m in ((2225, 1200 / 3937), (7415, 1.0), (None, 1.0)):
        write_outputs(runs.write_run(tmp_path / f"run-{epsg}", epsg=epsg), tmp_path / f"out-{epsg}")
        found = json.loads((tmp_path / f"out-{epsg}/buildings.geojson").read_text())
        assert found["verticalUnitM"] == read_catalogue(tmp_path / f"out-{epsg}").crs.vertical_unit_m
        assert found["verticalUnitM"] == pytest.approx(unit_m)
        crs = json.loads(output_file(tmp_path / f"out-{epsg}", "report").read_text())["crs"]
        assert crs["cityjson_vertical_unit_m"] == crs["vertical_unit_m"] == found["verticalUnitM"]


def test_a_footprint_without_a_place_on_earth_is_a_feature_without_geometry(tmp_path: Path) -> None:
    lost = runs.placed(small.gable(), "lost", 1e9, 0.0)
    found = runs.placed(small.gable(), "found", 500_000.0, 5_000_000.0)
    write_outputs(runs.write_run(tmp_path / "run", {"x1_y1": [lost, found]}, epsg=25832), tmp_path / "out")
    features = json.loads(output_file(tmp_path / "out", "geojson").read_text())["features"]
    nowhere = {feature["id"]: feature["geometry"] is None for feature in features}
    assert nowhere == {runs.ident("lost"): True, runs.ident("found"): False}
    assert json.loads(output_file(tmp_path / "out", "report").read_text())["buildings"]["without_footprint"] == 1


@pytest.mark.parametrize("name", [None, "site"])
def test_without_a_place_on_earth_the_coordinates_stay_the_tiles_own(tmp_path: Path, name: str | None) -> None:
    run_dir = runs.write_run(tmp_path / "run", epsg=None if name is None else 7415)
    write_outputs(run_dir if name is None else runs.with_local_crs(run_dir), tmp_path / "out")
    found = json.loads(output_file(tmp_path / "out", "geojson").read_text())
    assert (found["coordRefSys"], "not WGS 84" in found["note"]) == (None, True)
    (gable,) = [feature for feature in found["features"] if feature["id"] == runs.ident("gable")]
    assert shapely.geometry.shape(gable["geometry"]).bounds == (85_000.0, 447_000.0, 85_010.0, 447_008.0)
    crs = read_catalogue(tmp_path / "out").crs
    assert (crs.name, crs.is_known) == (name, False)


# --- meshes ----------------------------------------------------------------------------------------------------------


def test_the_zip_file_holds_the_terrain_of_the_tiles(tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "run")
    write_outputs(run_dir, tmp_path / "without", ("meshes",))
    tiles = json.loads((run_dir / "run.json").read_text())["tiles"]
    written = {f"terrain/tile={tiles[0]}/part-0.{end}": end.encode() for end in ("city.jsonl", "obj")}
    for name, content in written.items():
        (run_dir / name).parent.mkdir(parents=True, exist_ok=True)
        (run_dir / name).write_bytes(content)
    (run_dir / "terrain" / f"tile={tiles[0]}" / ".part-0.obj.1-ab.part").touch()
    write_outputs(run_dir, tmp_path / "with", ("meshes",))
    with (
        zipfile.ZipFile(output_file(tmp_path / "with", "meshes")) as archive,
        zipfile.ZipFile(output_file(tmp_path / "without", "meshes")) as before,
    ):
        assert sorted(archive.namelist()) == sorted([*before.namelist(), *written])
        assert {name: archive.read(name) for name in written} == written


@pytest.mark.parametrize("meshes", ["building", "tile"])
def test_the_zip_file_holds_the_meshes_under_the_names_of_the_table(tmp_path: Path, meshes: str) -> None:
    run_dir = runs.write_run(tmp_path / "run", meshes=meshes)
    write_outputs(run_dir, tmp_path / "out", ("meshes", "buildings"))
    named = set(pq.read_table(tmp_path / "out/buildings.parquet")["mesh_path"].to_pylist()) - {None}
    with zipfile.ZipFile(output_file(tmp_path / "out", "meshes")) as archive:
        assert archive.testzip() is None
        assert set(archive.namelist()) == named
        assert len(archive.namelist()) == len(named) == (5 if meshes == "building" else 3)
        for entry in archive.infolist():
            assert archive.read(entry) == (run_dir / entry.filename).read_bytes()
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)


def test_a_run_without_meshes_offers_none(tmp_path: Path) -> None:
    write_outputs(runs.write_run(tmp_path / "run", meshes="none"), tmp_path / "out")
    assert "meshes" not in read_catalogue(tmp_path / "out").outputs
    with pytest.raises(NoSuchOutputError, match="had nothing for it"):
        output_file(tmp_path / "out", "meshes")
    assert not (tmp_path / "out/meshes.zip").exists()


# --- the report ------------------------------------------------------------------------------------------------------


def test_the_report_accounts_for_every_candidate_and_object(out_dir: Path) -> None:
    report = json.loads(output_file(out_dir, "report").read_text())
    assert report["buildings"]["candidates"] == 6
    assert report["buildings"]["by_status"] == {"ok": 4, "doubtful": 0, "fallback": 1, "failed": 1}
    assert report["buildings"]["by_reason"] == {"invalid_solid": 1, "too_few_points": 1}
    assert report["buildings"]["by_roof_type"] == {"gable": 3, "flat": 1, "none": 1, "pent": 1}
    assert report["buildings"]["by_lod"] == {"2.2": 4, "1.2": 1}
    assert report["buildings"]["by_method"] == {"fuzzy-sart": 6}
    assert (report["buildings"]["roof_planes"], report["buildings"]["without_footprint"]) == (10, 1)
    assert report["rejected"] == {"objects": 4, "by_reason": {"too_small": 4}}
    assert report["content_sha256"] == "ee" * 32
    assert report["settings"] == {"general": {"method": "fuzzy-sart"}}
    assert report["timings_s"] == {"split": 1.5, "total": 3.0}
    assert report["largest_process_bytes"] == 5_000_000
    assert report["crs"]["uri"] == "http://www.opengis.net/def/crs/EPSG/0/28992"


def test_the_report_names_inputs_and_warnings_without_the_servers_folders(run_dir: Path, out_dir: Path) -> None:
    text = output_file(out_dir, "report").read_text()
    report = json.loads(text)
    assert [entry["name"] for entry in report["inputs"]] == ["tile.laz", "outlines.gpkg"]
    assert report["inputs"][0]["sha256"] == "ab" * 32
    assert report["warnings"] == ["tile.laz: no GPS time", "something else"]
    failed = {"tile": "x852_y4470", "reason": "OSError: scratch/a is gone"}
    assert report["tiles"] == {
        "planned": 5,
        "failed": [failed],
        "without_points": ["x850_y4470"],
        "without_terrain": [],
    }
    assert runs.SERVER_FOLDER not in text
    assert str(run_dir) not in text
    assert "node-7" not in text


def test_no_output_names_a_folder_of_the_server(run_dir: Path, out_dir: Path) -> None:
    for name, data in contents(out_dir).items():
        for folder in (runs.SERVER_FOLDER, str(run_dir), str(out_dir)):
            assert folder.encode() not in data, name


# --- memory ----------------------------------------------------------------------------------------------------------

_WRITE_OUTPUTS = """
import sys
from pathlib import Path
from service.outputs import write_outputs
write_outputs(Path(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.slow
def test_three_times_the_tiles_need_hardly_more_memory(tmp_path: Path) -> None:
    """The allocator's pools are full with the 60 tiles already."""
    peaks = []
    for count in (60, 180):
        tiles = {
            f"x{n}_y0": [runs.placed(small.gable(), f"{n} {k}", n * 100.0, k * 10.0) for k in range(60)]
            for n in range(count)
        }
        run_dir = runs.write_run(tmp_path / f"run {count}", tiles)
        (peak_kb,) = printed_with_peak(_WRITE_OUTPUTS, run_dir, tmp_path / f"out {count}")
        peaks.append(int(peak_kb) * 1024)
    assert read_catalogue(tmp_path / "out 180").n_buildings == 180 * 60
    assert peaks[1] - peaks[0] < 30 * 2**20
