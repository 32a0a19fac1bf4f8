"""Counts behind the figures, as tables to print: outcomes by roof type, confusion, topology, codes, breakdowns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.model import BoolArray, FloatArray, RoofType
from pipeline.report.table import CountTable
from pipeline.ruler.evaluation.measure import Group

OUTCOMES = ("correct", "passable", "false")
"""Outcomes of a roof, best first (Hofmann, Maas, Streilein 2003)."""
MAX_WIREFRAMES = 20
"""Buildings in the table of the worst wireframes."""
AREA_CLASSES_M2 = (0.0, 50.0, 100.0, 200.0, 500.0, math.inf)
"""Borders of the classes of footprints in breakdowns."""


Tables = Mapping[str, pa.Table]


def count_tables(tables: Tables) -> dict[Group, tuple[CountTable, ...]]:
    """The count tables by chapter, without those that were not measured."""
    makers: Sequence[tuple[Group, str, Callable[[pa.Table], list[CountTable]]]] = (
        (Group.ROOF_TYPES, "outcomes", _outcomes),
        (Group.ROOF_TYPES, "confusion", _confusion),
        (Group.FACES, "topology", _topology),
        (Group.VALIDITY, "validity_codes", _validity_codes),
        (Group.GROUND, "ground", _ground),
        (Group.WIREFRAMES, "wireframes", _wireframes),
    )
    found: dict[Group, tuple[CountTable, ...]] = {}
    for group, name, make in makers:
        if name in tables and tables[name].num_rows:
            found[group] = (*found.get(group, ()), *make(tables[name]))
    return found


def _in_order_of_types(names: set[str]) -> list[str]:
    order = [kind.value for kind in RoofType]
    return [name for name in order if name in names] + sorted(names - set(order))


def _outcomes(table: pa.Table) -> list[CountTable]:
    """As in the paper: one row per roof type and their sum; one table per subset that is not empty."""
    printed = []
    rows = table.to_pylist()
    for subset in dict.fromkeys(row["subset"] for row in rows):
        by_type = {row["true_type"]: [int(row[name]) for name in OUTCOMES] for row in rows if row["subset"] == subset}
        if not sum(sum(counts) for counts in by_type.values()):
            continue
        kinds = [kind for kind in _in_order_of_types(set(by_type)) if kind != "all"]
        lines = [(kind, by_type[kind]) for kind in kinds]
        lines.append(("all", [sum(counts[i] for _, counts in lines) for i in range(len(OUTCOMES))]))
        header = ("roof type", *OUTCOMES, "buildings", "share correct", "share passable or better")
        body = tuple((kind, *_outcome_cells(counts)) for kind, counts in lines)
        titles = {"all": "all buildings", "good": "buildings without defects", "hard": "buildings with defects"}
        printed.append(CountTable(title=f"Outcomes: {titles.get(subset, subset)}", header=header, rows=body))
    return printed


def _outcome_cells(counts: Sequence[int]) -> tuple[str, ...]:
    """Counts, their sum, and the shares of the best and of the two best."""
    total = sum(counts)
    return *map(_count, counts), _count(total), _share(counts[0], total), _share(counts[0] + counts[1], total)


def _confusion(table: pa.Table) -> list[CountTable]:
    """True roof types down, those of the models across."""
    counts = {(row["true_type"], row["model_type"]): int(row["buildings"]) for row in table.to_pylist()}
    true_types = _in_order_of_types({pair[0] for pair in counts})
    model_types = _in_order_of_types({pair[1] for pair in counts})
    rows = tuple((kind, *(_count(counts.get((kind, other), 0)) for other in model_types)) for kind in true_types)
    names = tuple("not found" if kind == RoofType.NONE else kind for kind in model_types)
    return [CountTable(title="Roof types: true down, modelled across", header=("true type", *names), rows=rows)]


def _topology(table: pa.Table) -> list[CountTable]:
    rows = tuple(
        (row["relation"], *(_count(row[name]) for name in ("components", "true_faces", "model_faces")))
        for row in table.to_pylist()
    )
    header = ("true to modelled", "cases", "true faces", "model faces")
    return [CountTable(title="Which faces lie on which", header=header, rows=rows)]


def _validity_codes(table: pa.Table) -> list[CountTable]:
    rows = tuple((str(row["code"]), _count(row["solids"])) for row in table.to_pylist())
    return [CountTable(title="Faults of solids by ISO 19107 code", header=("code", "solids"), rows=rows)]


def _ground(table: pa.Table) -> list[CountTable]:
    shares = ("type_1", "type_2", "total", "kappa")
    rows = tuple(
        (str(row["tile"]), *(_percent(row[name]) for name in shares), _count(row["ground"]), _count(row["object"]))
        for row in table.to_pylist()
    )
    header = ("tile", "type I", "type II", "total", "kappa", "ground points", "object points")
    return [CountTable(title="Ground filter by tile", header=header, rows=rows)]


def _wireframes(table: pa.Table) -> list[CountTable]:
    """One table of edges and one of corners, at 0.5 m; the worst buildings first."""
    title = "by building at 0.5 m, the worst first"
    if table.num_rows > MAX_WIREFRAMES:
        title += f": {MAX_WIREFRAMES} of {table.num_rows:,}"
    printed = []
    for kind, amount, sign in (("edge", "edges_m", " (m)"), ("corner", "corners", "")):
        worst = sorted(table.to_pylist(), key=lambda row: row[f"{kind}_f1_0_5m"] or 0.0)[:MAX_WIREFRAMES]
        rows = tuple(
            (
                str(row["building_id"]),
                *(_count(row[f"{side}_{amount}"]) for side in ("true", "model")),
                *(_percent(row[f"{kind}_{share}_0_5m"]) for share in ("recall", "precision", "f1")),
            )
            for row in worst
        )
        header = ("building", f"true{sign}", f"models{sign}", "recall", "precision", "F1")
        printed.append(CountTable(title=f"{kind.capitalize()}s {title}", header=header, rows=rows))
    return printed


def breakdowns(tables: Tables) -> tuple[CountTable, ...]:
    """Losses of buildings by shape, defect and size, without edge buildings; empty without a table of buildings.

    Columns whose measure was not possible are left out.
    """
    table = tables.get("buildings")
    if table is None or table.num_rows == 0:
        return ()
    if "touches_data_edge" in table.column_names:
        table = table.filter(pa.array(~flags(table, "touches_data_edge")))
    ratios = _ratios(table)
    if not ratios or not table.num_rows:
        return ()
    made = []
    for title, first, classes in _classes(table):
        if len(classes) < 2:
            continue
        rows = tuple(
            (
                name,
                _count(chosen.sum()),
                *(_share(part[chosen].sum(), whole[chosen].sum()) for _, part, whole in ratios),
            )
            for name, chosen in classes
        )
        made.append(CountTable(title=title, header=(first, "buildings", *(name for name, _, _ in ratios)), rows=rows))
    return tuple(made)


def _classes(table: pa.Table) -> list[tuple[str, str, list[tuple[str, BoolArray]]]]:
    """Title, first header, and the classes with their masks."""
    found = []
    for name, title in (("shape", "By shape"), ("true_type", "By roof type")):
        if name in table.column_names and table[name].null_count < table.num_rows:
            values = np.array([str(value) for value in table[name].to_pylist()])
            found.append((title, title[3:], [(kind, values == kind) for kind in sorted(set(values))]))
            break
    if "defects" in table.column_names:
        defects = [set(value or ()) for value in table["defects"].to_pylist()]
        names = sorted(set().union(*defects)) if defects else []
        classes = [("none", np.array([not held for held in defects], bool))]
        classes += [(name, np.array([name in held for held in defects], bool)) for name in names]
        found.append(("By what makes them hard (a building may have several)", "defect", classes))
    if "footprint_area_m2" in table.column_names:
        area = floats(table, "footprint_area_m2")
        classes = [
            (f"{low:g} to {high:g}" if math.isfinite(high) else f"over {low:g}", (area >= low) & (area < high))
            for low, high in itertools.pairwise(AREA_CLASSES_M2)
        ]
        found.append(("By footprint", "m²", [(name, chosen) for name, chosen in classes if chosen.any()]))
    return found


def _ratios(table: pa.Table) -> list[tuple[str, FloatArray, FloatArray]]:
    """Names, numerators and denominators (one per building) of the shares that the table allows."""
    names = set(table.column_names)
    ratios: list[tuple[str, FloatArray, FloatArray]] = []
    if "model_id" in names:
        found = table["model_id"].is_valid().to_numpy(zero_copy_only=False)
        ratios.append(("found", found.astype(np.float64), np.ones(table.num_rows)))
    if "outcome" in names:
        outcome = np.array([str(value) for value in table["outcome"].to_pylist()])
        judged = np.isin(outcome, OUTCOMES).astype(np.float64)
        ratios += [(wanted, (outcome == wanted).astype(np.float64), judged) for wanted in OUTCOMES]
    for label, part, whole in (
        ("faces found", "faces_found", "faces_to_find"),
        ("points within 0.2 m", "n_within", "n_points"),
        ("top points within 0.2 m", "top_n_within", "top_n_points"),
    ):
        if {part, whole} <= names:
            ratios.append((label, np.nan_to_num(floats(table, part)), np.nan_to_num(floats(table, whole))))
    if {"surface_within", "footprint_area_m2"} <= names:
        within, area = floats(table, "surface_within"), floats(table, "footprint_area_m2")
        area = np.where(np.isfinite(within), area, 0.0)
        ratios.append(("roof within 0.2 m", np.nan_to_num(within) * area, area))
    return ratios


def floats(table: pa.Table, name: str) -> FloatArray:
    """A column as float64, nan where null."""
    return np.array(table[name].cast(pa.float64()).to_numpy(zero_copy_only=False), np.float64)


def flags(table: pa.Table, name: str) -> BoolArray:
    """A column as bool, False where null."""
    return np.array([bool(value) for value in table[name].to_pylist()], bool)


def visible_share(table: pa.Table) -> FloatArray | None:
    """Share of each building's top-visible points within 0.2 m, nan without any; of all points in older tables.

    None if the table has no points.
    """
    for prefix in ("top_", ""):
        if {f"{prefix}n_points", f"{prefix}n_within"} <= set(table.column_names):
            n_points, n_within = floats(table, f"{prefix}n_points"), floats(table, f"{prefix}n_within")
            shares = np.full(table.num_rows, np.nan)
            np.divide(n_within, n_points, out=shares, where=n_points > 0.0)
            return shares
    return None


def _count(value: Any) -> str:
    return f"{int(value):,}"


def _percent(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{100.0 * value:.2f} %"


def _share(part: float, whole: float) -> str:
    return f"{100.0 * part / whole:.1f} %" if whole > 0.0 else "-"
