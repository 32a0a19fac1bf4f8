"""The tables of a run as collections: what their columns are for clients."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from pipeline.export.columns import COLUMNS, HORIZONTAL, NONE, VERTICAL
from pipeline.export.record_rows import SCHEMAS
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.io.crs_units import unit_name
from pipeline.model import Reason, RoofType, Status
from service.features.feature_crs import RunCrs
from service.features.index import TABLES

GEOMETRY = "geometry"
TILE = "tile"

_WORDS: Mapping[tuple[str, str], type[Status | RoofType | Reason]] = {
    ("buildings", "status"): Status,
    ("buildings", "reason"): Reason,
    ("buildings", "roof_type"): RoofType,
    ("rejected", "reason"): Reason,
}
"""Columns with a closed list of words."""
_UNITS = {table: {column.name: column.unit for column in columns} for table, columns in COLUMNS.items()}
_TITLES = {
    "buildings": "footprints of all candidates, with status and figures",
    "planes": "roof planes: faces, slope and aspect; the third coordinate is the elevation: in metres, in the storage "
    "CRS in its unit",
    "rejected": "objects that are not buildings, each with its reason",
}


@dataclasses.dataclass(frozen=True)
class Layer:
    """A table as a collection."""

    table: str
    """Its name."""

    @property
    def title(self) -> str:
        """Its content in a few words."""
        return _TITLES[self.table]

    @functools.cached_property
    def properties(self) -> Mapping[str, pa.DataType]:
        """The columns that features have as properties, with their types; the last one is the tile."""
        left_out = {GEOMETRY, *SHAPE_COLUMNS}
        fields = {field.name: field.type for field in SCHEMAS[self.table] if field.name not in left_out}
        return fields | {TILE: pa.string()}

    @functools.cached_property
    def kinds(self) -> Mapping[str, str]:
        """The kinds of these properties: text, number, boolean, time or list."""
        return {name: kind_of(kind) for name, kind in self.properties.items()}

    def feature_ids(self, columns: Mapping[str, Sequence[Any]]) -> Sequence[str]:
        """The ids of features: those of the objects; a plane has its building's, a dot and its own number."""
        if self.table == "planes":
            return list(map("{}.{}".format, columns["building_id"], columns["plane_id"]))
        return columns["object_id" if self.table == "rejected" else "building_id"]

    def filter_schema(self, crs: RunCrs) -> dict[str, Any]:
        """The JSON schemas of the properties that filters can name, and of the geometry."""
        found = {name: self._property(name, crs) for name, kind in self.kinds.items() if kind != "list"}
        role = {"x-ogc-role": "primary-geometry", "format": "geometry-polygon-or-multipolygon"}
        return {**found, GEOMETRY: {"title": GEOMETRY, **role}}

    def feature_schema(self, crs: RunCrs) -> dict[str, Any]:
        """The JSON schemas of the members of a feature.

        Types are single words with `nullable`, as in OpenAPI 3.0: GDAL takes a list of types for a text. For the same
        reason lists of floating point numbers are left out.
        """
        listed = [name for name, kind in self.properties.items() if not _is_float_list(kind)]
        nullable = {field.name for field in SCHEMAS[self.table] if field.nullable}
        found = {name: self._property(name, crs) | ({"nullable": True} if name in nullable else {}) for name in listed}
        return {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            GEOMETRY: {"type": "object", "nullable": True},
            "properties": {"type": "object", "properties": found, "required": listed},
        }

    def _property(self, name: str, crs: RunCrs) -> dict[str, Any]:
        """The JSON schema of a property; of a coordinate with its unit as UCUM (OGC API - Features, part 5)."""
        found = {"title": name, **json_type(self.properties[name])}
        own = {HORIZONTAL: crs.horizontal_unit_m, VERTICAL: crs.vertical_unit_m or 1.0}
        unit_m = own.get(_UNITS[self.table].get(name, NONE))
        if unit_m is not None:
            found["x-ogc-unit"] = ucum(unit_m)
        if (self.table, name) in _WORDS:
            found["enum"] = [str(word) for word in _WORDS[self.table, name]]
        return found


def ucum(unit_m: float) -> str:
    """A unit of length in the Unified Code for Units of Measure.

    >>> ucum(1.0), ucum(0.3048), ucum(1200.0 / 3937.0)
    ('m', '[ft_i]', '[ft_us]')
    """
    known = {"metre": "m", "foot": "[ft_i]", "US survey foot": "[ft_us]"}
    return known.get(unit_name(unit_m), f"{unit_m:.12g}.m")


LAYERS: Mapping[str, Layer] = {table: Layer(table) for table in TABLES}
"""The tables that are collections."""


def kind_of(kind: pa.DataType) -> str:
    """The kind of a type; filters compare all but lists.

    >>> kind_of(pa.int32()), kind_of(pa.timestamp("us", tz="UTC")), kind_of(pa.list_(pa.int32()))
    ('number', 'time', 'list')
    """
    if pa.types.is_string(kind):
        return "text"
    if pa.types.is_boolean(kind):
        return "boolean"
    if pa.types.is_timestamp(kind):
        return "time"
    return "number" if pa.types.is_integer(kind) or pa.types.is_floating(kind) else "list"


def _is_float_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) and pa.types.is_floating(kind.value_type))


def json_type(kind: pa.DataType) -> dict[str, Any]:
    """The JSON schema of a type's values.

    >>> json_type(pa.list_(pa.int32()))
    {'type': 'array', 'items': {'type': 'integer'}}
    """
    if pa.types.is_list(kind):
        return {"type": "array", "items": json_type(kind.value_type)}
    if pa.types.is_integer(kind):
        return {"type": "integer"}
    words = {"text": "string", "time": "string", "boolean": "boolean", "number": "number"}
    found = {"type": words[kind_of(kind)]}
    return found | {"format": "date-time"} if kind_of(kind) == "time" else found
