"""The table `decisions`: what was checked and tried for each building. It explains results and is not part of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa

from pipeline.export.columns import COLUMNS, schema_of
from pipeline.model import BuildingResult

NAME = "decisions"
"""Name of the table and of its folder in a run directory. The digest of a run does not cover it."""

DECISIONS = schema_of(COLUMNS[NAME])
"""One row per check, form and level of detail, sorted by `building_id` and `step`."""

_MAX_DETAIL = 300
"""Characters of a detail: messages of GEOS can hold whole geometries."""


def decisions_path(tile_key: str) -> str:
    """The file of a tile, relative to the run directory."""
    return f"{NAME}/tile={tile_key}/part-0.parquet"


def decision_rows(result: BuildingResult) -> list[dict[str, Any]]:
    """The rows of one building; figures that were not needed become None."""
    return [
        {
            "building_id": result.building_id,
            "step": step,
            "kind": entry.kind.value,
            "name": entry.name,
            "outcome": entry.outcome.value,
            "detail": entry.detail[:_MAX_DETAIL],
            "value": _or_none(entry.value),
            "limit": _or_none(entry.limit),
            "n_faces": entry.n_faces,
            "n_planes": entry.n_planes,
            "levelled_share": _or_none(entry.levelled_share),
            "explained_share": _or_none(entry.explained_share),
            "bic_margin": _or_none(entry.bic_margin),
            "validity_codes": list(entry.validity_codes),
        }
        for step, entry in enumerate(result.decisions)
    ]


def decisions_table(rows: Iterable[Mapping[str, Any]]) -> pa.Table:
    """Rows as an Arrow table, sorted."""
    ordered = sorted(rows, key=lambda row: (row["building_id"], row["step"]))
    return pa.Table.from_pylist([dict(row) for row in ordered], schema=DECISIONS)


def _or_none(value: float) -> float | None:
    """A rounded figure; None where there is none."""
    return round(float(value), 4) + 0.0 if math.isfinite(value) else None
