"""The figures of a finished run: statuses with reasons, roof types, residuals and coverage, for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs

from pipeline.export.geoparquet import stored_schema, table_batches
from pipeline.io import arrow_at
from pipeline.model import RoofType, Status

QUANTILES = (("p10", 0.1), ("p50", 0.5), ("p90", 0.9), ("max", 1.0))
"""Quantiles of a figure over the buildings."""
_FIGURES = ("rmse_m", "p95_m", "share_within_0_2m", "share_below_roof", "coverage", "density_per_m2", "height_m")
_SUMS = ("footprint_area_m2", "roof_area_m2", "volume_m3", "n_planes", "n_points")
_COLUMNS = ("status", "reason", "roof_type", "lod", "validity_codes", "touches_data_edge", *_FIGURES, *_SUMS)


def run_statistics(run_dir: str, filesystem: pafs.FileSystem | None = None) -> dict[str, Any]:
    """The figures of a finished run as plain JSON values; RunError if the directory has no run.

    `candidates`, `rejected`: counts. `statuses`, `shares`: of all candidates. `reasons`: of those not ok, by status and
    reason. `rejected_reasons`, `roof_types`, `lods`, `validity_codes`: counts. `touches_data_edge`: count. `sums`:
    totals of areas, volume, planes, points. `quantiles`: of each figure over the buildings that have it, with their
    number as `n`.
    """
    if filesystem is None:
        filesystem, run_dir = arrow_at(run_dir)
    table = _columns(run_dir, "buildings", _COLUMNS, filesystem)
    rejected = _columns(run_dir, "rejected", ("reason",), filesystem)
    statuses = Counter(table["status"].to_pylist())
    reasons: dict[str, Counter[str]] = {}
    for status, reason in zip(table["status"].to_pylist(), table["reason"].to_pylist(), strict=True):
        if reason is not None:
            reasons.setdefault(status, Counter())[reason] += 1
    codes = Counter(str(code) for found in table["validity_codes"].to_pylist() for code in set(found))
    return {
        "candidates": table.num_rows,
        "rejected": rejected.num_rows,
        "statuses": {status.value: statuses[status.value] for status in Status},
        "shares": {s.value: round(statuses[s.value] / table.num_rows, 4) if table.num_rows else None for s in Status},
        "reasons": {status: _most_first(counts) for status, counts in sorted(reasons.items())},
        "rejected_reasons": _most_first(Counter(rejected["reason"].to_pylist())),
        "roof_types": _known_order(Counter(table["roof_type"].to_pylist()), [kind.value for kind in RoofType]),
        "lods": dict(sorted(Counter(lod for lod in table["lod"].to_pylist() if lod).items(), reverse=True)),
        "validity_codes": dict(sorted(codes.items())),
        "touches_data_edge": sum(table["touches_data_edge"].to_pylist()),
        "sums": {name: _total(table[name]) for name in _SUMS},
        "quantiles": {name: _quantiles(table[name]) for name in _FIGURES},
    }


def _columns(run_dir: str, name: str, columns: Sequence[str], filesystem: pafs.FileSystem) -> pa.Table:
    """Columns of a table of the run, whole."""
    schema = pa.schema([stored_schema(name).field(column) for column in columns])
    batches = [batch.select(columns) for batch in table_batches(run_dir, name, columns, filesystem)]
    return pa.Table.from_batches([batch.cast(schema) for batch in batches], schema)


def _most_first(counts: Counter[str]) -> dict[str, int]:
    """Counts from the most frequent to the least, equal ones by name."""
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _known_order(counts: Counter[str], order: Sequence[str]) -> dict[str, int]:
    """The counts that are not zero, in a given order."""
    return {name: counts[name] for name in order if counts[name]}


def _total(column: pa.ChunkedArray) -> float:
    """Sum of the known values, rounded to thousandths; whole numbers stay whole."""
    values = [value for value in column.to_pylist() if value is not None]
    return sum(values) if pa.types.is_integer(column.type) else round(float(np.sum(values)), 3)


def _quantiles(column: pa.ChunkedArray) -> dict[str, float | int | None]:
    """Quantiles and number of the known values."""
    values = column.drop_null().to_numpy()
    quantiles: dict[str, float | int | None] = {"n": len(values)}
    for name, share in QUANTILES:
        quantiles[name] = round(float(np.quantile(values, share)), 3) if len(values) else None
    return quantiles
