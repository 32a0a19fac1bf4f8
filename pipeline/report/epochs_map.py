"""The map of a comparison of two epochs: what changed over what did not, of a street or of a whole country."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.epochs.records import Change
from pipeline.epochs.summary import size_of
from pipeline.model import FloatArray
from pipeline.report.evaluation_maps import Entry, Layer, Map, draw_map

COLOURS = {
    Change.NEW: "#1b9e77",
    Change.GONE: "#b2182b",
    Change.RAISED: "#e08214",
    Change.LOWERED: "#2c7fb8",
    Change.RESHAPED: "#8856a7",
    Change.UNCHANGED: "#c3cad1",
    Change.NOT_COMPARABLE: "#7d8790",
}
"""The colour of each class."""
MOST_CHANGED, MOST_UNCHANGED = 30_000, 20_000
"""Footprints that are drawn. Of more changes the largest are; where more is unchanged, its places are cells."""
CELLS_ACROSS = 300
"""Cells along the longer side of the map."""
_DRAWN = (Change.NOT_COMPARABLE, Change.RESHAPED, Change.LOWERED, Change.RAISED, Change.GONE, Change.NEW)


class MapRows:
    """Gathers what the map shows, part by part, within bounds of memory."""

    def __init__(self) -> None:
        self._changed: list[pa.Table] = []
        self._unchanged: list[Any] = []
        self._middles: list[FloatArray] = []
        self._count: dict[str, int] = {}
        self.left_out = 0
        """Changes that are too many and too small to be drawn."""

    def add(self, table: pa.Table) -> None:
        """Take in the rows of a part."""
        is_same = pc.equal(table["change"], Change.UNCHANGED.value)
        changed = table.filter(pc.invert(is_same))
        for change in changed["change"].to_pylist():
            self._count[change] = self._count.get(change, 0) + 1
        kept = changed.select(["change", "geometry"]).append_column("size", size_of(changed))
        self._changed.append(kept.append_column("id", changed["change_id"]))
        if sum(len(one) for one in self._changed) > 2 * MOST_CHANGED:
            self._changed = [self._largest()]
        same = shapely.from_wkb(np.array(table.filter(is_same)["geometry"].to_pylist(), dtype=object))
        same = same[~shapely.is_missing(same)]
        bounds = shapely.bounds(same).reshape(-1, 4)
        self._middles.append((bounds[:, :2] + bounds[:, 2:]) / 2.0)
        self._unchanged.append(same)
        if self.unchanged > MOST_UNCHANGED:
            self._unchanged = []

    @property
    def unchanged(self) -> int:
        """Number of unchanged rows."""
        return sum(len(one) for one in self._middles)

    def _largest(self) -> pa.Table:
        """The largest changes; of equal ones those that come first by name."""
        table = pa.concat_tables(self._changed)
        order = pc.sort_indices(table, sort_keys=[("size", "descending"), ("id", "ascending")])
        self.left_out += max(0, len(table) - MOST_CHANGED)
        return table.take(order[:MOST_CHANGED])

    def map(self, unit_m: float) -> Map | None:
        """The map; None where nothing has geometry.

        Parameters
        ----------
        unit_m : float
            Metres a unit of the geometries.
        """
        layers = []
        if self.unchanged:
            layers.append(_layer(Change.UNCHANGED, self._same(), self.unchanged, unit_m))
        if self._changed:
            table = self._largest()
            for change in _DRAWN:
                rows = table.filter(pc.equal(table["change"], change.value))["geometry"].to_pylist()
                geometries = shapely.from_wkb(np.array(rows, dtype=object))
                if len(geometries):
                    layers.append(_layer(change, geometries, self._count[change.value], unit_m))
        return draw_map("Buildings by what became of them", layers)

    def _same(self) -> Any:
        """The unchanged footprints, or the cells that hold some."""
        if self.unchanged <= MOST_UNCHANGED:
            return np.concatenate(self._unchanged)
        middles = np.concatenate(self._middles)
        low = middles.min(axis=0)
        side = float(np.max(middles.max(axis=0) - low)) / CELLS_ACROSS
        cells = np.unique(np.floor((middles - low) / side).astype(np.int64), axis=0)
        corner = low + cells * side
        return shapely.box(corner[:, 0], corner[:, 1], corner[:, 0] + side, corner[:, 1] + side)


def _layer(change: Change, geometries: Any, count: int, unit_m: float) -> Layer:
    if unit_m != 1.0:
        geometries = shapely.transform(geometries, lambda xy: xy * unit_m)
    hatched = change is Change.NOT_COMPARABLE
    entry = Entry(label=change.value.replace("_", " "), colour=COLOURS[change], count=count, hatched=hatched)
    return Layer(entry=entry, geometries=list(geometries), filled=not hatched)
