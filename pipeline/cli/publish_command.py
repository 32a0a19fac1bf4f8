"""The command that publishes a run for other programs."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli.command_options import AsJson, Quiet
from pipeline.console import Console
from pipeline.errors import SettingsError
from pipeline.extras.publish.publishing import COMMAND_FORMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.extras.publish.finished_run import Published
    from pipeline.model import Status


def publish(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A finished run directory, a folder or a URL.")],
    form: Annotated[
        str,
        typer.Option(
            "--as",
            metavar=f"<{'|'.join(COMMAND_FORMS)}>",
            help=" ".join(f"{name}: {form.words}." for name, form in COMMAND_FORMS.items()),
        ),
    ],
    out: Annotated[
        str, typer.Option(metavar="PATH", help="The file, which ends in .gpkg or .pmtiles, or the folder to write.")
    ],
    statuses: Annotated[
        list[str] | None,
        typer.Option(
            "--status",
            metavar="STATUS",
            help="Only buildings of this status: ok, doubtful, fallback or failed; with commas, or repeated. Rejected "
            "objects stay. Not for stac, which lists the files of the run.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    geoid_height: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="3dtiles: height of the geoid above the ellipsoid, added to elevations. Default: by PROJ, if it has "
            "the grid, else nothing.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a finished run as files that other programs open. The run stays as it is."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.extras.publish.finished_run import path_outside
        from pipeline.extras.publish.selection import run_of

        if form not in COMMAND_FORMS:
            raise SettingsError([f"--as {form!r}: use one of {', '.join(COMMAND_FORMS)}"])
        chosen, options = COMMAND_FORMS[form], {}
        if geoid_height is not None:
            if "geoid_height_m" not in chosen.options:
                raise SettingsError([f"--geoid-height {geoid_height:g} is not for --as {form}: leave it out"])
            options["geoid_height_m"] = geoid_height
        wanted = _statuses(statuses or [])
        if wanted and not chosen.by_status:
            raise SettingsError([f"--status {','.join(wanted)} cannot be used with --as {form}: leave it out"])
        path_outside(run, out)
        with run_of(run, wanted) as source:
            published: Published = chosen.write(source, out, overwrite=overwrite, on_event=console.on_event, **options)
        for sentence in published.sentences:
            console.say(sentence)
        console.table("Written", ["what", "rows"], list(published.rows.items()))
        console.say(f"{published.place}, {published.size_bytes / 1e6:.1f} MB")
        console.document({"run": run, "as": form, "status": wanted, **dataclasses.asdict(published)})


def _statuses(given: Sequence[str]) -> list[Status]:
    """The statuses of `--status`, in their order; raises SettingsError for other words."""
    from pipeline.model import Status

    words = {word.strip() for text in given for word in text.split(",")}
    unknown = sorted(words - set(Status))
    if unknown:
        raise SettingsError([f"--status {unknown[0]!r}: use one of {', '.join(Status)}"])
    return [status for status in Status if status in words]
