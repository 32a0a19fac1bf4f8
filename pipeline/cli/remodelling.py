"""Commands that model single buildings of a run again."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Quiet, takes_options
from pipeline.console import Console, ExitCode
from pipeline.runtime.isolation.preloading import start_early


@takes_options("rerun")
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
    as_json: AsJson = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Model single buildings of a run again, after other overrides; all others stay untouched."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.overrides.earlier import earlier_run, request_of
        from pipeline.extras.overrides.rerun import RerunRequest
        from pipeline.extras.overrides.rerun import rerun as rerun_buildings
        from pipeline.runtime.compiling import compile_for, kernel_groups
        from pipeline.runtime.resources import resources_of

        resources = resources_of(given)
        request = RerunRequest(run_dir=run_dir, overrides=overrides, only=tuple(only or ()), resources=resources)
        earlier = request_of(earlier_run(run_dir).manifest)
        general = earlier.settings.general
        groups = kernel_groups(method=general.method, terrain=general.terrain)
        compile_for(console.on_event, groups, earlier.inputs, (overrides,), scheduler=resources.scheduler)
        start_early("reconstruct", resources, method=general.method)
        summary = rerun_buildings(request, console.on_event)
        console.table("Made again", ["building", "status"], list(summary.buildings.items()))
        console.say(f"{len(summary.buildings)} buildings, {len(summary.tiles)} tiles written, {summary.seconds:.1f} s")
        console.say(f"content sha256 {summary.digest}")
        console.document(dataclasses.asdict(summary))


@takes_options("replay", isolate=True)
def replay(
    bundle: Annotated[str, typer.Argument(metavar="BUNDLE", help="A file of a run's quarantine folder.")],
    out: Annotated[
        str | None, typer.Option(metavar="DIR", help="Write the record, and the model as OBJ and CityJSON, here.")
    ] = None,
    as_json: AsJson = False,
    **given: Any,
) -> None:
    """Model one quarantined building again, from its bundle alone."""
    with Console(as_json=as_json) as console:
        from pipeline import __version__
        from pipeline.io.places import on_this_machine
        from pipeline.runtime.isolation.replay_bundle import read_bundle
        from pipeline.runtime.replay_building import replay as replay_building
        from pipeline.runtime.replay_building import replay_row, write_replay
        from pipeline.runtime.resources import resources_of

        limits = resources_of(given).isolation
        with on_this_machine(bundle) as file:
            found = read_bundle(str(file))
        if found.incident.engine_version != __version__:
            console.warn(f"it happened to gablework {found.incident.engine_version}; this is {__version__}")
        console.say(f"{found.candidate.building_id} in its run: {found.incident.reason}, {found.incident.detail}")
        replayed = replay_building(found, limits)
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
