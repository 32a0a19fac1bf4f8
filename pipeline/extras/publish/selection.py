"""A copy of a finished run with only the buildings of some statuses: whatever reads runs reads it."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.errors import RunError
from pipeline.export.cityjson import json_line, lines_of
from pipeline.export.decisions import NAME as DECISIONS
from pipeline.export.folders import TERRAIN_FOLDER, put_local
from pipeline.export.geoparquet import geo_metadata, parquet_bytes, shape_names, stored_schema, table_batches
from pipeline.export.glb import glb_bytes
from pipeline.extras.publish.finished_run import check_complete, disk_at, sequences_of
from pipeline.extras.publish.obj_parts import lines_of_buildings
from pipeline.io import arrow_at, storage_at
from pipeline.io.crs import SpatialReference
from pipeline.io.temporary import temporary_folder
from pipeline.model import Status
from pipeline.runtime.manifest import RunManifest, RunStatus, write_manifest
from pipeline.runtime.manifest_reading import city_unit_m, read_manifest

_MESH = re.compile(r"meshes/(?P<tile>[^/]+)/(?P<stem>[^/]+?)(-lod(?P<lod>[0-9]{2}))?\.(?P<kind>obj|glb)")


@contextlib.contextmanager
def run_of(run_dir: str, statuses: Collection[Status]) -> Iterator[str]:
    """The place of a run with the buildings of some statuses only; of all, the run itself.

    A selection is in a folder for temporary files, and goes at the end. Raises as `select_run` does.
    """
    if not statuses or set(statuses) == set(Status):
        yield run_dir
        return
    with temporary_folder() as folder:
        made = folder / "run"
        select_run(run_dir, made, statuses)
        try:
            yield str(made)
        except RunError as fault:
            chosen = ", ".join(status.value for status in Status if status in statuses)
            words, named = str(fault), f"{run_dir} (only {chosen})"
            raise RunError(words.replace(str(made), named) if str(made) in words else f"{named}: {words}") from fault


def select_run(run_dir: str, out: Path, statuses: Collection[Status]) -> None:
    """Copy a run that ended into a new folder, with the buildings of some statuses only, tile by tile.

    Tables, city objects and meshes keep these buildings. Rejected objects, which have no status, and terrain are
    copied. Points are left out. The copy has no digest, since no run gives it.

    Raises RunError if the run did not end, changes meanwhile or lacks files or rows, or if something cannot be read or
    written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : Path
        The folder to write.
    statuses : collection of Status
        At least one.
    """
    manifest = read_manifest(run_dir)
    if manifest.status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"the run in {run_dir} is {manifest.status.value}: run it to its end first")
    storage, put = storage_at(run_dir), put_local(out)
    selection = _Selection(run_dir, manifest, statuses)
    with disk_at(out):
        for key in storage.keys("state"):
            state = json.loads(storage.get(key))
            files = {}
            for name, content in selection.files(state["tile"], sorted(state["files"])):
                put(name, content)
                files[name] = hashlib.sha256(content).hexdigest()
            put(key, json.dumps({**state, "files": files}, indent=1).encode())
        for name in sequences_of(run_dir, TERRAIN_FOLDER).values():
            put(name, storage.get(name))
        check_complete(run_dir, manifest, {"buildings": selection.read}, [])
        counts = {**manifest.counts, **selection.counts()}
        write_manifest(out, dataclasses.replace(manifest, counts=counts, content_sha256=None))


class _Selection:
    """Selects the buildings of a run tile by tile, and counts them."""

    def __init__(self, run_dir: str, manifest: RunManifest, statuses: Collection[Status]) -> None:
        self._run_dir = run_dir
        self._storage = storage_at(run_dir)
        self._filesystem, self._place = arrow_at(run_dir)
        self._projjson = SpatialReference.of_facts(manifest.crs).projjson
        horizontal_m = (manifest.crs or {}).get("horizontal_unit_m", 1.0)
        self._units_m: tuple[float, float] = (horizontal_m, city_unit_m(manifest.crs))
        self._statuses = pa.array(sorted(status.value for status in statuses))
        self._kept: Counter[str] = Counter()
        self._planes = 0
        self.read = 0
        """Rows of the table of buildings so far, before the selection."""

    def counts(self) -> dict[str, int]:
        """What run.json counts of the selected buildings."""
        by_status = {status.value: self._kept[status.value] for status in Status}
        return {"candidates": self._kept.total(), **by_status, "roof_faces": self._planes}

    def files(self, tile: str, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        """The files of a tile for the selection, in the order of `names`, with their content."""
        if f"buildings/tile={tile}/part-0.parquet" not in names:
            return
        ids = self._ids(tile)
        kept = frozenset(ids.to_pylist())
        city: list[str] = []
        for name in names:  # in order: city objects come before meshes
            folder = name.partition("/")[0]
            if folder in {"buildings", "planes", DECISIONS}:
                yield name, self._table(folder, tile, ids)
            elif folder == "cityjson":
                city = _city(lines_of(self._storage.get(name).decode()), kept)
                yield name, "".join(f"{line}\n" for line in city).encode()
            elif folder == "meshes":
                if content := self._mesh(name, city, kept):
                    yield name, content
            elif folder == "rejected":
                yield name, self._storage.get(name)

    def _rows(self, name: str, tile: str, columns: Sequence[str]) -> pa.Table:
        """Some columns of a tile's file of a table; those that an older version did not write are null."""
        schema = pa.schema([stored_schema(name).field(column) for column in columns])
        batches = list(table_batches(self._place, name, columns, self._filesystem, [tile]))
        if not batches:
            return schema.empty_table()
        rows = pa.Table.from_batches(batches).combine_chunks()
        return rows.cast(
            pa.schema([field.with_nullable(field.nullable or rows[field.name].null_count > 0) for field in schema])
        )

    def _ids(self, tile: str) -> pa.Array:
        """The selected buildings of a tile."""
        rows = self._rows("buildings", tile, ["building_id", "status"])
        self.read += rows.num_rows
        kept = rows.filter(pc.is_in(rows["status"], value_set=self._statuses))
        self._kept.update(kept["status"].to_pylist())
        return kept["building_id"].combine_chunks()

    def _table(self, name: str, tile: str, ids: pa.Array) -> bytes:
        """A tile's file of a table with the rows of the selected buildings."""
        rows = self._rows(name, tile, stored_schema(name).names)
        rows = rows.filter(pc.is_in(rows["building_id"], value_set=ids))
        if name == DECISIONS:
            return parquet_bytes(rows)
        if name == "planes":
            self._planes += rows.num_rows
        shapes = {column: _shapes(rows, column) for column in shape_names(name)}
        geo = geo_metadata(_shapes(rows, "geometry"), self._projjson, shapes)
        text = json.dumps(geo, sort_keys=True, separators=(",", ":"))
        return parquet_bytes(rows.replace_schema_metadata({"geo": text}))

    def _mesh(self, name: str, city: Sequence[str], ids: Collection[str]) -> bytes:
        """A mesh file with the selected buildings; empty without any."""
        found = _MESH.fullmatch(name)
        if found is None:
            raise RunError(f"{name} of the run in {self._run_dir} is not a mesh: run it again")
        if found["kind"] == "glb":
            lod = found["lod"] and f"{found['lod'][0]}.{found['lod'][1]}"
            return glb_bytes(city, *self._units_m, lod) if len(city) > 1 else b""
        if found["stem"] != found["tile"] and found["stem"] not in ids:
            return b""
        lines = list(lines_of_buildings(self._storage.get(name).decode("ascii").splitlines(), ids))
        has_objects = any(line.startswith("o ") for line in lines)
        return "".join(f"{line}\n" for line in lines).encode() if has_objects else b""


def _shapes(table: pa.Table, column: str) -> Any:
    """The geometries of a column, None where there is none."""
    return shapely.from_wkb(np.array(table[column].to_pylist(), dtype=object))


def _city(lines: Sequence[str], ids: Collection[str]) -> list[str]:
    """The lines of a CityJSONSeq file with some of its features, and the bounds of these."""
    heading, features = json.loads(lines[0]), [json.loads(line) for line in lines[1:]]
    kept = [(feature, line) for feature, line in zip(features, lines[1:], strict=True) if feature["id"] in ids]
    heading["metadata"].pop("geographicalExtent", None)
    vertices = [vertex for feature, _ in kept for vertex in feature["vertices"]]
    if vertices:
        scale, translate = (np.array(heading["transform"][name]) for name in ("scale", "translate"))
        edges = [extreme(np.array(vertices), axis=0) * scale + translate for extreme in (np.min, np.max)]
        heading["metadata"]["geographicalExtent"] = [round(float(value), 9) for edge in edges for value in edge]
    return [json_line(heading), *(line for _, line in kept)]
