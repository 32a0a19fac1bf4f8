"""Some buildings of a published tile replaced: the rows, features and meshes of all others stay as they are.

What comes out is, byte for byte, what publishing the whole tile would have written.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import RunError
from pipeline.export.cityjson import lines_of
from pipeline.export.decisions import DECISIONS, decision_rows, decisions_path, decisions_table
from pipeline.export.facts import RecordContext, RejectedObject
from pipeline.export.geoparquet import geo_table, parquet_bytes
from pipeline.export.obj import obj_text
from pipeline.export.record_rows import KEYS, SCHEMAS, plane_rows, rejected_row
from pipeline.export.tile import building_rows, city_lines, mesh_files, mesh_path
from pipeline.model import BuildingResult


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileUpdate:
    """The files of a tile after a change, none of them written yet."""

    files: Mapping[str, bytes]
    """Content by path relative to the run directory."""
    gone: tuple[str, ...]
    """Paths of meshes that no row names any more."""

    @property
    def digests(self) -> dict[str, str]:
        """sha256 of each file in hexadecimal."""
        return {path: hashlib.sha256(data).hexdigest() for path, data in self.files.items()}


def updated_tile(
    run_dir: str | Path,
    tile_key: str,
    replaced: Collection[str],
    results: Sequence[BuildingResult],
    rejected: Sequence[RejectedObject],
    context: RecordContext,
    meshes: str,
) -> TileUpdate:
    """The files of a published tile with some of its buildings replaced.

    The rows of `replaced` ids go, in `buildings`, `planes` and `rejected` alike; `results` and `rejected` take their
    place. `context` has the facts of the run, and those of `results`; `meshes` is that of the run. Raises RunError if a
    file of the tile is not there or cannot be read.
    """
    root, names = Path(run_dir), frozenset(replaced)
    results = sorted(results, key=lambda result: result.building_id)
    rows = building_rows(results, context, tile_key, meshes)
    path = f"cityjson/tile={tile_key}/part-0.city.jsonl"
    fresh = city_lines(results, rows, context, "")
    text = _merged_cityjson(_text(root / path), names, fresh)
    files = {path: text.encode(), **dict(mesh_files(tile_key, results, lines_of(text), context, meshes))}
    gone: list[str] = []
    for lod in (None, *context.further_lods):
        there = {name: mesh_path(tile_key, name, meshes, lod) for name in sorted(names)}
        whole = mesh_path(tile_key, "", meshes, lod)
        if meshes == "tile" and whole is not None:
            old = (root / whole).read_text(encoding="utf-8") if (root / whole).is_file() else ""
            if merged := _merged_obj(old, names, obj_text(results, context.reference, lod)):
                files[whole] = merged.encode()
        gone.extend(
            path for path in dict.fromkeys(there.values()) if path and path not in files and (root / path).is_file()
        )
    added = {
        "planes": [row for result in results for row in plane_rows(result, context)],
        "rejected": [rejected_row(entry, context) for entry in rejected],
        "buildings": rows,
    }
    for name, fresh_rows in added.items():
        path = f"{name}/tile={tile_key}/part-0.parquet"
        kept = [row for row in _rows(root / path, SCHEMAS[name]) if row[KEYS[name][0]] not in names]
        files[path] = parquet_bytes(geo_table(name, [*kept, *fresh_rows], context.reference.projjson))
    path = decisions_path(tile_key)
    kept = [row for row in _rows(root / path, DECISIONS) if row["building_id"] not in names]
    tried = [row for result in results for row in decision_rows(result)]
    files[path] = parquet_bytes(decisions_table([*kept, *tried]))
    return TileUpdate(files=files, gone=tuple(gone))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}. Run the whole again") from error


def _rows(path: Path, schema: pa.Schema) -> list[dict[str, Any]]:
    """The rows of a table's file."""
    try:
        table = pq.ParquetFile(path).read(columns=schema.names)
    except (OSError, pa.ArrowException) as error:
        raise RunError(f"{path} cannot be read: {error}. Run the whole again") from error
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def _merged_obj(old: str, replaced: Collection[str], fresh: str) -> str:
    """The solids of two OBJ texts in the order of their ids, numbered anew; empty where there is none."""
    heading = fresh.splitlines()[0]
    kept = [block for block in _obj_blocks(old) if block[0][0] not in replaced]
    lines = [heading]
    written = 0
    for _, first, block in sorted([*kept, *_obj_blocks(fresh)], key=lambda block: block[0]):
        shift = written - first
        for line in block:
            if line.startswith("f ") and shift:
                lines.append("f " + " ".join(str(int(number) + shift) for number in line[2:].split()))
            else:
                lines.append(line)
        written += sum(line.startswith("v ") for line in block)
    return "\n".join(lines) + "\n" if written else ""


def _obj_blocks(text: str) -> list[tuple[tuple[str, int], int, list[str]]]:
    """The solids of an OBJ text: building and number of the part, vertices written before it, and its lines."""
    blocks: list[tuple[tuple[str, int], int, list[str]]] = []
    written = 0
    for line in text.splitlines():
        if line.startswith("o "):
            building_id, part = line[2:].rsplit("-", 1)
            blocks.append(((building_id, int(part)), written, []))
        if blocks:
            blocks[-1][2].append(line)
            written += line.startswith("v ")
    return blocks


def _merged_cityjson(old: str, replaced: Collection[str], fresh: Iterable[str]) -> str:
    """Two CityJSONSeq texts as one, in the order of the buildings' ids, about one origin."""
    headings: list[dict[str, Any]] = []
    features: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for lines, skipped in ((lines_of(old), replaced), (fresh, frozenset[str]())):
        heading, *found = (json.loads(line) for line in lines)
        headings.append(heading)
        features.extend((heading["transform"], feature) for feature in found if feature["id"] not in skipped)
    heading = headings[0]
    scale = heading["transform"]["scale"]
    digits = [round(-math.log10(step)) for step in scale]
    absolute = []
    for transform, feature in features:
        shift = [round(t * 10**d) for t, d in zip(transform["translate"], digits, strict=True)]
        absolute.append([[v + s for v, s in zip(vertex, shift, strict=True)] for vertex in feature["vertices"]])
    whole = [vertex for vertices in absolute for vertex in vertices]
    low = [min(axis) for axis in zip(*whole, strict=True)] or [0, 0, 0]
    high = [max(axis) for axis in zip(*whole, strict=True)] or [0, 0, 0]
    origin = [value // 10**d for value, d in zip(low, digits, strict=True)]
    heading["transform"]["translate"] = [float(value) for value in origin]
    heading["metadata"].pop("geographicalExtent", None)
    if whole:
        corners = [*zip(low, digits, strict=True), *zip(high, digits, strict=True)]
        heading["metadata"]["geographicalExtent"] = [value / 10**d for value, d in corners]
    for (_, feature), vertices in zip(features, absolute, strict=True):
        feature["vertices"] = [
            [v - o * 10**d for v, o, d in zip(vertex, origin, digits, strict=True)] for vertex in vertices
        ]
    ordered = sorted((feature for _, feature in features), key=lambda feature: str(feature["id"]))
    lines = (json.dumps(entry, separators=(",", ":"), ensure_ascii=False) for entry in (heading, *ordered))
    return "".join(f"{line}\n" for line in lines)
