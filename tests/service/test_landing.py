"""The landing page, conformance, health and figures."""

import html
import json
import re
from pathlib import Path

import pytest

from pipeline import __version__
from pipeline.export.columns import BUILDINGS
from pipeline.io.formats import POINT_SUFFIXES
from pipeline.model import Reason
from pipeline.runtime.monitoring.stages import STAGES
from service.errors import StartUpError
from service.filenames import FOOTPRINT_SUFFIXES
from service.keys import Scope
from service.page_words import page_words
from service.routes import landing
from service.routes.collections import CONFORMANCE as FEATURES
from service.settings import ServiceSettings
from service.status import RELATIONS


def test_the_landing_page_links_to_all_that_the_standard_wants(local_service) -> None:
    page = local_service.client.get("/").json()
    relations = {link["rel"]: link["href"] for link in page["links"]}
    wanted = {"service-desc", f"{RELATIONS}conformance", f"{RELATIONS}processes", f"{RELATIONS}job-list"}
    assert wanted <= set(relations)
    for href in relations.values():
        assert local_service.client.get(href).status_code == 200, href


def test_browsers_get_html_and_machines_get_json(local_service) -> None:
    browser = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
    page = local_service.client.get("/", headers=browser)
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'self'" in page.headers["content-security-policy"]
    for accept in ("*/*", "application/json", ""):
        assert local_service.client.get("/", headers={"Accept": accept}).json()["title"] == "gablework"


def test_the_parameter_f_stands_above_the_header(local_service) -> None:
    browser = {"Accept": "text/html"}
    assert local_service.client.get("/?f=json", headers=browser).json()["title"] == "gablework"
    assert local_service.client.get("/?f=html").headers["content-type"].startswith("text/html")
    assert local_service.client.get("/?f=xml").status_code == 400
    assert local_service.client.get("/", headers={"Accept": "image/png"}).status_code == 406


def test_the_page_has_the_words_of_the_engine(starting, monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<!doctype html><head><title>the page</title></head>")
    monkeypatch.setattr(landing, "VIEWER", tmp_path)
    text = starting().client.get("/?f=html").text
    (found,) = re.findall(r'<script type="application/json" id="words">(.*)</script></head>', text)
    words = json.loads(found)
    assert words == json.loads(json.dumps(page_words()))
    assert set(words["reasons"]) == {reason.value for reason in Reason}
    assert [stage["name"] for stage in words["stages"]] == [stage.name for stage in STAGES]
    assert set(words["columns"]) <= {column.name for column in BUILDINGS}
    assert words["columns"]["coverage"]["unit"] == "%"
    assert words["columns"]["ridge_z"] == {
        "label": "Ridge",
        "unit": "m",
        "digits": 2,
        "section": "Height",
        "isElevation": True,
    }
    assert words["inputs"]["verticalUnit"] == "Vertical unit"
    assert words["endings"]["tiles"].split(",") == [*POINT_SUFFIXES]
    assert words["endings"]["vectors"].split(",") == [*FOOTPRINT_SUFFIXES]


def test_tiles_beneath_the_map_are_named_in_the_page_and_allowed_in_its_policy_alone(
    starting, monkeypatch, tmp_path: Path
) -> None:
    (tmp_path / "index.html").write_text("<!doctype html><head><title>the page</title></head>")
    monkeypatch.setattr(landing, "VIEWER", tmp_path)
    plain = starting().client.get("/?f=html")
    assert "https:" not in plain.headers["content-security-policy"]
    assert "map-tiles" not in plain.text

    tiles = "https://Tiles.example.org:8443/a/{z}/{x}/{y}.png?k=1&v=2"
    client = starting(map_tiles=tiles, map_credit='© <Owners> & "others"', map_max_zoom=17).client
    page = client.get("/?f=html")
    policy = page.headers["content-security-policy"]
    assert "img-src 'self' data: blob: https://tiles.example.org:8443;" in policy
    assert policy.replace(" https://tiles.example.org:8443", "") == plain.headers["content-security-policy"]
    assert f'<meta name="map-tiles" content="{html.escape(tiles)}">' in page.text
    assert "© &lt;Owners&gt; &amp; &quot;others&quot;" in page.text
    assert '<meta name="map-max-zoom" content="17">' in page.text
    assert "tiles.example.org" not in client.get("/").headers["content-security-policy"]


@pytest.mark.parametrize(
    ("tiles", "fault"),
    [
        ("http://tiles.example.org/{z}/{x}/{y}.png", "https"),
        ("https://tiles.example.org/{z}/{x}.png", "{y}"),
        ("https://tiles.example.org/{z}/{x}/{y}/{s}.png", "no other"),
        ("https://tiles.example.org; script-src */{z}/{x}/{y}.png", "plain characters"),
        ("https://user@tiles.example.org/{z}/{x}/{y}.png", "plain characters"),
        ('https://tiles.example.org/{z}/{x}/{y}.png">', "plain characters"),
    ],
)
def test_tiles_that_cannot_be_used_are_refused_with_the_fix(tiles: str, fault: str) -> None:
    with pytest.raises(ValueError, match="map_tiles") as refused:
        ServiceSettings(map_tiles=tiles, map_credit="owners")
    assert fault in str(refused.value)
    assert "https://tiles.example.org/{z}/{x}/{y}.png" in str(refused.value)


def test_tiles_need_a_credit() -> None:
    with pytest.raises(ValueError, match="name the owners"):
        ServiceSettings(map_tiles="https://tiles.example.org/{z}/{x}/{y}.png")


def test_without_a_built_page_browsers_learn_how_to_build_it(starting, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(landing, "VIEWER", tmp_path / "nothing")
    page = starting().client.get("/?f=html")
    assert page.status_code == 200
    assert "npm run build" in page.text


def test_a_built_page_and_its_files_are_served(starting, monkeypatch, tmp_path: Path) -> None:
    built = tmp_path / "dist"
    (built / "assets").mkdir(parents=True)
    (built / "index.html").write_text("<!doctype html><title>the page</title>")
    (built / "assets" / "page.js").write_text("export {}")
    monkeypatch.setattr(landing, "VIEWER", built)
    client = starting().client
    assert "the page" in client.get("/?f=html").text
    assert client.get("/viewer/assets/page.js").text == "export {}"
    assert client.get("/viewer/../service.db").status_code == 404
    assert client.get("/viewer/%2e%2e/service.db").status_code == 404
    assert client.get("/viewer/assets/nothing.js").headers["content-type"] == "application/problem+json"


def test_conformance_names_what_is_met_and_nothing_else(local_service) -> None:
    declared = local_service.client.get("/conformance").json()["conformsTo"]
    classes = {uri.rpartition("/")[2] for uri in declared if "ogcapi-processes" in uri}
    assert set(declared) - set(FEATURES) == {uri for uri in declared if "ogcapi-processes" in uri}
    wanted = {"core", "json", "html", "oas30", "ogc-process-description", "job-list", "callback", "dismiss"}
    assert classes == wanted
    assert local_service.client.get("/openapi.json").json()["openapi"].startswith("3.0.")


def test_the_page_of_the_api_names_every_path_and_loads_nothing_from_elsewhere(local_service) -> None:
    page = local_service.client.get("/docs").text
    for path in local_service.client.get("/openapi.json").json()["paths"]:
        assert path in page
    assert "<script" not in page
    assert "https://" not in page


def test_a_service_that_works_is_alive_and_ready(local_service) -> None:
    assert local_service.client.get("/healthz").json() == {"status": "ok"}
    checks = local_service.client.get("/readyz").json()["checks"]
    assert checks == {"database": "ok", "state": "ok", "disk": "ok", "driver": "elsewhere", "slots": "ok"}


def test_a_service_without_its_state_folder_is_alive_but_not_ready(local_service) -> None:
    local_service.settings.state.rename(local_service.settings.state.with_name("gone"))
    answer = local_service.client.get("/readyz")
    assert answer.status_code == 503
    assert answer.json()["checks"]["state"] != "ok"
    assert local_service.client.get("/healthz").status_code == 200


def test_figures_count_requests_by_template_and_jobs_by_status(local_service) -> None:
    local_service.waiting()
    for number in range(3):
        local_service.client.get(f"/jobs/{number}")
    figures = local_service.client.get("/metrics").text
    assert 'gablework_requests_total{method="GET",path="/jobs/{jobID}",status="404"} 3.0' in figures
    assert 'gablework_jobs{status="accepted"} 1.0' in figures
    assert "process_resident_memory_bytes" in figures
    oldest = next(line for line in figures.splitlines() if line.startswith("gablework_oldest_waiting_job_seconds "))
    assert 0.0 <= float(oldest.split()[1]) < 600.0


def test_figures_need_a_key_that_sees_the_work_of_all_keys(local_service) -> None:
    expected = {Scope.READ: 403, Scope.SUBMIT: 403, Scope.ADMIN: 200}
    for scope, status in expected.items():
        assert local_service.client.get("/metrics", headers=local_service.key(scope)).status_code == status, scope
    assert local_service.client.get("/metrics").status_code == 401


def test_another_address_needs_keys(starting) -> None:
    with pytest.raises(StartUpError, match="keys create"):
        starting(host="0.0.0.0")
    assert starting(host="0.0.0.0", open_without_keys=True).client.get("/jobs").status_code == 200


def test_a_public_url_is_what_links_say(starting) -> None:
    page = starting(public_url="https://models.example.org/gable/").client.get("/").json()
    assert {link["href"].partition("/gable/")[0] for link in page["links"]} == {"https://models.example.org"}


def test_the_document_says_the_version(local_service) -> None:
    assert local_service.client.get("/openapi.json").json()["info"]["version"] == __version__
