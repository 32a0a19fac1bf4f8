"""The command that compares methods."""

from __future__ import annotations

from typing import Annotated

import typer

from pipeline.cli.options import (
    BUILDING_MEMORY_GIB,
    BUILDING_TIMEOUT_S,
    INPUT_TIMEOUT_S,
    AllowOutside,
    Aoi,
    AsJson,
    AsSurveyed,
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
    Meshes,
    Overwrite,
    Points,
    Quiet,
    Scheduler,
    SettingsFile,
    TlsCa,
    TlsCert,
    TlsKey,
    Truth,
    VerticalUnit,
    Workers,
    tls_files,
)
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import start_early


def compare(
    tiles: Annotated[
        list[str],
        typer.Argument(metavar="TILES", help="LAS, LAZ, COPC, PLY, ASCII files; folders, URLs, tile indexes."),
    ],
    methods: Annotated[
        list[str],
        typer.Option(metavar="M1,M2,…", help="METHOD or METHOD:PRESET, two or more; preset robust or faithful."),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: one run per method, and the page.")],
    footprints: Footprints = None,
    layer: Layer = None,
    guides: Guides = None,
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
    allow_outside_area_of_use: AllowOutside = False,
    bbox: Bbox = None,
    aoi: Aoi = None,
    classes: Classes = None,
    settings: SettingsFile = None,
    truth: Truth = None,
    points: Points = None,
    as_surveyed: AsSurveyed = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    meshes: Meshes = "none",
    licence: Licence = None,
    overwrite: Overwrite = False,
    isolate: Annotated[bool | None, Isolate] = None,
    input_timeout: InputTimeout = INPUT_TIMEOUT_S,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Model the same candidates by several methods and write one page on what came out."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.compare.compare import CompareRequest, own_tables, parse_variants
        from pipeline.model import Status
        from pipeline.ruler.evaluation.chapters import chapters
        from pipeline.ruler.evaluation.files import EvaluationRequest
        from pipeline.ruler.report.compare_files import compare_files, comparison_facts
        from pipeline.ruler.report.evaluation_page import headline
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import Resources
        from pipeline.settings import RunSettings, read_table

        table = read_table(settings)
        tables = own_tables(table)
        if classes is not None:
            table["classes"] = classes
        request = CompareRequest(
            run=RunRequest(
                inputs=tuple(tiles),
                out=out,
                settings=RunSettings.from_mapping(table),
                footprints=footprints,
                footprints_layer=layer,
                guides=guides,
                crs=crs,
                vertical_unit=vertical_unit,
                allow_outside_area_of_use=allow_outside_area_of_use,
                bbox=bbox,
                aoi=aoi,
                resources=Resources(
                    workers=workers,
                    scheduler=scheduler,
                    tls=tls_files(tls_ca, tls_cert, tls_key),
                    isolate=isolate,
                    input_timeout_s=input_timeout,
                    building_timeout_s=building_timeout,
                    building_memory_bytes=round(building_memory * 2**30),
                ),
                meshes=meshes,
                licence=licence,
                overwrite=overwrite,
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
                footprints=footprints if points else None,
                footprints_layer=layer if points else None,
                crs=crs,
                vertical_unit=vertical_unit,
                as_surveyed=as_surveyed,
            )
        groups = (*kernel_groups(terrain=request.run.settings.general.terrain), "compare")
        compile_for(console.on_event, groups, tiles, (footprints, guides, aoi), scheduler=scheduler)
        start_early("reconstruct", workers=workers, scheduler=scheduler, footprints=footprints is not None, method=None)
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
