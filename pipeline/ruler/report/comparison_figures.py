"""The figures of compared runs side by side: one row per figure, one column per run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.model import RoofType, Status
from pipeline.ruler.evaluation.chapters import NOTHING, number_text, printed, unit_sign
from pipeline.ruler.evaluation.counted_models import OUTCOMES
from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.ruler.report.comparison_records import ComparedBuilding, ComparedRun, Record, reference_of

MEASURES = (
    "delivery.lod2",
    "faces.completeness_10m2",
    "faces.correctness_10m2",
    "roof_types.correct",
    "roof_types.passable",
    "roof_types.false",
    "roof_types.accuracy",
    "footprints.iou_median",
    "surface.within_0_2m",
    "residuals.within_0_2m_top_visible",
    "residuals.rmse_top_visible",
    "validity.models_valid",
)
"""Measures of an evaluation, in their order; those that no run has are left out."""
Records = Sequence[Record]


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    note: str = ""


class FigureTable(NamedTuple):
    """Figures of all runs."""

    title: str
    first: str
    rows: Sequence[tuple[str, Sequence[Cell]]]


def figure_tables(runs: Sequence[ComparedRun], buildings: Sequence[ComparedBuilding]) -> tuple[FigureTable, ...]:
    """Results, roof types, times and measures of the runs, without empty tables."""
    columns = [tuple(building.records[place] for building in buildings) for place in range(len(runs))]
    tables = [_made(columns), _roof_types(columns), _seconds(columns), _measures(runs), _outcomes(runs)]
    return tuple(table for table in tables if table.rows)


def figure(value: float | None, unit: str, decimals: int) -> str:
    """A figure with its unit; a dash if unknown."""
    known = value is not None and math.isfinite(value)
    return number_text(float(value), unit, decimals) + unit_sign(unit) if known and value is not None else NOTHING


def _made(columns: Sequence[Records]) -> FigureTable:
    """Statuses with reasons, planes, residuals, coverage, validity."""
    common = [i for i, records in enumerate(zip(*columns, strict=True)) if all(one["is_model"] for one in records)]
    names = {
        Status.OK: "models by the method",
        Status.DOUBTFUL: "models that their points do not support",
        Status.FALLBACK: "blocks in their place",
        Status.FAILED: "failed",
    }
    rows = [("candidates", [Cell(f"{len(records):,}") for records in columns])]
    rows += [(names[status], [_status(records, status) for records in columns]) for status in Status]
    rows.append(("records with valid solids", [_share(sum(one["valid"] for one in r), len(r)) for r in columns]))
    rows.append(("roof planes of the models", [_planes(records) for records in columns]))
    for name, wanted in (("RMSE", "rmse_m"), ("95th percentile", "p95_m")):
        label = f"{name} of a building, median"
        rows.append((f"{label}, blocks counted", [_median(records, wanted, "m", 3) for records in columns]))
        both = [_median([records[i] for i in common], wanted, "m", 3) for records in columns]
        rows.append((f"{label}, where all have a model", both))
    rows.append(("points with a roof, median", [_median(records, "coverage", "share", 1) for records in columns]))
    return FigureTable("What the methods made", "figure", rows)


def _status(records: Records, status: Status) -> Cell:
    found = [record for record in records if record["status"] == status]
    reasons = Counter(record["reason"] for record in found if record["reason"] is not None)
    note = [f"{reason} {n:,}" for reason, n in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))]
    return _share(len(found), len(records), ", ".join(note))


def _share(part: int, whole: int, note: str = "") -> Cell:
    share = figure(part / whole, "share", 1) if whole else NOTHING
    return Cell(f"{part:,} ({share})", note)


def _planes(records: Records) -> Cell:
    planes = [record["n_planes"] for record in records if record["is_model"]]
    return Cell(f"{sum(planes):,}", f"{np.mean(planes):.1f} a model" if planes else "")


def _median(records: Records, name: str, unit: str, decimals: int) -> Cell:
    known = [record[name] for record in records if record["status"] != Status.FAILED and record[name] is not None]
    return Cell(figure(float(np.median(known)) if known else None, unit, decimals), f"n = {len(known):,}")


def _roof_types(columns: Sequence[Records]) -> FigureTable:
    """Number of buildings per roof type, without blocks and failed ones."""
    counts = [Counter(record["roof_type"] for record in records if record["is_model"]) for records in columns]
    kinds = [kind.value for kind in RoofType if any(count[kind.value] for count in counts)]
    rows = [(kind, [Cell(f"{count[kind]:,}") for count in counts]) for kind in kinds]
    return FigureTable("Roof types of the models", "roof type", rows)


def _seconds(columns: Sequence[Records]) -> FigureTable:
    """Seconds per building, where known."""
    known = [np.array([one["seconds"] for one in records if one["seconds"] is not None]) for records in columns]
    if not any(len(values) for values in known):
        return FigureTable("", "", ())
    kinds: tuple[tuple[str, Callable[..., float]], ...] = (
        ("median", np.median),
        ("mean", np.mean),
        ("95th percentile", lambda values: float(np.quantile(values, 0.95))),
        ("sum", np.sum),
    )
    rows = [
        (name, [Cell(seconds_text(float(of(values))) if len(values) else NOTHING) for values in known])
        for name, of in kinds
    ]
    rows.append(("buildings with a known time", [Cell(f"{len(values):,}") for values in known]))
    return FigureTable("Time of a building", "seconds", rows)


def seconds_text(seconds: float) -> str:
    """Three digits, at most milliseconds.

    >>> [seconds_text(s) for s in (0.0123, 0.5, 1.234, 12.34, 1234.5)]
    ['0.012 s', '0.500 s', '1.23 s', '12.3 s', '1,234 s']
    """
    decimals = min(3, max(0, 2 - math.floor(math.log10(seconds)))) if seconds > 0.0 else 3
    return f"{seconds:,.{decimals}f} s"


def _measures(runs: Sequence[ComparedRun]) -> FigureTable:
    """Headline measures with their intervals."""
    found = [
        {m.name: m for m in (() if run.evaluation is None else run.evaluation.measures) if m.subset == "all"}
        for run in runs
    ]
    rows = []
    for name in (name for name in MEASURES if any(name in measures for measures in found)):
        lines = [printed(measures[name], DEFINITIONS[name]) if name in measures else None for measures in found]
        cells = [
            Cell(NOTHING)
            if line is None
            else Cell(line.value, ", ".join(t for t in (line.interval, f"n = {line.n}") if t))
            for line in lines
        ]
        rows.append((DEFINITIONS[name].label, cells))
    against = reference_of(runs)
    return FigureTable("By themselves" if against is None else f"Against {against.name}", "measure", rows)


def _outcomes(runs: Sequence[ComparedRun]) -> FigureTable:
    """Correct / passable / false by true roof type."""
    counts: list[dict[str, list[int]]] = []
    for run in runs:
        table = None if run.evaluation is None else run.evaluation.tables.get("outcomes")
        rows = [] if table is None else [row for row in table.to_pylist() if row["subset"] == "all"]
        counts.append({row["true_type"]: [int(row[name]) for name in OUTCOMES] for row in rows})
    present = {kind for by_type in counts for kind, row in by_type.items() if sum(row)}
    kinds = [kind for kind in (*RoofType, "all") if kind in present]
    found = [(str(kind), [_outcome_cell(by_type.get(kind)) for by_type in counts]) for kind in kinds]
    return FigureTable("Correct / passable / false by true roof type", "true roof type", found)


def _outcome_cell(row: Sequence[int] | None) -> Cell:
    if row is None or not sum(row):
        return Cell(NOTHING)
    note = f"{figure(row[0] / sum(row), 'share', 1)} correct of {sum(row):,}"
    return Cell(" / ".join(f"{count:,}" for count in row), note)
