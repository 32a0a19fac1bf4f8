"""Files below a finished job that never change: points, tilesets and catalogues, and the files of the run they list."""

from __future__ import annotations

import re
from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from pipeline.export.folders import POINTS_FOLDER
from pipeline.extras.octree.point_files import NAMED_FILE, TILESET
from service.errors import NoSuchOutputError
from service.outputs.kinds import CITYJSONSEQ, GEOJSON, GEOPARQUET, GLB, JSON, KINDS, OBJ
from service.outputs.published_forms import FILES, ROOTS, RUN_FILE
from service.routes.finished_jobs import FinishedJob, FinishedRun
from service.routes.results import file_answers, unchanging_file

router = APIRouter(tags=["results"])

_DESCRIBED = {"ETag": "Another one for another file.", "Cache_Control": "The file never changes."}
_OF_POINTS = file_answers({JSON: True, GLB: False}, **_DESCRIBED)
_OF_OUTPUTS = file_answers({JSON: True, GEOJSON: True, GLB: False}, **_DESCRIBED)
_OF_RUNS = file_answers({GEOPARQUET: False, CITYJSONSEQ: False, OBJ: False, GLB: False}, **_DESCRIBED)
_TYPES = {".json": JSON, ".glb": GLB, ".parquet": GEOPARQUET, ".jsonl": CITYJSONSEQ, ".obj": OBJ}

_Output = Annotated[str, Path(alias="outputID", description=f"One of {', '.join(ROOTS)}.", examples=["3dtiles"])]
_File = Annotated[str, Path(description="A file that the output names.", examples=["tileset.json"])]
_Named = Annotated[str, Path(description="A file that a tileset names.", examples=[TILESET])]


@router.get(
    "/jobs/{jobID}/points/{file}",
    summary="Root tileset of the points",
    response_class=Response,
    responses=_OF_POINTS,
)
def root(request: Request, finished: FinishedRun, file: _Named) -> Response:
    """The root tileset in the CRS of the tiles (`tileset.json`), or on the globe (`tileset-ecef.json`)."""
    return _of_points(request, finished, file)


@router.get(
    "/jobs/{jobID}/points/{folder}/{file}",
    summary="A tileset or a node of the points",
    response_class=Response,
    responses=_OF_POINTS,
)
def node(
    request: Request,
    finished: FinishedRun,
    folder: Annotated[str, Path(description="A tile of the run, or upper.", examples=["x85_y447"])],
    file: _Named,
) -> Response:
    """The tileset of one tile of the run, or points as GLB."""
    return _of_points(request, finished, f"{folder}/{file}")


@router.get(
    "/jobs/{jobID}/results/{outputID}/{file}",
    summary="The root of a tileset or a catalogue",
    response_class=Response,
    responses=_OF_OUTPUTS,
)
def published_root(request: Request, finished: FinishedRun, output_id: _Output, file: _File) -> Response:
    """The tileset of the models (`3dtiles/tileset.json`), or the Collection of the tiles (`stac/collection.json`)."""
    return _of_output(request, finished, output_id, file)


@router.get(
    "/jobs/{jobID}/results/{outputID}/{folder}/{file}",
    summary="A file of a tileset or a catalogue",
    response_class=Response,
    responses=_OF_OUTPUTS,
)
def published_file(
    request: Request,
    finished: FinishedRun,
    output_id: _Output,
    folder: Annotated[str, Path(description="A folder of the output.", examples=["models"])],
    file: Annotated[str, Path(description="A file that the output names.", examples=["x85_y447.glb"])],
) -> Response:
    """Models or blocks as GLB, or an Item of a catalogue."""
    return _of_output(request, finished, output_id, f"{folder}/{file}")


@router.get(
    "/jobs/{jobID}/run/{table}/{tile}/{file}",
    summary="A file of a tile of the run",
    response_class=Response,
    responses=_OF_RUNS,
)
def run_file(
    request: Request,
    finished: FinishedRun,
    table: Annotated[str, Path(description="A folder of the run directory.", examples=["buildings"])],
    tile: Annotated[str, Path(description="The folder of a tile.", examples=["tile=x85_y447"])],
    file: Annotated[str, Path(description="A file that the catalogue names.", examples=["part-0.parquet"])],
) -> Response:
    """A table, the CityJSONSeq or the mesh of one tile, as the catalogue of the job lists it."""
    name = f"{table}/{tile}/{file}"
    if not (finished.out_dir / KINDS["stac"].filename).is_file():
        raise NoSuchOutputError("this job was requested without a catalogue: submit it again with publish stac")
    missing = f"the catalogue of this job lists no file {name[:80]!r}: start at results/stac"
    return _sent(request, finished, finished.run_dir, name, RUN_FILE, missing)


def _of_points(request: Request, finished: FinishedJob, name: str) -> Response:
    folder = finished.run_dir / POINTS_FOLDER
    if not folder.is_dir():
        raise NoSuchOutputError("this job was requested without points: submit it again with points")
    missing = f"the points of this job have no file {name[:80]!r}: start at {POINTS_FOLDER}/{TILESET}"
    return _sent(request, finished, folder, name, NAMED_FILE, missing)


def _of_output(request: Request, finished: FinishedJob, output_id: str, name: str) -> Response:
    if output_id not in finished.catalogue.outputs:
        raise finished.catalogue.missing(output_id)
    if output_id not in FILES:
        raise NoSuchOutputError(f"{output_id} is one file: leave out {name[:80]!r}")
    missing = f"{output_id} has no file {name[:80]!r}: start at {output_id}/{ROOTS[output_id]}"
    return _sent(request, finished, finished.out_dir / output_id, name, FILES[output_id], missing)


def _sent(
    request: Request, finished: FinishedJob, folder: FilePath, name: str, names: re.Pattern[str], missing: str
) -> Response:
    """A file of a folder; a name that it cannot have never becomes a path.

    Raises
    ------
    NoSuchOutputError
        There is no such file.
    """
    # an Item of a catalogue is GeoJSON
    is_item = names is FILES["stac"] and not name.endswith(ROOTS["stac"])
    if names.fullmatch(name):
        try:
            media_type = GEOJSON if is_item else _TYPES[FilePath(name).suffix]
            return unchanging_file(request, finished, folder / name, media_type)
        except FileNotFoundError:
            pass
    raise NoSuchOutputError(missing)
