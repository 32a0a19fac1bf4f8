"""Buildings by REST: pages by window and words against a slow twin, single buildings in four forms."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cityjson_rules
import finished_runs as runs
import glb_rules
import httpx
import pytest
import shapely
import small_buildings as small
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from pipeline.export.geoparquet import read_table
from pipeline.model import Decision, DecisionKind, Outcome
from service.errors import RequestError
from service.features.index import NAME
from service.wire.queries import window

GABLE = runs.ident("gable")
FAILED = runs.ident("failed")
TWO_PARTS = runs.ident("two_parts")


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    """A job of six buildings in four tiles."""
    return service.finished()


@pytest.fixture(scope="module")
def many(service: runs.Service) -> str:
    """A job of 108 buildings in nine tiles."""
    return service.finished(lambda run_dir: runs.write_run(run_dir, runs.nine_tiles(12)))


def answered(client: TestClient, job_id: str, **asked: Any) -> httpx.Response:
    """The answer to a request for a page of buildings."""
    names = {name.replace("_crs", "-crs"): value for name, value in asked.items()}
    return client.get(f"/jobs/{job_id}/buildings", params=names)


def page(client: TestClient, job_id: str, **asked: Any) -> dict[str, Any]:
    """A page of buildings."""
    answer = answered(client, job_id, **asked)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/geo+json"
    found: dict[str, Any] = answer.json()
    assert found["numberReturned"] == len(found["features"])
    return found


def ids(found: dict[str, Any]) -> list[str]:
    return [feature["id"] for feature in found["features"]]


def refused(client: TestClient, job_id: str, **asked: Any) -> str:
    """The detail of a request that is refused."""
    return runs.problem(answered(client, job_id, **asked), 400, "invalid-request")


# --- pages -----------------------------------------------------------------------------------------------------------


def test_the_pages_together_are_the_output_in_the_order_of_ids(client: TestClient, many: str) -> None:
    whole = {f["id"]: f for f in client.get(f"/jobs/{many}/results/geojson").json()["features"]}
    url: str | None = f"/jobs/{many}/buildings?limit=25"
    found, pages = [], 0
    while url is not None:
        answer = client.get(url).json()
        assert answer["numberMatched"] == 108
        found += answer["features"]
        pages += 1
        url = next((link["href"] for link in answer["links"] if link["rel"] == "next"), None)
    assert pages == 5
    assert [feature["id"] for feature in found] == sorted(whole)
    assert all(feature == whole[feature["id"]] for feature in found)


def test_links_lead_on_back_and_up_with_the_same_question(client: TestClient, many: str) -> None:
    asked = {"status": "ok", "limit": 10, "offset": 20, "bbox": "4.3,52,4.4,52.1"}
    found = page(client, many, **asked)
    links = {link["rel"]: link["href"] for link in found["links"]}
    assert set(links) == {"self", "next", "prev", "collection"}
    assert client.get(links["self"]).json()["features"] == found["features"]
    assert ids(client.get(links["next"]).json()) == ids(page(client, many, **asked | {"offset": 30}))
    assert ids(client.get(links["prev"]).json()) == ids(page(client, many, **asked | {"offset": 10}))
    assert client.get(links["collection"]).json()["jobID"] == many


def test_a_page_behind_the_end_is_empty(client: TestClient, job_id: str) -> None:
    found = page(client, job_id, offset=10**12)
    assert (found["features"], found["numberMatched"]) == ([], 6)
    assert "next" not in {link["rel"] for link in found["links"]}


def test_native_coordinates_are_those_of_the_table(client: TestClient, service: runs.Service, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/buildings", params={"crs": "native"})
    assert answer.headers["content-crs"] == "<http://www.opengis.net/def/crs/EPSG/0/28992>"
    found = answer.json()
    assert found["coordRefSys"] == "http://www.opengis.net/def/crs/EPSG/0/28992"
    table = read_table(str(service.folder.run(job_id, 1)), "buildings").to_pylist()
    own = {row["building_id"]: row for row in table}
    for feature in found["features"]:
        wkb = own[feature["id"]]["geometry"]
        if wkb is None:
            assert feature["geometry"] is None
        else:
            assert shapely.geometry.shape(feature["geometry"]).equals_exact(shapely.from_wkb(wkb))
        assert feature["properties"]["roof_type"] == own[feature["id"]]["roof_type"]
    plain = client.get(f"/jobs/{job_id}/buildings")
    assert plain.headers["content-crs"] == "<http://www.opengis.net/def/crs/OGC/1.3/CRS84>"
    assert "coordRefSys" not in plain.json()


def test_a_window_in_degrees_and_one_in_metres_find_the_same(client: TestClient, job_id: str) -> None:
    native = page(client, job_id, bbox="85125,447015,85155,447030", bbox_crs="native")
    assert ids(native) == [TWO_PARTS]
    box = shapely.geometry.shape(native["features"][0]["geometry"]).bounds
    degrees = ",".join(str(v) for v in box)
    assert ids(page(client, job_id, bbox=degrees)) == [TWO_PARTS]
    uri = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
    assert ids(page(client, job_id, bbox=degrees, bbox_crs=uri, crs=uri)) == [TWO_PARTS]


def test_a_window_over_the_180th_meridian_is_two(client: TestClient, job_id: str) -> None:
    assert ids(page(client, job_id, bbox="170,-10,-170,10")) == []
    assert page(client, job_id, bbox="4,-10,3,80")["numberMatched"] == 5


def test_the_border_of_a_window_belongs_to_it(client: TestClient, job_id: str) -> None:
    touching = page(client, job_id, bbox="84990,446990,85000,447000", bbox_crs="native")
    assert ids(touching) == [GABLE]
    beside = page(client, job_id, bbox="84990,446990,84999.999,447000", bbox_crs="native")
    assert ids(beside) == []


def test_words_may_be_repeated(client: TestClient, job_id: str) -> None:
    both = sorted([FAILED, runs.ident("courtyard")])
    assert ids(page(client, job_id, status=["failed", "fallback"])) == both


@pytest.mark.parametrize(
    ("name", "value", "reported"),
    [
        ("bbox", "1,2,3", "give four numbers"),
        ("bbox", "1,2,3,4,5,6", "give four numbers"),
        ("bbox", "a,b,c,d", "give four numbers"),
        ("bbox", "nan,0,1,1", "give four numbers"),
        ("bbox", "inf,0,1,1", "give four numbers"),
        ("bbox", "", "give four numbers"),
        ("bbox", "0,2,1,1", "south 2 lies north"),
        ("bbox", "0,52,181,53", "longitudes reach from -180 to 180"),
        ("bbox-crs", "EPSG:28992", "bbox-crs"),
        ("crs", "epsg", "crs"),
        ("limit", "0", "limit"),
        ("limit", "10001", "limit"),
        ("offset", "-1", "offset"),
        ("offset", str(2**64), "offset"),
        ("status", "fine", '["fine"]: use one of ok, doubtful, fallback, failed'),
        ("roof_type", "onion", '["onion"]: use one of flat, pent'),
        ("reason", "bad luck", '["bad luck"]: use one of'),
    ],
)
def test_what_means_nothing_is_refused_with_the_fix(
    client: TestClient, job_id: str, name: str, value: str, reported: str
) -> None:
    assert reported in refused(client, job_id, **{name: value})


def test_all_wrong_words_are_reported_at_once(client: TestClient, job_id: str) -> None:
    detail = refused(client, job_id, status="fine", roof_type="onion")
    assert '"fine"' in detail
    assert '"onion"' in detail


def test_a_page_is_only_geojson(client: TestClient, job_id: str) -> None:
    path = f"/jobs/{job_id}/buildings"
    for accept in ("application/json", "application/geo+json", "*/*"):
        assert client.get(path, headers={"Accept": accept}).headers["content-type"] == "application/geo+json"
    assert client.get(path, headers={"Accept": "text/html"}).status_code == 406


# --- against a slow twin ---------------------------------------------------------------------------------------------

_WORDS = {
    "status": ("ok", "doubtful", "fallback", "failed"),
    "roof_type": ("gable", "pent", "flat", "none", "hip"),
    "reason": ("invalid_solid", "too_few_points", "no_plane"),
}


@st.composite
def queries(draw: st.DrawFn) -> dict[str, Any]:
    """Questions of every kind, narrow and wide."""
    asked: dict[str, Any] = {
        name: ",".join(draw(st.lists(st.sampled_from(allowed), max_size=2, unique=True)))
        for name, allowed in _WORDS.items()
    }
    if draw(st.booleans()):
        x, y = draw(st.floats(84_900, 85_400)), draw(st.floats(446_900, 447_400))
        asked["bbox"] = (x, y, x + draw(st.floats(0, 400)), y + draw(st.floats(0, 400)))
    return asked | {"limit": draw(st.integers(1, 120)), "offset": draw(st.integers(0, 60))}


def twin(features: list[dict[str, Any]], asked: dict[str, Any]) -> list[str]:
    """The ids that fit, found by looking at every feature."""
    found = []
    for feature in features:
        if "bbox" in asked:
            if feature["geometry"] is None:
                continue
            own = shapely.box(*shapely.geometry.shape(feature["geometry"]).bounds)
            if not own.intersects(shapely.box(*asked["bbox"])):
                continue
        if all(not asked[name] or feature["properties"][name] in asked[name].split(",") for name in _WORDS):
            found.append(feature["id"])
    return sorted(found)


def test_pages_are_what_a_look_at_every_building_finds(client: TestClient, many: str) -> None:
    features = page(client, many, crs="native", limit=10_000)["features"]
    assert len(features) == 108

    @settings(max_examples=examples(150), suppress_health_check=[HealthCheck.too_slow], deadline=None)
    @given(queries())
    def check(asked: dict[str, Any]) -> None:
        expected = twin(features, asked)
        sent = asked | ({"bbox": ",".join(map(repr, asked["bbox"])), "bbox_crs": "native"} if "bbox" in asked else {})
        found = page(client, many, **sent)
        assert found["numberMatched"] == len(expected)
        assert ids(found) == expected[asked["offset"] : asked["offset"] + asked["limit"]]

    check()


@given(st.text(alphabet="0123456789.,-+einfa ", max_size=40), st.booleans(), st.booleans())
def test_any_text_is_a_window_or_refused(text: str, in_degrees: bool, northing_first: bool) -> None:
    try:
        found = window(text, in_degrees=in_degrees, northing_first=northing_first)
    except RequestError as error:
        reported = str(error)
    else:
        reported = "bbox" if all(west <= east and south <= north for west, south, east, north in found) else "no window"
    assert "bbox" in reported


# --- one building ----------------------------------------------------------------------------------------------------


def test_a_building_has_all_columns_and_its_planes(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/buildings/{TWO_PARTS}")
    assert answer.headers["content-type"] == "application/geo+json"
    found = answer.json()
    (listed,) = [f for f in page(client, job_id)["features"] if f["id"] == TWO_PARTS]
    planes = found["properties"].pop("planes")
    assert found["properties"] == listed["properties"]
    assert found["geometry"] == listed["geometry"]
    assert [plane["plane_id"] for plane in planes] == [0, 1, 2, 3]
    assert {plane["slope_deg"] for plane in planes} == {36.8699}
    assert {"aspect_deg", "area_m2", "coefficients", "origin_x", "n_points", "rmse_m"} <= set(planes[0])
    links = {link["type"]: link["href"] for link in found["links"] if link["rel"] == "alternate"}
    for media_type, href in links.items():
        assert client.get(href).headers["content-type"] == media_type
    assert set(links) == {"model/obj", "application/city+json"}


def test_a_building_says_what_was_checked_and_tried(service: runs.Service, client: TestClient) -> None:
    check = Decision(kind=DecisionKind.CHECK, name="roof_points", outcome=Outcome.MET, value=320, limit=10)
    form = Decision(
        kind=DecisionKind.FORM, name="traced", outcome=Outcome.INVALID, n_faces=2, bic_margin=0.5, validity_codes=(306,)
    )
    gable = dataclasses.replace(runs.placed(small.gable(), "gable", 0.0, 0.0), decisions=(check, form))
    pent = runs.placed(small.pent(), "pent", 50.0, 0.0)
    job = service.finished(lambda run_dir: runs.write_run(run_dir, {"x851_y4470": [gable, pent]}))
    place = f"/jobs/{job}/buildings/{gable.building_id}"
    found = client.get(f"{place}/decisions").json()
    assert found["building_id"] == gable.building_id
    assert found["decisions"] == [
        {"step": 0, "kind": "check", "name": "roof_points", "outcome": "met", "detail": "", "value": 320, "limit": 10},
        {
            "step": 1,
            "kind": "form",
            "name": "traced",
            "outcome": "invalid",
            "detail": "",
            "n_faces": 2,
            "bic_margin": 0.5,
            "validity_codes": [306],
        },
    ]
    links = {link["rel"]: link["href"] for link in found["links"]}
    assert links["self"].endswith(f"{place}/decisions")
    (related,) = [link["href"] for link in client.get(place).json()["links"] if link["rel"] == "related"]
    assert related == links["self"]
    assert client.get(f"/jobs/{job}/buildings/{pent.building_id}/decisions").json()["decisions"] == []
    missing = client.get(f"/jobs/{job}/buildings/{'a' * 24}/decisions")
    assert "hold no building 'aaaa" in runs.problem(missing, 404, "no-such-building")


def test_a_job_of_a_version_without_decisions_says_so(service: runs.Service, client: TestClient) -> None:
    job = service.finished()
    shutil.rmtree(service.folder.run(job, 1) / "decisions")
    answer = client.get(f"/jobs/{job}/buildings/{GABLE}/decisions")
    assert "recorded no decisions: submit it again" in runs.problem(answer, 404, "no-such-output")
    assert client.get(f"/jobs/{job}/buildings/{GABLE}").status_code == 200


def test_a_job_of_a_version_without_an_index_of_rows_gets_one(service: runs.Service, client: TestClient) -> None:
    job = service.finished()
    before = client.get(f"/jobs/{job}/buildings").json()["features"]
    (service.folder.outputs(job, 1) / NAME).unlink()
    assert client.get(f"/jobs/{job}/buildings").json()["features"] == before


def test_the_form_is_chosen_by_f_or_by_the_header(client: TestClient, job_id: str) -> None:
    path = f"/jobs/{job_id}/buildings/{GABLE}"
    for form, media_type in (("json", "application/geo+json"), ("obj", "model/obj")):
        assert client.get(path, params={"f": form}).headers["content-type"] == media_type
        assert client.get(path, headers={"Accept": media_type}).headers["content-type"] == media_type
    asked = {"Accept": "application/city+json, model/obj;q=0.5"}
    assert client.get(path, headers=asked).headers["content-type"] == "application/city+json"
    assert client.get(path, params={"f": "obj"}, headers=asked).headers["content-type"] == "model/obj"
    assert client.get(path, headers={"Accept": "image/png"}).status_code == 406
    assert client.get(path, params={"f": "png"}).status_code == 400


def test_the_mesh_is_the_file_of_the_run(client: TestClient, service: runs.Service, job_id: str) -> None:
    sent = client.get(f"/jobs/{job_id}/buildings/{TWO_PARTS}", params={"f": "obj"})
    assert sent.content == (service.folder.run(job_id, 1) / f"meshes/x851_y4470/{TWO_PARTS}.obj").read_bytes()


def test_the_mesh_out_of_a_tiles_file_is_the_same(client: TestClient, service: runs.Service, job_id: str) -> None:
    in_tiles = service.finished(lambda run_dir: runs.write_run(run_dir, meshes="tile"), meshes="tile")
    for name in ("gable", "courtyard", "two_parts", "pent", "far"):
        own, cut = (
            client.get(f"/jobs/{job}/buildings/{runs.ident(name)}", params={"f": "obj"}) for job in (job_id, in_tiles)
        )
        assert own.status_code == cut.status_code == 200
        assert own.content == cut.content


@pytest.fixture(scope="module")
def glb_job(service: runs.Service) -> str:
    """A job that was asked for GLB files."""
    return service.finished(lambda run_dir: runs.write_run(run_dir, meshes="glb"), meshes="glb")


@pytest.mark.parametrize("name", ["gable", "courtyard", "two_parts", "pent", "far"])
def test_the_glb_of_a_building_is_its_node_of_the_tiles_file(
    client: TestClient, service: runs.Service, glb_job: str, name: str
) -> None:
    path = f"/jobs/{glb_job}/buildings/{runs.ident(name)}"
    sent = client.get(path, params={"f": "glb"})
    assert (sent.status_code, sent.headers["content-type"]) == (200, "model/gltf-binary")
    assert sent.content == client.get(path, headers={"Accept": "model/gltf-binary"}).content
    assert "content-crs" not in sent.headers
    alone = glb_rules.read_glb(sent.content)
    assert list(alone.nodes) == [runs.ident(name)]
    mesh_path = alone.nodes[runs.ident(name)].extras["mesh_path"]
    tile = glb_rules.read_glb((service.folder.run(glb_job, 1) / mesh_path).read_bytes())
    mine, theirs = alone.nodes[runs.ident(name)], tile.nodes[runs.ident(name)]
    assert alone.place == tile.place
    assert mine.extras == theirs.extras
    assert mine.translation.tolist() == theirs.translation.tolist()
    assert len(mine.primitives) == len(theirs.primitives)
    for own, other in zip(mine.primitives, theirs.primitives, strict=True):
        assert (own.material, own.extras) == (other.material, other.extras)
        assert (own.triangles == other.triangles).all()
        assert (own.normals[own.indices] == other.normals[other.indices]).all()
        assert (own.planes[own.indices] == other.planes[other.indices]).all()
    links = {link["href"] for link in client.get(path).json()["links"] if link["type"] == "model/gltf-binary"}
    assert [client.get(href).content for href in links] == [sent.content]


def test_a_job_has_meshes_of_one_kind_and_names_it(client: TestClient, job_id: str, glb_job: str) -> None:
    for job, asked, there in ((job_id, "glb", "obj"), (glb_job, "obj", "glb")):
        answer = client.get(f"/jobs/{job}/buildings/{GABLE}", params={"f": asked})
        assert answer.status_code == 404
        assert answer.json()["detail"].endswith(f"request building {GABLE} with f={there}")
        assert client.get(f"/jobs/{job}/buildings/{GABLE}", params={"f": there}).status_code == 200


@pytest.mark.parametrize("meshes", ["building", "tile", "glb"])
def test_a_building_is_had_in_each_level_of_detail_that_was_made(
    client: TestClient, service: runs.Service, meshes: str
) -> None:
    levelled, block = runs.placed(small.levelled(), "levelled", 0.0, 0.0), runs.placed(small.courtyard(), "c", 0, 50.0)
    tiles = {"x850_y4470": [levelled, block]}
    job = service.finished(
        lambda run_dir: runs.write_run(run_dir, tiles, meshes=meshes, further_lods=("1.2", "1.3")), meshes=meshes
    )
    form = "glb" if meshes == "glb" else "obj"

    def sent(building: str, lod: str | None) -> bytes | int:
        asked = {"f": form} if lod is None else {"f": form, "lod": lod}
        answer = client.get(f"/jobs/{job}/buildings/{building}", params=asked)
        return answer.content if answer.status_code == 200 else answer.status_code

    contents = [sent(levelled.building_id, lod) for lod in ("2.2", "1.3", "1.2")]
    assert len({content for content in contents if isinstance(content, bytes)}) == 3
    assert sent(levelled.building_id, None) == contents[0]
    assert [sent(block.building_id, lod) for lod in ("1.2", "1.3", "2.2")] == [sent(block.building_id, None), 404, 404]
    for lod, height in (("1.3", b"6.75"), ("1.2", b"6.5")):
        found = sent(levelled.building_id, lod)
        if form == "obj":
            assert height in found
        else:
            assert glb_rules.read_glb(found).nodes[levelled.building_id].extras["lod"] == lod
    city = client.get(f"/jobs/{job}/buildings/{levelled.building_id}", params={"f": "cityjson"}).json()
    part = city["CityObjects"][f"{levelled.building_id}-0"]
    assert [geometry["lod"] for geometry in part["geometry"]] == ["2.2", "1.3", "1.2"]


def test_a_glb_that_is_gone_or_another_is_reported(client: TestClient, service: runs.Service) -> None:
    job = service.finished(lambda run_dir: runs.write_run(run_dir, meshes="glb"), meshes="glb")
    (path,) = service.folder.run(job, 1).glob("meshes/x851_y4470/*.glb")
    (other,) = service.folder.run(job, 1).glob("meshes/x850_y4470/*.glb")
    asked = f"/jobs/{job}/buildings/{TWO_PARTS}?f=glb"
    path.write_bytes(other.read_bytes())
    assert "holds no building" in runs.problem(client.get(asked), 404, "no-such-building")
    path.unlink()
    assert "no longer in the state folder" in runs.problem(client.get(asked), 404, "no-such-building")


def test_a_building_without_model_has_no_mesh_and_says_why(client: TestClient, job_id: str, glb_job: str) -> None:
    for job, form in ((job_id, "obj"), (glb_job, "glb")):
        answer = client.get(f"/jobs/{job}/buildings/{FAILED}", params={"f": form})
        assert "has no model (too_few_points)" in runs.problem(answer, 404, "no-such-building")
    links = client.get(f"/jobs/{job_id}/buildings/{FAILED}").json()["links"]
    assert "model/obj" not in {link["type"] for link in links}


def test_a_job_without_meshes_says_so(service: runs.Service) -> None:
    job = service.finished(lambda run_dir: runs.write_run(run_dir, meshes="none"), meshes="none")
    answer = service.client.get(f"/jobs/{job}/buildings/{GABLE}", params={"f": "obj"})
    assert "left out the meshes" in runs.problem(answer, 404, "no-such-building")
    assert service.client.get(f"/jobs/{job}/buildings/{GABLE}", params={"f": "cityjson"}).status_code == 200


def cjio(path: Path, *words: str) -> str:
    """Run cjio in a process of its own, since it changes Python's json on import."""
    command = [sys.executable, "-c", "from cjio.cjio import cli; cli()", str(path), *words]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.parametrize("name", ["two_parts", "courtyard", "failed"])
def test_the_city_object_is_a_document_of_its_own(client: TestClient, job_id: str, name: str, tmp_path: Path) -> None:
    sent = client.get(f"/jobs/{job_id}/buildings/{runs.ident(name)}", params={"f": "cityjson"})
    assert sent.headers["content-type"] == "application/city+json"
    document = sent.json()
    assert (document["type"], document["version"]) == ("CityJSON", "2.0")
    # the same rules as for a sequence of one line of metadata and one feature
    header = {**document, "CityObjects": {}, "vertices": []}
    feature = {"type": "CityJSONFeature", "id": runs.ident(name)}
    feature |= {part: document[part] for part in ("CityObjects", "vertices")}
    assert cityjson_rules.faults([header, feature]) == []
    path = tmp_path / "one.city.json"
    path.write_bytes(sent.content)
    assert "Building" in cjio(path, "info")
    obj = client.get(f"/jobs/{job_id}/buildings/{runs.ident(name)}", params={"f": "obj"})
    if obj.status_code == 200:
        corners = [tuple(map(float, xyz)) for xyz in re.findall(r"^v (\S+) (\S+) (\S+)$", obj.text, re.MULTILINE)]
        scale, shift = document["transform"]["scale"], document["transform"]["translate"]
        stood = [
            tuple(round(v * s + t, 3) for v, s, t in zip(xyz, scale, shift, strict=True))
            for xyz in document["vertices"]
        ]
        assert stood == corners
        low, high = (tuple(pick(axis) for axis in zip(*corners, strict=True)) for pick in (min, max))
        assert tuple(document["metadata"]["geographicalExtent"]) == pytest.approx((*low, *high))


@pytest.mark.parametrize(
    "name",
    [runs.ident("unknown"), "x", "A" * 24, "a" * 25, "..", "%2e%2e%2frun.json", "..%2f..%2frun.json", "%00", "' OR 1"],
)
def test_any_other_id_is_no_building(client: TestClient, job_id: str, name: str) -> None:
    for form in ("json", "obj", "glb", "cityjson"):
        answer = client.get(f"/jobs/{job_id}/buildings/{name}", params={"f": form})
        # a path that leads elsewhere is never a building
        assert answer.status_code in {400, 404} or "jobID" in answer.json()
        assert b"engine_version" not in answer.content


# --- an unknown CRS --------------------------------------------------------------------------------------------------


def test_where_the_crs_is_unknown_there_are_only_the_tiles_own_coordinates(service: runs.Service) -> None:
    job = service.finished(lambda run_dir: runs.write_run(run_dir, epsg=None))
    answer = service.client.get(f"/jobs/{job}/buildings", params={"bbox": "84990,446990,85011,447001"})
    assert "content-crs" not in answer.headers
    found = answer.json()
    assert found["coordRefSys"] is None
    assert ids(found) == [GABLE]
    assert shapely.geometry.shape(found["features"][0]["geometry"]).bounds == (85_000.0, 447_000.0, 85_010.0, 447_008.0)
    assert page(service.client, job, crs="native", bbox_crs="native")["numberMatched"] == 6
    assert "the CRS of the tiles is unknown or local: use native" in refused(service.client, job, crs="CRS84")
    assert "the CRS of the tiles is unknown or local: use native" in refused(service.client, job, bbox_crs="CRS84")
    one = service.client.get(f"/jobs/{job}/buildings/{GABLE}").json()
    assert one["coordRefSys"] is None
    assert service.client.get(f"/jobs/{job}/buildings/{GABLE}", params={"crs": "CRS84"}).status_code == 400


# --- the process that answers ----------------------------------------------------------------------------------------

_ANSWER = """
import json, sys
from pathlib import Path
import service.routes.buildings, service.routes.results
from service.features.index import NAME, RowIndex
from service.features.pages import among, bounded_by, feature_texts, sorted_page
from service.outputs import output_file
from service.outputs.single_building import building_cityjson, building_obj, stored_building
run, out = Path(sys.argv[1]), Path(sys.argv[2])
output_file(out, "buildings")
index = RowIndex(out / NAME)
conditions = [among("status", ["ok"]), bounded_by([(4.0, 51.0, 5.0, 53.0)], native=False)]
_, positions = sorted_page(index, conditions, by="id", limit=10, offset=0)
first = json.loads(next(feature_texts(index, "buildings", positions)))["id"]
one = stored_building(index, first)
list(building_obj(run, one)), building_cityjson(run, one)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_answering_loads_no_numerical_library(service: runs.Service, many: str) -> None:
    command = [sys.executable, "-c", _ANSWER, str(service.folder.run(many, 1)), str(service.folder.outputs(many, 1))]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = set(json.loads(result.stdout))
    heavy = {"numba", "scipy", "pandas", "geopandas", "matplotlib", "dask", "distributed", "pyarrow", "pyproj", "laspy"}
    assert loaded & heavy == set()
    assert {"fastapi", "sqlite3"} <= loaded


def test_the_openapi_document_describes_pages_and_buildings(client: TestClient) -> None:
    described = client.get("/openapi.json").json()["paths"]
    listed = described["/jobs/{jobID}/buildings"]["get"]
    assert {entry["name"] for entry in listed["parameters"]} == {
        *("jobID", "method", "bbox", "bbox-crs", "crs", "status", "roof_type", "reason", "limit", "offset")
    }
    text = (Path(__file__).resolve().parents[2] / "docs/how_to/results_by_rest.md").read_text()
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    reported = {word.strip(" `") for row in rows for word in row.split(",")}
    assert {entry["name"] for entry in listed["parameters"]} - {"jobID"} <= reported
    one = described["/jobs/{jobID}/buildings/{buildingID}"]["get"]["responses"]
    media_types = {"application/geo+json", "model/obj", "model/gltf-binary", "application/city+json"}
    assert set(one["200"]["content"]) == media_types
    for answers in (listed["responses"], one):
        assert {"200", "400", "401", "403", "404", "406", "422", "429", "500", "503"} <= set(answers)
    assert listed["responses"]["200"]["content"]["application/geo+json"]["example"]["features"]
