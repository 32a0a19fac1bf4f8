"""Files of a finished job in further formats: those of a tileset or a catalogue, and those of the run it lists."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from service.errors import NoSuchOutputError
from service.outputs.kinds import CITYJSONSEQ, GEOJSON, GEOPARQUET, GLB, KINDS, OBJ
from service.outputs.published import ROOTS, RUN_FILE, is_file_of, type_of
from service.routes.finished_jobs import FinishedJob, FinishedRun
from service.routes.results import file_answers, unchanging_file

router = APIRouter(tags=["results"])

_DESCRIBED = {"ETag": "Another one for another file.", "Cache_Control": "The file never changes."}
_OF_OUTPUTS = file_answers({"application/json": True, GEOJSON: True, GLB: False}, **_DESCRIBED)
_OF_RUNS = file_answers({GEOPARQUET: False, CITYJSONSEQ: False, OBJ: False, GLB: False}, **_DESCRIBED)
_TYPES = {".parquet": GEOPARQUET, ".jsonl": CITYJSONSEQ, ".obj": OBJ, ".glb": GLB}

_Output = Annotated[str, Path(alias="outputID", description=f"One of {', '.join(ROOTS)}.", examples=["3dtiles"])]
_File = Annotated[str, Path(description="A file that the output names.", examples=["tileset.json"])]


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
    if not RUN_FILE.fullmatch(name):
        raise NoSuchOutputError(f"the catalogue of this job lists no file {name[:80]!r}: start at results/stac")
    path = finished.run_dir / name
    try:
        return unchanging_file(request, finished, path, _TYPES[path.suffix])
    except FileNotFoundError:
        raise NoSuchOutputError(f"the catalogue of this job lists no file {name}: start at results/stac") from None


def _of_output(request: Request, finished: FinishedJob, output_id: str, name: str) -> Response:
    """The answer to a request for a file below an output.

    Raises
    ------
    NoSuchOutputError
        The job has no such output, or it has no such file.
    """
    if output_id not in finished.catalogue.outputs:
        raise finished.catalogue.missing(output_id)
    if output_id not in ROOTS:
        raise NoSuchOutputError(f"{output_id} is one file: leave out {name[:80]!r}")
    missing = NoSuchOutputError(f"{output_id} has no file {name[:80]!r}: start at {output_id}/{ROOTS[output_id]}")
    if not is_file_of(output_id, name):
        raise missing
    try:
        return unchanging_file(request, finished, finished.out_dir / output_id / name, type_of(output_id, name))
    except FileNotFoundError:
        raise missing from None
