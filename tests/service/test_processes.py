"""The processes: descriptions that hold for the code, and requests of which every fault is reported."""

import base64
import json
import re

import jsonschema
import pytest
from live_service import POINTS

from pipeline.methods import METHODS, PRESETS
from pipeline.settings import RunSettings
from service.drafts import reference_of
from service.jobs import InputReference
from service.keys import Scope
from service.outputs import OUTPUTS
from service.run_settings import settings_faults, settings_schema
from service.wire.inputs import CompareInputs, ReconstructInputs
from service.wire.jobs import JobForm


def execute(service, inputs: object, **body: object):
    return service.client.post("/processes/reconstruct/execution", json={"inputs": inputs, **body})


def of_an_upload(service, **more: object) -> dict[str, object]:
    """The inputs of a job of one upload."""
    return {"tiles": {"href": f"/uploads/{service.upload()}"}, "crs": "EPSG:28992", **more}


def faults_of(answer) -> str:
    assert answer.status_code == 400, answer.text
    return "\n".join(answer.json()["errors"])


def test_the_fields_of_the_form_are_inputs_of_the_processes() -> None:
    inputs = {*ReconstructInputs.model_fields, *CompareInputs.model_fields}
    assert {name.replace("tile", "tiles") for name in JobForm.model_fields} == inputs | {"outputs", "subscriber"}


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "none-such"},
        {"halo_m": -1.0, "classes": "believe"},
        {"roof": {"no_such": 1}, "candidates": {"min_area_m2": "wide"}},
        {"no-such-table": {}},
        {"candidates": {"min_area_m2": 15}, "method": "fuzzy-sart"},
        {"class-codes": {"building": [6, 2], "noise": [7, 6, 300]}},
        {"class-codes": {"ground": [2, 6]}, "candidates": {"min_area_m2": -1}},
        {"footprints": {"height": 7.5, "storeys": "levels", "storey_height_m": 99.0}},
    ],
)
def test_the_service_finds_the_faults_of_settings_that_a_run_finds(settings: dict) -> None:
    from pipeline.errors import SettingsError

    try:
        RunSettings.from_mapping(settings)
        wanted: set[str] = set()
    except SettingsError as error:
        wanted = set(error.faults)
    assert set(settings_faults(settings)) == wanted


def test_what_only_json_can_say_is_a_fault_too() -> None:
    found = settings_faults({"halo_m": None, "roof": {"step_offset_spacings": 10**400}, "lattice_x_m": [1]})
    assert len(found) == 3
    assert any("401 digits" in fault for fault in found)


def test_the_schema_of_settings_is_a_json_schema_whose_defaults_fit_it() -> None:
    schema = settings_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    defaults = {
        name: {field: value["default"] for field, value in found["properties"].items()}
        if found["type"] == "object"
        else found["default"]
        for name, found in schema["properties"].items()
    }
    jsonschema.validate(defaults, schema)
    assert settings_faults(defaults) == []


def test_the_description_names_methods_and_outputs_of_the_code(local_service) -> None:
    described = local_service.client.get("/processes/reconstruct").json()
    assert described["inputs"]["method"]["schema"]["enum"] == list(METHODS)
    assert described["inputs"]["preset"]["schema"]["enum"] == list(PRESETS)
    assert set(described["outputs"]) == set(OUTPUTS)
    assert described["jobControlOptions"] == ["async-execute", "dismiss"]
    for described_input in described["inputs"].values():
        jsonschema.Draft202012Validator.check_schema(described_input["schema"])
    assert described["inputs"]["tiles"]["minOccurs"] == 1


def test_the_list_of_processes_has_pages(local_service) -> None:
    page = local_service.client.get("/processes?limit=2").json()
    assert [process["id"] for process in page["processes"]] == ["reconstruct", "compare"]
    assert {link["rel"] for link in page["links"]} == {"self", "next"}
    rest = local_service.client.get(next(link["href"] for link in page["links"] if link["rel"] == "next")).json()
    assert [process["id"] for process in rest["processes"]] == ["classify", "echo"]
    assert {link["rel"] for link in rest["links"]} == {"self"}
    assert local_service.client.get("/processes?limit=0").status_code == 400


def test_the_answer_to_an_unknown_process_names_the_known_ones(local_service) -> None:
    for answer in (
        local_service.client.get("/processes/paint"),
        local_service.client.post("/processes/paint/execution", json={"inputs": {}}),
    ):
        assert answer.status_code == 404
        assert answer.json()["type"].endswith("/no-such-process")
        assert "reconstruct" in answer.json()["detail"]


def test_a_job_of_an_upload_waits_as_soon_as_the_answer_is_there(local_service) -> None:
    upload = local_service.upload()
    inputs = {
        "tiles": [{"href": f"/uploads/{upload}"}],
        "crs": "EPSG:28992",
        "method": "fuzzy-sart",
        "settings": {"candidates": {"min_area_m2": 15}},
        "bbox": {"bbox": [0, 0, 10, 10], "crs": "http://www.opengis.net/def/crs/EPSG/0/28992"},
        "title": "Straße 1",
    }
    answer = local_service.client.post(
        "/processes/reconstruct/execution",
        json={"inputs": inputs, "outputs": {"report": {}, "buildings": {}}},
        headers={"Prefer": "respond-async, wait=10"},
    )
    assert answer.status_code == 201
    assert answer.headers["preference-applied"] == "respond-async"
    reported = answer.json()
    assert answer.headers["location"].endswith(f"/jobs/{reported['jobID']}")
    assert (reported["status"], reported["type"], reported["processID"]) == ("accepted", "process", "reconstruct")
    job = local_service.store.get(reported["jobID"])
    assert job.request.tiles == (InputReference(kind="upload", value=upload),)
    assert job.request.settings == {"candidates": {"min_area_m2": 15}, "method": "fuzzy-sart"}
    assert job.request.bbox == (0.0, 0.0, 10.0, 10.0)
    assert job.request.outputs == ("buildings", "report")
    assert reported["request"]["inputs"]["title"] == "Straße 1"


def test_a_crs_may_be_a_bare_code(local_service) -> None:
    for given, taken in (("28992", "EPSG:28992"), (" 28992+5709 ", "EPSG:28992+5709")):
        inputs = {**of_an_upload(local_service), "crs": given}
        inputs["bbox"] = {"bbox": [0, 0, 10, 10], "crs": given}
        reported = execute(local_service, inputs).json()
        assert local_service.store.get(reported["jobID"]).request.crs == taken
        assert reported["request"]["inputs"]["crs"] == taken
    assert "is geographic" in faults_of(execute(local_service, {**of_an_upload(local_service), "crs": "4326"}))


def test_the_request_that_a_job_says_can_be_sent_again(local_service) -> None:
    first = execute(local_service, of_an_upload(local_service, priority=-3)).json()
    second = local_service.client.post("/processes/reconstruct/execution", json=first["request"]).json()
    one, other = (local_service.store.get(reported["jobID"]) for reported in (first, second))
    assert (one.request, one.priority) == (other.request, other.priority)
    assert one.priority == -3


def test_without_a_preference_none_is_applied(local_service) -> None:
    answer = execute(local_service, of_an_upload(local_service))
    assert answer.status_code == 201
    assert "preference-applied" not in answer.headers


def test_a_tile_by_value_becomes_an_upload(local_service) -> None:
    value = {"value": base64.b64encode(POINTS).decode(), "encoding": "base64", "mediaType": "text/plain"}
    answer = execute(local_service, {"tiles": [value], "crs": "EPSG:28992"})
    reference = local_service.request_of(answer).tiles[0]
    kept = local_service.store.upload(reference.value)
    assert (kept.filename, kept.size_bytes) == ("tiles.xyz", len(POINTS))


def test_footprints_by_value_are_geojson(local_service) -> None:
    square = {"type": "Polygon", "coordinates": [[[1, 1], [9, 1], [9, 9], [1, 9], [1, 1]]]}
    outlines = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": square}]}
    for footprints in (outlines, {"value": outlines, "mediaType": "application/geo+json"}):
        answer = execute(local_service, of_an_upload(local_service, footprints=footprints))
        reference = local_service.request_of(answer).footprints
        path = local_service.settings.state / "uploads" / reference.value / "footprints.geojson"
        assert json.loads(path.read_text()) == outlines


LINE = {
    "type": "Feature",
    "properties": {"kind": "ridge"},
    "geometry": {"type": "LineString", "coordinates": [[1, 1], [9, 1]]},
}


def test_guides_are_a_file_of_lines_by_value_or_by_reference(local_service) -> None:
    lines = {"type": "FeatureCollection", "features": [LINE]}
    sent = local_service.client.post("/uploads?filename=lines.geojson", content=json.dumps(lines))
    assert (sent.status_code, sent.json()["preflight"]["kind"], sent.json()["preflight"]["shapes"]) == (
        201,
        "guides",
        ["lines"],
    )
    for guides in (lines, {"value": lines, "mediaType": "application/geo+json"}, {"href": sent.headers["location"]}):
        answer = execute(local_service, of_an_upload(local_service, guides=guides))
        assert "/uploads/" in answer.json()["request"]["inputs"]["guides"]["href"]
        upload = local_service.store.upload(local_service.request_of(answer).guides.value)
        path = local_service.settings.state / "uploads" / upload.upload_id / upload.filename
        assert upload.filename in {"guides.geojson", "lines.geojson"}
        assert json.loads(path.read_text()) == lines


def test_guides_that_cannot_be_used_are_refused_with_the_fix(local_service) -> None:
    square = {"type": "Polygon", "coordinates": [[[1, 1], [9, 1], [9, 9], [1, 9], [1, 1]]]}
    points, polygons = (
        {"type": "FeatureCollection", "features": [{**LINE, "geometry": geometry}]}
        for geometry in ({"type": "Point", "coordinates": [1, 1]}, square)
    )
    for guides, said in (
        (points, "none of its 1 features is a polygon with a ring or a line.*or with lines of roofs"),
        (polygons, "guides.geojson' is not a file of guides: it holds polygons, not lines. Upload a file that does"),
        ({"href": "/uploads/" + "0" * 32}, "no upload"),
        ([1, 2], r"guides is \[1, 2\]: use one file"),
    ):
        answer = execute(local_service, of_an_upload(local_service, guides=guides))
        assert answer.status_code in {400, 404, 422}
        assert re.search(said, answer.text), answer.text


def test_the_processes_that_model_buildings_take_guides(local_service) -> None:
    for process, takes in (("reconstruct", True), ("compare", True), ("classify", False)):
        inputs = local_service.client.get(f"/processes/{process}").json()["inputs"]
        assert ("guides" in inputs) == takes, process
        if takes:
            assert inputs["guides"]["valuePassing"] == ["byValue", "byReference"]
            assert (inputs["guides"]["minOccurs"], inputs["guides"]["schema"]) == (0, inputs["footprints"]["schema"])


def test_all_faults_of_a_request_are_reported_at_once(local_service) -> None:
    answer = execute(
        local_service,
        {
            "tiles": [{"href": "relative.laz"}, {"value": "%%%"}],
            "crs": "EPSG:4326",
            "verticalUnit": "ell",
            "bbox": [0, 0, -1, 1],
            "method": "guess",
            "settings": {"roof": {"no_such": 1}},
            "meshes": "all",
            "title": "a\u0000b",
            "priority": 99,
            "colour": "red",
        },
        outputs={"pictures": {}},
    )
    reported = faults_of(answer)
    for words in ("tiles[0].href", "tiles[1]", "geographic", "verticalUnit", "bbox", "method", "[roof] no_such"):
        assert words in reported
    for words in ("meshes", "title", "priority", "colour", "pictures"):
        assert words in reported
    assert local_service.client.get("/jobs").json()["jobs"] == []


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "tiles is missing"),
        ({"inputs": []}, "inputs is"),
        ({"inputs": {}, "outputs": ["buildings"]}, "outputs is"),
        ({"inputs": {}, "mode": "sync"}, "mode is"),
        ({"inputs": {}, "response": "raw!"}, "response is"),
        ({"inputs": {}, "outputs": {"report": {"transmissionMode": "value"}}}, 'transmissionMode is "value": use'),
        (
            {"inputs": {}, "outputs": {"report": {"format": {"mediaType": "text/csv"}}}},
            'outputs.report.format.mediaType is "text/csv": use "application/json"',
        ),
        ({"inputs": {}, "outputs": {"report": {"colour": "red"}}}, '"colour" is not a member: use format'),
        ({"inputs": {}, "subscriber": {}}, "subscriber is empty: give one of successUri"),
        (
            {"inputs": {}, "subscriber": {"sucessUri": "https://example.org"}},
            '"sucessUri" is not a member: use successUri',
        ),
        ({"inputs": {"tiles": None}}, "tiles is missing"),
        ({"inputs": {"tiles": 7}}, "tiles is 7"),
        ({"inputs": {}, "mode": []}, "mode is []"),
        ({"inputs": {}, "response": {}}, "response is {}"),
        ({"inputs": {"tiles": {"value": "eA==", "mediaType": []}}}, "tiles.mediaType is []"),
    ],
)
def test_a_request_that_is_none_is_refused(local_service, body: dict, words: str) -> None:
    assert words in faults_of(local_service.client.post("/processes/reconstruct/execution", json=body))


def execute_text(service, content: bytes):
    json_type = {"Content-Type": "application/json"}
    return service.client.post("/processes/reconstruct/execution", content=content, headers=json_type)


def test_a_body_nested_as_deeply_as_can_just_be_read_is_refused(local_service) -> None:
    for depth in range(700, 1020, 8):
        for opened, closed in (("[", "]"), ('{"a":', "}")):
            nested = opened * depth + "1" + closed * depth
            for body in (f'{{"inputs": {{"tiles": {nested}}}}}', f'{{"inputs": {{}}, "mode": {nested}}}'):
                assert execute_text(local_service, body.encode()).status_code == 400, depth


def test_a_body_that_is_no_json_is_refused_with_the_reason(local_service) -> None:
    for content in (b"{", b"[1]", b"\xff", b"9" * 10_000):
        answer = execute_text(local_service, content)
        assert answer.status_code == 400, content[:20]
        assert answer.headers["content-type"] == "application/problem+json"


def test_levels_of_detail_are_an_input_of_their_own(local_service) -> None:
    answer = execute(local_service, of_an_upload(local_service, lods="1.2,2.2"))
    stored = local_service.request_of(answer).settings
    assert stored == {"lods": "1.2,2.2"}
    assert RunSettings.from_mapping(stored).building.lods == ("1.2", "2.2")
    assert "lods is" in faults_of(execute(local_service, of_an_upload(local_service, lods="2.1")))


def test_a_preset_stands_beside_the_method(local_service) -> None:
    inputs = of_an_upload(local_service, method="fuzzy-sart", preset="faithful")
    answer = execute(local_service, inputs)
    stored = local_service.request_of(answer).settings
    assert stored == {"method": "fuzzy-sart", "preset": "faithful"}
    assert RunSettings.from_mapping(stored).building.method == METHODS["fuzzy-sart"].preset("faithful")
    assert "preset is" in faults_of(execute(local_service, {**inputs, "preset": "loose"}))
    without_paper = faults_of(execute(local_service, {**inputs, "method": "arrangement"}))
    assert "preset is 'faithful', and arrangement follows no paper: use robust" in without_paper
    contradicted = {**inputs, "settings": {"preset": "robust"}}
    assert "settings.preset" in faults_of(execute(local_service, contradicted))


def test_method_and_settings_may_not_contradict_each_other(local_service) -> None:
    inputs = of_an_upload(local_service, classes="trust", settings={"classes": "audit"})
    assert "classes is trust" in faults_of(execute(local_service, inputs))


def test_a_rectangle_in_another_crs_is_refused(local_service) -> None:
    box = {"bbox": [4.0, 52.0, 4.1, 52.1]}
    for more in ({}, {"crs": "http://www.opengis.net/def/crs/OGC/1.3/CRS84"}):
        assert "bbox" in faults_of(execute(local_service, of_an_upload(local_service, bbox=box | more)))


def test_a_missing_upload_is_named(local_service) -> None:
    answer = execute(local_service, {"tiles": {"href": f"/uploads/{'0' * 32}"}, "crs": "EPSG:28992"})
    assert answer.status_code in {400, 404}
    assert "0" * 32 in answer.json()["detail"]


def test_nothing_is_kept_of_a_request_that_is_refused(local_service) -> None:
    good = {"value": base64.b64encode(POINTS).decode(), "mediaType": "text/plain"}
    bad = {"value": base64.b64encode(b"LASF" + bytes(40)).decode()}
    answer = execute(local_service, {"tiles": [good, bad], "crs": "EPSG:28992"})
    assert answer.status_code == 422, answer.text
    assert list((local_service.settings.state / "uploads").iterdir()) == []


def test_a_high_priority_needs_the_scope_admin(local_service) -> None:
    submitter, admin = local_service.key(Scope.SUBMIT), local_service.key(Scope.ADMIN)

    def send(header: dict[str, str], priority: int) -> int:
        tile = {"href": f"/uploads/{local_service.upload(**header)}"}
        body = {"inputs": {"tiles": tile, "crs": "EPSG:28992", "priority": priority}}
        return local_service.client.post("/processes/reconstruct/execution", json=body, headers=header).status_code

    assert send(submitter, 1) == 403
    assert send(submitter, -1) == 201
    assert send(admin, 1) == 201


def test_the_answer_of_a_full_queue_says_when_to_try_again(starting) -> None:
    service = starting(max_queued=2)
    answers = [execute(service, of_an_upload(service)) for _ in range(3)]
    assert [answer.status_code for answer in answers] == [201, 201, 429]
    assert int(answers[2].headers["retry-after"]) > 0


@pytest.mark.parametrize(
    ("href", "kind", "value"),
    [
        (f"/uploads/{'a' * 32}", "upload", "a" * 32),
        (f"https://example.org/prefix/uploads/{'a' * 32}", "url", f"https://example.org/prefix/uploads/{'a' * 32}"),
        ("https://example.org/tile.laz", "url", "https://example.org/tile.laz"),
        ("file:///data/a%20b.laz", "path", "/data/a b.laz"),
        ("/data/tile.laz", "path", "/data/tile.laz"),
    ],
)
def test_an_href_is_an_upload_a_url_or_a_path(href: str, kind: str, value: str) -> None:
    assert reference_of(href) == InputReference(kind=kind, value=value)


@pytest.mark.parametrize(
    "href", ["tile.laz", "../tile.laz", "ftp://example.org/a", "file://host/a", "s3://b/k", "https://"]
)
def test_any_other_href_is_none(href: str) -> None:
    assert reference_of(href) is None


def test_values_may_be_wrapped_as_the_standard_allows() -> None:
    given = {"tiles": "/srv/a.laz", "title": [{"value": "a title"}], "meshes": ["none"]}
    inputs = ReconstructInputs.model_validate({**given, "tiles": [{"href": "/srv/a.laz"}]})
    assert (inputs.title, inputs.meshes) == ("a title", "none")


def test_members_beside_the_inputs_are_refused_with_their_place(local_service) -> None:
    body = {"inputs": of_an_upload(local_service), "priority": 5, "foo": 1}
    answer = local_service.client.post("/processes/reconstruct/execution", json=body)
    faults = faults_of(answer)
    assert '"priority" is not a member: it is an input, put it into inputs' in faults
    assert '"foo" is not a member: use inputs, outputs' in faults


@pytest.mark.parametrize(
    ("tile", "words"),
    [
        ({"href": "/srv/a.laz", "method": "POST"}, '"method" is not a member: use href'),
        ({"value": "AAAA", "schema": {}}, '"schema" is not a member: use value'),
    ],
)
def test_members_of_a_file_that_would_be_ignored_are_refused(local_service, tile: dict, words: str) -> None:
    assert words in faults_of(execute(local_service, {"tiles": [tile]}))


def test_a_link_may_say_what_links_say(local_service) -> None:
    inputs = of_an_upload(local_service)
    (tile,) = inputs["tiles"] if isinstance(inputs["tiles"], list) else [inputs["tiles"]]
    linked = {**tile, "rel": "item", "type": "application/vnd.las", "title": "a tile", "hreflang": "en", "length": 9}
    assert execute(local_service, {**inputs, "tiles": [linked]}).status_code == 201


def test_an_upload_at_another_host_is_not_ours(local_service) -> None:
    inputs = {"crs": "EPSG:28992"}
    upload = local_service.upload()
    own = [f"/uploads/{upload}", f"uploads/{upload}", f"http://127.0.0.1:8000/uploads/{upload}"]
    for href in own:
        made = execute(local_service, {**inputs, "tiles": {"href": href}})
        assert local_service.request_of(made).tiles == (InputReference(kind="upload", value=upload),), href
    foreign = ["http://other", "https://127.0.0.1:8000", "http://127.0.0.1:8001", "http://127.0.0.1:8000/prefix"]
    foreign += ["http://me@127.0.0.1:8000", "file://"]
    for base in foreign:
        answer = execute(local_service, {**inputs, "tiles": {"href": f"{base}/uploads/{upload}"}})
        assert answer.status_code == 403, base


def test_an_upload_below_the_services_own_path_is_ours(starting) -> None:
    service = starting(public_url="https://example.org/models/", root_path="/models")
    upload = service.upload()
    for href in (f"https://example.org/models/uploads/{upload}", f"/models/uploads/{upload}"):
        made = execute(service, {"crs": "EPSG:28992", "tiles": {"href": href}})
        assert service.request_of(made).tiles[0].kind == "upload", href
    answer = execute(service, {"crs": "EPSG:28992", "tiles": {"href": f"https://example.org/uploads/{upload}"}})
    assert answer.status_code == 403
