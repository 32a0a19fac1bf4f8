"""Small files of every format, made where a test needs them."""

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
import pyproj
import pytest

from pipeline.model import FloatArray

WriteLas = Callable[..., Path]


def _points(n: int) -> FloatArray:
    """So many points on a lattice of centimetres around Delft."""
    rng = np.random.default_rng(7)
    return np.round(
        np.column_stack((rng.uniform(84_000, 84_100, n), rng.uniform(447_000, 447_100, n), rng.uniform(0, 20, n))), 2
    )


def _record(xyz: FloatArray, version: str, point_format: int, crs: str | None, fields: dict[str, Any]) -> laspy.LasData:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales = np.full(3, 0.01)
    header.offsets = np.array([84_000.0, 447_000.0, 0.0])
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.return_number = np.ones(len(xyz), dtype=np.uint8)
    las.number_of_returns = np.ones(len(xyz), dtype=np.uint8)
    for name, values in fields.items():
        setattr(las, name, values)
    return las


@pytest.fixture
def points() -> Callable[[int], FloatArray]:
    """Makes (n, 3) coordinates, whole centimetres."""
    return _points


@pytest.fixture
def write_las() -> WriteLas:
    """Writes LAS or LAZ, by the path's suffix, with laspy: an independent writer."""

    def write(
        path: Path,
        xyz: FloatArray,
        *,
        version: str = "1.2",
        point_format: int = 1,
        crs: str | None = None,
        **fields: Any,
    ) -> Path:
        _record(xyz, version, point_format, crs, fields).write(path)
        return path

    return write


@pytest.fixture
def write_copc() -> WriteLas:
    """Writes COPC: two levels, the root with every fifth point and its eight children; the root page names a second."""

    def write(path: Path, xyz: FloatArray, *, crs: str = "EPSG:7415", **fields: Any) -> Path:
        las = _record(xyz, "1.4", 6, crs, fields)
        center = (xyz.min(axis=0) + xyz.max(axis=0)) / 2.0
        halfsize = float(np.ptp(xyz, axis=0).max()) / 2.0 + 0.01
        child = ((xyz > center) * np.array([1, 2, 4])).sum(axis=1)
        node = np.where(np.arange(len(xyz)) % 5 == 0, 0, child + 1)
        laz_vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
        info_size = 54 + 160
        laszip_record = bytes(laz_vlr.record_data())
        wkt = pyproj.CRS.from_user_input(crs).to_wkt() + "\0"
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
        second_at = page_at + 32 * 6
        page = b"".join(entries[:5]) + struct.pack("<iiiiQii", *keys[5], second_at, 32 * len(entries[5:]), -1)
        page += b"".join(entries[5:])
        content += struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(page), b"") + page

        info = struct.pack("<5dQQ2d", *center, halfsize, 1.0, page_at, 32 * 6, 0.0, 0.0) + b"\0" * 88
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
        head += struct.pack("<H16sHH32s", 0, b"LASF_Projection", 2112, len(wkt), b"") + wkt.encode()
        content[: len(head)] = head
        assert len(head) == offset
        path.write_bytes(content)
        return path

    return write
