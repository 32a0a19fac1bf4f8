"""The command that classifies points."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Quiet, SettingsFile, takes_options
from pipeline.console import Console
from pipeline.runtime.isolation.preloading import is_surely_small, start_early

if TYPE_CHECKING:
    from pipeline.extras.classify.classify import ClassifySummary


@takes_options("classify")
def classify(
    tiles: Annotated[
        list[str],
        typer.Argument(
            metavar="TILES", help="Point files (LAS, LAZ, …: docs/reference/formats.md), or folders of them."
        ),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: one LAZ file per input.")],
    rasters: Annotated[
        bool, typer.Option("--rasters", help="Write terrain.tif, surface.tif and height.tif, too.")
    ] = False,
    raster_cell: Annotated[
        float | None,
        typer.Option(metavar="SIDE", help="Side of the rasters' cells in the CRS's units; default 0.5 m or 2 ft."),
    ] = None,
    settings: SettingsFile = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Classify points as ground, building and vegetation, and write them back as LAZ."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.classify.classify import ClassifyRequest
        from pipeline.extras.classify.classify import classify as classify_files
        from pipeline.options import InputFiles, InputOptions, chosen_settings, values_of
        from pipeline.runtime.compiling import RECONSTRUCT, compile_for
        from pipeline.runtime.resources import resources_of
        from pipeline.settings import RunSettings

        request = ClassifyRequest(
            inputs=tuple(tiles),
            out=out,
            settings=RunSettings.from_toml(settings, chosen_settings(given)),
            rasters=rasters,
            raster_cell=raster_cell,
            resources=resources_of(given),
            overwrite=overwrite,
            **values_of(InputFiles, given),
            **values_of(InputOptions, given),
        )
        scheduler = request.resources.scheduler
        compile_for(console.on_event, (*RECONSTRUCT, "classify"), tiles, (request.footprints,), scheduler=scheduler)
        if not is_surely_small(tiles):
            start_early("classify", request.resources, footprints=request.footprints is not None)
        summary = classify_files(request, console.on_event)
        show_classes(console, summary)
        console.document(dataclasses.asdict(summary))


def show_classes(console: Console, summary: ClassifySummary) -> None:
    """The outputs, as tables."""
    names = {1: "other", 2: "ground", 5: "vegetation", 6: "building", 7: "noise"}
    total = max(1, sum(summary.classes.values()))
    rows = [
        (f"{code} {names.get(code, 'as in the file')}", count, f"{100.0 * count / total:.1f} %")
        for code, count in summary.classes.items()
    ]
    console.table("Classes", ["class", "points", "share"], rows)
    console.table("Files", ["file", "points"], [(file.path, file.points) for file in summary.files])
    for path in summary.rasters:
        console.say(path)
    for name, seconds in summary.timings_s.items():
        console.say(f"{name} {seconds:.1f} s")
