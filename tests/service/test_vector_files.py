"""Footprints of further formats and of several layers as inputs of jobs, and jobs whose result would be empty."""

import io
import json
import sqlite3
import zipfile
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import pytest
import shapely
from driver_bench import Bench
from live_service import las_bytes

from pipeline.errors import InputError
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from service.driver.attempt import classify_request, compare_request, run_request
from service.errors import RequestError, TooLargeError
from service.fetching import Fetched, JobFiles
from service.filenames import clean_filename
from service.jobs import Fault, InputReference, JobRequest, JobStatus
from service.preflight import examine
from service.settings import ServiceSettings
from service.status import execute_request
from service.wire.files import outlines
from service.wire.inputs import ClassifyInputs, CompareInputs, ReconstructInputs

SQUARE = shapely.box(84_010.0, 447_010.0, 84_020.0, 447_020.0)
DRIVERS = {
    ".gpkg": "GPKG",
    ".fgb": "FlatGeobuf",
    ".gml": "GML",
    ".kml": "LIBKML",
    ".geojsonl": "GeoJSONSeq",
    ".shp": "ESRI Shapefile",
}


def write(path: Path, *geometries: Any, layer: str | None = None, crs: str = "EPSG:28992") -> Path:
    """Write features in RD; lines of GeoJSON and KML are in degrees."""
    frame = gpd.GeoDataFrame({"id": [*map(str, range(len(geometries)))]}, geometry=list(geometries), crs=crs)
    if path.suffix in {".geojsonl", ".kml"}:
        frame = frame.to_crs("EPSG:4326")
    frame.to_file(path, driver=DRIVERS.get(path.suffix), **({} if layer is None else {"layer": layer}))
    return path


def zipped(path: Path, *files: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return path


def shapes_of(folder: Path, name: str) -> list[Path]:
    folder.mkdir(exist_ok=True)
    write(folder / f"{name}.shp", SQUARE)
    return sorted(folder.glob(f"{name}.*"))


@pytest.mark.parametrize(
    ("suffix", "kind"),
    [
        (".kmz", "kml"),
        (".fgb", "flatgeobuf"),
        (".gml", "gml"),
        (".kml", "kml"),
        (".geojsonl", "geojson"),
        (".ndjson", "geojson"),
    ],
)
def test_an_upload_of_each_format_is_known_by_its_name_and_checked_by_its_content(
    tmp_path: Path, suffix: str, kind: str
) -> None:
    path = write(tmp_path / f"a{ {'.ndjson': '.geojsonl', '.kmz': '.kml'}.get(suffix, suffix) }", SQUARE)
    path = (zipped(tmp_path / "packed", path) if suffix == ".kmz" else path).rename(tmp_path / f"b{suffix}")
    assert clean_filename(path.name) == path.name
    found = examine(path, max_points=1)
    assert (found["kind"], found["format"], found["usable"]) == ("footprints", kind, True)
    path.write_bytes(b"\x00\x01 nothing of the kind")
    with pytest.raises(InputError):
        examine(path, max_points=1)


@pytest.mark.parametrize(
    ("name", "driver", "what"),
    [
        ("a.sqlite", "SQLite", "SQLite that is not a GeoPackage is not read"),
        ("a.tab", "MapInfo File", "MapInfo TAB is not read"),
        ("a.mif", "MapInfo File", "MapInfo MIF is not read"),
        ("a.json", "JSONFG", "JSON-FG is not read"),
    ],
)
def test_a_format_that_is_not_read_is_refused_with_the_fix_by_name_and_by_content(
    tmp_path: Path, name: str, driver: str, what: str
) -> None:
    gpd.GeoDataFrame({"id": ["1"]}, geometry=[SQUARE], crs="EPSG:28992").to_file(tmp_path / name, driver=driver)
    wanted = rf"{what}\. Convert it to GeoPackage \(\.gpkg\)"
    packed = zipped(tmp_path / "packed.zip", tmp_path / name)
    disguised = tmp_path / ("b.gpkg" if driver == "SQLite" else "b.geojson")
    disguised.write_bytes((tmp_path / name).read_bytes())
    for path in (packed, disguised):
        with pytest.raises(InputError, match=wanted):
            examine(path, max_points=1)
    if name != "a.json":
        with pytest.raises(RequestError, match=wanted):
            clean_filename(name)


def test_a_shapefile_alone_is_refused_with_the_way_to_send_it() -> None:
    with pytest.raises(RequestError, match=r"'houses\.shp' cannot be used: .* Send them in a zip archive"):
        clean_filename("houses.shp")


def test_an_archive_counts_as_what_is_in_it(tmp_path: Path) -> None:
    found = examine(zipped(tmp_path / "a.zip", *shapes_of(tmp_path / "s", "houses")), max_points=1)
    assert (found["format"], found["usable"]) == ("shapefile", True)
    found = examine(zipped(tmp_path / "b.zip", write(tmp_path / "a.gpkg", SQUARE)), max_points=1)
    assert (found["format"], found["featureCount"], found["crs"]["epsg"]) == ("geopackage", 1, 28992)


def test_what_is_refused_alone_is_refused_in_an_archive(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", SQUARE)
    with sqlite3.connect(path) as database:
        database.execute('ALTER TABLE "a" RENAME TO "b"')
        database.execute('CREATE VIEW "a" AS SELECT * FROM "b"')
    with pytest.raises(InputError, match="is a view or is not there") as caught:
        examine(zipped(tmp_path / "a.zip", path), max_points=1)
    assert caught.value.path == str(tmp_path / "a.zip")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match="a zip archive with 0 vector files"):
        examine(zipped(tmp_path / "b.zip", tmp_path / "a.txt"), max_points=1)
    (tmp_path / "a.laz").write_bytes(las_bytes(10))
    with pytest.raises(InputError, match="a zip archive of point clouds"):
        examine(zipped(tmp_path / "d.zip", tmp_path / "a.laz"), max_points=1)
    (tmp_path / "c.zip").write_bytes(b"PK\x03\x04 damaged")
    with pytest.raises(InputError, match="cannot be read as a zip archive"):
        examine(tmp_path / "c.zip", max_points=1)


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.geojson").write_text(" " * 100_000)
    path = zipped(tmp_path / "a.zip", tmp_path / "a.geojson")
    monkeypatch.setattr("service.vectors.GEOPACKAGE_LIMIT", 50_000)
    with pytest.raises(TooLargeError, match="unpacks to 100000 bytes"):
        examine(path, max_points=1)


@pytest.mark.parametrize("kind", ["geopackage", "zip"])
def test_an_upload_with_several_layers_lists_them_and_waits_for_a_name(tmp_path: Path, kind: str) -> None:
    if kind == "zip":
        files = (*shapes_of(tmp_path / "s", "houses"), *shapes_of(tmp_path / "s", "sheds"))
        path = zipped(tmp_path / "a.zip", *files)
    else:
        write(tmp_path / "a.gpkg", SQUARE, layer="houses")
        path = write(tmp_path / "a.gpkg", SQUARE, layer="sheds")
    found = examine(path, max_points=1)
    assert (found["format"], found["layers"], found["usable"]) == (kind, ["houses", "sheds"], False)
    wanted = "2 layers could be the footprints: give the input footprintsLayer, one of houses, sheds"
    assert found["problems"] == [wanted]


def test_footprints_by_value_get_the_ending_of_their_format(tmp_path: Path) -> None:
    import base64

    for suffix, ending in ((".fgb", ".fgb"), (".gml", ".gml"), (".gpkg", ".gpkg"), (".geojsonl", ".geojson")):
        content = write(tmp_path / f"a{suffix}", SQUARE).read_bytes()
        source = outlines({"value": base64.b64encode(content).decode(), "encoding": "base64"})
        assert source.filename == f"footprints{ending}"  # type: ignore[union-attr]


def test_requests_of_all_processes_carry_the_layer(tmp_path: Path) -> None:
    given = Fetched(reference=InputReference(kind="upload", value="g"), path=tmp_path / "a.gpkg", points=0, sha256=None)
    files, settings = JobFiles(tiles=[], footprints=given), ServiceSettings(state=tmp_path)
    request = JobRequest(tiles=(), methods=("arrangement", "kmeans"), footprints_layer="sheds")
    assert run_request(request, files, tmp_path / "out", settings).footprints_layer == "sheds"
    assert compare_request(request, files, tmp_path / "out", settings).run.footprints_layer == "sheds"
    assert classify_request(request, files, tmp_path / "out", settings).footprints_layer == "sheds"
    assert execute_request(request, "", 0).inputs["footprintsLayer"] == "sheds"
    assert JobRequest.from_dict(request.as_dict()) == request
    old = {name: value for name, value in request.as_dict().items() if name != "footprints_layer"}
    assert JobRequest.from_dict(old).footprints_layer is None


def test_the_input_is_checked_like_any_text() -> None:
    tiles = {"href": "/uploads/" + "1" * 32}
    both = {"tiles": tiles, "footprints": {"href": "/uploads/" + "2" * 32}}
    given = ReconstructInputs.model_validate({**both, "footprintsLayer": "sheds"})
    assert given.draft("reconstruct", None).values["footprints_layer"] == "sheds"
    with pytest.raises(ValueError, match="use no control characters"):
        ReconstructInputs.model_validate({**both, "footprintsLayer": "a\x00"})
    for inputs in (ReconstructInputs, ClassifyInputs, CompareInputs):
        with pytest.raises(ValueError, match="give footprints, or leave it out"):
            inputs.model_validate({"tiles": tiles, "footprintsLayer": "sheds", "footprints": None})


@pytest.fixture
def tile() -> dict[str, bytes]:
    """The content of the tile of a job, which a test may replace."""
    return {"content": las_bytes(2_000)}


@pytest.fixture
def driven(bench: Bench, tile: dict[str, bytes]) -> Bench:
    """A driver that runs the engine in its own process, on one tile and the footprints of the job."""

    def gather(request: JobRequest, *, target: Path, **_others: Any) -> JobFiles:
        target.mkdir(parents=True)
        (target / "tile.laz").write_bytes(tile["content"])
        points = Fetched(reference=request.tiles[0], path=target / "tile.laz", points=2_000, sha256=None)
        given = request.footprints
        found = None if given is None else Fetched(reference=given, path=Path(given.value), points=0, sha256=None)
        return JobFiles(tiles=[points], footprints=found)

    def run_here(request: RunRequest, on_event: Any, executor: Any, cancelled: Any) -> RunSummary:
        del executor
        return run(RunRequest(**{**vars(request), "resources": Resources(workers=0)}), on_event, None, cancelled)

    bench.tools |= {"gather": gather, "run": run_here}
    return bench


def test_a_job_models_the_layer_that_it_names(driven: Bench, tmp_path: Path) -> None:
    write(tmp_path / "a.gpkg", SQUARE, layer="houses")
    path = write(tmp_path / "a.gpkg", SQUARE, SQUARE.buffer(3.0), layer="sheds")
    given = InputReference(kind="path", value=str(path))
    job = driven.submit({"footprints": given, "footprints_layer": "houses"})
    driven.driver()
    done = driven.over(job)
    assert done.status is JobStatus.SUCCESSFUL, done.failure
    report = json.loads((driven.folder.run(job.job_id, 1) / "footprints.json").read_text())
    assert report["used"] == 1


@pytest.mark.parametrize("crs", ["EPSG:28992", "EPSG:4326"])
def test_footprints_off_the_data_fail_the_job_as_an_input_with_the_fix(driven: Bench, tmp_path: Path, crs: str) -> None:
    far = shapely.transform(SQUARE, lambda xy: xy + 5_000.0)
    given = InputReference(kind="path", value=str(write(tmp_path / "a.gpkg", far, crs=crs)))
    job = driven.submit({"footprints": given})
    driven.driver()
    done = driven.over(job)
    assert done.status is JobStatus.FAILED
    assert done.failure is not None
    assert done.failure.fault is Fault.INPUT
    fix = {
        "EPSG:28992": "the input bbox where they are given",
        "EPSG:4326": "GeoJSON without a member crs is in degrees",
    }
    assert fix[crs] in done.failure.detail
    assert "--" not in done.failure.detail
    assert str(tmp_path) not in done.failure.detail


def test_a_job_of_ground_points_alone_says_so_on_the_first_line_of_its_message(
    driven: Bench, tile: dict[str, bytes]
) -> None:
    las = laspy.read(io.BytesIO(tile["content"]))
    las.classification[:] = 2
    stream = io.BytesIO()
    las.write(stream, do_compress=True)
    tile["content"] = stream.getvalue()
    job = driven.submit()
    driven.driver()
    done = driven.over(job)
    assert done.status is JobStatus.SUCCESSFUL, done.failure
    first = "All 2000 points are of class 2 (ground), so none can be a roof: give the input classes ignore"
    assert done.message is not None
    assert done.message.startswith(first)
    assert done.summary is not None
    assert done.summary["headline"].lower() == done.summary["warnings"][0].lower()
