"""Every column of every table, whatever it holds, has the same name and value in each format."""

import json
import re
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import small_buildings as small
from column_values import rows
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.export.cityjson import cityjson_lines, lines_of
from pipeline.export.columns import COLUMNS, KINDS, VERTICAL, Column, kind_of
from pipeline.export.geoparquet import geo_table, parquet_bytes
from pipeline.export.record_rows import KEYS, SCHEMAS
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.extras.publish.cityjson_file import city_of

TABLES = list(COLUMNS)
ALL = [column for columns in COLUMNS.values() for column in columns]
JSON_TYPES = {"string": str, "boolean": bool, "number": int | float, "array": list, "string, ISO 8601": str}


@pytest.mark.parametrize("table", TABLES)
def test_every_column_has_a_name_of_its_own_a_known_type_and_a_meaning(table: str) -> None:
    names = [column.name for column in COLUMNS[table]]
    assert len({name.lower() for name in names}) == len(names), "GeoPackage ignores case"
    for column in COLUMNS[table]:
        assert re.fullmatch(r"[a-z][a-z0-9_]*", column.name)
        assert kind_of(column.kind) in KINDS
        assert column.meaning.strip() == column.meaning != ""
        assert not column.meaning.endswith("."), column.name
    meanings = [column.meaning for column in COLUMNS[table]]
    assert len(set(meanings)) == len(meanings)


def test_a_name_with_a_unit_means_that_unit() -> None:
    endings = {"_per_m2": "1/m2", "_m": "m", "_m2": "m2", "_m3": "m3", "_deg": "deg", "_share": "share"}
    for column in ALL:
        unit = next((unit for ending, unit in endings.items() if column.name.endswith(ending)), column.unit)
        assert column.unit == unit, column.name
        assert (column.unit == VERTICAL) == bool(re.fullmatch(r"\w+_z|h_\w+", column.name)), column.name


@pytest.mark.parametrize("table", list(SCHEMAS))
@settings(max_examples=examples(30), deadline=None)
@given(data=st.data())
def test_every_column_reads_back_from_parquet(table: str, data: st.DataObject) -> None:
    schema = SCHEMAS[table]
    flat = [column for column in schema.names if column not in SHAPE_COLUMNS]
    empty: dict[str, Any] = dict.fromkeys(schema.names)
    drawn = [empty | row for row in data.draw(st.lists(rows(schema, flat, has_z=table == "planes"), max_size=3))]
    read = pq.read_table(pa.BufferReader(parquet_bytes(geo_table(table, drawn, None))))
    assert read.drop_columns(["bbox"]).schema.remove_metadata() == schema
    ordered = sorted(drawn, key=lambda row: tuple(row[key] for key in KEYS[table]))
    assert read.drop_columns(["bbox"]).to_pylist() == ordered


def attribute(value: Any, column: Column) -> Any:
    """A value as the reference says that CityJSON has it, computed without the writer."""
    if column.name == "source_attributes":
        return json.loads(value)
    return value.isoformat() if kind_of(column.kind) == "timestamp" else value


@settings(max_examples=examples(60), deadline=None)
@given(data=st.data())
def test_every_column_is_an_attribute_of_cityjson(data: st.DataObject) -> None:
    columns = {
        column.name: column
        for column in COLUMNS["buildings"]
        if column.name not in {"building_id", "geometry", *SHAPE_COLUMNS}
    }
    given_columns = st.dictionaries(
        st.text(), st.none() | st.text() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    )
    row = data.draw(rows(SCHEMAS["buildings"], list(columns))) | {
        "source_attributes": data.draw(st.none() | given_columns.map(json.dumps))
    }
    empty = dict.fromkeys(SCHEMAS["buildings"].names)
    text = "\n".join(cityjson_lines([(small.courtyard(), empty | row)], small.Reference(), "t1"))
    city = city_of(lines_of(text))
    found = city["CityObjects"][small.courtyard().building_id]["attributes"]
    assert found == {name: attribute(value, columns[name]) for name, value in row.items() if value is not None}
    for name, value in found.items():
        kind = JSON_TYPES[KINDS[kind_of(columns[name].kind)].cityjson]
        assert isinstance(value, dict if name == "source_attributes" else kind), name
