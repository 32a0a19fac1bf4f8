"""The map of a comparison of two epochs: changed buildings over unchanged ones."""

from __future__ import annotations

from collections.abc import Callable

import pyarrow as pa

from pipeline.report.class_map import ROWS, ClassMap
from pipeline.report.maps import Entry
from pipeline.ruler.epochs.change_records import Change
from pipeline.ruler.epochs.change_summary import size_of

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
_DRAWN = (Change.NOT_COMPARABLE, Change.RESHAPED, Change.LOWERED, Change.RAISED, Change.GONE, Change.NEW)


def epochs_map() -> ClassMap:
    """An empty map of changes."""
    classes = {
        change.value: Entry(change.value.replace("_", " "), COLOURS[change], hatched=change is Change.NOT_COMPARABLE)
        for change in (Change.UNCHANGED, *_DRAWN)
    }
    return ClassMap("Buildings by change", classes)


def gathering(drawn: ClassMap) -> Callable[[pa.Table], None]:
    """A function that adds rows of changes to a map."""

    def gather(table: pa.Table) -> None:
        columns = [table["change"], table["geometry"], size_of(table), table["change_id"]]
        drawn.add(pa.table(columns, names=ROWS.names).cast(ROWS))

    return gather
