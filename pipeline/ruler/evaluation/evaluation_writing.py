"""An evaluation as files: one Parquet file per table, and `report.md` for people.

Every file is written under a temporary name and renamed: a reader sees the old file or the new one. Tables with a
`geometry` column are GeoParquet, which any GIS opens.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyproj
import shapely

from pipeline.export.geoparquet import geo_metadata, parquet_bytes
from pipeline.io.storage import LocalStorage
from pipeline.report.table import CountTable
from pipeline.ruler.evaluation.chapters import Chapter, chapters, definition_of
from pipeline.ruler.evaluation.counted_models import breakdowns
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.markdown import markdown_cell, markdown_table
from pipeline.ruler.evaluation.model_figures import TITLE, model_figures
from pipeline.ruler.evaluation.reading.wireframe_files import WireframeSet

MEASURES = "measures.parquet"
"""The file of all figures."""
REPORT = "report.md"
"""The file for people."""
INTERVALS = (
    "Intervals hold 95 % of 1,000 bootstrap resamples of whole buildings (rasters: blocks); where all of them agree on "
    "0 or 100 %, they are the exact binomial limits. A figure has no more digits than its interval supports."
)
"""Explanation of the intervals, for readers."""
_SCHEMA = pa.schema(
    [
        pa.field("name", pa.string(), nullable=False),
        pa.field("group", pa.string(), nullable=False),
        pa.field("label", pa.string(), nullable=False),
        pa.field("subset", pa.string(), nullable=False),
        pa.field("value", pa.float64()),
        pa.field("low", pa.float64()),
        pa.field("high", pa.float64()),
        pa.field("n", pa.int64(), nullable=False),
        pa.field("unit", pa.string(), nullable=False),
        pa.field("better", pa.string(), nullable=False),
    ]
)


def write_tables(evaluation: Evaluation, out_dir: str | Path) -> list[Path]:
    """Write `measures.parquet`, one Parquet file per table, and `report.md`; returns their paths in that order.

    Raises RunError if the folder cannot be made.
    """
    storage = LocalStorage(root=Path(out_dir))
    storage.put(MEASURES, parquet_bytes(measures_table(evaluation)))
    written = [MEASURES]
    crs = None if evaluation.reference is None else evaluation.reference.crs
    for name, table in evaluation.tables.items():
        storage.put(f"{name}.parquet", parquet_bytes(_with_geo(table, crs or evaluation.models.crs)))
        written.append(f"{name}.parquet")
    storage.put(REPORT, markdown(evaluation).encode())
    return [storage.path(key) for key in (*written, REPORT)]


def measures_table(evaluation: Evaluation) -> pa.Table:
    """All figures: name, group, label, subset, value, low, high, n, unit, better; null for nan."""
    rows = []
    for measure in evaluation.measures:
        definition = definition_of(measure.name)
        ends = {key: getattr(measure, key) for key in ("value", "low", "high")}
        rows.append(
            {key: value if math.isfinite(value) else None for key, value in ends.items()}
            | {"name": measure.name, "subset": measure.subset, "n": measure.n, "label": definition.label}
            | {"group": definition.group.value, "unit": definition.unit, "better": definition.better.value}
        )
    return pa.Table.from_pylist(rows, schema=_SCHEMA)


def _with_geo(table: pa.Table, crs: str | None) -> pa.Table:
    """The table, with the metadata of GeoParquet if it has geometries."""
    if "geometry" not in table.column_names:
        return table
    geometries = shapely.from_wkb(np.array(table["geometry"].to_pylist(), dtype=object))
    metadata = geo_metadata(geometries, _projjson(crs))
    del metadata["columns"]["geometry"]["covering"]
    geo = json.dumps(metadata, sort_keys=True, separators=(",", ":"))
    return table.replace_schema_metadata({**(table.schema.metadata or {}), "geo": geo})


def _projjson(crs: str | None) -> dict[str, object] | None:
    """The coordinate reference system of the geometries; None if unknown, or if its unit is not the metre."""
    if crs is None:
        return None
    try:
        parsed = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        return None
    if any(not math.isclose(axis.unit_conversion_factor, 1.0) for axis in parsed.axis_info):
        return None
    found: dict[str, object] = parsed.to_json_dict()
    return found


def subject_sentences(evaluation: Evaluation) -> tuple[str, str]:
    """The measured models and the reference, as two sentences."""
    models, reference = evaluation.models, evaluation.reference
    kinds = {"run": "a run", "cityjson": "CityJSON", "cityjsonseq": "CityJSONSeq", "obj": "OBJ"}
    measured = f"{models.name}: {_counted(len(models.models), 'model')} ({kinds[models.kind]})"
    if models.failed:
        measured += f", {_counted(len(models.failed), 'record')} without a model"
    drawn = [] if evaluation.wireframes is None else [_drawn(evaluation.wireframes)]
    outlines = evaluation.outlines
    if outlines is not None and (reference is None or reference.outlines != "truth"):
        drawn.append(f"{outlines.name}: {_counted(len(outlines.outlines), 'drawn outline')}")
    if reference is None:
        return f"{measured}.", f"{'; '.join(drawn)}." if drawn else "Nothing: the models alone."
    against = f"{reference.name}: {_counted(len(reference.buildings), 'building')}"
    if reference.has_faces:
        against += " with true roof faces"
    else:
        origins = {"given": "given footprints", "raster": "outlines of the class-6 raster", "truth": "true footprints"}
        against += f" ({origins.get(reference.outlines, reference.outlines)})"
    points = len(reference.tiles)
    against += f", points of {_counted(points, 'tile')}" if points else ", no points"
    return f"{measured}.", f"{'; '.join([against, *drawn])}."


def _drawn(wireframes: WireframeSet) -> str:
    return f"{wireframes.name}: roof edges of {_counted(len(wireframes.wireframes), 'building')}"


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def all_notes(evaluation: Evaluation) -> tuple[str, ...]:
    """Assumptions and omissions of readers and measures, each once."""
    reference = () if evaluation.reference is None else evaluation.reference.notes
    return tuple(dict.fromkeys((*evaluation.models.notes, *reference, *evaluation.notes)))


def markdown(evaluation: Evaluation) -> str:
    """The report for people: models, reference, notes, one table per chapter, breakdowns, formulas."""
    measured, against = subject_sentences(evaluation)
    parts = ["# Evaluation", f"- Measured: {markdown_cell(measured)}\n- Against: {markdown_cell(against)}"]
    parts.append(INTERVALS)
    notes = all_notes(evaluation)
    if notes:
        parts.append("## Notes\n\n" + "\n".join(f"- {markdown_cell(note)}" for note in notes))
    parts.append("\n\n".join([f"## {TITLE}", *(_count_table(table) for table in model_figures(evaluation))]))
    found = chapters(evaluation)
    parts += [_chapter(chapter) for chapter in found]
    lost = breakdowns(evaluation.tables)
    if lost:
        parts.append("## Where buildings are lost\n\n" + "\n\n".join(_count_table(table) for table in lost))
    if found:
        parts.append("## Definitions\n\n" + "\n\n".join(_definitions(chapter) for chapter in found))
    return "\n\n".join(parts) + "\n"


def _chapter(chapter: Chapter) -> str:
    """Figures, then counts."""
    parts = [f"## {chapter.title}"]
    if chapter.lines:
        subsets = len(chapter.subsets) > 1
        header = ("measure", *(("buildings",) if subsets else ()), "value", "95 % interval", "n")
        rows = [
            (line.label, *((line.subset,) if subsets else ()), line.value, line.interval, line.n)
            for line in chapter.lines
        ]
        parts.append(markdown_table(header, rows, texts=2 if subsets else 1))
    parts += [_count_table(table) for table in chapter.tables]
    return "\n\n".join(parts)


def _count_table(table: CountTable) -> str:
    return f"### {markdown_cell(table.title)}\n\n{markdown_table(table.header, table.rows)}"


def _definitions(chapter: Chapter) -> str:
    rows = {line.definition.name: (line.label, f"`{line.definition.name}`", line.definition) for line in chapter.lines}
    return "\n".join(
        f"- **{markdown_cell(label)}** ({name}): {definition.formula.replace(chr(10), ' ')}"
        for label, name, definition in rows.values()
    )
