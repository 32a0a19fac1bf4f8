"""The science commands. Each composes what stands below and imports it only when it runs: start-up counts."""

from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipeline.console import Console, ExitCode

if TYPE_CHECKING:
    from pipeline.evaluation.evaluate import Evaluation
    from pipeline.runtime.run import RunSummary
    from pipeline.settings import RunSettings

app = typer.Typer(
    name="gablework",
    help="Building models from raw airborne LiDAR: no classes and no footprints needed, both used when given.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich would triple the time until help shows
)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; events as JSON lines on stderr.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress; warnings and errors only.")]
Crs = Annotated[
    str | None, typer.Option(metavar="EPSG:n", help="The inputs' CRS, where their header has none or a wrong one.")
]
VerticalUnit = Annotated[
    str | None, typer.Option(metavar="UNIT", help="Unit of elevations: m, ft or us-ft; default as the header says.")
]
Workers = Annotated[
    int, typer.Option(min=0, help="Processes of the embedded cluster; 0 runs serially in this process.")
]
Method = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD",
        help="fuzzy-sart, parameter-space-2d, parameter-space-3d or kmeans; default as the settings say.",
    ),
]
Footprints = Annotated[
    str | None, typer.Option(metavar="FILE", help="Building outlines (GeoPackage, GeoJSON, Shapefile) to model.")
]
Bbox = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(metavar="XMIN YMIN XMAX YMAX", help="Only this rectangle, in the CRS's units."),
]
Aoi = Annotated[
    str | None, typer.Option(metavar="FILE", help="Only what lies inside the polygons of this vector file.")
]
Classes = Annotated[
    Literal["trust", "audit", "ignore"] | None,
    typer.Option(help="What the file's own classes are worth; default as the settings say."),
]
SettingsFile = Annotated[str | None, typer.Option(metavar="FILE", help="Settings as TOML; docs/reference/settings.md.")]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler to use in place of the embedded cluster.")
]
Meshes = Annotated[Literal["building", "tile", "none"], typer.Option(help="One OBJ a building, one a tile, or none.")]
Licence = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Licence of the source data, written into the results.")
]
Truth = Annotated[
    str | None, typer.Option(metavar="DIR", help="The truth that simulate wrote: measure the models against it.")
]
Points = Annotated[
    list[str] | None,
    typer.Option(metavar="TILE", help="A classified tile to measure against; several by several --points."),
]
AsSurveyed = Annotated[
    bool, typer.Option("--as-surveyed", help="Move each true building by the shift of the strips that saw it.")
]
Isolate = typer.Option(
    "--isolate/--no-isolate",
    help="Model buildings in a supervised child process, so that a bad one costs only itself.",
)
BuildingTimeout = Annotated[
    float, typer.Option(metavar="S", help="Seconds that a building may take in its child process.")
]
BuildingMemory = Annotated[
    float, typer.Option(metavar="GIB", help="Memory that a building's child process may take, in GiB.")
]
BUILDING_TIMEOUT_S, BUILDING_MEMORY_GIB = 600.0, 4.0
"""Defaults of `pipeline.runtime.isolation.IsolationLimits`, which is too slow to import for `--help`."""

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a run that is already there.")]


def _version(wanted: bool) -> None:
    if wanted:
        from pipeline import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def gablework(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Building models from raw airborne LiDAR."""
    del version


@app.command()
def reconstruct(
    tiles: Annotated[
        list[str], typer.Argument(metavar="TILES", help="LAS, LAZ, COPC, PLY or ASCII files, or folders of them.")
    ],
    out: Annotated[str, typer.Option(metavar="RUN", help="The run directory to write.")],
    method: Method = None,
    preset: Annotated[
        Literal["robust", "faithful"] | None,
        typer.Option(help="Settings of the method that measured better, or that keep to its paper."),
    ] = None,
    footprints: Footprints = None,
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
    bbox: Bbox = None,
    aoi: Aoi = None,
    classes: Classes = None,
    settings: SettingsFile = None,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    meshes: Meshes = "building",
    licence: Licence = None,
    overwrite: Overwrite = False,
    isolate: Annotated[bool | None, Isolate] = None,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct buildings from tiles into a run directory."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.runtime.run import RunRequest, run

        request = RunRequest(
            inputs=tuple(tiles),
            out=out,
            settings=_run_settings(settings, method=method, preset=preset, classes=classes),
            footprints=footprints,
            crs=crs,
            vertical_unit=vertical_unit,
            bbox=bbox,
            aoi=aoi,
            workers=workers,
            scheduler=scheduler,
            meshes=meshes,
            licence=licence,
            overwrite=overwrite,
            isolate=isolate,
            building_timeout_s=building_timeout,
            building_memory_bytes=round(building_memory * 2**30),
        )
        summary = run(request, console.on_event)
        show_summary(console, summary)
        console.document(dataclasses.asdict(summary))
        if summary.failed_tiles:
            raise typer.Exit(ExitCode.TILES_FAILED)


@app.command()
def compare(
    tiles: Annotated[
        list[str], typer.Argument(metavar="TILES", help="LAS, LAZ, COPC, PLY or ASCII files, or folders of them.")
    ],
    methods: Annotated[
        list[str],
        typer.Option(metavar="M1,M2,…", help="METHOD or METHOD:PRESET, two or more; preset robust or faithful."),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: a run a method, and the page.")],
    footprints: Footprints = None,
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
    bbox: Bbox = None,
    aoi: Aoi = None,
    classes: Classes = None,
    settings: SettingsFile = None,
    truth: Truth = None,
    points: Points = None,
    as_surveyed: AsSurveyed = False,
    workers: Workers = 2,
    scheduler: Scheduler = None,
    meshes: Meshes = "none",
    licence: Licence = None,
    overwrite: Overwrite = False,
    isolate: Annotated[bool | None, Isolate] = None,
    building_timeout: BuildingTimeout = BUILDING_TIMEOUT_S,
    building_memory: BuildingMemory = BUILDING_MEMORY_GIB,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Model the same candidates by several methods and write one page on what came out."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.evaluation.chapters import chapters
        from pipeline.evaluation.files import EvaluationRequest
        from pipeline.report.compare_files import compare_files, comparison_facts
        from pipeline.report.evaluation_page import headline
        from pipeline.runtime.compare import CompareRequest, own_tables, parse_variants
        from pipeline.runtime.run import RunRequest
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
                crs=crs,
                vertical_unit=vertical_unit,
                bbox=bbox,
                aoi=aoi,
                workers=workers,
                scheduler=scheduler,
                meshes=meshes,
                licence=licence,
                overwrite=overwrite,
                isolate=isolate,
                building_timeout_s=building_timeout,
                building_memory_bytes=round(building_memory * 2**30),
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
                crs=crs,
                vertical_unit=vertical_unit,
                as_surveyed=as_surveyed,
            )
        made = compare_files(request, reference, console.on_event)
        facts = comparison_facts(request, made.summary)
        names = ("ok", "fallback", "failed")
        rows = [
            (
                told["label"],
                *(told["statuses"].get(name, 0) for name in names),
                told["counts"]["roof_faces"],
                f"{1e3 * told['seconds_a_building'].get('median', 0.0):.1f} ms",
            )
            for told in facts["variants"]
        ]
        console.table("Methods", ["method", *names, "roof faces", "a building (median)"], rows)
        found = {label: headline(chapters(evaluation)) for label, evaluation in made.evaluations.items()}
        if found:
            values = {label: {line.label: line.value for _, line in lines} for label, lines in found.items()}
            measures = [line.label for _, line in next(iter(found.values()))]
            compared = [(name, *(values[label].get(name, "") for label in values)) for name in measures]
            console.table("Against the reference", ["measure", *values], compared)
        for path in made.written:
            console.say(f"wrote {path}")
        console.document(facts | {"out": made.summary.out, "written": [str(path) for path in made.written]})
        if any(run.failed_tiles for run in made.summary.runs.values()):
            raise typer.Exit(ExitCode.TILES_FAILED)


def _run_settings(path: str | None, **overrides: str | None) -> RunSettings:
    """The settings of a file, or the defaults, under the options of the command line."""
    from pipeline.settings import RunSettings

    given = {name: value for name, value in overrides.items() if value is not None}
    return RunSettings.from_toml(path, given)


def show_summary(console: Console, summary: RunSummary) -> None:
    """What a run found, as tables or as the JSON document."""
    from pipeline.report.table import run_statistics, statistics_tables

    for table in statistics_tables(run_statistics(summary.run_dir)):
        console.show(table)
    console.table(
        "Time", ["stage", "wall clock"], [(k, f"{seconds:.1f} s") for k, seconds in summary.timings_s.items()]
    )
    points, tiles = summary.counts["points"], summary.counts["tiles"]
    largest = max(summary.peak_memory_bytes.values(), default=0) / 2**30
    console.say(f"{points} points, tiles: {tiles}, peak memory of a process: {largest:.2f} GiB")
    for tile in summary.failed_tiles:
        console.warn(f"tile {tile} failed")
    console.say(f"content sha256 {summary.digest}")
    console.say(f"results are in {summary.run_dir}")


@app.command()
def inspect(
    tile: Annotated[str, typer.Argument(metavar="TILE", help="A LAS, LAZ, COPC, PLY or ASCII file.")],
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell what a tile holds and roughly what it takes; reads it once, streamed."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.inspection import inspect as inspect_tile
        from pipeline.io.source import ReadOptions
        from pipeline.runtime.events import Event

        def on_progress(done: int, total: int) -> None:
            console.on_event(Event(kind="progress", stage="read", done=done, total=total))

        found = inspect_tile(tile, ReadOptions(crs=crs, vertical_unit=vertical_unit), on_progress)
        for warning in found.warnings:
            console.warn(warning)
        console.table(tile, ["fact", "value"], found.rows())
        shares = [[n, count, f"{100.0 * count / found.used_points:.1f} %"] for n, count in found.classes.items()]
        console.table("Classes", ["class", "points", "share"], shares)
        console.document(dataclasses.asdict(found))


@app.command()
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


@app.command()
def simulate(
    suite: Annotated[
        str,
        typer.Argument(metavar="SUITE", help="suburb, town, cube, hofmann310, sweep, city or one of the roof shapes."),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: LAZ tiles and the truth beside them.")],
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="Of layout and scanner; default the suite's own.")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(metavar="dev|test", help="In place of --seed: methods are tuned on dev and reported on test."),
    ] = None,
    draw: Annotated[int, typer.Option(metavar="N", help="Which scene of the split, counted from 0.")] = 0,
    size: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="EAST NORTH", help="Extent in metres; default the suite's own."),
    ] = None,
    density: Annotated[
        float | None, typer.Option(metavar="D", help="Pulses a square metre; of sweep, which cells.")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(metavar="M", help="Range noise in metres; of sweep, which cells.")
    ] = None,
    with_classes: Annotated[bool, typer.Option("--with-classes", help="Write the true classes into the tile.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a scene as LAZ tiles, with the exact truth beside them."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.errors import SettingsError
        from pipeline.runtime.events import Event
        from pipeline.synthetic.dataset import simulate as simulate_scene
        from pipeline.synthetic.seeds import seed_of

        if split is None and draw != 0:
            raise SettingsError([f"draw is {draw} of no split: give --split dev or --split test with it"])
        if split is not None and seed is not None:
            raise SettingsError([f"both --seed {seed} and --split {split} are given: use one of them"])
        paths = simulate_scene(
            suite,
            out,
            seed if split is None else seed_of(split, draw),
            size_m=size,
            density_per_m2=density,
            noise_m=noise,
            with_classes=with_classes,
            on_points=lambda n: console.on_event(Event(kind="progress", stage="scan", done=n)),
        )
        console.say(f"{paths.points} points of {paths.buildings} buildings in {paths.laz}, the truth in {paths.truth}")
        console.document(dataclasses.asdict(paths))


@app.command(name="warm-up")
def warm_up(as_json: AsJson = False, quiet: Quiet = False) -> None:
    """Compile the numba kernels, by a small simulated run in this process."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from tempfile import TemporaryDirectory

        from pipeline.runtime.modelling import load
        from pipeline.runtime.run import RunRequest, run
        from pipeline.synthetic.dataset import simulate as simulate_scene

        with TemporaryDirectory(prefix="gablework-") as folder:
            started = time.perf_counter()
            scene = simulate_scene("gable", f"{folder}/scene")
            request = RunRequest(inputs=(str(scene.laz),), out=f"{folder}/run", workers=0)
            summary = run(request, console.on_event)
            load()  # the other methods, too
            seconds = time.perf_counter() - started
        console.say(f"kernels compiled and one building modelled in {seconds:.1f} s")
        console.document({"seconds": seconds, "statuses": summary.statuses})


@app.command()
def evaluate(
    models: Annotated[
        str, typer.Argument(metavar="MODELS", help="A run directory; CityJSON, CityJSONSeq or OBJ of any program.")
    ],
    truth: Truth = None,
    points: Points = None,
    footprints: Annotated[
        str | None, typer.Option(metavar="FILE", help="Building outlines that go with the points.")
    ] = None,
    ground: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="The same points as some program classified them: judge its ground."),
    ] = None,
    crs: Crs = None,
    vertical_unit: VerticalUnit = None,
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
) -> None:
    """Measure models: against simulated truth, against classified points, or by themselves."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.evaluation.files import EvaluationRequest, evaluate_files
        from pipeline.runtime.events import Event

        request = EvaluationRequest(
            models=models,
            truth=truth,
            points=tuple(points or ()),
            footprints=footprints,
            ground=tuple(ground or ()),
            crs=crs,
            vertical_unit=vertical_unit,
            as_surveyed=as_surveyed,
            blocks=blocks,
        )

        def on_step(name: str) -> None:
            console.on_event(Event(kind="stage", stage=name))

        evaluation = evaluate_files(request, on_step)
        document = show_evaluation(console, evaluation)
        if out is not None:
            from pipeline.evaluation.writing import write_tables
            from pipeline.report.evaluation_page import write_page

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
    from pipeline.evaluation.chapters import chapters
    from pipeline.evaluation.writing import all_notes, measures_table

    document: dict[str, Any] = {"models": evaluation.models.path, "notes": list(all_notes(evaluation))}
    if evaluation.models.kind == "run":
        from pipeline.report.table import run_statistics, statistics_tables

        document["statistics"] = run_statistics(evaluation.models.path)
        for table in statistics_tables(document["statistics"]):
            console.show(table)
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


@app.command()
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
        from pipeline.runtime.bundle import read_bundle
        from pipeline.runtime.isolation import IsolationLimits
        from pipeline.runtime.replay import replay as replay_building
        from pipeline.runtime.replay import replay_row, write_replay

        limits = IsolationLimits(timeout_s=building_timeout, memory_bytes=round(building_memory * 2**30))
        found = read_bundle(bundle)
        if found.incident.engine_version != __version__:
            console.warn(f"it happened to gablework {found.incident.engine_version}; this is {__version__}")
        console.say(f"{found.candidate.building_id} in its run: {found.incident.reason}, {found.incident.detail}")
        replayed = replay_building(found, limits if isolate else None)
        row = replay_row(found, replayed)
        console.table("This time", ["column", "value"], [(name, value) for name, value in row.items() if value != []])
        if replayed.loss is not None and replayed.loss.stderr:
            console.say(f"its process said last:\n{replayed.loss.stderr}")
        written = [str(path) for path in write_replay(out, found, replayed)] if out is not None else []
        for path in written:
            console.say(f"wrote {path}")
        incident = dataclasses.asdict(found.incident)
        stderr = "" if replayed.loss is None else replayed.loss.stderr
        console.document({"incident": incident, "record": dict(row), "stderr": stderr, "written": written})
        if row["status"] == "failed":
            raise typer.Exit(ExitCode.TILES_FAILED)


@app.command()
def demo(
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder of everything the demo makes.")] = "demo",
    size: Annotated[
        tuple[float, float] | None, typer.Option(metavar="EAST NORTH", help="Extent of the suburb in metres.")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Of the suburb; default its own.")] = None,
    workers: Workers = 2,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a small suburb, reconstruct it, measure it against the truth, draw it."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.demo import demonstrate
        from pipeline.evaluation.chapters import chapters
        from pipeline.evaluation.writing import measures_table
        from pipeline.report.evaluation_page import headline

        made = demonstrate(out, console.on_event, workers=workers, overwrite=overwrite, size_m=size, seed=seed)
        show_summary(console, made.summary)
        decisive = headline(chapters(made.evaluation))
        rows = [(line.label, line.value, line.interval, line.n) for _, line in decisive]
        console.table("Against the truth", ["measure", "value", "95 % interval", "n"], rows)
        console.say("Where to look:")
        places = [
            ("picture", made.picture),
            ("report", made.page),
            ("run directory", made.summary.run_dir),
            ("meshes (OBJ)", f"{made.summary.run_dir}/meshes"),
            ("tables (GeoParquet)", f"{made.summary.run_dir}/buildings"),
            ("the tile", made.scene.laz),
            ("the truth", made.scene.truth),
        ]
        console.table("", ["what", "where"], places)
        told = {"measures": measures_table(made.evaluation).to_pylist(), "picture": str(made.picture)}
        console.document(dataclasses.asdict(made.summary) | told)


@app.command()
def worker(
    scheduler: Annotated[str, typer.Option(metavar="ADDRESS", help="The Dask scheduler, as tcp://host:8786.")],
    threads: Annotated[int, typer.Option(min=1, help="Tasks at once.")] = 1,
    memory_limit: Annotated[
        str, typer.Option(metavar="BYTES", help="Memory of the process, such as 4GiB; auto, or 0 for none.")
    ] = "auto",
    local_directory: Annotated[
        str | None, typer.Option(metavar="DIR", help="Where the worker keeps its own files; default temporary.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name in the scheduler's lists; default its address.")] = None,
    host: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="To listen on; default what leads to the scheduler.")
    ] = None,
    drain_timeout: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="Longest wait for running tasks at the end; default none.")
    ] = None,
    give_up_after: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="End when the scheduler was away so long; default never.")
    ] = None,
) -> None:
    """Work for a Dask scheduler; on SIGTERM finish what runs, then leave."""
    with Console() as console:
        from pipeline.runtime.worker import WorkerOptions, serve_worker

        options = WorkerOptions(
            scheduler=scheduler,
            threads=threads,
            memory_limit=memory_limit,
            local_directory=local_directory,
            name=name,
            host=host,
            drain_timeout_s=drain_timeout,
            give_up_after_s=give_up_after,
        )
        serve_worker(options, console.say)
