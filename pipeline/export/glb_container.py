"""glTF 2.0 in one binary file (GLB): its document as JSON, then its binary data.

It loads no numerical library, so that a service can cut files; `pipeline.export.glb_arrays` adds arrays. The rules are
those of the Khronos Group's glTF 2.0 specification (ISO/IEC 12113:2022).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, BinaryIO

VERSION = "2.0"
"""Version of glTF."""
VERTICES, INDICES = 34962, 34963
"""Targets of bufferViews."""
QUANTIZATION = "KHR_mesh_quantization"
"""The extension that allows positions as integers."""

_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAGIC, _CONTAINER_VERSION = b"glTF", 2


class GlbFile:
    """A file that is being made: its accessors, and views with their bytes.

    Each view begins at a multiple of `alignment` bytes, 4 or 8; numbers of 64 bits need the latter.
    """

    def __init__(self, alignment: int = 4) -> None:
        self._alignment = alignment
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._pieces: list[bytes] = []
        self._size = 0

    def view(self, data: bytes, **layout: int) -> int:
        """Append bytes; the number of their view."""
        self._views.append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data), **layout})
        padding = b"\0" * (-len(data) % self._alignment)
        self._pieces += (data, padding)
        self._size += len(data) + len(padding)
        return len(self._views) - 1

    def accessor(self, view: int, **facts: Any) -> int:
        """Append an accessor of a view; its number."""
        self._accessors.append({"bufferView": view, **facts})
        return len(self._accessors) - 1

    def content(
        self,
        nodes: Sequence[Mapping[str, Any]],
        meshes: Sequence[Mapping[str, Any]],
        *,
        scene: Mapping[str, Any] | None = None,
        materials: Sequence[Mapping[str, Any]] = (),
        asset: Mapping[str, Any] | None = None,
        used: Sequence[str] = (),
        extensions: Mapping[str, Any] | None = None,
    ) -> bytes:
        """The whole file.

        The scene has the first node, unless it is given. `asset` has more facts about the file; extensions are those
        that are `used`, of which a reader must know the one for integers, and what they say about the file.
        """
        document: dict[str, Any] = {"asset": {"version": VERSION, "generator": "gablework", **(asset or {})}}
        if used:
            document |= {"extensionsUsed": list(used), "extensionsRequired": [QUANTIZATION]}
        if extensions:
            document["extensions"] = extensions
        document |= {"scene": 0, "scenes": [scene or {"nodes": [0]}], "nodes": nodes, "meshes": meshes}
        if materials:
            document["materials"] = materials
        document |= {
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        return container(document, self._pieces, self._alignment)


def container(document: Mapping[str, Any], pieces: Iterable[bytes], alignment: int = 4) -> bytes:
    """A file: a header of twelve bytes, a chunk of JSON and one of the binary data, each padded to four bytes.

    The binary data begin at a multiple of `alignment` bytes, 4 or 8.
    """
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
    text += b" " * (-(len(text) + _HEADER.size + 2 * _CHUNK.size) % alignment)
    binary = b"".join(pieces)
    binary += b"\0" * (-len(binary) % 4)
    return b"".join(
        (
            _HEADER.pack(_MAGIC, _CONTAINER_VERSION, _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)),
            _CHUNK.pack(len(text), b"JSON"),
            text,
            _CHUNK.pack(len(binary), b"BIN\0"),
            binary,
        )
    )


def read_document(file: BinaryIO | bytes) -> tuple[dict[str, Any], int]:
    """The document of a file, and where its binary data begin; of an open file the rest is not read.

    Raises ValueError if it is another kind of file.
    """
    stream = io.BytesIO(file) if isinstance(file, bytes) else file
    head = stream.read(_HEADER.size + _CHUNK.size)
    if len(head) < _HEADER.size + _CHUNK.size or not head.startswith(_MAGIC):
        raise ValueError("this is not a GLB file")
    size, _ = _CHUNK.unpack_from(head, _HEADER.size)
    document: dict[str, Any] = json.loads(stream.read(size))
    return document, len(head) + size + _CHUNK.size
