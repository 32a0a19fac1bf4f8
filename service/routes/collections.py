"""OGC API - Features: the tables of finished jobs and of published runs as collections.

Modules that read Parquet are imported in the functions that need them: the start of the API loads no Arrow.
"""

from __future__ import annotations

import contextlib
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
from service.errors import (
    NoSuchCollectionError,
    NoSuchFeatureError,
    NoSuchJobError,
    NoSuchOutputError,
    RequestError,
    ResultNotReadyError,
)
from service.features.index import CRS84, TABLES
from service.features.pages import Search, ShapeTest, acquired_in, collected, feature_texts
from service.features.runs import OpenRun, PublishedRun, split_id
from service.files import StateFolder, is_id
from service.jobs import Job, JobStatus
from service.outputs.kinds import GEOJSON
from service.problems import JobFailedError
from service.routes.answers import FEATURE_EXAMPLE, document, header, problems, reference
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
from service.wire.queries import interval, is_interval, window

if TYPE_CHECKING:
    from service.features.feature_tables import Layer

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
    "extent": {"spatial": {"bbox": [[4.35, 51.99, 4.38, 52.01]], "crs": CRS84}},
    "crs": [CRS84, "http://www.opengis.net/def/crs/EPSG/0/28992"],
    "storageCrs": "http://www.opengis.net/def/crs/EPSG/0/28992",
    "links": [{"href": "http://127.0.0.1:8000/collections/delft.buildings/items", "rel": "items", "type": GEOJSON}],
}
_PAGE_EXAMPLE = {
    "type": "FeatureCollection",
    "timeStamp": "2026-03-01T09:30:00.000Z",
    "numberMatched": 257,
    "numberReturned": 1,
    "links": [{"href": "http://127.0.0.1:8000/collections/delft.buildings/items", "rel": "self", "type": GEOJSON}],
    "features": [FEATURE_EXAMPLE],
}


# --- which runs ------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """The runs that a caller may read."""

    published: Mapping[str, PublishedRun]
    """Those of the operator."""
    store: JobStore
    """Those of jobs."""
    folder: StateFolder
    """Their files."""
    caller: Principal
    """The caller."""

    def opened(self, collection_id: str) -> tuple[OpenRun, str]:
        """The run and the table of a collection. Only names of the settings and ids of jobs ever become a path.

        Raises
        ------
        NoSuchCollectionError
            There is none, or it belongs to another key.
        """
        name, table = split_id(collection_id)
        if name in self.published:
            return self.published[name].opened(), table
        job_id = name.partition(".")[0]
        if is_id(job_id):
            with contextlib.suppress(NoSuchJobError):
                for run in self.of_job(self.store.get(job_id, owner=self.caller.owner)):
                    if run.name == name:
                        return run, table
        raise NoSuchCollectionError(
            f"there is no run {name[:80]!r} with collections: /collections lists all; those of a job are there when "
            "it is over, those of a comparison are JOB.METHOD"
        )

    def of_job(self, job: Job) -> Iterator[OpenRun]:
        """The runs of a job that is over: several of a comparison, none of one without buildings."""
        if job.request.has_buildings:
            finished = results_of(job, self.folder)
            for one in [finished.run(label) for label in finished.catalogue.runs] or [finished]:
                name = job.job_id if one.label is None else f"{job.job_id}.{one.label}"
                yield OpenRun(name=name, version=name, index=one.index, is_job=True)

    def page(self, limit: int, offset: int) -> tuple[list[OpenRun], int]:
        """Published runs on the first page, then those of jobs; and the number of jobs found, up to `limit` + 1."""
        criteria = JobFilter(
            owner=self.caller.owner,
            statuses=[JobStatus.SUCCESSFUL],
            process_ids=["reconstruct", "compare"],
            limit=limit + 1,
            offset=offset,
        )
        jobs = self.store.list(criteria)
        found: list[OpenRun] = []
        for one in [*(self.published.values() if offset == 0 else ()), *jobs[:limit]]:
            with contextlib.suppress(*_NOT_SHOWN):  # its files are gone, or its CRS is unknown
                found += [one.opened()] if isinstance(one, PublishedRun) else self.of_job(one)
        return found, len(jobs)


def _catalogue(request: Request, store: Store, folder: Folder, caller: Reader) -> Catalogue:
    return Catalogue(published=request.app.state.published, store=store, folder=folder, caller=caller)


_Runs = Annotated[Catalogue, Depends(_catalogue)]


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
    found, n_jobs = runs.page(limit, offset)
    listed = [_described(run, table, base) for run in found for table in TABLES]
    links = page_links(f"{base}/collections", [], n_jobs, limit, offset)
    return respond(Collections(links=links, collections=listed))


@router.get(
    "/collections/{collectionID}",
    summary="A collection",
    responses={200: document(Collection, "The collection.", _COLLECTION_EXAMPLE), **problems(404)},
)
def collection(runs: _Runs, base: Base, collection_id: _CollectionId) -> Response:
    """Describe a collection: its extent, its coordinate reference systems, its links."""
    return respond(_described(*runs.opened(collection_id), base))


def _described(run: OpenRun, table: str, base: str) -> Collection:
    from service.features.feature_tables import LAYERS

    totals, layer, name = run.index.totals(table), LAYERS[table], run.collection_id(table)
    place = f"{base}/collections/{name}"
    bounds = None if totals.bounds is None else run.crs.outside(totals.bounds, run.crs.named(None, "crs"))
    spatial = None if bounds is None else SpatialExtent(bbox=[[round(value, 7) for value in bounds]], crs=CRS84)
    temporal = TemporalExtent(interval=[list(totals.times)]) if totals.times != (None, None) else None
    links = [
        link(place, "self", "This collection"),
        link(f"{place}/items", "items", "The features", GEOJSON),
        link(f"{place}/queryables", f"{RELATIONS}queryables", "The properties for filters", SCHEMA_TYPE),
        link(f"{place}/schema", "describedby", "The JSON schema of the features", SCHEMA_TYPE),
    ]
    licence = run.index.facts["licence"]
    if licence.startswith(("http://", "https://")):
        links.append(Link(href=licence, rel="license", title="Licence of the source data"))
    stated = f"; licence of the source data: {licence}" if licence else ""
    return Collection(
        id=name,
        title=f"{run.name}: {table}",
        description=layer.title + _elevations(run, layer) + stated,
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

    unit_m = run.crs.vertical_unit_m or 1.0
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
    from service.features.feature_tables import LAYERS

    run, table = runs.opened(collection_id)
    name, layer = run.collection_id(table), LAYERS[table]
    found = JsonSchema(
        **{"$schema": _SCHEMA, "$id": f"{base}/collections/{name}/{kind}"},
        type="object",
        title=f"{run.name}: {table}",
        additionalProperties=kind == "schema",
        properties=layer.filter_schema(run.crs) if kind == "queryables" else layer.feature_schema(run.crs),
    )
    return respond(found, media_type=SCHEMA_TYPE)


# --- features --------------------------------------------------------------------------------------------------------


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
        AfterValidator(is_interval),
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


def _search(run: OpenRun, table: str, asked: _Asked, given: Sequence[tuple[str, str]]) -> Search:
    """The search of a request; all of it is checked before anything is read."""
    from service.features.cql2 import compiled, equality, parsed

    bbox_crs, filter_crs = run.crs.named(asked.bbox_crs, "bbox-crs"), run.crs.named(asked.filter_crs, "filter-crs")
    queryables = {name: kind for name, kind in run.index.kinds(table).items() if kind != "list"}
    unknown = [name for name, _ in given if name not in queryables]
    if unknown:
        known = f"{', '.join(sorted(_NAMES))}, or a property of its queryables"
        raise RequestError([f"query {name[:80]!r} is not known: use {known}" for name in dict.fromkeys(unknown)])
    twice = {name: number for name, number in Counter(name for name, _ in given).items() if number > 1}
    if twice:
        raise RequestError([f"query {name} is given {number} times: give it once" for name, number in twice.items()])
    trees = [equality(name, value, queryables) for name, value in given]
    if asked.filter is not None:
        trees.append(parsed(asked.filter, asked.filter_lang))
    shapes: list[ShapeTest] = []
    filters = [compiled(tree, queryables, filter_crs, shapes) for tree in trees]
    boxes = None
    near, near_crs = [one.window for one in filters if one.window is not None][:1], filter_crs
    if asked.bbox is not None:
        boxes = window(asked.bbox, in_degrees=bbox_crs.crs.is_geographic, northing_first=bbox_crs.is_northing_first)
        near, near_crs = boxes, bbox_crs
    windows = [run.crs.window(box, near_crs) for box in near]
    times = [] if asked.datetime is None or table != "buildings" else [acquired_in(interval(asked.datetime))]
    selecting = (asked.bbox, bbox_crs.uri, asked.datetime, asked.filter, asked.filter_lang, filter_crs.uri, *given)
    return Search(
        version=run.version,
        table=table,
        key=json.dumps(selecting),
        index=run.index,
        crs=run.crs,
        conditions=[*filters, *times],
        shapes=shapes,
        boxes=boxes,
        boxes_crs=bbox_crs,
        windows=None if not windows or None in windows else [box for box in windows if box is not None],
    )


def _texts(run: OpenRun, table: str, positions: Sequence[int], crs: str | None) -> tuple[Iterator[bytes], str]:
    """Features as GeoJSON in the CRS of a query parameter, and its URI."""
    named = run.crs.named(crs, "crs")
    is_stored = table == "buildings" and named.uri == CRS84
    written = None if is_stored else lambda shapes: run.crs.written(shapes, named)
    return feature_texts(run.index, table, positions, written), named.uri


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
    preferred(request.headers.get("accept"), [GEOJSON])
    run, table = runs.opened(collection_id)
    everything = request.query_params.multi_items()
    search = _search(run, table, asked, [(name, value) for name, value in everything if name not in _NAMES])
    run.crs.named(asked.crs, "crs")
    positions, following = search.page(asked.limit, asked.start)
    place = f"{base}/collections/{run.collection_id(table)}"

    def at(given: Sequence[tuple[str, str]]) -> str:
        return f"{place}/items?{urlencode(given)}" if given else f"{place}/items"

    links = [link(at(everything), "self", "These features", GEOJSON), link(place, "collection", "The collection")]
    if following is not None:
        again = [(name, value) for name, value in everything if name not in {"start", "limit"}]
        again += [("limit", str(asked.limit)), ("start", str(following))]
        links.append(link(at(again), "next", "The next features", GEOJSON))
    matched = search.matched()
    members: dict[str, Any] = {
        "timeStamp": timestamp(dt.datetime.now(dt.UTC)),
        **({} if matched is None else {"numberMatched": matched}),
        "numberReturned": len(positions),
        "links": [one.model_dump() for one in links],
    }
    texts, uri = _texts(run, table, positions, asked.crs)
    return Response(b"".join(collected(members, texts)), media_type=GEOJSON, headers=_headers(uri))


def _headers(crs: str) -> dict[str, str]:
    return {"Content-Crs": f"<{crs}>", "Cache-Control": "private, no-cache", "Vary": "Accept"}


@router.get(
    "/collections/{collectionID}/items/{featureID}",
    summary="One feature",
    response_class=Response,
    responses={
        200: {
            "description": "The feature.",
            "content": {GEOJSON: {"schema": reference(CollectionFeature), "example": FEATURE_EXAMPLE}},
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
    preferred(request.headers.get("accept"), [GEOJSON])
    run, table = runs.opened(collection_id)
    with run.index.opened() as connection:
        query = f"SELECT position FROM {table} WHERE id = ?"  # noqa: S608 - our own words
        row = connection.execute(query, (feature_id,)).fetchone()
    if row is None:
        raise NoSuchFeatureError(f"{collection_id} holds no feature {feature_id[:80]!r}")
    texts, uri = _texts(run, table, row, crs)
    (text,) = texts
    place = f"{base}/collections/{collection_id}"
    links = [
        link(f"{place}/items/{feature_id}", "self", "This feature", GEOJSON),
        link(place, "collection", "The collection"),
    ]
    if run.is_job and table == "buildings" and "." not in run.name:
        building = f"{base}/jobs/{run.name}/buildings/{feature_id}"
        links.append(link(building, "related", "The building with its planes and models", GEOJSON))
    body = text[:-1] + b',"links":' + json.dumps([one.model_dump() for one in links]).encode() + b"}"
    return Response(body, media_type=GEOJSON, headers=_headers(uri))
