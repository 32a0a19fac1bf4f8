"""A comparison of runs over the same candidates as files: a table for programs, Markdown, and a page with pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.errors import SettingsError
from pipeline.export.geoparquet import parquet_bytes
from pipeline.extras.compare.compare import BUILDINGS, PAGE, REPORT
from pipeline.io.storage import LocalStorage
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.report.comparison_building import ComparedRun
from pipeline.ruler.report.comparison_choice import Choice, chosen_buildings
from pipeline.ruler.report.comparison_figures import figure_tables
from pipeline.ruler.report.comparison_page import Comparison, ComparisonCase, markdown, page
from pipeline.ruler.report.comparison_pictures import draw_building, place_of
from pipeline.ruler.report.comparison_points import PointFiles, points_within
from pipeline.ruler.report.comparison_records import buildings_table, projjson_of, read_buildings
from pipeline.runtime.manifest_reading import read_manifest

__all__ = ["BUILDINGS", "PAGE", "REPORT", "ComparedRun", "PointFiles", "write_comparison"]


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
    _check(runs)
    on_step("records")
    manifests = tuple(read_manifest(run.run_dir) for run in runs)
    buildings, left_out = read_buildings(runs, manifests)
    choices = chosen_buildings(buildings)
    storage = LocalStorage(root=Path(out))
    storage.put(BUILDINGS, parquet_bytes(buildings_table(runs, buildings, projjson_of(manifests[0]))))
    comparison = Comparison(
        runs=tuple(runs),
        manifests=manifests,
        buildings=tuple(buildings),
        left_out=left_out,
        tables=figure_tables(runs, buildings),
        cases=tuple(_cases(runs, choices, points, on_step)),
        has_points=points is not None,
    )
    on_step("page")
    storage.put(REPORT, markdown(comparison).encode())
    storage.put(PAGE, page(comparison).encode())
    return [storage.path(key) for key in (BUILDINGS, REPORT, PAGE)]


def _check(runs: Sequence[ComparedRun]) -> None:
    labels = [run.label for run in runs]
    if not runs:
        raise SettingsError(["no runs are given: give at least one"])
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise SettingsError([f"runs are labelled {', '.join(twice)} more than once: give each its own label"])


def _cases(
    runs: Sequence[ComparedRun],
    choices: Sequence[Choice],
    points: PointFiles | None,
    on_step: Callable[[str], None],
) -> list[ComparisonCase]:
    """The chosen buildings with their pictures."""
    names = {choice.building.building_id for choice in choices}
    found = [_models_of(run.evaluation.models if run.evaluation else read_models(run.run_dir), names) for run in runs]
    known = [[models[choice.building.building_id] for models in found] for choice in choices]
    reference = next((run.evaluation.reference for run in runs if run.evaluation and run.evaluation.reference), None)
    true = {} if reference is None else {building.building_id: building for building in reference.buildings}
    truths = [true.get(choice.building.true_id or "") for choice in choices]
    places = [place_of(models, truth) for models, truth in zip(known, truths, strict=True)]
    on_step("points")
    xyz = points_within(points or PointFiles(paths=()), places)
    on_step("pictures")
    return [
        ComparisonCase(choice=choice, pictures=draw_building(models, truth, cloud))
        for choice, models, truth, cloud in zip(choices, known, truths, xyz, strict=True)
    ]


def _models_of(models: ModelSet, names: set[str]) -> dict[str, RoofModel]:
    """The models and failed records of some buildings; a record without even a footprint has an empty one."""
    return {model.building_id: model for model in (*models.models, *models.failed) if model.building_id in names}
