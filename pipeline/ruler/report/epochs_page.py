"""A comparison of two epochs as one HTML file: sums, a map, pictures of the largest changes, a table to filter."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import shapely

from pipeline.io.storage import LocalStorage
from pipeline.report.class_map import MAX_DRAWN, ClassMap
from pipeline.report.page_template import page_template
from pipeline.report.pictures import data_uri
from pipeline.ruler.epochs.change_records import CHANGES, DOUBTS, INCOMPARABLE, Change, Doubt, Incomparable
from pipeline.ruler.epochs.change_summary import HEIGHT_EDGES_M, LARGEST
from pipeline.ruler.epochs.change_writing import PARQUET
from pipeline.ruler.epochs.diff import Diff
from pipeline.ruler.epochs.epoch import Epoch
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.evaluation.chapters import NOTHING as _NOTHING
from pipeline.ruler.report.epochs_map import COLOURS
from pipeline.ruler.report.epochs_pictures import NEW_LINE, OLD_LINE, SIZE_PX, Case, cases
from pipeline.ruler.report.svg_chart import Axis, Ordinate, histogram_svg

PAGE = "changes.html"
"""The file."""
_DIGITS = 12

_CELLS: tuple[tuple[str, str, int, bool], ...] = (
    ("height, m", "height_change_m", 2, True),
    ("up, m", "max_raise_m", 2, False),
    ("down, m", "max_drop_m", 2, False),
    ("area, m²", "area_change_m2", 0, True),
    ("gained, m³", "gained_m3", 0, False),
    ("lost, m³", "lost_m3", 0, False),
    ("IoU", "iou", 2, False),
    ("ratio", "change_ratio", 1, False),
)
"""Columns of the table: header, column, decimals, whether the sign is shown."""


def write_page(diff: Diff, rows: ClassMap) -> Path:
    """Write `changes.html` with its images and styles; `rows` is the map, filled while the rows were written."""
    storage = LocalStorage(root=Path(diff.request.out))
    storage.put(PAGE, page(diff, rows).encode())
    return storage.path(PAGE)


def page(diff: Diff, rows: ClassMap) -> str:
    """The page as text."""
    facts = diff.as_dict()
    drawn = rows.map(diff.new.reference.horizontal_unit_m)
    largest = diff.summary.largest
    pictures = cases(largest, diff.old, diff.new)
    listed = [_row(row) for row in largest.to_pylist()]
    changed = sum(one["rows"] for name, one in facts["changes"].items() if name != Change.UNCHANGED.value)
    return page_template("epochs.html", "pipeline.ruler.report").render(
        title=" to ".join(_names_of(diff.old.run_dir, diff.new.run_dir)),
        subject=_subject(diff),
        warnings=diff.warnings,
        cards=[(name, facts["changes"][name.value], COLOURS[name], CHANGES[name]) for name in Change],
        level=facts["level"],
        map=None if drawn is None else {"uri": data_uri(drawn.png), "it": drawn},
        left_out=rows.left_out,
        max_drawn=MAX_DRAWN,
        chart=_chart(diff),
        reasons=[(INCOMPARABLE[Incomparable(name)], count) for name, count in facts["reasons"].items()],
        doubts=[(DOUBTS[Doubt(name)], count) for name, count in facts["doubts"].items()],
        cases=[_case(case) for case in pictures],
        size=SIZE_PX,
        lines=(OLD_LINE, NEW_LINE),
        columns=[header for header, *_ in _CELLS],
        rows=listed,
        changed=changed,
        most=LARGEST,
        parquet=PARQUET,
        colours={name.value: colour for name, colour in COLOURS.items()},
        settings=_settings(diff.request.settings),
        runs=[_run_row(diff.old), _run_row(diff.new)],
    )


def _names_of(old: str, new: str) -> tuple[str, str]:
    """The last differing parts of two paths.

    >>> _names_of("surveys/2019/run", "surveys/2024/run"), _names_of("a/old", "b/new")
    (('2019', '2024'), ('old', 'new'))
    """
    before, after = (list(PurePath(path).parts) for path in (old, new))
    while len(before) > 1 and len(after) > 1 and before[-1] == after[-1]:
        before.pop()
        after.pop()
    return before[-1] if before else old, after[-1] if after else new


def _subject(diff: Diff) -> str:
    """The subject, in a sentence."""
    times = diff.summary.acquired
    sides = [f"OLD is {diff.old.run_dir}", f"NEW is {diff.new.run_dir}"]
    for place, name in enumerate(("old_acquired", "new_acquired")):
        if name in times:
            sides[place] += f" (acquired {'until' if place == 0 else 'from'} {times[name]:%Y-%m-%d})"
    return f"{sides[0]}, {len(diff.old):,} candidates; {sides[1]}, {len(diff.new):,} candidates."


def _chart(diff: Diff) -> Any:
    """Histogram of rises and drops of roofs; None without any."""
    counts = diff.summary.heights.astype(np.float64)
    if not counts.any():
        return None
    return histogram_svg(
        np.array(HEIGHT_EDGES_M),
        counts,
        x=Axis(name="largest rise or drop, m", text=lambda value: f"{value:+g}" if value else "0"),
        y=Axis(name="changed buildings", text=lambda value: f"{value:,.0f}"),
        ordinate=Ordinate(low=0.0, high=max(1.0, float(counts.max())) * 1.05, log=False),
        description=f"Histogram of the largest rise or drop of {counts.sum():,.0f} changed buildings.",
    )


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    """One row of the table: texts with their sort values."""
    cells = []
    for _, column, decimals, signed in _CELLS:
        value = row[column]
        text = _NOTHING if value is None else f"{value:+,.{decimals}f}" if signed else f"{value:,.{decimals}f}"
        cells.append((text, "" if value is None else value))
    place = None if row["geometry"] is None else shapely.point_on_surface(shapely.from_wkb(row["geometry"]))
    return {
        "id": row["change_id"],
        "change": row["change"],
        "flags": [name.removeprefix("is_") for name in _other_flags(row)],
        "doubts": row["doubts"],
        "words": ", ".join(word for word in (row["reason"], *row["doubts"]) if word).replace("_", " "),
        "roofs": _roofs(row),
        "place": "" if place is None else f"{place.x:.0f} {place.y:.0f}",
        "size": (row["gained_m3"] or 0.0) + (row["lost_m3"] or 0.0),
        "names": _names(row),
        "cells": cells,
    }


def _other_flags(row: Mapping[str, Any]) -> list[str]:
    """Further changes of a row besides its class."""
    return [name for name in ("is_raised", "is_lowered", "is_reshaped") if row[name] and name != f"is_{row['change']}"]


def _roofs(row: Mapping[str, Any]) -> str:
    before, after = row["old_roof_type"], row["new_roof_type"]
    return before or after or _NOTHING if before == after or not (before and after) else f"{before} → {after}"


def _names(row: Mapping[str, Any]) -> str:
    """All names on both sides, those of given footprints first."""
    parts = []
    for which in ("old", "new"):
        own = [name for name in row[f"{which}_source_ids"] if name is not None]
        if row[f"{which}_ids"]:
            parts.append(f"{which.upper()}: {', '.join([*own, *row[f'{which}_ids']])}")
    return "; ".join(parts)


def _case(case: Case) -> dict[str, Any]:
    return _row(case.row) | {
        "plan": data_uri(case.plan),
        "scale_m": case.scale_m,
        "scale_share": case.scale_share,
        "old": None if case.old is None else data_uri(case.old),
        "new": None if case.new is None else data_uri(case.new),
        "figures": _figures(case.row),
        "was": _side(case.row, "old"),
        "becomes": _side(case.row, "new"),
    }


def _side(row: Mapping[str, Any], which: str) -> str:
    """A building in one epoch, in a few words."""
    height, area, roof = (row[f"{which}_{name}"] for name in ("height_m", "area_m2", "roof_type"))
    if area is None:
        return "nothing"
    return f"{roof} roof, {_figure(height, 1)} m high, {_figure(area, 0)} m²"


def _figure(value: float | None, decimals: int) -> str:
    return _NOTHING if value is None else f"{value:,.{decimals}f}"


def _figures(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures beside the pictures of a change."""
    parts: Sequence[tuple[str, str, str, int]] = (
        ("gained", "gained_m3", "m³", 0),
        ("lost", "lost_m3", "m³", 0),
        ("added", "added_m2", "m²", 0),
        ("removed", "removed_m2", "m²", 0),
        ("higher", "raised_m2", "m²", 0),
        ("lower", "lowered_m2", "m²", 0),
    )
    figures = [(label, f"{row[name]:,.{digits}f} {unit}") for label, name, unit, digits in parts if row[name]]
    if row["height_change_m"] is not None:
        figures.append(("median height", f"{row['height_change_m']:+.2f} m"))
    return figures


def _settings(settings: DiffSettings) -> list[tuple[str, str, str]]:
    """The thresholds with their values and meanings."""
    return [
        (field.name, f"{getattr(settings, field.name):g} {field.metadata['unit']}".rstrip(), field.metadata["doc"])
        for field in dataclasses.fields(settings)
    ]


def _run_row(epoch: Epoch) -> tuple[str, ...]:
    """A row of the table of runs."""
    manifest = epoch.manifest
    return (
        epoch.name,
        epoch.run_dir,
        manifest.method,
        manifest.settings_hash[:_DIGITS],
        (manifest.content_sha256 or _NOTHING)[:_DIGITS],
        manifest.engine_version,
        epoch.reference.name,
    )
