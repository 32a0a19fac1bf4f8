"""GeoParquet files: judged by the validator, read back by three independent readers."""

import io
import json
from pathlib import Path

import duckdb
import geopandas
import geoparquet_validator
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
import small_buildings as small
from small_buildings import Contexts, RejectedObjects

from pipeline.errors import RunError
from pipeline.export.geoparquet import geo_table, parquet_bytes, read_table, table_dataset
from pipeline.export.record_rows import SCHEMAS, RecordContext, building_row, plane_rows, rejected_row
from pipeline.export.tile import write_tile

CRSES = ["compound", "feet and metres", "US feet", "unknown"]
BUILT = (small.gable, small.courtyard, small.two_parts, small.failed, small.pent)


@pytest.fixture
def run_dir(tmp_path: Path, contexts: Contexts, rejected_objects: RejectedObjects) -> Path:
    """A run of two tiles, the second of them empty."""
    write_tile(tmp_path, "x85_y447", [build() for build in BUILT], rejected_objects, contexts["compound"])
    write_tile(tmp_path, "x86_y447", [], [], contexts["compound"])
    return tmp_path


def rows_of(table: str, context: RecordContext, rejected_objects: RejectedObjects) -> list[dict]:
    if table == "buildings":
        return [building_row(build(), context) for build in BUILT]
    if table == "planes":
        return [row for build in BUILT for row in plane_rows(build(), context)]
    return [rejected_row(entry, context) for entry in rejected_objects]


def judged(data: bytes) -> list[str]:
    """The tests of GeoParquet that a file fails; the core and the covering class must be claimed.

    Statistics of row groups are asked for by the validator's class of good distribution; a file without rows has none.
    """
    report = geoparquet_validator.check_bytes("table.parquet", data)
    passed = {outcome["id"] for outcome in report["outcomes"] if outcome["status"] == "pass"}
    assert any("/core/" in name for name in passed)
    assert any("/covering/" in name for name in passed)
    without_rows = pq.read_metadata(io.BytesIO(data)).num_rows == 0
    excused = {"/conf/distribution/geospatial-statistics"} if without_rows else set()
    return [name for name in geoparquet_validator.failed(report) if name not in excused]


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("table", list(SCHEMAS))
def test_the_validator_finds_no_fault_also_in_an_empty_table(
    contexts: Contexts, rejected_objects: RejectedObjects, table: str, crs: str
) -> None:
    for rows in (rows_of(table, contexts[crs], rejected_objects), []):
        assert judged(parquet_bytes(geo_table(table, rows, contexts[crs].reference.projjson))) == []


@pytest.mark.parametrize("table", list(SCHEMAS))
def test_an_unknown_crs_is_reported_as_null_and_a_known_one_as_projjson(
    contexts: Contexts, rejected_objects: RejectedObjects, table: str
) -> None:
    for crs in CRSES:
        projjson = contexts[crs].reference.projjson
        data = parquet_bytes(geo_table(table, rows_of(table, contexts[crs], rejected_objects), projjson))
        geo = json.loads(pq.read_schema(io.BytesIO(data)).metadata[b"geo"])
        column = geo["columns"]["geometry"]
        assert "crs" in column
        assert column["crs"] == projjson
        assert (geo["version"], column["edges"], column["orientation"]) == ("1.1.0", "planar", "counterclockwise")


def test_geometry_types_and_bounds_are_those_of_the_rows(contexts: Contexts, rejected_objects: RejectedObjects) -> None:
    wanted = {"buildings": ["Polygon"], "planes": ["Polygon Z"], "rejected": ["Polygon"]}
    for table, types in wanted.items():
        rows = rows_of(table, contexts["compound"], rejected_objects)
        column = json.loads(geo_table(table, rows, None).schema.metadata[b"geo"])["columns"]["geometry"]
        assert column["geometry_types"] == types
        assert len(column["bbox"]) == (6 if table == "planes" else 4)
        empty = json.loads(geo_table(table, [], None).schema.metadata[b"geo"])["columns"]["geometry"]
        assert empty["geometry_types"] == []
        assert "bbox" not in empty


def test_pyarrow_reads_back_what_was_written(
    run_dir: Path, contexts: Contexts, rejected_objects: RejectedObjects
) -> None:
    for table, schema in SCHEMAS.items():
        found = read_table(str(run_dir), table)
        assert found.schema.names == [*schema.names, "bbox", "tile"]
        assert set(found["tile"].to_pylist()) == {"x85_y447"}
        key = schema.names[0]
        assert found[key].to_pylist() == sorted(found[key].to_pylist())
        rows = {row[key]: row for row in rows_of(table, contexts["compound"], rejected_objects)}
        if table != "planes":
            for row in found.to_pylist():
                for name in schema.names:
                    if name != "mesh_path":
                        assert row[name] == rows[row[key]][name], name


def test_the_bbox_column_covers_each_geometry_and_is_null_without_one(run_dir: Path) -> None:
    found = read_table(str(run_dir), "buildings").to_pylist()
    assert sum(row["bbox"] is None for row in found) == 1
    for row in found:
        if row["geometry"] is None:
            assert row["bbox"] is None
        else:
            assert tuple(row["bbox"].values()) == shapely.from_wkb(row["geometry"]).bounds


def test_geometries_are_iso_wkb_and_rings_counter_clockwise(run_dir: Path) -> None:
    for row in read_table(str(run_dir), "planes").to_pylist():
        assert row["geometry"][:5] == b"\x01" + (1003).to_bytes(4, "little")
        polygon = shapely.from_wkb(row["geometry"])
        assert polygon.exterior.is_ccw
        assert polygon.is_valid


def test_geopandas_reads_crs_and_geometry(run_dir: Path) -> None:
    part = run_dir / "buildings" / "tile=x85_y447" / "part-0.parquet"
    frame = geopandas.read_parquet(part)
    assert frame.crs.to_epsg() == 7415
    assert frame.set_index("building_id").geometry["courtyard"].area == pytest.approx(300.0)
    assert frame.geometry.isna().sum() == 1
    near = geopandas.read_parquet(part, bbox=(85_030, 447_000, 85_040, 447_001))
    assert list(near["building_id"]) == ["courtyard"]
    planes = geopandas.read_parquet(run_dir / "planes" / "tile=x85_y447" / "part-0.parquet")
    assert planes.geometry.has_z.all()


def test_geopandas_reads_an_unknown_crs_as_none(tmp_path: Path, contexts: Contexts) -> None:
    write_tile(tmp_path, "a1", [small.gable()], [], contexts["unknown"])
    frame = geopandas.read_parquet(tmp_path / "buildings" / "tile=a1" / "part-0.parquet")
    assert frame.crs is None


def test_duckdb_reads_the_hive_folders_and_the_same_wkb(run_dir: Path) -> None:
    source = f"read_parquet('{run_dir}/buildings/*/*.parquet', hive_partitioning = true)"
    with duckdb.connect() as base:
        base.execute("SET enable_geoparquet_conversion = false")
        rows = base.execute(
            f"SELECT building_id, tile, status, volume_m3, geometry, validity_codes FROM {source} ORDER BY 1"
        ).fetchall()
        kind = base.execute(f"SELECT typeof(tile), typeof(acquired_from) FROM {source} LIMIT 1").fetchone()
    assert kind == ("VARCHAR", "TIMESTAMP WITH TIME ZONE")
    found = read_table(str(run_dir), "buildings").to_pylist()
    assert [row[0] for row in rows] == [row["building_id"] for row in found]
    assert {row[1] for row in rows} == {"x85_y447"}
    assert [row[3] for row in rows] == [row["volume_m3"] for row in found]
    assert [None if row[4] is None else bytes(row[4]) for row in rows] == [row["geometry"] for row in found]
    assert rows[0][5] == [203, 104]


def test_the_same_rows_in_any_order_give_the_same_bytes(contexts: Contexts, rejected_objects: RejectedObjects) -> None:
    for table in SCHEMAS:
        rows = rows_of(table, contexts["compound"], rejected_objects)
        shuffled = [rows[i] for i in np.random.default_rng(1).permutation(len(rows))]
        assert parquet_bytes(geo_table(table, rows, None)) == parquet_bytes(geo_table(table, shuffled, None))


def test_a_folder_that_is_no_run_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="not a folder: give the directory that a run wrote"):
        table_dataset(str(tmp_path), "buildings")


def test_a_damaged_file_is_an_error_that_names_the_table(run_dir: Path) -> None:
    (run_dir / "planes" / "tile=x85_y447" / "part-0.parquet").write_bytes(b"PAR1 cut off")
    with pytest.raises(RunError, match="planes"):
        read_table(str(run_dir), "planes")
