"""Requirements of OGC API - Features 1, 2 and 3 and of CQL2, one check each, by the last parts of their URIs."""

import json
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import finished_runs as runs
import jsonschema
import pyproj
import pytest
import shapely
from openapi_spec_validator import OpenAPIV30SpecValidator

from service.routes.collections import CONFORMANCE

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
EPSG = "http://www.opengis.net/def/crs/EPSG/0/"
REL = "http://www.opengis.net/def/rel/ogc/1.0/"
GEOJSON = "application/geo+json"
SCHEMA = "application/schema+json"
GABLE = runs.ident("gable")
CHECKS: dict[str, Callable[[runs.Service], None]] = {}
"""The checks by requirement; the class of a requirement comes before the slash."""
PLACE: list[str] = []
"""Path of the collection of buildings of a job."""


def requirement(*names: str) -> Callable[[Callable[[runs.Service], None]], Callable[[runs.Service], None]]:
    """Adds a check to the table."""

    def add(check: Callable[[runs.Service], None]) -> Callable[[runs.Service], None]:
        for name in names:
            assert name not in CHECKS
            CHECKS[name] = check
        return check

    return add


@pytest.fixture(scope="module", autouse=True)
def collection(service: runs.Service) -> None:
    """The job of six buildings in four tiles."""
    PLACE[:] = [f"/collections/{service.finished()}.buildings"]


@pytest.fixture(scope="module")
def met() -> set[object]:
    """The checks that passed."""
    return set()


def got(service: runs.Service, path: str, media_type: str = "application/json", **query: Any) -> dict[str, Any]:
    """A document that must be there."""
    answer = service.client.get(path, params=query or None)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == media_type
    found: dict[str, Any] = answer.json()
    return found


def named(query: dict[str, Any]) -> dict[str, Any]:
    """Parameters by their names on the wire; those of properties keep theirs."""
    ours = {"bbox_crs", "filter_lang", "filter_crs"}
    return {name.replace("_", "-") if name in ours else name: value for name, value in query.items()}


def page(service: runs.Service, **query: Any) -> dict[str, Any]:
    return got(service, f"{PLACE[0]}/items", GEOJSON, **named(query))


def ids(found: dict[str, Any]) -> list[str]:
    return [feature["id"] for feature in found["features"]]


def refused(service: runs.Service, **query: Any) -> str:
    return runs.problem(service.client.get(f"{PLACE[0]}/items", params=named(query)), 400, "invalid-request")


def links(document: dict[str, Any], rel: str) -> list[dict[str, Any]]:
    return [link for link in document["links"] if link["rel"] == rel]


def shape(feature: dict[str, Any]) -> shapely.Geometry:
    return shapely.from_geojson(json.dumps(feature["geometry"]))


def native(service: runs.Service) -> dict[str, shapely.Geometry]:
    """The footprints in the CRS of the run, without the building that has none."""
    found = page(service, crs=f"{EPSG}28992")["features"]
    return {feature["id"]: shape(feature) for feature in found if feature["geometry"]}


# --- part 1: core


@requirement("core/root-op", "core/root-success")
def landing_page(service: runs.Service) -> None:
    found = got(service, "/")
    assert links(found, "service-desc")
    assert links(found, f"{REL}conformance")
    (data,) = links(found, "data")
    assert got(service, urlsplit(data["href"]).path)["collections"]


@requirement(
    "core/api-definition-op", "core/api-definition-success", "oas30/oas-definition-1", "oas30/oas-definition-2"
)
def api_definition(service: runs.Service) -> None:
    (link,) = links(got(service, "/"), "service-desc")
    assert link["type"] == "application/vnd.oai.openapi+json;version=3.0"
    answer = service.client.get(urlsplit(link["href"]).path)
    assert list(OpenAPIV30SpecValidator(answer.json()).iter_errors()) == []


@requirement("oas30/completeness", "oas30/oas-impl", "oas30/exception-codes", "oas30/security")
def described(service: runs.Service) -> None:
    paths = service.client.get("/openapi.json").json()["paths"]
    one = "/collections/{collectionID}"
    for path in (
        "/collections",
        one,
        f"{one}/queryables",
        f"{one}/schema",
        f"{one}/items",
        f"{one}/items/{{featureID}}",
    ):
        operation = paths[path]["get"]
        assert operation["security"] == [{}, {"key": []}]
        assert {"200", "400", "401", "403"} <= set(operation["responses"])
        assert path == "/collections" or "404" in operation["responses"]


@requirement("core/conformance-op", "core/conformance-success")
def conformance(service: runs.Service) -> None:
    declared = got(service, "/conformance")["conformsTo"]
    assert set(CONFORMANCE) <= set(declared)
    assert len(declared) == len(set(declared))


@requirement("core/http")
def http(service: runs.Service) -> None:
    assert service.client.get("/collections").http_version == "HTTP/1.1"
    assert service.client.head(f"{PLACE[0]}/items").status_code == 200
    assert service.client.post("/collections").status_code == 405
    runs.problem(service.client.get("/collections/no.buildings"), 404, "no-such-collection")
    assert service.client.get(f"{PLACE[0]}/items", headers={"Accept": "text/csv"}).status_code == 406


@requirement("core/query-param-unknown")
def unknown_parameter(service: runs.Service) -> None:
    assert "'colour' is not known" in refused(service, colour="red")
    for path in ("/collections", PLACE[0], f"{PLACE[0]}/queryables", f"{PLACE[0]}/items/{GABLE}"):
        runs.problem(service.client.get(f"{path}?colour=red"), 400, "invalid-request")


@requirement("core/query-param-invalid")
def invalid_parameter(service: runs.Service) -> None:
    faulty = [
        {"limit": "many"},
        {"limit": "0"},
        {"limit": "10001"},
        {"bbox": "1,2,3"},
        {"bbox": "1,2,3,nan"},
        {"bbox": "4,53,5,52"},
        {"bbox": "4,52,181,53"},
        {"bbox": "4,52,0,5,53,9"},
        {"datetime": "yesterday"},
        {"datetime": "2024-01-01T00:00:00Z/2023-01-01T00:00:00Z"},
        {"height_m": "tall"},
        {"valid": "yes"},
        {"acquired_from": "then"},
        {"start": "-1"},
    ]
    for query in faulty:
        assert next(iter(query)) in refused(service, **query)
    answer = service.client.get(f"{PLACE[0]}/items?status=ok&status=failed")
    assert "given 2 times" in runs.problem(answer, 400, "invalid-request")


@requirement("core/fc-md-op", "core/fc-md-success", "core/fc-md-links", "core/fc-md-items", "core/fc-md-items-links")
def collections(service: runs.Service) -> None:
    found = got(service, "/collections")
    assert links(found, "self")
    names = [collection["id"] for collection in found["collections"]]
    assert {f"{PLACE[0].removeprefix('/collections/').removesuffix('.buildings')}.{table}" for table in TABLES} <= set(
        names
    )
    for collection in found["collections"]:
        assert {"id", "links", "crs", "itemType"} <= set(collection)
        (items,) = links(collection, "items")
        assert items["type"] == GEOJSON
        assert service.client.get(urlsplit(items["href"]).path).status_code == 200


TABLES = ("buildings", "planes", "rejected")


@requirement("core/fc-md-extent", "core/fc-md-extent-multi")
def extent(service: runs.Service) -> None:
    found = got(service, PLACE[0])["extent"]
    ((west, south, east, north),) = found["spatial"]["bbox"]
    assert found["spatial"]["crs"] == CRS84
    footprints = [shape(feature) for feature in page(service)["features"] if feature["geometry"]]
    assert shapely.box(west, south, east, north).buffer(2e-7).covers(shapely.union_all(footprints))
    assert found["temporal"]["interval"] == [["2014-03-01T10:00:00.000Z", "2014-03-01T11:00:00.000Z"]]


@requirement("core/sfc-md-op", "core/sfc-md-success")
def one_collection(service: runs.Service) -> None:
    listed = [one for one in got(service, "/collections")["collections"] if PLACE[0].endswith(one["id"])]
    assert listed == [got(service, PLACE[0])]


@requirement("core/fc-op", "core/fc-response", "geojson/definition", "geojson/content")
def features(service: runs.Service) -> None:
    found = page(service)
    assert found["type"] == "FeatureCollection"
    assert sorted(ids(found)) == sorted(map(runs.ident, ("gable", "courtyard", "failed", "two_parts", "pent", "far")))
    for feature in found["features"]:
        assert feature["type"] == "Feature"
        assert {"id", "geometry", "properties"} <= set(feature)


@requirement("core/fc-limit-definition", "core/fc-limit-response-1")
def limit(service: runs.Service) -> None:
    assert len(page(service, limit=2)["features"]) == 2
    assert len(page(service, limit=10000)["features"]) == 6
    operation = service.client.get("/openapi.json").json()["paths"]["/collections/{collectionID}/items"]["get"]
    (schema,) = [given["schema"] for given in operation["parameters"] if given["name"] == "limit"]
    assert (schema["minimum"], schema["maximum"], schema["default"]) == (1, 10000, 100)


@requirement("core/fc-bbox-definition", "core/fc-bbox-response")
def bbox(service: runs.Service) -> None:
    chosen = shape(got(service, f"{PLACE[0]}/items/{GABLE}", GEOJSON))
    found = page(service, bbox=",".join(map(str, chosen.bounds)))
    # a feature without geometry matches every window
    assert set(ids(found)) == {GABLE, runs.ident("failed")}
    assert found["numberMatched"] == 2
    assert ids(page(service, bbox="170,-10,-170,10")) == [runs.ident("failed")]
    assert len(page(service, bbox="-180,-90,180,90")["features"]) == 6


@requirement("core/fc-time-definition", "core/fc-time-response")
def datetime(service: runs.Service) -> None:
    for inside in (
        "2014-03-01T10:30:00Z",
        "2014-03-01T11:00:00Z/..",
        "../2014-03-01T10:00:00Z",
        "/2015-01-01T00:00:00Z",
    ):
        assert page(service, datetime=inside)["numberMatched"] == 6
    for outside in ("2013-01-01T00:00:00Z", "2014-03-01T11:00:01Z/..", "../2014-03-01T09:59:59Z"):
        assert page(service, datetime=outside)["numberMatched"] == 0
    # features without times match every time
    planes = PLACE[0].replace(".buildings", ".planes")
    assert got(service, f"{planes}/items", GEOJSON, datetime="2013-01-01T00:00:00Z")["numberMatched"] > 5


@requirement(
    "core/fc-links", "core/fc-rel-type", "core/fc-numberMatched", "core/fc-numberReturned", "core/fc-timeStamp"
)
def pages(service: runs.Service) -> None:
    everything = ids(page(service))
    found, seen = page(service, limit=4, valid="true"), []
    while True:
        assert all({"rel", "type", "href"} <= set(link) for link in found["links"])
        assert found["numberMatched"] == 5
        assert found["numberReturned"] == len(found["features"])
        assert found["timeStamp"].endswith("Z")
        (own,) = links(found, "self")
        assert ids(page(service, **dict(parse_qsl(urlsplit(own["href"]).query)))) == ids(found)
        seen += ids(found)
        following = links(found, "next")
        if not following:
            break
        found = page(service, **dict(parse_qsl(urlsplit(following[0]["href"]).query)))
    assert seen == [name for name in everything if name != runs.ident("failed")]


@requirement("core/f-op", "core/f-success", "core/f-links")
def feature(service: runs.Service) -> None:
    for listed in page(service)["features"]:
        found = got(service, f"{PLACE[0]}/items/{listed['id']}", GEOJSON)
        assert links(found, "self")
        assert links(found, "collection")
        assert {name: value for name, value in found.items() if name != "links"} == listed
    runs.problem(service.client.get(f"{PLACE[0]}/items/{runs.ident('nothing')}"), 404, "no-such-feature")


# --- part 2: coordinate reference systems


@requirement(
    "crs/crs-uri",
    "crs/fc-md-crs-list",
    "crs/fc-md-crs-list-global",
    "crs/fc-md-storageCrs",
    "crs/fc-md-storageCrs-valid-value",
)
def crs_list(service: runs.Service) -> None:
    found = got(service, PLACE[0])
    assert found["crs"] == [CRS84, f"{EPSG}4326", f"{EPSG}3857", f"{EPSG}28992"]
    assert found["storageCrs"] == f"{EPSG}28992"


@requirement("crs/fc-crs-definition", "crs/fc-crs-valid-value", "crs/crs-exception")
def crs_values(service: runs.Service) -> None:
    for uri in got(service, PLACE[0])["crs"]:
        assert page(service, crs=uri)["numberReturned"] == 6
    for unknown in ("EPSG:28992", f"{EPSG}25832", ""):
        assert f"use one of {CRS84}" in refused(service, crs=unknown)


@requirement("crs/fc-crs-default-value", "crs/ogc-crs-header", "crs/ogc-crs-header-value")
def crs_header(service: runs.Service) -> None:
    for path in (f"{PLACE[0]}/items", f"{PLACE[0]}/items/{GABLE}"):
        assert service.client.get(path).headers["content-crs"] == f"<{CRS84}>"
        answer = service.client.get(path, params={"crs": f"{EPSG}3857"})
        assert answer.headers["content-crs"] == f"<{EPSG}3857>"


@requirement("crs/fc-crs-action", "crs/geojson", "core/crs84")
def crs_action(service: runs.Service) -> None:
    own = native(service)
    for code in ("OGC:CRS84", "EPSG:4326", "EPSG:3857"):
        # in the order of the axes of the CRS: latitude before longitude in EPSG:4326
        move = pyproj.Transformer.from_crs("EPSG:28992", code)
        uri = CRS84 if code == "OGC:CRS84" else code.replace("EPSG:", EPSG)
        for one in page(service, crs=uri)["features"]:
            if one["geometry"]:
                moved = shapely.transform(own[one["id"]], move.transform, interleaved=False)
                assert shapely.hausdorff_distance(shape(one), moved) < (2e-3 if code == "EPSG:3857" else 1e-8)


@requirement("crs/fc-bbox-crs-definition", "crs/fc-bbox-crs-valid-values", "crs/bbox-crs-exception")
def bbox_crs_values(service: runs.Service) -> None:
    for uri in got(service, PLACE[0])["crs"]:
        assert page(service, bbox="1,2,3,4", bbox_crs=uri)["numberReturned"] == 1
    assert "bbox-crs" in refused(service, bbox="1,2,3,4", bbox_crs="EPSG:4326")


@requirement("crs/fc-bbox-crs-default-value", "crs/fc-bbox-crs-action")
def bbox_crs_action(service: runs.Service) -> None:
    for uri in got(service, PLACE[0])["crs"]:
        answer = service.client.get(f"{PLACE[0]}/items/{GABLE}", params={"crs": uri})
        window = ",".join(map(str, shape(answer.json()).bounds))
        assert set(ids(page(service, bbox=window, bbox_crs=uri))) == {GABLE, runs.ident("failed")}
        if uri == CRS84:
            assert set(ids(page(service, bbox=window))) == {GABLE, runs.ident("failed")}


# --- part 3: filtering


@requirement("queryables/queryables-link", "queryables/get-queryables-op", "queryables/get-queryables-response")
def queryables(service: runs.Service) -> None:
    (link,) = links(got(service, PLACE[0]), f"{REL}queryables")
    assert link["type"] == SCHEMA
    found = got(service, urlsplit(link["href"]).path, SCHEMA)
    jsonschema.Draft202012Validator.check_schema(found)
    assert found["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert found["$id"].endswith(f"{PLACE[0]}/queryables")
    assert found["type"] == "object"
    assert found["properties"]["height_m"] == {"title": "height_m", "type": "number"}
    assert found["properties"]["status"]["enum"] == ["ok", "doubtful", "fallback", "failed"]
    assert found["properties"]["geometry"]["format"].startswith("geometry-")


@requirement("queryables/expression-construction", "filter/expression-construction")
def only_queryables(service: runs.Service) -> None:
    assert "'colour' is not a property" in refused(service, filter="colour = 'red'")
    # a list is a property and no queryable
    assert "'validity_codes' is not a property" in refused(service, filter="validity_codes IS NULL")


@requirement("queryables-query-parameters/parameters")
def property_parameters(service: runs.Service) -> None:
    for feature in page(service)["features"]:
        given = {
            name: feature["properties"][name] for name in ("building_id", "status", "roof_type", "tile", "height_m")
        }
        texts = {name: str(value) for name, value in given.items() if value is not None}
        assert ids(page(service, **texts)) == [feature["id"]]
    assert ids(page(service, valid="false")) == [runs.ident("failed")]
    assert page(service, acquired_to="2014-03-01T11:00:00Z")["numberMatched"] == 6


@requirement("filter/filter-param", "filter/response", "features-filter/response", "cql2-text/filter-lang")
def filter_parameter(service: runs.Service) -> None:
    assert ids(page(service, filter="status = 'failed'")) == [runs.ident("failed")]
    assert ids(page(service, filter="status = 'failed'", filter_lang="cql2-text")) == [runs.ident("failed")]
    for faulty in ("", "status =", "status = 'ok' AND", "(status = 'ok'", "status LIKE 3", "status", "height_m = 'x'"):
        assert "query filter" in refused(service, filter=faulty)


@requirement("filter/filter-lang-param", "cql2-json/basic-cql2")
def filter_language(service: runs.Service) -> None:
    tree = {"op": "=", "args": [{"property": "status"}, "failed"]}
    assert ids(page(service, filter=json.dumps(tree), filter_lang="cql2-json")) == [runs.ident("failed")]
    assert "filter-lang" in refused(service, filter="status = 'ok'", filter_lang="sql")
    for faulty in ("{", "[]", '"ok"', '{"op": "="}', '{"op": "paint", "args": []}', '{"op": "=", "args": [1]}'):
        assert "query filter" in refused(service, filter=faulty, filter_lang="cql2-json")


@requirement("filter/filter-crs-wgs84", "filter/filter-crs-param", "features-filter/filter-crs-param")
def filter_crs(service: runs.Service) -> None:
    for uri in got(service, PLACE[0])["crs"]:
        answer = service.client.get(f"{PLACE[0]}/items/{GABLE}", params={"crs": uri})
        x, y = shape(answer.json()).representative_point().coords[0]
        text = f"S_INTERSECTS(geometry, POINT({x} {y}))"
        assert ids(page(service, filter=text, filter_crs=uri)) == [GABLE]
        if uri == CRS84:
            assert ids(page(service, filter=text)) == [GABLE]
    assert "filter-crs" in refused(service, filter="valid = true", filter_crs="EPSG:4326")


@requirement("filter/mixing-expressions")
def mixed(service: runs.Service) -> None:
    # all that is given must hold
    chosen = shape(got(service, f"{PLACE[0]}/items/{GABLE}", GEOJSON))
    window = ",".join(map(str, chosen.bounds))
    assert ids(page(service, bbox=window, filter="valid = true", roof_type="gable")) == [GABLE]
    assert ids(page(service, bbox=window, filter="valid = true", roof_type="pent")) == []


# --- CQL2


def expected(service: runs.Service, keep: Callable[[dict[str, Any]], bool]) -> list[str]:
    return [feature["id"] for feature in page(service)["features"] if keep(feature["properties"])]


@requirement(
    "basic-cql2/cql2-filter",
    "basic-cql2/binary-comparison-predicate",
    "basic-cql2/null-predicate",
    "basic-cql2/property",
)
def basic_filters(service: runs.Service) -> None:
    def tall(row: dict[str, Any], limit: float = 6.0) -> bool:
        return row["height_m"] is not None and row["height_m"] > limit

    cases: dict[str, Callable[[dict[str, Any]], bool]] = {
        "height_m > 6": tall,
        "NOT (height_m > 6)": lambda row: row["height_m"] is not None and row["height_m"] <= 6.0,
        "height_m > 6 OR status <> 'ok'": lambda row: tall(row) or row["status"] != "ok",
        "height_m > 6 AND roof_type = 'gable'": lambda row: tall(row) and row["roof_type"] == "gable",
        "height_m IS NULL": lambda row: row["height_m"] is None,
        "height_m IS NOT NULL": lambda row: row["height_m"] is not None,
        "valid = true": lambda row: row["valid"],
        "valid": lambda row: row["valid"],
        "acquired_from >= TIMESTAMP('2014-03-01T10:00:00Z')": lambda _: True,
        "acquired_from < DATE('2014-03-01')": lambda _: False,
        "n_planes <= 2": lambda row: row["n_planes"] <= 2,
        "6 < height_m": tall,
    }
    counts = []
    for text, keep in cases.items():
        assert ids(page(service, filter=text)) == expected(service, keep), text
        counts.append(len(expected(service, keep)))
    assert len(set(counts)) > 3


@requirement(
    "advanced-comparison-operators/between-predicate",
    "advanced-comparison-operators/in-predicate",
    "advanced-comparison-operators/like-predicate",
)
def advanced_filters(service: runs.Service) -> None:
    heights = sorted(row["properties"]["height_m"] for row in page(service, filter="height_m > 0")["features"])
    low, high = heights[1], heights[-2]
    found = page(service, filter=f"height_m BETWEEN {low} AND {high}")
    assert ids(found) == expected(service, lambda row: row["height_m"] is not None and low <= row["height_m"] <= high)
    assert ids(page(service, filter="roof_type IN ('gable', 'pent')")) == expected(
        service, lambda row: row["roof_type"] in {"gable", "pent"}
    )
    assert ids(page(service, filter="roof_type NOT IN ('gable')")) == expected(
        service, lambda row: row["roof_type"] != "gable"
    )
    assert ids(page(service, filter="roof_type LIKE 'g_b%'")) == expected(
        service, lambda row: row["roof_type"] == "gable"
    )
    assert ids(page(service, filter="roof_type LIKE 'GABLE'")) == []


@requirement(
    "basic-spatial-functions/spatial-predicate",
    "basic-spatial-functions/spatial-functions",
    "basic-spatial-functions-plus/spatial-data-types",
    "spatial-functions/spatial-data-types",
)
def spatial_filters(service: runs.Service) -> None:
    own = native(service)
    west, south, east, north = own[GABLE].bounds
    corners = f"{west} {south}, {east} {south}, {east} {north}, {west} {north}, {west} {south}"
    shapes = [
        f"BBOX({west},{south},{east},{north})",
        f"POLYGON(({corners}))",
        f"MULTIPOLYGON((({corners})))",
        f"LINESTRING({corners})",
        f"POINT({(west + east) / 2} {(south + north) / 2})",
    ]
    for text in shapes:
        wkt = None if text.startswith("BBOX") else text
        other = shapely.box(west, south, east, north) if wkt is None else shapely.from_wkt(wkt)
        for name in ("intersects", "disjoint", "within", "contains", "touches", "overlaps", "crosses", "equals"):
            wanted = [one for one, footprint in own.items() if getattr(shapely, name)(footprint, other)]
            found = page(service, filter=f"S_{name.upper()}(geometry, {text})", filter_crs=f"{EPSG}28992")
            assert ids(found) == wanted, (name, text)
        mirrored = page(service, filter=f"S_CONTAINS({text}, geometry)", filter_crs=f"{EPSG}28992")
        assert ids(mirrored) == [one for one, footprint in own.items() if shapely.contains(other, footprint)]
    assert "not a valid geometry" in refused(
        service, filter="S_INTERSECTS(geometry, POLYGON((0 0, 1 1, 1 0, 0 1, 0 0)))"
    )


@requirement("cql2-text/escaping")
def escaping(service: runs.Service) -> None:
    assert ids(page(service, filter="reason_detail = 'it''s (not] so'")) == []
    assert ids(page(service, filter="\"status\" = 'failed'")) == [runs.ident("failed")]


@pytest.mark.parametrize("name", list(CHECKS))
def test_the_requirement_is_met(name: str, service: runs.Service, met: set[object]) -> None:
    # a check of several requirements runs again only while it fails
    if CHECKS[name] not in met:
        CHECKS[name](service)
        met.add(CHECKS[name])


def test_the_table_has_a_check_for_every_declared_class() -> None:
    assert {uri.rpartition("/")[2] for uri in CONFORMANCE} == {name.partition("/")[0] for name in CHECKS}
    assert len(CHECKS) > 60
