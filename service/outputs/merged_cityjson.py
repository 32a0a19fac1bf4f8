"""The tiles' CityJSONSeq files as one: a single line of metadata with one transform, then all features."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

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


def merge_cityjson(path: Path, sources: Sequence[Path], each: Iterable[Path]) -> None:
    """Write one CityJSONSeq file from the tiles' files.

    Each tile counts its integer vertices from a corner of its own; here all are counted from the lowest of these
    corners. The corners are whole units and the scales powers of ten, so no vertex moves.

    Parameters
    ----------
    path : Path
        The file to write.
    sources : sequence of Path
        The tiles' files; may be empty.
    each : iterable of Path
        The same, as they are written.

    Raises
    ------
    RunError
        A file is missing or damaged, or the files are of several runs.
    """
    first = _united([_header(source) for source in sources])
    with path.open("wb") as stream:
        stream.write(_line(first))
        for source in each:
            with source.open("rb") as lines:
                own = json.loads(next(lines))["transform"]["translate"]
                there, scale = first["transform"]["translate"], first["transform"]["scale"]
                shift = [round((own[axis] - there[axis]) / scale[axis]) for axis in range(3)]
                for line in lines:
                    stream.write(_moved(line, shift) if any(shift) else line)


def _header(path: Path) -> dict[str, Any]:
    """The first line of a CityJSONSeq file."""
    try:
        with path.open("rb") as stream:
            header: dict[str, Any] = json.loads(stream.readline())
    except (OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read as CityJSONSeq: {error}") from error
    return header


def _united(headers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The first line for the features of all tiles."""
    placed = [header for header in headers if "geographicalExtent" in header["metadata"]]
    first = (placed or list(headers) or [_EMPTY])[0]
    scale = first["transform"]["scale"]
    if any(header["transform"]["scale"] != scale for header in placed):
        raise RunError("the tiles' CityJSON files have more than one scale: files of two runs lie in one directory")
    corners = [header["transform"]["translate"] for header in placed] or [[0.0, 0.0, 0.0]]
    metadata = {**first["metadata"], "title": "buildings"}
    metadata.pop("geographicalExtent", None)
    if placed:
        extents = [header["metadata"]["geographicalExtent"] for header in placed]
        low = [min(extent[axis] for extent in extents) for axis in range(3)]
        high = [max(extent[axis] for extent in extents) for axis in range(3, 6)]
        metadata["geographicalExtent"] = [*low, *high]
    translate = [min(corner[axis] for corner in corners) for axis in range(3)]
    return {**first, "transform": {"scale": scale, "translate": translate}, "metadata": metadata}


def _moved(line: bytes, shift: Sequence[int]) -> bytes:
    """A feature with its vertices counted from another corner."""
    feature = json.loads(line)
    dx, dy, dz = shift
    return _line({**feature, "vertices": [[x + dx, y + dy, z + dz] for x, y, z in feature["vertices"]]})


def _line(value: dict[str, Any]) -> bytes:
    """One line of JSON without spaces."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode() + b"\n"
