"""The table of solar energy on roofs: GeoParquet, one row per roof plane, written tile by tile."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.export.columns import COUNT, FLOAT64, HORIZONTAL, INT32, NONE, SHARE, TEXT, WKB, Column
from pipeline.export.geoparquet import BBOX, bbox_column, geo_metadata

SUFFIX = ".parquet"
"""Ending of the file."""
FACTS = "gablework_solar"
"""The key of the file's metadata that holds the assumptions, as JSON."""


COLUMNS = (
    Column("tile", TEXT, NONE, "tile of the run", required=True),
    Column("building_id", TEXT, NONE, "as in the run", required=True),
    Column("plane_id", INT32, NONE, "as in the run", required=True),
    Column("geometry", WKB, HORIZONTAL, "faces of the plane in 3D, as in the run; null without a face"),
    Column("azimuth_deg", FLOAT64, "deg", "of descent, clockwise from true north; 0 if level", required=True),
    Column("tilt_deg", FLOAT64, "deg", "angle to the horizontal", required=True),
    Column("area_m2", FLOAT64, "m2", "true area, along the slope", required=True),
    Column("samples", INT32, COUNT, "points that looked at the sky; 0 without a face", required=True),
    Column("sky_view", FLOAT64, SHARE, "sky view factor, (1 + cos tilt) / 2 in the open; null without a face"),
    Column(
        "horizon_deg",
        pa.list_(pa.float32()),
        "deg",
        "elevation of the horizon in 72 azimuths, 5 degrees apart, from north clockwise, mean of the points; "
        "null without a face",
    ),
    Column(
        "irradiation_kwh_m2",
        FLOAT64,
        "kWh/m2",
        "energy of a year per true area, of beam, sky and ground; this and what follows is null without a face, and "
        "with `--sky-only`",
    ),
    Column("irradiation_kwh", FLOAT64, "kWh", "the same for the whole plane"),
    Column("beam_kwh_m2", FLOAT64, "kWh/m2", "the part of the sun's beam"),
    Column("sky_kwh_m2", FLOAT64, "kWh/m2", "the part of the sky"),
    Column("ground_kwh_m2", FLOAT64, "kWh/m2", "the part that the ground reflects"),
    Column("beam_loss", FLOAT64, SHARE, "share of the beam that roofs take away; null without any beam"),
)
"""The columns, in the order of the file; `bbox` follows."""

SCHEMA = pa.schema([*(pa.field(c.name, c.kind, nullable=not c.required) for c in COLUMNS), pa.field("bbox", BBOX)])
"""The schema of the file."""


class SolarFile:
    """A file that is being written, one row group or more per tile. The same rows give the same bytes.

    Parameters
    ----------
    path : Path
        The file, which no one else reads yet.
    projjson : mapping or None
        CRS of the geometries; None if unknown.
    facts : mapping
        Assumptions and facts about the run, as plain JSON values.
    """

    def __init__(self, path: Path, projjson: Mapping[str, Any] | None, facts: Mapping[str, Any]) -> None:
        self._projjson, self._facts = projjson, facts
        self._writer = pq.ParquetWriter(path, SCHEMA, compression="zstd", store_schema=False)
        self._geo: dict[str, Any] | None = None
        self.rows = 0

    def write(self, columns: Mapping[str, Sequence[Any]], faces: Any) -> None:
        """Add the rows of a tile: all `columns` except `bbox`, and their geometries as shapes, (n,)."""
        arrays = [_array(columns[column.name], column.kind) for column in COLUMNS]
        self._writer.write_table(pa.Table.from_arrays([*arrays, bbox_column(faces)], schema=SCHEMA))
        self._geo = _united(self._geo, geo_metadata(faces, self._projjson))
        self.rows += len(faces)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the file, with what is known only at the end: bounds and types of all geometries."""
        if kind is None:
            geo = self._geo or geo_metadata(np.zeros(0, object), self._projjson)
            for key, value in (("geo", geo), (FACTS, self._facts)):
                self._writer.add_key_value_metadata({key: json.dumps(value, sort_keys=True, separators=(",", ":"))})
        self._writer.close()


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Values as an Arrow array of a type; nan becomes null."""
    if pa.types.is_list(kind):
        missing = np.isnan(np.asarray(values)).any(axis=1)
        return pa.array([None if gone else row for gone, row in zip(missing, values, strict=True)], kind)
    return pa.array(values, kind, from_pandas=True)


def _united(first: dict[str, Any] | None, second: dict[str, Any]) -> dict[str, Any]:
    """The metadata of the geometries of two tiles together."""
    if first is None:
        return second
    a, b = first["columns"]["geometry"], second["columns"]["geometry"]
    a["geometry_types"] = sorted({*a["geometry_types"], *b["geometry_types"]})
    if "bbox" in a and "bbox" in b:
        half = len(a["bbox"]) // 2
        low, high = np.minimum(a["bbox"], b["bbox"])[:half], np.maximum(a["bbox"], b["bbox"])[half:]
        a["bbox"] = [*low.tolist(), *high.tolist()]
    elif "bbox" in b:
        a["bbox"] = b["bbox"]
    return first
