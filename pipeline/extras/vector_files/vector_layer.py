"""One layer of a vector file, unchanged: GeoParquet, or a format that GDAL reads.

Of a file that covers a country, only what lies near the data is kept: its geometries go by in batches, and the columns
of the others are never read (GDAL), or let go batch by batch (GeoParquet).
"""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import InputError, UnreadableInputError
from pipeline.extras.vector_files.gdal_layer import read_by_gdal
from pipeline.extras.vector_files.nearby import POLYGONS, Boxes, Shape, VectorLayer
from pipeline.extras.vector_files.vector_archive import unpacked
from pipeline.io.formats import first_bytes
from pipeline.io.locations import is_url, shown
from pipeline.io.places import on_this_machine

PARQUET_MAGIC = b"PAR1"


def read_layer(path: str | Path, layer: str | None, boxes: Boxes | None = None, shape: Shape = POLYGONS) -> VectorLayer:
    """The one layer of a file that can hold polygons, or features of another shape, or the named one.

    Raises UnreadableInputError if the file cannot be read as vector data, or the layer is not there.

    Parameters
    ----------
    path : str or Path
        The file, or its URL: then it is fetched for as long as it is read. Its first bytes show its format.
    layer : str, optional
        The layer; of GeoParquet the geometry column.
    boxes : callable, optional
        Where features are wanted; those whose bounds meet none of its boxes are passed over. None reads all.
    shape : Shape
        What the features are.
    """
    label = shown(str(path))
    if is_url(path) and label.lower().endswith(".shp"):
        raise UnreadableInputError(
            label, "a Shapefile is several files", "Give a GeoPackage or a zip archive, or fetch its files first"
        )
    with on_this_machine(path) as file:
        inner = file
        try:
            with unpacked(file, layer, shape) as (inner, name):
                return _read(inner, name, boxes, shape)
        except InputError as fault:
            raise fault.of(label, str(inner)) from fault


def _read(path: Path, layer: str | None, boxes: Boxes | None, shape: Shape) -> VectorLayer:
    """The layer of a file of this machine."""
    if not first_bytes(path).startswith(PARQUET_MAGIC):
        return read_by_gdal(path, layer, boxes, shape)
    from pipeline.extras.vector_files.geoparquet_layer import read_geoparquet

    return read_geoparquet(path, layer, boxes, shape)
