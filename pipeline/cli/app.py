"""The command line, built from a table of commands, and the options before every command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import typer

from pipeline.registry import loaded

_HELP = "Building models from raw airborne LiDAR: it needs neither classes nor footprints, and uses both when given."


def _version(wanted: bool) -> None:
    if wanted:
        from pipeline import __version__

        typer.echo(__version__)
        raise typer.Exit


def gablework(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Building models from raw airborne LiDAR."""
    del version


def command_line(table: Mapping[str, str], words: Sequence[str] = ()) -> typer.Typer:
    """The command line with the commands and groups of a table, or with the called one alone.

    Importing and building all takes time.

    Parameters
    ----------
    table : mapping
        By the name of each one, its place as `module:function`, or `module:attribute` of a group.
    words : sequence of str
        The arguments after `gablework`; if the first one is not in the table, all are built.
    """
    made = typer.Typer(
        name="gablework",
        help=_HELP,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # rich would triple the time until help shows
    )
    made.callback()(gablework)
    called = [word for word in words[:1] if word in table]
    for name in called or table:
        command = loaded(table[name])
        if isinstance(command, typer.Typer):
            made.add_typer(command, name=name)
        else:
            made.command(name)(command)
    return made
