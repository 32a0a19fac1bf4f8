"""Points of a finished job as 3D Tiles: tilesets, and the nodes that they name."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from pipeline.export.folders import POINTS_FOLDER
from pipeline.extras.octree.point_files import NAMED_FILE, TILESET
from service.errors import NoSuchOutputError
from service.outputs.kinds import GLB
from service.routes.finished_jobs import FinishedJob, FinishedRun
from service.routes.results import file_answers, unchanging_file

router = APIRouter(tags=["results"])

_JSON = "application/json"
_ROOT = f"{POINTS_FOLDER}/{TILESET}"


_ANSWERS = file_answers(
    {_JSON: True, GLB: False}, ETag="Another one for another file.", Cache_Control="The file never changes."
)

_File = Annotated[str, Path(description="A file that a tileset names.", examples=[TILESET])]


@router.get(
    "/jobs/{jobID}/points/{file}",
    summary="Root tileset of the points",
    response_class=Response,
    responses=_ANSWERS,
)
def root(request: Request, finished: FinishedRun, file: _File) -> Response:
    """The root tileset in the CRS of the tiles (`tileset.json`), or on the globe (`tileset-ecef.json`)."""
    return _answer(request, finished, file)


@router.get(
    "/jobs/{jobID}/points/{folder}/{file}",
    summary="A tileset or a node of the points",
    response_class=Response,
    responses=_ANSWERS,
)
def node(
    request: Request,
    finished: FinishedRun,
    folder: Annotated[str, Path(description="A tile of the run, or upper.", examples=["x85_y447"])],
    file: _File,
) -> Response:
    """The tileset of one tile of the run, or points as GLB."""
    return _answer(request, finished, f"{folder}/{file}")


def _answer(request: Request, finished: FinishedJob, name: str) -> Response:
    """The answer to a request for a file."""
    path = _path(finished.run_dir / POINTS_FOLDER, name)
    media_type = GLB if name.endswith(".glb") else _JSON
    try:
        return unchanging_file(request, finished, path, media_type)
    except FileNotFoundError:
        raise NoSuchOutputError(f"the points of this job have no file {name}: start at {_ROOT}") from None


def _path(folder: FilePath, name: str) -> FilePath:
    """The path of a file; a name that no tileset has never becomes a path.

    Raises
    ------
    NoSuchOutputError
        There are no points, or none could have this name.
    """
    if not folder.is_dir():
        raise NoSuchOutputError("this job was requested without points: submit it again with points")
    if not NAMED_FILE.fullmatch(name):
        raise NoSuchOutputError(f"the points of this job have no file {name[:80]!r}: start at {_ROOT}")
    return folder / name
