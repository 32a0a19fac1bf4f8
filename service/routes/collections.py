"""OGC API - Features: the tables of finished jobs and of published runs as collections.

Modules that read Parquet are imported in the functions that need them: the start of the API loads no Arrow.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import AfterValidator

from service.auth import Principal
from service.errors import NoSuchCollectionError, NoSuchJobError, NoSuchOutputError, RequestError, ResultNotReadyError
from service.features.runs import ServedRun, split_id
from service.files import StateFolder, is_id
from service.jobs import Job, JobStatus
from service.outputs.kinds import GEOJSON
from service.problems import JobFailedError
from service.routes.answers import document, header, problems, reference
from service.routes.bound import Base, Folder, Reader, Store
from service.routes.finished_jobs import results_of
from service.routes.negotiation import preferred
from service.store import JobStore
from service.store.queries import JobFilter
from service.wire import patterns
from service.wire.base import RELATIONS, Link, link, page_links, respond, timestamp
from service.wire.features import (
    Collection,
    CollectionFeature,
    CollectionPage,
    Collections,
    Extent,
    JsonSchema,
    SpatialExtent,
    TemporalExtent,
)
from service.wire.queries import interval

if TYPE_CHECKING:
    from service.features.cql2 import Filter
    from service.features.pages import FeatureQuery
    from service.features.tables import Layer, OpenRun

FEATURES = "http://www.opengis.net/spec/ogcapi-features-"
CQL2 = "http://www.opengis.net/spec/cql2/1.0/conf/"
CONFORMANCE = (
    *(f"{FEATURES}1/1.0/conf/{name}" for name in ("core", "geojson", "oas30")),
    f"{FEATURES}2/1.0/conf/crs",
    *(f"{FEATURES}3/1.0/conf/{name}" for name in ("queryables", "queryables-query-parameters")),
    *(f"{FEATURES}3/1.0/conf/{name}" for name in ("filter", "features-filter")),
    *(f"{CQL2}{name}" for name in ("cql2-text", "cql2-json", "basic-cql2", "advanced-comparison-operators")),
    *(f"{CQL2}{name}" for name in ("basic-spatial-functions", "basic-spatial-functions-plus", "spatial-functions")),
)
"""The implemented parts of OGC API - Features and of CQL2."""

SCHEMA_TYPE = "application/schema+json"
MAX_LIMIT = 10_000
"""Maximum number of features of one page."""
MAX_START = 2**53 - 1
_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
_CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
_NOT_SHOWN = (NoSuchCollectionError, NoSuchOutputError, ResultNotReadyError, JobFailedError)

router = APIRouter(tags=["features"])

_CollectionId = Annotated[
    str, Path(alias="collectionID", description="RUN.TABLE, as in the list.", examples=["delft.buildings"])
]
_FeatureId = Annotated[
    str, Path(alias="featureID", description="As in the pages.", examples=["3givd2mvtyerfjxv2yytjbmi"])
]
_URI = patterns.stated(patterns.CRS_URI)
_Crs = Annotated[
    str | None,
    Query(alias="crs", description="CRS of the answer; one of the collection's `crs`.", json_schema_extra=_URI),
]
_CRS_HEADER = header("Content-Crs", "CRS of the coordinates.")

_COLLECTION_EXAMPLE: dict[str, Any] = {
    "id": "delft.buildings",
    "title": "delft: buildings",
    "description": "footprints of all candidates, with status and figures",
    "itemType": "feature",
    "extent": {"spatial": {"bbox": [[4.35, 51.99, 4.38, 52.01]], "crs": _CRS84}},
    "crs": [_CRS84, "http://www.opengis.net/def/crs/EPSG/0/28992"],
    "storageCrs": "http://www.opengis.net/def/crs/EPSG/0/28992",
    "links": [{"href": "http://127.0.0.1:8000/collections/delft.buildings/items", "rel": "items", "type": GEOJSON}],
}
_FEATURE_EXAMPLE: dict[str, Any] = {
    "type": "Feature",
    "id": "3givd2mvtyerfjxv2yytjbmi",
    "geometry": {"type": "Polygon", "coordinates": [[[4.36, 52.0], [4.37, 52.0], [4.37, 52.01], [4.36, 52.0]]]},
    "properties": {"building_id": "3givd2mvtyerfjxv2yytjbmi", "status": "ok", "height_m": 7.618},
}
_PAGE_EXAMPLE = {
    "type": "FeatureCollection",
    "timeStamp": "2026-03-01T09:30:00.000Z",
    "numberMatched": 257,
    "numberReturned": 1,
    "links": [{"href": "http://127.0.0.1:8000/collections/delft.buildings/items", "rel": "self", "type": GEOJSON}],
    "features": [_FEATURE_EXAMPLE],
}


# --- which runs ------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """The runs that a caller may read."""

    published: Mapping[str, ServedRun]
    """Those of the operator."""
    store: JobStore
    """Those of jobs."""
    folder: StateFolder
    """Their files."""
    caller: Principal
    """The caller."""

    def run(self, name: str) -> ServedRun:
        """The run with a name. Only names of the settings and ids of jobs ever become a path.

        Raises
        ------
        NoSuchCollectionError
            There is none, or it belongs to another key.
        """
        if name in self.published:
            return self.published[name]
        job_id = name.partition(".")[0]
        if is_id(job_id):
            try:
                job = self.store.get(job_id, owner=self.caller.owner)
            except NoSuchJobError:
                job = None
            found = [run for run in self.of_job(job) if run.name == name] if job is not None else []
            if found:
                return found[0]
        raise NoSuchCollectionError(
            f"there is no run {name[:80]!r} with collections: /collections lists all; those of a job are there when "
            "it is over, those of a comparison are JOB.METHOD"
        )

    def of_job(self, job: Job) -> list[ServedRun]:
        """The runs of a job that is over: several of a comparison, none of one without buildings."""
        if not job.request.has_buildings:
            return []
        finished = results_of(job, self.folder)
        index_dir = self.folder.attempt(job.job_id, job.attempt) / "features"
        runs = [finished.run(label) for label in finished.catalogue.runs] or [finished]
        return [
            ServedRun(
                name=job.job_id if one.label is None else f"{job.job_id}.{one.label}",
                place=str(one.run_dir),
                index_dir=index_dir,
                is_job=True,
            )
            for one in runs
        ]

    def page(self, limit: int, offset: int) -> tuple[list[ServedRun], int]:
        """Published runs on the first page, then those of jobs; and the number of jobs found, up to `limit` + 1."""
        criteria = JobFilter(
            owner=self.caller.owner,
            statuses=[JobStatus.SUCCESSFUL],
            process_ids=["reconstruct", "compare"],
            limit=limit + 1,
            offset=offset,
        )
        jobs = self.store.list(criteria)
        found = list(self.published.values()) if offset == 0 else []
        for job in jobs[:limit]:
            try:
                found += self.of_job(job)
            except _NOT_SHOWN:
                continue  # its files are gone
        return found, len(jobs)


def _catalogue(request: Request, store: Store, folder: Folder, caller: Reader) -> Catalogue:
    return Catalogue(published=request.app.state.published, store=store, folder=folder, caller=caller)


_Runs = Annotated[Catalogue, Depends(_catalogue)]


def _opened(runs: Catalogue, collection_id: str) -> tuple[OpenRun, Layer]:
    """The run and the table of a collection."""
    from service.features.tables import LAYERS, open_run

    name, table = split_id(collection_id)
    return open_run(runs.run(name)), LAYERS[table]


# --- collections -----------------------------------------------------------------------------------------------------


@router.get(
    "/collections",
    summary="List the collections of features",
    responses={200: document(Collections, "The collections.", {"links": [], "collections": [_COLLECTION_EXAMPLE]})},
)
def collections(
    runs: _Runs,
    base: Base,
    limit: Annotated[int, Query(ge=1, le=100, description="Maximum number of jobs whose runs are listed.")] = 10,
    offset: Annotated[int, Query(ge=0, le=2**31 - 1, description="Number of jobs before the page.")] = 0,
) -> Response:
    """List published runs and runs of jobs, each with its tables; a run whose CRS is unknown has no collections."""
    from service.features.tables import layers, open_run

    found, n_jobs = runs.page(limit, offset)
    listed: list[Collection] = []
    for served in found:
        try:
            run = open_run(served)
        except _NOT_SHOWN:
            continue
        listed += [_described(run, layer, base) for layer in layers()]
    links = page_links(f"{base}/collections", [], n_jobs, limit, offset)
    return respond(Collections(links=links, collections=listed))


@router.get(
    "/collections/{collectionID}",
    summary="A collection",
    responses={200: document(Collection, "The collection.", _COLLECTION_EXAMPLE), **problems(404)},
)
def collection(runs: _Runs, base: Base, collection_id: _CollectionId) -> Response:
    """Describe a collection: its extent, its coordinate reference systems, its links."""
    return respond(_described(*_opened(runs, collection_id), base))


def _described(run: OpenRun, layer: Layer, base: str) -> Collection:
    totals = run.totals(layer.table)
    place = f"{base}/collections/{run.run.collection_id(layer.table)}"
    bounds = None if totals.bounds is None else run.crs.outside(totals.bounds, run.crs.named(None, "crs"))
    spatial = None if bounds is None else SpatialExtent(bbox=[[round(value, 7) for value in bounds]], crs=_CRS84)
    temporal = TemporalExtent(interval=[list(totals.times)]) if totals.times != (None, None) else None
    links = [
        link(place, "self", "This collection"),
        link(f"{place}/items", "items", "The features", GEOJSON),
        link(f"{place}/queryables", f"{RELATIONS}queryables", "The properties for filters", SCHEMA_TYPE),
        link(f"{place}/schema", "describedby", "The JSON schema of the features", SCHEMA_TYPE),
    ]
    if (run.licence or "").startswith(("http://", "https://")):
        links.append(Link(href=str(run.licence), rel="license", title="Licence of the source data"))
    licence = f"; licence of the source data: {run.licence}" if run.licence else ""
    return Collection(
        id=run.run.collection_id(layer.table),
        title=f"{run.run.name}: {layer.table}",
        description=layer.title + _elevations(run, layer) + licence,
        itemType="feature",
        extent=Extent(spatial=spatial, temporal=temporal) if spatial or temporal else None,
        crs=run.crs.uris,
        storageCrs=run.crs.storage_uri,
        links=links,
    )


def _elevations(run: OpenRun, layer: Layer) -> str:
    """Half a sentence about the unit of the properties that are elevations, where it is not the metre."""
    from pipeline.export.columns import ELEVATIONS
    from pipeline.io.crs_units import unit_name

    unit_m = run.crs.vertical_unit_m
    if unit_m == 1.0 or not ELEVATIONS[layer.table]:
        return ""
    return f"; elevations that are properties are in units of {unit_m:.12g} m ({unit_name(unit_m)})"


_SCHEMA_ANSWER = {
    200: {"description": "A JSON schema.", "content": {SCHEMA_TYPE: {"schema": reference(JsonSchema)}}},
    **problems(404),
}


@router.get(
    "/collections/{collectionID}/queryables",
    summary="Properties for filters",
    response_class=Response,
    responses=_SCHEMA_ANSWER,
)
def queryables(runs: _Runs, base: Base, collection_id: _CollectionId) -> Response:
    """The properties that filters and query parameters can name, with their types."""
    return _schema(runs, base, collection_id, "queryables")


@router.get(
    "/collections/{collectionID}/schema",
    summary="Properties of features",
    response_class=Response,
    responses=_SCHEMA_ANSWER,
)
def schema(runs: _Runs, base: Base, collection_id: _CollectionId) -> Response:
    """A JSON schema of the features, with the types of their properties."""
    return _schema(runs, base, collection_id, "schema")


def _schema(runs: Catalogue, base: str, collection_id: str, kind: Literal["queryables", "schema"]) -> Response:
    run, layer = _opened(runs, collection_id)
    name = run.run.collection_id(layer.table)
    found = JsonSchema(
        **{"$schema": _SCHEMA, "$id": f"{base}/collections/{name}/{kind}"},
        type="object",
        title=f"{run.run.name}: {layer.table}",
        additionalProperties=kind == "schema",
        properties=layer.filter_schema(run.crs) if kind == "queryables" else layer.feature_schema(run.crs),
    )
    return respond(found, media_type=SCHEMA_TYPE)


# --- features --------------------------------------------------------------------------------------------------------


def _is_interval(text: str | None) -> str | None:
    interval(text)
    return text


@dataclasses.dataclass(frozen=True)
class _Asked:
    """The query parameters of a page of features, without those that name properties."""

    bbox: Annotated[
        str | None,
        Query(
            description="Only features that meet this window: four numbers in the axis order of `bbox-crs`; in degrees "
            "it may cross the 180th meridian. Features without geometry are always there.",
            examples=["4.35,51.99,4.37,52.01"],
            json_schema_extra=patterns.stated(patterns.WINDOW),
        ),
    ] = None
    bbox_crs: Annotated[
        str | None,
        Query(alias="bbox-crs", description="CRS of bbox; CRS84 by default.", json_schema_extra=_URI),
    ] = None
    crs: _Crs = None
    datetime: Annotated[
        str | None,
        AfterValidator(_is_interval),
        Query(
            description="Only features whose points were acquired then: an RFC 3339 time, or `a/b`, `../b`, `a/..`. "
            "Features without such times are always there.",
            json_schema_extra=patterns.stated(patterns.INTERVAL),
        ),
    ] = None
    filter: Annotated[
        str | None, Query(description="A filter in CQL2.", examples=["status = 'ok' AND height_m > 12"])
    ] = None
    filter_lang: Annotated[
        Literal["cql2-text", "cql2-json"], Query(alias="filter-lang", description="Language of the filter.")
    ] = "cql2-text"
    filter_crs: Annotated[
        str | None,
        Query(
            alias="filter-crs",
            description="CRS of coordinates in the filter; CRS84 by default.",
            json_schema_extra=_URI,
        ),
    ] = None
    limit: Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Maximum number of features of the page.")] = 100
    start: Annotated[
        int,
        Query(ge=0, le=MAX_START, description="Position in the collection where the page begins; as in `next` links."),
    ] = 0


_NAMES = {"bbox", "bbox-crs", "crs", "datetime", "filter", "filter-lang", "filter-crs", "limit", "start"}
_PROPERTY_PARAMETERS = {
    "parameters": [
        {
            "name": "properties",
            "in": "query",
            "description": "Each property of the queryables is a parameter: only features with this value, such as "
            "`status=ok`.",
            "required": False,
            "style": "form",
            "explode": True,
            "schema": {"type": "object", "additionalProperties": {"type": "string"}},
            "example": {"status": "ok"},
        }
    ]
}


def _query(run: OpenRun, layer: Layer, asked: _Asked, given: Sequence[tuple[str, str]]) -> FeatureQuery:
    """The query for a page; all of it is checked before anything is read."""
    from service.features.coordinates import parsed_window
    from service.features.cql2 import compiled, equality, parsed
    from service.features.pages import FeatureQuery

    bbox_crs, filter_crs = run.crs.named(asked.bbox_crs, "bbox-crs"), run.crs.named(asked.filter_crs, "filter-crs")
    unknown = [name for name, _ in given if name not in layer.queryables]
    if unknown:
        known = f"{', '.join(sorted(_NAMES))}, or a property of its queryables"
        raise RequestError([f"query {name[:80]!r} is not known: use {known}" for name in dict.fromkeys(unknown)])
    twice = {name: number for name, number in Counter(name for name, _ in given).items() if number > 1}
    if twice:
        raise RequestError([f"query {name} is given {number} times: give it once" for name, number in twice.items()])
    filters: list[Filter] = [
        compiled(equality(name, value, layer.queryables), layer.queryables, filter_crs) for name, value in given
    ]
    if asked.filter is not None:
        filters.append(compiled(parsed(asked.filter, asked.filter_lang), layer.queryables, filter_crs))
    boxes = None if asked.bbox is None else parsed_window(asked.bbox, bbox_crs)
    selecting = (asked.bbox, bbox_crs.uri, asked.datetime, asked.filter, asked.filter_lang, filter_crs.uri, *given)
    return FeatureQuery(
        crs=run.crs.named(asked.crs, "crs"),
        boxes=boxes,
        boxes_crs=bbox_crs,
        interval=None if asked.datetime is None else interval(asked.datetime),
        filters=filters,
        filter_crs=filter_crs,
        key=json.dumps(selecting),
        limit=asked.limit,
        start=asked.start,
    )


@router.get(
    "/collections/{collectionID}/items",
    summary="Features of a collection",
    response_class=Response,
    responses={
        200: {
            "description": "A page of features, in an order that stays the same. If there are more, it has a link "
            "`next`; it can have fewer than `limit` also then.",
            "content": {GEOJSON: {"schema": reference(CollectionPage), "example": _PAGE_EXAMPLE}},
            "headers": _CRS_HEADER,
        },
        **problems(404, 406),
    },
    openapi_extra=_PROPERTY_PARAMETERS,
)
def items(
    request: Request, runs: _Runs, base: Base, collection_id: _CollectionId, asked: Annotated[_Asked, Depends()]
) -> Response:
    """List features by window, time, property and filter, in pages."""
    from service.features.pages import feature_page

    preferred(request.headers.get("accept"), [GEOJSON])
    run, layer = _opened(runs, collection_id)
    everything = request.query_params.multi_items()
    query = _query(run, layer, asked, [(name, value) for name, value in everything if name not in _NAMES])
    page = feature_page(run, layer, query)
    place = f"{base}/collections/{run.run.collection_id(layer.table)}"

    def at(given: Sequence[tuple[str, str]]) -> str:
        return f"{place}/items?{urlencode(given)}" if given else f"{place}/items"

    links = [link(at(everything), "self", "These features", GEOJSON), link(place, "collection", "The collection")]
    if page.following is not None:
        again = [(name, value) for name, value in everything if name not in {"start", "limit"}]
        again += [("limit", str(asked.limit)), ("start", str(page.following))]
        links.append(link(at(again), "next", "The next features", GEOJSON))
    members: dict[str, Any] = {"type": "FeatureCollection", "timeStamp": timestamp(dt.datetime.now(dt.UTC))}
    if page.matched is not None:
        members["numberMatched"] = page.matched
    members |= {"numberReturned": len(page.features), "links": [one.model_dump() for one in links]}
    body = b"".join(_collected(members, page.features))
    return Response(body, media_type=GEOJSON, headers=_headers(query.crs.uri))


def _collected(members: Mapping[str, Any], features: Sequence[bytes]) -> Iterator[bytes]:
    yield json.dumps(members, ensure_ascii=False).encode()[:-1] + b',"features":[\n'
    yield b",\n".join(features)
    yield b"\n]}\n"


def _headers(crs: str) -> dict[str, str]:
    return {"Content-Crs": f"<{crs}>", "Cache-Control": "private, no-cache", "Vary": "Accept"}


@router.get(
    "/collections/{collectionID}/items/{featureID}",
    summary="One feature",
    response_class=Response,
    responses={
        200: {
            "description": "The feature.",
            "content": {GEOJSON: {"schema": reference(CollectionFeature), "example": _FEATURE_EXAMPLE}},
            "headers": _CRS_HEADER,
        },
        **problems(404, 406),
    },
)
def item(
    request: Request,
    runs: _Runs,
    base: Base,
    collection_id: _CollectionId,
    feature_id: _FeatureId,
    crs: _Crs = None,
) -> Response:
    """One feature by its id."""
    from service.features.pages import single_feature

    preferred(request.headers.get("accept"), [GEOJSON])
    run, layer = _opened(runs, collection_id)
    named = run.crs.named(crs, "crs")
    text = single_feature(run, layer, feature_id, named)
    place = f"{base}/collections/{run.run.collection_id(layer.table)}"
    links = [
        link(f"{place}/items/{feature_id}", "self", "This feature", GEOJSON),
        link(place, "collection", "The collection"),
    ]
    if run.run.is_job and layer.table == "buildings" and "." not in run.run.name:
        building = f"{base}/jobs/{run.run.name}/buildings/{feature_id}"
        links.append(link(building, "related", "The building with its planes and models", GEOJSON))
    body = text[:-1] + b',"links":' + json.dumps([one.model_dump() for one in links]).encode() + b"}"
    return Response(body, media_type=GEOJSON, headers=_headers(named.uri))
