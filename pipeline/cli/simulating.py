"""Commands that simulate scenes."""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Overwrite, Quiet, takes_options
from pipeline.cli.run_summary import show_summary
from pipeline.console import Console


def simulate(
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE",
            help="suburb, town, cube, hofmann310, sweep, city, low_buildings, bridges_and_vans, wide_halls, "
            "outline_shapes, broken_slopes, curved_roofs, trust or one of the roof shapes.",
        ),
    ],
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder to write: LAZ tiles and the truth beside them.")],
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="Seed of layout and scanner; default the suite's own.")
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
        float | None, typer.Option(metavar="D", help="Pulses per square metre; for sweep and trust, which cells.")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(metavar="M", help="Range noise in metres; for sweep and trust, which cells.")
    ] = None,
    with_classes: Annotated[bool, typer.Option("--with-classes", help="Write the true classes into the tile.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a scene as LAZ tiles, with the exact truth beside them."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.errors import SettingsError
        from pipeline.ruler.simulation.dataset import Output
        from pipeline.ruler.simulation.dataset import simulate as simulate_scene
        from pipeline.ruler.simulation.seeds import seed_of
        from pipeline.runtime.monitoring.progress import Event

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
            output=Output(
                with_classes=with_classes,
                on_points=lambda n: console.on_event(Event(kind="progress", stage="scan", done=n)),
            ),
        )
        console.say(f"{paths.points} points of {paths.buildings} buildings in {paths.laz}, the truth in {paths.truth}")
        console.document(dataclasses.asdict(paths))


@takes_options("demo")
def demo(
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder of everything the demo makes.")] = "demo",
    size: Annotated[
        tuple[float, float] | None, typer.Option(metavar="EAST NORTH", help="Extent of the suburb in metres.")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of the suburb; default its own.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Simulate a small suburb, reconstruct it, measure it against the truth, draw it."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.demo import demonstrate
        from pipeline.ruler.evaluation.chapters import chapters
        from pipeline.ruler.evaluation.evaluation_writing import measures_table
        from pipeline.ruler.report.evaluation_page import headline
        from pipeline.runtime.compiling import RECONSTRUCT, compile_first
        from pipeline.runtime.isolation.preloading import start_early
        from pipeline.runtime.resources import resources_of

        compile_first(console.on_event, (*RECONSTRUCT, "simulate", "evaluate"))
        start_early("reconstruct", resources_of(given))
        made = demonstrate(out, console.on_event, workers=given["workers"], overwrite=overwrite, size_m=size, seed=seed)
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
        document = {"measures": measures_table(made.evaluation).to_pylist(), "picture": str(made.picture)}
        console.document(dataclasses.asdict(made.summary) | document)


def warm_up(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="WHAT",
            help="Commands to compile for: reconstruct, simulate, evaluate, classify, terrain, compare, diff, solar or "
            "all; default reconstruct by the default method.",
        ),
    ] = None,
    into: Annotated[
        str | None,
        typer.Option(
            metavar="DIR", help="Copy all compiled kernels there, with a list of their hashes, for a package."
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compile numba kernels ahead of their first use, on all cores."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pathlib import Path

        from pipeline.compiler import warm_up
        from pipeline.errors import SettingsError
        from pipeline.runtime.monitoring.measurement import cores
        from pipeline.runtime.monitoring.progress import Event

        groups = warm_up.groups()
        wanted = what or ["reconstruct"]
        unknown = [name for name in wanted if name not in {*groups, "all"}]
        if unknown:
            raise SettingsError([f"{name!r} is not known: use {', '.join(groups)} or all" for name in unknown])
        started = time.perf_counter()

        def on_progress(done: int, total: int, left_s: float) -> None:
            left = f"about {left_s:.0f} s left" if done < total else ""
            console.on_event(Event(kind="progress", stage="compile", done=done, total=total, message=left))

        kernels = warm_up.listed(None if "all" in wanted else wanted)
        console.on_event(Event(kind="stage", stage="compile", total=len(kernels)))
        warm_up.compile_kernels(kernels, cores(), on_progress)
        if into is not None:
            warm_up.ship(Path(into))
        seconds = time.perf_counter() - started
        console.say(f"{len(kernels)} kernels are compiled; it took {seconds:.1f} s")
        console.document({"seconds": seconds, "kernels": len(kernels)})
