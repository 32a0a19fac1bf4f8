"""An evaluation as one HTML file: nothing to load, no script, light and dark, for a screen, a phone and a printer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.io.storage import LocalStorage
from pipeline.report.page_template import page_template
from pipeline.report.pictures import data_uri
from pipeline.ruler.evaluation.chapters import Chapter, Line, chapters
from pipeline.ruler.evaluation.counted_models import breakdowns
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.evaluation_writing import INTERVALS, all_notes, subject_sentences
from pipeline.ruler.evaluation.model_figures import TITLE, model_figures
from pipeline.ruler.report.evaluation_maps import maps
from pipeline.ruler.report.histograms import charts
from pipeline.ruler.report.model_pictures import TRUTH_COLOUR, models_view
from pipeline.ruler.report.section import RESIDUAL_CLASSES
from pipeline.ruler.report.worst_cases import MAX_NOT_FOUND, MODEL_COLOUR, SECTION_COLOUR, worst_cases

PAGE = "report.html"
"""The file."""
HEADLINE = (
    ("delivery.lod2", "delivery.records_ok"),
    ("validity.models_valid",),
    ("residuals.within_0_2m_top_visible",),
    ("surface.within_0_2m",),
    ("wireframes.edge_f1_0_5m",),
    ("wireframes.corner_f1_0_5m",),
    ("faces.completeness_10m2",),
    ("faces.correctness_10m2",),
    ("roof_types.correct",),
    ("footprints.iou_median",),
    ("detection.area_quality_without_ring", "detection.area_completeness_without_ring"),
    ("residuals.rmse_top_visible",),
    ("residuals.median_top_visible",),
    ("delivery.records_doubtful",),
    ("delivery.records_fallback",),
    ("delivery.records_failed",),
    ("form.corner_f1_0_5m",),
    ("form.right_corners",),
)
"""The main figures: the first measured one of each row, and the first eight of all rows."""
HEADLINE_FIGURES = 8
"""Largest number."""


def write_page(evaluation: Evaluation, out_dir: str | Path) -> Path:
    """Write `report.html` with its images and styles; RunError if the folder cannot be created."""
    storage = LocalStorage(root=Path(out_dir))
    storage.put(PAGE, page(evaluation).encode())
    return storage.path(PAGE)


def page(evaluation: Evaluation) -> str:
    """The page as text."""
    found = chapters(evaluation)
    measured, against = subject_sentences(evaluation)
    name = evaluation.models.name
    truth = evaluation.reference or evaluation.wireframes or evaluation.outlines
    view = models_view(evaluation.models.models) if evaluation.reference is None else None
    return page_template("evaluation.html", "pipeline.ruler.report").render(
        title=name if truth is None else f"{name} against {truth.name}",
        measured=measured,
        against=against,
        headline=headline(found),
        models_title=TITLE,
        figures=model_figures(evaluation),
        view=None if view is None else _with_uris(view, png="uri"),
        chapters=found,
        lost=breakdowns(evaluation.tables),
        maps=[_with_uris(one, png="uri") for one in maps(evaluation)],
        charts=charts(evaluation.tables),
        cases=[_with_uris(one, plan_png="plan_uri", view_png="view_uri") for one in worst_cases(evaluation)],
        max_not_found=MAX_NOT_FOUND,
        residuals=RESIDUAL_CLASSES,
        truth_colour=TRUTH_COLOUR,
        model_colour=MODEL_COLOUR,
        section_colour=SECTION_COLOUR,
        notes=all_notes(evaluation),
        intervals=INTERVALS,
    )


def headline(found: Sequence[Chapter]) -> list[tuple[str, Line]]:
    """The main figures of all buildings, with the titles of their chapters."""
    lines = {
        line.definition.name: (chapter.title, line)
        for chapter in found
        for line in chapter.lines
        if line.measure.subset == "all"
    }
    chosen = [next((lines[name] for name in names if name in lines), None) for names in HEADLINE]
    return [pair for pair in chosen if pair is not None][:HEADLINE_FIGURES]


def _with_uris(thing: Any, **pictures: str) -> dict[str, Any]:
    """The fields and properties of a dataclass, with PNG bytes as data URIs."""
    known = {name: getattr(thing, name) for name in dir(thing) if not name.startswith("_") and name not in pictures}
    for field, name in pictures.items():
        png = getattr(thing, field)
        known[name] = None if png is None else data_uri(png)
    return known
