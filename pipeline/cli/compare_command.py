"""The command that compares methods."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Overwrite, Quiet, SettingsFile, takes_options
from pipeline.cli.measure_commands import AsSurveyed, Points, Truth
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import start_early


@takes_options("compare", meshes="none")
def compare(
    tiles: Annotated[
        list[str],
        typer.Argument(
            metavar="TILES", help="Point files (LAS, LAZ, …: docs/reference/formats.md); folders, URLs, tile indexes."
        ),
    ],
    methods: Annotated[
        list[str],
        typer.Option(metavar="M1,M2,…", help="METHOD or METHOD:PRESET, two or more; preset robust or faithful."),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: one run per method, and the page.")],
    settings: SettingsFile = None,
    truth: Truth = None,
    points: Points = None,
    as_surveyed: AsSurveyed = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Model the same candidates by several methods and write one page on what came out."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.compare.compare import CompareRequest, own_tables, parse_variants
        from pipeline.model import Status
        from pipeline.options import ModelFiles, ModelOptions, chosen_settings, values_of
        from pipeline.ruler.evaluation.chapters import chapters
        from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest
        from pipeline.ruler.report.comparison import compare_files, comparison_facts
        from pipeline.ruler.report.evaluation_page import headline
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import resources_of
        from pipeline.settings import RunSettings, read_table

        table = read_table(settings)
        tables = own_tables(table)
        table |= chosen_settings(given)
        request = CompareRequest(
            run=RunRequest(
                inputs=tuple(tiles),
                out=out,
                settings=RunSettings.from_mapping(table),
                resources=resources_of(given),
                overwrite=overwrite,
                **values_of(ModelFiles, given),
                **values_of(ModelOptions, given),
            ),
            variants=parse_variants(methods),
            tables=tables,
        )
        reference = None
        if truth is not None or points or as_surveyed:
            reference = EvaluationRequest(
                models=out,
                truth=truth,
                points=tuple(points or ()),
                footprints=given["footprints"] if points else None,
                footprints_layer=given["footprints_layer"] if points else None,
                crs=given["crs"],
                vertical_unit=given["vertical_unit"],
                as_surveyed=as_surveyed,
            )
        groups = (*kernel_groups(terrain=request.run.settings.general.terrain), "compare")
        resources = request.run.resources
        files = values_of(ModelFiles, given).values()
        compile_for(console.on_event, groups, tiles, files, scheduler=resources.scheduler)
        start_early("reconstruct", resources, footprints=request.run.footprints is not None)
        made = compare_files(request, reference, console.on_event)
        facts = comparison_facts(request, made.summary)
        names = tuple(map(str, Status))
        rows = [
            (
                variant["label"],
                *(variant["statuses"].get(name, 0) for name in names),
                variant["counts"]["roof_faces"],
                f"{1e3 * variant['seconds_a_building'].get('median', 0.0):.1f} ms",
            )
            for variant in facts["variants"]
        ]
        console.table("Methods", ["method", *names, "roof faces", "per building (median)"], rows)
        found = {label: headline(chapters(evaluation)) for label, evaluation in made.evaluations.items()}
        if found:
            values = {label: {line.label: line.value for _, line in lines} for label, lines in found.items()}
            measures = [line.label for _, line in next(iter(found.values()))]
            compared = [(name, *(values[label].get(name, "") for label in values)) for name in measures]
            console.table("Against the reference", ["measure", *values], compared)
        for path in made.written:
            console.say(f"wrote {path}")
        console.document(facts | {"out": made.summary.out, "written": [str(path) for path in made.written]})
        if not all(run.is_complete for run in made.summary.runs.values()):
            raise typer.Exit(ExitCode.TILES_FAILED)
