"""The labels of a simulated data set."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq


def labels_of(truth: Path) -> dict[str, Any]:
    """One array per column of the labels, in the order of the points of all tiles; building_id is None for none."""
    tables = []
    for tile in json.loads((truth / "scene.json").read_text())["tiles"]:
        table = pq.read_table(truth / tile["labels"])
        names = table["building_id"].cast(pa.string())
        tables.append(table.drop_columns("building_id").append_column("building_id", names))
    labels = pa.concat_tables(tables)
    return {name: labels[name].to_numpy() for name in labels.column_names}
