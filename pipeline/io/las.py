"""LAS 1.2 to 1.4 and LAZ, streamed. COPC is LAZ too; a window of it is read through its octree.

laspy knows the header, the records and their bit fields; decompression goes to lazrs directly, because only then the
unused fields can be left out, and because errors must name file and fix.
"""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import lazrs
import numpy as np
from laspy.copc import CopcInfoVlr
from laspy.point.record import PackedPointRecord

from pipeline.errors import InconsistentInputError, UnreadableInputError
from pipeline.io.apart import apart
from pipeline.io.file_facts import UNSORTED_CLASSES, FileFacts, PointRecords, Readable, Share, Window, bytes_of
from pipeline.io.gps_time import GpsTimeKind, kind_of
from pipeline.io.las_header import REWRITE, header_crs, read_header_block
from pipeline.io.laz_chunks import (
    DECODING_ERRORS,
    LAYERED_FORMAT,
    ChunkTable,
    check_chunk,
    check_chunks,
    decodable_record,
    decoding,
    read_chunk_table,
)
from pipeline.io.reading import moved
from pipeline.io.strays import Bounds, header_box_problem, typical_bounds
from pipeline.model import FloatArray

if TYPE_CHECKING:
    import numpy.typing as npt

    from pipeline.io.copc import OctreeInfo

SAMPLE_PLACES = 8
SAMPLE_SIZE = 2_000
"""Points looked at in each of some places of the file, to tell classes and GPS times without reading it all."""

USED_FIELDS = (
    lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
    | lazrs.SELECTIVE_DECOMPRESS_Z
    | lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
    | lazrs.SELECTIVE_DECOMPRESS_FLAGS
    | lazrs.SELECTIVE_DECOMPRESS_POINT_SOURCE_ID
    | lazrs.SELECTIVE_DECOMPRESS_GPS_TIME
)
"""What is decompressed of point formats 6 and above; the older ones know no selection."""

PIECE_BYTES = 2**27
"""Most bytes of records that are decoded at once, however long a record is."""


class LasFile:
    """A LAS, LAZ or COPC file.

    Parameters
    ----------
    facts : FileFacts, optional
        Those of the same file, opened before: then neither the points of its last chunk nor a sample is decoded again.

    Raises
    ------
    InputError
        If the header, the table of compressed chunks and the file's size do not fit one another.
    """

    def __init__(self, path: Readable, facts: FileFacts | None = None) -> None:
        self._path = path
        self._warnings: list[str] = []
        self._block = read_header_block(path)
        with path.open("rb") as stream:
            self._header = self._laspy_header(stream)
            # LAS: points with 0 are of the strip that the file has
            self._file_id = np.uint16(self._header.file_source_id)
            self._laszip_record = b""
            self._chunks: ChunkTable | None = None
            self._copc = None
            if self._block.compressed:
                self._laszip_record = self._read_laszip_record()
                self._chunks = read_chunk_table(path, stream, self._block, self._laszip_record)
                self._copc = _octree_of(self._header)
            else:
                self._check_room()
        self.facts = self._read_facts() if facts is None else facts

    def records(self, chunk_size: int, window: Window | None, share: Share | None = None) -> Iterator[PointRecords]:
        """The records in file order, in pieces of `chunk_size`; of COPC with a window only the nodes that meet it.

        With a share only its stretch of them: whole compressed chunks or nodes. Raises UnreadableInputError if the
        data end or break before the promised count.
        """
        chunk_size = max(1, min(chunk_size, PIECE_BYTES // self._block.point_size))
        if self._chunks is not None and (share is not None or (window is not None and self._copc is not None)):
            yield from self._chunk_records(chunk_size, window, share)
            return
        for raw in self._raw(chunk_size, USED_FIELDS, share):
            yield self._to_records(raw)

    def whole_records(self, chunk_size: int) -> Iterator[tuple[npt.NDArray[np.uint8], PointRecords]]:
        """As `records`, without a window, but each piece also as its bytes with every field."""
        chunk_size = max(1, min(chunk_size, PIECE_BYTES // self._block.point_size))
        for raw in self._raw(chunk_size, lazrs.SELECTIVE_DECOMPRESS_ALL, None):
            yield raw, self._to_records(raw)

    def _raw(self, chunk_size: int, fields: int, share: Share | None) -> Iterator[npt.NDArray[np.uint8]]:
        """The bytes of the records in file order; of compressed files some of the fields only, and no share."""
        first, end = 0, self._block.point_count
        if share is not None:
            first, end = (end * k // share.of for k in (share.number, share.number + 1))
        with self._path.open("rb") as stream:
            if self._chunks is not None and self._block.point_format >= LAYERED_FORMAT:
                check_chunks(self._path, stream, self._block, self._laszip_record, self._chunks)
            decoder = self._decoder(stream, fields, first)
            for begin in range(first, end, chunk_size):
                yield self._decode(decoder, min(chunk_size, end - begin), begin)

    def _chunk_records(self, chunk_size: int, window: Window | None, share: Share | None) -> Iterator[PointRecords]:
        """Records of whole compressed chunks, small ones together and large ones in pieces.

        They are the octree nodes that meet a window, or all chunks; with a share its stretch of them.
        """
        table = self._chunks
        assert table is not None
        if table.is_large:
            # such chunks are never decoded at once, so the first share is the whole file
            yield from () if share is not None and share.number else self.records(chunk_size, None)
            return
        with self._path.open("rb") as stream:
            chunks = np.flatnonzero(table.counts)
            if window is not None and self._copc is not None:
                from pipeline.io.copc import nodes_within

                nodes = nodes_within(self._path, stream, self._copc, window, self._block.file_size)
                chunks = self._chunks_of(nodes)
            if share is not None:
                ends = np.cumsum(table.counts[chunks])
                chunks = chunks[share.pieces(ends - table.counts[chunks], int(table.counts[chunks].sum()))]
            batch: list[npt.NDArray[np.uint8]] = []
            for chunk in chunks.tolist():
                held = sum(map(len, batch)) // self._block.point_size
                if batch and held + table.counts[chunk] > chunk_size:
                    yield from self._pieces(batch, chunk_size)
                    batch = []
                batch.append(self._decode_chunk(stream, chunk, int(table.counts[chunk])))
            if batch:
                yield from self._pieces(batch, chunk_size)

    def _chunks_of(self, nodes: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
        """Numbers of the chunks of some octree nodes; raises UnreadableInputError unless each has one of its own."""
        table = self._chunks
        assert table is not None
        filled = np.flatnonzero(table.counts)
        place = np.minimum(np.searchsorted(table.offsets[filled], nodes["offset"].astype(np.int64)), len(filled) - 1)
        chunks = filled[place]
        is_right = table.offsets[chunks] == nodes["offset"].astype(np.int64)
        is_right &= (table.sizes[chunks] == nodes["size"]) & (table.counts[chunks] == nodes["count"])
        if not is_right.all() or len(np.unique(chunks)) < len(chunks):
            problem = "the octree is damaged: its nodes are not the compressed chunks of the file"
            raise UnreadableInputError(str(self._path), problem, "Get the file again, or rewrite it as LAZ")
        return chunks

    def _pieces(self, batch: list[npt.NDArray[np.uint8]], chunk_size: int) -> Iterator[PointRecords]:
        """Records of some decoded chunks, at most so many a piece."""
        raw, step = np.concatenate(batch), chunk_size * self._block.point_size
        for begin in range(0, len(raw), step):
            yield self._to_records(raw[begin : begin + step])

    def _laspy_header(self, stream: io.BufferedReader) -> laspy.LasHeader:
        """The header by laspy; what it makes of damaged records is any of Python's errors."""
        try:
            header = laspy.LasHeader.read_from(stream)
            item_size = header.point_format.dtype().itemsize
        except (
            laspy.LaspyException,
            ArithmeticError,
            AttributeError,
            LookupError,
            TypeError,
            ValueError,
            struct.error,
        ) as fault:
            raise UnreadableInputError(str(self._path), f"the LAS header is damaged ({fault})", REWRITE) from fault
        if item_size != self._block.point_size:
            raise InconsistentInputError(
                str(self._path),
                f"the header has {self._block.point_size} bytes per point, its format and extra fields {item_size}",
                REWRITE,
            )
        return header

    def _read_laszip_record(self) -> bytes:
        """The LAZ VLR, which describes the compression."""
        try:
            record = bytes(self._header.vlrs[self._header.vlrs.index("LasZipVlr")].record_data)
        except ValueError as fault:
            raise UnreadableInputError(str(self._path), "the file is compressed but has no LAZ VLR", REWRITE) from fault
        return decodable_record(record)

    def _check_room(self) -> None:
        """Hold the promised count against the bytes of an uncompressed file."""
        block = self._block
        room = block.end_of_points - block.offset_to_points
        held, rest = divmod(room, block.point_size)
        problem = f"the header promises {block.point_count} points, the file has room for {held}"
        if held < block.point_count:
            if rest:
                raise UnreadableInputError(str(self._path), f"truncated: {problem} and a piece", REWRITE)
            raise InconsistentInputError(str(self._path), problem, REWRITE)
        if held > block.point_count and not rest:
            raise InconsistentInputError(str(self._path), problem, REWRITE)
        spare = room - block.point_count * block.point_size
        if spare:
            self._warnings.append(f"{spare} bytes follow the points and are not read")

    def _decoder(self, stream: io.BufferedReader, fields: int, first: int) -> Any:
        """The thing that gives the next records: lazrs where compressed, else the stream, at the first wanted one."""
        stream.seek(self._block.offset_to_points)
        if self._chunks is None:
            stream.seek(first * self._block.point_size, io.SEEK_CUR)
            return stream
        # The parallel one makes room for a whole chunk, so chunks without measure go to the sequential one.
        make = lazrs.LasZipDecompressor if self._chunks.is_large else lazrs.ParLasZipDecompressor
        try:
            with decoding():
                return make(stream, self._laszip_record, lazrs.DecompressionSelection(fields))
        except DECODING_ERRORS as fault:
            raise self._broken(fault, "at the start") from fault

    def _decode(self, decoder: Any, count: int, begin: int) -> npt.NDArray[np.uint8]:
        """The bytes of the next records."""
        raw = np.empty(count * self._block.point_size, dtype=np.uint8)
        try:
            if self._chunks is not None:
                with decoding():
                    decoder.decompress_many(raw)
            else:
                read_exactly(decoder, raw)
        except (*DECODING_ERRORS, EOFError) as fault:
            raise self._broken(fault, f"between points {begin} and {begin + count}") from fault
        return raw

    def _decode_chunk(self, stream: io.BufferedReader, chunk: int, count: int) -> npt.NDArray[np.uint8]:
        """The bytes of the first records of a compressed chunk."""
        table = self._chunks
        assert table is not None
        offset, size = int(table.offsets[chunk]), int(table.sizes[chunk])
        packed = bytes_of(self._path, stream, offset, size)
        if len(packed) < size:
            problem = f"truncated: {len(packed)} of the {size} bytes of the chunk at byte {offset} are there"
            raise UnreadableInputError(str(self._path), problem, REWRITE)
        if self._block.point_format >= LAYERED_FORMAT:
            check_chunk(self._path, packed, self._block, table, chunk)
        raw = np.empty(count * self._block.point_size, dtype=np.uint8)
        try:
            fields = lazrs.DecompressionSelection(USED_FIELDS)
            with decoding():
                lazrs.decompress_points_with_chunk_table(packed, self._laszip_record, raw, [(count, size)], fields)
        except DECODING_ERRORS as fault:
            raise self._broken(fault, f"in the chunk at byte {offset}") from fault
        return raw

    def _broken(self, fault: Exception, where: str) -> UnreadableInputError:
        """The error for data that cannot be decoded."""
        problem = f"the point data are damaged or truncated {where} of {self._block.point_count} ({fault})"
        return UnreadableInputError(str(self._path), problem, REWRITE)

    def _to_records(self, raw: npt.NDArray[np.uint8]) -> PointRecords:
        """Arrays of the fields that are used."""
        moved()
        packed = PackedPointRecord.from_buffer(raw, self._header.point_format)
        array = packed.array
        xyz = np.empty((len(array), 3), dtype=np.float64)
        for axis, name in enumerate(("X", "Y", "Z")):
            np.multiply(array[name], self._header.scales[axis], out=xyz[:, axis])
            xyz[:, axis] += self._header.offsets[axis]
        return PointRecords(
            xyz=xyz,
            return_number=np.asarray(packed["return_number"], dtype=np.uint8),
            return_count=np.asarray(packed["number_of_returns"], dtype=np.uint8),
            classification=np.asarray(packed["classification"], dtype=np.uint8),
            gps_time=np.array(array["gps_time"]) if "gps_time" in array.dtype.names else None,
            source_id=np.where(array["point_source_id"] == 0, self._file_id, array["point_source_id"]),
            withheld=np.asarray(packed["withheld"], dtype=np.bool_),
        )

    def _checked_sample(self) -> PointRecords:
        """As `_sample`, of chunks that were held against the header."""
        # the layers of a remote file are checked when its chunks are read: a plan needs few of these
        if isinstance(self._path, Path) or self._block.point_format < LAYERED_FORMAT:
            assert self._chunks is not None
            with self._path.open("rb") as stream:
                check_chunks(self._path, stream, self._block, self._laszip_record, self._chunks)
        return self._sample()

    def _sample(self) -> PointRecords:
        """Points from some places spread over the file, in file order; of COPC the coarsest node."""
        pieces, most = [], max(1, min(SAMPLE_SIZE, PIECE_BYTES // SAMPLE_PLACES // self._block.point_size))
        with self._path.open("rb") as stream:
            root = self._root_chunk(stream)
            if self._chunks is not None and root is not None:
                return self._to_records(self._decode_chunk(stream, root, int(self._chunks.counts[root])))
            if self._chunks is None:
                last = max(self._block.point_count - most, 0)
                for start in _places(last):
                    stream.seek(self._block.offset_to_points + start * self._block.point_size)
                    count = min(most, self._block.point_count - start)
                    pieces.append(self._decode(stream, count, start))
            elif self._chunks.pointwise:
                count = min(most, self._block.point_count)
                pieces.append(self._decode(self._decoder(stream, USED_FIELDS, 0), count, 0))
            else:
                filled = np.flatnonzero(self._chunks.counts)
                for chunk in filled[_places(len(filled) - 1)].tolist():
                    count = min(most, int(self._chunks.counts[chunk]))
                    pieces.append(self._decode_chunk(stream, chunk, count))
        return self._to_records(np.concatenate(pieces))

    def _root_chunk(self, stream: io.BufferedReader) -> int | None:
        """The chunk of an octree's root; None without one, or where it is damaged: the file can still be read whole."""
        if self._copc is None or self._chunks is None or self._chunks.is_large:
            return None
        from pipeline.io.copc import root_node

        try:
            root = self._chunks_of(root_node(self._path, stream, self._copc, self._block.file_size))
        except UnreadableInputError:
            return None
        return int(root[0]) if len(root) else None

    def _read_facts(self) -> FileFacts:
        """The facts from header and sample."""
        header, block = self._header, self._block
        sample = self._sample() if self._chunks is None else apart(self._checked_sample, str(self._path))
        found = header_crs(self._path, header, block)
        self._warnings.extend(found.warnings)
        by_return = [int(n) for n in header.number_of_points_by_return]
        assert sample.return_count is not None
        assert sample.classification is not None
        has_returns = any(by_return[1:]) or bool((sample.return_count > 1).any())
        if block.minor >= 4 and block.legacy_count not in {0, block.point_count}:
            self._warnings.append(
                f"the old point count {block.legacy_count} differs from the 64-bit one {block.point_count}"
            )
        kind, time_range = GpsTimeKind.NONE, None
        if sample.gps_time is not None and np.isfinite(sample.gps_time).all():
            time_range = float(sample.gps_time.min()), float(sample.gps_time.max())
            flagged = bool(block.flags & 1)
            # LAS 1.5 may name an offset of its own.
            kind = GpsTimeKind.UNKNOWN if block.minor > 4 else kind_of(*time_range, flagged_as_adjusted=flagged)
            if kind is GpsTimeKind.ADJUSTED and not flagged:
                self._warnings.append("GPS times are flagged as seconds of the week but are adjusted standard time")
        return FileFacts(
            format="copc" if self._copc is not None else "laz" if block.compressed else "las",
            point_count=block.point_count,
            bounds=self._bounds(sample.xyz),
            crs=found.crs,
            horizontal_unit_m=found.horizontal_unit_m,
            vertical_unit_m=found.vertical_unit_m,
            has_returns=has_returns,
            has_classes=not bool(np.isin(sample.classification, UNSORTED_CLASSES).all()),
            has_gps_time=kind is not GpsTimeKind.NONE,
            gps_time_kind=kind,
            gps_time_range=None if kind is GpsTimeKind.NONE else time_range,
            typical_bounds=typical_bounds([sample.xyz]),
            created=header.creation_date,
            dimensions=_dimensions_of(header.point_format),
            warnings=tuple(self._warnings),
        )

    def _bounds(self, sample: FloatArray) -> Bounds:
        """The header's bounds; those of a pass over the points where they cannot be, or some points contradict them."""
        lows, highs = np.array(self._header.mins), np.array(self._header.maxs)
        problem = header_box_problem(lows, highs, sample)
        if problem is not None:
            measured = apart(self._bounds_of_points, str(self._path))
            if not np.allclose((lows, highs), measured, rtol=0.0, atol=1.0):
                box = f"the header's bounds {lows.tolist()} to {highs.tolist()}"
                self._warnings.append(f"{box} {problem}: taken from the points")
            lows, highs = measured
        x_min, y_min, z_min, x_max, y_max, z_max = (float(value) for value in (*lows, *highs))
        return x_min, y_min, z_min, x_max, y_max, z_max

    def _bounds_of_points(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The (3,) lowest and highest coordinates of all points."""
        lows, highs = np.full(3, np.inf), np.full(3, -np.inf)
        for piece in self.records(1_000_000, None):
            lows, highs = np.minimum(lows, piece.xyz.min(axis=0)), np.maximum(highs, piece.xyz.max(axis=0))
        return lows, highs


def _octree_of(header: laspy.LasHeader) -> OctreeInfo | None:
    """The octree of a COPC file, which its first record describes; None for other files."""
    if not header.vlrs or not isinstance(header.vlrs[0], CopcInfoVlr):
        return None
    from pipeline.io.copc import octree_info

    return octree_info(header.vlrs[0])


def _places(last: int) -> list[int]:
    """Some numbers spread from 0 to the last one, each once; `np.unique` would load masked arrays first."""
    return sorted(set(np.linspace(0, last, SAMPLE_PLACES).astype(np.int64).tolist()))


def read_exactly(stream: io.BufferedReader, into: npt.NDArray[np.uint8]) -> None:
    """Fill an array from a stream; EOFError if the stream ends before."""
    if stream.readinto(into.data) != len(into):
        raise EOFError("the file ends")


def _dimensions_of(point_format: laspy.PointFormat) -> tuple[tuple[str, str], ...]:
    """Names and types of the fields of a point, extra bytes included; fields of single bits are u1."""
    letters = {
        laspy.DimensionKind.SignedInteger: "i",
        laspy.DimensionKind.UnsignedInteger: "u",
        laspy.DimensionKind.FloatingPoint: "f",
        laspy.DimensionKind.BitField: "u",
    }
    return _shared(tuple((one.name, f"{letters[one.kind]}{-(-one.num_bits // 8)}") for one in point_format.dimensions))


@functools.lru_cache(maxsize=64)
def _shared(dimensions: tuple[tuple[str, str], ...]) -> tuple[tuple[str, str], ...]:
    """Equal ones are one object: the driver of a country holds those of all its files."""
    return dimensions
