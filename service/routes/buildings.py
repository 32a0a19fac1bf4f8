"""Buildings of a job: pages of GeoJSON, and each one as a record, a mesh or a city object.

They can be read while the job runs: then pages are in the order in which the buildings were modelled, and say that the
list is not complete.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import AfterValidator

from pipeline.model import Reason, RoofType, Status
from service.errors import NoSuchBuildingError, RequestError, ResultNotReadyError
from service.features.index import CRS84, RowIndex
from service.features.pages import Condition, among, bounded_by, collected, feature_texts, sorted_page
from service.outputs.catalogue import ResultsCrs
from service.outputs.kinds import CITYJSON, GEOJSON, GLB, OBJ
from service.outputs.single_building import (
    StoredBuilding,
    building_cityjson,
    building_decisions,
    building_glb,
    building_obj,
    cityjson_so_far,
    points_of_building,
    stored_building,
)
from service.routes.answers import FEATURE_EXAMPLE, JOB_ID, document, header, problems, reference
from service.routes.bound import Base
from service.routes.finished_jobs import FinishedJob, FinishedRun, ReadableRun
from service.routes.negotiation import preferred
from service.routes.results import FAILED
from service.wire import patterns
from service.wire.base import link, page_links, respond
from service.wire.buildings import CityJson, Decision, Decisions, Feature, FeaturePage
from service.wire.queries import Statuses, entry_of, window, words

router = APIRouter(tags=["results"])

_FORMATS: Mapping[str, str] = {"json": GEOJSON, "obj": OBJ, "glb": GLB, "cityjson": CITYJSON}
_URI = CRS84


class CoordinateChoice(StrEnum):
    """The coordinates of a request."""

    CRS84 = "CRS84"
    """Longitude and latitude in WGS 84."""
    CRS84_URI = _URI
    """The same by its full name."""
    NATIVE = "native"
    """Easting and northing of the tiles, in their own units."""


_PAGE_EXAMPLE = {
    "type": "FeatureCollection",
    "numberMatched": 154,
    "numberReturned": 1,
    "complete": True,
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}/buildings?limit=1", "rel": "self", "type": GEOJSON}],
    "features": [FEATURE_EXAMPLE],
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
            "without a footprint never do. In degrees it may cross the 180th meridian.",
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
    limit: Annotated[int, Query(ge=1, le=10_000, description="Maximum number of buildings of the page.")] = 100
    offset: Annotated[int, Query(ge=0, le=10**12, description="Number of buildings before the page.")] = 0

    def conditions(self, known: ResultsCrs) -> list[Condition]:
        """What buildings must meet."""
        native = _is_native(self.bbox_crs, known, "bbox-crs")
        chosen = (("status", self.status), ("roof_type", self.roof_type), ("reason", self.reason))
        found = [among(column, allowed) for column, allowed in chosen if allowed]
        if self.bbox is not None:
            found.append(bounded_by(window(self.bbox, in_degrees=not native), native=native))
        return found


@router.get(
    "/jobs/{jobID}/buildings",
    summary="Buildings of a job",
    response_class=Response,
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
    conditions, native = asked.conditions(known), _is_native(asked.crs, known, "crs")
    matched, positions = 0, list[int]()
    texts: Iterator[bytes] = iter(())
    if finished.has_buildings_yet:
        # a list that grows does so at its end
        order = "id" if finished.is_complete else "position"
        matched, positions = sorted_page(finished.index, conditions, by=order, limit=asked.limit, offset=asked.offset)
        texts = _texts(finished.index, positions, native=native)
    collection = f"{base}/jobs/{finished.job.job_id}"
    given = [entry for entry in request.query_params.multi_items() if entry[0] not in {"limit", "offset", "method"}]
    found = matched - asked.offset if positions else 0
    links = page_links(
        f"{collection}/buildings", [*given, ("method", finished.label)], found, asked.limit, asked.offset, GEOJSON
    )
    links.append(link(collection, "collection", "The job"))
    members = {
        "numberMatched": matched,
        "numberReturned": len(positions),
        **_state(finished),
        **_crs_members(known, native=native),
        "links": [one.model_dump() for one in links],
    }
    headers = _headers(finished, native=native)
    return Response(b"".join(collected(members, texts)), media_type=GEOJSON, headers=headers)


def _texts(index: RowIndex, positions: Sequence[int], *, native: bool) -> Iterator[bytes]:
    """Buildings as GeoJSON, in degrees or in the coordinates of the tiles."""
    return feature_texts(index, "buildings", positions, (lambda shapes: shapes) if native else None)


@router.get(
    "/jobs/{jobID}/buildings/{buildingID}",
    summary="One building",
    response_class=Response,
    responses={
        200: {
            "description": "The record with its planes; or its mesh; or a CityJSON document of its own.",
            "content": {
                GEOJSON: {"schema": reference(Feature), "example": FEATURE_EXAMPLE},
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
        Literal["1.2", "1.3", "2.0", "2.2", "2.3"] | None,
        Query(description="Level of detail of an OBJ or GLB, one that the job made; default that of the record."),
    ] = None,
    crs: _Coordinates = None,
) -> Response:
    """One building: all columns and its roof planes, or its model as OBJ, GLB or CityJSON."""
    media_type = (
        preferred(request.headers.get("accept"), list(_FORMATS.values())) if wanted is None else _FORMATS[wanted]
    )
    native = _is_native(crs, finished.catalogue.crs, "crs")
    found = _found(finished, building_id, media_type)
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
        made = building_cityjson if finished.is_complete else cityjson_so_far
        content = _json(made(finished.run_dir, found))
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
    found = stored_building(finished.index, building_id)
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
    entries = building_decisions(finished.run_dir, stored_building(finished.index, building_id))
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


def _found(finished: FinishedJob, building_id: str, media_type: str) -> StoredBuilding:
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
            return stored_building(finished.index, building_id)
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
    (text,) = _texts(finished.index, [found.position], native=native)
    feature = json.loads(text)
    return {
        **feature,
        "properties": {**feature["properties"], "planes": found.planes},
        **_crs_members(finished.catalogue.crs, native=native),
        "links": [entry.model_dump() for entry in links],
    }


def _is_native(choice: CoordinateChoice | None, crs: ResultsCrs, parameter: str) -> bool:
    """Whether the tiles' own coordinates are requested; they are the only ones if the CRS is unknown.

    Raises
    ------
    RequestError
        WGS 84 is requested, but the CRS of the tiles is unknown.
    """
    if crs.is_known or choice is CoordinateChoice.NATIVE:
        return choice is CoordinateChoice.NATIVE
    if choice is not None:
        fault = f"query {parameter} is {choice.value}, but the CRS of the tiles is unknown or local"
        raise RequestError([f"{fault}: use native, or leave it out"])
    return True


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
    uri = finished.catalogue.crs.uri if native else _URI
    return {
        # the next answer of a running job is another one
        "Cache-Control": "private, no-cache" if finished.is_complete else "no-store",
        "Vary": "Accept",
        **({} if uri is None else {"Content-Crs": f"<{uri}>"}),
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
