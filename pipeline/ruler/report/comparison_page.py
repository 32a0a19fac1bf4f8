"""A comparison as one HTML file and as Markdown."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

from pipeline.model import RoofType, Status
from pipeline.report.page_template import page_template
from pipeline.report.palette import ROOF_COLOURS
from pipeline.report.pictures import data_uri
from pipeline.ruler.evaluation.chapters import NOTHING
from pipeline.ruler.evaluation.counted_models import OUTCOMES
from pipeline.ruler.evaluation.evaluation_writing import INTERVALS, all_notes
from pipeline.ruler.evaluation.markdown import markdown_cell, markdown_table
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
from pipeline.ruler.report.comparison_records import ComparedBuilding, ComparedRun, Record, reference_of
from pipeline.ruler.report.model_pictures import TRUTH_COLOUR
from pipeline.ruler.report.section import RESIDUAL_CLASSES
from pipeline.runtime.manifest import RunManifest, RunStatus

MAX_ROWS = 500
"""Buildings in the page's table."""
_SETTINGS_DIGITS = 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """The content of a page."""

    runs: tuple[ComparedRun, ...]
    manifests: tuple[RunManifest, ...]
    buildings: tuple[ComparedBuilding, ...]
    left_out: int
    tables: tuple[FigureTable, ...]
    cases: tuple[tuple[Choice, BuildingPictures], ...]
    has_points: bool

    @property
    def labels(self) -> list[str]:
        """Labels of the runs."""
        return [run.label for run in self.runs]

    @property
    def title(self) -> str:
        """Title of the page."""
        *others, last = self.labels
        return f"{', '.join(others)} and {last}" if others else last

    @property
    def subject(self) -> str:
        """The subject, in a sentence."""
        noun = "building" if len(self.buildings) == 1 else "buildings"
        files = list(dict.fromkeys(file.path.rsplit("/", 1)[-1] for file in self.manifests[0].inputs))
        names = ", ".join(files[:4]) + (f" and {len(files) - 4} more files" if len(files) > 4 else "")
        return f"{len(self.buildings):,} {noun}" + (f" of {names}" if names else "")

    @property
    def records(self) -> list[Record]:
        """All records of all buildings."""
        return [record for one in self.buildings for record in one.records]

    @property
    def intervals(self) -> str:
        """Explanation of the intervals; empty without evaluations."""
        return INTERVALS if any(run.evaluation is not None for run in self.runs) else ""


def page(comparison: Comparison) -> str:
    """The page as text: styles, pictures and the one script, which sorts a table, are in it."""
    ordered = most_different_first(comparison.buildings)[:MAX_ROWS]
    columns = ["status", "roof", "planes", "RMSE, m", "time, s"]
    if any(record["outcome"] is not None for record in comparison.records):
        columns.append("outcome")
    drawn = [record for choice, _ in comparison.cases for record in choice.building.records]
    kinds = {record["roof_type"] for record in drawn if record["is_model"]}
    return page_template("comparison.html", "pipeline.ruler.report").render(
        title=comparison.title,
        subject=comparison.subject,
        labels=comparison.labels,
        notes=_notes(comparison),
        stacks=_stacks(comparison),
        tables=comparison.tables,
        rule=RULE,
        cases=[_case(comparison, *case) for case in comparison.cases],
        rows=[_row(one, columns) for one in ordered],
        columns=columns,
        n_buildings=len(comparison.buildings),
        made=_made(comparison),
        intervals=comparison.intervals,
        residuals=RESIDUAL_CLASSES if comparison.has_points else (),
        roofs=[(kind.value, ROOF_COLOURS[kind]) for kind in RoofType if kind.value in kinds],
        truth_colour=TRUTH_COLOUR,
        block_colour=BLOCK_COLOUR,
        low_colour=LOW_COLOUR,
        ramp=", ".join(HEIGHT_COLOURS),
        low_m=LOW_M,
        reach_m=REACH_M,
        has_points=comparison.has_points,
        has_truth=any(pictures.truth for _, pictures in comparison.cases),
        has_outlines=any(choice.building.true_id for choice, _ in comparison.cases),
    )


def _notes(comparison: Comparison) -> list[str]:
    notes = []
    for run, manifest in zip(comparison.runs, comparison.manifests, strict=True):
        if manifest.failed_tiles:
            count = len(manifest.failed_tiles)
            notes.append(f"{run.label}: {count:,} {'tile' if count == 1 else 'tiles'} failed.")
        elif manifest.status is not RunStatus.FINISHED:
            notes.append(f"{run.label}: the run is {manifest.status.value}; not all of its buildings may be there.")
    if comparison.left_out:
        rest = ", except from the evaluations of the runs" if comparison.intervals else ""
        notes.append(f"{comparison.left_out:,} buildings that not all runs have are left out below{rest}.")
    if not comparison.has_points:
        notes.append("No points were available: the pictures show models alone.")
    known = [all_notes(run.evaluation) for run in comparison.runs if run.evaluation is not None]
    notes += [note for note in (known[0] if known else ()) if all(note in one for one in known)]
    return list(dict.fromkeys(notes))


def _stacks(comparison: Comparison) -> list[dict[str, Any]]:
    """Bars of statuses and of judged outcomes: title, and one row per run of (name, count, share)."""
    stacks = [_stack(comparison, "Candidates", "status", list(Status))]
    outcomes = _stack(comparison, "Against the truth, of the candidates with a true building", "outcome", OUTCOMES)
    return stacks + [outcomes] * any(row["parts"] for row in outcomes["rows"])


def _stack(comparison: Comparison, title: str, column: str, names: Sequence[str]) -> dict[str, Any]:
    rows = []
    for place, label in enumerate(comparison.labels):
        counts = Counter(one.records[place][column] for one in comparison.buildings)
        held = [(str(name), counts[name]) for name in names if counts[name]]
        total = sum(count for _, count in held)
        counted = ", ".join(f"{name} {count:,}" for name, count in held) or "none"
        parts = [(name, count, count / total) for name, count in held]
        rows.append({"label": label, "parts": parts, "description": f"{label}: {counted}"})
    return {"title": title, "names": list(map(str, names)), "rows": rows}


def _case(comparison: Comparison, choice: Choice, pictures: BuildingPictures) -> dict[str, Any]:
    """One row of pictures."""
    building = choice.building
    name, records = building.building_id, building.records
    views = [
        {
            "label": label,
            "uri": None if png is None else data_uri(png),
            "alt": f"{name} by {label}: {_summary(record)}.",
            "status": record["status"],
            "reason": record["reason"],
            "detail": record["reason_detail"],
            "outcome": record["outcome"],
            "figures": _figures(record),
        }
        for label, record, png in zip(comparison.labels, records, pictures.views, strict=True)
    ]
    judged = next((record for record in records if record["true_type"] is not None), records[0])
    return {
        "name": name,
        "why": choice.why,
        "pictures": pictures,
        "plan": None if pictures.plan is None else data_uri(pictures.plan),
        "views": views,
        "truth": None if pictures.truth is None else data_uri(pictures.truth),
        "true_id": building.true_id,
        "true_type": judged["true_type"],
        "true_faces": judged["faces_to_find"],
        "area": next((figure(one["footprint_area_m2"], "m2", 0) for one in records if one["lod"]), NOTHING),
    }


def _summary(record: Record) -> str:
    """A record in a few words."""
    reason = record["reason"]
    kinds = {
        Status.OK: "model",
        Status.DOUBTFUL: f"doubtful model, {reason}",
        Status.FALLBACK: f"block in place of a model, {reason}",
    }
    if record["status"] == Status.FAILED:
        return f"failed, {reason}"
    planes = f"{record['n_planes']} {'plane' if record['n_planes'] == 1 else 'planes'}"
    rmse = figure(record["rmse_m"], "m", 3)
    return f"{kinds[Status(record['status'])]}, {record['roof_type']} roof, {planes}, RMSE {rmse}"


def _figures(record: Record) -> list[tuple[str, str]]:
    """The caption of a picture."""
    is_there = record["status"] != Status.FAILED
    figures = []
    if is_there:
        figures += [("roof", record["roof_type"]), ("planes", f"{record['n_planes']}")]
        figures += [("RMSE", figure(record["rmse_m"], "m", 3)), ("covered", figure(record["coverage"], "share", 1))]
    if record["seconds"] is not None:
        figures.append(("time", seconds_text(record["seconds"])))
    if record["faces_found"] is not None:
        figures.append(("faces found", f"{record['faces_found']} of {record['faces_to_find']}"))
        figures.append(("wrong faces", f"{record['faces_wrong'] or 0}"))
    if record["iou"] and is_there:
        figures.append(("footprint IoU", f"{record['iou']:.2f}"))
    return figures


def _row(building: ComparedBuilding, columns: Sequence[str]) -> dict[str, Any]:
    """One row of the table of buildings: texts with their sort values."""
    cells = []
    for record in building.records:
        status = record["status"] + (f": {record['reason']}" if record["reason"] else "")
        cells += [(status, status), (record["roof_type"],) * 2, (str(record["n_planes"]), record["n_planes"])]
        cells += [_number(record["rmse_m"], 3), _number(record["seconds"], 3)]
        if "outcome" in columns:
            cells.append((record["outcome"] or NOTHING, record["outcome"] or ""))
    area = next((one["footprint_area_m2"] for one in building.records if one["footprint_area_m2"] is not None), None)
    own = [_number(area, 0), _number(building.total, 2)]
    return {"name": building.building_id, "own": own, "cells": cells}


def _number(value: float | None, decimals: int) -> tuple[str, Any]:
    return (NOTHING, "") if value is None else (f"{value:.{decimals}f}", round(value, 6))


def _made(comparison: Comparison) -> dict[str, Any]:
    """Inputs, settings, digests and versions."""
    first = comparison.manifests[0]
    rows = [
        (
            run.label,
            run.method,
            run.preset,
            manifest.settings_hash[:_SETTINGS_DIGITS],
            (manifest.content_sha256 or NOTHING)[:_SETTINGS_DIGITS],
            manifest.engine_version,
        )
        for run, manifest in zip(comparison.runs, comparison.manifests, strict=True)
    ]
    facts = [("reference system", str((first.crs or {}).get("name") or "unknown"))]
    if first.source_licence:
        facts.append(("licence of the data", first.source_licence))
    reference = reference_of(comparison.runs)
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
    parts.append("\n".join(f"- {markdown_cell(note)}" for note in _notes(comparison)))
    for table in comparison.tables:
        rows = [(name, *(f"{c.text} ({c.note})" if c.note else c.text for c in cells)) for name, cells in table.rows]
        text = markdown_table((table.first, *comparison.labels), rows)
        parts.append(f"## {markdown_cell(table.title)}\n\n{text}")
    parts.append(comparison.intervals)
    header = ("building", "chosen for", *comparison.labels)
    rows = [
        (choice.building.building_id, choice.why, *(_brief(record) for record in choice.building.records))
        for choice, _ in comparison.cases
    ]
    if rows:
        parts.append(f"## Buildings side by side\n\n{RULE}\n\n{markdown_table(header, rows, texts=len(header))}")
    made = _made(comparison)
    parts.append(f"## How it was made\n\n{markdown_table(made['header'], made['rows'], texts=6)}")
    parts.append("\n".join(f"- {name}: {markdown_cell(text)}" for name, text in made["facts"]))
    if made["inputs"]:
        parts.append(markdown_table(("input", "bytes", "points", "sha256"), made["inputs"]))
    return "\n\n".join(part for part in parts if part) + "\n"


def _brief(record: Record) -> str:
    """A record in a cell."""
    return f"{_summary(record)}, {record['outcome']}" if record["outcome"] else _summary(record)
