"""LAS and LAZ files of points that a test makes."""

import io
import struct
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
import pyproj


def write_las(path: Path, xyz: np.ndarray, crs: str | None = None, point_format: int = 6, **fields: Any) -> Path:
    """Write points (n, 3) in units of the file, thousandths kept; `fields` are further dimensions by name."""
    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    for name, values in ({"return_number": 1, "number_of_returns": 1} | fields).items():
        las[name] = np.broadcast_to(np.asarray(values, np.uint8), len(xyz))
    las.write(path)
    return path


def copc_of(path: Path, las: laspy.LasData, crs: str) -> Path:
    """Write points of format 6 as COPC of two levels, the root with every fifth point and its eight children.

    The root page names a second page.
    """
    xyz = np.column_stack((las.x, las.y, las.z))
    center = (xyz.min(axis=0) + xyz.max(axis=0)) / 2.0
    halfsize = float(np.ptp(xyz, axis=0).max()) / 2.0 + 0.01
    child = ((xyz > center) * np.array([1, 2, 4])).sum(axis=1)
    node = np.where(np.arange(len(xyz)) % 5 == 0, 0, child + 1)
    laz_vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
    info_size = 54 + 160
    laszip_record = bytes(laz_vlr.record_data())
    wkt = pyproj.CRS.from_user_input(crs).to_wkt().encode() + b"\0"
    offset = 375 + info_size + 54 + len(laszip_record) + 54 + len(wkt)

    body = io.BytesIO()
    body.write(b"\0" * offset)
    compressor = lazrs.LasZipCompressor(body, laz_vlr)
    raw = las.points.array
    keys: list[tuple[int, int, int, int]] = []
    for number in range(9):
        chosen = raw[node == number]
        if len(chosen) == 0:
            continue
        if keys:
            compressor.finish_current_chunk()
        compressor.compress_many(np.frombuffer(chosen.tobytes(), dtype=np.uint8))
        bits = number - 1
        keys.append((0, 0, 0, 0) if number == 0 else (1, bits & 1, bits >> 1 & 1, bits >> 2 & 1))
    compressor.done()
    content = bytearray(body.getvalue())
    stream = io.BytesIO(content)
    stream.seek(offset)
    chunks = lazrs.read_chunk_table(stream, laz_vlr)
    at, entries = offset + 8, []
    for key, (count, size) in zip(keys, chunks, strict=True):
        entries.append(struct.pack("<iiiiQii", *key, at, size, count))
        at += size
    evlr_at = len(content)
    page_at = evlr_at + 60
    # The second page holds the children from 4 on.
    page, more = b"".join(entries[:5]), b"".join(entries[5:])
    if more:
        page += struct.pack("<iiiiQii", *keys[5], page_at + len(page) + 32, len(more), -1)
    root_size = len(page)
    page += more
    content += struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(page), b"") + page

    info = struct.pack("<5dQQ2d", *center, halfsize, 1.0, page_at, root_size, 0.0, 0.0) + b"\0" * 88
    head = bytearray(375)
    struct.pack_into("<4sHH", head, 0, b"LASF", 0, 16)
    head[24], head[25] = 1, 4
    struct.pack_into("<HHHIIBH", head, 90, 10, 2024, 375, offset, 3, 6 | 0x80, 30)
    struct.pack_into("<6d", head, 131, *las.header.scales, *las.header.offsets)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    struct.pack_into("<6d", head, 179, high[0], low[0], high[1], low[1], high[2], low[2])
    struct.pack_into("<QQIQ", head, 227, 0, evlr_at, 1, len(xyz))
    head += struct.pack("<H16sHH32s", 0, b"copc", 1, 160, b"") + info
    head += struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(laszip_record), b"") + laszip_record
    head += struct.pack("<H16sHH32s", 0, b"LASF_Projection", 2112, len(wkt), b"") + wkt
    content[: len(head)] = head
    assert len(head) == offset
    path.write_bytes(content)
    return path
