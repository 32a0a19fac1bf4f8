"""A GeoPackage of a run: which columns its layers have, of which types, and how rows become theirs.

A layer has the columns of its table by the same names, without `bbox` (the layer has a spatial index) and without those
of the solids: a layer has one geometry. `tile` is added, as every reader of the run's folders sees it. GeoPackage lacks
some types of Arrow; `columns.KINDS` says what each becomes. A layer is written as a stream of batches, so memory does
not grow with the run.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.fs as pafs
import shapely

from pipeline.errors import RunError
from pipeline.export.columns import COLUMNS, HORIZONTAL, KINDS, TILE_COLUMN, VERTICAL, kind_of, text_of
from pipeline.export.decisions import DECISIONS
from pipeline.export.decisions import NAME as DECISIONS_NAME
from pipeline.export.record_rows import SCHEMAS
from pipeline.export.solid_geometry import SOLID_COLUMNS
from pipeline.extras.publish.finished_run import FinishedRun, Published, file_outside, new_file
from pipeline.extras.publish_gis.gdal_layers import gdal_options, write_layer
from pipeline.extras.publish_gis.qml import STYLES as QGIS_STYLES
from pipeline.extras.publish_gis.qml import Style
from pipeline.io import arrow_at
from pipeline.io.crs_units import unit_name
from pipeline.runtime.monitoring.progress import Listener, ignore

SUFFIX = ".gpkg"
"""Ending of the files: GDAL and QGIS warn of any other."""
GEOMETRY = "geometry"
"""The column of geometry, in the tables and in the layers."""
TILE = TILE_COLUMN.name
"""The column that the folders' names carry."""
STYLES = "layer_styles"
"""The table in which QGIS looks for styles."""

VERSION = "1.3"
"""Version of GeoPackage: GDAL 3.6, which QGIS 3.22 of Debian 12 has, warns of a later one."""

_JSON = {"ARROW:extension:name": "arrow.json", "ARROW:extension:metadata": ""}
_COMMENT = "GDAL:OGR:comment"
"""Key of a field's metadata; GDAL stores its value in `gpkg_data_columns`, where QGIS finds it."""
_MILLISECONDS = pa.timestamp("ms", tz="UTC")
_STYLES_SCHEMA = pa.schema(
    [
        *(pa.field(name, pa.string()) for name in ("f_table_catalog", "f_table_schema", "f_table_name")),
        *(pa.field(name, pa.string()) for name in ("f_geometry_column", "styleName", "styleQML", "styleSLD")),
        pa.field("useAsDefault", pa.bool_()),
        *(pa.field(name, pa.string()) for name in ("description", "owner", "ui")),
        pa.field("update_time", _MILLISECONDS),
    ]
)
"""The columns by which QGIS finds a style."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Layer:
    """One layer of the file, made of one table of a run."""

    name: str
    """Name of the layer and of the table."""
    table: pa.Schema
    """Schema of the table, without the columns of its files alone (`bbox`)."""
    geometry_type: str | None
    """GDAL's name of the layer's type of geometry; None where the layer is a table of attributes."""
    description: str
    """A sentence for people, stored in the file."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that are read from the table, in its order."""
        return tuple(name for name in self.table.names if name not in SOLID_COLUMNS)

    @property
    def schema(self) -> pa.Schema:
        """The schema of what is written: the columns in their stored types, then `tile`."""
        return self.schema_in({})

    def schema_in(self, units: Mapping[str, str]) -> pa.Schema:
        """The schema with the meaning of each column, in the units of a run's CRS (`Column.comment_in`)."""
        fields = [*map(stored_field, map(self.table.field, self.columns)), pa.field(TILE, pa.string(), nullable=False)]
        comments = {one.name: one.comment_in(units) for one in (*COLUMNS[self.name], TILE_COLUMN)}
        return pa.schema(
            [field.with_metadata({**(field.metadata or {}), _COMMENT: comments[field.name]}) for field in fields]
        )


LAYERS = (
    Layer(
        name="buildings",
        table=SCHEMAS["buildings"],
        geometry_type="MultiPolygon",
        description="One row per candidate: its footprint, its status and its figures",
    ),
    Layer(
        name="planes",
        table=SCHEMAS["planes"],
        geometry_type="MultiPolygon Z",
        description="One row per roof plane: its faces in 3D, slope and aspect",
    ),
    Layer(
        name="rejected",
        table=SCHEMAS["rejected"],
        geometry_type="MultiPolygon",
        description="One row per object that is not a building: the box around it and the reason",
    ),
    Layer(
        name=DECISIONS_NAME,
        table=DECISIONS,
        geometry_type=None,
        description="One row per check, form and level of detail of each building",
    ),
)
"""The layers of a file, in their order."""


def stored_field(field: pa.Field) -> pa.Field:
    """A column of a table as it is written; raises RunError if GeoPackage has no type for it."""
    kind = kind_of(field.type)
    if kind not in KINDS:
        raise RunError(
            f"column {field.name} has type {field.type}, for which GeoPackage has none: add it to the mapping"
        )
    if kind == "list":
        return pa.field(field.name, pa.string(), nullable=field.nullable, metadata=_JSON)
    return field.with_type(_MILLISECONDS) if kind == "timestamp" else field


def stored_batch(batch: pa.RecordBatch, layer: Layer, tile: str) -> pa.RecordBatch:
    """Rows of a table with the layer's columns, in its stored types."""
    columns = [_stored(batch.column(name), name) for name in layer.columns]
    return pa.record_batch([*columns, pa.array([tile] * batch.num_rows, pa.string())], schema=layer.schema)


def _stored(column: pa.Array, name: str) -> pa.Array:
    """The values of a column as they are written."""
    if name == GEOMETRY:
        return multi_polygons(column)
    kind = kind_of(column.type)
    if kind == "list":
        return pa.array([text_of(value) for value in column.to_pylist()], pa.string())
    if kind == "timestamp":
        return pc.cast(pc.floor_temporal(column, unit="millisecond"), _MILLISECONDS)
    return column


def multi_polygons(column: pa.Array) -> pa.Array:
    """ISO WKB of polygons, all of them as MultiPolygons, since a layer has one type of geometry; null stays null."""
    found = shapely.from_wkb(np.array([*column.to_pylist(), None], dtype=object)[:-1])
    single = shapely.get_type_id(found) == shapely.GeometryType.POLYGON
    found[single] = shapely.multipolygons(found[single, np.newaxis])
    return pa.array(shapely.to_wkb(found, flavor="iso"), pa.binary())


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeoPackage:
    """A GeoPackage that is being written. The same content with the same time gives the same bytes."""

    path: Path
    """The file, which no one else reads yet; the first layer makes it. The caller brings it to the disk."""
    wkt: str | None
    """The CRS of all geometries, compound if it is; None if unknown."""
    at: dt.datetime
    """When the content was made, with a time zone."""
    facts: Mapping[str, str]
    """Facts about the run, stored as metadata of each layer."""
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Names of the units of the CRS, by `columns.HORIZONTAL` and `VERTICAL`, for the comments of columns."""

    def write(self, layer: Layer, batches: Iterable[pa.RecordBatch]) -> int:
        """Add a layer; returns the number of its rows.

        Raises RunError if the file cannot be written, and whatever the `batches` raise.

        Parameters
        ----------
        layer : Layer
            The layer.
        batches : iterable of pyarrow.RecordBatch
            The rows, of the layer's `schema`; one batch after the other is held in memory.
        """
        options: dict[str, Any] = {"layer_options": {"IDENTIFIER": layer.name, "DESCRIPTION": layer.description}}
        if layer.geometry_type is not None:
            options["layer_options"]["GEOMETRY_NAME"] = GEOMETRY
            options |= {"geometry_name": GEOMETRY, "geometry_type": layer.geometry_type, "crs": self.wkt}
        # of the layers: where the dataset has metadata, GDAL's readers leave a file .aux.xml beside it
        schema = layer.schema_in(self.units)
        return self._write(layer.name, schema, batches, layer_metadata=dict(self.facts), **options)

    def write_styles(self, styles: Sequence[Style]) -> None:
        """Store styles where QGIS looks for them; the first one of a layer is what QGIS draws it with.

        Raises RunError if the file cannot be written.
        """
        layers = [style.layer for style in styles]
        rows = [
            {
                "f_table_catalog": "",
                "f_table_schema": "",
                "f_table_name": style.layer,
                "f_geometry_column": GEOMETRY,
                "styleName": style.name,
                "styleQML": style.qml,
                "styleSLD": "",
                "useAsDefault": style.layer not in layers[:number],
                "description": style.description,
                "owner": "",
                "ui": "",
                "update_time": self.at,
            }
            for number, style in enumerate(styles)
        ]
        batch = pa.RecordBatch.from_pylist(rows, schema=_STYLES_SCHEMA)
        self._write(STYLES, _STYLES_SCHEMA, [batch], layer_options={"FID": "id"})

    def _write(self, name: str, schema: pa.Schema, batches: Iterable[pa.RecordBatch], **options: Any) -> int:
        """Write a stream of batches as a layer; returns the number of rows."""
        with gdal_options({"OGR_CURRENT_DATE": _zulu(self.at), "OGR_SQLITE_SYNCHRONOUS": "OFF"}):
            return write_layer(
                self.path, name, schema, batches, "GPKG", dataset_options={"VERSION": VERSION}, **options
            )


def _zulu(at: dt.datetime) -> str:
    """A time as GDAL takes it in place of the time of day."""
    return at.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def publish_geopackage(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write a finished run as a GeoPackage, tile by tile; parameters and errors as in `publishing.Form`."""
    target = file_outside(run_dir, out, SUFFIX, overwrite)
    run = FinishedRun.at(run_dir, {layer.name for layer in LAYERS})
    manifest, reference = run.manifest, run.reference
    with new_file(target, overwrite) as path:
        made = GeoPackage(
            path=path,
            wkt=(manifest.crs or {}).get("wkt"),
            at=manifest.finished_at or manifest.started_at,
            facts=run.facts,
            units={
                HORIZONTAL: unit_name(reference.horizontal_unit_m),
                VERTICAL: unit_name(reference.vertical_unit_m),
            },
        )
        rows = {}
        for layer in LAYERS:
            if layer.name == DECISIONS_NAME and not _has_decisions(run_dir):
                continue
            read = run.batches(layer.name, layer.columns, on_event)
            rows[layer.name] = made.write(layer, (stored_batch(batch, layer, tile) for tile, batch in read))
        made.write_styles(QGIS_STYLES)
        run.check(rows)
    return Published(place=str(target), size_bytes=target.stat().st_size, rows=rows)


def _has_decisions(run_dir: str) -> bool:
    """Whether a run has the table: those of older versions lack it."""
    filesystem, place = arrow_at(run_dir)
    found = filesystem.get_file_info(f"{place.rstrip('/')}/{DECISIONS_NAME}")
    return bool(found.type is pafs.FileType.Directory)
