"""The command that finds party walls."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

from pipeline.cli.command_options import AsJson, Quiet
from pipeline.console import Console
from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings

_DEFAULTS = PartyWallSettings()


def party_walls(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A finished run directory, a folder or a URL.")],
    out: Annotated[str, typer.Option(metavar="FILE", help="The file of the walls that touch, which ends in .parquet.")],
    buildings: Annotated[
        str | None, typer.Option(metavar="FILE", help="Also a file of the shared and exposed wall area per building.")
    ] = None,
    max_distance: Annotated[
        float, typer.Option(metavar="M", help="Walls touch where they are at most this far apart.")
    ] = _DEFAULTS.max_distance_m,
    max_angle: Annotated[
        float, typer.Option(metavar="DEG", help="Largest angle between their planes.")
    ] = _DEFAULTS.max_angle_deg,
    min_area: Annotated[
        float, typer.Option(metavar="M2", help="Smaller contacts do not count.")
    ] = _DEFAULTS.min_area_m2,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find the walls that neighbouring buildings share, with their area. The run stays as it is."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.party_walls.party_walls_of_run import party_walls as write_party_walls

        settings = PartyWallSettings(max_distance_m=max_distance, max_angle_deg=max_angle, min_area_m2=min_area)
        written = write_party_walls(
            run, out, buildings=buildings, settings=settings, overwrite=overwrite, on_event=console.on_event
        )
        pairs = written.rows["party_walls"]
        console.say(f"{pairs} pairs of walls: {written.place}, {written.size_bytes / 1e6:.1f} MB")
        console.document({"run": run, **dataclasses.asdict(written)})
