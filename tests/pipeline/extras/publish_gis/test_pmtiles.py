"""PMTiles: every column in the tiles as the reference says, buildings in their place, and a file that is whole."""

import base64
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pmtiles.reader as archive
import pyarrow as pa
import pyproj
import pytest
import shapely
from column_values import rows
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from small_runs import content, restated, write_run, write_whole_run
from vector_tile import Feature, layers_of

from pipeline.errors import RunError
from pipeline.export.columns import COLUMNS, KINDS, TILE_COLUMN, kind_of
from pipeline.export.geoparquet import read_table
from pipeline.export.projection import projection_to
from pipeline.extras.publish_gis import pmtiles
from pipeline.extras.publish_gis.pmtiles import publish_pmtiles

RD = {"wkt": pyproj.CRS.from_epsg(28992).to_wkt()}
BUILDINGS = {column.name: column for column in COLUMNS["buildings"]}
Tiles = dict[tuple[int, int, int], tuple[int, list[Feature]]]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished run of four buildings on two tiles in the Netherlands, one of them without a model."""
    run = write_whole_run(tmp_path / "run")
    restated(run, crs=RD)
    return run


def tiles_of(path: Path) -> Tiles:
    """Extent and features of each tile, by zoom, column and row, read without GDAL."""
    with path.open("rb") as file:
        found: Tiles = {}
        for place, data in archive.all_tiles(archive.MmapSource(file)):
            (layer,) = layers_of(gzip.decompress(data)).items()
            assert layer[0] == pmtiles.LAYER
            found[place] = layer[1]
        return found


def written(value: Any, name: str) -> Any:
    """A value as the reference says that the tiles have it, computed without the writer."""
    kind = kind_of(BUILDINGS[name].kind)
    if kind == "timestamp":
        return value.isoformat()
    return json.dumps(value, separators=(",", ":")) if kind == "list" else value


@settings(max_examples=examples(40), deadline=None)
@given(data=st.data())
def test_every_column_is_a_property_of_the_documented_type(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    schema = pa.schema([pa.field(name, BUILDINGS[name].kind) for name in pmtiles.READ])
    drawn = data.draw(st.lists(rows(schema, pmtiles.READ), max_size=4))
    drawn = [row | {"building_id": f"b{number}"} for number, row in enumerate(drawn)]
    batch = pa.RecordBatch.from_pylist(drawn, schema=schema)
    path = tmp_path_factory.mktemp("written") / "run.pmtiles"
    placed = {row["building_id"]: row for row in drawn if row["geometry"] is not None}
    batches = [pmtiles.map_batch(batch, "t1", lambda xy: xy)]
    if not placed:
        with pytest.raises(RunError, match="no building with a footprint"):
            pmtiles.write_pmtiles(path, batches, {})
        return
    assert pmtiles.write_pmtiles(path, batches, {}) == len(placed)
    found = {
        feature.properties["building_id"]: feature.properties
        for (zoom, _, _), (_, features) in tiles_of(path).items()
        if zoom == pmtiles.MAX_ZOOM
        for feature in features
    }
    assert found == {
        key: {name: written(value, name) for name, value in row.items() if value is not None and name != "geometry"}
        | {TILE_COLUMN.name: "t1"}
        for key, row in placed.items()
    }
    types = {"string": str, "bool": bool, "int": int, "double": int | float}
    for properties in found.values():
        for name in properties.keys() - {TILE_COLUMN.name}:
            kind = KINDS[kind_of(BUILDINGS[name].kind)].pmtiles.split(",")[0]
            assert isinstance(properties[name], types[kind]), name


def test_elevations_are_in_metres_and_heights_stay() -> None:
    schema = pa.schema([pa.field(name, BUILDINGS[name].kind) for name in pmtiles.READ])
    known = {"geometry": shapely.to_wkb(shapely.box(0, 0, 9, 9)), "ridge_z": 1000.0, "ground_z": None, "height_m": 5.0}
    batch = pa.RecordBatch.from_pylist([dict.fromkeys(schema.names) | known], schema=schema)
    (row,) = pmtiles.map_batch(batch, "t", lambda xy: xy, 1200.0 / 3937.0).to_pylist()
    assert (row["ridge_z"], row["ground_z"], row["height_m"]) == (304.801, None, 5.0)


def test_all_columns_are_there_or_left_out_by_name() -> None:
    missing = {name for name in BUILDINGS if name not in pmtiles.READ}
    shapes = {name for name in missing if name.startswith("solid") or name in {"wall_outline", "boxes"}}
    assert missing - shapes == set(pmtiles.LEFT_OUT)
    assert set(pmtiles.SCHEMA.names) == {*pmtiles.READ, "tile"}


def test_buildings_lie_where_they_are_at_each_zoom(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "run.pmtiles"
    before = content(run_dir)
    published = publish_pmtiles(str(run_dir), str(out))
    assert content(run_dir) == before
    assert list(out.parent.iterdir()) == [out]
    table = read_table(str(run_dir), "buildings").to_pylist()
    shapes = {row["building_id"]: shapely.from_wkb(row["geometry"]) for row in table if row["geometry"]}
    assert (published.place, published.rows) == (str(out), {"buildings": len(shapes)})
    assert published.size_bytes == out.stat().st_size
    to_map = pyproj.Transformer.from_crs(28992, 3857, always_xy=True).transform
    expected = {key: shapely.transform(shape, to_map, interleaved=False) for key, shape in shapes.items()}
    world_m = 2 * np.pi * 6378137.0
    places = tiles_of(out)
    assert {zoom for zoom, _, _ in places} == set(range(pmtiles.MIN_ZOOM, pmtiles.MAX_ZOOM + 1))
    for (zoom, column, row), (extent, features) in places.items():
        side_m = world_m / 2**zoom
        corner = (column * side_m - world_m / 2, world_m / 2 - (row + 1) * side_m)
        window = shapely.box(*corner, corner[0] + side_m, corner[1] + side_m)
        assert {one.properties["building_id"] for one in features} >= {
            key for key, shape in expected.items() if window.contains(shape)
        }
        for feature in features:
            shape = expected[feature.properties["building_id"]]
            unit_m = side_m / extent
            if window.contains(shape):
                assert abs(feature.area * unit_m**2 - shape.area) <= 2 * unit_m * shape.length


def test_coordinates_are_easting_first_whatever_the_axes_of_the_crs() -> None:
    # Gauss-Kruger states northing first, here with heights
    crs = pyproj.crs.CompoundCRS("GK", [pyproj.CRS.from_epsg(31468), pyproj.CRS.from_epsg(7837)])
    munich = projection_to({"wkt": crs.to_wkt()}, "OGC:CRS84")(np.array([[4468000.0, 5333000.0]]))
    assert munich[0] == pytest.approx((11.57, 48.14), abs=0.02)


def test_header_and_metadata_lead_a_map_to_the_data(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.pmtiles"
    restated(run_dir, source_licence="CC-BY-4.0")
    publish_pmtiles(str(run_dir), str(out))
    with out.open("rb") as file:
        reader = archive.Reader(archive.MmapSource(file))
        header, metadata = reader.header(), reader.metadata()
    to_degrees = projection_to(RD, "OGC:CRS84")
    footprints = read_table(str(run_dir), "buildings")["geometry"].drop_null().to_pylist()
    bounds = shapely.total_bounds(shapely.transform(shapely.from_wkb(footprints), to_degrees)) * 1e7
    stated = [
        header[f"{side}_{axis}_e7"] for side, axis in (("min", "lon"), ("min", "lat"), ("max", "lon"), ("max", "lat"))
    ]
    assert stated == pytest.approx(bounds, abs=10)
    assert "source_licence: CC-BY-4.0" in metadata["description"]
    (layer,) = metadata["vector_layers"]
    assert layer["id"] == "buildings"
    assert set(layer["fields"]) == set(pmtiles.SCHEMA.names) - {"geometry"}


def test_of_too_many_buildings_the_largest_stay_and_the_last_zoom_has_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pmtiles, "MAX_BUILDINGS", 5)
    empty: dict[str, Any] = dict.fromkeys(pmtiles.READ)
    drawn = [
        empty | {"building_id": f"b{number}", "geometry": shapely.box(x, x, x + 5 + number, x + 9).wkb}
        for number, x in enumerate(range(10_000, 18_000, 400))
    ]
    schema = pa.schema([pa.field(name, BUILDINGS[name].kind) for name in pmtiles.READ])
    batch = pmtiles.map_batch(pa.RecordBatch.from_pylist(drawn, schema=schema), "t", lambda xy: xy)
    pmtiles.write_pmtiles(tmp_path / "run.pmtiles", [batch], {})
    places = tiles_of(tmp_path / "run.pmtiles")
    at: dict[int, set[str]] = {zoom: set() for zoom, _, _ in places}
    for (zoom, _, _), (extent, features) in places.items():
        assert (extent, len(features) <= 5) == (4096, True)
        at[zoom] |= {one.properties["building_id"] for one in features}
    assert "b19" in at[pmtiles.MIN_ZOOM]
    assert "b0" not in at[pmtiles.MIN_ZOOM]
    assert len(at[pmtiles.MAX_ZOOM]) == 20


def test_long_attributes_do_not_make_coordinates_coarse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pmtiles, "MIN_ZOOM", pmtiles.MAX_ZOOM)
    # random words, since the limit is on compressed bytes
    text = base64.b64encode(np.random.default_rng(7).bytes(60_000)).decode()
    empty: dict[str, Any] = dict.fromkeys(pmtiles.READ)
    drawn = [
        empty | {"building_id": f"b{n}", "geometry": shapely.box(n, 0, n + 9, 9).wkb, "source_attributes": text[n:]}
        for n in range(100, 200)
    ]
    schema = pa.schema([pa.field(name, BUILDINGS[name].kind) for name in pmtiles.READ])
    batch = pmtiles.map_batch(pa.RecordBatch.from_pylist(drawn, schema=schema), "t", lambda xy: xy)
    pmtiles.write_pmtiles(tmp_path / "run.pmtiles", [batch], {})
    places = tiles_of(tmp_path / "run.pmtiles")
    assert max(len(features) for _, features in places.values()) == 100
    assert {extent for extent, _ in places.values()} == {4096}


def test_a_run_without_a_crs_is_refused(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.pmtiles"
    for crs in (None, {"wkt": None}):
        restated(run_dir, crs=crs)
        with pytest.raises(RunError, match=r"the CRS of the run is unknown.*--crs"):
            publish_pmtiles(str(run_dir), str(out))
    assert not out.exists()


def test_a_run_without_buildings_is_refused(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", [])
    restated(run_dir, crs=RD)
    with pytest.raises(RunError, match="no building with a footprint"):
        publish_pmtiles(str(run_dir), str(tmp_path / "run.pmtiles"))
    assert list(tmp_path.iterdir()) == [run_dir]
