"""The public header block of LAS 1.0 to 1.5, checked against the file before anybody trusts or allocates by it.

Source: ASPRS, LAS Specification 1.4 R15, tables 3 and 4.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from pipeline.errors import EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.io.file_facts import Readable

if TYPE_CHECKING:
    import laspy
    import pyproj

SIGNATURE = b"LASF"
HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
"""Smallest header in bytes by minor version."""
VLR_HEADER_SIZE = 54
EVLR_HEADER_SIZE = 60
RECORDS_LIMIT = 1 << 26
"""Bytes of records before the points: all are held at once, and files have some kilobytes."""
EVLR_LIMIT = 10_000
"""Extended records looked at: files have a handful, and a damaged count is in the billions."""
WKT_RECORD_ID = 2112
WKT_SIZE_LIMIT = 1 << 20
"""A longer text is not a CRS."""
COMPRESSED_BIT = 0x80

REWRITE = "Get the file again, or rewrite it with a tool that repairs headers"


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeaderBlock:
    """The fields of the public header that say where things are and how many."""

    minor: int
    """Minor version of LAS 1.x."""
    flags: int
    """Global encoding bits."""
    offset_to_points: int
    """Byte at which the point data begin."""
    compressed: bool
    """True for LAZ."""
    point_format: int
    """Point data record format, 0 to 10."""
    point_size: int
    """Bytes a record, uncompressed."""
    point_count: int
    """Points that the header promises; the 64-bit count in LAS 1.4."""
    legacy_count: int
    """The 32-bit count."""
    first_evlr: int
    """Byte at which the extended records begin; 0 where there are none."""
    evlr_count: int
    """Extended records."""
    waveform_start: int
    """Byte at which waveform packets begin; 0 where there are none in the file."""
    file_size: int
    """Bytes of the file."""

    @property
    def end_of_points(self) -> int:
        """Byte at which the room for points ends: the next thing that the header names, or the file's end."""
        later = [at for at in (self.first_evlr, self.waveform_start) if at > self.offset_to_points]
        return min([*later, self.file_size])


def promised_points(path: Readable) -> int:
    """The number of points in the header; raises as `read_header_block`."""
    return read_header_block(path).point_count


def read_header_block(path: Readable) -> HeaderBlock:
    """The header of a LAS or LAZ file, checked.

    Raises
    ------
    UnreadableInputError
        Not a LAS file, a version or point format that is not known, or too short for its own header.
    InconsistentInputError
        Offsets, scales or counts that cannot be.
    EmptyInputError
        The header promises zero points.
    """
    name, file_size = str(path), path.stat().st_size
    with path.open("rb") as stream:
        raw = stream.read(max(HEADER_SIZES.values()))
    if raw[:4] != SIGNATURE:
        raise UnreadableInputError(
            name, f"not a LAS file: it begins with {raw[:4]!r}, not {SIGNATURE!r}", "Give a LAS or LAZ file"
        )
    major, minor = (raw[24], raw[25]) if len(raw) > 25 else (1, 2)
    if major != 1 or minor not in HEADER_SIZES:
        raise UnreadableInputError(name, f"LAS version {major}.{minor} is not known", "Convert it to LAS 1.2 to 1.4")
    if len(raw) < HEADER_SIZES[minor]:
        raise UnreadableInputError(
            name, f"truncated: {file_size} bytes, but a LAS 1.{minor} header alone has {HEADER_SIZES[minor]}", REWRITE
        )
    header_size, offset, vlr_count, format_byte, point_size, legacy_count = struct.unpack_from("<HIIBHI", raw, 94)
    block = HeaderBlock(
        minor=minor,
        flags=struct.unpack_from("<H", raw, 6)[0],
        offset_to_points=offset,
        compressed=bool(format_byte & COMPRESSED_BIT),
        point_format=format_byte & 0x3F,
        point_size=point_size,
        point_count=struct.unpack_from("<Q", raw, 247)[0] if minor >= 4 else legacy_count,
        legacy_count=legacy_count,
        first_evlr=struct.unpack_from("<Q", raw, 235)[0] if minor >= 4 else 0,
        evlr_count=struct.unpack_from("<I", raw, 243)[0] if minor >= 4 else 0,
        waveform_start=struct.unpack_from("<Q", raw, 227)[0] if minor >= 3 else 0,
        file_size=file_size,
    )
    _check_layout(name, block, header_size, vlr_count)
    _check_scales(name, struct.unpack_from("<6d", raw, 131))
    return block


def _check_layout(name: str, block: HeaderBlock, header_size: int, vlr_count: int) -> None:
    """Refuse a header whose parts do not fit into the file."""
    if block.offset_to_points > block.file_size:
        raise UnreadableInputError(
            name, f"truncated: points begin at byte {block.offset_to_points}, the file has {block.file_size}", REWRITE
        )
    if header_size < HEADER_SIZES[block.minor] or header_size > block.offset_to_points:
        raise InconsistentInputError(
            name,
            f"header size {header_size} does not fit LAS 1.{block.minor} with points at byte {block.offset_to_points}",
            REWRITE,
        )
    room = block.offset_to_points - header_size
    if room > RECORDS_LIMIT:
        raise InconsistentInputError(
            name,
            f"points begin at byte {block.offset_to_points}: records before them have {RECORDS_LIMIT} at most",
            REWRITE,
        )
    if vlr_count * VLR_HEADER_SIZE > room:
        raise InconsistentInputError(
            name, f"the header promises {vlr_count} variable length records in {room} bytes", REWRITE
        )
    if block.evlr_count and not block.offset_to_points <= block.first_evlr <= block.file_size:
        raise UnreadableInputError(
            name,
            f"truncated: extended records begin at byte {block.first_evlr}, the file has {block.file_size}",
            REWRITE,
        )
    if block.point_count == 0:
        if block.legacy_count:
            raise InconsistentInputError(
                name,
                f"the header promises 0 points in its 64-bit count and {block.legacy_count} in the old one",
                REWRITE,
            )
        raise EmptyInputError(name, "the header promises 0 points", "Give a file with points")


def _check_scales(name: str, values: tuple[float, ...]) -> None:
    """Refuse scales and offsets that make no coordinates."""
    for axis, scale, offset in zip("xyz", values[:3], values[3:], strict=True):
        if not (math.isfinite(scale) and scale > 0.0):
            raise InconsistentInputError(name, f"the {axis} scale factor is {scale}", REWRITE)
        if not (math.isfinite(offset) and abs(offset) + scale * 2.0**31 < 1e15):
            raise InconsistentInputError(
                name, f"{axis} offset {offset} with scale {scale} gives no coordinates", REWRITE
            )


class ExtendedRecord(NamedTuple):
    """Where an extended variable length record (EVLR) is; it can be gigabytes."""

    user_id: bytes
    """Who defines it, without the zeros at its end."""
    record_id: int
    """Which of theirs it is."""
    description: bytes
    """(32 bytes) as in the file."""
    offset: int
    """Byte at which its data begin."""
    size: int
    """Bytes of data."""


def extended_records(stream: BinaryIO, block: HeaderBlock) -> Iterator[ExtendedRecord]:
    """The extended records of a file in its order, without their data; one that leads out of the file is the last."""
    end = block.first_evlr
    for _ in range(min(block.evlr_count, EVLR_LIMIT)):
        stream.seek(end)
        head = stream.read(EVLR_HEADER_SIZE).ljust(EVLR_HEADER_SIZE, b"\xff")
        record_id, size = struct.unpack_from("<HQ", head, 18)
        start = end + EVLR_HEADER_SIZE
        yield ExtendedRecord(head[2:18].split(b"\0")[0], record_id, head[28:60], start, size)
        end = start + size
        if end > block.file_size:
            return


def _wkt_of_extended_records(stream: BinaryIO, block: HeaderBlock) -> str:
    """The WKT in the extended records, without reading the others (waveforms can be gigabytes); empty without any."""
    for one in extended_records(stream, block):
        if (one.user_id, one.record_id) == (b"LASF_Projection", WKT_RECORD_ID) and one.size <= WKT_SIZE_LIMIT:
            stream.seek(one.offset)
            return stream.read(one.size).rstrip(b"\0").decode("utf-8", errors="replace")
    return ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeaderCrs:
    """The CRS as a LAS header has it."""

    crs: pyproj.CRS | None
    """None where there is none or it cannot be understood."""
    horizontal_unit_m: float | None
    """From the GeoTIFF keys."""
    vertical_unit_m: float | None
    """From the GeoTIFF keys."""
    warnings: tuple[str, ...]
    """What could not be understood."""


def header_crs(path: Readable, header: laspy.LasHeader, block: HeaderBlock) -> HeaderCrs:
    """The CRS from WKT, which overrides GeoTIFF keys if a file has both."""
    import pyproj

    warnings: list[str] = []
    texts = [vlr.string for vlr in header.vlrs.get("WktCoordinateSystemVlr")]
    if block.evlr_count:
        with path.open("rb") as stream:
            texts.append(_wkt_of_extended_records(stream, block))
    crs = None
    for text in texts:
        if crs is None and text.strip(" \0"):
            try:
                crs = pyproj.CRS.from_wkt(text)
            except pyproj.exceptions.CRSError as fault:
                warnings.append(f"the header's WKT is not understood ({str(fault)[:120]})")
    if not header.vlrs.get("GeoKeyDirectoryVlr"):
        return HeaderCrs(crs=crs, horizontal_unit_m=None, vertical_unit_m=None, warnings=tuple(warnings))
    from pipeline.io.geotiff_keys import crs_of_keys, keys_of

    keys = keys_of(header)
    if crs is None and keys.codes:
        crs, more = crs_of_keys(header, keys)
        warnings.extend(more)
    return HeaderCrs(
        crs=crs,
        horizontal_unit_m=keys.horizontal_unit_m,
        vertical_unit_m=keys.vertical_unit_m,
        warnings=tuple(warnings),
    )
