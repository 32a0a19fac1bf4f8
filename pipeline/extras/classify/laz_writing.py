"""LAZ 1.4 in point formats 6, 7 and 8: records of every older format, converted without loss, and the file around them.

Source: ASPRS, LAS Specification 1.4 R15, tables 3, 4, 7 to 17, 22; LASzip as implemented by lazrs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import lazrs
import numpy as np
import numpy.typing as npt

from pipeline.model import ByteArray

HEADER_SIZE = 375
KEEP = 255
"""In place of a class: the point keeps its own."""
OVERLAP_CLASS = 12
"""Class of overlap points in point formats 0 to 5; the newer ones have a flag for it."""
WKT_BIT = 1 << 4
WAVEFORM_FORMATS = (4, 5, 9, 10)

_PLACE: list[tuple[str, Any]] = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2")]
_GPS: list[tuple[str, Any]] = [("gps_time", "<f8")]
_RGB: list[tuple[str, Any]] = [("rgb", "<u2", (3,))]  # type: ignore[list-item]
_NIR: list[tuple[str, Any]] = [("nir", "<u2")]
_OLD: list[tuple[str, Any]] = [
    *_PLACE,
    ("bits", "u1"),
    ("class_bits", "u1"),
    ("scan_angle_rank", "i1"),
    ("user_data", "u1"),
    ("point_source_id", "<u2"),
]
_NEW: list[tuple[str, Any]] = [
    *_PLACE,
    ("returns", "u1"),
    ("flags", "u1"),
    ("classification", "u1"),
    ("user_data", "u1"),
    ("scan_angle", "<i2"),
    ("point_source_id", "<u2"),
    *_GPS,
]
_FIELDS = {
    0: _OLD,
    1: [*_OLD, *_GPS],
    2: [*_OLD, *_RGB],
    3: [*_OLD, *_GPS, *_RGB],
    6: _NEW,
    7: [*_NEW, *_RGB],
    8: [*_NEW, *_RGB, *_NIR],
}
NEWER_FORMAT = {0: 6, 1: 6, 2: 7, 3: 7, 6: 6, 7: 7, 8: 8}
"""The point format that a file's records are written in."""
SCAN_ANGLE_UNIT_DEG = 0.006


def record_dtype(point_format: int, size: int) -> np.dtype[np.void]:
    """A record of one of the formats 0 to 3 and 6 to 8, its extra bytes in the field `extra`."""
    base = np.dtype(_FIELDS[point_format]).itemsize
    return np.dtype([*_FIELDS[point_format], ("extra", "u1", (size - base,))])


def to_newer_format(raw: ByteArray, point_format: int, size: int) -> npt.NDArray[np.void]:
    """Records of any format but those with waveforms, as records of format 6, 7 or 8.

    A scan angle rank in whole degrees becomes a scan angle in units of 0.006 deg; the old class 12 (overlap) becomes
    the overlap flag as well, since the class will be another one; a format without GPS time gets zeros. From the bytes
    of the file's records, (n * size,), returns (n,) of `record_dtype(NEWER_FORMAT[point_format], …)`; a view of them if
    the format is one of the newer ones.
    """
    old = raw.view(record_dtype(point_format, size))
    if point_format >= 6:
        return old
    wanted = NEWER_FORMAT[point_format]
    extra = old.dtype["extra"].itemsize
    new = np.zeros(len(old), record_dtype(wanted, np.dtype(_FIELDS[wanted]).itemsize + extra))
    for name in ("X", "Y", "Z", "intensity", "user_data", "point_source_id", "gps_time", "rgb", "extra"):
        if name in (old.dtype.names or ()) and name in (new.dtype.names or ()):
            new[name] = old[name]
    bits, classes = old["bits"], old["class_bits"]
    new["returns"] = (bits & 7) | ((bits >> 3 & 7) << 4)
    own = classes & 31
    overlap = (own == OVERLAP_CLASS).astype(np.uint8)
    # synthetic, key point and withheld are bits 5 to 7 of the old class byte and 0 to 2 of the new flags
    new["flags"] = (classes >> 5) | (overlap << 3) | (bits & 0xC0)
    new["classification"] = own
    new["scan_angle"] = np.rint(old["scan_angle_rank"] / SCAN_ANGLE_UNIT_DEG).astype(np.int16)
    return new


def classified(records: npt.NDArray[np.void], classes: ByteArray) -> npt.NDArray[np.void]:
    """A copy of the records with other classes; those of class `KEEP` keep their own."""
    out = records.copy()
    out["classification"] = np.where(classes == KEEP, records["classification"], classes)
    return out


def header_of(
    *,
    point_format: int,
    size: int,
    scales: tuple[float, float, float],
    offsets: tuple[float, float, float],
    software: str,
    older: bytes = bytes(HEADER_SIZE),
    wkt: bool = True,
) -> bytes:
    """The public header block of LAS 1.4 in point format 6, 7 or 8; the writer fills in counts, bounds and places.

    `size` is the bytes of a record with its extra bytes; scales and offsets are those of the integer coordinates.
    Source id, encoding, GUID, system and day of creation are taken over from an `older` header. `wkt` sets the bit that
    says that the CRS is stored as WKT.
    """
    header = bytearray(HEADER_SIZE)
    header[:90] = older[:90]  # signature, source id, encoding, GUID, version, system, software
    header[90:94] = older[90:94]
    encoding = struct.unpack_from("<H", older, 6)[0] & ~(WKT_BIT | 0b110)  # no waveforms
    struct.pack_into("<4s", header, 0, b"LASF")
    struct.pack_into("<H", header, 6, encoding | (WKT_BIT if wkt else 0))
    struct.pack_into("<BB", header, 24, 1, 4)
    struct.pack_into("<32s", header, 58, software.encode("ascii", "replace")[:32])
    struct.pack_into("<HII", header, 94, HEADER_SIZE, 0, 0)
    struct.pack_into("<BH", header, 104, point_format | 0x80, size)
    struct.pack_into("<6d", header, 131, *scales, *offsets)
    return bytes(header)


class LazWriter:
    """A LAZ 1.4 file under way: records come in pieces, header and extended records when it ends.

    The stream is empty, and open for writing and seeking; the header is that of `header_of`. The variable length
    records (user id, record id, description, data) do not include that of LAZ.
    """

    def __init__(
        self, stream: BinaryIO, header: bytes, records: Iterable[tuple[bytes, int, bytes, bytes]] = ()
    ) -> None:
        self._stream, self._header = stream, bytearray(header)
        format_byte, self._size = struct.unpack_from("<BH", header, 104)
        point_format = format_byte & 0x3F
        base = np.dtype(_FIELDS[point_format]).itemsize
        self._vlr = lazrs.LazVlr.new_for_compression(point_format, self._size - base)
        kept = [*records, (b"laszip encoded", 22204, b"by lazrs", bytes(self._vlr.record_data()))]
        body = b"".join(_record_head(*entry[:3], len(entry[3])) + entry[3] for entry in kept)
        struct.pack_into("<II", self._header, 96, HEADER_SIZE + len(body), len(kept))
        stream.write(bytes(self._header) + body)
        self._compressor = lazrs.ParLasZipCompressor(stream, self._vlr)
        self._compressor.reserve_offset_to_chunk_table()
        self._count = 0
        self._by_return = np.zeros(15, np.int64)
        self._low = np.full(3, 2**31, np.int64)
        self._high = np.full(3, -(2**31), np.int64)

    def write(self, records: npt.NDArray[np.void]) -> None:
        """Append records of the header's format."""
        if len(records) == 0:
            return
        for axis, name in enumerate("XYZ"):
            self._low[axis] = min(self._low[axis], int(records[name].min()))
            self._high[axis] = max(self._high[axis], int(records[name].max()))
        # return number 0 is not legal; such points are in no count
        self._by_return += np.bincount(records["returns"] & 15, minlength=16)[1:]
        self._count += len(records)
        self._compressor.compress_many(np.ascontiguousarray(records).view(np.uint8))

    def close(self, extended: Iterable[tuple[bytes, int, bytes, int, Iterator[bytes]]] = ()) -> None:
        """End the points, write extended records and the header; the stream stays open.

        Extended variable length records are user id, record id, description, size and pieces of data.
        """
        self._compressor.done()
        self._stream.seek(0, 2)
        first, number = self._stream.tell(), 0
        for user_id, record_id, description, size, pieces in extended:
            self._stream.write(_record_head(user_id, record_id, description, size, extended=True))
            for piece in pieces:
                self._stream.write(piece)
            number += 1
        scales, offsets = struct.unpack_from("<3d", self._header, 131), struct.unpack_from("<3d", self._header, 155)
        bounds: list[float] = []
        for axis in range(3):
            low, high = (int(v[axis]) * scales[axis] + offsets[axis] for v in (self._low, self._high))
            bounds.extend((max(low, high), min(low, high)))
        struct.pack_into("<6d", self._header, 179, *(bounds if self._count else [0.0] * 6))
        struct.pack_into("<QQIQ", self._header, 227, 0, first if number else 0, number, self._count)
        struct.pack_into("<15Q", self._header, 255, *self._by_return.tolist())
        self._stream.seek(0)
        self._stream.write(self._header)


def _record_head(user_id: bytes, record_id: int, description: bytes, size: int, *, extended: bool = False) -> bytes:
    """The head of a variable length record, or of an extended one."""
    return struct.pack("<H16sHQ32s" if extended else "<H16sHH32s", 0, user_id, record_id, size, description)


def new_records(count: int) -> npt.NDArray[np.void]:
    """So many records of format 6 without extra bytes, all zeros, for points of other kinds of files."""
    return np.zeros(count, record_dtype(6, np.dtype(_NEW).itemsize))
