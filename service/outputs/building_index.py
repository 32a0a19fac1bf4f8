"""The index of a job's buildings: a SQLite file, written once, then only read.

While a job runs its index grows in a file of its own, and readers get a copy, which does not change either.

It holds the columns that requests filter by, and where the prepared answers are in other files. A page of buildings
needs neither a Parquet reader nor a transformation of coordinates. Readers open it as immutable: no locks, also on a
network folder.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

NAME = "index.sqlite"
"""File name in the folder of outputs; not an output itself."""
FEATURES_NAME = "buildings.geojson"
"""The file of features that the index points into."""

_LAYOUT = """
CREATE TABLE tile (
    tile INTEGER PRIMARY KEY,
    name TEXT NOT NULL,
    n INTEGER NOT NULL,               -- buildings
    x_min REAL, y_min REAL, x_max REAL, y_max REAL,
    west REAL, south REAL, east REAL, north REAL
);
CREATE TABLE building (
    place INTEGER PRIMARY KEY,        -- in the order of the tiles
    building_id TEXT NOT NULL,
    tile INTEGER NOT NULL,
    mesh_path TEXT,
    start INTEGER NOT NULL,           -- of the feature in the file of features
    size INTEGER NOT NULL,
    geometry_start INTEGER NOT NULL,  -- within the feature
    geometry_size INTEGER NOT NULL,
    native BLOB NOT NULL,             -- the geometry in the coordinates of the tiles
    city_start INTEGER NOT NULL,      -- of the line in the tile's CityJSONSeq file
    city_size INTEGER NOT NULL,
    planes BLOB NOT NULL              -- JSON, compressed
);
CREATE TABLE decision (
    place INTEGER PRIMARY KEY,
    entries BLOB NOT NULL             -- JSON, compressed
);
-- narrow, which keeps a scan of all rows cheap; in the order of pages
CREATE TABLE key (
    building_id TEXT PRIMARY KEY,
    place INTEGER NOT NULL,
    tile INTEGER NOT NULL,
    status TEXT NOT NULL,
    roof_type TEXT NOT NULL,
    reason TEXT,
    x_min REAL, y_min REAL, x_max REAL, y_max REAL,
    west REAL, south REAL, east REAL, north REAL
) WITHOUT ROWID;
"""
_GROWTH = """
CREATE TABLE batch (name TEXT PRIMARY KEY) WITHOUT ROWID;  -- those whose buildings are here
"""
_BY_TILE = "CREATE INDEX key_by_tile ON key (tile)"
_TILES = """
INSERT INTO tile SELECT tile, '', count(*), min(x_min), min(y_min), max(x_max), max(y_max),
    min(west), min(south), max(east), max(north) FROM key GROUP BY tile
"""
Box = tuple[float, float, float, float]
_NOWHERE = (None, None, None, None)


class BuildingIndexFile:
    """Writes an index.

    Parameters
    ----------
    path : Path
        The file to write; must not exist.
    """

    def __init__(self, path: Path) -> None:
        self._connection = self._opened(path)
        self._connection.executescript(_LAYOUT)
        self._connection.execute("BEGIN")
        self._tiles: dict[str, int] = {}

    @staticmethod
    def _opened(path: Path) -> sqlite3.Connection:
        connection = sqlite3.connect(path, isolation_level=None)
        # the file gets its name when it is complete, so nothing here needs to survive a crash
        for setting in ("journal_mode=OFF", "synchronous=OFF", "cache_size=-32000", "locking_mode=EXCLUSIVE"):
            connection.execute(f"PRAGMA {setting}")
        return connection

    def add(
        self,
        *,
        record: Mapping[str, Any],
        feature: tuple[int, int, int, int],
        native: bytes,
        city: tuple[int, int],
        planes: Sequence[Mapping[str, Any]],
        decisions: Sequence[Mapping[str, Any]],
        bounds: Box | None,
        bounds_deg: Box | None,
    ) -> None:
        """Append one building.

        Parameters
        ----------
        record : mapping
            Its row of the buildings table, with `tile`.
        feature : tuple of int
            Start and size of its feature, start and size of the geometry within.
        native : bytes
            The geometry in the coordinates of the tiles, as GeoJSON.
        city : tuple of int
            Start and size of its line in the tile's CityJSONSeq file.
        planes : sequence of mapping
            Its rows of the planes table without geometry.
        decisions : sequence of mapping
            Its rows of the decisions table.
        bounds, bounds_deg : tuple of float, optional
            Of the footprint, in the coordinates of the tiles and in degrees.
        """
        name = record["building_id"]
        tile = self._tiles.setdefault(record["tile"], len(self._tiles))
        cursor = self._connection.execute(
            "INSERT INTO building (building_id, tile, mesh_path, start, size, geometry_start, geometry_size, native,"
            " city_start, city_size, planes) VALUES (?,?,?,?,?,?,?,?,?,?,?)",
            (name, tile, record["mesh_path"], *feature, native, *city, _packed(planes)),
        )
        if decisions:
            self._connection.execute("INSERT INTO decision VALUES (?,?)", (cursor.lastrowid, _packed(decisions)))
        words = (record["status"], record["roof_type"], record["reason"])
        self._connection.execute(
            "INSERT INTO key VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)",
            (name, cursor.lastrowid, tile, *words, *(bounds or _NOWHERE), *(bounds_deg or _NOWHERE)),
        )

    def _finish(self) -> None:
        """Write the search index and the names of the tiles."""
        self._connection.execute(_BY_TILE)
        self._sum_tiles()
        self._connection.execute("COMMIT")

    def _sum_tiles(self) -> None:
        """Write the tiles: their names, numbers and bounds."""
        self._connection.execute("DELETE FROM tile")
        self._connection.execute(_TILES)
        self._connection.executemany(
            "UPDATE tile SET name = ? WHERE tile = ?", [(name, tile) for name, tile in self._tiles.items()]
        )

    def __enter__(self) -> Self:
        """Open for writing."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file, or leave it if there was an exception."""
        if kind is None:
            self._finish()
        self._connection.close()


class GrowingIndexFile(BuildingIndexFile):
    """Writes an index that readers see while it grows. They read a copy, which is replaced as a whole.

    A writer that was killed does no harm: the next one goes on from the copy.

    Parameters
    ----------
    path : Path
        The copy that is read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._own = path.with_name(f".growing-{path.name}")
        self._own.unlink(missing_ok=True)
        is_new = not path.exists()
        if not is_new:
            shutil.copyfile(path, self._own)
        self._connection = self._opened(self._own)
        if is_new:
            self._connection.executescript(_LAYOUT + _GROWTH + _BY_TILE)
        self._tiles = {name: tile for tile, name in self._connection.execute("SELECT tile, name FROM tile")}
        self._connection.execute("BEGIN")

    @property
    def n_buildings(self) -> int:
        """Number of its buildings."""
        (count,) = self._connection.execute("SELECT count(*) FROM building").fetchone()
        return int(count)

    @property
    def features_size(self) -> int:
        """Bytes of the file of features that it knows."""
        (size,) = self._connection.execute("SELECT coalesce(max(start + size), 0) FROM building").fetchone()
        return int(size)

    @property
    def city_sizes(self) -> dict[str, int]:
        """Bytes of each tile's CityJSONSeq file that it knows, by the tile's name."""
        ends = "SELECT name, max(city_start + city_size) FROM building JOIN tile USING (tile) GROUP BY tile"
        return {name: end + 1 for name, end in self._connection.execute(ends)}

    @property
    def batches(self) -> set[str]:
        """Names of the batches whose buildings it has."""
        return {name for (name,) in self._connection.execute("SELECT name FROM batch")}

    def add_batch(self, name: str) -> None:
        """Note that all buildings of a batch are added."""
        self._connection.execute("INSERT INTO batch VALUES (?)", (name,))

    def show(self) -> None:
        """Let readers see what was added since."""
        self._sum_tiles()
        self._connection.execute("COMMIT")
        new = self._path.with_name(f".new-{self._path.name}")
        shutil.copyfile(self._own, new)
        new.replace(self._path)
        self._connection.execute("BEGIN")

    def _finish(self) -> None:
        """Nothing: what readers did not see yet is added again by the next writer."""


def _packed(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows as compressed JSON."""
    return zlib.compress(json.dumps(list(rows), separators=(",", ":"), allow_nan=False).encode())
