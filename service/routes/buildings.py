"""Buildings of a job: pages of GeoJSON, and each one as a record, a mesh or a city object.

They can be read while the job runs: then pages are in the order in which the buildings were modelled, and say that the
list is not complete.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import AfterValidator

from pipeline.model import Reason, RoofType, Status
from service.errors import NoSuchBuildingError, ResultNotReadyError
from service.outputs.building_index import FEATURES_NAME
from service.outputs.building_pages import (
    MAX_LIMIT,
    MAX_OFFSET,
    BuildingPage,
    BuildingQuery,
    CoordinateChoice,
    building_page,
    checked_choice,
    parsed_bbox,
)
from service.outputs.catalogue import ResultsCrs
from service.outputs.kinds import CITYJSON, GEOJSON, GLB, OBJ
from service.outputs.single_building import (
    StoredBuilding,
    building_cityjson,
    building_decisions,
    building_glb,
    building_obj,
    points_of_building,
    stored_building,
)
from service.routes.answers import JOB_ID, document, header, problems, reference
from service.routes.bound import Base
from service.routes.finished_jobs import FinishedJob, FinishedRun, ReadableRun
from service.routes.negotiation import preferred
from service.routes.results import FAILED
from service.wire import patterns
from service.wire.base import link, respond
from service.wire.buildings import CityJson, Decision, Decisions, Feature, FeaturePage
from service.wire.queries import Statuses, entry_of, words

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
    "complete": True,
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}/buildings?limit=1", "rel": "self", "type": GEOJSON}],
    "features": [_FEATURE_EXAMPLE],
}
_DECISIONS_EXAMPLE = {
    "building_id": "3givd2mvtyerfjxv2yytjbmi",
    "decisions": [
        {"step": 0, "kind": "check", "name": "roof_points", "outcome": "met", "detail": "", "value": 412, "limit": 10},
        {
            "step": 1,
            "kind": "form",
            "name": "arrangement",
            "outcome": "chosen",
            "detail": "",
            "n_faces": 2,
            "n_planes": 2,
            "levelled_share": 0.0,
        },
    ],
    "links": [
        {
            "href": f"http://127.0.0.1:8000/jobs/{JOB_ID}/buildings/3givd2mvtyerfjxv2yytjbmi/decisions",
            "rel": "self",
            "type": "application/json",
        }
    ],
}
_CRS_HEADER = header("Content-Crs", "CRS of the coordinates; absent if it has no URI.")

_Coordinates = Annotated[
    CoordinateChoice | None,
    Query(
        alias="crs",
        description="Coordinates of the answer: CRS84 (longitude, latitude; the default) or native (easting, northing "
        "of the tiles). If the CRS of the tiles is unknown, only native is possible, and the default.",
    ),
]


_BuildingId = Annotated[
    str, Path(alias="buildingID", description="As in the lists.", examples=["3givd2mvtyerfjxv2yytjbmi"])
]
_RoofTypes = Annotated[list[Annotated[str, entry_of(RoofType)]] | None, AfterValidator(words(list(RoofType)))]
_Reasons = Annotated[list[Annotated[str, entry_of(Reason)]] | None, AfterValidator(words(list(Reason)))]


def _any_of(kind: type[Status | RoofType | Reason]) -> str:
    return f"Any of: {', '.join(kind)}; with commas, or the parameter again."


@dataclasses.dataclass(frozen=True)
class _Asked:
    """The query parameters of a page of buildings."""

    bbox: Annotated[
        str | None,
        Query(
            description="Only buildings whose footprint's bounds meet this window: west,south,east,north. Buildings "
            "without a footprint never do. Split a window over the 180th meridian into two requests.",
            examples=["9.99,53.55,10.01,53.57"],
            json_schema_extra=patterns.stated(patterns.WINDOW),
        ),
    ] = None
    bbox_crs: Annotated[
        CoordinateChoice | None, Query(alias="bbox-crs", description="Coordinates of bbox; CRS84 by default.")
    ] = None
    crs: _Coordinates = None
    status: Annotated[Statuses, Query(description=_any_of(Status))] = None
    roof_type: Annotated[_RoofTypes, Query(description=_any_of(RoofType))] = None
    reason: Annotated[_Reasons, Query(description=_any_of(Reason))] = None
    limit: Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Maximum number of buildings of the page.")] = 100
    offset: Annotated[int, Query(ge=0, le=MAX_OFFSET, description="Number of buildings before the page.")] = 0

    def query(self, known: ResultsCrs, *, by_arrival: bool) -> BuildingQuery:
        """The query, in the coordinates of the results."""
        bbox_native = checked_choice(self.bbox_crs, known, "bbox-crs")
        return BuildingQuery(
            bbox=None if self.bbox is None else parsed_bbox(self.bbox, native=bbox_native),
            bbox_native=bbox_native,
            native=checked_choice(self.crs, known, "crs"),
            statuses=tuple(self.status or ()),
            roof_types=tuple(self.roof_type or ()),
            reasons=tuple(self.reason or ()),
            limit=self.limit,
            offset=self.offset,
            by_arrival=by_arrival,
        )

    def again(self, label: str | None, start: int) -> str:
        """The same query, starting at another building."""
        lists = (("status", self.status), ("roof_type", self.roof_type), ("reason", self.reason))
        given = [
            ("method", label),
            ("bbox", self.bbox),
            ("bbox-crs", None if self.bbox_crs is None else self.bbox_crs.value),
            ("crs", None if self.crs is None else self.crs.value),
            *((name, ",".join(values or ()) or None) for name, values in lists),
            ("limit", self.limit),
            ("offset", start),
        ]
        return urlencode([(name, value) for name, value in given if value is not None])


@router.get(
    "/jobs/{jobID}/buildings",
    summary="Buildings of a job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "A page of buildings, sorted by building_id. One without an outline has a null geometry. "
            "While the job runs, these are the buildings so far, in the order in which they were modelled: `complete` "
            "is false.",
            "content": {GEOJSON: {"schema": reference(FeaturePage), "example": _PAGE_EXAMPLE}},
            "headers": _CRS_HEADER,
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def buildings(request: Request, finished: ReadableRun, base: Base, asked: Annotated[_Asked, Depends()]) -> Response:
    """List buildings by window, status, roof type and reason, in pages; also those that a running job has so far."""
    preferred(request.headers.get("accept"), [GEOJSON])
    known = finished.catalogue.crs
    query = asked.query(known, by_arrival=not finished.is_complete)
    if finished.has_buildings_yet:
        page = building_page(finished.out_dir, query)
    else:
        page = BuildingPage(matched=0, parts=(), path=finished.out_dir / FEATURES_NAME)
    collection = f"{base}/jobs/{finished.job.job_id}"
    limit, offset = asked.limit, asked.offset

    def at(start: int, rel: str, title: str) -> dict[str, Any]:
        href = f"{collection}/buildings?{asked.again(finished.label, start)}"
        return link(href, rel, title, GEOJSON).model_dump()

    links = [at(offset, "self", "These buildings"), link(collection, "collection", "The job").model_dump()]
    if offset + len(page.parts) < page.matched and page.parts:
        links.append(at(offset + limit, "next", "The next buildings"))
    if offset > 0:
        links.append(at(max(0, offset - limit), "prev", "The buildings before"))
    members = {**_state(finished), **_crs_members(known, native=query.native), "links": links}
    headers = _headers(finished, native=query.native)
    return StreamingResponse(page.chunks(members), media_type=GEOJSON, headers=headers)


@router.get(
    "/jobs/{jobID}/buildings/{buildingID}",
    summary="One building",
    response_class=Response,
    responses={
        200: {
            "description": "The record with its planes; or its mesh; or a CityJSON document of its own.",
            "content": {
                GEOJSON: {"schema": reference(Feature), "example": _FEATURE_EXAMPLE},
                OBJ: {"schema": {"type": "string"}},
                GLB: {"schema": {"type": "string", "format": "binary"}},
                CITYJSON: {"schema": reference(CityJson)},
            },
            "headers": _CRS_HEADER,
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def building(
    request: Request,
    finished: ReadableRun,
    base: Base,
    building_id: _BuildingId,
    wanted: Annotated[
        Literal["json", "obj", "glb", "cityjson"] | None,
        Query(alias="f", description="Overrides the header Accept."),
    ] = None,
    lod: Annotated[
        Literal["1.2", "1.3", "2.2", "2.3"] | None,
        Query(description="Level of detail of an OBJ or GLB, one that the job made; default that of the record."),
    ] = None,
    crs: _Coordinates = None,
) -> Response:
    """One building: all columns and its roof planes, or its model as OBJ, GLB or CityJSON."""
    media_type = (
        preferred(request.headers.get("accept"), list(_FORMATS.values())) if wanted is None else _FORMATS[wanted]
    )
    native = checked_choice(crs, finished.catalogue.crs, "crs")
    found = _found(finished, building_id, media_type, native=native)
    headers = _headers(finished, native=native or media_type != GEOJSON)
    if media_type == OBJ:
        lines = building_obj(finished.run_dir, found, lod)
        content = "".join(f"{line}\n" for line in lines).encode()
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.obj"'
    elif media_type == GLB:
        content = building_glb(finished.run_dir, found, lod)
        headers.pop("Content-Crs", None)  # metres from an origin, which the file states
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.glb"'
    elif media_type == CITYJSON:
        content = _json(building_cityjson(finished.run_dir, found))
        headers["Content-Disposition"] = f'inline; filename="{found.building_id}.city.json"'
    else:
        content = _json(_feature(found, finished, base, native=native))
    return Response(content, media_type=media_type, headers=headers)


@router.get(
    "/jobs/{jobID}/buildings/{buildingID}/points",
    summary="Points of one building",
    response_class=Response,
    responses={
        200: {
            "description": "The points from which the building was modelled, each with class, roof plane and vertical "
            "distance to the model, in the form of the nodes of the points' octree.",
            "content": {GLB: {"schema": {"type": "string", "format": "binary"}}},
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def points(
    request: Request,
    finished: FinishedRun,
    building_id: _BuildingId,
) -> Response:
    """The points of one building as GLB, if the job was requested with points."""
    preferred(request.headers.get("accept"), [GLB])
    found = stored_building(finished.out_dir, building_id)
    content = points_of_building(finished.run_dir, found)
    headers = {
        "Cache-Control": "private, no-cache",
        "Vary": "Accept",
        "Content-Disposition": f'inline; filename="{found.building_id}-points.glb"',
    }
    return Response(content, media_type=GLB, headers=headers)


@router.get(
    "/jobs/{jobID}/buildings/{buildingID}/decisions",
    summary="Decisions about one building",
    response_class=Response,
    responses={
        200: document(Decisions, "The checks, forms and levels of detail, in their order.", _DECISIONS_EXAMPLE),
        **problems(400, 404, *FAILED),
    },
)
def decisions(finished: FinishedRun, base: Base, building_id: _BuildingId) -> Response:
    """The figures that decided on a building's model, each with its limit, and the forms that were tried."""
    entries = building_decisions(finished.out_dir, building_id)
    place = f"{base}/jobs/{finished.job.job_id}/buildings/{building_id}"
    answer = Decisions(
        building_id=building_id,
        decisions=[Decision(**entry) for entry in entries],
        links=[
            link(finished.address(f"{place}/decisions"), "self", "These decisions"),
            link(finished.address(place), "up", "The building", GEOJSON),
        ],
    )
    return respond(answer, headers={"Cache-Control": "private, no-cache"})


def _found(finished: FinishedJob, building_id: str, media_type: str, *, native: bool) -> StoredBuilding:
    """The building of a job.

    Raises
    ------
    NoSuchBuildingError
        No building of the job has this id.
    ResultNotReadyError
        The job runs, and has not modelled the building or not written its mesh yet.
    """
    later = f"while job {finished.job.job_id} runs ({finished.job.progress} %)"
    if not finished.is_complete and media_type in {OBJ, GLB}:
        raise ResultNotReadyError(f"there are no meshes {later}: use f=cityjson, or ask again when it is over")
    try:
        if finished.has_buildings_yet:
            return stored_building(finished.out_dir, building_id, native=native)
        raise NoSuchBuildingError(building_id)  # noqa: TRY301
    except NoSuchBuildingError:
        if finished.is_complete:
            raise
        problem = f"there is no building {building_id[:80]!r} {later}: it may come, ask again later"
        raise ResultNotReadyError(problem) from None


def _feature(found: StoredBuilding, finished: FinishedJob, base: str, *, native: bool) -> dict[str, Any]:
    """The building's feature with its planes and links."""
    collection = f"{base}/jobs/{finished.job.job_id}"
    place = f"{collection}/buildings/{found.building_id}"
    links = [
        link(finished.address(place), "self", "This building", GEOJSON),
        link(finished.address(f"{collection}/buildings"), "collection", "The buildings", GEOJSON),
        link(finished.address(place, f="cityjson"), "alternate", "As CityJSON", CITYJSON),
        link(finished.address(f"{place}/decisions"), "related", "What was checked and tried"),
    ]
    if found.mesh_path is not None:
        kind = found.mesh_path.rpartition(".")[2]
        links.append(link(finished.address(place, f=kind), "alternate", f"As {kind.upper()}", _FORMATS[kind]))
    return {
        **found.feature,
        "properties": {**found.feature["properties"], "planes": found.planes},
        **_crs_members(finished.catalogue.crs, native=native),
        "links": [entry.model_dump() for entry in links],
    }


def _crs_members(crs: ResultsCrs, *, native: bool) -> dict[str, Any]:
    """The members for coordinates that are not CRS84, null if the CRS is unknown, and for elevations."""
    found: dict[str, Any] = {"coordRefSys": crs.uri or crs.name} if native else {}
    return found if crs.vertical_unit_m is None else {**found, "verticalUnitM": crs.vertical_unit_m}


def _state(finished: FinishedJob) -> dict[str, Any]:
    """Whether the list is complete; if not, how far the job is."""
    if finished.is_complete:
        return {"complete": True}
    return {"complete": False, "progress": finished.job.progress, "attempt": finished.job.attempt}


def _headers(finished: FinishedJob, *, native: bool) -> dict[str, str]:
    uri = finished.catalogue.crs.uri if native else _CRS84
    return {
        # the next answer of a running job is another one
        "Cache-Control": "private, no-cache" if finished.is_complete else "no-store",
        "Vary": "Accept",
        **({} if uri is None else {"Content-Crs": f"<{uri}>"}),
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
