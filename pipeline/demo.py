"""The demo: a simulated suburb with exact truth, reconstructed, measured against the truth, drawn."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pipeline.report.render import render_run
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest, evaluate_files
from pipeline.ruler.evaluation.evaluation_writing import write_tables
from pipeline.ruler.report.evaluation_page import write_page
from pipeline.ruler.simulation.dataset import Output, ScenePaths, simulate
from pipeline.runtime.monitoring.progress import Event, Listener
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run

SUITE = "suburb"
"""The suite of the demo."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo:
    """The results of the demo."""

    scene: ScenePaths
    """The simulated tile and its truth."""
    summary: RunSummary
    """The run on it."""
    evaluation: Evaluation
    """The run's models against the truth."""
    page: Path
    """The page of the evaluation."""
    picture: Path
    """The run, drawn."""


def demonstrate(
    out: str | Path,
    on_event: Listener,
    *,
    workers: int | None,
    overwrite: bool,
    size_m: tuple[float, float] | None,
    seed: int | None,
) -> Demo:
    """Simulate, reconstruct, measure and draw into the folders `scene/`, `run/`, `report/` and the file `demo.png`.

    Raises RunError if there is a run already, and `overwrite` is False.

    Parameters
    ----------
    workers : int or None
        Processes of the embedded cluster; 0 runs serially, None follows the estimate.
    size_m, seed : tuple of float or None, int or None
        Extent of the suburb east and north, and its seed; its own by default.
    """
    folder = Path(out)
    scene = simulate(
        SUITE,
        folder / "scene",
        seed,
        size_m=size_m,
        output=Output(on_points=lambda n: on_event(Event(kind="progress", stage="scan", done=n))),
    )
    request = RunRequest(
        inputs=(str(scene.laz),), out=str(folder / "run"), resources=Resources(workers=workers), overwrite=overwrite
    )
    summary = run(request, on_event)
    on_event(Event(kind="stage", stage="measure", total=1))
    evaluation = evaluate_files(EvaluationRequest(models=summary.run_dir, truth=str(scene.truth)))
    write_tables(evaluation, folder / "report")
    page = write_page(evaluation, folder / "report")
    on_event(Event(kind="progress", stage="measure", done=1, total=1))
    on_event(Event(kind="stage", stage="draw", total=1))
    picture = folder / "demo.png"
    render_run(summary.run_dir, picture, truth=scene.truth)
    on_event(Event(kind="progress", stage="draw", done=1, total=1))
    return Demo(scene=scene, summary=summary, evaluation=evaluation, page=page, picture=picture)
