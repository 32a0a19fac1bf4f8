"""The command that publishes a run for other programs."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

import typer

from pipeline.cli.options import AsJson, Quiet
from pipeline.console import Console


def publish(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A finished run directory, a folder or a URL.")],
    form: Annotated[
        Literal["geopackage", "cityjson", "pmtiles", "stac"],
        typer.Option(
            "--as",
            help="geopackage: one file with layers and styles, for GIS. cityjson: a folder, one file per tile. "
            "pmtiles: one file with footprints, for maps on the web. stac: a folder, a catalogue of the run.",
        ),
    ],
    out: Annotated[
        str, typer.Option(metavar="PATH", help="The file, which ends in .gpkg or .pmtiles, or the folder to write.")
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a finished run as files that other programs open. The run stays as it is."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.runtime.publishing import publish_cityjson, publish_geopackage, publish_pmtiles, publish_stac

        forms = {
            "geopackage": publish_geopackage,
            "cityjson": publish_cityjson,
            "pmtiles": publish_pmtiles,
            "stac": publish_stac,
        }
        published = forms[form](run, out, overwrite=overwrite, on_event=console.on_event)
        console.table("Written", ["what", "rows"], list(published.rows.items()))
        console.say(f"{published.place}, {published.size_bytes / 1e6:.1f} MB")
        console.document({"run": run, "as": form, **dataclasses.asdict(published)})
