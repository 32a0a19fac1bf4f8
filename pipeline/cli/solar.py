"""The command that computes solar energy on roofs."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

from pipeline.cli.command_options import AsJson, Quiet
from pipeline.console import Console
from pipeline.extras.solar.solar_settings import SolarSettings

_DEFAULTS = SolarSettings()


def solar(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A finished run directory, a folder or a URL.")],
    out: Annotated[str, typer.Option(metavar="FILE", help="The file to write, which ends in .parquet.")],
    weather: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="A typical year: EPW, or the CSV of PVGIS. Without it the sky is always clear."
        ),
    ] = None,
    turbidity: Annotated[
        float | None,
        typer.Option(metavar="X", help="Linke turbidity of the clear sky, 1 to 10; default pvlib's map by month."),
    ] = None,
    albedo: Annotated[
        float, typer.Option(metavar="SHARE", help="Share of the light that the ground reflects.")
    ] = _DEFAULTS.albedo,
    reach: Annotated[
        float, typer.Option(metavar="M", help="Buildings within this distance shade a plane.")
    ] = _DEFAULTS.reach_m,
    samples: Annotated[int, typer.Option(metavar="N", help="About so many points of each plane.")] = _DEFAULTS.samples,
    sky_only: Annotated[
        bool, typer.Option("--sky-only", help="Only the view of the sky, without pvlib and without a CRS.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compute each roof plane's view of the sky and its solar energy of a year. The run stays as it is."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.errors import SettingsError
        from pipeline.extras.solar.solar_of_run import solar as write_solar

        if weather is not None and (sky_only or turbidity is not None):
            other = "--sky-only" if sky_only else "--turbidity"
            raise SettingsError([f"--weather {weather} and {other} exclude each other: give one of them"])
        settings = SolarSettings(reach_m=reach, samples=samples, albedo=albedo, linke_turbidity=turbidity)
        written = write_solar(
            run,
            out,
            settings=settings,
            weather=weather,
            sky_only=sky_only,
            overwrite=overwrite,
            on_event=console.on_event,
        )
        console.say(f"{written.rows['planes']} roof planes: {written.place}, {written.size_bytes / 1e6:.1f} MB")
        console.document({"run": run, **dataclasses.asdict(written)})
