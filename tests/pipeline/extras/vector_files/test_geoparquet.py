"""Footprints out of GeoParquet, written by others and by hand."""

import datetime as dt
import decimal
import json

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from measured import printed
from shapely import MultiPolygon, Polygon, box

from pipeline.errors import UnreadableInputError
from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.extras.vector_files.geoparquet_layer import geometry_column
from pipeline.io import SpatialReference
from pipeline.io.crs_resolution import resolve_reference

RING = Polygon(box(85_040, 447_000, 85_050, 447_010).exterior, [box(85_044, 447_004, 85_046, 447_006).exterior])
HOUSES = [box(85_000, 447_000, 85_010, 447_008), RING]


def reference(crs="EPSG:7415"):
    return resolve_reference(path="points", crs=crs)[0]


def frame(geometries=HOUSES, crs="EPSG:28992", **columns):
    return geopandas.GeoDataFrame(columns, geometry=list(geometries), crs=crs)


def by_hand(path, columns, geometry="geometry", **about):
    """A file whose metadata say what the test wants."""
    geo = {"version": "1.1.0", "primary_column": geometry, "columns": {geometry: {"geometry_types": [], **about}}}
    pq.write_table(pa.table(columns).replace_schema_metadata({"geo": json.dumps(geo)}), path)
    return path


def wkb(geometries=HOUSES):
    return pa.array([None if g is None else shapely.to_wkb(g) for g in geometries], pa.binary())


@pytest.mark.parametrize("types", [5, True, "Polygon", None, {"a": 1}])
def test_types_that_are_no_list_are_taken_for_unknown(tmp_path, types):
    path = by_hand(tmp_path / "a.parquet", {"geometry": wkb()}, encoding="WKB", crs="EPSG:28992", geometry_types=types)
    assert len(read_footprints(path, reference()).polygons) == len(HOUSES)
    column = geometry_column(path, pq.read_schema(path))
    assert column.types == ()


@pytest.mark.parametrize("encoding", ["WKB", "geoarrow"])
@pytest.mark.parametrize("version", ["1.0.0", "1.1.0"])
def test_what_geopandas_writes_is_read_as_it_wrote_it(tmp_path, encoding, version):
    if (encoding, version) == ("geoarrow", "1.0.0"):
        version = "1.1.0"
    path = tmp_path / "a.parquet"
    # A list of polygons and one of several parts make two encodings.
    for geometries in (
        HOUSES,
        [MultiPolygon([HOUSES[0], box(85_100, 447_000, 85_101, 447_001)]), MultiPolygon([RING])],
    ):
        frame(geometries, id=["one", "two"], year=[1900, 1950]).to_parquet(
            path, geometry_encoding=encoding, schema_version=version, write_covering_bbox=version == "1.1.0"
        )
        found = read_footprints(path, reference())
        assert found.ids == ("one", "two")
        assert found.attributes == ({"id": "one", "year": 1900}, {"id": "two", "year": 1950})
        assert all(a.equals(b) for a, b in zip(found.polygons, geometries, strict=True))
        assert found.warnings == ()


def test_geoparquet_and_geopackage_say_the_same(tmp_path):
    frame(identificatie=["a", "b"]).to_parquet(tmp_path / "a.parquet")
    frame(identificatie=["a", "b"]).to_file(tmp_path / "a.gpkg")
    one, other = (read_footprints(tmp_path / name, reference()) for name in ("a.parquet", "a.gpkg"))
    assert one.ids == other.ids
    assert one.attributes == other.attributes
    assert all(a.equals(b) for a, b in zip(one.polygons, other.polygons, strict=True))


def test_a_missing_crs_is_longitude_and_latitude_and_null_is_unknown(tmp_path):
    degrees = np.array(geopandas.GeoSeries(HOUSES, crs="EPSG:28992").to_crs("OGC:CRS84"))
    missing = by_hand(tmp_path / "a.parquet", {"geometry": wkb(degrees)}, encoding="WKB")
    found = read_footprints(missing, reference())
    assert max(a.hausdorff_distance(b) for a, b in zip(found.polygons, HOUSES, strict=True)) < 0.001
    assert any("reprojected from 'WGS 84 (CRS84)'" in warning for warning in found.warnings)
    unknown = by_hand(tmp_path / "b.parquet", {"geometry": wkb()}, encoding="WKB", crs=None)
    found = read_footprints(unknown, reference())
    assert found.polygons[0].equals(HOUSES[0])
    assert found.warnings == ("the footprints have no CRS: that of the points is assumed",)


def test_a_crs_as_projjson_is_understood(tmp_path):
    path = tmp_path / "a.parquet"
    frame(crs="EPSG:28992").to_crs("EPSG:32631").to_parquet(path)
    assert isinstance(json.loads(pq.read_metadata(path).metadata[b"geo"])["columns"]["geometry"]["crs"], dict)
    found = read_footprints(path, reference())
    assert max(a.hausdorff_distance(b) for a, b in zip(found.polygons, HOUSES, strict=True)) < 0.001


def test_another_geometry_column_can_be_named_and_is_no_attribute(tmp_path):
    two = frame(id=["one", "two"])
    two["roof"] = two.geometry.buffer(1.0, join_style="mitre")
    two.to_parquet(tmp_path / "a.parquet")
    walls = read_footprints(tmp_path / "a.parquet", reference())
    assert walls.attributes == ({"id": "one"}, {"id": "two"})
    roofs = read_footprints(tmp_path / "a.parquet", reference(), layer="roof")
    assert roofs.polygons[0].area == 12 * 10
    with pytest.raises(UnreadableInputError, match=r"geometry column 'cellar' is not there.*geometry, roof"):
        read_footprints(tmp_path / "a.parquet", reference(), layer="cellar")


def test_attributes_become_what_json_knows(tmp_path):
    columns = {
        "geometry": wkb(),
        "built": pa.array([dt.date(1999, 12, 31), None]),
        "seen": pa.array([dt.datetime(2020, 1, 2, 3, 4, tzinfo=dt.UTC), None], pa.timestamp("us", tz="UTC")),
        "tax": pa.array([decimal.Decimal("12.50"), None]),
        "height": pa.array([1.5, float("nan")]),
        "uses": pa.array([["shop", "flat"], []]),
        "address": pa.array([{"street": "Dam", "number": 1}, None]),
        "photo": pa.array([b"\x00\xff", None]),
    }
    path = by_hand(tmp_path / "a.parquet", columns, encoding="WKB", crs=None)
    first, second = read_footprints(path, reference()).attributes
    assert first == {
        "built": "1999-12-31",
        "seen": "2020-01-02T03:04:00+00:00",
        "tax": 12.5,
        "height": 1.5,
        "uses": ["shop", "flat"],
        "address": {"street": "Dam", "number": 1},
        "photo": None,
    }
    assert second == dict.fromkeys(first) | {"uses": []}
    json.dumps([first, second], allow_nan=False)


def test_attributes_that_python_cannot_hold_stop_nothing(tmp_path):
    columns = {
        "geometry": wkb(),
        "late": pa.array([2**62, 0], pa.timestamp("us")),
        "somewhere": pa.array([0, None], pa.timestamp("us", tz="Nowhere/Land")),
        "name": pa.array([b"\xff", b"Dam"]).view(pa.string()),
    }
    path = by_hand(tmp_path / "a.parquet", columns, encoding="WKB", crs=None)
    found = read_footprints(path, reference())
    assert found.attributes == (
        {"late": None, "somewhere": None, "name": "ÿ"},
        {"late": "1970-01-01T00:00:00", "somewhere": None, "name": "Dam"},
    )
    assert "the text in column 'name' of row 0 is not UTF-8 and is read as Windows-1252 ('ÿ')" in found.warnings
    table = pa.Table.from_arrays([wkb(), pa.array([1, 2]), pa.array([3, 4])], names=["geometry", "year", "year"])
    pq.write_table(table.replace_schema_metadata(pq.read_schema(path).metadata), path)
    assert [row["year"] for row in read_footprints(path, reference()).attributes] == [1, 2]


def test_rows_without_geometry_are_reported_one_by_one(tmp_path):
    broken = pa.array([shapely.to_wkb(HOUSES[0]), None, b"\x01\x02", shapely.to_wkb(shapely.Point(1, 2))], pa.binary())
    path = by_hand(tmp_path / "a.parquet", {"id": ["a", "b", "c", "d"], "geometry": broken}, encoding="WKB", crs=None)
    found = read_footprints(path, reference())
    assert found.ids == ("a",)
    assert [(issue.source_id, issue.problem) for issue in found.issues] == [
        ("b", "no_geometry"),
        ("c", "unreadable"),
        ("d", "not_polygon"),
    ]


def test_rows_without_geometry_in_nested_lists_are_reported_too(tmp_path):
    frame([HOUSES[0], None, RING], id=["a", "b", "c"]).to_parquet(tmp_path / "a.parquet", geometry_encoding="geoarrow")
    found = read_footprints(tmp_path / "a.parquet", reference())
    assert found.ids == ("a", "c")
    assert found.polygons[1].equals(RING)
    assert [(issue.source_id, issue.problem) for issue in found.issues] == [("b", "no_geometry")]


def test_parquet_that_says_nothing_of_geometry_is_refused_and_the_fix_named(tmp_path):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"geometry": wkb()}), path)
    with pytest.raises(UnreadableInputError, match=r"no `geo` metadata.*Write it as GeoParquet"):
        read_footprints(path, reference())
    with pytest.raises(UnreadableInputError, match="encoded as 'point'"):
        read_footprints(by_hand(path, {"geometry": wkb()}, encoding="point"), reference())
    with pytest.raises(UnreadableInputError, match=r"WKB column is of type string"):
        read_footprints(by_hand(path, {"geometry": ["POLYGON EMPTY"]}, encoding="WKB"), reference())
    with pytest.raises(UnreadableInputError, match=r"polygon column is not of nested lists"):
        read_footprints(by_hand(path, {"geometry": wkb()}, encoding="polygon"), reference())
    for geo in ("[]", "{", '{"primary_column": "geometry", "columns": {"geometry": 1}}'):
        pq.write_table(pa.table({"geometry": wkb()}).replace_schema_metadata({"geo": geo}), path)
        with pytest.raises(UnreadableInputError, match="name no geometry column"):
            read_footprints(path, reference())


@pytest.mark.parametrize("covering", [None, 1, [], {}, {"bbox": []}, {"bbox": {"xmin": [{}, 1], "ymin": 3}}])
def test_a_covering_that_is_none_is_passed_over(tmp_path, covering):
    path = by_hand(tmp_path / "a.parquet", {"geometry": wkb()}, encoding="WKB", crs=None, covering=covering)
    assert len(read_footprints(path, reference())) == 2


@pytest.mark.parametrize("kept", [8, 100, -8])
def test_a_truncated_file_is_refused(tmp_path, kept):
    path = tmp_path / "a.parquet"
    frame(id=[1, 2]).to_parquet(path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(UnreadableInputError, match="cannot be read as Parquet"):
        read_footprints(path, SpatialReference())


def test_the_delft_footprints_survive_geoparquet(shared_data, tmp_path):
    known = geopandas.read_file(shared_data / "ahn3" / "footprints.gpkg")
    known.to_parquet(tmp_path / "a.parquet")
    found = read_footprints(tmp_path / "a.parquet", reference())
    assert found.ids == tuple(known["bgt_id"])
    assert all(a.equals(b) for a, b in zip(found.polygons, known.geometry, strict=True))
    again = read_footprints(shared_data / "ahn3" / "footprints.gpkg", reference())
    assert [row["status"] for row in found.attributes] == [row["status"] for row in again.attributes]


def test_reading_a_geopackage_does_not_load_pyarrow(tmp_path):
    frame().to_file(tmp_path / "a.gpkg")
    code = (
        "import sys; from pipeline.io import SpatialReference; "
        "from pipeline.extras.footprints.footprints_file import read_footprints; "
        f"read_footprints({str(tmp_path / 'a.gpkg')!r}, SpatialReference()); "
        "print('pyarrow.parquet' in sys.modules)"
    )
    assert printed(code) == ["False"]
