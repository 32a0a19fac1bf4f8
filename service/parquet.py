"""Checks a client's GeoParquet file: decodes it once, piece by piece, and keeps nothing.

A few bytes of Parquet can encode millions of rows, or millions of copies of one long text; the sizes in the footer do
not show it. The child process of `service.preflight`, which has little memory and time, therefore decodes the columns
that will be read, until they end or exceed the limits.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import EmptyInputError, UnreadableInputError
from pipeline.extras.vector_files.geoparquet_layer import DEPTHS, geometry_column
from pipeline.io.library_faults import in_our_words
from service.errors import TooLargeError
from service.input_policy import checked_crs

if TYPE_CHECKING:
    import pyarrow as pa

ROWS_LIMIT = 20_000_000
"""Maximum number of rows; a GeoPackage of the maximum size holds fewer."""
DECODED_LIMIT = 2**30
"""Maximum number of decoded bytes of all columns: as many as a GeoPackage may have."""
FOOTER_LIMIT = 2**24
"""Maximum number of bytes of the footer, which is read at once."""
ROWS_AT_ONCE = 1024
MAGIC = b"PAR1"
FIX = "Write it again as GeoParquet with WKB, as GDAL, DuckDB or geopandas do"
CODE = re.compile(r"(?:urn:ogc:def:crs:)?EPSG:(?:[\d.]*:)?(\d{4,6})")


def parquet_facts(path: Path) -> tuple[int, str, dict[str, Any] | None, tuple[str, ...]]:
    """Rows, geometry column, CRS (name and EPSG code; None if the file says that it is unknown), types of geometries.

    Raises
    ------
    UnreadableInputError
        Not Parquet, damaged, cut off, without geometry, or in an unsupported encoding.
    EmptyInputError
        No rows.
    TooLargeError
        More rows or bytes than allowed.
    CrsError
        Its CRS is a text that PROJ must not search for.
    """
    import pyarrow.parquet as pq

    _check_footer(path)
    with in_our_words(path, "Parquet", FIX, passing=(TooLargeError,)), pq.ParquetFile(path) as file:
        about = geometry_column(path, file.schema_arrow)
        if about.encoding != "WKB" and about.encoding not in DEPTHS:
            raise UnreadableInputError(str(path), f"its geometries are encoded as {about.encoding[:40]!r}", FIX)
        crs = None if about.crs is None else _crs_of(path, about.crs)
        rows = file.metadata.num_rows
        if rows == 0:
            raise EmptyInputError(str(path), "it has no rows", "Give polygons of buildings, or lines of roofs")
        if rows > ROWS_LIMIT:
            raise TooLargeError(
                f"{path.name} has {rows} rows, footprints or guides may have {ROWS_LIMIT}: cut out the area"
            )
        decoded, found = 0, 0
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=about.wanted, use_threads=False):
            found += batch.num_rows
            decoded += sum(max(_plain(path, column).nbytes, len(column)) for column in batch.columns)
            if decoded > DECODED_LIMIT:
                raise TooLargeError(
                    f"{path.name} holds more than {DECODED_LIMIT} bytes when decoded: cut out the area of "
                    "the points, or leave columns out"
                )
    if found != rows:
        raise UnreadableInputError(str(path), f"its footer promises {rows} rows, it holds {found}", FIX)
    return rows, about.name, crs, about.types


def _check_footer(path: Path) -> None:
    """Refuse a file that does not begin and end like Parquet, or whose footer is larger than any real one."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(len(MAGIC))
        stream.seek(max(size - 8, 0))
        tail = stream.read(8)
    if head != MAGIC:
        raise UnreadableInputError(str(path), f"not Parquet: it begins with {head!r}", FIX)
    if len(tail) < 8 or tail[4:] != MAGIC:
        raise UnreadableInputError(str(path), "truncated: a Parquet file ends with PAR1", FIX)
    footer = int.from_bytes(tail[:4], "little")
    if footer > min(size, FOOTER_LIMIT):
        raise UnreadableInputError(str(path), f"its footer claims {footer} of {size} bytes", FIX)


def _plain(path: Path, column: pa.Array) -> pa.Array:
    """The values of a column, decoded as its reader will get them."""
    import pyarrow as pa

    if pa.types.is_dictionary(column.type):
        return column.dictionary_decode()
    if "dictionary<" in str(column.type) or "run_end_encoded<" in str(column.type):
        raise UnreadableInputError(str(path), f"a column is of type {str(column.type)[:60]}", FIX)
    return column


def _crs_of(path: Path, text: str) -> dict[str, Any]:
    """Name and code of a CRS, from its text alone if it has them."""
    crs = checked_crs(text, path=str(path))
    code = CODE.fullmatch(text.strip())
    identity = json.loads(text).get("id") if text.lstrip().startswith("{") else None
    if isinstance(identity, dict) and identity.get("authority") == "EPSG":
        code = CODE.fullmatch(f"EPSG:{identity.get('code')}")
    return {"name": str(crs.name)[:200], "epsg": int(code[1]) if code else None}
