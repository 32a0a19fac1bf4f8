"""A comparison of methods: runs, evaluations, a table for programs, Markdown and a page with pictures in one folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.errors import RunCancelledError, SettingsError
from pipeline.export.geoparquet import parquet_bytes
from pipeline.extras.compare.compare import (
    BUILDINGS,
    PAGE,
    REPORT,
    SUMMARY,
    CompareRequest,
    CompareSummary,
    compare,
    settings_of,
)
from pipeline.io import LocalStorage, ReadOptions, find_inputs
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest, evaluate_files, read_reference
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.report.comparison_choice import Choice, chosen_buildings
from pipeline.ruler.report.comparison_figures import figure_tables
from pipeline.ruler.report.comparison_page import Comparison, markdown, page
from pipeline.ruler.report.comparison_pictures import BuildingPictures, draw_building, place_of
from pipeline.ruler.report.comparison_points import PointFiles, points_within
from pipeline.ruler.report.comparison_records import (
    ComparedRun,
    buildings_table,
    projjson_of,
    read_buildings,
    reference_of,
)
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event, Listener, ignore, never


@dataclasses.dataclass(frozen=True, kw_only=True)
class WrittenComparison:
    """A finished comparison."""

    summary: CompareSummary
    evaluations: dict[str, Evaluation]
    written: tuple[Path, ...]


def compare_files(
    request: CompareRequest,
    reference: EvaluationRequest | None = None,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> WrittenComparison:
    """Run several methods over the same candidates; write compare.json, buildings.parquet, compare.md and index.html.

    `request.run.out` is the folder of all files. With a `reference`, every variant is evaluated against it; its
    `models` are not read. `on_event`, `executor` and `cancelled` are those of `pipeline.runtime.run.run`.
    """

    def step(name: str) -> None:
        if cancelled():
            raise RunCancelledError("the comparison was cancelled")
        on_event(Event(kind="stage", stage=name))

    measured_against = None if reference is None else read_reference(reference)
    summary = compare(request, on_event, executor, cancelled)
    evaluations: dict[str, Evaluation] = {}
    if reference is not None:
        for label, run in summary.runs.items():
            step("evaluate")
            of_run = dataclasses.replace(reference, models=run.run_dir)
            evaluations[label] = evaluate_files(of_run, reference=measured_against)
    options = ReadOptions(crs=request.run.crs, vertical_unit=request.run.vertical_unit)
    runs = [
        ComparedRun(
            label=variant.label,
            method=variant.method,
            preset=variant.preset,
            run_dir=summary.runs[variant.label].run_dir,
            seconds=summary.seconds[variant.label],
            evaluation=evaluations.get(variant.label),
        )
        for variant in request.variants
    ]
    paths = find_inputs(request.run.inputs, only_files=request.run.only_files)
    points = PointFiles(paths=tuple(paths), options=options)
    written = write_comparison(summary.out, runs, points=points, on_step=step)
    document = json.dumps(comparison_facts(request, summary), indent=1, ensure_ascii=False).encode()
    LocalStorage(root=Path(summary.out)).put(SUMMARY, document)
    return WrittenComparison(
        summary=summary, evaluations=evaluations, written=(Path(summary.out) / SUMMARY, *(Path(p) for p in written))
    )


def comparison_facts(request: CompareRequest, summary: CompareSummary) -> dict[str, Any]:
    """The content of compare.json: the inputs, and the result of each variant."""
    variants = []
    for variant in request.variants:
        run = summary.runs[variant.label]
        seconds = sorted(summary.seconds[variant.label].values())
        spread: Mapping[str, Any] = {
            "mean": np.mean,
            "median": np.median,
            "p95": lambda values: np.quantile(values, 0.95),
        }
        variants.append(
            {
                "label": variant.label,
                "method": variant.method,
                "preset": variant.preset,
                "run_dir": str(Path(run.run_dir).relative_to(summary.out)),
                "settings_hash": settings_of(request.run.settings, variant, request.tables).settings_hash,
                "content_sha256": run.digest,
                "statuses": run.statuses,
                "reasons": run.reasons,
                "roof_types": run.roof_types,
                "counts": run.counts,
                "seconds_a_building": {name: round(float(of(seconds)), 6) for name, of in spread.items() if seconds},
                "failed_tiles": list(run.failed_tiles),
                "tiles_without_points": list(run.tiles_without_points),
                "warnings": list(run.warnings),
            }
        )
    return {"engine_version": __version__, "inputs": list(request.run.inputs), "variants": variants}


def write_comparison(
    out: str | Path,
    runs: Sequence[ComparedRun],
    *,
    points: PointFiles | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Write `buildings.parquet`, `compare.md` and `index.html`; returns their paths in that order.

    The runs have the same candidates and are the columns. Points of the drawn buildings are read again from `points`;
    without it the pictures have none. `on_step` is called with the name of each step as it begins.

    Raises SettingsError if there is no run, or two have one label; RunError if a directory has no run, the runs have
    different candidates, or the folder cannot be created; InputError if a point file cannot be read.
    """
    labels = [run.label for run in runs]
    if not runs:
        raise SettingsError(["no runs are given: give at least one"])
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise SettingsError([f"runs are labelled {', '.join(twice)} more than once: give each its own label"])
    on_step("records")
    manifests = tuple(read_manifest(run.run_dir) for run in runs)
    buildings, left_out = read_buildings(runs, manifests)
    storage = LocalStorage(root=Path(out))
    storage.put(BUILDINGS, parquet_bytes(buildings_table(runs, buildings, projjson_of(manifests[0]))))
    comparison = Comparison(
        runs=tuple(runs),
        manifests=manifests,
        buildings=tuple(buildings),
        left_out=left_out,
        tables=figure_tables(runs, buildings),
        cases=tuple(_cases(runs, chosen_buildings(buildings), points, on_step)),
        has_points=points is not None,
    )
    on_step("page")
    storage.put(REPORT, markdown(comparison).encode())
    storage.put(PAGE, page(comparison).encode())
    return [storage.path(key) for key in (BUILDINGS, REPORT, PAGE)]


def _cases(
    runs: Sequence[ComparedRun],
    choices: Sequence[Choice],
    points: PointFiles | None,
    on_step: Callable[[str], None],
) -> list[tuple[Choice, BuildingPictures]]:
    """The chosen buildings with their pictures."""
    names = {choice.building.building_id for choice in choices}
    found = [_models_of(run.evaluation.models if run.evaluation else read_models(run.run_dir), names) for run in runs]
    known = [[models[choice.building.building_id] for models in found] for choice in choices]
    reference = reference_of(runs)
    true = {} if reference is None else {building.building_id: building for building in reference.buildings}
    truths = [true.get(choice.building.true_id or "") for choice in choices]
    places = [place_of(models, truth) for models, truth in zip(known, truths, strict=True)]
    on_step("points")
    xyz = points_within(points or PointFiles(paths=()), places)
    on_step("pictures")
    return [
        (choice, draw_building(models, truth, cloud))
        for choice, models, truth, cloud in zip(choices, known, truths, xyz, strict=True)
    ]


def _models_of(models: ModelSet, names: set[str]) -> dict[str, RoofModel]:
    """The models and failed records of some buildings; a record without even a footprint has an empty one."""
    return {model.building_id: model for model in (*models.models, *models.failed) if model.building_id in names}
