"""The index of a job's buildings: a SQLite file, written once, then only read.

It holds the columns that requests filter by, and where the prepared answers are in other files. A page of buildings
needs neither a Parquet reader nor a transformation of coordinates. Readers open it as immutable: no locks, also on a
network folder.
"""

from __future__ import annotations

import json
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
        self._connection = sqlite3.connect(path, isolation_level=None)
        # the file gets its name when it is complete, so nothing here needs to survive a crash
        for setting in ("journal_mode=OFF", "synchronous=OFF", "cache_size=-32000", "locking_mode=EXCLUSIVE"):
            self._connection.execute(f"PRAGMA {setting}")
        self._connection.executescript(_LAYOUT)
        self._connection.execute("BEGIN")
        self._tiles: dict[str, int] = {}

    def add(
        self,
        *,
        record: Mapping[str, Any],
        feature: tuple[int, int, int, int],
        native: bytes,
        city: tuple[int, int],
        planes: Sequence[Mapping[str, Any]],
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
        bounds, bounds_deg : tuple of float, optional
            Of the footprint, in the coordinates of the tiles and in degrees.
        """
        packed = zlib.compress(json.dumps(list(planes), separators=(",", ":"), allow_nan=False).encode())
        name = record["building_id"]
        tile = self._tiles.setdefault(record["tile"], len(self._tiles))
        cursor = self._connection.execute(
            "INSERT INTO building (building_id, tile, mesh_path, start, size, geometry_start, geometry_size, native,"
            " city_start, city_size, planes) VALUES (?,?,?,?,?,?,?,?,?,?,?)",
            (name, tile, record["mesh_path"], *feature, native, *city, packed),
        )
        words = (record["status"], record["roof_type"], record["reason"])
        self._connection.execute(
            "INSERT INTO key VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)",
            (name, cursor.lastrowid, tile, *words, *(bounds or _NOWHERE), *(bounds_deg or _NOWHERE)),
        )

    def _finish(self) -> None:
        """Write the search index and the names of the tiles."""
        self._connection.execute("CREATE INDEX key_by_tile ON key (tile)")
        self._connection.execute(_TILES)
        self._connection.executemany(
            "UPDATE tile SET name = ? WHERE tile = ?", [(name, tile) for name, tile in self._tiles.items()]
        )
        self._connection.execute("COMMIT")

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
