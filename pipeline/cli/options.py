"""The options that several commands share."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from pipeline.runtime.cluster.tls import TlsFiles

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; events as JSON lines on stderr.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress; warnings and errors only.")]
Crs = Annotated[
    str | None, typer.Option(metavar="EPSG:n", help="The inputs' CRS, if their header has none or a wrong one.")
]
VerticalUnit = Annotated[
    str | None, typer.Option(metavar="UNIT", help="Unit of elevations: m, ft or us-ft; default from the header.")
]
AllowOutside = Annotated[
    bool,
    typer.Option("--allow-outside-area-of-use", help="Accept tiles that lie far outside the area of use of their CRS."),
]
AUTO = "auto"
"""The word for as many workers as the job needs and the machine has."""
_MAX_WORKERS = 1024


def count_or_auto(text: str, *, least: int) -> str:
    """The word of an option for workers: `auto`, or a number without leading zeros; raises BadParameter for others.

    Examples
    --------
    >>> count_or_auto("02", least=1), count_or_auto("auto", least=1)
    ('2', 'auto')
    """
    if text == AUTO:
        return AUTO
    if text.isdecimal() and least <= int(text) <= _MAX_WORKERS:
        return str(int(text))
    raise typer.BadParameter(f"{text!r}: use {AUTO}, or a whole number from {least} to {_MAX_WORKERS}")


def worker_count(text: str) -> int | None:
    """The number of workers in an option; 0 for none, None for `auto`. Raises BadParameter as `count_or_auto`."""
    word = count_or_auto(text, least=0)
    return None if word == AUTO else int(word)


Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N|auto",
        parser=worker_count,
        show_default=AUTO,
        help="Processes of the embedded cluster; 0 runs serially in this process, auto starts a cluster for large "
        "jobs only.",
    ),
]
Method = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD",
        help="arrangement, fuzzy-sart, parameter-space-2d, parameter-space-3d or kmeans; default from the settings.",
    ),
]
Lods = Annotated[
    str | None,
    typer.Option(
        metavar="L1,L2,…", help="Levels of detail to write: 1.2, 1.3, 2.2, 2.3, or several; default from the settings."
    ),
]
Footprints = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        help="Building outlines to model: GeoPackage, GeoJSON, Shapefile and others; docs/reference/formats.md.",
    ),
]
Layer = Annotated[
    str | None, typer.Option(metavar="NAME", help="Layer of the footprints, where their file has several.")
]
Guides = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Lines of roofs (ridges, eaves, ...) that models follow; docs/how_to/guides.md."),
]
Bbox = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(metavar="XMIN YMIN XMAX YMAX", help="Only this rectangle, in the CRS's units."),
]
Aoi = Annotated[str | None, typer.Option(metavar="FILE", help="Only the area inside the polygons of this vector file.")]
Classes = Annotated[
    Literal["trust", "audit", "ignore"] | None,
    typer.Option(help="How to use the file's own classes; default from the settings."),
]
SettingsFile = Annotated[str | None, typer.Option(metavar="FILE", help="Settings as TOML; docs/reference/settings.md.")]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler to use in place of the embedded cluster.")
]
TlsCa = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="CA of the cluster's certificates, PEM; default GABLEWORK_TLS_CA."),
]
TlsCert = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="This process's certificate for the cluster; default GABLEWORK_TLS_CERT."),
]
TlsKey = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Its key, unless in the same file; default GABLEWORK_TLS_KEY."),
]


def tls_files(ca: str | None, cert: str | None, key: str | None) -> TlsFiles | None:
    """The files of these three options or of the environment; None if there are none. Raises SettingsError."""
    if not any((ca, cert, key)) and not any(name.startswith("GABLEWORK_TLS_") for name in os.environ):
        return None
    from pipeline.runtime.cluster.tls import given_tls

    return given_tls(ca, cert, key)


PerformanceReport = Annotated[
    str | None, typer.Option(metavar="FILE", help="Write a page (HTML) about the workers' time.")
]
MetricsPort = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, max=65535, help="Show metrics for Prometheus on this port, at /metrics."),
]
MetricsHost = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Address of these metrics: anyone who reaches it can read them.")
]
LogJson = Annotated[bool, typer.Option("--log-json", help="Log one JSON object per line, like GABLEWORK_LOG_JSON=1.")]
Scratch = Annotated[
    str | None,
    typer.Option(
        metavar="DIR",
        help="Folder for intermediate results, the same for all workers; default beside the results.",
    ),
]
Meshes = Annotated[
    Literal["building", "tile", "glb", "none"],
    typer.Option(help="One OBJ per building, one OBJ per tile, one GLB per tile, or none."),
]
WithPoints = Annotated[
    bool, typer.Option("--points", help="Also write the points as 3D Tiles, with their distances to the models.")
]
Terrain = Annotated[
    Literal["none", "tin"] | None,
    typer.Option(help="Also write the terrain: triangles with the buildings cut out; default from the settings."),
]
Licence = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Licence of the source data, written into the results.")
]
Truth = Annotated[
    str | None, typer.Option(metavar="DIR", help="The truth that simulate wrote: measure the models against it.")
]
Points = Annotated[
    list[str] | None,
    typer.Option(metavar="TILE", help="A classified tile to measure against; repeat --points for several."),
]
AsSurveyed = Annotated[
    bool, typer.Option("--as-surveyed", help="Move each true building by the shift of the strips that saw it.")
]
Isolate = typer.Option(
    "--isolate/--no-isolate",
    help="Model buildings in a supervised child process, so a bad one harms no other.",
)
BuildingTimeout = Annotated[
    float, typer.Option(metavar="S", help="Seconds that a building may take in its child process.")
]
BuildingMemory = Annotated[
    float, typer.Option(metavar="GIB", help="Memory that a building's child process may take, in GiB.")
]
InputTimeout = Annotated[
    float, typer.Option(metavar="S", help="Seconds within which some more of an input must be read.")
]
INPUT_TIMEOUT_S = 600.0
"""Default of `pipeline.io.reading`."""
BUILDING_TIMEOUT_S, BUILDING_MEMORY_GIB = 600.0, 4.0
"""Defaults of `pipeline.runtime.isolation.isolated_items.IsolationLimits`, which is too slow to import for `--help`."""

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")]
