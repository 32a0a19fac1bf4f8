"""A comparison as one HTML file and as Markdown."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pipeline.model import RoofType, Status
from pipeline.report.page_template import page_template
from pipeline.report.pictures import data_uri
from pipeline.report.render import ROOF_COLOURS
from pipeline.ruler.evaluation.chapters import NOTHING
from pipeline.ruler.evaluation.counts import OUTCOMES
from pipeline.ruler.evaluation.markdown import markdown_cell, markdown_table
from pipeline.ruler.evaluation.writing import INTERVALS, all_notes
from pipeline.ruler.report.comparison_building import ComparedBuilding, ComparedRun, Record
from pipeline.ruler.report.comparison_choice import RULE, Choice, most_different_first
from pipeline.ruler.report.comparison_figures import FigureTable, figure, seconds_text
from pipeline.ruler.report.comparison_pictures import (
    BLOCK_COLOUR,
    HEIGHT_COLOURS,
    LOW_COLOUR,
    LOW_M,
    REACH_M,
    BuildingPictures,
)
from pipeline.ruler.report.section import RESIDUAL_CLASSES
from pipeline.ruler.report.worst_cases import TRUTH_COLOUR
from pipeline.runtime.manifest import RunManifest, RunStatus

MAX_ROWS = 500
"""Buildings in the page's table."""
_SETTINGS_DIGITS = 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparisonCase:
    """A building with its pictures."""

    choice: Choice
    """The building, and the reason."""
    pictures: BuildingPictures
    """Pictures of all runs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """The content of a page."""

    runs: tuple[ComparedRun, ...]
    """In the order of the columns."""
    manifests: tuple[RunManifest, ...]
    """Manifests of the runs."""
    buildings: tuple[ComparedBuilding, ...]
    """Buildings that all runs have, by building_id."""
    left_out: int
    """Buildings that a run with failed tiles lacks."""
    tables: tuple[FigureTable, ...]
    """Figures side by side."""
    cases: tuple[ComparisonCase, ...]
    """The buildings that are drawn."""
    has_points: bool
    """Whether points were available."""

    @property
    def title(self) -> str:
        """Title of the page."""
        *others, last = (run.label for run in self.runs)
        return f"{', '.join(others)} and {last}" if others else last

    @property
    def subject(self) -> str:
        """The subject, in a sentence."""
        noun = "building" if len(self.buildings) == 1 else "buildings"
        files = list(dict.fromkeys(file.path.rsplit("/", 1)[-1] for file in self.manifests[0].inputs))
        names = ", ".join(files[:4]) + (f" and {len(files) - 4} more files" if len(files) > 4 else "")
        return f"{len(self.buildings):,} {noun}" + (f" of {names}" if names else "")


def page(comparison: Comparison) -> str:
    """The page as text: styles, pictures and the one script, which sorts a table, are in it."""
    ordered = most_different_first(comparison.buildings)[:MAX_ROWS]
    has_outcomes = any(record.outcome is not None for one in comparison.buildings for record in one.records)
    kinds = {
        record.roof_type for case in comparison.cases for record in case.choice.building.records if record.is_model
    }
    return page_template("comparison.html", "pipeline.ruler.report").render(
        title=comparison.title,
        subject=comparison.subject,
        labels=[run.label for run in comparison.runs],
        notes=_notes(comparison),
        stacks=_stacks(comparison),
        tables=comparison.tables,
        rule=RULE,
        cases=[_case(comparison, case) for case in comparison.cases],
        rows=[_row(one, has_outcomes) for one in ordered],
        columns=_columns(has_outcomes),
        n_buildings=len(comparison.buildings),
        made=_made(comparison),
        intervals=INTERVALS if _has_intervals(comparison) else "",
        residuals=RESIDUAL_CLASSES if comparison.has_points else (),
        roofs=[(kind.value, ROOF_COLOURS[kind]) for kind in RoofType if kind.value in kinds],
        truth_colour=TRUTH_COLOUR,
        block_colour=BLOCK_COLOUR,
        low_colour=LOW_COLOUR,
        ramp=", ".join(HEIGHT_COLOURS),
        low_m=LOW_M,
        reach_m=REACH_M,
        has_points=comparison.has_points,
        has_truth=any(case.pictures.truth for case in comparison.cases),
        has_outlines=any(case.choice.building.true_id for case in comparison.cases),
    )


def _has_intervals(comparison: Comparison) -> bool:
    return any(run.evaluation is not None for run in comparison.runs)


def _notes(comparison: Comparison) -> list[str]:
    notes = []
    for run, manifest in zip(comparison.runs, comparison.manifests, strict=True):
        if manifest.failed_tiles:
            count = len(manifest.failed_tiles)
            notes.append(f"{run.label}: {count:,} {'tile' if count == 1 else 'tiles'} failed.")
        elif manifest.status is not RunStatus.FINISHED:
            notes.append(f"{run.label}: the run is {manifest.status.value}; not all of its buildings may be there.")
    if comparison.left_out:
        rest = ", except from the evaluations of the runs" if _has_intervals(comparison) else ""
        notes.append(f"{comparison.left_out:,} buildings that not all runs have are left out below{rest}.")
    if not comparison.has_points:
        notes.append("No points were available: the pictures show models alone.")
    evaluations = [run.evaluation for run in comparison.runs if run.evaluation is not None]
    known = [set(all_notes(evaluation)) for evaluation in evaluations]
    if known:
        notes += [note for note in all_notes(evaluations[0]) if all(note in one for one in known)]
    return list(dict.fromkeys(notes))


def _stacks(comparison: Comparison) -> list[dict[str, Any]]:
    """Bars of statuses and of judged outcomes: title, and one row per run of (name, count, share)."""
    stacks = [_stack("Candidates", _counts(comparison, list(Status), lambda record: record.status), comparison)]
    outcomes = _counts(comparison, OUTCOMES, lambda record: record.outcome)
    if any(sum(counts) for _, counts in outcomes):
        stacks.append(_stack("Against the truth, of the candidates with a true building", outcomes, comparison))
    return stacks


def _counts(
    comparison: Comparison, names: Sequence[str], of: Callable[[Record], str | None]
) -> list[tuple[str, list[int]]]:
    """Number of records per run, one row per name."""
    found = [Counter(of(one.records[i]) for one in comparison.buildings) for i in range(len(comparison.runs))]
    return [(str(name), [counts[name] for counts in found]) for name in names]


def _stack(title: str, parts: Sequence[tuple[str, Sequence[int]]], comparison: Comparison) -> dict[str, Any]:
    rows = []
    for place, run in enumerate(comparison.runs):
        total = sum(counts[place] for _, counts in parts)
        held = [(name, counts[place], counts[place] / total) for name, counts in parts if counts[place]]
        counted = ", ".join(f"{name} {count:,}" for name, count, _ in held)
        rows.append({"label": run.label, "parts": held, "description": f"{run.label}: {counted or 'none'}"})
    return {"title": title, "names": [name for name, _ in parts], "rows": rows}


def _case(comparison: Comparison, case: ComparisonCase) -> dict[str, Any]:
    """One row of pictures."""
    building, pictures = case.choice.building, case.pictures
    name = building.building_id
    views = []
    for run, record, png in zip(comparison.runs, building.records, pictures.views, strict=True):
        views.append(
            {
                "label": run.label,
                "uri": None if png is None else data_uri(png),
                "alt": f"{name} by {run.label}: {_summary(record)}.",
                "status": record.status.value,
                "reason": record.reason,
                "detail": record.reason_detail,
                "outcome": record.outcome,
                "figures": _figures(record),
            }
        )
    truth = next((dict(record.truth) for record in building.records if record.truth), {})
    return {
        "name": name,
        "why": case.choice.why,
        "pictures": pictures,
        "plan": None if pictures.plan is None else data_uri(pictures.plan),
        "views": views,
        "truth": None if pictures.truth is None else data_uri(pictures.truth),
        "true_id": building.true_id,
        "true_type": truth.get("true_type"),
        "true_faces": truth.get("faces_to_find"),
        "area": next((figure(r.footprint_area_m2, "m2", 0) for r in building.records if r.lod), NOTHING),
    }


def _summary(record: Record) -> str:
    """A record in a few words."""
    if record.status is Status.FAILED:
        return f"failed, {record.reason}"
    kind = "model" if record.is_model else f"block in place of a model, {record.reason}"
    if record.status is Status.DOUBTFUL:
        kind = f"doubtful model, {record.reason}"
    planes = f"{record.n_planes} {'plane' if record.n_planes == 1 else 'planes'}"
    return f"{kind}, {record.roof_type} roof, {planes}, RMSE {figure(record.rmse_m, 'm', 3)}"


def _figures(record: Record) -> list[tuple[str, str]]:
    """The caption of a picture."""
    figures = []
    if record.status is not Status.FAILED:
        figures += [("roof", record.roof_type), ("planes", f"{record.n_planes}")]
        figures += [("RMSE", figure(record.rmse_m, "m", 3)), ("covered", figure(record.coverage, "share", 1))]
    if math.isfinite(record.seconds):
        figures.append(("time", seconds_text(record.seconds)))
    found = record.truth.get("faces_found")
    if found is not None:
        figures.append(("faces found", f"{found} of {record.truth.get('faces_to_find')}"))
        figures.append(("wrong faces", f"{record.truth.get('faces_wrong') or 0}"))
    if record.truth.get("iou") and record.status is not Status.FAILED:
        figures.append(("footprint IoU", f"{record.truth['iou']:.2f}"))
    return figures


def _columns(has_outcomes: bool) -> list[str]:
    return ["status", "roof", "planes", "RMSE, m", "time, s", *(["outcome"] if has_outcomes else [])]


def _row(building: ComparedBuilding, has_outcomes: bool) -> dict[str, Any]:
    """One row of the table of buildings: texts with their sort values."""
    cells = []
    for record in building.records:
        status = record.status.value + (f": {record.reason}" if record.reason else "")
        cells += [(status, status), (record.roof_type, record.roof_type), (str(record.n_planes), record.n_planes)]
        cells += [_number(record.rmse_m, 3), _number(record.seconds, 3)]
        if has_outcomes:
            cells.append((record.outcome or NOTHING, record.outcome or ""))
    area = next((r.footprint_area_m2 for r in building.records if math.isfinite(r.footprint_area_m2)), math.nan)
    own = [_number(area, 0), _number(building.difference.total, 2)]
    return {"name": building.building_id, "own": own, "cells": cells}


def _number(value: float, decimals: int) -> tuple[str, Any]:
    return (f"{value:.{decimals}f}", round(value, 6)) if math.isfinite(value) else (NOTHING, "")


def _made(comparison: Comparison) -> dict[str, Any]:
    """Inputs, settings, digests and versions."""
    first = comparison.manifests[0]
    rows = []
    for run, manifest in zip(comparison.runs, comparison.manifests, strict=True):
        rows.append(
            (
                run.label,
                run.method,
                run.preset,
                manifest.settings_hash[:_SETTINGS_DIGITS],
                (manifest.content_sha256 or NOTHING)[:_SETTINGS_DIGITS],
                manifest.engine_version,
            )
        )
    crs: Mapping[str, Any] = first.crs or {}
    facts = [("reference system", str(crs.get("name") or "unknown"))]
    if first.source_licence:
        facts.append(("licence of the data", first.source_licence))
    reference = next((r.evaluation.reference for r in comparison.runs if r.evaluation and r.evaluation.reference), None)
    if reference is not None:
        facts.append(("measured against", reference.name))
    return {
        "header": ("label", "method", "preset", "settings", "content", "version"),
        "rows": rows,
        "facts": facts,
        "inputs": [
            (file.path, f"{file.size_bytes:,}", NOTHING if file.n_points is None else f"{file.n_points:,}", file.sha256)
            for file in first.inputs
        ],
    }


def markdown(comparison: Comparison) -> str:
    """The figures and how they were made, as Markdown."""
    parts = [f"# Compared: {markdown_cell(comparison.title)}", f"{markdown_cell(comparison.subject)}."]
    notes = _notes(comparison)
    if notes:
        parts.append("\n".join(f"- {markdown_cell(note)}" for note in notes))
    for table in comparison.tables:
        rows = [(name, *(f"{c.text} ({c.note})" if c.note else c.text for c in cells)) for name, cells in table.rows]
        parts.append(f"## {markdown_cell(table.title)}\n\n{markdown_table((table.first, *table.labels), rows)}")
    if _has_intervals(comparison):
        parts.append(INTERVALS)
    header = ("building", "chosen for", *(run.label for run in comparison.runs))
    rows = [
        (c.choice.building.building_id, c.choice.why, *(_brief(record) for record in c.choice.building.records))
        for c in comparison.cases
    ]
    if rows:
        parts.append(f"## Buildings side by side\n\n{RULE}\n\n{markdown_table(header, rows, texts=len(header))}")
    made = _made(comparison)
    parts.append(f"## How it was made\n\n{markdown_table(made['header'], made['rows'], texts=6)}")
    parts.append("\n".join(f"- {name}: {markdown_cell(text)}" for name, text in made["facts"]))
    if made["inputs"]:
        parts.append(markdown_table(("input", "bytes", "points", "sha256"), made["inputs"]))
    return "\n\n".join(parts) + "\n"


def _brief(record: Record) -> str:
    """A record in a cell."""
    summary = _summary(record)
    return f"{summary}, {record.outcome}" if record.outcome else summary
