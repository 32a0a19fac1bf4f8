"""Pages of features: which rows a request selects, read a row group at a time, and their GeoJSON."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import datetime as dt
import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import shapely

from service.errors import NoSuchFeatureError
from service.features.coordinates import NamedCrs
from service.features.cql2 import Filter, Rows
from service.features.row_index import Box, Part
from service.features.tables import GEOMETRY, TILE, Layer, OpenRun, unreadable

MAX_READ = 1000
"""Row groups of which rows are looked at for one page. Then a page that has a feature is short, and its link goes on;
one without goes on itself, since clients take an empty page for the last."""
MAX_COUNTED = 250
"""Most row groups of which rows are looked at to count all matches; beyond, the answer has no number."""
_KEPT_COUNTS = 4096

Interval = tuple[dt.datetime | None, dt.datetime | None]
_TIMES = ("acquired_from", "acquired_to")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureQuery:
    """The query for a page."""

    crs: NamedCrs
    """CRS of the answer."""
    boxes: Sequence[Box] | None = None
    """Rows whose geometry meets one of these, or that have none; easting first."""
    boxes_crs: NamedCrs
    """Their CRS."""
    interval: Interval | None = None
    """Rows acquired in this time, or at an unknown one."""
    filters: Sequence[Filter] = ()
    """Rows that all of these select."""
    filter_crs: NamedCrs
    """CRS of the coordinates in them."""
    key: str = ""
    """The same for queries that select the same rows."""
    limit: int = 100
    """Maximum number of features."""
    start: int = 0
    """Position in the collection of the first row that is looked at."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeaturePage:
    """One page."""

    features: Sequence[bytes]
    """GeoJSON texts, in the order of the collection."""
    matched: int | None
    """Features on all pages; None if counting them would take too long."""
    following: int | None
    """`start` of the next page; None if there is none."""


def feature_page(run: OpenRun, layer: Layer, query: FeatureQuery) -> FeaturePage:
    """One page of features.

    Raises
    ------
    NoSuchCollectionError
        A file of the run cannot be read.
    """
    try:
        return _Search(run, layer, query).page()
    except (OSError, pa.ArrowException) as error:
        raise unreadable(run.run, error) from error


def single_feature(run: OpenRun, layer: Layer, feature_id: str, crs: NamedCrs) -> bytes:
    """One feature as GeoJSON text.

    Raises
    ------
    NoSuchFeatureError
        There is none with this id.
    NoSuchCollectionError
        A file of the run cannot be read.
    """
    parts, wanted = _places(run, layer, feature_id)
    try:
        for part in parts:
            with _reading(run, part) as reader:
                found = reader.read([name for name, _ in wanted])
                mask = np.ones(part.n, bool)
                for name, value in wanted:
                    mask &= np.asarray(pc.fill_null(pc.equal(found[name], value), fill_value=False))
                if mask.any():
                    return next(_features(run, layer, reader, np.flatnonzero(mask)[:1], crs))
    except (OSError, pa.ArrowException) as error:
        raise unreadable(run.run, error) from error
    raise NoSuchFeatureError(f"{run.run.collection_id(layer.table)} holds no feature {feature_id[:80]!r}")


def _places(run: OpenRun, layer: Layer, feature_id: str) -> tuple[list[Part], list[tuple[str, Any]]]:
    """The row groups that can hold a feature, and the values of columns that it has."""
    if layer.table == "rejected":
        return run.index.parts_with("rejected", feature_id), [("object_id", feature_id)]
    building_id, _, number = feature_id.partition(".") if layer.table == "planes" else (feature_id, "", "")
    found = run.index.parts_with("buildings", building_id)
    if layer.table == "buildings" or not found:
        return found, [("building_id", building_id)]
    # "07" and "7" would be two ids of one plane
    if not (number.isascii() and number.isdigit() and str(int(number[:9])) == number):
        return [], []
    return run.index.parts_of_tile("planes", found[0].tile), [("building_id", building_id), ("plane_id", int(number))]


class _Reader:
    """Columns of one row group."""

    def __init__(self, file: pq.ParquetFile, part: Part) -> None:
        self._file = file
        self._part = part
        self._names = set(file.schema_arrow.names)

    def read(self, names: Sequence[str]) -> dict[str, pa.Array]:
        """Columns by their names; `tile` is made, and one that an older run lacks is null."""
        stored = [name for name in names if name in self._names]
        table = self._file.read_row_group(self._part.row_group, columns=stored, use_threads=False)
        found = {name: table.column(name).combine_chunks() for name in stored}
        for name in names:
            if name == TILE:
                found[name] = pa.repeat(pa.scalar(self._part.tile), self._part.n)
            elif name not in found:
                found[name] = pa.nulls(self._part.n)
        return found

    def geometries(self) -> npt.NDArray[np.object_]:
        """The geometries of all rows, None where there is none."""
        column = self.read([GEOMETRY])[GEOMETRY]
        return _from_wkb(column)


def _from_wkb(column: pa.Array) -> npt.NDArray[np.object_]:
    return np.asarray(shapely.from_wkb(np.array([*column.to_pylist(), None], dtype=object)[:-1]), dtype=object)


@contextlib.contextmanager
def _reading(run: OpenRun, part: Part) -> Iterator[_Reader]:
    """The row group, opened."""
    with run.filesystem.open_input_file(part.path) as stream:
        yield _Reader(pq.ParquetFile(stream), part)


class _Counts:
    """Numbers of matches of the latest queries: the pages of one list share theirs."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: collections.OrderedDict[tuple[str, str, str], int] = collections.OrderedDict()

    def get(self, key: tuple[str, str, str]) -> int | None:
        with self._lock:
            return self._found.get(key)

    def put(self, key: tuple[str, str, str], count: int) -> None:
        with self._lock:
            self._found[key] = count
            if len(self._found) > _KEPT_COUNTS:
                self._found.popitem(last=False)


_counts = _Counts()


class _Search:
    """Looks for the rows of one page."""

    def __init__(self, run: OpenRun, layer: Layer, query: FeatureQuery) -> None:
        self._run = run
        self._layer = layer
        self._query = query
        names = {name for one in query.filters for name in one.columns}
        self._has_times = query.interval is not None and layer.has_times
        self._columns = sorted(names | set(_TIMES)) if self._has_times else sorted(names)
        self._selects = bool(query.filters) or self._has_times
        self._union = None if query.boxes is None else shapely.union_all([shapely.box(*box) for box in query.boxes])
        self._windows = self._searched()

    def _searched(self) -> list[Box] | None:
        """Windows of the run's CRS in which all wanted geometries lie, beside rows without; None for anywhere."""
        query, crs = self._query, self._run.crs
        if query.boxes is not None:
            found = [crs.window(box, query.boxes_crs) for box in query.boxes]
        else:
            found = [crs.window(one.window, query.filter_crs) for one in query.filters if one.window is not None][:1]
        return None if not found or None in found else [box for box in found if box is not None]

    def page(self) -> FeaturePage:
        """The page."""
        query, layer = self._query, self._layer
        key = (self._run.version, layer.table, query.key)
        matched = _counts.get(key) if self._selects or self._union is not None else self._run.totals(layer.table).n
        counting = matched is None and self._can_count()
        # counting begins at the first row, a page at its own
        parts = self._run.index.parts(layer.table, self._windows, 0 if counting else query.start)
        features: list[bytes] = []
        count, looked_at, following = 0, 0, None
        for part in parts:
            if not counting and following is not None:
                break
            if not counting and features and looked_at >= MAX_READ:
                following = part.first
                break
            rows, was_read = self._rows(part)
            looked_at += was_read
            count += len(rows)
            wanted = rows[rows + part.first >= query.start] if following is None else rows[:0]
            room = query.limit - len(features)
            if len(wanted) > room:
                following = part.first + int(wanted[room])
                wanted = wanted[:room]
            if len(wanted):
                with _reading(self._run, part) as reader:
                    features += _features(self._run, layer, reader, wanted, query.crs)
        if counting:
            matched = count
            _counts.put(key, count)
        return FeaturePage(features=features, matched=matched, following=following)

    def _can_count(self) -> bool:
        """Whether few enough row groups must be looked at."""
        n = 0
        for part in self._run.index.parts(self._layer.table, self._windows):
            n += self._selects or not self._is_inside(part)
            if n > MAX_COUNTED:
                return False
        return True

    def _is_inside(self, part: Part) -> bool:
        """Whether the windows select all rows of a row group."""
        if self._union is None or part.bounds is None:
            return True
        bounds = self._run.crs.outside(part.bounds, self._query.boxes_crs)
        return bounds is not None and bool(shapely.covers(self._union, shapely.box(*bounds)))

    def _rows(self, part: Part) -> tuple[npt.NDArray[np.int64], bool]:
        """The selected rows of a row group, and whether they had to be looked at."""
        is_inside = self._is_inside(part)
        if is_inside and not self._selects:
            return np.arange(part.n), False
        query = self._query
        mask = np.ones(part.n, bool)
        with _reading(self._run, part) as reader:
            columns = reader.read(self._columns) if self._columns else {}
            own = reader.geometries() if not is_inside or any(one.is_spatial for one in query.filters) else None
        if not is_inside and own is not None:
            mask &= shapely.is_missing(own) | shapely.intersects(self._run.crs.moved(own, query.boxes_crs), self._union)
        if self._has_times:
            mask &= _in_time(columns, query.interval)
        moved = None if own is None else self._run.crs.moved(own, query.filter_crs)
        for one in query.filters:
            found = one.mask(Rows(columns, moved, part.n))
            mask &= np.asarray(pc.fill_null(found, fill_value=False))
        return np.flatnonzero(mask), True


def _in_time(columns: Mapping[str, pa.Array], interval: Interval | None) -> npt.NDArray[np.bool_]:
    """Rows whose acquisition meets an interval, or is unknown."""
    first, last = interval or (None, None)
    begins, ends = (pc.cast(columns[name], pa.timestamp("us", tz="UTC")) for name in _TIMES)
    mask = np.ones(len(begins), bool)
    if last is not None:
        mask &= np.asarray(pc.fill_null(pc.less_equal(begins, pa.scalar(last, begins.type)), fill_value=True))
    if first is not None:
        mask &= np.asarray(pc.fill_null(pc.greater_equal(ends, pa.scalar(first, ends.type)), fill_value=True))
    return mask


def _features(
    run: OpenRun, layer: Layer, reader: _Reader, rows: npt.NDArray[np.int64], crs: NamedCrs
) -> Iterator[bytes]:
    """The features of some rows of a row group."""
    columns = reader.read([GEOMETRY, *layer.properties])
    taken = {name: column.take(pa.array(rows)) for name, column in columns.items()}
    shapes = run.crs.written(_from_wkb(taken.pop(GEOMETRY)), crs)
    values = {name: column.to_pylist() for name, column in taken.items()}
    for number, shape in enumerate(shapes):
        row = {name: _plain(column[number]) for name, column in values.items()}
        geometry = b"null" if shape is None else str(shapely.to_geojson(shape)).encode()
        yield (
            b'{"type":"Feature","id":'
            + _json(layer.feature_id(row))
            + b',"geometry":'
            + geometry
            + b',"properties":'
            + _json(row)
            + b"}"
        )


def _plain(value: Any) -> Any:
    return value.isoformat().replace("+00:00", "Z") if isinstance(value, dt.datetime) else value


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
