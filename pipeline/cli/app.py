"""The application of the command line, and the options before every command."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(
    name="gablework",
    help="Building models from raw airborne LiDAR: it needs neither classes nor footprints, and uses both when given.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich would triple the time until help shows
)


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
