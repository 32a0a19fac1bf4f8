"""GeoPackage: every column reads back as the documented types say, with its CRS and with styles that QGIS finds."""

import dataclasses
import datetime as dt
import json
import sqlite3
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyogrio
import pyproj
import pytest
import shapely
from column_values import rows
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import RunError
from pipeline.export.columns import COLUMNS, HORIZONTAL, KINDS, TILE_COLUMN, VERTICAL, kind_of
from pipeline.export.solid_geometry import SOLID_COLUMNS
from pipeline.extras.publish_gis.geopackage import (
    GEOMETRY,
    LAYERS,
    STYLES,
    TILE,
    GeoPackage,
    Layer,
    stored_batch,
    stored_field,
)
from pipeline.extras.publish_gis.qml import STYLES as ALL_STYLES
from pipeline.model import Reason, Status
from pipeline.terrain.candidates import REASON_OF_FAULT

AT = dt.datetime(2026, 1, 2, 3, 4, 5, 678_901, tzinfo=dt.UTC)
COMPOUND = pyproj.CRS.from_epsg(7415)
BY_NAME = {layer.name: layer for layer in LAYERS}


def written(path: Path, layer: Layer, *tables: pa.Table, wkt: str | None = None) -> Path:
    """A GeoPackage with one layer, a tile per table."""
    batches = (
        stored_batch(batch, layer, f"t{number}")
        for number, table in enumerate(tables)
        for batch in table.select(layer.columns).to_batches()
    )
    assert package(path, wkt).write(layer, batches) == sum(table.num_rows for table in tables)
    return path


def package(path: Path, wkt: str | None = None) -> GeoPackage:
    return GeoPackage(path=path, wkt=wkt, at=AT, facts={"method": "arrangement"})


@st.composite
def tables(draw: st.DrawFn, layer: Layer) -> pa.Table:
    """A table with every column of a layer's table."""
    row = rows(layer.table, layer.columns, has_z=(layer.geometry_type or "").endswith("Z"))
    schema = pa.schema([layer.table.field(name) for name in layer.columns])
    return pa.Table.from_pylist(draw(st.lists(row, max_size=4)), schema=schema)


def expected(value: Any, field: pa.Field) -> Any:
    """A value as the documents say that it is stored, computed without the writer."""
    if value is None:
        return None
    if field.name == GEOMETRY:
        shape = shapely.from_wkb(value)
        return shapely.MultiPolygon([shape]) if shape.geom_type == "Polygon" else shape
    if pa.types.is_timestamp(field.type):
        return value.replace(microsecond=value.microsecond // 1000 * 1000)
    return value


def found(value: Any, field: pa.Field) -> Any:
    """A value of the file as Python has it: texts of lists parsed, geometries decoded."""
    if value is None:
        return None
    if field.name == GEOMETRY:
        return shapely.from_wkb(value)
    return json.loads(value) if pa.types.is_list(field.type) else value


def is_same(one: Any, other: Any) -> bool:
    """Equal to the last bit, coordinates too; SQLite has one zero, as the records have."""
    if isinstance(one, shapely.Geometry) and isinstance(other, shapely.Geometry):
        return one.has_z == other.has_z and shapely.equals_exact(one, other, 0.0)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("name", BY_NAME)
@settings(max_examples=examples(40), deadline=None)
@given(data=st.data())
def test_every_column_reads_back_as_the_documented_types_say(
    name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    layer = BY_NAME[name]
    drawn = [data.draw(tables(layer)) for _ in range(data.draw(st.integers(1, 3)))]
    path = written(tmp_path_factory.mktemp("written") / "run.gpkg", layer, *drawn, wkt=COMPOUND.to_wkt())
    _, read = pyogrio.read_arrow(path, layer=name)
    assert set(read.column_names) == {*layer.table.names, TILE} - set(SOLID_COLUMNS)
    assert read[TILE].to_pylist() == [f"t{number}" for number, table in enumerate(drawn) for _ in range(len(table))]
    for column in layer.columns:
        field = layer.table.field(column)
        before = [value for table in drawn for value in table[column].to_pylist()]
        for one, other in zip(before, read[column].to_pylist(), strict=True):
            assert is_same(expected(one, field), found(other, field)), (column, one, other)


def test_the_file_has_the_documented_types_and_says_what_each_column_means(tmp_path: Path) -> None:
    for layer in LAYERS:
        path = written(tmp_path / f"{layer.name}.gpkg", layer, layer.table.empty_table())
        with sqlite3.connect(path) as file:
            columns = {row[1]: row[2] for row in file.execute(f'PRAGMA table_info("{layer.name}")')}
            comments = dict(file.execute("SELECT column_name, description FROM gpkg_data_columns"))
        for name in set(layer.columns) - {GEOMETRY}:
            assert columns[name] == KINDS[kind_of(layer.table.field(name).type)].geopackage, name
        meant = {one.name: one.comment for one in (*COLUMNS[layer.name], TILE_COLUMN)}
        assert comments == {name: meant[name] for name in (*layer.columns, TILE) if name != GEOMETRY}


def test_comments_name_the_units_of_the_run_s_crs(tmp_path: Path) -> None:
    layer = BY_NAME["planes"]
    units = {HORIZONTAL: "metre", VERTICAL: "US survey foot"}
    made = dataclasses.replace(package(tmp_path / "a.gpkg"), units=units)
    made.write(layer, [stored_batch(batch, layer, "t") for batch in layer.table.empty_table().to_batches()])
    with sqlite3.connect(tmp_path / "a.gpkg") as file:
        comments = dict(file.execute("SELECT column_name, description FROM gpkg_data_columns"))
    assert comments["origin_z"] == "elevation of the local origin [US survey foot]"
    assert comments["origin_x"] == "easting of the local origin [metre]"
    assert comments["rmse_m"].endswith("[m]")


def test_a_column_that_no_type_can_hold_is_refused_by_name() -> None:
    with pytest.raises(RunError, match=r"column age has type uint64.*add it to the mapping"):
        stored_field(pa.field("age", pa.uint64()))


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.name)
def test_a_compound_crs_stays_whole_and_an_unknown_one_unknown(tmp_path: Path, layer: Layer) -> None:
    # of no code as a whole: ETRS89 / UTM 32N with heights of DHHN2016
    uncoded = pyproj.crs.CompoundCRS("uncoded", [pyproj.CRS.from_epsg(25832), pyproj.CRS.from_epsg(7837)])
    for number, crs in enumerate([COMPOUND, uncoded, None]):
        wkt = None if crs is None else crs.to_wkt()
        path = written(tmp_path / f"{number}.gpkg", layer, layer.table.empty_table(), wkt=wkt)
        info = pyogrio.read_info(path, layer=layer.name)
        assert info["geometry_type"] == layer.geometry_type
        if crs is None or layer.geometry_type is None:
            assert info["crs"] is None
            continue
        read = pyproj.CRS(info["crs"])
        assert [part.to_epsg() for part in read.sub_crs_list] == [part.to_epsg() for part in crs.sub_crs_list]


def test_an_error_of_the_rows_is_raised_as_it_is_and_gdal_is_left_as_it_was(tmp_path: Path) -> None:
    layer = BY_NAME["rejected"]
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")

    def batches() -> Iterator[pa.RecordBatch]:
        yield from ()
        raise KeyError("lost on the way")

    with pytest.raises(KeyError, match="lost on the way"):
        package(tmp_path / "run.gpkg").write(layer, batches())
    assert pyogrio.get_gdal_config_option("OGR_CURRENT_DATE") == before


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    layer = BY_NAME["rejected"]
    with pytest.raises(RunError, match=r"layer rejected cannot be written to run\.gpkg: .*--out"):
        package(tmp_path / "no" / "run.gpkg").write(layer, [])


# --- styles ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def styled(tmp_path: Path) -> sqlite3.Connection:
    """A file with all layers, without rows, and their styles."""
    file = package(tmp_path / "run.gpkg", COMPOUND.to_wkt())
    for layer in LAYERS:
        file.write(layer, [])
    file.write_styles(ALL_STYLES)
    connection = sqlite3.connect(file.path)
    connection.row_factory = sqlite3.Row
    return connection


def test_qgis_finds_a_default_style_of_each_layer_with_geometry(styled: sqlite3.Connection) -> None:
    # the query of QGIS 3.22 to 3.34 (its OGR provider): a column of another name, and no style is found
    query = (
        f"SELECT styleName, styleQML, useAsDefault FROM {STYLES} WHERE f_table_schema='' AND f_table_name=? "
        "AND f_geometry_column=? ORDER BY CASE WHEN useAsDefault THEN 1 ELSE 2 END, update_time DESC LIMIT 1"
    )
    geometries = styled.execute("SELECT table_name, column_name FROM gpkg_geometry_columns").fetchall()
    assert {row["table_name"] for row in geometries} == {layer.name for layer in LAYERS if layer.geometry_type}
    for table, column in geometries:
        style = styled.execute(query, (table, column)).fetchone()
        assert style["useAsDefault"], table
        assert style["styleName"] == {"buildings": "status", "planes": "slope", "rejected": "reason"}[table]
    kinds = dict(styled.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall())
    assert kinds[STYLES] == kinds["decisions"] == "attributes"


def test_each_style_is_xml_over_a_column_that_exists_and_has_the_symbols_of_its_classes(
    styled: sqlite3.Connection,
) -> None:
    rows = styled.execute(f"SELECT * FROM {STYLES}").fetchall()
    assert len(rows) == len(ALL_STYLES) >= 4
    for row in rows:
        assert len(row["styleName"]) <= 30
        root = ET.fromstring(row["styleQML"])
        renderer = root.find("renderer-v2")
        assert root.tag == "qgis"
        assert renderer is not None
        columns = {one[1] for one in styled.execute(f'PRAGMA table_info("{row["f_table_name"]}")')}
        assert renderer.get("attr") in columns
        classes = renderer.findall("categories/category") + renderer.findall("ranges/range")
        symbols = {symbol.get("name") for symbol in renderer.findall("symbols/symbol")}
        assert {one.get("symbol") for one in classes} == symbols
        assert all(one.get("label") for one in classes)
        fills = [tuple(option.get("value") for option in one.iter("Option")) for one in renderer.findall("symbols/*")]
        assert len(set(fills)) == len(fills), "two classes that look alike"


def values_of(layer: str, name: str) -> list[str | None]:
    """The values that have a class of their own in a style."""
    qml = next(style.qml for style in ALL_STYLES if (style.layer, style.name) == (layer, name))
    return [one.get("value") for one in ET.fromstring(qml).iter("category")]


def test_every_status_and_every_reason_of_rejection_has_a_class() -> None:
    assert sorted(values_of("buildings", "status")) == sorted(Status)
    reasons = {*REASON_OF_FAULT.values(), Reason.TOO_FEW_POINTS, Reason.OVERRIDDEN, Reason.STRIPS_DISAGREE}
    *known, others = values_of("rejected", "reason")
    assert sorted(known) == sorted(reasons)
    assert others == ""


def bounds_of(qml: str) -> list[tuple[float, float]]:
    """Lower and upper bound of each range, in their order."""
    return [(float(one.get("lower", "")), float(one.get("upper", ""))) for one in ET.fromstring(qml).iter("range")]


@pytest.mark.parametrize(("name", "most"), [("slope", 90.0), ("distance of the points", 1.0)])
def test_ranges_touch_and_begin_at_zero(name: str, most: float) -> None:
    qml = next(style.qml for style in ALL_STYLES if style.name == name)
    bounds = sorted(bounds_of(qml))
    assert bounds[0][0] == 0.0
    assert [low for low, _ in bounds[1:]] == [high for _, high in bounds[:-1]]
    assert bounds[-1][1] == most


@pytest.mark.parametrize("share", [0.5, 0.75, 0.9, 0.95])
def test_a_share_between_two_ranges_is_in_the_upper_one_as_on_the_page(share: float) -> None:
    qml = next(style.qml for style in ALL_STYLES if style.name == "distance of the points")
    # QGIS takes the first range that holds a value
    assert next(low for low, high in bounds_of(qml) if low <= share <= high) == share
