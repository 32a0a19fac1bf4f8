"""The tables of a served run: what their columns are for clients, and the run opened for reading."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import logging
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa
import pyarrow.fs as pafs

from pipeline.errors import RunError, causes
from pipeline.export.columns import COLUMNS, HORIZONTAL, NONE, VERTICAL
from pipeline.export.records import SCHEMAS
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.io import arrow_at, is_url
from pipeline.io.crs_units import unit_name
from pipeline.model import Reason, RoofType, Status
from pipeline.runtime.manifest import NAME as MANIFEST_NAME
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from service.errors import NoSuchCollectionError, ResultNotReadyError, StartUpError
from service.features.coordinates import CollectionCrs
from service.features.row_index import RowIndex, Totals, write_index
from service.features.runs import TABLES, ServedRun, version_of

GEOMETRY = "geometry"
TILE = "tile"

_log = logging.getLogger("gablework.service")
_TRUST_S = 5.0
"""Seconds for which a run at a URL is not asked whether it changed."""
_OPEN_RUNS = 64

_WORDS: Mapping[tuple[str, str], type[Status | RoofType | Reason]] = {
    ("buildings", "status"): Status,
    ("buildings", "reason"): Reason,
    ("buildings", "roof_type"): RoofType,
    ("rejected", "reason"): Reason,
}
"""Columns with a closed list of words."""
_UNITS = {table: {column.name: column.unit for column in columns} for table, columns in COLUMNS.items()}
_TITLES = {
    "buildings": "footprints of all candidates, with status and figures",
    "planes": "roof planes: faces, slope and aspect; the third coordinate is the elevation: in metres, in the storage "
    "CRS in its unit",
    "rejected": "objects that are not buildings, each with its reason",
}


@dataclasses.dataclass(frozen=True)
class Layer:
    """A table as a collection."""

    table: str
    """Its name."""

    @property
    def title(self) -> str:
        """Its content in a few words."""
        return _TITLES[self.table]

    @functools.cached_property
    def properties(self) -> Mapping[str, pa.DataType]:
        """The columns that features have as properties, with their types; the last one is the tile."""
        left_out = {GEOMETRY, *SHAPE_COLUMNS}
        fields = {field.name: field.type for field in SCHEMAS[self.table] if field.name not in left_out}
        return fields | {TILE: pa.string()}

    @functools.cached_property
    def queryables(self) -> Mapping[str, str]:
        """The properties that filters can name, with their kinds: text, number, boolean or time."""
        kinds = {name: kind_of(kind) for name, kind in self.properties.items()}
        return {name: kind for name, kind in kinds.items() if kind}

    @property
    def has_times(self) -> bool:
        """Whether features have a time of acquisition."""
        return "acquired_from" in self.properties

    def feature_id(self, row: Mapping[str, Any]) -> str:
        """The id of a row's feature: that of the object; a plane has its building's, a dot and its own number."""
        if self.table == "planes":
            return f"{row['building_id']}.{row['plane_id']}"
        return str(row["object_id" if self.table == "rejected" else "building_id"])

    def filter_schema(self, crs: CollectionCrs) -> dict[str, Any]:
        """The JSON schemas of the properties that filters can name, and of the geometry."""
        found = {name: self._property(name, crs) for name in self.queryables}
        role = {"x-ogc-role": "primary-geometry", "format": "geometry-polygon-or-multipolygon"}
        return {**found, GEOMETRY: {"title": GEOMETRY, **role}}

    def feature_schema(self, crs: CollectionCrs) -> dict[str, Any]:
        """The JSON schemas of the members of a feature.

        Types are single words with `nullable`, as in OpenAPI 3.0: GDAL takes a list of types for a text. For the same
        reason lists of floating point numbers are left out.
        """
        listed = [name for name, kind in self.properties.items() if not _is_float_list(kind)]
        nullable = {field.name for field in SCHEMAS[self.table] if field.nullable}
        found = {name: self._property(name, crs) | ({"nullable": True} if name in nullable else {}) for name in listed}
        return {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            GEOMETRY: {"type": "object", "nullable": True},
            "properties": {"type": "object", "properties": found, "required": listed},
        }

    def _property(self, name: str, crs: CollectionCrs) -> dict[str, Any]:
        """The JSON schema of a property; of a coordinate with its unit as UCUM (OGC API - Features, part 5)."""
        found = {"title": name, **json_type(self.properties[name])}
        own = {HORIZONTAL: crs.horizontal_unit_m, VERTICAL: crs.vertical_unit_m}
        unit_m = own.get(_UNITS[self.table].get(name, NONE))
        if unit_m is not None:
            found["x-ogc-unit"] = ucum(unit_m)
        if (self.table, name) in _WORDS:
            found["enum"] = [str(word) for word in _WORDS[self.table, name]]
        return found


def ucum(unit_m: float) -> str:
    """A unit of length in the Unified Code for Units of Measure.

    >>> ucum(1.0), ucum(0.3048), ucum(1200.0 / 3937.0)
    ('m', '[ft_i]', '[ft_us]')
    """
    known = {"metre": "m", "foot": "[ft_i]", "US survey foot": "[ft_us]"}
    return known.get(unit_name(unit_m), f"{unit_m:.12g}.m")


LAYERS: Mapping[str, Layer] = {table: Layer(table) for table in TABLES}
"""The tables that are collections."""


def kind_of(kind: pa.DataType) -> str:
    """The kind of a type that filters compare; an empty text for lists.

    >>> kind_of(pa.int32()), kind_of(pa.timestamp("us", tz="UTC")), kind_of(pa.list_(pa.int32()))
    ('number', 'time', '')
    """
    if pa.types.is_string(kind):
        return "text"
    if pa.types.is_boolean(kind):
        return "boolean"
    if pa.types.is_timestamp(kind):
        return "time"
    return "number" if pa.types.is_integer(kind) or pa.types.is_floating(kind) else ""


def _is_float_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) and pa.types.is_floating(kind.value_type))


def json_type(kind: pa.DataType) -> dict[str, Any]:
    """The JSON schema of a type's values.

    >>> json_type(pa.list_(pa.int32()))
    {'type': 'array', 'items': {'type': 'integer'}}
    """
    if pa.types.is_list(kind):
        return {"type": "array", "items": json_type(kind.value_type)}
    if pa.types.is_integer(kind):
        return {"type": "integer"}
    words = {"text": "string", "time": "string", "boolean": "boolean", "number": "number"}
    found = {"type": words[kind_of(kind)]}
    return found | {"format": "date-time"} if kind_of(kind) == "time" else found


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenRun:
    """A served run, ready to be read."""

    run: ServedRun
    """The run."""
    filesystem: pafs.FileSystem
    """Where it lies."""
    version: str
    """Differs for another state of the run."""
    crs: CollectionCrs
    """Its CRS, and those of answers."""
    licence: str | None
    """Licence of its source data."""
    index: RowIndex
    """Where its rows are."""

    @functools.lru_cache(maxsize=256)  # noqa: B019 - runs are few and kept anyway
    def totals(self, table: str) -> Totals:
        """Facts about a whole table."""
        return self.index.totals(table)

    __hash__ = object.__hash__


_open: dict[tuple[str, str], tuple[float, tuple[Any, ...], OpenRun]] = {}
_locks: dict[str, threading.Lock] = {}
_guard = threading.Lock()


def open_run(run: ServedRun) -> OpenRun:
    """Open a run. Its index is made if there is none for its present state.

    Raises
    ------
    NoSuchCollectionError
        Its CRS is unknown, or it cannot be read.
    ResultNotReadyError
        A published run is not finished, or is being replaced.
    """
    key = (run.name, run.place)
    with _guard:
        lock = _locks.setdefault("\n".join(key), threading.Lock())
    with lock:
        held = _open.get(key)
        now_s = time.monotonic()
        if held is not None and (run.is_job or (is_url(run.place) and now_s - held[0] < _TRUST_S)):
            return held[2]
        try:
            filesystem, place = arrow_at(run.place)
            info = filesystem.get_file_info(f"{place.rstrip('/')}/{MANIFEST_NAME}")
            state = (info.mtime_ns, info.size)
            opened = held[2] if held is not None and held[1] == state else _opened(run, filesystem, place, state)
        except (RunError, OSError, pa.ArrowException) as error:
            raise unreadable(run, error) from error
        with _guard:
            _open[key] = (now_s, state, opened)
            for old in list(_open)[:-_OPEN_RUNS]:
                del _open[old]
        return opened


def _opened(run: ServedRun, filesystem: pafs.FileSystem, place: str, state: tuple[Any, ...]) -> OpenRun:
    manifest = read_manifest(place, filesystem)
    if not run.is_job and manifest.status is not RunStatus.FINISHED:
        raise ResultNotReadyError(
            f"run {run.name} is {manifest.status.value}, not finished: complete it, or wait until it is replaced"
        )
    crs = CollectionCrs(manifest.crs, run.name)
    version = version_of(run.place, manifest.content_sha256, manifest.finished_at, *state)
    path = run.index_dir / f"{run.name}-{version}.sqlite"
    if not path.is_file():
        write_index(path, place, filesystem)
        for old in path.parent.glob(f"{run.name}-{'?' * len(version)}.sqlite"):
            if old != path:
                old.unlink(missing_ok=True)
    return OpenRun(
        run=run,
        filesystem=filesystem,
        version=version,
        crs=crs,
        licence=manifest.source_licence or None,
        index=RowIndex(path),
    )


def unreadable(run: ServedRun, error: Exception) -> NoSuchCollectionError:
    """The error for a run whose files are gone or damaged. The log has the cause, since it can name a folder."""
    _log.warning("run %s at %s cannot be read: %s", run.name, run.place, error)
    return NoSuchCollectionError(f"files of run {run.name} are gone or damaged; the log of the service says which")


def check_published(runs: Mapping[str, ServedRun]) -> None:
    """Read each published run once, and make its index.

    Raises
    ------
    StartUpError
        One is not a finished run, or its coordinate reference system is unknown.
    """
    for run in runs.values():
        try:
            open_run(run)
        except (NoSuchCollectionError, ResultNotReadyError) as error:
            behind = next(itertools.islice(causes(error), 1, None), error)
            raise StartUpError(f"the run {run.place} cannot be published: {behind}") from error


def layers() -> Iterator[Layer]:
    """The tables that are collections, in their order."""
    yield from LAYERS.values()
