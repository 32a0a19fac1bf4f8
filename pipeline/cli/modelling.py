"""The command that models buildings."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipeline.cli.options import (
    BUILDING_MEMORY_GIB,
    BUILDING_TIMEOUT_S,
    INPUT_TIMEOUT_S,
    AllowOutside,
    Aoi,
    AsJson,
    Bbox,
    BuildingMemory,
    BuildingTimeout,
    Classes,
    Crs,
    Footprints,
    Guides,
    InputTimeout,
    Isolate,
    Layer,
    Licence,
    Lods,
    Meshes,
    Method,
    Overwrite,
    PerformanceReport,
    Quiet,
    Scheduler,
    Scratch,
    SettingsFile,
    Terrain,
    TlsCa,
    TlsCert,
    TlsKey,
    VerticalUnit,
    WithPoints,
    Workers,
    tls_files,
)
from pipeline.cli.summary import show_summary
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import start_early

if TYPE_CHECKING:
    from pipeline.settings import RunSettings


def reconstruct(
    tiles: Annotated[
        list[str],
        typer.Argument(metavar="TILES", help="LAS, LAZ, COPC, PLY, ASCII files; folders, URLs, tile indexes."),
    ],
    out: Annotated[
        str, typer.Option(metavar="RUN", help="The run directory to write; a folder, or s3://bucket/prefix.")
    ],
    method: Method = None,
    preset: Annotated[
        Literal["robust", "faithful"] | None,
        typer.Option(help="Settings of the method that measured better, or that keep to its paper."),
    ] = None,
    lods: Lods = None,
    footprints: Footprints = None,
    layer: Layer = None,
    guides: Guides = None,
    overrides: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Corrections of single buildings, as TOML; docs/how_to/overrides.md."),
    ] = None,
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
    allow_outside_area_of_use: AllowOutside = False,
    bbox: Bbox = None,
    aoi: Aoi = None,
    classes: Classes = None,
    settings: SettingsFile = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    scratch: Scratch = None,
    meshes: Meshes = "building",
    points: WithPoints = False,
    terrain: Terrain = None,
    licence: Licence = None,
    overwrite: Overwrite = False,
    isolate: Annotated[bool | None, Isolate] = None,
    input_timeout: InputTimeout = INPUT_TIMEOUT_S,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    performance_report: PerformanceReport = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct buildings from tiles into a run directory."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import Resources
        from pipeline.runtime.run import run

        request = RunRequest(
            inputs=tuple(tiles),
            out=out,
            settings=_run_settings(
                settings, method=method, preset=preset, classes=classes, lods=_in_order(lods), terrain=terrain
            ),
            footprints=footprints,
            footprints_layer=layer,
            guides=guides,
            overrides=overrides,
            crs=crs,
            vertical_unit=vertical_unit,
            allow_outside_area_of_use=allow_outside_area_of_use,
            bbox=bbox,
            aoi=aoi,
            resources=Resources(
                workers=workers,
                scheduler=scheduler,
                tls=tls_files(tls_ca, tls_cert, tls_key),
                performance_report=performance_report,
                scratch=scratch,
                isolate=isolate,
                input_timeout_s=input_timeout,
                building_timeout_s=building_timeout,
                building_memory_bytes=round(building_memory * 2**30),
            ),
            meshes=meshes,
            points=points,
            licence=licence,
            overwrite=overwrite,
        )
        general, files = request.settings.general, (footprints, guides, overrides, aoi)
        groups = kernel_groups(method=general.method, points=points, terrain=general.terrain)
        compile_for(console.on_event, groups, tiles, files, scheduler=scheduler)
        start_early(
            "reconstruct",
            workers=workers,
            scheduler=scheduler,
            footprints=footprints is not None,
            method=general.method,
        )
        summary = run(request, console.on_event)
        show_summary(console, summary)
        console.document(dataclasses.asdict(summary))
        if not summary.is_complete:
            raise typer.Exit(ExitCode.TILES_FAILED)


def _in_order(words: str | None) -> str | None:
    """Levels of detail in the settings' form: each once, the coarsest first."""
    return None if words is None else ",".join(sorted({word.strip() for word in words.split(",")}))


def _run_settings(path: str | None, **overrides: str | None) -> RunSettings:
    """The settings of a file, or the defaults, overridden by options of the command line."""
    from pipeline.settings import RunSettings

    given = {name: value for name, value in overrides.items() if value is not None}
    return RunSettings.from_toml(path, given)
