"""The octree of a COPC file: which compressed nodes meet a window. Source: COPC specification 1.0, copc.io.

The walk is our own and not laspy's reader, because a query there decodes all of a window at once and a damaged
hierarchy leads it into an endless loop.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import numpy.typing as npt

from pipeline.errors import UnreadableInputError
from pipeline.io.file_facts import Readable

if TYPE_CHECKING:
    from laspy.copc import CopcInfoVlr

    from pipeline.io.file_facts import Window

ENTRY = np.dtype(
    [("level", "<i4"), ("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")]
)
"""One entry of a hierarchy page; a count of -1 means that offset and size name another page."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OctreeInfo:
    """Where the octree is."""

    x_min: float
    """West of the root cube, in the units of the CRS."""
    y_min: float
    """South of the root cube."""
    width: float
    """Edge of the root cube."""
    root_offset: int
    """Byte of the root page."""
    root_size: int
    """Bytes of the root page."""


def octree_info(info: CopcInfoVlr) -> OctreeInfo:
    """The octree that a record of the header describes."""
    return OctreeInfo(
        x_min=float(info.center[0] - info.halfsize),
        y_min=float(info.center[1] - info.halfsize),
        width=2.0 * float(info.halfsize),
        root_offset=int(info.hierarchy_root_offset),
        root_size=int(info.hierarchy_root_size),
    )


_DEEPEST = 31
"""No octree is deeper: the numbers of its nodes have 32 bits."""
_PAGE_LIMIT = 1 << 26
"""Bytes of a page: two million nodes, some hundred thousand million points."""
_FIX = "Get the file again, or rewrite it as LAZ"


def root_node(path: Readable, stream: BinaryIO, info: OctreeInfo, file_size: int) -> npt.NDArray[np.void]:
    """The coarsest node, a sample of the whole file, as an array of at most one `ENTRY`.

    Raises UnreadableInputError if the root page lies outside the file.
    """
    entries = _page(path, stream, info.root_offset, info.root_size, file_size)
    root: npt.NDArray[np.void] = entries[(entries["level"] == 0) & (entries["count"] > 0)][:1]
    return root


def nodes_within(
    path: Readable, stream: BinaryIO, info: OctreeInfo, window: Window, file_size: int
) -> npt.NDArray[np.void]:
    """The nodes that hold points and meet the window, in file order, as an array of `ENTRY`.

    Raises UnreadableInputError if a page lies outside the file. What the nodes say is not checked.
    """
    pages, seen = [(info.root_offset, info.root_size)], set()
    found = []
    while pages:
        offset, size = pages.pop()
        if offset in seen:
            continue
        seen.add(offset)
        entries = _page(path, stream, offset, size, file_size)
        edge = info.width / np.exp2(entries["level"].astype(np.float64))
        west, south = info.x_min + entries["x"] * edge, info.y_min + entries["y"] * edge
        # One micrometre of slack: points sit on node borders by rounding.
        slack = 1e-6
        meets = (west - slack <= window.x_max) & (west + edge + slack >= window.x_min)
        meets &= (south - slack <= window.y_max) & (south + edge + slack >= window.y_min)
        pages.extend((int(page["offset"]), int(page["size"])) for page in entries[meets & (entries["count"] == -1)])
        found.append(entries[meets & (entries["count"] > 0)])
    nodes = np.concatenate(found)
    ordered: npt.NDArray[np.void] = nodes[np.argsort(nodes["offset"], kind="stable")]
    return ordered


def _page(path: Readable, stream: BinaryIO, offset: int, size: int, file_size: int) -> npt.NDArray[np.void]:
    """The entries of a page."""
    if not 0 < size <= _PAGE_LIMIT or size % ENTRY.itemsize or offset + size > file_size:
        raise UnreadableInputError(
            str(path), f"the octree page at byte {offset} with {size} bytes is damaged or truncated", _FIX
        )
    stream.seek(offset)
    entries = np.frombuffer(stream.read(size), dtype=ENTRY)
    if entries["level"].min() < 0 or entries["level"].max() > _DEEPEST:
        raise UnreadableInputError(str(path), f"the octree page at byte {offset} names impossible levels", _FIX)
    return entries
