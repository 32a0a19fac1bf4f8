"""Commands that model buildings."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    Lods,
    Meshes,
    Method,
    Overwrite,
    PerformanceReport,
    Points,
    Quiet,
    Scheduler,
    Scratch,
    SettingsFile,
    Terrain,
    TlsCa,
    TlsCert,
    TlsKey,
    Truth,
    VerticalUnit,
    WithPoints,
    Workers,
    tls_files,
)
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import has_idle_child, start_early

if TYPE_CHECKING:
    from pipeline.runtime.run import RunSummary
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


def rerun(
    run_dir: Annotated[str, typer.Argument(metavar="RUN", help="The directory of a finished run.")],
    overrides: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="The overrides that replace the run's; default its own file."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="A building to model again in any case; repeat --only for several."),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    isolate: Annotated[bool | None, Isolate] = None,
    input_timeout: InputTimeout = INPUT_TIMEOUT_S,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Model single buildings of a run again, after other overrides; all others stay untouched."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.earlier import earlier_run, request_of
        from pipeline.runtime.rerun import RerunRequest
        from pipeline.runtime.rerun import rerun as rerun_buildings
        from pipeline.runtime.resources import Resources

        request = RerunRequest(
            run_dir=run_dir,
            overrides=overrides,
            only=tuple(only or ()),
            resources=Resources(
                workers=workers,
                scheduler=scheduler,
                tls=tls_files(tls_ca, tls_cert, tls_key),
                isolate=isolate,
                input_timeout_s=input_timeout,
                building_timeout_s=building_timeout,
                building_memory_bytes=round(building_memory * 2**30),
            ),
        )
        earlier = request_of(earlier_run(run_dir).manifest)
        general = earlier.settings.general
        groups = kernel_groups(method=general.method, terrain=general.terrain)
        compile_for(console.on_event, groups, earlier.inputs, (overrides,), scheduler=scheduler)
        start_early("reconstruct", workers=workers, scheduler=scheduler, footprints=False, method=general.method)
        summary = rerun_buildings(request, console.on_event)
        console.table("Made again", ["building", "status"], list(summary.buildings.items()))
        console.say(f"{len(summary.buildings)} buildings, {len(summary.tiles)} tiles written, {summary.seconds:.1f} s")
        console.say(f"content sha256 {summary.digest}")
        console.document(dataclasses.asdict(summary))


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
        from pipeline.model import Status
        from pipeline.ruler.evaluation.chapters import chapters
        from pipeline.ruler.evaluation.files import EvaluationRequest
        from pipeline.ruler.report.compare_files import compare_files, comparison_facts
        from pipeline.ruler.report.evaluation_page import headline
        from pipeline.runtime.compare import CompareRequest, own_tables, parse_variants
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


def replay(
    bundle: Annotated[str, typer.Argument(metavar="BUNDLE", help="A file of a run's quarantine folder.")],
    isolate: Annotated[bool, Isolate] = True,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    out: Annotated[
        str | None, typer.Option(metavar="DIR", help="Write the record, and the model as OBJ and CityJSON, here.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Model one quarantined building again, from its bundle alone."""
    with Console(as_json=as_json) as console:
        from pipeline import __version__
        from pipeline.io.remote_file import on_this_machine
        from pipeline.runtime.isolation.limits import IsolationLimits
        from pipeline.runtime.isolation.replay_bundle import read_bundle
        from pipeline.runtime.replay import replay as replay_building
        from pipeline.runtime.replay import replay_row, write_replay

        limits = IsolationLimits(timeout_s=building_timeout, memory_bytes=round(building_memory * 2**30))
        with on_this_machine(bundle) as file:
            found = read_bundle(str(file))
        if found.incident.engine_version != __version__:
            console.warn(f"it happened to gablework {found.incident.engine_version}; this is {__version__}")
        console.say(f"{found.candidate.building_id} in its run: {found.incident.reason}, {found.incident.detail}")
        replayed = replay_building(found, limits if isolate else None)
        row = replay_row(found, replayed)
        console.table("This time", ["column", "value"], [(name, value) for name, value in row.items() if value != []])
        if replayed.loss is not None and replayed.loss.stderr:
            console.say(f"the last lines of its process:\n{replayed.loss.stderr}")
        written = [str(path) for path in write_replay(out, found, replayed)] if out is not None else []
        for path in written:
            console.say(f"wrote {path}")
        incident = dataclasses.asdict(found.incident)
        stderr = "" if replayed.loss is None else replayed.loss.stderr
        console.document({"incident": incident, "record": dict(row), "stderr": stderr, "written": written})
        if row["status"] == "failed":
            raise typer.Exit(ExitCode.TILES_FAILED)


def _in_order(words: str | None) -> str | None:
    """Levels of detail in the settings' form: each once, the coarsest first."""
    return None if words is None else ",".join(sorted({word.strip() for word in words.split(",")}))


def _run_settings(path: str | None, **overrides: str | None) -> RunSettings:
    """The settings of a file, or the defaults, overridden by options of the command line."""
    from pipeline.settings import RunSettings

    given = {name: value for name, value in overrides.items() if value is not None}
    return RunSettings.from_toml(path, given)


def _statistics_of(run_dir: str) -> dict[str, Any]:
    """The figures of a run, read by a child of the run if there is one: it has loaded Arrow, which takes longer."""
    if has_idle_child():
        from pipeline.runtime.cluster.local_executor import LocalExecutor
        from pipeline.runtime.cluster.serial_executor import run_alone

        return run_alone(LocalExecutor(1), "report", _read_statistics, run_dir)
    return _read_statistics(run_dir)


def _read_statistics(run_dir: str) -> dict[str, Any]:
    from pipeline.report.statistics import run_statistics

    return run_statistics(run_dir)


def show_summary(console: Console, summary: RunSummary) -> None:
    """The results of a run, as tables."""
    from pipeline.cli.measuring import show_statistics

    if summary.headline:
        console.say_first(summary.headline)
    show_statistics(console, _statistics_of(summary.run_dir))
    console.table(
        "Time", ["stage", "wall clock"], [(k, f"{seconds:.1f} s") for k, seconds in summary.timings_s.items()]
    )
    points, tiles = summary.counts["points"], summary.counts["tiles"]
    largest = max(summary.peak_memory_bytes.values(), default=0) / 2**30
    console.say(f"{points} points, tiles: {tiles}, peak memory of a process: {largest:.2f} GiB")
    for tile in summary.failed_tiles:
        console.warn(f"tile {tile} failed")
    for tile in summary.tiles_without_points:
        console.warn(f"tile {tile} has no points")
    for tile in summary.tiles_without_terrain:
        console.warn(f"tile {tile} has no terrain")
    console.say(f"content sha256 {summary.digest}")
    console.say(f"results are in {summary.run_dir}")
