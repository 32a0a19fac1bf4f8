"""The outputs of the processes: tables of the files that a finished job offers for download."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.extras.publish.publishing import FORMS
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
JSON = "application/json"
"""Media type of any other JSON document."""


@dataclasses.dataclass(frozen=True)
class OutputKind:
    """One output of a process."""

    output_id: str
    """Its name in requests, results and paths."""
    media_type: str
    """The type that it is served as."""
    filename: str
    """Name of the file in the folder of outputs, and the last part of the name that a browser saves."""
    title: str
    """A short title."""
    description: str
    """Content, and how to read it."""
    form: str | None = None
    """The word of the input `publish` that requests it; None if it needs none."""
    is_selectable: bool = False
    """Whether it is also made for buildings of some statuses. Outputs that hold no buildings, are about the whole job,
    or name files of the run are not."""

    @property
    def is_document(self) -> bool:
        """Whether it is a JSON object."""
        return self.media_type in {JSON, GEOJSON}

    @property
    def schema(self) -> dict[str, Any]:
        """JSON schema of the value, for the process description."""
        kind: dict[str, Any] = {"type": "object" if self.is_document else "string", "contentMediaType": self.media_type}
        if self.media_type == GEOJSON:
            kind["format"] = "geojson-feature-collection"
        return (
            kind if self.is_document or self.media_type in {CITYJSONSEQ, HTML} else kind | {"contentEncoding": "binary"}
        )


def _table(*kinds: OutputKind) -> Mapping[str, OutputKind]:
    return {kind.output_id: kind for kind in kinds}


OUTPUTS = _table(
    OutputKind(
        "buildings",
        GEOPARQUET,
        "buildings.parquet",
        "Buildings as GeoParquet",
        "One row per candidate, modelled or not: status and reason, roof type, footprint, solids, heights, volume, "
        "quality and validity. GeoParquet 1.1 in the CRS of the tiles, all tiles in one file.",
        is_selectable=True,
    ),
    OutputKind(
        "planes",
        GEOPARQUET,
        "planes.parquet",
        "Roof planes as GeoParquet",
        "One row per roof plane: its face in 3D, slope, aspect, coefficients, area and residuals.",
        is_selectable=True,
    ),
    OutputKind(
        "rejected",
        GEOPARQUET,
        "rejected.parquet",
        "Rejected objects as GeoParquet",
        "One row per object that was judged not to be a building, with its reason.",
    ),
    OutputKind(
        "meshes",
        ZIP,
        "meshes.zip",
        "Meshes as OBJ or GLB in a zip file",
        "The solids as Wavefront OBJ in full coordinates, one file per building (or per tile, on request); or, on "
        "request, as GLB, one file per tile. The names in the zip file are in the column mesh_path. With the "
        "setting terrain also the terrain of each tile, as OBJ and CityJSONSeq.",
        is_selectable=True,
    ),
    OutputKind(
        "tileset",
        JSON,
        "tileset.json",
        "Points as 3D Tiles",
        "The tileset over the points of the run, if the request asked for them: 3D Tiles 1.1 in the CRS of the "
        "tiles. Each point has its class, its building, its roof plane and its vertical distance to the model.",
    ),
    OutputKind(
        "cityjson",
        CITYJSONSEQ,
        "buildings.city.jsonl",
        "Buildings as CityJSONSeq",
        "CityJSON 2.0 as text lines: one line of metadata, then one feature per building with the record as its "
        "attributes, and a BuildingPart with semantic surfaces per solid.",
        is_selectable=True,
    ),
    OutputKind(
        "geojson",
        GEOJSON,
        "buildings.geojson",
        "Footprints as GeoJSON",
        "RFC 7946: footprints in WGS 84 with all columns as properties; one without an outline has a null geometry."
        " If the CRS of the tiles is unknown, the coordinates are in that CRS, and `coordRefSys` is null. "
        "`verticalUnitM` has the unit of the columns that are elevations.",
        is_selectable=True,
    ),
    OutputKind(
        "report",
        JSON,
        "report.json",
        "Report of the run",
        "Counts by status, reason and roof type, inputs with sha256, settings and hashes, warnings, timings, and "
        "the digest of the content.",
    ),
    *(
        OutputKind(
            one.output_id,
            one.media_type,
            one.filename,
            one.title,
            one.description,
            form=form.name,
            is_selectable=form.by_status and one.holds != "root",
        )
        for form in FORMS.values()
        for one in form.outputs
    ),
)
"""The outputs of a run by their ids, in the order of lists: those of the process `reconstruct`."""

COMPARISON_OUTPUTS = _table(
    OutputKind(
        "page",
        HTML,
        "index.html",
        "Comparison as a page",
        "One page for a browser: the methods side by side, with pictures and a table per building. It holds all "
        "that it shows, and its content cannot reach the service.",
    ),
    OutputKind(
        "table",
        GEOPARQUET,
        "buildings.parquet",
        "Comparison as GeoParquet",
        "One row per building and method: status and reason, roof type, planes, residuals, seconds, footprint.",
    ),
    OutputKind(
        "summary",
        JSON,
        "compare.json",
        "Summary of the comparison",
        "Methods with their presets, hashes of settings, digests, inputs, counts and seconds.",
    ),
    OutputKind(
        "archive",
        ZIP,
        "comparison.zip",
        "The whole comparison in a zip file",
        "Page, table, summary, and a run directory per method with all its tables and models.",
    ),
)
"""The outputs of the process `compare`."""

CLASSIFICATION_OUTPUTS = _table(
    OutputKind(
        "points",
        ZIP,
        "points.zip",
        "Classified points as LAZ in a zip file",
        "One LAZ 1.4 file per tile, in the order of its points and with all their attributes; only the classes are "
        "new: 1 other, 2 ground, 5 vegetation, 6 building, 7 noise, 17 bridge.",
    ),
    OutputKind(
        "terrain",
        GEOTIFF,
        "terrain.tif",
        "Terrain as cloud-optimised GeoTIFF",
        "Elevation of the ground, also below buildings. One raster for all tiles; empty cells have no value.",
    ),
    OutputKind(
        "surface",
        GEOTIFF,
        "surface.tif",
        "Surface as cloud-optimised GeoTIFF",
        "Elevation of the highest point of each cell. One raster for all tiles; empty cells have no value.",
    ),
    OutputKind(
        "height",
        GEOTIFF,
        "height.tif",
        "Height as cloud-optimised GeoTIFF",
        "Height of the surface above the terrain. One raster for all tiles; empty cells have no value.",
    ),
    OutputKind(
        "classes",
        JSON,
        "classes.json",
        "Counts by class",
        "Points by class, files with their points, number of buildings, warnings and timings.",
    ),
)
"""The outputs of the process `classify`."""

ECHO_OUTPUTS = _table(
    OutputKind(
        "echo",
        JSON,
        "echo.json",
        "The message",
        "The message that came with the request.",
    ),
)
"""The output of the process `echo`."""

KINDS: Mapping[str, OutputKind] = {**OUTPUTS, **COMPARISON_OUTPUTS, **CLASSIFICATION_OUTPUTS, **ECHO_OUTPUTS}
"""All outputs; an id means the same in all processes."""
ON_REQUEST = frozenset(name for name, kind in KINDS.items() if kind.form is not None)
"""Those that are made on request."""
FORMATS: Mapping[str, tuple[str, ...]] = {
    form: tuple(name for name in KINDS if KINDS[name].form == form)
    for form in dict.fromkeys(kind.form for kind in KINDS.values())
    if form is not None
}
"""Their ids by the words of the input `publish`."""
SELECTABLE = tuple(name for name, kind in KINDS.items() if kind.is_selectable)
"""Those that are also made for buildings of some statuses."""
RASTERS = tuple(name for name, kind in KINDS.items() if kind.media_type == GEOTIFF)
"""Those that are rasters."""


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
