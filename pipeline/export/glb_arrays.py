"""Arrays in a GLB file: attributes of vertices, triangles, and positions as integers.

Positions are 16-bit integers (the extension KHR_mesh_quantization); the scale and the translation of the node lead to
metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.export.glb_container import INDICES, VERTICES, GlbFile
from pipeline.model import FloatArray, IntArray

TYPES = {5120: "|i1", 5121: "|u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""numpy's names of the types of components."""
MOST_SHORT = 65_535
"""The largest 16-bit integer: so many steps, or vertices, since the largest index restarts a primitive."""
MAX_STEP_MM = 10
"""Largest step of positions: errors stay within half of it. Wider files have 32-bit floats."""

_COMPONENTS = {name: number for number, name in TYPES.items()}
_MM = 1000


def gltf_axes(xyz: FloatArray) -> FloatArray:
    """East, north, up to x, y up, z minus north: a turn, so that outward stays outward; (n, 3)."""
    return np.column_stack((xyz[:, 0], xyz[:, 2], 0.0 - xyz[:, 1]))


def values_of(values: npt.NDArray[Any], kind: str) -> dict[str, Any]:
    """An accessor's words about values: their type, their number and their kind (SCALAR, VEC3)."""
    return {"componentType": _COMPONENTS[values.dtype.str], "count": len(values), "type": kind}


def bounds_of(rows: npt.NDArray[Any]) -> dict[str, list[float]]:
    """The smallest and the largest values of rows (n, k), which glTF wants of positions."""
    return {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}


def add_vertices(
    file: GlbFile, values: npt.NDArray[Any], kind: str, *, bounded: bool = False, normalized: bool = False
) -> int:
    """Append values of vertices, (n,) or (n, k), each at a multiple of four bytes; the number of their accessor."""
    rows = values.reshape(len(values), -1)
    width = -(-rows.shape[1] * rows.itemsize // 4) * 4 // rows.itemsize
    wide = np.zeros((len(rows), width), rows.dtype)
    wide[:, : rows.shape[1]] = rows
    view = file.view(wide.tobytes(), byteStride=wide.strides[0], target=VERTICES)
    more: dict[str, Any] = {"normalized": True} if normalized else {}
    return file.accessor(view, **values_of(rows, kind), **more, **(bounds_of(rows) if bounded else {}))


def add_triangles(file: GlbFile, triangles: npt.NDArray[Any]) -> int:
    """Append triangles (t, 3) as indices of vertices, of 16 bits if these do; the number of their accessor."""
    index = triangles.reshape(-1)
    stored = index.astype("<u2" if index.max() < MOST_SHORT else "<u4")
    return file.accessor(file.view(stored.tobytes(), target=INDICES), **values_of(stored, "SCALAR"))


def quantized(places_mm: IntArray) -> tuple[dict[str, Any], npt.NDArray[Any]]:
    """Places (n, 3) in mm along the axes of glTF as positions, with translation and scale of their node."""
    low_mm = places_mm.min(axis=0)
    away_mm = places_mm - low_mm
    step_mm = max(1, -(-int(away_mm.max()) // MOST_SHORT))
    if step_mm <= MAX_STEP_MM:
        positions: npt.NDArray[Any] = ((away_mm + step_mm // 2) // step_mm).astype("<u2")
    else:
        step_mm, positions = _MM, (away_mm / _MM).astype("<f4")
    return {"translation": (low_mm / _MM).tolist(), "scale": [step_mm / _MM] * 3}, positions
