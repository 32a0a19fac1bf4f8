"""The group `gablework batch`: runs over whole surveys, and changes between two of them."""

from __future__ import annotations

import typer

from pipeline.cli.batching import plan, run, schedule, status
from pipeline.cli.differing import diff

batch = typer.Typer(
    help="City-scale runs from one file: plan, run, resume, repeat for what changed; list changes between two runs.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
for _command in (plan, run, status, schedule, diff):
    batch.command()(_command)
