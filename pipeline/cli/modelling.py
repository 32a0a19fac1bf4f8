"""The command that models buildings."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Overwrite, Quiet, SettingsFile, takes_options
from pipeline.cli.run_summary import show_summary
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import start_early


@takes_options("reconstruct")
def reconstruct(
    tiles: Annotated[
        list[str],
        typer.Argument(
            metavar="TILES", help="Point files (LAS, LAZ, …: docs/reference/formats.md); folders, URLs, tile indexes."
        ),
    ],
    out: Annotated[
        str, typer.Option(metavar="RUN", help="The run directory to write; a folder, or s3://bucket/prefix.")
    ],
    settings: SettingsFile = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Reconstruct buildings from tiles into a run directory."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.options import ModelFiles, ModelOptions, chosen_settings, values_of
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import resources_of
        from pipeline.runtime.run import run
        from pipeline.settings import RunSettings

        if given["lods"] is not None:
            given["lods"] = in_order(given["lods"])
        request = RunRequest(
            inputs=tuple(tiles),
            out=out,
            settings=RunSettings.from_toml(settings, chosen_settings(given)),
            resources=resources_of(given),
            overwrite=overwrite,
            **values_of(ModelFiles, given),
            **values_of(ModelOptions, given),
        )
        general, scheduler = request.settings.general, request.resources.scheduler
        groups = kernel_groups(method=general.method, points=request.points, terrain=general.terrain)
        compile_for(console.on_event, groups, tiles, values_of(ModelFiles, given).values(), scheduler=scheduler)
        has_footprints = request.footprints is not None
        start_early("reconstruct", request.resources, footprints=has_footprints, method=general.method)
        summary = run(request, console.on_event)
        show_summary(console, summary)
        console.document(dataclasses.asdict(summary))
        if not summary.is_complete:
            raise typer.Exit(ExitCode.TILES_FAILED)


def in_order(words: str) -> str:
    """Levels of detail in the settings' form: each once, the coarsest first."""
    return ",".join(sorted({word.strip() for word in words.split(",")}))
