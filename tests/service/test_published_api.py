"""Further formats by REST: made by a job after its run, listed among its outputs, and served by path."""

import functools
import hashlib
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import finished_runs as runs
import pyarrow.parquet as pq
import pyogrio
import pytest
from starlette.testclient import TestClient

from pipeline.errors import RunCancelledError
from pipeline.export.glb_container import read_document
from pipeline.extras.party_walls.party_walls_of_run import party_walls
from pipeline.extras.publish.publishing import Form
from pipeline.runtime.manifest import RunStatus
from service.outputs import published_forms as published
from service.outputs.kinds import FORMATS, ON_REQUEST, OUTPUTS

WITHOUT_SOLAR = tuple(form for form in FORMATS if form != "solar")


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    """A job that published everything but solar energy."""
    return service.finished(publish=WITHOUT_SOLAR)


@pytest.fixture(scope="module")
def bare(service: runs.Service) -> str:
    """A job without further formats."""
    return service.finished()


def test_the_document_lists_every_output_by_reference_with_its_size_and_sum(
    client: TestClient, job_id: str, bare: str
) -> None:
    found = client.get(f"/jobs/{job_id}/results").json()
    assert list(found) == [name for name in OUTPUTS if name != "solar"]
    for name, entry in found.items():
        assert entry["href"] == f"http://127.0.0.1/jobs/{job_id}/results/{name}"
        answer = client.get(entry["href"])
        assert answer.headers["content-type"] == entry["type"] == OUTPUTS[name].media_type
        assert len(answer.content) == entry["bytes"] == int(answer.headers["content-length"])
        assert hashlib.sha256(answer.content).hexdigest() == entry["sha256"]
    assert list(client.get(f"/jobs/{bare}/results").json()) == [name for name in OUTPUTS if name not in ON_REQUEST]


@pytest.mark.parametrize("start", ["results/3dtiles", "results/3dtiles/tileset.json"])
def test_a_globe_finds_all_models_from_either_tileset(client: TestClient, job_id: str, start: str) -> None:
    address = f"http://127.0.0.1/jobs/{job_id}/{start}"
    tileset = client.get(address).json()
    assert tileset["asset"]["version"] == "1.1"
    waiting, buildings = [tileset["root"]], set()
    for node in waiting:
        if "content" in node:
            answer = client.get(urljoin(address, node["content"]["uri"]))
            assert (answer.status_code, answer.headers["content-type"]) == (200, "model/gltf-binary")
            table = read_document(answer.content)[0]["extensions"]["EXT_structural_metadata"]["propertyTables"][0]
            buildings.add((node["content"]["uri"].rpartition("/")[2], table["count"]))
        waiting.extend(node.get("children", ()))
    assert buildings == {("x850_y4470.glb", 2), ("x851_y4470.glb", 1), ("x850_y4471.glb", 2)}


@pytest.mark.parametrize("name", ["results/3dtiles/models/x850_y4470.glb", "points/x850_y4470/r.glb"])
def test_files_that_never_change_are_kept_for_good_and_sent_in_ranges_and_compressed(
    client: TestClient, job_id: str, name: str
) -> None:
    address = f"/jobs/{job_id}/{name}"
    whole = client.get(address)
    assert whole.headers["cache-control"] == "private, max-age=31536000, immutable"
    again = client.get(address, headers={"If-None-Match": whole.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    part = client.get(address, headers={"Range": "bytes=0-3"})
    assert (part.status_code, part.content) == (206, b"glTF")
    beyond = client.get(address, headers={"Range": "bytes=999999-"})
    assert "lies beyond the end" in runs.problem(beyond, 416, "about:blank")
    packed = client.get(address, headers={"Accept-Encoding": "gzip"})
    assert (packed.headers["content-encoding"], packed.content) == ("gzip", whole.content)


def test_the_zip_file_holds_the_tileset_as_it_is_served(client: TestClient, job_id: str) -> None:
    place = f"/jobs/{job_id}/results"
    with zipfile.ZipFile(io.BytesIO(client.get(f"{place}/3dtiles-zip").content)) as archive:
        assert "tileset.json" in archive.namelist()
        for name in archive.namelist():
            assert archive.read(name) == client.get(f"{place}/3dtiles/{name}").content, name


def test_maps_and_gis_read_the_files(client: TestClient, job_id: str, tmp_path: Path) -> None:
    for name, count in (("geopackage", 6), ("pmtiles", 5)):
        path = tmp_path / OUTPUTS[name].filename
        path.write_bytes(client.get(f"/jobs/{job_id}/results/{name}").content)
        options = {"ZOOM_LEVEL": 16} if name == "pmtiles" else {}
        assert len(pyogrio.read_dataframe(path, "buildings", use_arrow=False, **options)) >= count
    with zipfile.ZipFile(io.BytesIO(client.get(f"/jobs/{job_id}/results/cityjson-zip").content)) as archive:
        cities = [json.loads(archive.read(name)) for name in archive.namelist()]
    assert {city["type"] for city in cities} == {"CityJSON"}
    assert sum(thing["type"] == "Building" for city in cities for thing in city["CityObjects"].values()) == 6


@pytest.mark.parametrize("start", ["results/stac", "results/stac/collection.json"])
def test_the_catalogue_leads_to_every_file_it_lists(client: TestClient, job_id: str, start: str) -> None:
    address = f"http://127.0.0.1/jobs/{job_id}/{start}"
    collection = client.get(address).json()
    assert (collection["id"], collection["assets"]) == (job_id, {})
    items = [urljoin(address, link["href"]) for link in collection["links"] if link["rel"] == "item"]
    assert len(items) == 4
    for place in items:
        answer = client.get(place)
        assert answer.headers["content-type"] == "application/geo+json"
        for link in answer.json()["links"]:
            document = client.get(urljoin(place, link["href"])).json()
            assert document["id"] == job_id or (link["rel"], document["properties"]["pc:count"]) == (
                "derived_from",
                700,
            )
        assets = answer.json()["assets"]
        assert {"buildings", "planes", "rejected", "cityjson"} <= set(assets)
        for asset in assets.values():
            file = client.get(urljoin(place, asset["href"]))
            assert f"1220{hashlib.sha256(file.content).hexdigest()}" == asset["file:checksum"]
            assert file.headers["content-type"] == asset["type"]
    assert "/srv/" not in client.get(address).text


def test_the_catalogue_leads_to_the_points_and_names_no_folder(client: TestClient, job_id: str) -> None:
    address = f"http://127.0.0.1/jobs/{job_id}/results/stac"
    (child,) = (link["href"] for link in client.get(address).json()["links"] if link["rel"] == "child")
    place = urljoin(address, child)
    points = client.get(place)
    assert (points.json()["id"], points.headers["content-type"]) == (f"{job_id}-points", "application/json")
    (item,) = (link["href"] for link in points.json()["links"] if link["rel"] == "item")
    answer = client.get(urljoin(place, item))
    assert answer.headers["content-type"] == "application/geo+json"
    assert (answer.json()["properties"]["title"], answer.json()["assets"]) == ("Points of tile.laz", {})
    assert "/srv/" not in points.text + answer.text


@pytest.mark.parametrize(
    "path",
    ["results/3dtiles/..%2f..%2frun%2frun.json", "results/3dtiles/outputs.json", "results/3dtiles/models/x1_y1.glb",
     "results/3dtiles/..%2frows.sqlite", "results/stac/x850_y4470/x851_y4470.json", "results/report/tileset.json",
     "results/nothing/tileset.json", "results/3dtiles/tileset.json%0a", "run/state/x850_y4470/x850_y4470.json",
     "run/buildings/tile=x850_y4470/..%2f..%2frun.json", "run/buildings/tile=x1_y1/part-0.parquet",
     "results/3dtiles/skylines/x1_y1.glb", "results/outputs.json", "results/rows.sqlite", "results/%00",
     "results/..%2f..%2fservice.db", "points/x850_y4470/buildings.json", "points/x850_y4470/..%2f..%2frun.json",
     "points/..%2frun.json", "points/x850_y4470/r9.glb", "points/a/b.glb", "points/x850_y4470/r0.glb",
     "points/tileset-ecef.json", "points/x850_y4470%2ftileset.json%0a"],
)  # fmt: skip
def test_nothing_else_is_served(client: TestClient, job_id: str, path: str) -> None:
    answer = client.get(f"/jobs/{job_id}/{path}")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")


@pytest.mark.parametrize(
    "path",
    [*(f"/jobs/JOB/results/{name}" for name in OUTPUTS if name != "solar"),
     "/jobs/JOB/results/3dtiles/tileset.json", "/jobs/JOB/results/3dtiles/models/x850_y4470.glb",
     "/jobs/JOB/results/stac/collection.json", "/jobs/JOB/results/stac/x850_y4470/x850_y4470.json",
     "/jobs/JOB/run/buildings/tile=x850_y4470/part-0.parquet", "/jobs/JOB/results/3dtiles/nothing.json",
     "/jobs/JOB/run/state/x1_y1/x1_y1.json", "/jobs/JOB/points/tileset.json",
     "/collections", "/collections/JOB.buildings",
     "/collections/JOB.buildings/queryables", "/collections/JOB.buildings/schema", "/collections/JOB.buildings/items",
     "/collections/JOB.buildings/items?limit=2&filter=height_m%20%3E%201", "/collections/JOB.buildings/items/nothing",
     "/collections/JOB.nothing/items"],
)  # fmt: skip
def test_the_head_of_an_answer_is_that_of_get_without_its_body(client: TestClient, job_id: str, path: str) -> None:
    place = path.replace("JOB", job_id)
    for headers in ({}, {"Accept": "text/csv"}, {"Range": "bytes=0-3"}):
        whole, head = (client.request(method, place, headers=headers) for method in ("GET", "HEAD"))
        assert head.content == b""
        assert head.status_code == whole.status_code
        assert head.headers == whole.headers
    refused = client.put(place)
    assert (refused.status_code, refused.headers["allow"]) == (405, "GET, HEAD, OPTIONS")


def test_a_job_without_further_formats_says_so(client: TestClient, bare: str) -> None:
    for path in ("results/3dtiles/tileset.json", "results/geopackage"):
        assert "the request left out" in runs.problem(client.get(f"/jobs/{bare}/{path}"), 404, "no-such-output")
    of_run = client.get(f"/jobs/{bare}/run/buildings/tile=x850_y4470/part-0.parquet")
    assert "publish stac" in runs.problem(of_run, 404, "no-such-output")


def test_what_cannot_be_made_leaves_the_rest(service: runs.Service, client: TestClient) -> None:
    unknown = functools.partial(runs.write_run, epsg=None)
    problems: dict[str, str] = {}
    job = service.finished(unknown, publish=WITHOUT_SOLAR, problems=problems)
    assert set(problems) == {"3dtiles", "pmtiles", "stac"}
    assert all("CRS" in problem for problem in problems.values())
    there = set(client.get(f"/jobs/{job}/results").json()) & set(ON_REQUEST)
    assert there == {"geopackage", "cityjson-zip", "party-walls", "wall-areas"}
    holes = functools.partial(runs.write_run, failed_tile="x9_y9", status=RunStatus.INCOMPLETE)
    problems.clear()
    service.finished(holes, publish=("geopackage",), problems=problems)
    assert "would have holes" in problems["geopackage"]


@pytest.mark.parametrize("form", WITHOUT_SOLAR)
def test_an_unexpected_fault_leaves_out_that_format_whole(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs.write_run(tmp_path / "run")
    plain = published._write

    def broken(one: Form, *given: Any) -> None:
        plain(one, *given)
        if one.name == form:
            (tmp_path / "out" / form).mkdir(exist_ok=True)
            raise IndexError("list index out of range")

    monkeypatch.setattr(published, "_write", broken)
    found = published.publish(tmp_path / "run", tmp_path / "out", WITHOUT_SOLAR, name="some run")
    assert {name: type(error) for name, error in found.items()} == {form: IndexError}
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert not files & {form, *(OUTPUTS[name].filename for name in FORMATS[form])}
    assert files >= {OUTPUTS[name].filename for other in set(WITHOUT_SOLAR) - {form} for name in FORMATS[other]}
    if form != "stac":
        collection = json.loads((tmp_path / "out" / "stac.json").read_text(encoding="utf-8"))
        assert collection["id"] == "some run"


def test_a_format_without_memory_ends_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs.write_run(tmp_path / "run")

    def broken(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(published, "_write", broken)
    with pytest.raises(MemoryError):
        published.publish(tmp_path / "run", tmp_path / "out", ("pmtiles",), name="a")


def test_a_cancellation_within_a_format_ends_the_work(tmp_path: Path) -> None:
    runs.write_run(tmp_path / "run")
    calls = iter([None, RunCancelledError("the job was cancelled")])

    def cancelled_once(*_: int) -> None:
        if error := next(calls, None):
            raise error

    with pytest.raises(RunCancelledError):
        published.publish(tmp_path / "run", tmp_path / "out", ("pmtiles",), name="a", on_progress=cancelled_once)


def test_party_walls_are_two_outputs_with_the_tables_of_the_command(
    service: runs.Service, client: TestClient, tmp_path: Path
) -> None:
    run_dir = runs.write_run(tmp_path / "run")
    party_walls(str(run_dir), str(tmp_path / "walls.parquet"), buildings=str(tmp_path / "areas.parquet"))
    job = service.finished(publish=("party-walls",))
    for name, file in (("party-walls", "walls.parquet"), ("wall-areas", "areas.parquet")):
        found = pq.read_table(io.BytesIO(client.get(f"/jobs/{job}/results/{name}").content))
        assert found.equals(pq.read_table(tmp_path / file)), name
    assert found.num_rows > 0


@pytest.mark.slow
def test_the_solar_table_is_an_output(service: runs.Service, client: TestClient) -> None:
    pytest.importorskip("pvlib")
    job = service.finished(publish=("solar",))
    solar, planes = (
        pq.read_table(io.BytesIO(client.get(f"/jobs/{job}/results/{name}").content)) for name in ("solar", "planes")
    )
    assert solar.num_rows == planes.num_rows > 0
    assert min(solar["irradiation_kwh_m2"].to_pylist()) > 0.0


# --- the request


def submitted(client: TestClient, inputs: dict[str, Any], outputs: dict[str, Any] | None = None) -> Any:
    """The answer to a request for a job."""
    tile = client.post("/uploads?filename=a.xyz", content=b"1 2 3\n4 5 6\n7 9 9\n").headers["location"]
    body: dict[str, Any] = {
        "inputs": {"tiles": {"href": tile}, "crs": "EPSG:28992", "allowOutsideAreaOfUse": True, **inputs}
    }
    return client.post(
        "/processes/reconstruct/execution", json=body | ({} if outputs is None else {"outputs": outputs})
    )


def test_a_format_is_asked_for_by_input_or_by_output(client: TestClient) -> None:
    by_input = submitted(client, {"publish": ["pmtiles", "3dtiles"], "geoidHeight": 43.2}, {"report": {}}).json()
    assert by_input["request"]["inputs"]["publish"] == ["3dtiles", "pmtiles"]
    assert by_input["request"]["inputs"]["geoidHeight"] == 43.2
    assert list(by_input["request"]["outputs"]) == ["report", "pmtiles", "3dtiles", "3dtiles-zip"]
    by_output = submitted(client, {}, {"3dtiles-zip": {}}).json()
    assert by_output["request"]["inputs"]["publish"] == ["3dtiles"]
    assert list(by_output["request"]["outputs"]) == ["3dtiles-zip"]
    plain = submitted(client, {}).json()
    assert "publish" not in plain["request"]["inputs"]
    assert submitted(client, {"publish": "geopackage"}).json()["request"]["inputs"]["publish"] == ["geopackage"]


def test_a_form_asks_for_formats_with_commas(client: TestClient) -> None:
    fields = {
        "crs": "EPSG:28992",
        "allowOutsideAreaOfUse": "true",
        "publish": "pmtiles, 3dtiles",
        "geoidHeight": "43.2",
    }
    answer = client.post("/jobs", data=fields, files={"tile": ("a.xyz", b"1 2 3\n4 5 6\n7 9 9\n")})
    assert answer.status_code == 201, answer.text
    inputs = answer.json()["request"]["inputs"]
    assert (inputs["publish"], inputs["geoidHeight"]) == (["3dtiles", "pmtiles"], 43.2)


@pytest.mark.parametrize(
    ("inputs", "said"),
    [({"publish": ["shapefile"]}, "3dtiles, geopackage"),
     ({"publish": ["pmtiles"], "geoidHeight": 43.0}, "add 3dtiles"),
     ({"publish": ["3dtiles"], "geoidHeight": 900.0}, "geoidHeight")],
)  # fmt: skip
def test_a_wish_that_makes_no_sense_is_refused(client: TestClient, inputs: dict[str, Any], said: str) -> None:
    assert said in runs.problem(submitted(client, inputs), 400, "invalid-request")


def test_a_service_without_pvlib_refuses_solar(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    reported = runs.problem(submitted(client, {"publish": ["solar"]}), 400, "invalid-request")
    assert re.search("needs pvlib.*leave solar out", reported)


def test_a_comparison_refuses_formats(client: TestClient) -> None:
    methods = ["kmeans", "fuzzy-sart"]
    inputs = {"tiles": {"href": "/uploads/" + "a" * 32}, "methods": methods, "publish": ["3dtiles"]}
    answer = client.post("/processes/compare/execution", json={"inputs": inputs})
    assert "submit reconstruct" in runs.problem(answer, 400, "invalid-request")
