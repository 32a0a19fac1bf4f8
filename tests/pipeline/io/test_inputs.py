"""Which files paths, URLs and tile indexes mean."""

import json
import logging
import zipfile
from pathlib import PurePath

import geopandas
import pytest
import shapely

from pipeline.errors import UnreadableInputError
from pipeline.extras.remote.urls import filesystem_of
from pipeline.extras.vector_files.tile_index import COLUMNS, TileIndex, read_tile_index
from pipeline.io import SpatialReference, find_inputs
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.formats import VECTOR_SUFFIXES

RD = "EPSG:28992"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "below").mkdir()
    for name in ("a.laz", "b.laz", "c.laz", "below/d.laz"):
        (tmp_path / name).write_bytes(b"LASF")
    return tmp_path


def reference():
    return resolve_reference(path="", crs=RD)[0]


def names(locations):
    return [PurePath(location).name for location in locations]


def write_index(path, rows, column="location", crs=RD, **more):
    """A vector file of squares of 1 km, the k-th k km east of (100000, 400000)."""
    squares = [shapely.box(100_000 + 1000 * k, 400_000, 101_000 + 1000 * k, 401_000) for k in range(len(rows))]
    frame = geopandas.GeoDataFrame({column: rows, **more}, geometry=squares, crs=RD)
    frame = frame if crs is None else frame.to_crs(crs)
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    elif path.suffix in {".zip", ".kmz"}:
        inner = write_index(path.with_suffix(".shp" if path.suffix == ".zip" else ".kml"), rows, column, crs, **more)
        with zipfile.ZipFile(path, "w") as archive:
            for file in sorted(inner.parent.glob(f"{inner.stem}.*")):
                if file != path:
                    archive.write(file, file.name)
                    file.unlink()
    else:
        frame.to_file(path, driver={".kml": "LIBKML", ".geojsonl": "GeoJSONSeq"}.get(path.suffix))
    return path


def put(url, content=b"LASF"):
    filesystem_of(url).pipe_file(url, content)


def test_a_text_index_names_files_relative_to_itself_absolute_and_by_url(folder):
    index = folder / "below" / "tiles.txt"
    index.write_text(f"# sheets\n\n../a.laz\nd.laz\n{folder}/b.laz\nd.laz\n")
    assert names(find_inputs([index])) == ["a.laz", "b.laz", "d.laz"]
    index.write_text("https://host/x.laz?a=1\ns3://bucket/y.laz\n")
    assert find_inputs([index]) == ["https://host/x.laz?a=1", "s3://bucket/y.laz"]


def test_points_in_a_text_file_are_points(folder):
    (folder / "points.txt").write_text("1.0 2.0 3.0\n")
    (folder / "table.csv").write_text("x,y,z\n1,2,3\n")
    assert names(find_inputs([folder / "points.txt", folder / "table.csv"])) == ["points.txt", "table.csv"]


def test_a_line_that_names_no_point_file_is_reported(folder):
    (folder / "tiles.txt").write_text("a.laz\nreadme.html\n")
    with pytest.raises(UnreadableInputError, match=r"tiles\.txt: the line 'readme\.html' names no point file"):
        find_inputs([folder / "tiles.txt"])


@pytest.mark.parametrize("ending", [*VECTOR_SUFFIXES])
def test_a_vector_index_names_files_in_its_column(folder, ending):
    alike = {".json": ".geojson", ".geojsons": ".geojsonl", ".ndjson": ".geojsonl", ".geoparquet": ".parquet"}
    written = folder / f"index{alike.get(ending, ending)}"
    crs = "EPSG:4326" if written.suffix in {".geojsonl", ".kml", ".kmz"} else RD
    index = write_index(written, ["a.laz", "below/d.laz"], crs=crs, sheet=["1", "2"]).rename(folder / f"index{ending}")
    assert names(find_inputs([index])) == ["a.laz", "d.laz"]
    assert read_tile_index(str(index)).outlines is not None


def test_a_zip_archive_of_point_clouds_is_not_an_index_and_named(folder):
    with zipfile.ZipFile(folder / "tiles.zip", "w") as archive:
        archive.write(folder / "a.laz", "a.laz")
    with pytest.raises(UnreadableInputError, match=r"tiles\.zip: it is a zip archive of point clouds\. Give each"):
        find_inputs([folder / "tiles.zip"])


@pytest.mark.parametrize(
    ("rows", "columns", "wanted"),
    [
        *((["a.laz"], {"column": column.upper(), "other": ["no file"]}, ["a.laz"]) for column in COLUMNS),
        (["a.laz"], {"column": "url", "location": ["Delft"], "file": ["b.laz"]}, ["a.laz"]),
        (["a.laz", None, "b.laz"], {}, ["a.laz", "b.laz"]),
    ],
)
def test_the_first_usual_column_that_names_files_counts_in_any_case(folder, rows, columns, wanted):
    index = write_index(folder / "index.gpkg", rows, **columns)
    assert names(find_inputs([index])) == wanted


def test_another_column_is_taken_where_it_is_the_only_one_that_names_files(folder):
    index = write_index(folder / "index.gpkg", ["a.laz", "b.laz"], column="ahn_laz", sheet=["37EN1", "37EN2"])
    assert names(find_inputs([index])) == ["a.laz", "b.laz"]
    write_index(folder / "index.gpkg", ["a.laz"], column="ahn3_laz", ahn4_laz=["b.laz"])
    with pytest.raises(UnreadableInputError, match=r"2 columns name files \(ahn3_laz, ahn4_laz\)"):
        find_inputs([index])
    write_index(folder / "index.gpkg", ["37EN1"], column="sheet")
    with pytest.raises(UnreadableInputError, match=r"no column names point files; its columns are sheet"):
        find_inputs([index])


@pytest.mark.parametrize("crs", [RD, "EPSG:4326", "EPSG:25831"])
def test_an_index_is_cut_by_an_area_whatever_its_crs(folder, crs):
    index = read_tile_index(str(write_index(folder / "index.gpkg", [f"{k}.laz" for k in range(6)], crs=crs)))
    area = shapely.box(102_300, 400_300, 103_500, 400_600)
    assert names(index.within(area, reference())) == ["2.laz", "3.laz"]
    corner = shapely.box(103_000 - 50, 401_050, 103_000, 402_000)
    assert names(index.within(corner, reference())) == ["2.laz", "3.laz"]
    assert index.within(shapely.box(0, 0, 1, 1), reference()) == ()


def test_tiles_without_an_outline_are_always_taken():
    outlines = shapely.from_wkt(["POLYGON ((0 0, 1 0, 1 1, 0 0))", None, "POLYGON EMPTY"])
    index = TileIndex(path="i", locations=("a", "b", "c"), outlines=outlines, crs=None)
    assert index.within(shapely.box(5000, 5000, 5001, 5001), SpatialReference()) == ("b", "c")


def test_find_inputs_asks_which_files_of_an_index_are_wanted(folder):
    index = write_index(folder / "index.gpkg", ["a.laz", "b.laz", "c.laz"])
    assert names(find_inputs([index], cut=lambda found: found.locations[1:2])) == ["b.laz"]


def test_inputs_of_strangers_lead_nowhere_else(folder):
    (folder / "tiles.txt").write_text("a.laz\n")
    write_index(folder / "index.gpkg", ["a.laz"])
    for name in ("tiles.txt", "index.gpkg", "a.laz"):
        assert names(find_inputs([folder / name], only_files=True)) == [name]
    for entry in ("s3://bucket/a.laz", "https://host/a.laz", str(folder), f"{folder}/*.laz"):
        with pytest.raises(UnreadableInputError):
            find_inputs([entry], only_files=True)


def test_a_folder_and_a_pattern_of_a_bucket_are_listed(bucket):
    for name in ("t/a.laz", "t/B.LAZ", "t/deep/c.laz", "t/notes.txt", "t/d.txt", "t/.hidden.laz", "u/e.laz"):
        put(f"{bucket}/{name}", b"1 2 3\n" if name == "t/d.txt" else b"no points\n")
    put(f"{bucket}/t/empty.laz", b"")
    assert names(find_inputs([f"{bucket}/t/"])) == ["B.LAZ", "a.laz", "d.txt"]
    assert names(find_inputs([f"{bucket}/*/*.laz"])) == [".hidden.laz", "a.laz", "e.laz"]
    assert names(find_inputs([f"{bucket}/t/**/c.laz", f"{bucket}/u/e.laz"])) == ["c.laz", "e.laz"]


def test_an_object_that_is_named_like_a_pattern_is_a_file(bucket):
    put(f"{bucket}/tile[1].laz")
    assert find_inputs([f"{bucket}/tile[1].laz"]) == [f"{bucket}/tile[1].laz"]


def test_what_is_not_in_a_bucket_is_reported(bucket):
    put(f"{bucket}/t/notes.txt", b"no points\n")
    for entry, reported in (
        (f"{bucket}/t/missing.laz", "there is no such thing"),
        (f"{bucket}/t", "a folder, not a file.*End its name with /"),
        (f"{bucket}/t/*.laz", "matches no file"),
        (f"{bucket}/t/", "none of the 1 files in the folder is a point file"),
        (f"{bucket}/nothing/", "there is no such thing|the folder is empty"),
        ("s3://no-such-bucket/t/", "there is no such bucket"),
        ("https://host/folder/", "does not list its files.*a tile index"),
        ("ftp://host/a.laz", "ftp:// is not supported"),
    ):
        with pytest.raises(UnreadableInputError, match=reported):
            find_inputs([entry])


def test_an_index_in_a_bucket_names_its_neighbours_and_no_file_of_this_machine(bucket, folder):
    put(f"{bucket}/2026/tiles.txt", b"a.laz\n../2025/b.laz\nhttps://host/c.laz\n")
    assert find_inputs([f"{bucket}/2026/tiles.txt"]) == [
        "https://host/c.laz",
        f"{bucket}/2025/b.laz",
        f"{bucket}/2026/a.laz",
    ]
    put(f"{bucket}/tiles.geojson", write_index(folder / "i.geojson", ["x/a.laz"], crs="EPSG:4326").read_bytes())
    assert find_inputs([f"{bucket}/tiles.geojson"]) == [f"{bucket}/x/a.laz"]
    put(f"{bucket}/evil.txt", b"/etc/points.laz\n")
    with pytest.raises(UnreadableInputError, match="a file of this machine"):
        find_inputs([f"{bucket}/evil.txt"])


def test_an_index_of_a_web_server_names_its_neighbours(s3, bucket):
    url = f"{bucket}/2026/tiles.txt"
    filesystem_of(url).pipe_file(url, b"a.laz\n/b.laz?x=1\n//other/c.laz\n", ACL="public-read")
    page = f"{s3.endpoint}/{bucket.removeprefix('s3://')}/2026/tiles.txt"
    assert find_inputs([f"{page}?token=hidden"]) == sorted(
        [page.replace("tiles.txt", "a.laz"), f"{s3.endpoint}/b.laz?x=1", "http://other/c.laz"]
    )


def test_a_broken_index_is_reported_by_its_name(folder):
    (folder / "index.geojson").write_text(json.dumps({"type": "FeatureCollection"})[:-4])
    with pytest.raises(UnreadableInputError, match=r"index\.geojson: cannot be read as vector data"):
        find_inputs([folder / "index.geojson"])


def test_only_a_lost_connection_of_a_task_goes_unreported(caplog: pytest.LogCaptureFixture) -> None:
    filesystem_of("https://example.org/a.laz")
    for error in (ConnectionResetError("cut off"), ValueError("a fault")):
        logging.getLogger("asyncio").error("Task exception was never retrieved", exc_info=error)
    assert [str(record.exc_info[1]) for record in caplog.records if record.exc_info] == ["a fault"]
