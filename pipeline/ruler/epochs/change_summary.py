"""Sums of a comparison, part by part: counts of classes, areas, volumes, reasons, doubts, the largest changes."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections import Counter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.model import IntArray
from pipeline.ruler.epochs.change_records import SCHEMA, Change, Doubt, Incomparable, Relation
from pipeline.ruler.epochs.epoch import floats

SUMS = (
    *("area_change_m2", "added_m2", "removed_m2", "raised_m2", "lowered_m2"),
    *("volume_change_m3", "gained_m3", "lost_m3"),
)
"""The columns that are summed by class."""
LARGEST = 300
"""Rows of each class that are kept for the page."""
_REACH_MM = 20_000
"""Range of the histogram of levels; larger differences count at its ends."""
HEIGHT_EDGES_M = tuple(0.5 * step for step in range(-24, 25))
"""Borders of the classes of rises and drops; values beyond count in the outermost ones."""


def size_of(table: pa.Table) -> Any:
    """Order of the rows: gained plus lost volume; 0 if unknown."""
    gained, lost = (pc.fill_null(table[name], 0.0) for name in ("gained_m3", "lost_m3"))
    return pc.add(gained, lost)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Level:
    """Agreement of the elevations of the two epochs on unchanged roofs."""

    median_m: float | None
    """Median of the differences, NEW less OLD; None without such roofs."""
    spread_m: float | None
    """Half of the distance between the quantiles that hold 68.27 % of them: one standard deviation."""
    count: int


class Summary:
    """Aggregates all rows."""

    def __init__(self) -> None:
        self.rows: Counter[str] = Counter()
        self.old_buildings: Counter[str] = Counter()
        self.new_buildings: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.relations: Counter[str] = Counter()
        self.doubts: Counter[str] = Counter()
        self.without_doubt: Counter[str] = Counter()
        self.flags: Counter[str] = Counter()
        self.sums: dict[str, dict[str, float]] = {name: dict.fromkeys(Change, 0.0) for name in SUMS}
        self.heights: IntArray = np.zeros(len(HEIGHT_EDGES_M) - 1, np.int64)
        self.acquired: dict[str, dt.datetime] = {}
        self._level: IntArray = np.zeros(2 * _REACH_MM + 1, np.int64)
        self._largest: dict[str, pa.Table] = {}

    def add(self, table: pa.Table) -> None:
        """Add the rows of one part."""
        self.reasons.update(_counted(table["reason"]))
        self.relations.update(_counted(table["relation"]))
        self.flags.update(
            {name: int(pc.sum(table[name]).as_py() or 0) for name in ("is_raised", "is_lowered", "is_reshaped")}
        )
        for change, count in sorted(_counted(table["change"]).items()):
            rows = table.filter(pc.equal(table["change"], change))
            self.rows[change] += count
            self.old_buildings[change] += int(pc.sum(pc.list_value_length(rows["old_ids"])).as_py())
            self.new_buildings[change] += int(pc.sum(pc.list_value_length(rows["new_ids"])).as_py())
            self.without_doubt[change] += int(pc.sum(pc.equal(pc.list_value_length(rows["doubts"]), 0)).as_py())
            if change != Change.UNCHANGED.value:
                self.doubts.update(_counted(pc.list_flatten(rows["doubts"])))
            for name in SUMS:
                self.sums[name][change] += float(pc.sum(rows[name]).as_py() or 0.0)
            if change == Change.UNCHANGED.value:
                self._take_level(rows)
            else:
                self._take_largest(change, rows)
                self._take_heights(rows)
        self._take_times(table)

    def _take_heights(self, rows: pa.Table) -> None:
        raised, dropped = (np.nan_to_num(floats(rows[name])) for name in ("max_raise_m", "max_drop_m"))
        strongest = np.where(raised >= dropped, raised, -dropped)
        counted = strongest[strongest != 0.0]
        self.heights += np.histogram(np.clip(counted, HEIGHT_EDGES_M[0], HEIGHT_EDGES_M[-1]), HEIGHT_EDGES_M)[0]

    def _take_times(self, table: pa.Table) -> None:
        """The latest acquisition of the earlier epoch and the earliest of the later one."""
        for name, extreme, better in (("old_acquired", pc.max, max), ("new_acquired", pc.min, min)):
            found = extreme(table[name]).as_py()
            if found is not None:
                self.acquired[name] = found if name not in self.acquired else better(self.acquired[name], found)

    def _take_level(self, rows: pa.Table) -> None:
        known = floats(rows["height_change_m"])
        mm = np.clip(np.rint(known[np.isfinite(known)] * 1000.0), -_REACH_MM, _REACH_MM).astype(np.int64)
        self._level += np.bincount(mm + _REACH_MM, minlength=2 * _REACH_MM + 1)

    def _take_largest(self, change: str, rows: pa.Table) -> None:
        held = self._largest.get(change)
        joined = rows if held is None else pa.concat_tables([held, rows])
        order = pc.sort_indices(
            pa.table({"size": size_of(joined), "id": joined["change_id"]}),
            sort_keys=[("size", "descending"), ("id", "ascending")],
        )
        self._largest[change] = joined.take(order[:LARGEST]).combine_chunks()

    @property
    def largest(self) -> pa.Table:
        """The largest rows of every class except the unchanged, class by class, at most `LARGEST` of each."""
        held = [self._largest[change.value] for change in Change if change.value in self._largest]
        return pa.concat_tables(held) if held else SCHEMA.empty_table()

    @property
    def level(self) -> Level:
        """Agreement of the elevations of the epochs."""
        count = int(self._level.sum())
        if count == 0:
            return Level(median_m=None, spread_m=None, count=0)
        cumulated = np.cumsum(self._level)

        def quantile(share: float) -> float:
            low, high = (int(np.searchsorted(cumulated, place + 1)) for place in _places(share, count))
            return ((low + high) / 2.0 - _REACH_MM) / 1000.0

        return Level(median_m=quantile(0.5), spread_m=(quantile(0.84135) - quantile(0.15865)) / 2.0, count=count)

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values, in the order of the closed lists."""
        level = self.level
        return {
            "changes": {
                change.value: {
                    "rows": self.rows[change.value],
                    "without_doubt": self.without_doubt[change.value],
                    "old_buildings": self.old_buildings[change.value],
                    "new_buildings": self.new_buildings[change.value],
                    **{name: round(self.sums[name][change.value], 1) + 0.0 for name in SUMS},
                }
                for change in Change
            },
            "flags": {name: self.flags[name] for name in ("is_raised", "is_lowered", "is_reshaped")},
            "reasons": {one.value: self.reasons[one.value] for one in Incomparable if self.reasons[one.value]},
            "doubts": {one.value: self.doubts[one.value] for one in Doubt if self.doubts[one.value]},
            "relations": {one.value: self.relations[one.value] for one in Relation if self.relations[one.value]},
            "level": {
                "median_m": None if level.median_m is None else round(level.median_m, 4),
                "spread_m": None if level.spread_m is None else round(level.spread_m, 4),
                "unchanged_roofs": level.count,
            },
        }


def _places(share: float, count: int) -> tuple[int, int]:
    """The ranks whose mean is a quantile; symmetric: exchanging the epochs only turns its sign."""
    rank = share * (count - 1)
    return int(np.floor(rank + 1e-9)), int(np.ceil(rank - 1e-9))


def _counted(column: Any) -> dict[str, int]:
    """How often each value occurs, without null."""
    counts = pc.value_counts(column)
    return {pair["values"]: pair["counts"] for pair in counts.to_pylist() if pair["values"] is not None}
