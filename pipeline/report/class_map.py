"""A map of buildings by class, from a street to a whole country, filled part by part in bounded memory.

Ordinary buildings lie beneath; the others are drawn over them one by one, so a map of a city still shows them.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.model import FloatArray
from pipeline.report.maps import Entry, Map, draw_map

MAX_DRAWN, MAX_ORDINARY = 30_000, 20_000
"""Most footprints that are drawn: the largest ones that are not ordinary; ordinary ones beyond this become cells."""
CELLS_ACROSS = 300
"""Cells along the longer side of the map."""

ROWS = pa.schema([("class", pa.string()), ("geometry", pa.binary()), ("size", pa.float64()), ("id", pa.string())])
"""Columns of a part of the map: class, footprint as WKB, size by which the rows are ordered, name of the row."""


class ClassMap:
    """A map by classes, each with its name in the rows: all others are drawn over the first one, the last on top."""

    def __init__(self, title: str, classes: Mapping[str, Entry]) -> None:
        self._title, self._classes = title, dict(classes)
        self._ordinary = next(iter(classes))
        self._drawn: list[pa.Table] = []
        self._beneath: list[Any] = []
        self._middles: list[FloatArray] = []
        self._count: Counter[str] = Counter()
        self._n_drawn = 0
        self.ordinary = 0
        """Ordinary rows with a geometry."""
        self.left_out = 0
        """Rows that are left out because others are larger."""

    def add(self, rows: pa.Table) -> None:
        """Add a part with the columns of `ROWS`."""
        is_ordinary = pc.equal(rows["class"], self._ordinary)
        drawn = rows.filter(pc.invert(is_ordinary))
        self._count.update(drawn["class"].to_pylist())
        self._drawn.append(drawn)
        self._n_drawn += len(drawn)
        if self._n_drawn > 2 * MAX_DRAWN:
            self._drawn = [self._largest()]
            self._n_drawn = len(self._drawn[0])
        found = shapely.from_wkb(np.array(rows.filter(is_ordinary)["geometry"].to_pylist(), dtype=object))
        found = found[~shapely.is_missing(found)]
        bounds = shapely.bounds(found).reshape(-1, 4)
        self._middles.append((bounds[:, :2] + bounds[:, 2:]) / 2.0)
        self._beneath.append(found)
        self.ordinary += len(found)
        if self.ordinary > MAX_ORDINARY:
            self._beneath = []

    def _largest(self) -> pa.Table:
        """The largest rows; the first name wins among equal ones."""
        table = pa.concat_tables(self._drawn)
        order = pc.sort_indices(table, sort_keys=[("size", "descending"), ("id", "ascending")])
        self.left_out += max(0, len(table) - MAX_DRAWN)
        return table.take(order[:MAX_DRAWN])

    def map(self, unit_m: float) -> Map | None:
        """The map, given metres per unit of the geometries; None without geometry."""
        shown: dict[str, Any] = {}
        if self.ordinary:
            self._count[self._ordinary] = self.ordinary
            shown[self._ordinary] = self._cells_or_footprints()
        if self._drawn:
            table = self._largest()
            for name in [*self._classes][1:]:
                rows = table.filter(pc.equal(table["class"], name))["geometry"].to_pylist()
                shown[name] = shapely.from_wkb(np.array(rows, dtype=object))
        layers = [
            dataclasses.replace(
                self._classes[name],
                count=self._count[name],
                geometries=shapely.transform(geometries, lambda xy: xy * unit_m).tolist(),
            )
            for name, geometries in shown.items()
        ]
        return draw_map(self._title, layers)

    def _cells_or_footprints(self) -> Any:
        """The ordinary footprints, or the cells that contain them."""
        if self.ordinary <= MAX_ORDINARY:
            return np.concatenate(self._beneath)
        middles = np.concatenate(self._middles)
        low = middles.min(axis=0)
        side = float(np.max(middles.max(axis=0) - low)) / CELLS_ACROSS
        cells = np.unique(np.floor((middles - low) / side).astype(np.int64), axis=0)
        corner = low + cells * side
        return shapely.box(corner[:, 0], corner[:, 1], corner[:, 0] + side, corner[:, 1] + side)
