"""Buildings of a finished job: pages of GeoJSON, and each one as a record, a mesh or a city object."""

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
    StoredBuilding,
    building_cityjson,
    building_glb,
    building_obj,
    stored_building,
)
from service.routes.answers import JOB_ID, header, problems, reference
from service.routes.bound import Base
from service.routes.finished_jobs import FinishedJob, FinishedRun
from service.routes.negotiation import preferred
from service.routes.results import FAILED
from service.wire.base import link
from service.wire.buildings import CityJson, Feature, FeaturePage
from service.wire.queries import words

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
_CRS_HEADER = header("Content-Crs", "CRS of the coordinates; absent if it has no URI.")

_Coordinates = Annotated[
    CoordinateChoice | None,
    Query(
        alias="crs",
        description="Coordinates of the answer: CRS84 (longitude, latitude; the default) or native (easting, northing "
        "of the tiles). If the CRS of the tiles is unknown, only native is possible, and the default.",
    ),
]


_Statuses = Annotated[list[str] | None, AfterValidator(words(list(Status)))]
_RoofTypes = Annotated[list[str] | None, AfterValidator(words(list(RoofType)))]
_Reasons = Annotated[list[str] | None, AfterValidator(words(list(Reason)))]


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
        ),
    ] = None
    bbox_crs: Annotated[
        CoordinateChoice | None, Query(alias="bbox-crs", description="Coordinates of bbox; CRS84 by default.")
    ] = None
    crs: _Coordinates = None
    status: Annotated[_Statuses, Query(description=_any_of(Status))] = None
    roof_type: Annotated[_RoofTypes, Query(description=_any_of(RoofType))] = None
    reason: Annotated[_Reasons, Query(description=_any_of(Reason))] = None
    limit: Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Maximum number of buildings of the page.")] = 100
    offset: Annotated[int, Query(ge=0, le=MAX_OFFSET, description="Number of buildings before the page.")] = 0

    def query(self, known: ResultsCrs) -> BuildingQuery:
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
            "description": "A page of buildings, sorted by building_id. One without an outline has a null geometry.",
            "content": {GEOJSON: {"schema": reference(FeaturePage), "example": _PAGE_EXAMPLE}},
            "headers": _CRS_HEADER,
        },
        **problems(400, 404, 406, *FAILED),
    },
)
def buildings(request: Request, finished: FinishedRun, base: Base, asked: Annotated[_Asked, Depends()]) -> Response:
    """List buildings by window, status, roof type and reason, in pages."""
    preferred(request.headers.get("accept"), [GEOJSON])
    known = finished.catalogue.crs
    query = asked.query(known)
    page = building_page(finished.out_dir, query)
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
    members = {**_crs_members(known, native=query.native), "links": links}
    return StreamingResponse(page.chunks(members), media_type=GEOJSON, headers=_headers(known, native=query.native))


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
    finished: FinishedRun,
    base: Base,
    building_id: Annotated[
        str, Path(alias="buildingID", description="As in the lists.", examples=["3givd2mvtyerfjxv2yytjbmi"])
    ],
    wanted: Annotated[
        Literal["json", "obj", "glb", "cityjson"] | None,
        Query(alias="f", description="Overrides the header Accept."),
    ] = None,
    lod: Annotated[
        Literal["1.2", "1.3", "2.2"] | None,
        Query(description="Level of detail of an OBJ or GLB, one that the job made; default the finest."),
    ] = None,
    crs: _Coordinates = None,
) -> Response:
    """One building: all columns and its roof planes, or its model as OBJ, GLB or CityJSON."""
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
        headers.pop("Content-Crs", None)  # metres from an origin, which the file states
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
        "links": [entry.model_dump() for entry in links],
    }


def _crs_members(crs: ResultsCrs, *, native: bool) -> dict[str, Any]:
    """The member for coordinates that are not CRS84; null if the CRS is unknown."""
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
