"""Geometries out of WKB that a stranger wrote."""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt
import shapely

DEPTH_LIMIT = 32
"""Maximum depth of geometries in geometries, as in GDAL; real ones have two or three. GEOS goes down one frame of the
stack per level, and ends the process where the stack ends."""

_HEADER_BYTES = 9
"""Byte order, type and count."""
_POINT = 1
_OF_POINTS = (2, 8)
"""Lines and circular strings: so many positions."""
_OF_RINGS = (3, 17)
"""Polygons and triangles: so many rings of so many positions."""
_FLAT = (_POINT, *_OF_POINTS, *_OF_RINGS)


def geometries_of(wkb: npt.NDArray[np.object_]) -> npt.NDArray[np.object_]:
    """(n,) geometries of (n,) bytes or None; None where there is nothing, or nothing that can be read.

    Coordinates may be NaN or infinite. Geometries that are nested deeper than `DEPTH_LIMIT` are not read.
    """
    deep = [k for k, data in enumerate(wkb) if data is not None and _is_deep(data)]
    if deep:
        wkb = wkb.copy()
        wkb[deep] = None
    with np.errstate(invalid="ignore"):
        return np.asarray(shapely.from_wkb(wkb, on_invalid="ignore"), object)


def _is_deep(data: bytes) -> bool:
    """Whether a geometry is nested deeper than the limit; walks it as GEOS does, up to where it is damaged."""
    if len(data) <= _HEADER_BYTES * DEPTH_LIMIT or _type_of(data, 0)[0] in _FLAT:
        return False
    at, left = 0, [1]
    while left:
        if left[-1] == 0:
            left.pop()
            continue
        left[-1] -= 1
        if len(left) > DEPTH_LIMIT + 1:
            return True
        if at + _HEADER_BYTES > len(data):
            return False
        kind, order, position_bytes, header_bytes = _type_of(data, at)
        at += header_bytes
        if kind == _POINT:
            at += position_bytes
            continue
        if at + 4 > len(data):
            return False
        (count,) = struct.unpack_from(f"{order}I", data, at)
        at += 4
        if kind in _OF_POINTS:
            at += count * position_bytes
        elif kind in _OF_RINGS:
            for _ in range(count):
                if at + 4 > len(data):
                    return False
                at += 4 + struct.unpack_from(f"{order}I", data, at)[0] * position_bytes
        else:
            left.append(count)
    return False


def _type_of(data: bytes, at: int) -> tuple[int, str, int, int]:
    """Type, byte order, bytes of a position, and bytes up to its count, of the geometry that begins there."""
    order = "<" if data[at] == 1 else ">"
    (code,) = struct.unpack_from(f"{order}I", data, at + 1)
    thousands, kind = divmod(code & 0xFFFF, 1000)
    has_z = bool(code & 0x8000_0000) or thousands in (1, 3)
    has_m = bool(code & 0x4000_0000) or thousands in (2, 3)
    return kind, order, 8 * (2 + has_z + has_m), 9 if code & 0x2000_0000 else 5
