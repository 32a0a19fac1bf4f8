"""Footprints of a run as vector tiles in one PMTiles file, for maps on the web.

The layer has the columns of `buildings` by the same names, without those of geometry and solids and without
`LEFT_OUT`. Tiles of every zoom hold all of them. GDAL writes the file from a stream of batches and sorts the features
into tiles on the disk, so memory does not grow with the run.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.errors import NothingToShowError
from pipeline.export.columns import COLUMNS, ELEVATIONS, TILE_COLUMN, kind_of, text_of
from pipeline.export.projection import Project, projection_to
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.extras.publish.finished_run import FinishedRun, Published, file_outside, new_file
from pipeline.extras.publish_gis.gdal_layers import write_layer
from pipeline.runtime.monitoring.progress import Listener, ignore

SUFFIX = ".pmtiles"
"""Ending of the files, by which GDAL knows the format."""
LAYER = "buildings"
"""Name of the layer, and of its table."""
CRS = "EPSG:3857"
"""The CRS of web maps."""
MIN_ZOOM, MAX_ZOOM = 12, 16
"""At the first, a city is a few tiles; at the last, one unit of a tile is 0.15 m at the equator and 0.1 m at 50 deg."""
MAX_BUILDINGS = 6000
"""Largest number of buildings in one tile: about 1 MB. Of more, GDAL takes the largest.

The last zoom has all up to 16,000 per km2 at the equator and 38,000 at 50 deg, the one before up to a quarter."""
MAX_TILE_BYTES = 2_000_000_000
"""So large that no tile reaches it: GDAL would coarsen its coordinates."""
GEOMETRY = "geometry"
"""The column of geometry."""
LEFT_OUT = ("mesh_path", "input_hash", "settings_hash", "engine_version")
"""Columns that a map does not need: with them a file is a third larger, and most are the same for all buildings."""

READ = tuple(
    column.name for column in COLUMNS[LAYER] if column.name not in SHAPE_COLUMNS and column.name not in LEFT_OUT
)
"""The columns that are read from the table, in its order."""
_TEXTS = ("timestamp", "list")
_KINDS = {column.name: column.kind for column in COLUMNS[LAYER]}
SCHEMA = pa.schema(
    [
        *(pa.field(name, pa.string() if kind_of(_KINDS[name]) in _TEXTS else _KINDS[name]) for name in READ),
        pa.field(TILE_COLUMN.name, TILE_COLUMN.kind),
    ]
)
"""The schema of what is written."""


def map_batch(batch: pa.RecordBatch, tile: str, project: Project, vertical_unit_m: float = 1.0) -> pa.RecordBatch:
    """The rows that have a footprint, with the columns of the layer; elevations in metres, as web maps have all else.

    Parameters
    ----------
    batch : pyarrow.RecordBatch
        Rows of `buildings` with the columns `READ`.
    tile : str
        Their tile.
    project : callable
        From the run's horizontal CRS to `CRS`.
    vertical_unit_m : float
        Metres per unit of the elevations in the table.
    """
    rows = batch.filter(pc.is_valid(batch.column(GEOMETRY)))
    columns = [_property(in_metres(rows.column(name), name, vertical_unit_m), name, project) for name in READ]
    return pa.record_batch([*columns, pa.array([tile] * rows.num_rows, pa.string())], schema=SCHEMA)


def in_metres(column: pa.Array, name: str, vertical_unit_m: float) -> pa.Array:
    """The values of a column of `buildings`; those of an elevation in metres, to 1 mm."""
    if vertical_unit_m == 1.0 or name not in ELEVATIONS[LAYER]:
        return column
    return pc.round(pc.multiply(column, vertical_unit_m), ndigits=3)


def _property(column: pa.Array, name: str, project: Project) -> pa.Array:
    """The values of a column as they are written."""
    if name == GEOMETRY:
        found = shapely.from_wkb(np.array([*column.to_pylist(), None], dtype=object)[:-1])
        return pa.array(shapely.to_wkb(shapely.transform(found, project), flavor="iso"), pa.binary())
    kind = kind_of(column.type)
    if kind not in _TEXTS:
        return column
    return pa.array([text_of(value) for value in column.to_pylist()], pa.string())


def write_pmtiles(path: Path, batches: Iterable[pa.RecordBatch], facts: Mapping[str, str]) -> int:
    """Write a PMTiles file; returns the number of its buildings. The same rows give the same bytes.

    Raises NothingToShowError without a building, and RunError if the file cannot be written. Errors of the `batches`
    pass through.

    Parameters
    ----------
    path : Path
        The file, in a folder of its own: GDAL has more files beside it. The caller brings it to the disk.
    batches : iterable of pyarrow.RecordBatch
        What `map_batch` returns.
    facts : mapping
        Facts about the run, stored as the description.
    """
    rest = iter(batches)
    first = next((batch for batch in rest if batch.num_rows), None)
    if first is None:
        raise NothingToShowError("the run has no building with a footprint, so there is nothing for a map")
    options = {
        "NAME": LAYER,
        "DESCRIPTION": ", ".join(f"{name}: {value}" for name, value in facts.items()),
        "MINZOOM": str(MIN_ZOOM),
        "MAXZOOM": str(MAX_ZOOM),
        "MAX_FEATURES": str(MAX_BUILDINGS),
        "MAX_SIZE": str(MAX_TILE_BYTES),
    }
    return write_layer(
        path,
        LAYER,
        SCHEMA,
        itertools.chain([first], rest),
        "PMTiles",
        dataset_options=options,
        geometry_name=GEOMETRY,
        geometry_type="MultiPolygon",
        crs=CRS,
    )


def publish_pmtiles(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write the footprints of a finished run; parameters and errors as in `publishing.Form`.

    Raises RunError if the run's CRS is unknown, too.
    """
    target = file_outside(run_dir, out, SUFFIX, overwrite)
    run = FinishedRun.at(run_dir, {LAYER})
    project = projection_to(run.manifest.crs, CRS)
    unit_m = run.reference.vertical_unit_m
    read = 0

    def batches() -> Iterator[pa.RecordBatch]:
        nonlocal read
        for tile, batch in run.batches(LAYER, READ, on_event):
            read += batch.num_rows
            yield map_batch(batch, tile, project, unit_m)

    with new_file(target, overwrite) as path:
        rows = {LAYER: write_pmtiles(path, batches(), run.facts)}
        run.check({LAYER: read})
    return Published(place=str(target), size_bytes=target.stat().st_size, rows=rows)
