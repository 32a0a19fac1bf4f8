"""The command that compares two runs of one place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipeline.cli.command_options import AsJson, Quiet
from pipeline.console import Console

if TYPE_CHECKING:
    from pipeline.ruler.epochs.diff import Diff


def diff(
    old: Annotated[str, typer.Argument(metavar="OLD", help="Run directory of the earlier epoch, a folder or a URL.")],
    new: Annotated[str, typer.Argument(metavar="NEW", help="Run directory of the later epoch, a folder or a URL.")],
    out: Annotated[
        str,
        typer.Option(metavar="DIR", help="Folder or URL of changes.parquet, .geojson, .json and .html."),
    ],
    settings: Annotated[
        str | None, typer.Option(metavar="FILE", help="Thresholds as TOML; docs/reference/changes.md.")
    ] = None,
    min_height_change: Annotated[
        float | None, typer.Option(metavar="M", help="Least difference of roofs' elevations that counts.")
    ] = None,
    min_area_change: Annotated[
        float | None, typer.Option(metavar="M2", help="Least plan area of a changed part that counts.")
    ] = None,
    min_width: Annotated[float | None, typer.Option(metavar="M", help="Narrower parts do not count.")] = None,
    vertical_shift: Annotated[
        float | None,
        typer.Option(metavar="M", help="Known difference of the epochs' elevations, NEW less OLD, that is no change."),
    ] = None,
    geojson: Annotated[
        Literal["changed", "all", "none"], typer.Option(help="Which rows changes.geojson holds.")
    ] = "changed",
    page: Annotated[bool, typer.Option("--page/--no-page", help="Write changes.html.")] = True,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell new, gone, raised, lowered, reshaped and unchanged buildings between two runs of one place."""
    with Console(as_json=as_json, quiet=quiet) as console:
        from pipeline.io.places import made_here, place_below
        from pipeline.ruler.epochs.diff import DiffRequest, refuse_run_as_out
        from pipeline.ruler.epochs.diff import diff as compare_runs
        from pipeline.ruler.epochs.epoch_settings import read_settings
        from pipeline.ruler.report.epochs_map import epochs_map, gathering
        from pipeline.ruler.report.epochs_page import write_page
        from pipeline.runtime.monitoring.progress import Event

        chosen = read_settings(
            settings,
            {
                "min_height_change_m": min_height_change,
                "min_area_change_m2": min_area_change,
                "min_width_m": min_width,
                "vertical_shift_m": vertical_shift,
            },
        )

        def on_part(done: int, total: int) -> None:
            console.on_event(Event(kind="progress", stage="compare", done=done, total=total))

        refuse_run_as_out(out, (old, new))
        drawn = epochs_map()
        with made_here(out) as folder:
            found = compare_runs(
                DiffRequest(old=old, new=new, out=folder, settings=chosen, geojson=geojson),
                on_part,
                take_in=(gathering(drawn),) if page else (),
            )
            written = [*found.written]
            if page:
                console.on_event(Event(kind="stage", stage="page"))
                written.append(write_page(found, drawn))
        places = [place_below(out, path.name) for path in written]
        _show(console, found)
        for place in places:
            console.say(f"written: {place}")
        console.document(found.as_dict() | {"written": places})


def _show(console: Console, found: Diff) -> None:
    """The sums as tables, and the warnings."""
    from pipeline.ruler.epochs.change_records import INCOMPARABLE

    for warning in found.warnings:
        console.warn(warning)
    sums = found.summary.as_dict()
    rows = [
        (
            name.replace("_", " "),
            one["rows"],
            one["without_doubt"],
            f"{one['added_m2'] - one['removed_m2']:+,.0f} m2",
            f"{one['gained_m3']:,.0f} m3",
            f"{one['lost_m3']:,.0f} m3",
        )
        for name, one in sums["changes"].items()
    ]
    console.table("Changes", ["what", "rows", "without doubt", "plan area", "gained", "lost"], rows)
    reasons = {one.value: text for one, text in INCOMPARABLE.items()}
    console.table(
        "Not comparable", ["rows", "why"], [(count, reasons[name]) for name, count in sums["reasons"].items()]
    )
