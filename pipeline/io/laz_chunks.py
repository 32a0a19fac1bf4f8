"""The chunk table of LAZ: how many compressed pieces a file has, where they are and how many points they hold.

A file of LASzip 1 (compressor 1, point by point) has no chunks, and counts as one that is never decoded at once.

The table is what a header's claim can be held against before anything is decoded. Source: M. Isenburg, LASzip:
lossless compression of LiDAR data, 2013, and the LASzip VLR (record 22204).
"""

from __future__ import annotations

import dataclasses
import struct
from typing import TYPE_CHECKING, BinaryIO

import lazrs
import numpy as np
import numpy.typing as npt

from pipeline.errors import InconsistentInputError, UnreadableInputError
from pipeline.io.file_facts import Readable
from pipeline.io.reading import moved

if TYPE_CHECKING:
    from pipeline.io.las_header import HeaderBlock
import contextlib
from collections.abc import Iterator

import laspy

CHUNK_SIZE_LIMIT = 4_000_000
"""Points a chunk beyond which chunks are not decoded at once: writers use 50,000, COPC some 100,000."""
CHUNK_BYTES_LIMIT = 2**29
"""The same in bytes: a record may have 65,535, and a chunk of equal records compresses to nearly nothing."""
POINTWISE = 1
"""The compressor of LASzip 1: one stream of points, without chunks and without a table of them."""
LAYERED_FORMAT = 6
"""The first point format whose chunks have layers."""
LAYERS = {6: (30, 9), 7: (36, 10), 8: (38, 11), 9: (59, 10), 10: (67, 12)}
"""Bytes a record without extra bytes, and compressed layers, by point format; each extra byte is a layer of its own."""
FIX = "Get the file again, or rewrite it with a LAZ tool"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChunkTable:
    """The compressed chunks of a LAZ file, in file order."""

    counts: npt.NDArray[np.int64]
    """(c,) points a chunk; in files of a fixed chunk size the last is what the header's count leaves for it."""
    sizes: npt.NDArray[np.int64]
    """(c,) bytes a chunk."""
    offsets: npt.NDArray[np.int64]
    """(c,) byte at which a chunk begins."""
    item_size: int
    """Bytes a record, uncompressed."""
    largest: int
    """Points that a decoder makes room for: the fixed chunk size, or the largest count."""
    variable: bool
    """True where each chunk has a count of its own (COPC)."""
    pointwise: bool = False
    """True where the file is one stream without chunks, which can only be decoded from its first point on."""

    @property
    def is_large(self) -> bool:
        """Whether a chunk is too large to be decoded at once."""
        return self.largest > CHUNK_SIZE_LIMIT or self.largest * self.item_size > CHUNK_BYTES_LIMIT


def decodable_record(laszip_record: bytes) -> bytes:
    """The LAZ VLR as lazrs understands it: some files of LASzip 1 have a chunk size of 0, which means none there."""
    if len(laszip_record) < 16 or struct.unpack_from("<H", laszip_record)[0] != POINTWISE:
        return laszip_record
    return laszip_record[:12] + struct.pack("<I", 1) + laszip_record[16:]


def read_chunk_table(path: Readable, stream: BinaryIO, block: HeaderBlock, laszip_record: bytes) -> ChunkTable:
    """The chunk table, checked against the header and the file's size without decoding a point.

    Raises
    ------
    UnreadableInputError
        If the table is missing or damaged, as in a truncated file.
    InconsistentInputError
        If the header promises more or fewer points than the chunks hold.
    """
    name, start = str(path), block.offset_to_points
    try:
        with decoding():
            vlr = lazrs.LazVlr(laszip_record)
            item_size, chunk_size = int(vlr.item_size()), int(vlr.chunk_size())
            variable = bool(vlr.uses_variable_size_chunks())
    except DECODING_ERRORS as fault:
        raise UnreadableInputError(name, f"the LAZ record in the header is damaged ({fault})", FIX) from fault
    if item_size != block.point_size:
        raise InconsistentInputError(
            name, f"the header has {block.point_size} bytes per point, its LAZ record {item_size}", FIX
        )
    if struct.unpack_from("<H", laszip_record)[0] == POINTWISE:
        return _one_stream(block, item_size)
    table_at = _table_offset(stream, block)
    if not start + 8 < table_at <= block.file_size - 8:
        raise UnreadableInputError(
            name,
            f"truncated: {block.point_count} points are promised, but the table of compressed chunks"
            f" should be at byte {table_at} of {block.file_size}",
            FIX,
        )
    stream.seek(table_at)
    _, chunk_count = struct.unpack("<II", stream.read(8))
    body = table_at - start - 8
    # Each chunk begins with one record uncompressed.
    if chunk_count == 0 or (chunk_count - 1) * item_size > body:
        raise UnreadableInputError(
            name, f"the table of compressed chunks is damaged: {chunk_count} chunks in {body} bytes", FIX
        )
    if not variable and (chunk_size == 0 or chunk_count != -(-block.point_count // chunk_size)):
        raise InconsistentInputError(
            name,
            f"the header promises {block.point_count} points, but the file holds {chunk_count} compressed"
            f" chunks of at most {chunk_size}, so at most {chunk_count * chunk_size}",
            FIX,
        )
    stream.seek(start)
    try:
        with decoding():
            rows = np.array(lazrs.read_chunk_table(stream, vlr), dtype=np.int64).reshape(-1, 2)
    except DECODING_ERRORS as fault:
        raise UnreadableInputError(name, f"the table of compressed chunks is damaged ({fault})", FIX) from fault
    counts, sizes = rows[:, 0].copy(), rows[:, 1]
    # Some writers of COPC end with an empty chunk.
    too_small = (sizes < item_size) & ~((sizes == 0) & (counts == 0))
    if len(rows) != chunk_count or too_small.any() or sizes.sum() != body:
        raise UnreadableInputError(
            name, f"the table of compressed chunks is damaged: {sizes.sum()} bytes of chunks in {body}", FIX
        )
    if not variable:
        counts[-1] = block.point_count - counts[:-1].sum()
    elif counts.sum() != block.point_count:
        raise InconsistentInputError(
            name, f"the header promises {block.point_count} points, its compressed chunks hold {counts.sum()}", FIX
        )
    offsets = start + 8 + np.concatenate(([0], np.cumsum(sizes)[:-1]))
    largest = int(counts.max()) if variable else chunk_size
    return ChunkTable(
        counts=counts, sizes=sizes, offsets=offsets, item_size=item_size, largest=largest, variable=variable
    )


def _one_stream(block: HeaderBlock, item_size: int) -> ChunkTable:
    """The table of a file without one: a single chunk that is never decoded at once."""
    return ChunkTable(
        counts=np.array([block.point_count]),
        sizes=np.array([block.file_size - block.offset_to_points]),
        offsets=np.array([block.offset_to_points]),
        item_size=item_size,
        largest=2**62,
        variable=False,
        pointwise=True,
    )


def _table_offset(stream: BinaryIO, block: HeaderBlock) -> int:
    """Byte of the chunk table; writers that could not seek leave -1 and put it into the file's last 8 bytes."""
    stream.seek(block.offset_to_points)
    raw = stream.read(8)
    if len(raw) < 8:
        return -1
    at = int(struct.unpack("<q", raw)[0])
    if at == -1 and block.file_size >= 8:
        stream.seek(block.file_size - 8)
        at = int(struct.unpack("<q", stream.read(8))[0])
    return at


def check_chunks(path: Readable, stream: BinaryIO, block: HeaderBlock, laszip_record: bytes, table: ChunkTable) -> None:
    """Hold the header's count against the chunks, to the point.

    Raises InconsistentInputError if the chunks hold another number of points, UnreadableInputError if one is damaged.
    """
    if block.point_format >= LAYERED_FORMAT:
        _check_layers(path, stream, block, table)
    elif not (table.variable or table.pointwise) and not last_is_large(table):
        _check_last_chunk(path, stream, block, laszip_record, table)


def last_is_large(table: ChunkTable) -> bool:
    """Whether the last chunk is too large to be decoded at once."""
    return dataclasses.replace(table, largest=int(table.counts[-1])).is_large


def _check_layers(path: Readable, stream: BinaryIO, block: HeaderBlock, table: ChunkTable) -> None:
    """Point formats 6 and above: the layers and counts of all chunks, and the header's count."""
    held = 0
    for chunk in np.flatnonzero(table.counts).tolist():
        moved()
        stream.seek(int(table.offsets[chunk]))
        held += check_chunk(path, stream.read(_layers_end(block)), block, table, chunk)
    if held != block.point_count:
        raise InconsistentInputError(
            str(path), f"the header promises {block.point_count} points, its chunks hold {held}", FIX
        )


def _layers_end(block: HeaderBlock) -> int:
    """Bytes at the start of a chunk of point formats 6 and above: one record, its count, the sizes of its layers."""
    base_size, layers = LAYERS[block.point_format]
    return block.point_size + 4 * (1 + layers + block.point_size - base_size)


def check_chunk(path: Readable, packed: bytes, block: HeaderBlock, table: ChunkTable, chunk: int) -> int:
    """Check a chunk of point formats 6 and above, of which `packed` has the first bytes at least; the points it holds.

    lazrs asks for as much memory as a layer's size says, so a damaged one must not get there.

    Raises
    ------
    UnreadableInputError
        If its layers are damaged.
    InconsistentInputError
        If it holds another number of points than the table says; only all chunks together tell this of the last one.
    """
    offset, size, count = int(table.offsets[chunk]), int(table.sizes[chunk]), int(table.counts[chunk])
    end = _layers_end(block)
    if len(packed) < end:
        raise UnreadableInputError(str(path), f"truncated: the chunk at byte {offset} has no layers", FIX)
    held, *sizes = np.frombuffer(packed[block.point_size : end], "<u4").tolist()
    if end + sum(sizes) != size:
        raise UnreadableInputError(str(path), f"the layers of the chunk at byte {offset} are damaged", FIX)
    if held != count and (table.variable or offset != table.offsets[-1]):
        raise InconsistentInputError(
            str(path), f"the chunk at byte {offset} has {held} points, the chunk table says {count}", FIX
        )
    return int(held)


def _check_last_chunk(
    path: Readable, stream: BinaryIO, block: HeaderBlock, laszip_record: bytes, table: ChunkTable
) -> None:
    """Older point formats: a chunk does not store its count, but its arithmetic coder uses up its bytes exactly.

    So the right count fails with one byte less, and with one point more.
    """
    count, size = int(table.counts[-1]), int(table.sizes[-1])
    stream.seek(int(table.offsets[-1]))
    chunk = stream.read(size)
    if size > table.item_size and _decodes(chunk[:-1], count, laszip_record, table.item_size):
        if _decodes(chunk, count + 1, laszip_record, table.item_size):
            raise InconsistentInputError(
                str(path), f"the header promises {block.point_count} points, its last chunk holds more", FIX
            )
    elif not _decodes(chunk, count, laszip_record, table.item_size):
        raise InconsistentInputError(
            str(path), f"the header promises {block.point_count} points, its last chunk ends before them", FIX
        )


def _decodes(chunk: bytes, count: int, laszip_record: bytes, item_size: int) -> bool:
    """Whether so many points can be decoded from the bytes of a chunk."""
    out = np.empty(count * item_size, dtype=np.uint8)
    selection = lazrs.DecompressionSelection(lazrs.SELECTIVE_DECOMPRESS_ALL)
    try:
        with decoding():
            lazrs.decompress_points_with_chunk_table(chunk, laszip_record, out, [(count, len(chunk))], selection)
    except DECODING_ERRORS:
        return False
    return True


DECODING_ERRORS = (lazrs.LazrsError, laspy.LaspyException, ArithmeticError, OSError, ValueError, struct.error)
"""What decoding a damaged file raises within `decoding`."""


_BINDINGS = "pyo3_runtime"
"""Module of the exceptions that stand for panics; it cannot be imported."""


@contextlib.contextmanager
def decoding() -> Iterator[None]:
    """Raise LazrsError in place of a panic of lazrs, and of memory that it cannot get for what the file claims."""
    try:
        yield
    except MemoryError as fault:
        raise lazrs.LazrsError("the file asks for more memory than there is") from fault
    except Exception:
        raise
    except BaseException as fault:
        if type(fault).__module__ != _BINDINGS:
            raise
        raise lazrs.LazrsError(f"the decoder met what cannot be: {fault}") from fault
