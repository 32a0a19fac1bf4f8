"""`gablework submit`, `watch`, `fetch`, `jobs` and `request`: what they print, and how they end."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from client_site import LINES, OUTLINES, Site
from command_line import app
from live_service import POINTS
from typer.testing import CliRunner

from service.jobs import Fault, JobFailure
from service.problems import FAILURES


@pytest.fixture(autouse=True)
def environment(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GABLEWORK_KEY", "GABLEWORK_KEY_FILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("GABLEWORK_URL", site.url)
    monkeypatch.setenv("XDG_CACHE_HOME", str(site.cache))


def invoke(*words: str, **options: Any) -> Result:
    return CliRunner().invoke(app, list(words), **options)


def done(*words: str, **options: Any) -> str:
    """What a command prints that must succeed."""
    found = invoke(*words, **options)
    assert found.exit_code == 0, found.output
    return found.stdout


def test_submit_prints_the_id_and_the_same_command_prints_it_again(site: Site) -> None:
    words = ("submit", str(site.file("points.xyz", POINTS)), "--crs", "EPSG:28992", "--title", "mine")
    job_id = done(*words).strip()
    again = invoke(*words)
    assert again.stdout.strip() == job_id
    assert "--new makes another one" in again.stderr
    assert done(*words, "--new").strip() != job_id
    document = json.loads(done(*words, "--json"))
    assert (document["jobID"], document["title"]) == (job_id, "mine")


def test_every_option_of_submit_arrives(site: Site) -> None:
    tile, settings = str(site.file("points.xyz", POINTS)), site.folder / "settings.toml"
    settings.write_text("[settings]\n[settings.candidates]\nmin_area_m2 = 15.0\n")
    outlines = site.file("outlines.geojson", OUTLINES)
    words = ["--crs", "EPSG:28992", "--vertical-unit", "ft", "--bbox", "84000", "447000", "84010", "447010"]
    words += ["--classes", "ignore", "--method", "kmeans", "--preset", "faithful", "--lods", "1.2", "--meshes", "glb"]
    words += ["--settings", str(settings), "--licence", "CC0", "--title", "a", "--priority", "-1"]
    words += [
        "--footprints",
        str(outlines),
        "--guides",
        str(site.file("lines.geojson", LINES)),
        "--output",
        "report",
        "--output",
        "buildings",
        "--allow-outside-area-of-use",
    ]
    request = json.loads(done("submit", tile, *words, "--json"))["request"]
    inputs = request["inputs"]
    assert sorted(request["outputs"]) == ["buildings", "report"]
    assert len(inputs.pop("tiles")) == 1
    assert inputs.pop("footprints")["href"].startswith("http")
    assert inputs.pop("guides")["href"].startswith("http")
    assert inputs == {
        "crs": "EPSG:28992",
        "verticalUnit": "ft",
        "bbox": [84000.0, 447000.0, 84010.0, 447010.0],
        "allowOutsideAreaOfUse": True,
        "settings": {
            "candidates": {"min_area_m2": 15.0},
            "method": "kmeans",
            "preset": "faithful",
            "classes": "ignore",
            "lods": "1.2",
        },
        "meshes": "glb",
        "licence": "CC0",
        "title": "a",
        "priority": -1,
    }
    formats = ("--publish", "3dtiles", "--publish", "pmtiles", "--geoid-height", "43.2", "--json")
    inputs = json.loads(done("submit", tile, "--crs", "EPSG:28992", *formats))["request"]["inputs"]
    assert (inputs["publish"], inputs["geoidHeight"]) == (["3dtiles", "pmtiles"], 43.2)
    compared = json.loads(done("submit", tile, "--crs", "EPSG:28992", "--methods", "kmeans, fuzzy-sart", "--json"))
    assert (compared["processID"], compared["request"]["inputs"]["methods"]) == ("compare", ["kmeans", "fuzzy-sart"])
    classified = ("submit", tile, "--crs", "EPSG:28992", "--process", "classify", "--raster-cell", "2", "--json")
    assert json.loads(done(*classified))["request"]["inputs"]["rasterCell"] == 2.0


@pytest.mark.parametrize("field", ["failed_tiles", "tiles_without_points", "tiles_without_terrain", "unpublished"])
def test_submit_and_wait_ends_as_the_job_does(site: Site, field: str) -> None:
    job = site.runs.running(process_id="echo", echo={"message": "a", "delay": 0.0})
    site.store.succeed(job, message="all good", summary={field: ["x1_y1"]})
    found = invoke("watch", job.job_id)
    assert (found.exit_code, "all good" in found.stdout) == (1, True)
    assert "job successful: all good" in found.stderr
    reported = invoke("watch", job.job_id, "--json")
    assert json.loads(reported.stdout)["status"] == "successful"
    assert [json.loads(line)["kind"] for line in reported.stderr.splitlines()] == ["run", "run", "run"]
    assert invoke("watch", job.job_id, "--quiet").stderr == ""


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (Fault.INPUT, 3),
        (Fault.REFUSED, 3),
        (Fault.SETTINGS, 2),
        (Fault.INTERNAL, 5),
        (Fault.CLUSTER, 6),
        (Fault.LOST, 6),
        (Fault.NO_SPACE, 6),
    ],
)
def test_watch_ends_with_the_code_of_the_outcome(site: Site, fault: Fault, code: int) -> None:
    assert set(FAILURES) == set(Fault)
    site.echoed()
    job = site.claimed()
    site.store.fail(job, JobFailure(fault=fault, detail="the reason"))
    found = invoke("watch", job.job_id)
    assert (found.exit_code, f"job {job.job_id} failed: the reason" in found.stderr) == (code, True)
    assert "Traceback" not in found.stderr
    assert "the reason" in done("jobs", "show", job.job_id)


def test_fetch_names_the_files_and_those_that_were_here(site: Site) -> None:
    job_id, out = site.runs.finished(), site.folder / "out"
    assert done("fetch", job_id, "--out", str(out), "report", "buildings").split() == [
        str(out / "buildings.parquet"),
        str(out / "report.json"),
    ]
    files = json.loads(done("fetch", job_id, "--out", str(out), "--json"))["files"]
    assert {file["output"]: file["new"] for file in files}.items() >= {"report": False, "planes": True}.items()
    (out / "report.json").write_text("mine")
    refused = invoke("fetch", job_id, "--out", str(out))
    assert (refused.exit_code, "--overwrite" in refused.stderr) == (4, True)
    done("fetch", job_id, "--out", str(out), "--overwrite")


def test_jobs_are_listed_cancelled_kept_retried_and_removed(site: Site) -> None:
    assert done("jobs").strip() == "there are no such jobs"
    ids = [site.echoed(title=f"number {number}").job_id for number in range(3)]
    table = done("jobs", "--limit", "2")
    assert (ids[2] in table, ids[1] in table, ids[0] in table) == (True, True, False)
    assert "there are more: --offset 2" in table
    listed = json.loads(done("jobs", "--offset", "2", "--json"))
    assert ([job["jobID"] for job in listed["jobs"]], listed["hasMore"]) == ([ids[0]], False)
    assert "is dismissed" in done("jobs", "cancel", ids[0])
    assert invoke("watch", ids[0]).exit_code == 7
    assert ids[0] in done("jobs", "--status", "dismissed", "--process", "echo")
    again = done("jobs", "retry", ids[0]).strip()
    assert "is kept" in done("jobs", "keep", again)
    assert "no longer kept" in done("jobs", "keep", again, "--no-keep")
    assert invoke("jobs", "remove", again).exit_code == 2
    assert done("jobs", "remove", ids[0]) == f"removed {ids[0]}\n"
    assert invoke("jobs", "show", ids[0]).exit_code == 6


def test_options_before_a_command_of_jobs_are_not_lost_silently() -> None:
    found = invoke("jobs", "--url", "http://elsewhere.example", "cancel", "0" * 32)
    assert (found.exit_code, "write --url after the word cancel" in found.output) == (2, True)


def test_request_sends_json_and_prints_the_answer(site: Site) -> None:
    job_id = site.runs.finished()
    assert json.loads(done("request", "GET", f"/jobs/{job_id}"))["jobID"] == job_id
    file = site.file("keep.json", b'{"keep": true}')
    for data, text in (('{"keep": true}', None), (f"@{file}", None), ("-", '{"keep": true}')):
        assert json.loads(done("request", "PATCH", f"/jobs/{job_id}", "--data", data, input=text))["keep"] is True
    assert done("request", "GET", "/healthz")
    assert invoke("request", "PATCH", f"/jobs/{job_id}", "--data", "{").exit_code == 2
    assert invoke("request", "PATCH", f"/jobs/{job_id}", "--data", '{"keep": 7}').exit_code == 2
    assert invoke("request", "GET", "/nothing").exit_code == 6


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["submit", "nowhere.laz"], 3, "nowhere.laz"),
        (["submit", "TILE", "--crs", "EPSG:4326"], 2, "EPSG:28992"),
        (["submit", "TILE", "--settings", "nowhere.toml"], 2, "nowhere.toml"),
        (["submit", "TILE", "--process", "magic"], 2, "reconstruct, compare, classify"),
        (["submit", "/uploads/" + "0" * 32], 2, "0" * 32),
        (["submit", "BAD"], 3, "bad.laz"),
        (["jobs", "--status", "lost"], 2, "accepted, running"),
        (["jobs", "--url", "example.org"], 2, "write it in full"),
        (["jobs", "--url", "http://127.0.0.1:1", "--patience", "0"], 6, "does not answer"),
        (["jobs", "--key-file", "nowhere"], 2, "nowhere"),
    ],
)
def test_commands_that_cannot_work_say_why(site: Site, words: list[str], code: int, said: str) -> None:
    files = {"TILE": site.file("points.xyz", POINTS), "BAD": site.file("bad.laz", b"not a tile" * 50)}
    found = invoke(*(str(files.get(word, word)) for word in words))
    assert (found.exit_code, said in found.stderr) == (code, True), found.stderr
    assert "Traceback" not in found.stderr
    as_json = invoke(*(str(files.get(word, word)) for word in words), "--json")
    assert json.loads(as_json.stdout)["error"]["exit_code"] == code


def test_commands_import_the_client_and_nothing_of_the_engine(site: Site, tmp_path: Path) -> None:
    code = (
        "import sys, atexit\natexit.register(lambda: print(*{n.split('.')[0] for n in sys.modules}, file=sys.stderr))\n"
    )
    code += "from service.cli import main\nmain()\n"
    heavy = {"numpy", "numba", "starlette", "fastapi", "sqlalchemy", "pyarrow", "dask", "pygments"}
    for words in (["jobs"], ["submit", str(site.file("points.xyz", POINTS)), "--crs", "EPSG:28992"]):
        command = [sys.executable, "-c", code, *words]
        ended = subprocess.run(command, env=os.environ, capture_output=True, text=True, check=True)
        found = set(ended.stderr.splitlines()[-1].split())
        assert "httpx" in found
        assert found & heavy == set()
