"""STAC: a valid catalogue whose files, places and times are those of the run."""

import dataclasses
import datetime as dt
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pystac
import pytest
import shapely
from pystac.extensions.pointcloud import PointcloudExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.table import TableExtension
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from small_runs import content, restated, write_run, write_whole_run

from pipeline.errors import RunError
from pipeline.export.columns import COLUMNS
from pipeline.export.geoparquet import read_table
from pipeline.export.projection import Project, projection_to
from pipeline.extras.publish_stac import stac
from pipeline.extras.publish_stac.stac import publish_stac
from pipeline.io import storage_at
from pipeline.runtime.manifest import InputFile, PointFileFacts, RunManifest, RunStatus

RD = {"wkt": pyproj.CRS.from_epsg(7415).to_wkt(), "epsg": 7415, "horizontal_unit_m": 1.0, "vertical_unit_m": 1.0}
MADE = dt.datetime(2026, 1, 1, 2, tzinfo=dt.UTC)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished run of four buildings on two tiles in the Netherlands."""
    run = write_whole_run(tmp_path / "my models")
    restated(run, crs=RD, finished_at=MADE, source_licence="CC-BY-4.0", tiles=("t1", "t2"))
    return run


def catalogued(project: Project = lambda xy: xy) -> stac.Run:
    """A run whose places are degrees."""
    manifest = RunManifest(
        status=RunStatus.FINISHED,
        engine_version="1",
        method="m",
        settings={},
        settings_hash="",
        started_at=MADE,
        finished_at=MADE,
        crs=RD,
    )
    return stac.Run(name="r", manifest=manifest, project=project)


def validated(path: Path) -> dict[str, Any]:
    """A Collection or Item that meets the schema of the core, which pystac brings; nothing is fetched."""
    document: dict[str, Any] = json.loads(path.read_text())
    kind = pystac.STACObjectType.COLLECTION if document["type"] == "Collection" else pystac.STACObjectType.ITEM
    assert document["stac_version"] == "1.1.0"
    assert JsonSchemaSTACValidator().validate_core(document, kind, "1.1.0", str(path))
    return document


def test_the_catalogue_is_valid_and_its_links_lead_somewhere(run_dir: Path, tmp_path: Path) -> None:
    before, out = content(run_dir), tmp_path / "new" / "catalogue"
    published = publish_stac(str(run_dir), str(out))
    assert content(run_dir) == before
    assert set(content(out)) == {"collection.json", "t1/t1.json", "t2/t2.json"}
    assert (published.place, published.rows) == (str(out), {"items": 2, "points": 0})
    assert published.size_bytes == sum(map(len, content(out).values()))
    assert list(out.parent.iterdir()) == [out]
    for name in content(out):
        validated(out / name)
    collection = pystac.Collection.from_file(str(out / "collection.json"))
    assert (collection.id, collection.license) == ("my models", "CC-BY-4.0")
    items = list(collection.get_items())
    assert [item.id for item in items] == ["t1", "t2"]
    assert all(item.get_collection() is collection for item in items)


def test_assets_are_the_files_of_the_run_with_their_digests(run_dir: Path, tmp_path: Path) -> None:
    publish_stac(str(run_dir), str(tmp_path / "out"))
    for tile in ("t1", "t2"):
        path = tmp_path / "out" / tile / f"{tile}.json"
        item = pystac.Item.from_file(str(path))
        assert set(item.assets) == {"buildings", "planes", "rejected", "decisions", "cityjson"}
        for name, asset in item.assets.items():
            assert "my%20models" in asset.href
            data = Path(pystac.utils.make_absolute_href(asset.href, str(path)).replace("%20", " ")).read_bytes()
            assert asset.extra_fields["file:checksum"] == f"1220{hashlib.sha256(data).hexdigest()}"
            assert (data[:4] == b"PAR1") == (asset.media_type == "application/vnd.apache.parquet")
            if name in {"buildings", "rejected"}:
                rows = read_table(str(run_dir), name)["tile"].to_pylist().count(tile)
                assert asset.extra_fields["table:row_count"] == rows


def test_places_cover_the_buildings(run_dir: Path, tmp_path: Path) -> None:
    publish_stac(str(run_dir), str(tmp_path / "out"))
    collection = pystac.Collection.from_file(str(tmp_path / "out" / "collection.json"))
    to_degrees = pyproj.Transformer.from_crs(28992, "OGC:CRS84", always_xy=True).transform
    table = read_table(str(run_dir), "buildings").to_pylist()
    for item in collection.get_items():
        assert item.geometry is not None
        assert item.bbox == pytest.approx(shapely.bounds(shapely.geometry.shape(item.geometry)), abs=2e-7)
        inside = [shapely.from_wkb(row["geometry"]) for row in table if row["tile"] == item.id and row["geometry"]]
        shown = shapely.transform(inside, to_degrees, interleaved=False)
        assert shapely.covers(shapely.buffer(shapely.geometry.shape(item.geometry), 1e-6), shown).all()
        projection = ProjectionExtension.ext(item)
        assert (projection.code, projection.wkt2) == ("EPSG:7415", RD["wkt"])
        assert projection.bbox is not None
        assert shapely.covers(shapely.box(*projection.bbox), inside).all()
    boxes = np.array([item.bbox for item in collection.get_items()])
    assert collection.extent.spatial.bboxes == [[*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0)]]


def test_times_are_those_of_the_points_and_else_that_of_the_run(run_dir: Path, tmp_path: Path) -> None:
    publish_stac(str(run_dir), str(tmp_path / "out"))
    unknown = pystac.Item.from_file(str(tmp_path / "out" / "t1" / "t1.json"))
    assert (unknown.datetime, unknown.properties["processing:datetime"]) == (MADE, "2026-01-01T02:00:00Z")
    start, end = dt.datetime(2020, 5, 1, tzinfo=dt.UTC), dt.datetime(2020, 5, 2, 1, 2, 3, 4, tzinfo=dt.UTC)
    run = catalogued()
    tile = stac.TileFacts(key="t", files={}, bounds=(0.0, 0.0, 1.0, 1.0), acquired=(start, end), rows={})
    known = stac.item(tile, run, "")["properties"]
    assert (known["datetime"], known["start_datetime"]) == (None, "2020-05-01T00:00:00Z")
    assert known["end_datetime"] == "2020-05-02T01:02:03.000004Z"
    later = stac.item(tile, run, "") | {"id": "u"}
    collection = stac.collection(run, [later], [], "")
    assert collection["extent"]["temporal"]["interval"] == [[known["start_datetime"], known["end_datetime"]]]
    bare = dataclasses.replace(tile, acquired=None)
    earlier = dataclasses.replace(tile, acquired=(start - dt.timedelta(days=1), start))
    assert [one.acquired for one in stac.dated([tile, bare, earlier])] == [
        (start, end),
        (start - dt.timedelta(days=1), end),
        (start - dt.timedelta(days=1), start),
    ]
    assert stac.dated([bare]) == [bare]


def test_times_are_compared_as_times_not_as_texts() -> None:
    """As a text, half a second after comes before."""
    at = ("2020-05-01T00:00:00Z", "2020-05-01T00:00:00.500000Z")
    items = [{"id": text, "bbox": [0.0, 0.0, 1.0, 1.0], "properties": {"datetime": text}} for text in at]
    run = catalogued()
    assert stac.collection(run, items, [], "")["extent"]["temporal"]["interval"] == [list(at)]


def test_a_catalogue_of_another_run_is_kept_and_other_files_do_not_matter(run_dir: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "out", write_whole_run(tmp_path / "other" / "my models")
    restated(other, crs=RD, finished_at=MADE, tiles=("t1", "t2"))
    (out / "models").mkdir(parents=True)
    (out / "models" / "run.json").write_text("{}")
    publish_stac(str(run_dir), str(out))
    before = content(out)
    with pytest.raises(RunError, match=r"collection\.json is of another run or catalogue"):
        publish_stac(str(other), str(out), overwrite=True)
    (out / "collection.json").write_text("[]")
    with pytest.raises(RunError, match="another run or catalogue"):
        publish_stac(str(run_dir), str(out), overwrite=True)
    assert {**content(out), "collection.json": b""} == {**before, "collection.json": b""}


def test_a_file_where_a_folder_must_be_is_kept(run_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "t2").write_text("mine")
    with pytest.raises(RunError, match="t2 is a file, where a folder must be"):
        publish_stac(str(run_dir), str(tmp_path / "out"))
    assert content(tmp_path / "out") == {"t2": b"mine"}


def test_a_place_that_is_not_on_the_earth_is_refused(run_dir: Path, tmp_path: Path) -> None:
    local = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    restated(run_dir, crs={**RD, "wkt": local, "epsg": None})
    with pytest.raises(RunError, match=r"has no place on the earth.*--crs"):
        publish_stac(str(run_dir), str(tmp_path / "out"))
    project = projection_to({"wkt": pyproj.CRS.from_epsg(32631).to_wkt()}, stac.CRS)
    with pytest.raises(RunError, match=r"1000000000000000, 5 lies outside the CRS.*--crs"):
        project(np.array([(500_000.0, 5e6), (1e15, 5.0)]))


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("size", [0.0, 1e-9, 3e-8, 1e-3])
def test_rings_are_counterclockwise_and_never_empty(flip: float, size: float) -> None:
    tile = stac.TileFacts(key="t", files={}, bounds=(5.0, 50.0, 5.0 + size, 50.0), acquired=None, rows={})
    item = stac.item(tile, catalogued(lambda xy: xy * (flip, 1.0)), "")
    place = shapely.geometry.shape(item["geometry"])
    assert place.is_valid
    assert place.area > 0.0
    assert place.exterior.is_ccw
    assert item["bbox"] == list(place.bounds)


def test_a_tile_across_180_deg_is_split_there() -> None:
    run = catalogued(lambda xy: np.where(xy > 180.0, xy - 360.0, xy))
    items = []
    for west, east in ((179.5, 180.25), (180.0, 180.5), (179.0, 179.5)):
        tile = stac.TileFacts(key="t", files={}, bounds=(west, -17.0, east, -16.0), acquired=None, rows={})
        items.append(stac.item(tile, run, ""))
    assert items[0]["bbox"] == [179.5, -17.0, -179.75, -16.0]
    parts = shapely.geometry.shape(items[0]["geometry"]).geoms
    assert [part.bounds for part in parts] == [(179.5, -17.0, 180.0, -16.0), (-180.0, -17.0, -179.75, -16.0)]
    assert all(part.exterior.is_ccw for part in parts)
    assert shapely.geometry.shape(items[1]["geometry"]).bounds == (-180.0, -17.0, -179.5, -16.0)
    extent = stac.collection(run, items, [], "")["extent"]["spatial"]["bbox"]
    assert extent == [[179.0, -17.0, -179.5, -16.0]]


@pytest.mark.parametrize(
    ("licence", "stated", "link"),
    [
        (None, "other", None),
        ("etalab-2.0", "etalab-2.0", None),
        ("free for research", "other", None),
        ("https://example.org/licence", "other", "https://example.org/licence"),
    ],
)
def test_a_licence_in_other_words_is_other_and_stays_readable(
    run_dir: Path, tmp_path: Path, licence: str | None, stated: str, link: str | None
) -> None:
    restated(run_dir, source_licence=licence)
    publish_stac(str(run_dir), str(tmp_path / "out"))
    document = validated(tmp_path / "out" / "collection.json")
    assert document["license"] == stated
    assert (licence or "unknown") in document["description"]
    assert next((one["href"] for one in document["links"] if one["rel"] == "license"), None) == link


def test_the_collection_describes_every_column(run_dir: Path, tmp_path: Path) -> None:
    publish_stac(str(run_dir), str(tmp_path / "out"))
    collection = pystac.Collection.from_file(str(tmp_path / "out" / "collection.json"))
    assert collection.assets["run"].href.endswith("my%20models/run.json")
    assert TableExtension.has_extension(collection)
    for table, columns in COLUMNS.items():
        described = collection.item_assets[table].properties["table:columns"]
        assert [(one["name"], one["description"]) for one in described] == [(one.name, one.comment) for one in columns]


def test_meshes_of_whole_tiles_are_assets(run_dir: Path, tmp_path: Path) -> None:
    storage = storage_at(run_dir)
    state = json.loads(storage.get("state/t1.json"))
    lods = ("12", "13", "20", "23")
    for name in ("meshes/t1/t1.glb", "meshes/t1/abc.obj", *(f"meshes/t1/t1-lod{lod}.glb" for lod in lods)):
        storage.put(name, b"x")
        state["files"][name] = "0" * 64
    storage.put("state/t1.json", json.dumps(state).encode())
    publish_stac(str(run_dir), str(tmp_path / "out"))
    assets = validated(tmp_path / "out" / "t1" / "t1.json")["assets"]
    assert {name: one["type"] for name, one in assets.items() if "mesh" in name} == {
        "mesh": "model/gltf-binary",
        **{f"mesh-lod{lod}": "model/gltf-binary" for lod in lods},
    }


def test_a_catalogue_is_replaced_only_where_asked_and_never_another_one(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish_stac(str(run_dir), str(out))
    (out / "notes.txt").write_text("mine")
    before = content(out)
    with pytest.raises(RunError, match=r"holds collection\.json already.*--overwrite"):
        publish_stac(str(run_dir), str(out))
    (out / "t1" / "t1.json").write_text("of before")
    publish_stac(str(run_dir), str(out), overwrite=True)
    assert content(out) == before
    (out / "t9").mkdir()
    (out / "t9" / "t9.json").write_text("{}")
    with pytest.raises(RunError, match=r"holds t9/t9\.json, which is not of this run"):
        publish_stac(str(run_dir), str(out), overwrite=True)


def test_what_cannot_be_listed_is_refused(run_dir: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    restated(run_dir, crs=None)
    with pytest.raises(RunError, match="the CRS of the run is unknown"):
        publish_stac(str(run_dir), out)
    without_states = write_run(tmp_path / "run", [])
    restated(without_states, crs=RD)
    with pytest.raises(RunError, match="no tile with files"):
        publish_stac(str(without_states), out)
    assert not (tmp_path / "out").exists()


def test_a_tile_without_objects_is_its_square(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [])
    files = {"buildings/tile=x1_y2/part-0.parquet": "0" * 64, "rejected/tile=x1_y2/part-0.parquet": "0" * 64}
    for name in files:
        storage_at(run).put(name, (run / name.replace("x1_y2", "t2")).read_bytes())
    storage_at(run).put("state/x1_y2.json", json.dumps({"tile": "x1_y2", "state": "done", "files": files}).encode())
    restated(run, crs=RD, lattice={"tile_size_m": 500.0, "origin_x_m": 0.0, "origin_y_m": 0.0})
    publish_stac(str(run), str(tmp_path / "out"))
    item = validated(tmp_path / "out" / "x1_y2" / "x1_y2.json")
    assert item["properties"]["proj:bbox"] == [500.0, 1000.0, 1000.0, 1500.0]


def _input(path: str, **changes: Any) -> InputFile:
    """An input of 1000 points, of which the run took 900 in the western half."""
    file = PointFileFacts(
        format=changes.pop("format", "laz"),
        n_points=1000,
        bounds_m=changes.pop("whole_m", (84_950.0, 446_950.0, 85_150.0, 447_050.0)),
        acquired=changes.pop("acquired", (MADE - dt.timedelta(days=2), MADE - dt.timedelta(days=1))),
        dimensions={"X": "i4", "classification": "u1", "gps_time": "f8"},
    )
    taken_m = changes.pop("taken_m", (84_950.0, 446_950.0, 85_050.0, 447_050.0))
    found = InputFile(path=path, sha256="ab" * 32, size_bytes=12, n_points=900, bounds_m=taken_m, file=file)
    return dataclasses.replace(found, **changes)


def test_the_points_are_a_collection_of_their_own_with_the_counts_of_the_files(run_dir: Path, tmp_path: Path) -> None:
    elsewhere = _input("/data/b/tile.laz", sha256="cd" * 32, taken_m=(0.0, 0.0, 1.0, 1.0), acquired=None)
    without_points = _input("/data/c.laz", sha256="ef" * 32, bounds_m=None, n_points=0)
    outlines = InputFile(path="/data/outlines.gpkg", sha256="0" * 64, size_bytes=3)
    restated(run_dir, inputs=(_input("/data/a/my tile.laz"), elsewhere, without_points, outlines))
    published = publish_stac(str(run_dir), str(tmp_path / "out"))
    assert published.rows == {"items": 2, "points": 2}
    names = {"points/collection.json", "points/my_tile-abababab.json", "points/tile-cdcdcdcd.json"}
    assert {name for name in content(tmp_path / "out") if name.startswith("points")} == names
    for name in names:
        assert "/data" not in (tmp_path / "out" / name).read_text()
        validated(tmp_path / "out" / name)
    collection = pystac.Collection.from_file(str(tmp_path / "out" / "collection.json"))
    (points,) = collection.get_children()
    first, second = points.get_items()
    assert (points.id, first.get_root(), first.get_parent(), first.assets) == (
        "my models-points",
        collection,
        points,
        {},
    )
    cloud = PointcloudExtension.ext(first)
    assert (cloud.count, cloud.type, cloud.encoding, cloud.density) == (1000, "lidar", "LASzip", 0.05)
    assert [(one.name, one.size, one.type) for one in cloud.schemas] == [
        ("X", 4, "signed"),
        ("classification", 1, "unsigned"),
        ("gps_time", 8, "floating"),
    ]
    assert ProjectionExtension.ext(first).bbox == [84_950.0, 446_950.0, 85_150.0, 447_050.0]
    assert (first.common_metadata.start_datetime, first.datetime) == (MADE - dt.timedelta(days=2), None)
    assert second.datetime == MADE
    assert first.properties["description"] == f"The file my tile.laz, 12 bytes, sha256 {'ab' * 32}"
    sources = {
        item.id: [link.get_absolute_href() for link in item.get_links("derived_from")]
        for item in collection.get_items()
    }
    assert sources["t1"] == [str(tmp_path / "out" / "points" / "my_tile-abababab.json")]


@pytest.mark.parametrize(("form", "has_digest"), [("laz", True), ("copc", False)])
def test_points_with_an_address_are_an_asset(run_dir: Path, tmp_path: Path, form: str, has_digest: bool) -> None:
    """A window of a remote COPC is read by its nodes, so the digest is not that of the file."""
    restated(run_dir, inputs=(_input("https://example.org/a/tile.laz", format=form),))
    publish_stac(str(run_dir), str(tmp_path / "out"))
    document = validated(tmp_path / "out" / "points" / "tile-abababab.json")
    asset = document["assets"]["points"]
    assert (asset["href"], asset["file:size"]) == ("https://example.org/a/tile.laz", 12)
    assert ("file:checksum" in asset, "sha256" in document["properties"]["description"]) == (has_digest, has_digest)
    assert stac.FILE in document["stac_extensions"]


def test_points_without_an_area_have_no_density(run_dir: Path, tmp_path: Path) -> None:
    restated(run_dir, inputs=(_input("tile.laz", whole_m=(84_950.0, 446_950.0, 84_950.0, 447_050.0)),))
    publish_stac(str(run_dir), str(tmp_path / "out"))
    assert "pc:density" not in validated(tmp_path / "out" / "points" / "tile-abababab.json")["properties"]


def test_the_points_of_another_run_are_kept(run_dir: Path, tmp_path: Path) -> None:
    restated(run_dir, inputs=(_input("tile.laz"),))
    publish_stac(str(run_dir), str(tmp_path / "out"))
    restated(run_dir, inputs=(_input("tile.laz", sha256="cd" * 32),))
    with pytest.raises(RunError, match=r"holds points/tile-abababab\.json, which is not of this run"):
        publish_stac(str(run_dir), str(tmp_path / "out"), overwrite=True)
