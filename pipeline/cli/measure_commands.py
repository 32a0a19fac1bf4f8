"""Commands that look at tiles, runs and models."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Quiet, SettingsFile, takes_options
from pipeline.cli.run_summary import show_statistics
from pipeline.console import Console
from pipeline.errors import SettingsError

if TYPE_CHECKING:
    from pipeline.ruler.evaluation.evaluate import Evaluation


Truth = Annotated[
    str | None, typer.Option(metavar="DIR", help="The truth that simulate wrote: measure the models against it.")
]
Points = Annotated[
    list[str] | None,
    typer.Option(metavar="TILE", help="A classified tile to measure against; repeat --points for several."),
]
AsSurveyed = Annotated[
    bool, typer.Option("--as-surveyed", help="Move each true building by the shift of the strips that saw it.")
]


@takes_options("inspect")
def inspect(
    tile: Annotated[
        str,
        typer.Argument(
            metavar="TILE", help="A point file (LAS, LAZ, …: docs/reference/formats.md); or a run directory."
        ),
    ],
    settings: SettingsFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Show the facts of a tile and an estimate of time and memory; or the figures and reasons of a run, added up."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.inspection import inspect as inspect_tile
        from pipeline.io.source import ReadOptions
        from pipeline.runtime.monitoring.progress import Event
        from pipeline.settings import RunSettings
        from pipeline.terrain.terrain_settings import ClassCodeSettings

        if _is_run(tile):
            from pipeline.options import option_named
            from pipeline.report.statistics import run_statistics

            named = {"--settings": settings} | {option_named(name).flag: value for name, value in given.items()}
            unused = [f"{flag} {value}" for flag, value in named.items() if value is not None]
            if unused:
                raise SettingsError([f"{', '.join(unused)}: {tile} is a run, which has its own. Leave them out"])
            statistics = run_statistics(tile)
            show_statistics(console, statistics)
            console.document({"run": tile, "statistics": statistics})
            return

        def on_progress(done: int, total: int) -> None:
            console.on_event(Event(kind="progress", stage="read", done=done, total=total))

        options = ReadOptions(**given)
        found = inspect_tile(tile, options, on_progress, RunSettings.from_toml(settings, {}))
        for warning in found.warnings:
            console.warn(warning)
        console.table(tile, ["fact", "value"], found.rows())
        shares = [
            [n, ClassCodeSettings.role(n), count, f"{100.0 * count / found.used_points:.1f} %"]
            for n, count in found.classes.items()
        ]
        console.table("Classes", ["class", "meaning", "points", "share"], shares)
        console.document(dataclasses.asdict(found))


def _is_run(place: str) -> bool:
    """Whether a folder or a URL is a run directory; imports nothing for files."""
    from pipeline.io import is_url

    if not is_url(place) and not Path(place).is_dir():
        return False
    from pipeline.ruler.evaluation.reading.run_models import is_run

    return is_run(place)


def digest(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run directory.")],
    as_json: AsJson = False,
) -> None:
    """Print the sha256 of a run's content, the same for all workers and tilings."""
    with Console(as_json=as_json) as console:
        from pipeline.runtime.digest import run_digest

        content = run_digest(run)
        console.say(content)
        console.document({"run": run, "content_sha256": content})


def report(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run directory, a folder or a URL.")],
    as_json: AsJson = False,
) -> None:
    """Write the page about a finished run, RUN/run.html: map, failures by reason, slowest buildings, time, memory."""
    with Console(as_json=as_json) as console:
        from pipeline.report.run_page import write_run_page

        written = write_run_page(run)
        console.say(f"the report is {written}")
        console.document({"run": run, "written": written})


@takes_options("evaluate")
def evaluate(
    models: Annotated[
        str, typer.Argument(metavar="MODELS", help="A run directory; CityJSON, CityJSONSeq or OBJ of any program.")
    ],
    truth: Truth = None,
    points: Points = None,
    footprints: Annotated[
        str | None, typer.Option(metavar="FILE", help="Drawn outlines: of the points, and for the form of outlines.")
    ] = None,
    ground: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="The same points, classified by another program: judge its ground."),
    ] = None,
    wireframes: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="True roof edges in metres, as JSON or OBJ lines: judge edges and corners by them."
        ),
    ] = None,
    as_surveyed: AsSurveyed = False,
    blocks: Annotated[
        bool | None,
        typer.Option(
            "--blocks/--no-blocks", help="Join true buildings that touch; default: for models without footprints."
        ),
    ] = None,
    out: Annotated[
        str | None, typer.Option(metavar="DIR", help="Write the report here: a page, Markdown, Parquet tables.")
    ] = None,
    picture: Annotated[str | None, typer.Option(metavar="FILE", help="Draw the run to this PNG file.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Measure models: against simulated truth, classified points, drawn outlines, true roof edges, or alone."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest, evaluate_files
        from pipeline.runtime.monitoring.progress import Event

        request = EvaluationRequest(
            models=models,
            truth=truth,
            points=tuple(points or ()),
            footprints=footprints,
            ground=tuple(ground or ()),
            wireframes=wireframes,
            as_surveyed=as_surveyed,
            blocks=blocks,
            **given,
        )

        def on_step(name: str) -> None:
            console.on_event(Event(kind="stage", stage=name))

        evaluation = evaluate_files(request, on_step)
        document = show_evaluation(console, evaluation)
        if out is not None:
            from pipeline.ruler.evaluation.evaluation_writing import write_tables
            from pipeline.ruler.report.evaluation_page import write_page

            on_step("page")
            written = [*write_tables(evaluation, out), write_page(evaluation, out)]
            console.say(f"the report is {written[-1]}")
            document["written"] = [str(path) for path in written]
        if picture is not None:
            from pipeline.report.render import render_run

            render_run(models, picture, truth=truth)
            console.say(f"the picture is {picture}")
            document["picture"] = picture
        console.document(document)


def show_evaluation(console: Console, evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as tables; returns it as plain JSON values."""
    from pipeline.ruler.evaluation.chapters import chapters
    from pipeline.ruler.evaluation.evaluation_writing import all_notes, measures_table
    from pipeline.ruler.evaluation.model_figures import model_figures

    document: dict[str, Any] = {"models": evaluation.models.path, "notes": list(all_notes(evaluation))}
    if evaluation.statistics is not None:
        document["statistics"] = evaluation.statistics
    for figures in model_figures(evaluation):
        console.table(figures.title, figures.header, figures.rows)
    for chapter in chapters(evaluation):
        rows = [
            (line.label, line.value, line.interval, line.n) for line in chapter.lines if line.measure.subset == "all"
        ]
        console.table(chapter.title, ["measure", "value", "95 % interval", "n"], rows)
        for counts in chapter.tables:
            console.table(counts.title, list(counts.header), list(counts.rows))
    for note in all_notes(evaluation):
        console.say(note)
    document["measures"] = measures_table(evaluation).to_pylist()
    return document
