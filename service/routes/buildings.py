"""Buildings of a finished job: pages of GeoJSON, and each one as a record, a mesh or a city object."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from pipeline.model import Reason, RoofType, Status
from service.errors import RequestError
from service.outputs.building_pages import (
    MAX_LIMIT,
    MAX_OFFSET,
    BuildingQuery,
    CoordinateChoice,
    building_page,
    checked_choice,
    parsed_bbox,
)
from service.outputs.catalogue import ResultsCrs
from service.outputs.kinds import CITYJSON, GEOJSON, GLB, OBJ
from service.outputs.single_building import (
    ID_PATTERN,
    StoredBuilding,
    building_cityjson,
    building_glb,
    building_obj,
    stored_building,
)
from service.routes.bound import Base
from service.routes.documented import JOB_ID, problems
from service.routes.finished_jobs import FinishedJob, FinishedRun
from service.routes.negotiation import preferred
from service.routes.results import FAILED
from service.routes.status import link

router = APIRouter(tags=["results"])

_FORMATS: Mapping[str, str] = {"json": GEOJSON, "obj": OBJ, "glb": GLB, "cityjson": CITYJSON}
_CRS84 = CoordinateChoice.CRS84_URI.value

_FEATURE_EXAMPLE: dict[str, Any] = {
    "type": "Feature",
    "id": "3givd2mvtyerfjxv2yytjbmi",
    "geometry": {
        "type": "Polygon",
        "coordinates": [[[9.9967, 53.5603], [9.9968, 53.5602], [9.9969, 53.5603], [9.9967, 53.5603]]],
    },
    "properties": {
        "building_id": "3givd2mvtyerfjxv2yytjbmi",
        "status": "ok",
        "reason": None,
        "roof_type": "gable",
        "height_m": 7.618,
        "volume_m3": 965.377,
        "tile": "x5660_y59350",
    },
}
_PAGE_EXAMPLE = {
    "type": "FeatureCollection",
    "numberMatched": 154,
    "numberReturned": 1,
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}/buildings?limit=1", "rel": "self", "type": GEOJSON}],
    "features": [_FEATURE_EXAMPLE],
}
_LINKS = {"type": "array", "items": {"$ref": "#/components/schemas/Link"}}
_FEATURE: dict[str, Any] = {
    "type": "object",
    "required": ["type", "id", "geometry", "properties"],
    "properties": {
        "type": {"type": "string", "enum": ["Feature"]},
        "id": {"type": "string", "pattern": ID_PATTERN},
        "geometry": {
            "anyOf": [
                {
                    "type": "object",
                    "required": ["type", "coordinates"],
                    "properties": {
                        "type": {"type": "string", "enum": ["Polygon", "MultiPolygon"]},
                        "coordinates": {"type": "array"},
                    },
                },
                {"type": "null"},
            ]
        },
        "properties": {"type": "object", "description": "The columns of the table buildings, and `tile`."},
        "links": _LINKS,
    },
}
_PAGE: dict[str, Any] = {
    "type": "object",
    "required": ["type", "numberMatched", "numberReturned", "links", "features"],
    "properties": {
        "type": {"type": "string", "enum": ["FeatureCollection"]},
        "numberMatched": {"type": "integer", "minimum": 0},
        "numberReturned": {"type": "integer", "minimum": 0},
        "coordRefSys": {
            "anyOf": [{"type": "string"}, {"type": "null"}],
            "description": "Told where the coordinates are not CRS84.",
        },
        "links": _LINKS,
        "features": {"type": "array", "items": _FEATURE},
    },
}
_CITYJSON: dict[str, Any] = {
    "type": "object",
    "required": ["type", "version", "transform", "CityObjects", "vertices"],
    "properties": {
        "type": {"type": "string", "enum": ["CityJSON"]},
        "version": {"type": "string", "enum": ["2.0"]},
        "transform": {"type": "object"},
        "metadata": {"type": "object"},
        "CityObjects": {"type": "object"},
        "vertices": {"type": "array"},
    },
}
_CRS_HEADER = {
    "Content-Crs": {"description": "CRS of the coordinates; absent where it has no URI.", "schema": {"type": "string"}}
}

_Coordinates = Annotated[
    CoordinateChoice | None,
    Query(
        alias="crs",
        description="Coordinates of the answer: CRS84 (longitude, latitude; the default) or native (easting, northing "
        "of the tiles). Where the CRS of the tiles is unknown, native is the default and all there is.",
    ),
]


@router.get(
    "/jobs/{jobID}/buildings",
    summary="Buildings of a job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "A page of buildings, sorted by building_id. One without an outline has a null geometry.",
            "content": {GEOJSON: {"schema": _PAGE, "example": _PAGE_EXAMPLE}},
            "headers": _CRS_HEADER,
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def buildings(
    request: Request,
    finished: FinishedRun,
    base: Base,
    bbox: Annotated[
        str | None,
        Query(
            description="Only buildings whose footprint's bounds meet this window: west,south,east,north. Those "
            "without a footprint never do. A window over the 180th meridian is asked for in two halves.",
            examples=["9.99,53.55,10.01,53.57"],
        ),
    ] = None,
    bbox_crs: Annotated[
        CoordinateChoice | None, Query(alias="bbox-crs", description="Coordinates of bbox; by default those of CRS84.")
    ] = None,
    crs: _Coordinates = None,
    statuses: Annotated[
        list[str] | None, Query(alias="status", description=f"Any of: {', '.join(Status)}; with commas, or again.")
    ] = None,
    roof_types: Annotated[
        list[str] | None, Query(alias="roof_type", description=f"Any of: {', '.join(RoofType)}; likewise.")
    ] = None,
    reasons: Annotated[
        list[str] | None, Query(alias="reason", description=f"Any of: {', '.join(Reason)}; likewise.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Most buildings of the page.")] = 100,
    offset: Annotated[int, Query(ge=0, le=MAX_OFFSET, description="Buildings to pass over.")] = 0,
) -> Response:
    """List buildings by window, status, roof type and reason, in pages."""
    preferred(request.headers.get("accept"), [GEOJSON])
    known = finished.catalogue.crs
    faults: list[str] = []
    words = {
        "status": _listed("status", statuses, list(Status), faults),
        "roof_type": _listed("roof_type", roof_types, list(RoofType), faults),
        "reason": _listed("reason", reasons, list(Reason), faults),
    }
    if faults:
        raise RequestError(faults)
    native = checked_choice(crs, known, "crs")
    bbox_native = checked_choice(bbox_crs, known, "bbox-crs")
    page = building_page(
        finished.out_dir,
        BuildingQuery(
            bbox=None if bbox is None else parsed_bbox(bbox, native=bbox_native),
            bbox_native=bbox_native,
            native=native,
            statuses=words["status"],
            roof_types=words["roof_type"],
            reasons=words["reason"],
            limit=limit,
            offset=offset,
        ),
    )
    asked = [
        ("method", finished.label),
        ("bbox", bbox),
        ("bbox-crs", None if bbox_crs is None else bbox_crs.value),
        ("crs", None if crs is None else crs.value),
        *((name, ",".join(values) or None) for name, values in words.items()),
        ("limit", limit),
    ]
    collection = f"{base}/jobs/{finished.job.job_id}"

    def at(start: int) -> str:
        return f"{collection}/buildings?{urlencode([(n, v) for n, v in (*asked, ('offset', start)) if v is not None])}"

    links = [
        link(at(offset), "self", "These buildings", GEOJSON),
        link(collection, "collection", "The job"),
    ]
    if offset + len(page.parts) < page.matched and page.parts:
        links.append(link(at(offset + limit), "next", "More buildings", GEOJSON))
    if offset > 0:
        links.append(link(at(max(0, offset - limit)), "prev", "Buildings before them", GEOJSON))
    members = {**_crs_members(known, native=native), "links": links}
    return StreamingResponse(page.chunks(members), media_type=GEOJSON, headers=_headers(known, native=native))


@router.get(
    "/jobs/{jobID}/buildings/{buildingID}",
    summary="One building",
    response_class=Response,
    responses={
        200: {
            "description": "The record with its planes; or its mesh; or a CityJSON document of its own.",
            "content": {
                GEOJSON: {"schema": _FEATURE, "example": _FEATURE_EXAMPLE},
                OBJ: {"schema": {"type": "string"}},
                GLB: {"schema": {"type": "string", "format": "binary"}},
                CITYJSON: {"schema": _CITYJSON},
            },
            "headers": _CRS_HEADER,
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def building(
    request: Request,
    finished: FinishedRun,
    base: Base,
    building_id: Annotated[
        str, Path(alias="buildingID", description="As the lists tell it.", examples=["3givd2mvtyerfjxv2yytjbmi"])
    ],
    wanted: Annotated[
        Literal["json", "obj", "glb", "cityjson"] | None,
        Query(alias="f", description="Stands above the header Accept."),
    ] = None,
    lod: Annotated[
        Literal["1.2", "1.3", "2.2"] | None,
        Query(description="Of an OBJ or GLB: one of the levels of detail that the job made; default the finest."),
    ] = None,
    crs: _Coordinates = None,
) -> Response:
    """Tell one building: all columns and its roof planes, or its model as OBJ, GLB or CityJSON."""
    media_type = (
        preferred(request.headers.get("accept"), list(_FORMATS.values())) if wanted is None else _FORMATS[wanted]
    )
    known = finished.catalogue.crs
    native = checked_choice(crs, known, "crs")
    found = stored_building(finished.out_dir, building_id, native=native)
    headers = _headers(known, native=native or media_type != GEOJSON)
    if media_type == OBJ:
        lines = building_obj(finished.run_dir, found, lod)
        content = "".join(f"{line}\n" for line in lines).encode()
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.obj"'
    elif media_type == GLB:
        content = building_glb(finished.run_dir, found, lod)
        headers.pop("Content-Crs", None)  # metres from an origin: the file tells it
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.glb"'
    elif media_type == CITYJSON:
        content = _json(building_cityjson(finished.run_dir, found))
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.city.json"'
    else:
        content = _json(_feature(found, finished, base, native=native))
    return Response(content, media_type=media_type, headers=headers)


def _feature(found: StoredBuilding, finished: FinishedJob, base: str, *, native: bool) -> dict[str, Any]:
    """The building's feature with its planes and links."""
    collection = f"{base}/jobs/{finished.job.job_id}"
    place = f"{collection}/buildings/{found.building_id}"
    links = [
        link(finished.address(place), "self", "This building", GEOJSON),
        link(finished.address(f"{collection}/buildings"), "collection", "The buildings", GEOJSON),
        link(finished.address(place, f="cityjson"), "alternate", "As CityJSON", CITYJSON),
    ]
    if found.mesh_path is not None:
        kind = found.mesh_path.rpartition(".")[2]
        links.append(link(finished.address(place, f=kind), "alternate", f"As {kind.upper()}", _FORMATS[kind]))
    return {
        **found.feature,
        "properties": {**found.feature["properties"], "planes": found.planes},
        **_crs_members(finished.catalogue.crs, native=native),
        "links": links,
    }


def _listed(name: str, values: list[str] | None, allowed: list[str], faults: list[str]) -> tuple[str, ...]:
    """The words of a parameter that may come several times, with commas, or both."""
    words = [word.strip() for value in values or () for word in value.split(",") if word.strip()]
    faults.extend(
        f"query {name} is {word[:80]!r}: use one of {', '.join(allowed)}" for word in words if word not in allowed
    )
    return tuple(dict.fromkeys(words))


def _crs_members(crs: ResultsCrs, *, native: bool) -> dict[str, Any]:
    """What is told of coordinates that are not CRS84; null where the CRS is unknown."""
    return {"coordRefSys": crs.uri or crs.name} if native else {}


def _headers(crs: ResultsCrs, *, native: bool) -> dict[str, str]:
    uri = crs.uri if native else _CRS84
    return {
        "Cache-Control": "private, no-cache",
        "Vary": "Accept",
        **({} if uri is None else {"Content-Crs": f"<{uri}>"}),
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
