"""The group of commands for batch runs."""

from __future__ import annotations

import typer

from pipeline.cli.batching import plan, run, status

batch = typer.Typer(
    name="batch",
    help="City-scale runs from one file: planned, watched, resumed, done again for what changed only.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
for _command in (plan, run, status):
    batch.command()(_command)
