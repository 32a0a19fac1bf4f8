"""The tiles' CityJSONSeq files as one: a single line of metadata with one transform, then all features."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.errors import RunError
from pipeline.export.cityjson import VERSION

_EMPTY: dict[str, Any] = {
    "type": "CityJSON",
    "version": VERSION,
    "transform": {"scale": [0.001, 0.001, 0.001], "translate": [0.0, 0.0, 0.0]},
    "metadata": {},
    "CityObjects": {},
    "vertices": [],
}


def read_header(path: Path) -> dict[str, Any]:
    """The first line of a CityJSONSeq file.

    Raises
    ------
    RunError
        The file is missing or damaged.
    """
    try:
        with path.open("rb") as stream:
            header: dict[str, Any] = json.loads(stream.readline())
    except (OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read as CityJSONSeq: {error}") from error
    return header


class MergedCityJson:
    """Writes one CityJSONSeq file from the tiles' files.

    Each tile counts its integer vertices from a corner of its own; here all are counted from the lowest of these
    corners. The corners are whole units and the scales powers of ten, so no vertex moves.

    Parameters
    ----------
    stream : binary file
        To be written.
    headers : sequence of dict
        The tiles' first lines; may be empty.
    """

    def __init__(self, stream: BinaryIO, headers: Sequence[dict[str, Any]]) -> None:
        self._stream = stream
        placed = [header for header in headers if "geographicalExtent" in header["metadata"]]
        first = (placed or list(headers) or [_EMPTY])[0]
        self._scale = first["transform"]["scale"]
        if any(header["transform"]["scale"] != self._scale for header in placed):
            raise RunError("the tiles' CityJSON files have more than one scale: files of two runs lie in one directory")
        corners = [header["transform"]["translate"] for header in placed] or [[0.0, 0.0, 0.0]]
        self._translate = [min(corner[axis] for corner in corners) for axis in range(3)]
        metadata = {**first["metadata"], "title": "buildings"}
        metadata.pop("geographicalExtent", None)
        if placed:
            extents = [header["metadata"]["geographicalExtent"] for header in placed]
            low = [min(extent[axis] for extent in extents) for axis in range(3)]
            high = [max(extent[axis] for extent in extents) for axis in range(3, 6)]
            metadata["geographicalExtent"] = [*low, *high]
        header = {
            **first,
            "transform": {"scale": self._scale, "translate": self._translate},
            "metadata": metadata,
        }
        self._put(_json(header))

    def add(self, header: dict[str, Any], line: bytes) -> None:
        """Append one feature of the tile with this first line."""
        corner = header["transform"]["translate"]
        shift = [round((corner[axis] - self._translate[axis]) / self._scale[axis]) for axis in range(3)]
        if not any(shift):
            self._put(line)
            return
        feature = json.loads(line)
        dx, dy, dz = shift
        feature["vertices"] = [[x + dx, y + dy, z + dz] for x, y, z in feature["vertices"]]
        self._put(_json(feature))

    def _put(self, line: bytes) -> None:
        self._stream.write(line)
        self._stream.write(b"\n")


def _json(value: dict[str, Any]) -> bytes:
    """One line of JSON without spaces."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
