"""A comparison of methods: runs, evaluations, tables and the page in one folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.errors import RunCancelledError
from pipeline.extras.compare.compare import SUMMARY, CompareRequest, CompareSummary, compare, settings_of
from pipeline.io import LocalStorage, ReadOptions, find_inputs
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.files import EvaluationRequest, evaluate_files, read_reference
from pipeline.ruler.report.comparison import ComparedRun, PointFiles, write_comparison
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring.progress import Event, Listener, ignore, never


@dataclasses.dataclass(frozen=True, kw_only=True)
class WrittenComparison:
    """A finished comparison."""

    summary: CompareSummary
    """The runs."""
    evaluations: dict[str, Evaluation]
    """Evaluations by label; empty without a reference."""
    written: tuple[Path, ...]
    """The files beside the runs."""


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
        spread = (
            {
                "mean": float(np.mean(seconds)),
                "median": float(np.median(seconds)),
                "p95": float(np.quantile(seconds, 0.95)),
            }
            if seconds
            else {}
        )
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
                "seconds_a_building": {name: round(value, 6) for name, value in spread.items()},
                "failed_tiles": list(run.failed_tiles),
                "tiles_without_points": list(run.tiles_without_points),
                "warnings": list(run.warnings),
            }
        )
    return {"engine_version": __version__, "inputs": list(request.run.inputs), "variants": variants}
