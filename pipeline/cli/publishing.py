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
        Literal["geopackage"],
        typer.Option("--as", help="geopackage: one file with layers and styles, for QGIS and other GIS."),
    ],
    out: Annotated[str, typer.Option(metavar="FILE", help="The file to write; of a GeoPackage it ends in .gpkg.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a finished run as a file that other programs open. The run stays as it is."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.runtime.publishing import publish_geopackage

        published = publish_geopackage(run, out, overwrite=overwrite, on_event=console.on_event)
        console.table("Layers", ["layer", "rows"], list(published.layers.items()))
        console.say(f"{published.file}, {published.size_bytes / 1e6:.1f} MB")
        console.document({"run": run, "as": form, **dataclasses.asdict(published)})
