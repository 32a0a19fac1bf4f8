"""What the columns of a run's tables may hold, for property tests of every format."""

import datetime as dt
from collections.abc import Sequence
from typing import Any

import pyarrow as pa
import shapely
from hypothesis import strategies as st

from pipeline.export.columns import kind_of

GEOMETRY = "geometry"
EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)


def polygons(has_z: bool) -> st.SearchStrategy[Any]:
    """Polygons and MultiPolygons in millimetres, as records hold them, or none."""
    place = st.integers(0, 10**9).map(lambda mm: mm / 1000.0)

    def triangle(x: float, y: float, z: float) -> shapely.Polygon:
        corners = [(x, y, z), (x + 1.5, y, z + 0.25), (x, y + 2.125, z)]
        return shapely.Polygon([corner if has_z else corner[:2] for corner in corners])

    single = st.builds(triangle, place, place, place)
    return st.none() | single | st.lists(single, min_size=1, max_size=3).map(shapely.MultiPolygon)


def values(field: pa.Field, has_z: bool) -> st.SearchStrategy[Any]:
    """What a column may hold. C ends a text at its first zero byte, so there is none; figures are finite or null."""
    if field.name == GEOMETRY:
        found = polygons(has_z).map(lambda one: None if one is None else shapely.to_wkb(one, flavor="iso"))
    else:
        found = {
            "string": st.text(st.characters(codec="utf-8", exclude_characters="\0")),
            "bool": st.booleans(),
            "int32": st.integers(-(2**31), 2**31 - 1),
            "int64": st.integers(-(2**63), 2**63 - 1),
            "double": st.floats(allow_nan=False, allow_infinity=False),
            "timestamp": st.integers(0, 4 * 10**15).map(lambda us: EPOCH + dt.timedelta(microseconds=us)),
            "binary": st.binary(),
            "list": st.lists(_items(field.type)),
        }[kind_of(field.type)]
    return found if not field.nullable else st.none() | found


def _items(kind: pa.DataType) -> st.SearchStrategy[Any]:
    """The items of a list, none of which is missing."""
    if not pa.types.is_list(kind):
        return st.nothing()
    return values(pa.field("item", kind.value_type, nullable=False), False)


def rows(schema: pa.Schema, names: Sequence[str], *, has_z: bool = False) -> st.SearchStrategy[dict[str, Any]]:
    """Rows with some columns of a table."""
    return st.fixed_dictionaries({name: values(schema.field(name), has_z) for name in names})
