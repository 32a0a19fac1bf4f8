"""The outputs of the processes: tables of the files that a finished job offers for download."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from service.errors import NoSuchOutputError

GEOPARQUET = "application/vnd.apache.parquet"
"""Media type of Parquet and GeoParquet."""
CITYJSONSEQ = "application/city+json-seq"
"""Media type of CityJSONSeq: a line of metadata, then one CityJSONFeature per line."""
CITYJSON = "application/city+json"
"""Media type of a whole CityJSON document."""
GEOJSON = "application/geo+json"
"""Media type of RFC 7946."""
OBJ = "model/obj"
"""Media type of Wavefront OBJ."""
GLB = "model/gltf-binary"
"""Media type of glTF 2.0 in one binary file."""
GEOTIFF = "image/tiff"
"""Media type of GeoTIFF."""
HTML = "text/html"
"""Media type of a page."""
ZIP = "application/zip"
"""Media type of a zip file."""
GEOPACKAGE = "application/geopackage+sqlite3"
"""Media type of GeoPackage."""
PMTILES = "application/vnd.pmtiles"
"""Media type of PMTiles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutputKind:
    """One output of a process."""

    output_id: str
    """Its name in requests, results and paths."""
    title: str
    """A short title."""
    description: str
    """Content, and how to read it."""
    media_type: str
    """The type that it is served as."""
    filename: str
    """Name of the file in the folder of outputs, and the last part of the name that a browser saves."""
    schema: Mapping[str, Any]
    """JSON schema of the value, for the process description."""


def _binary(media_type: str) -> dict[str, Any]:
    return {"type": "string", "contentEncoding": "binary", "contentMediaType": media_type}


_OF_A_RUN = (
    OutputKind(
        output_id="buildings",
        title="Buildings as GeoParquet",
        description="One row per candidate, modelled or not: status and reason, roof type, footprint, solids, heights, "
        "volume, quality and validity. GeoParquet 1.1 in the CRS of the tiles, all tiles in one file.",
        media_type=GEOPARQUET,
        filename="buildings.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="planes",
        title="Roof planes as GeoParquet",
        description="One row per roof plane: its face in 3D, slope, aspect, coefficients, area and residuals.",
        media_type=GEOPARQUET,
        filename="planes.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="rejected",
        title="Rejected objects as GeoParquet",
        description="One row per object that was judged not to be a building, with its reason.",
        media_type=GEOPARQUET,
        filename="rejected.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="meshes",
        title="Meshes as OBJ or GLB in a zip file",
        description="The solids as Wavefront OBJ in full coordinates, one file per building (or per tile, on "
        "request); or, on request, as GLB, one file per tile. The names in the zip file are in the column mesh_path. "
        "With the setting terrain also the terrain of each tile, as OBJ and CityJSONSeq.",
        media_type=ZIP,
        filename="meshes.zip",
        schema=_binary(ZIP),
    ),
    OutputKind(
        output_id="tileset",
        title="Points as 3D Tiles",
        description="The tileset over the points of the run, if the request asked for them: 3D Tiles 1.1 in the CRS of "
        "the tiles. Each point has its class, its building, its roof plane and its vertical distance to the model.",
        media_type="application/json",
        filename="tileset.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
    OutputKind(
        output_id="cityjson",
        title="Buildings as CityJSONSeq",
        description="CityJSON 2.0 as text lines: one line of metadata, then one feature per building with the record "
        "as its attributes, and a BuildingPart with semantic surfaces per solid.",
        media_type=CITYJSONSEQ,
        filename="buildings.city.jsonl",
        schema={"type": "string", "contentMediaType": CITYJSONSEQ},
    ),
    OutputKind(
        output_id="geojson",
        title="Footprints as GeoJSON",
        description="RFC 7946: footprints in WGS 84 with all columns as properties; one without an outline has a null "
        "geometry. If the CRS of the tiles is unknown, the coordinates are in that CRS, and `coordRefSys` is null. "
        "`verticalUnitM` has the unit of the columns that are elevations.",
        media_type=GEOJSON,
        filename="buildings.geojson",
        schema={"type": "object", "format": "geojson-feature-collection", "contentMediaType": GEOJSON},
    ),
    OutputKind(
        output_id="report",
        title="Report of the run",
        description="Counts by status, reason and roof type, inputs with sha256, settings and hashes, warnings, "
        "timings, and the digest of the content.",
        media_type="application/json",
        filename="report.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
)

_PUBLISHED = (
    OutputKind(
        output_id="3dtiles",
        title="Models as 3D Tiles",
        description="The tileset for globes such as CesiumJS, if the input publish names 3dtiles: 3D Tiles 1.1 in "
        "EPSG:4978, with the records. Its files, and a copy of it with paths of its own, are below this output.",
        media_type="application/json",
        filename="3dtiles.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
    OutputKind(
        output_id="3dtiles-zip",
        title="Models as 3D Tiles in a zip file",
        description="The same tileset with all its files, to be served elsewhere.",
        media_type=ZIP,
        filename="3dtiles.zip",
        schema=_binary(ZIP),
    ),
    OutputKind(
        output_id="geopackage",
        title="All tables as GeoPackage",
        description="One file with all layers and their styles, for GIS, if the input publish names geopackage.",
        media_type=GEOPACKAGE,
        filename="models.gpkg",
        schema=_binary(GEOPACKAGE),
    ),
    OutputKind(
        output_id="pmtiles",
        title="Footprints as PMTiles",
        description="Vector tiles of the footprints in one file, for maps on the web, which read it in ranges; if the "
        "input publish names pmtiles.",
        media_type=PMTILES,
        filename="models.pmtiles",
        schema=_binary(PMTILES),
    ),
    OutputKind(
        output_id="cityjson-zip",
        title="One CityJSON file per tile in a zip file",
        description="CityJSON 2.0 with all levels of detail, for programs that do not read sequences; if the input "
        "publish names cityjson.",
        media_type=ZIP,
        filename="cityjson.zip",
        schema=_binary(ZIP),
    ),
    OutputKind(
        output_id="stac",
        title="Catalogue of the tiles",
        description="A STAC 1.1 Collection, with an Item per tile below this output, if the input publish names stac. "
        "Their assets are the files of the run.",
        media_type="application/json",
        filename="stac.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
    OutputKind(
        output_id="solar",
        title="Solar energy per roof plane as GeoParquet",
        description="One row per roof plane: sky view, horizon, and irradiation of a year under clear skies; if the "
        "input publish names solar.",
        media_type=GEOPARQUET,
        filename="solar.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="party-walls",
        title="Party walls as GeoParquet",
        description="One row per pair of walls of two buildings that touch: the shared polygon and its area; if the "
        "input publish names party-walls.",
        media_type=GEOPARQUET,
        filename="party_walls.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="wall-areas",
        title="Wall areas per building as GeoParquet",
        description="One row per building: how much of its walls is shared, inner and exposed; with the party walls.",
        media_type=GEOPARQUET,
        filename="wall_areas.parquet",
        schema=_binary(GEOPARQUET),
    ),
)

_OF_A_COMPARISON = (
    OutputKind(
        output_id="page",
        title="Comparison as a page",
        description="One page for a browser: the methods side by side, with pictures and a table per building. It "
        "holds all that it shows, and its content cannot reach the service.",
        media_type=HTML,
        filename="index.html",
        schema={"type": "string", "contentMediaType": HTML},
    ),
    OutputKind(
        output_id="table",
        title="Comparison as GeoParquet",
        description="One row per building and method: status and reason, roof type, planes, residuals, seconds, "
        "footprint.",
        media_type=GEOPARQUET,
        filename="buildings.parquet",
        schema=_binary(GEOPARQUET),
    ),
    OutputKind(
        output_id="summary",
        title="Summary of the comparison",
        description="Methods with their presets, hashes of settings, digests, inputs, counts and seconds.",
        media_type="application/json",
        filename="compare.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
    OutputKind(
        output_id="archive",
        title="The whole comparison in a zip file",
        description="Page, table, summary, and a run directory per method with all its tables and models.",
        media_type=ZIP,
        filename="comparison.zip",
        schema=_binary(ZIP),
    ),
)

_OF_A_CLASSIFICATION = (
    OutputKind(
        output_id="points",
        title="Classified points as LAZ in a zip file",
        description="One LAZ 1.4 file per tile, in the order of its points and with all their attributes; only the "
        "classes are new: 1 other, 2 ground, 5 vegetation, 6 building, 7 noise, 17 bridge.",
        media_type=ZIP,
        filename="points.zip",
        schema=_binary(ZIP),
    ),
    *(
        OutputKind(
            output_id=name,
            title=f"{title} as cloud-optimised GeoTIFF",
            description=f"{content} One raster for all tiles; empty cells have no value.",
            media_type=GEOTIFF,
            filename=f"{name}.tif",
            schema=_binary(GEOTIFF),
        )
        for name, title, content in (
            ("terrain", "Terrain", "Elevation of the ground, also below buildings."),
            ("surface", "Surface", "Elevation of the highest point of each cell."),
            ("height", "Height", "Height of the surface above the terrain."),
        )
    ),
    OutputKind(
        output_id="classes",
        title="Counts by class",
        description="Points by class, files with their points, number of buildings, warnings and timings.",
        media_type="application/json",
        filename="classes.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    ),
)

OUTPUTS: Mapping[str, OutputKind] = {kind.output_id: kind for kind in (*_OF_A_RUN, *_PUBLISHED)}
"""The outputs of a run by their ids, in the order of lists: those of the process `reconstruct`."""

FORMATS: Mapping[str, tuple[str, ...]] = {
    "3dtiles": ("3dtiles", "3dtiles-zip"),
    "geopackage": ("geopackage",),
    "pmtiles": ("pmtiles",),
    "cityjson": ("cityjson-zip",),
    "stac": ("stac",),
    "solar": ("solar",),
    "party-walls": ("party-walls", "wall-areas"),
}
"""The ids of those that are made on request, by the words of the input `publish`."""
ON_REQUEST = frozenset(name for ids in FORMATS.values() for name in ids)
"""All of these."""

COMPARISON_OUTPUTS: Mapping[str, OutputKind] = {kind.output_id: kind for kind in _OF_A_COMPARISON}
"""The outputs of the process `compare`."""

CLASSIFICATION_OUTPUTS: Mapping[str, OutputKind] = {kind.output_id: kind for kind in _OF_A_CLASSIFICATION}
"""The outputs of the process `classify`."""

ECHO_OUTPUTS: Mapping[str, OutputKind] = {
    "echo": OutputKind(
        output_id="echo",
        title="The message",
        description="The message that came with the request.",
        media_type="application/json",
        filename="echo.json",
        schema={"type": "object", "contentMediaType": "application/json"},
    )
}
"""The output of the process `echo`."""

RASTERS = ("terrain", "surface", "height")
"""Those of them that are rasters."""

KINDS: Mapping[str, OutputKind] = {**OUTPUTS, **COMPARISON_OUTPUTS, **CLASSIFICATION_OUTPUTS, **ECHO_OUTPUTS}
"""All outputs; an id means the same in all processes."""


def chosen(wanted: Iterable[str] | None, kinds: Mapping[str, OutputKind] = OUTPUTS) -> tuple[OutputKind, ...]:
    """The kinds of some ids, in the order of the table; all of them for None.

    Raises
    ------
    NoSuchOutputError
        An id is not in the table.

    Examples
    --------
    >>> [kind.output_id for kind in chosen(["report", "buildings"])]
    ['buildings', 'report']
    """
    if wanted is None:
        return tuple(kinds.values())
    names = set(wanted)
    unknown = sorted(names - set(kinds))
    if unknown:
        raise NoSuchOutputError(f"there is no output {', '.join(unknown)}: use {', '.join(kinds)}")
    return tuple(kind for kind in kinds.values() if kind.output_id in names)
