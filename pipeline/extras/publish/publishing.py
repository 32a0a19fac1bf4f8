"""The forms in which a finished run is published, one row each; the command and the service derive theirs from here.

A form is added by its module and its row. This module loads none of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from pipeline.registry import loaded

_TILE = r"x-?\d{1,9}_y-?\d{1,9}"
_GEOPARQUET, _JSON, _ZIP = "application/vnd.apache.parquet", "application/json", "application/zip"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Output:
    """A file that a service offers of a form."""

    output_id: str
    """Its name in requests, results and paths."""
    title: str
    """A short title."""
    description: str
    """Content, and how to read it."""
    media_type: str
    """The type that it is served as."""
    filename: str
    """Name of the file in the folder of outputs."""
    holds: Literal["file", "zip", "root"] = "file"
    """The file that is written, a folder in a zip file, or a copy of the folder's file that is opened first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Form:
    """A form. Its writer takes (run_dir, out, *, overwrite, on_event), and its `options` by name.

    What is written appears whole, or stays what it was. A writer raises SettingsError if `out` cannot be such a file or
    folder, and RunError if it exists and is not to be replaced, if the run is not finished, changes meanwhile or lacks
    files or rows, or if something cannot be read or written.
    """

    name: str
    """The word for it."""
    words: str
    """What it is, for the help of the command; empty if it has a command of its own."""
    place: str
    """The writer, as "module:name"."""
    outputs: tuple[Output, ...]
    """What a service offers of it."""
    options: tuple[str, ...] = ()
    """The writer's own options that a service gives: `geoid_height_m`; `name` of the run; `documents` to list."""
    beside: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Options of the writer that name further files, and the ids of their outputs."""
    by_status: bool = True
    """Whether it can hold buildings of some statuses only."""
    root: str = ""
    """The file to open first, of a folder whose files are served one by one."""
    files: str = ""
    """Pattern of the paths of these files."""
    moved: str = ""
    """Rewrites the content of `root` for a copy above its folder, as "module:name"."""

    def write(self, run_dir: str, out: str, **options: Any) -> Any:
        """Publish a run; see the class. Returns `finished_run.Published`."""
        return loaded(self.place)(run_dir, out, **options)


FORMS: Mapping[str, Form] = {
    form.name: form
    for form in (
        Form(
            name="3dtiles",
            words="a folder with a tileset, for globes such as CesiumJS",
            place="pipeline.extras.publish_3dtiles.publishing_3dtiles:publish_3dtiles",
            options=("geoid_height_m",),
            root="tileset.json",
            files=rf"(tileset|terrain)\.json|(models|blocks|terrain)/{_TILE}\.glb|skylines/{_TILE}_\d{{1,9}}\.glb",
            moved="pipeline.export.tileset:moved_tileset",
            outputs=(
                Output(
                    output_id="3dtiles",
                    title="Models as 3D Tiles",
                    description="The tileset for globes such as CesiumJS, if the input publish names 3dtiles: 3D Tiles "
                    "1.1 in EPSG:4978, with the records. Its files, and a copy of it with paths of its own, are below "
                    "this output.",
                    media_type=_JSON,
                    filename="3dtiles.json",
                    holds="root",
                ),
                Output(
                    output_id="3dtiles-zip",
                    title="Models as 3D Tiles in a zip file",
                    description="The same tileset with all its files, to be served elsewhere.",
                    media_type=_ZIP,
                    filename="3dtiles.zip",
                    holds="zip",
                ),
            ),
        ),
        Form(
            name="geopackage",
            words="one file (.gpkg) with layers and styles, for GIS",
            place="pipeline.extras.publish_gis.geopackage:publish_geopackage",
            outputs=(
                Output(
                    output_id="geopackage",
                    title="All tables as GeoPackage",
                    description="One file with all layers and their styles, for GIS, if the input publish names "
                    "geopackage.",
                    media_type="application/geopackage+sqlite3",
                    filename="models.gpkg",
                ),
            ),
        ),
        Form(
            name="pmtiles",
            words="one file (.pmtiles) with footprints, for maps on the web",
            place="pipeline.extras.publish_gis.pmtiles:publish_pmtiles",
            outputs=(
                Output(
                    output_id="pmtiles",
                    title="Footprints as PMTiles",
                    description="Vector tiles of the footprints in one file, for maps on the web, which read it in "
                    "ranges; if the input publish names pmtiles.",
                    media_type="application/vnd.pmtiles",
                    filename="models.pmtiles",
                ),
            ),
        ),
        Form(
            name="cityjson",
            words="a folder, one file per tile",
            place="pipeline.extras.publish.cityjson_file:publish_cityjson",
            outputs=(
                Output(
                    output_id="cityjson-zip",
                    title="One CityJSON file per tile in a zip file",
                    description="CityJSON 2.0 with all levels of detail, for programs that do not read sequences; if "
                    "the input publish names cityjson.",
                    media_type=_ZIP,
                    filename="cityjson.zip",
                    holds="zip",
                ),
            ),
        ),
        Form(
            name="stac",
            words="a folder, a catalogue of the run",
            place="pipeline.extras.publish_stac.stac:publish_stac",
            options=("name", "documents"),
            by_status=False,
            root="collection.json",
            files=rf"(points/)?collection\.json|(?P<tile>{_TILE})/(?P=tile)\.json|points/[\w-]+\.json",
            moved="pipeline.extras.publish_stac.stac:moved_collection",
            outputs=(
                Output(
                    output_id="stac",
                    title="Catalogue of the tiles",
                    description="A STAC 1.1 Collection, with an Item per tile below this output, if the input publish "
                    "names stac. Their assets are the files of the run.",
                    media_type=_JSON,
                    filename="stac.json",
                    holds="root",
                ),
            ),
        ),
        Form(
            name="solar",
            words="",
            place="pipeline.extras.solar.solar_of_run:solar",
            by_status=False,
            outputs=(
                Output(
                    output_id="solar",
                    title="Solar energy per roof plane as GeoParquet",
                    description="One row per roof plane: sky view, horizon, and irradiation of a year under clear "
                    "skies; if the input publish names solar.",
                    media_type=_GEOPARQUET,
                    filename="solar.parquet",
                ),
            ),
        ),
        Form(
            name="party-walls",
            words="",
            place="pipeline.extras.party_walls.party_walls_of_run:party_walls",
            beside={"buildings": "wall-areas"},
            by_status=False,
            outputs=(
                Output(
                    output_id="party-walls",
                    title="Party walls as GeoParquet",
                    description="One row per pair of walls of two buildings that touch: the shared polygon and its "
                    "area; if the input publish names party-walls.",
                    media_type=_GEOPARQUET,
                    filename="party_walls.parquet",
                ),
                Output(
                    output_id="wall-areas",
                    title="Wall areas per building as GeoParquet",
                    description="One row per building: how much of its walls is shared, inner and exposed; with the "
                    "party walls.",
                    media_type=_GEOPARQUET,
                    filename="wall_areas.parquet",
                ),
            ),
        ),
    )
}
"""All forms by their names, in the order of the outputs."""
COMMAND_FORMS: Mapping[str, Form] = {name: form for name, form in FORMS.items() if form.words}
"""Those of `gablework publish`."""
