"""Tables of a finished run: statuses with reasons, roof types, residuals and coverage, for people and for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
from rich.table import Table

from pipeline.export.geoparquet import table_dataset
from pipeline.io import arrow_at
from pipeline.model import RoofType, Status

QUANTILES = (("p10", 0.1), ("p50", 0.5), ("p90", 0.9), ("max", 1.0))
"""What is told of a figure's distribution over the buildings."""
_FIGURES = ("rmse_m", "p95_m", "coverage", "density_per_m2", "height_m")
_SUMS = ("footprint_area_m2", "roof_area_m2", "volume_m3", "n_planes", "n_points")
_COLUMNS = ("status", "reason", "roof_type", "lod", "validity_codes", "touches_data_edge", *_FIGURES, *_SUMS)


def run_statistics(run_dir: str, filesystem: pafs.FileSystem | None = None) -> dict[str, Any]:
    """The figures of a finished run as plain JSON values.

    Parameters
    ----------
    run_dir : str
        The run directory: a path or URL, or a path of `filesystem`.
    filesystem : pyarrow.fs.FileSystem, optional
        Where the run lies; by default as `run_dir` says.

    Returns
    -------
    dict
        `candidates`, `rejected`: counts. `statuses`, `shares`: of all candidates. `reasons`: of those not ok, by status
        and reason. `rejected_reasons`, `roof_types`, `lods`, `validity_codes`: counts. `touches_data_edge`: count.
        `sums`: totals of areas, volume, planes, points. `quantiles`: of each figure over the buildings that have it,
        with their number as `n`.

    Raises
    ------
    RunError
        The directory holds no run.
    """
    if filesystem is None:
        filesystem, run_dir = arrow_at(run_dir)
    table = table_dataset(run_dir, "buildings", filesystem).to_table(columns=list(_COLUMNS))
    rejected = table_dataset(run_dir, "rejected", filesystem).to_table(columns=["reason"])
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


def _most_first(counts: Counter[str]) -> dict[str, int]:
    """Counts from the most frequent to the least, equal ones by name."""
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _known_order(counts: Counter[str], order: Sequence[str]) -> dict[str, int]:
    """The counts that are not zero, in a given order."""
    return {name: counts[name] for name in order if counts[name]}


def _total(column: pa.ChunkedArray) -> float:
    """Sum of what is known, rounded to thousandths; whole numbers stay whole."""
    values = [value for value in column.to_pylist() if value is not None]
    return sum(values) if pa.types.is_integer(column.type) else round(float(np.sum(values)), 3)


def _quantiles(column: pa.ChunkedArray) -> dict[str, float | int | None]:
    """Quantiles of what is known, and how many that are."""
    values = column.drop_null().to_numpy()
    told: dict[str, float | int | None] = {"n": len(values)}
    for name, share in QUANTILES:
        told[name] = round(float(np.quantile(values, share)), 3) if len(values) else None
    return told


def statistics_tables(statistics: Mapping[str, Any]) -> list[Table]:
    """The figures of `run_statistics` as rich tables for a terminal."""
    tables = [_outcome_table(statistics), _count_table("Roof types", "type", statistics["roof_types"])]
    if statistics["rejected_reasons"]:
        tables.append(_count_table("Judged to be no building", "reason", statistics["rejected_reasons"]))
    tables.append(_quantile_table(statistics))
    return tables


def _outcome_table(statistics: Mapping[str, Any]) -> Table:
    """Statuses with their shares, and their reasons beneath."""
    table = Table(title="Candidates", title_justify="left")
    table.add_column("status")
    table.add_column("reason")
    table.add_column("count", justify="right")
    table.add_column("share", justify="right")
    for status, count in statistics["statuses"].items():
        share = statistics["shares"][status]
        table.add_row(status, "", str(count), "" if share is None else f"{share:.1%}")
        for reason, told in statistics["reasons"].get(status, {}).items():
            table.add_row("", reason, str(told), f"{told / statistics['candidates']:.1%}")
    table.add_section()
    table.add_row("all", "", str(statistics["candidates"]), "")
    return table


def _count_table(title: str, header: str, counts: Mapping[str, int]) -> Table:
    """Counts by name."""
    table = Table(title=title, title_justify="left")
    table.add_column(header)
    table.add_column("count", justify="right")
    for name, count in counts.items():
        table.add_row(name, str(count))
    return table


def _quantile_table(statistics: Mapping[str, Any]) -> Table:
    """Quantiles of the figures over the buildings."""
    table = Table(title="Over the buildings", title_justify="left")
    table.add_column("figure")
    for name, _ in QUANTILES:
        table.add_column(name, justify="right")
    table.add_column("n", justify="right")
    for figure, told in statistics["quantiles"].items():
        values = ["" if told[name] is None else f"{told[name]:.3f}" for name, _ in QUANTILES]
        table.add_row(figure, *values, str(told["n"]))
    return table
