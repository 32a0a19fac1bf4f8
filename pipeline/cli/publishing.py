"""The command that publishes a run for other programs."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipeline.cli.options import AsJson, Quiet
from pipeline.console import Console
from pipeline.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.extras.publish.publishing import Published
    from pipeline.model import Status


def publish(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A finished run directory, a folder or a URL.")],
    form: Annotated[
        Literal["geopackage", "cityjson", "pmtiles", "stac", "3dtiles"],
        typer.Option(
            "--as",
            help="geopackage: one file with layers and styles, for GIS. cityjson: a folder, one file per tile. "
            "pmtiles: one file with footprints, for maps on the web. stac: a folder, a catalogue of the run. "
            "3dtiles: a folder with a tileset, for globes such as CesiumJS.",
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
        from pipeline.extras.publish.publishing import (
            path_outside,
            publish_cityjson,
            publish_geopackage,
            publish_pmtiles,
            publish_stac,
        )
        from pipeline.extras.publish.selection import run_of

        forms = {
            "geopackage": publish_geopackage,
            "cityjson": publish_cityjson,
            "pmtiles": publish_pmtiles,
            "stac": publish_stac,
        }
        if geoid_height is not None and form != "3dtiles":
            raise SettingsError([f"--geoid-height {geoid_height:g} is for --as 3dtiles alone: leave it out"])
        wanted = _statuses(statuses or [])
        if wanted and form == "stac":
            raise SettingsError([f"--status {','.join(wanted)} cannot be used with --as stac: leave it out"])
        path_outside(run, out, "what is published is")
        with run_of(run, wanted) as source:
            if form == "3dtiles":
                published: Published = _tiles(console, source, out, overwrite, geoid_height)
            else:
                published = forms[form](source, out, overwrite=overwrite, on_event=console.on_event)
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


def _tiles(console: Console, run: str, out: str, overwrite: bool, geoid_height: float | None) -> Published:
    """Write 3D Tiles, and say how they were placed."""
    from pipeline.extras.publish_3dtiles.publishing_3dtiles import publish_3dtiles

    published = publish_3dtiles(run, out, overwrite=overwrite, geoid_height_m=geoid_height, on_event=console.on_event)
    facts = published.georeference
    accuracy = "unknown" if facts["accuracy_m"] is None else f"{facts['accuracy_m']:g} m"
    console.say(f"{facts['transformation']}, accuracy {accuracy}")
    added = "" if facts["geoid_height_m"] is None else f" ({facts['geoid_height_m']:+g} m)"
    console.say(f"heights: {facts['heights']}{added}")
    return published
