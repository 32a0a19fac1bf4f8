"""Vector files in further formats, archives and layers, and what they must not do."""

import json
import shutil
import zipfile

import geopandas
import numpy as np
import pyogrio
import pytest
from shapely import LineString, box

from pipeline.errors import CrsError, EmptyInputError, UnreadableInputError
from pipeline.extras.footprints.footprints_file import read_area, read_footprints
from pipeline.extras.footprints.placed_features import off_the_data
from pipeline.extras.guides.guides_file import read_guides
from pipeline.extras.vector_files.nearby import Elsewhere
from pipeline.extras.vector_files.tile_index import read_tile_index
from pipeline.io import SpatialReference
from pipeline.io.crs_resolution import resolve_reference

HOUSES = [box(85_000, 447_000, 85_010, 447_008), box(85_020, 447_000, 85_030, 447_010)]
NAMES = ["Müllerstraße 1", "Œuvre"]
AREA = box(84_900, 446_900, 85_100, 447_100)
NEAR_FIRST = box(84_990, 446_990, 84_991, 446_991)


def reference(crs: str = "EPSG:28992") -> SpatialReference:
    return resolve_reference(path="points", crs=crs)[0]


def frame(geometries=HOUSES, crs="EPSG:28992", **columns):
    columns = columns or {"id": ["A", "B"][: len(geometries)], "name": NAMES[: len(geometries)]}
    return geopandas.GeoDataFrame(columns, geometry=list(geometries), crs=crs)


def written(path, driver, found=None, **options):
    found = frame() if found is None else found
    found.to_file(path, driver=driver, **options)
    return path


def zipped(path, *files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return path


def shape_files(folder, name, found=None):
    folder.mkdir(exist_ok=True)
    written(folder / f"{name}.shp", "ESRI Shapefile", found, encoding="UTF-8")
    return sorted(folder.glob(f"{name}.*"))


def made(tmp_path, kind):
    """A file of a kind, made by geopandas or by hand."""
    if kind == "flatgeobuf":
        return written(tmp_path / "a.fgb", "FlatGeobuf")
    if kind == "flatgeobuf without index":
        return written(tmp_path / "a.fgb", "FlatGeobuf", SPATIAL_INDEX="NO")
    if kind == "gml":
        return written(tmp_path / "a.gml", "GML")
    if kind == "gml 2":
        return written(tmp_path / "a.gml", "GML", FORMAT="GML2")
    if kind == "gml without a name for it":
        return written(tmp_path / "a.gml", "GML").rename(tmp_path / "a.xml")
    if kind == "lines":
        return written(tmp_path / "a.geojsonl", "GeoJSONSeq", frame().to_crs("EPSG:4326"))
    if kind == "text sequence":
        return written(tmp_path / "a.geojsons", "GeoJSONSeq", frame().to_crs("EPSG:4326"), RS="YES")
    if kind == "lines named json":
        return written(tmp_path / "a.geojsonl", "GeoJSONSeq", frame().to_crs("EPSG:4326")).rename(tmp_path / "a.json")
    if kind == "zipped shapefile":
        return zipped(tmp_path / "a.zip", *shape_files(tmp_path / "s", "houses"))
    if kind == "zipped shapefile with a note":
        (tmp_path / "meta.json").write_text("{}")
        return zipped(tmp_path / "a.shp.zip", *shape_files(tmp_path / "s", "houses"), tmp_path / "meta.json")
    if kind == "zipped geopackage":
        return zipped(tmp_path / "a.zip", written(tmp_path / "b.gpkg", "GPKG"))
    assert kind == "zipped geojson"
    return zipped(tmp_path / "a.zip", written(tmp_path / "b.geojson", "GeoJSON"))


KINDS = [
    "flatgeobuf",
    "flatgeobuf without index",
    "gml",
    "gml 2",
    "gml without a name for it",
    "lines",
    "text sequence",
    "lines named json",
    "zipped shapefile",
    "zipped shapefile with a note",
    "zipped geopackage",
    "zipped geojson",
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("area", [None, AREA, NEAR_FIRST], ids=["all", "around", "near one"])
def test_every_format_gives_the_same_polygons_ids_and_text(tmp_path, kind, area):
    path = made(tmp_path, kind)
    before = sorted(tmp_path.rglob("*"))
    found = read_footprints(path, reference(), area=area)
    wanted = {"A": (HOUSES[0], NAMES[0]), "B": (HOUSES[1], NAMES[1])}
    assert set(found.ids) <= {"A", "B"}
    assert len(found) + found.elsewhere.count == 2
    for name, polygon, row in zip(found.ids, found.polygons, found.attributes, strict=True):
        # the text of degrees has seven decimals
        assert polygon.hausdorff_distance(wanted[name][0]) < 0.02
        assert row["name"] == wanted[name][1]
    assert sorted(tmp_path.rglob("*")) == before, "reading leaves nothing beside the file"


@pytest.mark.parametrize("driver", ["KML", "LIBKML"])
@pytest.mark.parametrize("is_zipped", [False, True])
def test_kml_is_read_with_its_attributes(tmp_path, driver, is_zipped):
    path = written(tmp_path / "a.kml", driver, frame(use=["house", "barn"]).to_crs("EPSG:4326"))
    path = zipped(tmp_path / "a.kmz", path) if is_zipped else path
    before = sorted(tmp_path.rglob("*"))
    found = read_footprints(path, reference())
    assert [row["use"] for row in found.attributes] == ["house", "barn"]
    for polygon, wanted in zip(found.polygons, HOUSES, strict=True):
        assert polygon.hausdorff_distance(wanted) < 0.02
    assert sorted(tmp_path.rglob("*")) == before


def test_kml_that_links_to_other_files_is_refused(tmp_path):
    path = written(tmp_path / "a.kml", "KML", frame().to_crs("EPSG:4326"))
    link = "<NetworkLink><Link><href>http://127.0.0.1/b.kml</href></Link></NetworkLink></Folder>"
    path.write_text(path.read_text().replace("</Folder>", link))
    with pytest.raises(UnreadableInputError, match="links: <NetworkLink"):
        read_footprints(path, reference())


@pytest.mark.parametrize(
    ("name", "driver", "words"),
    [
        ("a.sqlite", "SQLite", "SQLite that is not a GeoPackage is not read"),
        ("a.json", "JSONFG", "JSON-FG is not read"),
        ("a.tab", "MapInfo File", "MapInfo TAB is not read"),
        ("a.mif", "MapInfo File", "MapInfo MIF is not read"),
        ("a.gdb", "OpenFileGDB", "a folder, not a file"),
    ],
)
def test_a_format_that_is_not_read_is_named(tmp_path, name, driver, words):
    path = written(tmp_path / name, driver)
    with pytest.raises(UnreadableInputError, match=rf"{words}. Convert it to GeoPackage"):
        read_footprints(path, reference())
    if path.is_dir():
        files = zipped(tmp_path / "a.zip", *path.iterdir())
        with pytest.raises(UnreadableInputError, match=r"a File Geodatabase is not read\. Convert"):
            read_footprints(files, reference())


def test_guides_and_areas_read_the_same_formats(tmp_path):
    lines = frame([LineString([(85_000, 447_004), (85_010, 447_004)])], kind=["ridge"])
    assert len(read_guides(written(tmp_path / "a.fgb", "FlatGeobuf", lines), reference(), area=AREA).guides) == 1
    area = read_area(zipped(tmp_path / "a.zip", *shape_files(tmp_path / "s", "houses")), reference())
    assert area.area == pytest.approx(180.0)


def test_ids_of_gml_count_unless_its_writer_made_them_up(tmp_path):
    path = written(tmp_path / "a.gml", "GML")
    assert read_footprints(path, reference()).ids == ("A", "B")
    text = path.read_text()
    path.write_text(text.replace('gml:id="a.0"', 'gml:id="DEBY_1"').replace('gml:id="a.1"', 'gml:id="DEBY_2"'))
    (tmp_path / "a.xsd").unlink(missing_ok=True)
    assert read_footprints(path, reference()).ids == ("DEBY_1", "DEBY_2")


def two_layers(tmp_path, kind):
    sheds = frame([box(85_040, 447_000, 85_044, 447_004)], id=["S"], name=["shed"])
    if kind == "geopackage":
        written(tmp_path / "a.gpkg", "GPKG", layer="houses")
        return written(tmp_path / "a.gpkg", "GPKG", sheds, layer="sheds")
    if kind == "zipped geopackage":
        return zipped(tmp_path / "a.zip", two_layers(tmp_path, "geopackage"))
    return zipped(
        tmp_path / "a.zip", *shape_files(tmp_path / "s", "houses"), *shape_files(tmp_path / "s", "sheds", sheds)
    )


@pytest.mark.parametrize("kind", ["geopackage", "zipped geopackage", "zipped shapefiles"])
def test_one_of_several_layers_must_be_named(tmp_path, kind):
    path = two_layers(tmp_path, kind)
    assert read_footprints(path, reference(), layer="sheds").ids == ("S",)
    assert len(read_footprints(path, reference(), layer="houses")) == 2
    with pytest.raises(UnreadableInputError, match="Name one of its layers with --layer: houses, sheds"):
        read_footprints(path, reference())
    with pytest.raises(UnreadableInputError, match="barns"):
        read_footprints(path, reference(), layer="barns")
    with pytest.raises(UnreadableInputError, match="Give a file with one of its layers: houses, sheds"):
        read_area(path, reference())
    if path.suffix == ".gpkg":
        with pytest.raises(UnreadableInputError, match=r"be the tiles\. Give a file with one of its layers: houses"):
            read_tile_index(str(path))


@pytest.mark.parametrize("folder", ["./", "/", "houses/"])
def test_folders_in_an_archive_are_passed_over(tmp_path, folder):
    path = made(tmp_path, "zipped geopackage")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(folder, b"")
    assert read_footprints(path, reference()).ids == ("A", "B")


def test_archives_that_cannot_be_used_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("no vectors")
    with pytest.raises(UnreadableInputError, match="a zip archive with 0 vector files"):
        read_footprints(zipped(tmp_path / "a.zip", tmp_path / "a.txt"), reference())
    whole = zipped(tmp_path / "b.zip", *shape_files(tmp_path / "s", "houses")).read_bytes()
    (tmp_path / "b.zip").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnreadableInputError, match="cannot be read as a zip archive"):
        read_footprints(tmp_path / "b.zip", reference())


def test_an_archive_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = made(tmp_path, "zipped geopackage")
    monkeypatch.setattr("pipeline.extras.vector_files.vector_archive.UNPACKED_LIMIT", 1000)
    monkeypatch.setattr(shutil, "copyfileobj", None)
    with pytest.raises(UnreadableInputError, match=r"it unpacks to \d+ bytes"):
        read_footprints(path, reference())


@pytest.mark.parametrize("kind", ["gml", "flatgeobuf"])
def test_a_file_that_could_name_other_files_is_refused(tmp_path, kind):
    path = made(tmp_path, kind)
    other = written(tmp_path / "other.geojson", "GeoJSON")
    pointer = f'<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>{other}</SrcDataSource></OGRVRTLayer>'
    content = path.read_bytes()
    path.write_bytes(content[:60] + f"<!-- {pointer}</OGRVRTDataSource> -->".encode() + content[60:])
    with pytest.raises(UnreadableInputError, match="it may name other files or servers"):
        read_footprints(path, reference())


PDS4 = """<?xml version="1.0"?><!-- http://www.opengis.net/gml -->
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1"><File_Area_Observational>
<File><file_name>{0}</file_name></File><Table_Delimited><offset unit="byte">0</offset>
<parsing_standard_id>PDS DSV 1</parsing_standard_id><records>1</records>
<record_delimiter>Carriage-Return Line-Feed</record_delimiter><field_delimiter>Comma</field_delimiter>
<Record_Delimited><fields>1</fields><groups>0</groups><Field_Delimited><name>WKT</name>
<field_number>1</field_number><data_type>ASCII_String</data_type></Field_Delimited></Record_Delimited>
</Table_Delimited></File_Area_Observational></Product_Observational>"""


def test_xml_that_only_mentions_gml_is_refused(tmp_path):
    path = tmp_path / "a.gml"
    path.write_text(PDS4.format(path.name))
    with pytest.raises(UnreadableInputError, match="it is PDS4, not GML"):
        read_footprints(path, reference())


def test_xml_with_entities_is_refused(tmp_path):
    path = made(tmp_path, "gml")
    text = path.read_text().replace("<ogr:FeatureCollection", '<!DOCTYPE x [<!ENTITY a "b">]><ogr:FeatureCollection', 1)
    path.write_text(text)
    with pytest.raises(UnreadableInputError, match="entities"):
        read_footprints(path, reference())


def test_xml_that_is_not_gml_and_unknown_bytes_are_refused_with_the_formats(tmp_path):
    for content in (b"<html><body>no</body></html>", b"\x01\x02\x03\x04 nothing"):
        (tmp_path / "a.gml").write_bytes(content)
        with pytest.raises(UnreadableInputError, match="FlatGeobuf"):
            read_footprints(tmp_path / "a.gml", reference())


def test_one_feature_alone_and_pretty_geojson_are_one_document(tmp_path):
    feature = {"type": "Feature", "properties": {"id": "A"}, "geometry": HOUSES[0].__geo_interface__}
    crs = {"type": "name", "properties": {"name": "EPSG:28992"}}
    whole = {"type": "FeatureCollection", "crs": crs, "features": [feature, {**feature, "properties": {"id": "B"}}]}
    (tmp_path / "a.json").write_text(json.dumps(whole, indent=1))
    assert len(read_footprints(tmp_path / "a.json", reference())) == 2
    (tmp_path / "a.json").write_text(json.dumps({**feature, "crs": crs}) + "\n")
    assert len(read_footprints(tmp_path / "a.json", reference())) == 1


@pytest.mark.parametrize(("read", "what"), [(read_footprints, "footprints"), (read_area, "area")])
def test_coordinates_that_cannot_be_degrees_are_refused(tmp_path, read, what):
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": json.loads(frame().to_json())["features"]}))
    with pytest.raises(CrsError, match=rf"the {what} are in 'WGS 84', in degrees, which x .* cannot be"):
        read(path, reference())


@pytest.mark.parametrize(
    ("bounds", "crs", "kind", "words"),
    [
        ((400_015.0, 5_000_015.0, 400_061.0, 5_000_062.0), "OGC:CRS84", CrsError, "cannot be"),
        ((-2e6, -2e6, -1.9e6, -1.9e6), "OGC:CRS84", CrsError, "cannot be"),
        ((52.0, 4.37, 52.01, 4.38), "OGC:CRS84", EmptyInputError, "longitude before latitude"),
        ((447_000.0, 85_000.0, 447_010.0, 85_010.0), "EPSG:28992", EmptyInputError, "Write x before y"),
        ((0.0, 0.0, 10.0, 10.0), "EPSG:28992", EmptyInputError, "Check the CRS of the footprints"),
        (None, None, EmptyInputError, "Check the CRS of the footprints"),
    ],
)
def test_the_error_for_features_off_the_data_says_where_both_lie_and_what_may_be_wrong(bounds, crs, kind, words):
    fault = off_the_data("a.geojson", "footprints", Elsewhere(3, bounds, crs), AREA, reference())
    assert isinstance(fault, kind)
    assert words in str(fault)
    if bounds is not None:
        assert f"{bounds[0]:.9g}" in str(fault) or f"{bounds[2]:.9g}" in str(fault)


def test_repeated_and_empty_ids_stay_as_given_with_a_warning(tmp_path):
    boxes = [box(85_000 + 20 * k, 447_000, 85_010 + 20 * k, 447_008) for k in range(6)]
    path = written(tmp_path / "a.gpkg", "GPKG", frame(boxes, id=["A", "B", "B", "C", None, "D"]))
    found = read_footprints(path, reference())
    assert found.ids == ("A", "B", "B", "C", "5", "D")
    (warning,) = found.warnings
    assert warning.startswith("column 'id' is empty 1 times and holds 'B' 2 times")


@pytest.mark.parametrize(
    ("columns", "ids"),
    [
        ({"id": [0, 0, 0, 0], "objectid": [7, 8, 9, 9]}, ("7", "8", "9", "9")),
        ({"id": ["A", "B", "B", "C"], "uuid": ["p", "q", "r", "s"]}, ("p", "q", "r", "s")),
        ({"id": [0, 0, 0, 0]}, ("1", "2", "3", "4")),
        ({"id": [None, None, None, None]}, ("1", "2", "3", "4")),
    ],
)
def test_a_column_of_ids_must_tell_most_features_apart(tmp_path, columns, ids):
    boxes = [box(85_000 + 20 * k, 447_000, 85_010 + 20 * k, 447_008) for k in range(4)]
    assert read_footprints(written(tmp_path / "a.gpkg", "GPKG", frame(boxes, **columns)), reference()).ids == ids


def test_the_bundled_gdal_reads_what_the_docs_promise():
    assert {"GML", "LIBKML", "FlatGeobuf", "GeoJSONSeq", "GPKG", "ESRI Shapefile", "GeoJSON"} <= set(
        pyogrio.list_drivers()
    )
    assert np.all([isinstance(name, str) for name in pyogrio.list_drivers()])
