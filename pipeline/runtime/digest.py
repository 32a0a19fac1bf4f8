"""The digest of a run: one sha256 over its content, independent of workers, tiles, files and the Parquet writer.

Content is all columns of buildings, planes and rejected except `NOT_CONTENT`, in the order of the rows' keys. Of
`reason_detail` only the figures count, so a better wording changes no digest. Every row is hashed by itself in a
canonical form (columns by name; integers, floats and times as eight bytes, texts as UTF-8, null unlike any value). A
column of `ADDED` that is null in a row is left out of it: a run without overhangs or guides has the digest that it had
before there were columns for them. The row hashes are then hashed in the order of the keys, so only the keys and 32
bytes per row are held in memory.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.fs as pafs

from pipeline.errors import RunError
from pipeline.export.geoparquet import stored_schema, table_batches
from pipeline.export.record_rows import KEYS
from pipeline.export.solid_geometry import OVERHANG_COLUMNS
from pipeline.io import arrow_at

NOT_CONTENT = frozenset(
    {
        *("tile", "mesh_path", "input_hash", "settings_hash", "engine_version"),
        *("height_source", "ground_source", "extrapolated", "extrapolated_share"),
    }
)
"""Columns that may differ between runs with equal results (by tiling, names of settings, or the version), and those
that say where figures come from: the figures themselves and the reasons count."""
ADDED = frozenset(
    {
        *("solid_lod20", "solid_lod20_parts", "solid_lod20_surfaces", "boxes", "n_boxes"),
        *(*OVERHANG_COLUMNS, "overhang_source", "lod23_reason", "guides_followed", "guides_not_followed"),
    }
)
"""Columns that only options fill which were added later: they count in rows that have a value there."""
FIGURES_ONLY = "reason_detail"
"""The column whose figures count and whose words do not."""
ROWS_A_BATCH = 8192
"""Rows in memory at once."""

_FIGURE = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")
_NULL, _PRESENT = b"\x00", b"\x01"
_HASH_BYTES = hashlib.sha256().digest_size

Fixed = npt.NDArray[np.uint8]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rows:
    """n rows of a table, in the order of their keys."""

    keys: tuple[npt.NDArray[Any], ...]
    """The key columns, (n,) each: bytes or integers."""
    hashes: Fixed
    """(n, 32) sha256 of each row."""

    def between(self, low: bytes, high: bytes | None) -> Rows:
        """Those whose first key is at least `low` and smaller than `high`; None is the end."""
        first = np.searchsorted(self.keys[0], low)
        last = len(self.hashes) if high is None else np.searchsorted(self.keys[0], high)
        return Rows(keys=tuple(column[first:last] for column in self.keys), hashes=self.hashes[first:last])


def rows_of(table: pa.Table, name: str) -> Rows:
    """The rows of a table as the digest counts them; raises RunError if it lacks a key."""
    columns = [column for column in stored_schema(name).names if column not in NOT_CONTENT]
    batches = table.select(columns).to_batches(ROWS_A_BATCH)
    return merged(name, [_rows_of_batch(batch, name, name) for batch in batches])


def merged(name: str, parts: Sequence[Rows]) -> Rows:
    """Parts of a table together, in the order of the keys; raises RunError if a key comes twice."""
    key = KEYS[name]
    parts = [part for part in parts if len(part.hashes)]
    if not parts:
        return Rows(keys=tuple(np.empty(0, "S1") for _ in key), hashes=np.empty((0, _HASH_BYTES), np.uint8))
    keys = [np.concatenate([part.keys[k] for part in parts]) for k in range(len(key))]
    order = np.lexsort(tuple(reversed(keys)))
    _check_unique(name, key, keys, order)
    hashes = np.concatenate([part.hashes for part in parts])
    return Rows(keys=tuple(column[order] for column in keys), hashes=hashes[order])


def digest_of(tables: Mapping[str, tuple[int, Iterable[Fixed]]]) -> str:
    """The sha256 of a run, from the number of rows of each table and their hashes in the order of the keys."""
    content = hashlib.sha256(b"gablework content 2\n")
    for name in KEYS:
        count, parts = tables[name]
        content.update(f"{name} {count}\n".encode())
        for hashes in parts:
            content.update(np.ascontiguousarray(hashes).data)
    return content.hexdigest()


def run_digest(run_dir: str, filesystem: pafs.FileSystem | None = None, tiles: Sequence[str] | None = None) -> str:
    """The sha256 of a run's content in hexadecimal.

    Raises RunError if the directory lacks one of the tables, a table lacks its key, or an object comes twice.

    Parameters
    ----------
    run_dir : str
        The run directory: a path or URL, or a path of `filesystem`.
    filesystem : pyarrow.fs.FileSystem, optional
        Storage of the run; by default as `run_dir` says.
    tiles : sequence of str, optional
        Keys of the tiles that have tables; by default the run directory is listed.
    """
    if filesystem is None:
        filesystem, run_dir = arrow_at(run_dir)
    tables = {}
    for name in KEYS:
        columns = [column for column in stored_schema(name).names if column not in NOT_CONTENT]
        batches = table_batches(run_dir, name, columns, filesystem, tiles, ROWS_A_BATCH)
        rows = merged(name, [_rows_of_batch(batch, name, f"{run_dir}/{name}") for batch in batches if batch.num_rows])
        tables[name] = (len(rows.hashes), [rows.hashes])
    return digest_of(tables)


def _rows_of_batch(batch: pa.RecordBatch, name: str, where: str) -> Rows:
    """The rows of a batch in their order there."""
    digests = b"".join(hashlib.sha256(row).digest() for row in canonical_rows(batch))
    return Rows(
        keys=tuple(_key_values(batch.column(column), where, column) for column in KEYS[name]),
        hashes=np.frombuffer(digests, np.uint8).reshape(-1, _HASH_BYTES),
    )


def _key_values(column: pa.Array, folder: str, name: str) -> npt.NDArray[Any]:
    """A key column as an array that sorts: bytes or integers."""
    if column.null_count:
        raise RunError(f"{folder} has {column.null_count} rows without {name}: it was not written by this program")
    if _is_text(column.type):
        return np.array([text.encode() for text in column.to_pylist()])
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.int64)


def _check_unique(name: str, key: tuple[str, ...], keys: list[npt.NDArray[Any]], order: npt.NDArray[Any]) -> None:
    """Refuse a table with two rows of one key, since their order, and with it the digest, would be undefined."""
    if len(order) < 2:
        return
    same = np.ones(len(order) - 1, dtype=bool)
    for values in keys:
        ordered = values[order]
        same &= ordered[1:] == ordered[:-1]
    if same.any():
        row = order[int(np.argmax(same))]
        cells = [column[row].item() for column in keys]
        texts = [value.decode() if isinstance(value, bytes) else value for value in cells]
        found = ", ".join(f"{column} {text!r}" for column, text in zip(key, texts, strict=True))
        raise RunError(f"{name} has more than one row of {found}: files of two runs lie in one directory")


def canonical_rows(batch: pa.RecordBatch) -> Iterator[bytes]:
    """Every row of a batch as bytes that depend only on names and values, not on Arrow's representation."""
    names = sorted(set(batch.schema.names) - ADDED)
    cells = [_cells(batch.column(name), name) for name in names]
    added = sorted(ADDED.intersection(batch.schema.names))
    further = [[b""] * batch.num_rows]
    for name in added:
        heading = _sized(name.encode())
        further.append([b"" if cell == _NULL else heading + cell for cell in _cells(batch.column(name), name)])
    heading = "\x1f".join(names).encode()
    for row in zip(*cells, *further, strict=True):
        yield heading + b"".join(row)


def figures_of(detail: str) -> str:
    """The figures of a reason's wording, sorted, so that their order in the sentence does not count.

    Examples
    --------
    >>> figures_of("12 points, fewer than min_points 24.5")
    '12 24.5'
    """
    return " ".join(sorted(_FIGURE.findall(detail)))


def _is_text(kind: pa.DataType) -> bool:
    """Whether a type is a string type, also dictionary encoded."""
    if pa.types.is_dictionary(kind):
        return _is_text(kind.value_type)
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _is_binary(kind: pa.DataType) -> bool:
    """Whether a type is a bytes type."""
    return bool(pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_binary_view(kind))


def _cells(column: pa.Array, name: str) -> list[bytes]:
    """The cells of a column: a zero byte for null, else a one byte and the value."""
    kind = column.type
    if name == FIGURES_ONLY:
        column = pa.array([None if text is None else figures_of(text) for text in column.to_pylist()], pa.string())
        kind = column.type
    if _is_text(kind):
        return [_NULL if text is None else _sized(text.encode()) for text in column.to_pylist()]
    if _is_binary(kind):
        return [_NULL if data is None else _sized(data) for data in column.to_pylist()]
    if pa.types.is_struct(kind):
        return _struct_cells(column, name)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        items = _cells(column.flatten(), name)
        return _list_cells(column, items)
    return _fixed_cells(column, name)


def _sized(data: bytes) -> bytes:
    """Bytes preceded by their length, so that neighbours cannot run together."""
    return _PRESENT + struct.pack("<Q", len(data)) + data


def _fixed_cells(column: pa.Array, name: str) -> list[bytes]:
    """Numbers, truth values and times as eight little-endian bytes."""
    kind = column.type
    if pa.types.is_timestamp(kind):
        column = pc.cast(column, pa.timestamp("us", tz=kind.tz)).cast(pa.int64())
    elif pa.types.is_boolean(kind) or pa.types.is_integer(kind):
        column = column.cast(pa.int64())
    elif pa.types.is_floating(kind):
        column = column.cast(pa.float64())
    else:
        raise RunError(f"column {name} has type {kind}, which the digest does not know")
    present = column.is_valid().to_numpy(zero_copy_only=False)
    dtype = np.dtype("<f8") if pa.types.is_floating(column.type) else np.dtype("<i8")
    values = column.fill_null(0).to_numpy(zero_copy_only=False).astype(dtype)
    if dtype.kind == "f":
        # one zero and one nan, whatever their bits
        values = np.where(np.isnan(values), np.nan, values + 0.0)
    data = values.tobytes()
    return [_PRESENT + data[8 * i : 8 * i + 8] if there else _NULL for i, there in enumerate(present.tolist())]


def _struct_cells(column: pa.StructArray, name: str) -> list[bytes]:
    """The fields of each struct in the order of their names."""
    fields = sorted(field.name for field in column.type)
    parts = [_cells(column.field(field), f"{name}.{field}") for field in fields]
    present = column.is_valid().to_pylist()
    return [_PRESENT + b"".join(cells) if there else _NULL for there, *cells in zip(present, *parts, strict=True)]


def _list_cells(column: pa.Array, items: list[bytes]) -> list[bytes]:
    """Every list as its length and its items."""
    cells, start = [], 0
    for length in pc.list_value_length(column).to_pylist():
        if length is None:
            cells.append(_NULL)
            continue
        cells.append(_PRESENT + struct.pack("<Q", length) + b"".join(items[start : start + length]))
        start += length
    return cells
