"""Footprints of three formats, in metres of the run's CRS, with ids and attributes."""

import json

import geopandas
import numpy as np
import pandas as pd
import pyproj
import pytest
import shapely
from measured import printed
from shapely import LineString, MultiPolygon, Point, Polygon, box
from shapely.affinity import scale

from pipeline.errors import CrsError, EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.extras.footprints.footprints_file import read_area, read_footprints
from pipeline.io import SpatialReference
from pipeline.io.crs_resolution import resolve_reference

HOUSES = [box(85_000, 447_000, 85_010, 447_008), box(85_020, 447_000, 85_030, 447_010)]


def reference(crs="EPSG:7415"):
    return resolve_reference(path="points", crs=crs)[0]


def write(path, geometries=HOUSES, crs="EPSG:28992", layer=None, **columns):
    """Writes with geopandas: an independent writer."""
    frame = geopandas.GeoDataFrame(columns, geometry=list(geometries), crs=crs)
    frame.to_file(path, **({} if layer is None else {"layer": layer}))
    return path


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".geojson"])
def test_three_formats_give_the_same_polygons(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", identifi=["one", "two"], year=[1900, 1950])
    found = read_footprints(path, reference(), id_column="identifi")
    assert found.ids == ("one", "two")
    assert [row["year"] for row in found.attributes] == [1900, 1950]
    for polygon, expected in zip(found.polygons, HOUSES, strict=True):
        assert polygon.symmetric_difference(expected).area < 1e-6
        assert not polygon.has_z
    assert len(found) == 2


def test_geojson_in_degrees_is_reprojected_and_reported(tmp_path):
    path = tmp_path / "a.geojson"
    write(path, np.array(geopandas.GeoSeries(HOUSES, crs="EPSG:28992").to_crs("EPSG:4326")), crs="EPSG:4326")
    found = read_footprints(path, reference())
    # GeoJSON keeps seven decimals of a degree.
    assert max(a.hausdorff_distance(b) for a, b in zip(found.polygons, HOUSES, strict=True)) < 0.02
    assert any("reprojected from 'WGS 84' to 'Amersfoort / RD New'" in warning for warning in found.warnings)


def test_a_run_in_feet_gets_metres(tmp_path):
    path = write(tmp_path / "a.gpkg", crs="EPSG:2992")
    found = read_footprints(path, reference("EPSG:2992"))
    expected = scale(HOUSES[0], 0.3048, 0.3048, origin=(0, 0))
    assert found.polygons[0].symmetric_difference(expected).area < 1e-6
    area = read_area(path, reference("EPSG:2992"))
    assert area.symmetric_difference(MultiPolygon(HOUSES)).area < 1e-3


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"identificatie": ["a", "b"], "id": [1, 2]}, ("a", "b")),
        ({"gml_id": ["g1", "g2"]}, ("g1", "g2")),
        ({"ID": [7, 8]}, ("7", "8")),
        ({"id": [7, 7]}, ("1", "2")),
        ({"id": ["x", None], "osm_id": [3, 4]}, ("3", "4")),
        ({"name": ["a", "b"]}, ("1", "2")),
    ],
)
def test_ids_come_from_the_first_common_column_that_identifies_else_the_feature_id(tmp_path, columns, expected):
    assert read_footprints(write(tmp_path / "a.gpkg", **columns), reference()).ids == expected


def test_a_named_column_must_be_there_and_identify(tmp_path):
    path = write(tmp_path / "a.gpkg", street=["x", "x"])
    with pytest.raises(UnreadableInputError, match=r"'number' is not there.*street"):
        read_footprints(path, reference(), id_column="number")
    with pytest.raises(InconsistentInputError, match="empty or not unique"):
        read_footprints(path, reference(), id_column="street")


def test_attributes_are_plain_values(tmp_path):
    built = pd.to_datetime(["1999-12-31", None])
    path = write(tmp_path / "a.gpkg", built=built, height=[1.5, np.nan], storeys=np.array([2, 3]), note=["x", None])
    first, second = read_footprints(path, reference()).attributes
    assert first["built"].startswith("1999-12-31")
    assert (first["height"], first["storeys"], first["note"]) == (1.5, 2, "x")
    assert (second["built"], second["height"], second["note"]) == (None, None, None)
    json.dumps([first, second])


def test_invalid_polygons_are_repaired_and_reported(tmp_path):
    bow_tie = Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])
    spike = Polygon([(0, 0), (10, 0), (10, 10), (10, 20), (10, 10), (0, 10)])
    flat = Polygon([(0, 0), (5, 5), (10, 10)])
    found = read_footprints(write(tmp_path / "a.gpkg", [bow_tie, spike, flat, HOUSES[0]], id=[1, 2, 3, 4]), reference())
    assert found.ids == ("1", "2", "4")
    assert all(polygon.is_valid and polygon.area > 0 for polygon in found.polygons)
    assert isinstance(found.polygons[0], MultiPolygon)
    assert found.polygons[1].equals(box(0, 0, 10, 10))
    assert "2 footprints are invalid and were repaired" in found.warnings
    assert "1 features are left out: 1 invalid and without area" in found.warnings
    reported = [(issue.source_id, issue.problem, issue.action) for issue in found.issues]
    assert reported == [
        ("1", "invalid", "repaired to 2 polygons of 50.0 m2"),
        ("2", "invalid", "repaired to one polygon of 100.0 m2"),
        ("3", "no_area", "left out"),
    ]
    assert found.issues[0].detail == "Self-intersection[5 5]"
    assert found.issues[0].bounds_m == (0.0, 0.0, 10.0, 10.0)
    assert str(found.issues[2]) == "footprint 3: Self-intersection[5 5]; no area is left of it: left out"


def test_a_footprint_that_is_not_finite_or_off_the_map_stops_nothing(tmp_path):
    broken = Polygon([(0, 0), (10, 0), (10, np.inf), (0, 10)])
    path = write(tmp_path / "a.gpkg", [broken, HOUSES[0]], id=["inf", "good"])
    found = read_footprints(path, reference())
    assert found.ids == ("good",)
    assert [(issue.source_id, issue.problem) for issue in found.issues] == [("inf", "not_finite")]
    far = write(tmp_path / "b.gpkg", [box(4.3, 52.0, 4.4, 52.1), box(4.3, 95.0, 4.4, 96.0)], crs="EPSG:4326", id=[1, 2])
    found = read_footprints(far, reference())
    assert found.ids == ("1",)
    assert [(issue.source_id, issue.problem) for issue in found.issues] == [("2", "outside_crs")]


def test_elevations_holes_and_several_parts_are_kept_in_plan(tmp_path):
    ring = Polygon(box(0, 0, 10, 10).exterior, [box(4, 4, 6, 6).exterior])
    raised = Polygon([(20, 0, 5), (30, 0, 5), (30, 10, 9)])
    found = read_footprints(write(tmp_path / "a.gpkg", [MultiPolygon([ring, box(12, 0, 14, 2)]), raised]), reference())
    assert found.polygons[0].area == 96 + 4
    assert not found.polygons[1].has_z


def test_other_geometries_are_left_out_and_reported(tmp_path):
    mixed = [Point(0, 0), LineString([(0, 0), (1, 1)]), HOUSES[0], None, Polygon()]
    found = read_footprints(write(tmp_path / "a.geojson", mixed, crs="EPSG:28992", id=[1, 2, 3, 4, 5]), reference())
    assert found.ids == ("3",)
    assert "4 features are left out: 2 no polygons, 1 without a geometry, 1 empty" in found.warnings
    assert [(issue.source_id, issue.problem) for issue in found.issues] == [
        ("1", "not_polygon"),
        ("2", "not_polygon"),
        ("4", "no_geometry"),
        ("5", "empty"),
    ]
    lines = write(tmp_path / "b.gpkg", [LineString([(0, 0), (1, 1)])])
    with pytest.raises(EmptyInputError, match="none of the 1 features is a polygon"):
        read_footprints(lines, reference())


def test_a_layer_of_points_beside_does_not_disturb(tmp_path):
    path = write(tmp_path / "a.gpkg", layer="houses")
    write(path, [Point(0, 0)], layer="trees")
    assert len(read_footprints(path, reference())) == 2


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_footprints_without_crs_are_assumed_to_be_the_run_s_and_reported(tmp_path):
    path = write(tmp_path / "a.shp", crs=None)
    found = read_footprints(path, reference())
    assert found.polygons[0].equals(HOUSES[0])
    assert any("no CRS" in warning for warning in found.warnings)


def test_degrees_cannot_meet_points_of_an_unknown_crs(tmp_path):
    path = tmp_path / "a.geojson"
    write(path, [box(4.3, 52.0, 4.4, 52.1)], crs="EPSG:4326")
    with pytest.raises(CrsError, match="geographic"):
        read_footprints(path, SpatialReference())
    metres = read_footprints(write(tmp_path / "b.gpkg"), SpatialReference())
    assert any("the points' CRS is unknown" in warning for warning in metres.warnings)
    with pytest.raises(CrsError, match="another unit"):
        read_footprints(write(tmp_path / "c.gpkg", crs="EPSG:2992"), SpatialReference())


def test_what_is_no_vector_file_is_refused_and_the_valid_ones_listed(tmp_path):
    text = tmp_path / "a.geojson"
    text.write_text('{"type": "FeatureCollection", "features": [')
    for path in (text, tmp_path / "missing.gpkg"):
        with pytest.raises(UnreadableInputError) as caught:
            read_footprints(path, reference())
        assert str(path) in str(caught.value)
    with pytest.raises(UnreadableInputError, match=r"GeoPackage.*GeoJSON.*Shapefile"):
        read_footprints(text, reference())


def test_the_delft_footprints_read_as_geopandas_reads_them(shared_data):
    path = shared_data / "ahn3" / "footprints.gpkg"
    found, frame = read_footprints(path, reference()), geopandas.read_file(path)
    assert len(found) == len(frame) == 160
    assert found.ids == tuple(frame["bgt_id"])
    assert found.warnings == ()
    assert all(a.equals(b) for a, b in zip(found.polygons, frame.geometry, strict=True))
    assert [row["status"] for row in found.attributes] == frame["status"].tolist()


def test_importing_the_reader_needs_neither_pandas_nor_the_format_libraries():
    heavy = ("pandas", "geopandas", "pyogrio", "laspy", "scipy", "pyproj")
    code = f"import sys, pipeline.io; print([m for m in {heavy} if m in sys.modules])"
    assert printed(code) == ["[]"]


# --- files that cover more than the data ------------------------------------------------------------------------------

TOWN = [box(x, 447_000, x + 10, 447_008) for x in range(85_000, 95_000, 250)]
FORMATS = [".gpkg", ".shp", ".geojson", ".parquet"]


def write_town(path, geometries=TOWN, crs="EPSG:28992"):
    frame = geopandas.GeoDataFrame(
        {"id": [f"h{k}" for k in range(len(geometries))], "year": range(1900, 1900 + len(geometries))},
        geometry=list(geometries),
        crs="EPSG:28992",
    ).to_crs(crs)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_file(path)
    return path


@pytest.mark.parametrize("suffix", FORMATS)
def test_near_an_area_the_same_is_read_as_of_the_whole_file(tmp_path, suffix):
    path = write_town(tmp_path / f"a{suffix}")
    area = box(86_000, 446_990, 86_600, 447_100)
    whole, near = read_footprints(path, reference()), read_footprints(path, reference(), area=area)
    inside = [k for k, polygon in enumerate(whole.polygons) if area.intersects(polygon)]
    assert near.ids == tuple(whole.ids[k] for k in inside) == ("h4", "h5", "h6")
    assert near.attributes == tuple(whole.attributes[k] for k in inside)
    assert all(a.equals(whole.polygons[k]) for a, k in zip(near.polygons, inside, strict=True))
    assert (len(near) + near.elsewhere.count, whole.elsewhere.count) == (len(TOWN), 0)


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_area_in_another_crs_finds_its_footprints(tmp_path, suffix):
    path = write_town(tmp_path / f"a{suffix}", crs="EPSG:4326")
    parts = MultiPolygon([box(86_000, 446_990, 86_020, 447_100), box(93_990, 446_900, 94_020, 447_005)])
    found = read_footprints(path, reference(), area=parts)
    assert found.ids == ("h4", "h36")
    assert found.elsewhere.count == len(TOWN) - 2


@pytest.mark.parametrize("suffix", FORMATS)
def test_off_all_footprints_none_are_read_and_they_are_counted(tmp_path, suffix):
    found = read_footprints(write_town(tmp_path / f"a{suffix}"), reference(), area=box(0, 0, 10, 10))
    assert (found.ids, found.polygons, found.issues, found.elsewhere.count) == ((), (), (), len(TOWN))
    assert not any("left out" in warning for warning in found.warnings)


@pytest.mark.parametrize("suffix", [".gpkg", ".parquet", ".geojson"])
def test_faults_without_a_place_are_reported_wherever_the_area_is(tmp_path, suffix):
    path = write_town(tmp_path / f"a{suffix}", [*TOWN[:3], None, Polygon(), Point(85_000, 447_000), Point(0, 0)])
    found = read_footprints(path, reference(), area=box(85_000, 447_000, 85_001, 447_001))
    assert (found.ids, found.elsewhere.count) == (("h0",), 2)
    assert {issue.source_id: issue.problem for issue in found.issues} == {
        "h3": "no_geometry",
        "h4": "empty",
        "h5": "not_polygon",
    }


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".gpkg", ".parquet"])
def test_of_a_file_of_a_whole_country_only_a_little_is_held(tmp_path, suffix):
    at = np.arange(100_000)
    country = shapely.box(
        80_000 + at % 400 * 20.0, 4e5 + at // 400 * 20.0, 80_010 + at % 400 * 20.0, 400_010 + at // 400 * 20.0
    )
    path = write_town(tmp_path / f"a{suffix}", country)
    code = (
        "import re, sys, pyarrow.parquet, pyogrio, pyproj, shapely; "
        "from pipeline.io import SpatialReference; "
        "from pipeline.extras.footprints.footprints_file import read_footprints; "
        "peak = lambda: int(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]) >> 10; "
        "before = peak(); "
        "area = shapely.box(81_000, 401_000, 81_100, 401_100) if sys.argv[2] == 'near' else None; "
        "found = read_footprints(sys.argv[1], SpatialReference(), area=area); "
        "print(len(found), found.elsewhere.count, peak() - before)"
    )
    near, whole = ([int(word) for word in printed(code, path, what)] for what in ("near", "all"))
    assert (near[0] + near[1], whole[0], whole[1]) == (100_000, 100_000, 0)
    assert 25 <= near[0] <= 400
    assert near[2] < whole[2] / 2


def test_an_outline_longer_than_any_building_is_left_out(tmp_path):
    spiked = Polygon([(0, 0), (10, 0), (4e9, 10), (0, 10)])
    path = write(tmp_path / "a.gpkg", [spiked, HOUSES[0]], id=["spiked", "good"])
    found = read_footprints(path, reference())
    assert found.ids == ("good",)
    assert [(issue.source_id, issue.problem, issue.action) for issue in found.issues] == [
        ("spiked", "too_large", "left out")
    ]
    assert "4e+09 m wide or long, more than 20000 m" in str(found.issues[0])
    alone = write(tmp_path / "b.gpkg", [spiked], id=["spiked"])
    with pytest.raises(EmptyInputError, match="no polygon of at most 20000 m has an area"):
        read_footprints(alone, reference())


def test_a_projection_that_proj_cannot_name_gives_an_unknown_accuracy(tmp_path):
    damaged = (
        pyproj.CRS.from_epsg(25832).to_wkt("WKT1_ESRI").replace('PRIMEM["Greenwich', 'PRIMEM["0],PARAMETEGreenwich')
    )
    assert 'PRIMEM["0]' in damaged
    path = write(tmp_path / "a.shp", [box(500_000, 5_650_000, 500_010, 5_650_010)], crs="EPSG:25832", id=["a"])
    path.with_suffix(".prj").write_text(damaged)
    found = read_footprints(path, reference("EPSG:25832"))
    assert found.polygons[0].area == pytest.approx(100.0, abs=0.1)
    assert any(warning.endswith("with an unknown accuracy") for warning in found.warnings)
