"""The container of glTF 2.0 in one binary file (GLB): its document as JSON, then its binary data.

It loads no numerical library, so that a service can cut files. The rules are those of the Khronos Group's glTF 2.0
specification (ISO/IEC 12113:2022, section 4.4).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable, Mapping
from typing import Any, BinaryIO

VERSION = "2.0"
"""Version of glTF."""
VERTICES, INDICES = 34962, 34963
"""Targets of bufferViews."""
QUANTIZATION = "KHR_mesh_quantization"
"""The extension that allows positions as integers."""

_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAGIC, _CONTAINER_VERSION = b"glTF", 2


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
