"""Everything in a LAS file except its points, byte for byte, for writing the file again.

Source: ASPRS, LAS Specification 1.4 R15, tables 3, 4 and 22.
"""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

from pipeline.errors import UnreadableInputError
from pipeline.io.las_header import (
    EVLR_HEADER_SIZE,
    HEADER_SIZES,
    REWRITE,
    VLR_HEADER_SIZE,
    ExtendedRecord,
    HeaderBlock,
    extended_records,
    read_header_block,
)

HEADER_SIZE_1_4 = HEADER_SIZES[4]


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariableRecord:
    """A variable length record (VLR)."""

    user_id: bytes
    """Who defines it, without the zeros at its end."""
    record_id: int
    """Which of theirs it is."""
    description: bytes
    """(32 bytes) as in the file."""
    data: bytes
    """What it holds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LasFrame:
    """Header and records of a LAS or LAZ file."""

    block: HeaderBlock
    """The checked header."""
    header: bytes
    """(375 bytes) the public header block, zeros where an older version has no such field."""
    records: tuple[VariableRecord, ...]
    """All VLRs in the file's order."""
    extended: tuple[ExtendedRecord, ...]
    """All EVLRs in the file's order."""


def read_frame(path: Path) -> LasFrame:
    """Everything of a LAS file but its points.

    Raises InputError if the header is damaged, or a record leads out of the file.
    """
    block = read_header_block(path)
    with path.open("rb") as stream:
        header_size = HEADER_SIZES[min(block.minor, 4)]
        header = stream.read(header_size).ljust(HEADER_SIZE_1_4, b"\0")
        size, _, count = struct.unpack_from("<HII", header, 94)
        at, records = size, []
        for _ in range(count):
            stream.seek(at)
            head = stream.read(VLR_HEADER_SIZE)
            length = struct.unpack_from("<H", head, 20)[0] if len(head) == VLR_HEADER_SIZE else 0
            at += VLR_HEADER_SIZE + length
            if at > block.offset_to_points:
                raise UnreadableInputError(
                    str(path), f"a variable length record ends at byte {at}, beyond the points' first", REWRITE
                )
            records.append(
                VariableRecord(
                    user_id=head[2:18].split(b"\0")[0],
                    record_id=struct.unpack_from("<H", head, 18)[0],
                    description=head[22:54],
                    data=stream.read(length),
                )
            )
        extended = tuple(extended_records(stream, block))
    if extended and extended[-1].offset + extended[-1].size > block.file_size:
        at = extended[-1].offset - EVLR_HEADER_SIZE
        problem = f"truncated: the extended record at byte {at} leads out of the file"
        raise UnreadableInputError(str(path), problem, REWRITE)
    return LasFrame(block=block, header=header, records=tuple(records), extended=extended)
